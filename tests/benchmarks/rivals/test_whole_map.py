"""Decoders of whole tiles against the float64 path, and the texture of a whole map against the decoder on the host."""

import numpy as np
import pytest
from builders.synthetic import random_sheet

from benchmarks.lightmap_exact import bound64, decode_tile64
from benchmarks.rivals.whole_map import WholeMap
from benchmarks.rivals.whole_tiles import ExactDecoder, FrameDecoder, MatrixDecoder, TileDecoder, fast_decoder
from wlm import interop
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.model import SheetModel
from wlm.texels import near_gaps

KINDS = (3, 4, 3, 1, 0, 3)


def _check(decoder: TileDecoder, model: SheetModel, time: float, most: float) -> None:
    """Compares with the float64 path: half a step of RGB9E5, and a share of the tile's bound in gamma space."""
    decoder.set_time(time)
    decoder.decode()
    gamma = model.profile.gamma
    for number, found in zip(decoder.numbers.tolist(), decoder.numpy(), strict=True):
        light, bound = decode_tile64(model, number, time), bound64(model, number, time)
        allowed = (light ** (1.0 / gamma) + most * bound) ** gamma - light + light.max(-1, keepdims=True) / 500.0
        assert (np.abs(found - light) <= allowed).all()


SLOW = [pytest.param(*shape, marks=pytest.mark.slow) for shape in ((17, "exact"), (64, "tanh"))]


@pytest.mark.parametrize("hidden, gelu", [(8, "tanh"), *SLOW])
def test_tiles_decode_at_any_time(device, hidden, gelu):
    model = random_sheet(KINDS, hidden=hidden, gelu=gelu)
    exact, frames = ExactDecoder(model, device), FrameDecoder(model, device)
    assert exact.numbers.tolist() == [0, 2, 5] and frames.numbers.tolist() == [1]
    for decoder in (exact, frames):
        for time in (model.times[0], 13.0, 21.7, 3.1):
            _check(decoder, model, time, 1e-5)


@pytest.mark.parametrize(("gelu", "most"), [("exact", 1e-4), ("tanh", 2e-2), ("fast", 2e-2)])
def test_a_cheaper_gelu_stays_close(gelu, most, device):
    model = random_sheet((3,), columns=1)
    _check(ExactDecoder(model, device, gelu), model, 7.5, most)


@pytest.mark.parametrize(("hidden", "resolution"), [(16, 8), (48, 128), (64, 40)])
def test_matrix_units_are_close(hidden, resolution, device):
    if device == "cpu":
        pytest.skip("a CPU has none")
    model = random_sheet(KINDS, hidden=hidden, gelu="tanh", uvt_resolution=resolution)
    matrix = MatrixDecoder(model, device)
    assert matrix.numbers.tolist() == [0, 2, 5]
    for time in (13.0, 21.7):
        _check(matrix, model, time, 3.0 / 255.0)  # half floats: some thousandths of an activation


def test_a_captured_decode_repeats(device):
    model = random_sheet((3, 3))
    decoder = fast_decoder(model, device)
    decoder.decode()
    expected = decoder.numpy()
    graph = interop.StepGraph(decoder.decode, device, warmup=1)
    for _ in range(3):
        decoder.out.zero_()
        graph()
        assert np.array_equal(decoder.numpy(), expected)
    assert graph.captured == (device != "cpu")


@pytest.mark.parametrize("time", [7.5, 9.0])
def test_the_map_is_that_of_the_host(time, device):
    mask = np.zeros((236, 375), bool)
    mask[20:60, 30:128] = mask[100:180, 60:90] = mask[40:200, 126:150] = mask[130:200, 200:340] = True
    model = random_sheet((3, 4, 3, 1, 4, 3), mask=mask, columns=3)
    decoder = WholeMap(model, device)
    decoder.set_time(time)
    decoder.decode()
    expected = SheetDecoder(model, device).frame(time)
    step = expected.max(2, keepdims=True) / 256
    # Half a step of each of both times and of their mixture.
    assert (np.abs(decoder.numpy() - expected) <= (1.5 if time == 9.0 else 0.5) * step + 1e-6).all()


def test_mips_hold_charts_alone(device):
    mask = np.zeros((236, 247), bool)
    mask[:64, 5:70] = mask[117:, 90:] = mask[235, 0] = True
    model = random_sheet((3, 3, 1, 3), mask=mask)
    decoder = WholeMap(model, device)
    decoder.decode()
    assert [level.shape for level in decoder.levels] == [(236 >> i, 247 >> i) for i in range(8)]
    light, weight = decoder.numpy().astype(np.float64), mask.astype(float)
    for level in range(1, 8):
        rows, columns = (np.minimum(np.arange(size) // 2, max(size // 2, 1) - 1) for size in weight.shape)
        shape = decoder.levels[level].shape
        total, summed = np.zeros(shape), np.zeros((*shape, 3))
        np.add.at(total, (rows[:, None], columns[None]), weight)
        np.add.at(summed, (rows[:, None], columns[None]), weight[..., None] * light)
        mean = summed / np.maximum(total, 1)[..., None]
        light, weight = decoder.numpy(level).astype(np.float64), total
        inside = total > 0
        assert (np.abs(light - mean)[inside] <= mean[inside].max(1, keepdims=True) / 500 + 1e-7).all()
        target, source = near_gaps(inside)
        np.testing.assert_array_equal(light[tuple(target.T)], light[tuple(source.T)])
        inside[tuple(target.T)] = True
        assert (light[~inside] == 0).all()
