"""The runtime decoders and the texture of the whole map, against the decoder on the host and the float64 path."""

import numpy as np
import pytest
import warp as wp
from builders.light_groups import random_groups, sum64
from builders.lightmap_codes import shares_of
from builders.synthetic import random_sheet

from benchmarks.lightmap_exact import bound64, colour_tile64
from wlm import interop
from wlm.errors import WlmError
from wlm.formats.shared_exponent import LARGEST, pack_rgb9e5, unpack_rgb9e5
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.runtime import ExactDecoder, MapDecoder, MatrixDecoder, fast_decoder
from wlm.texels import near_gaps
from wlm_kernels.shared_exponent import pack_rgb9e5 as pack_kernel
from wlm_kernels.shared_exponent import unpack_rgb9e5 as unpack_kernel

KINDS = (3, 2, 3, 1, 0, 3)  # the static tile's place lies between two dynamic ones


@pytest.mark.parametrize(
    ("hidden", "gelu"),
    [(8, "tanh"), *(pytest.param(*shape, marks=pytest.mark.slow) for shape in ((17, "exact"), (64, "tanh")))],
)
def test_tiles_decode_at_any_time(device, hidden, gelu):
    model = random_sheet(KINDS, hidden=hidden, gelu=gelu)
    exact = ExactDecoder(model, device)
    assert exact.numbers.tolist() == [0, 2, 5]
    for time in (None, 13.0, 21.7, 3.1):
        if time is not None:
            exact.set_time(time)
        exact.decode()
        # Between stored times the two are mixed after each was rounded, in steps of its own range.
        stored, at = time in (None, 13.0), model.times[0] if time is None else time
        shares = shares_of(model, exact.numbers, at)
        assert np.abs(exact.numpy()[..., :3] - 255.0 * shares).max() < (0.51 if stored else 3.51)
        np.testing.assert_allclose(exact.bounds, [bound64(model, number, at) for number in exact.numbers], rtol=1e-6)


@pytest.mark.parametrize(("gelu", "most"), [("exact", 1e-4), ("tanh", 2e-2), ("fast", 2e-2)])
def test_a_cheaper_gelu_stays_close(gelu, most, device):
    model = random_sheet((3,), columns=1)
    exact = ExactDecoder(model, device, gelu)
    exact.set_time(7.5)
    exact.decode()
    share = np.minimum(colour_tile64(model, 0, 7.5) / exact.bounds[0], 1.0)
    assert np.abs(exact.numpy()[0, ..., :3] / 255.0 - share).max() < 0.5 / 255.0 + most


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(("hidden", "resolution"), [(16, 8), (48, 128), (64, 40)])
def test_matrix_units_are_close(hidden, resolution, shared, device):
    if device == "cpu":
        pytest.skip("a CPU has none")
    model = random_sheet(KINDS, hidden=hidden, gelu="tanh", uvt_resolution=resolution)
    matrix, exact, gamma = MatrixDecoder(model, device, shared), SheetDecoder(model, device), model.profile.gamma
    assert matrix.numbers.tolist() == [0, 2, 5]
    for time in (13.0, 21.7):
        matrix.set_time(time)
        matrix.decode()
        light, bounds = exact.tiles([0, 2, 5], time), matrix.bounds[:, None, None, None]
        shares, found = np.minimum(light ** (1.0 / gamma) / bounds, 1.0), matrix.numpy()[..., :3]
        # Half floats: some thousandths of an activation.
        if shared:
            steps = ((shares + 3.0 / 255.0) ** gamma - shares**gamma) * bounds**gamma
            assert (np.abs(found - light) <= steps + light.max(-1, keepdims=True) / 500.0).all()
        else:
            off = np.abs(found - 255.0 * shares)
            assert off.max() <= 3.0 and off.mean() < 0.3


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


MAP_KINDS = (3, 4, 2, 1, 4, 3)


@wp.kernel
def _both_ways(light: wp.array1d[wp.vec3], words: wp.array1d[wp.uint32], back: wp.array1d[wp.vec3]):
    i = wp.tid()
    words[i] = pack_kernel(light[i])
    back[i] = unpack_kernel(words[i])


def test_texels_are_packed_as_on_the_host(device):
    random = np.random.default_rng(0)
    light = random.random((4000, 3)) * 2.0 ** random.integers(-26, 17, (4000, 1))
    powers = 2.0 ** np.arange(-25, 17)
    edges = np.concatenate([powers, np.nextafter(powers, 0), powers * (1 - 1 / 1024)])[:, None] * [1.0, 0.5, 0.0]
    light = np.concatenate([light, edges, [[0, 0, 0], [LARGEST, 1e9, 0], [-1, 0.5, 0]]]).astype(np.float32)
    words, back = (
        wp.empty(len(light), dtype=wp.uint32, device=device),
        wp.empty(len(light), dtype=wp.vec3, device=device),
    )
    wp.launch(_both_ways, len(light), [wp.array(light, dtype=wp.vec3, device=device), words, back], device=device)
    np.testing.assert_array_equal(back.numpy(), unpack_rgb9e5(words.numpy()))
    # A half is rounded up here and to even there.
    expected = unpack_rgb9e5(pack_rgb9e5(light))
    step = np.maximum(light.max(1, keepdims=True), 2.0**-16).clip(max=LARGEST) / 256
    assert (np.abs(back.numpy() - expected) <= step).all() and (back.numpy() == expected).mean() > 0.999


@pytest.mark.parametrize("time", [7.5, 9.0])
def test_the_map_is_that_of_the_host(time, device):
    mask = np.zeros((236, 375), bool)
    mask[20:60, 30:128] = mask[100:180, 60:90] = mask[40:200, 126:150] = mask[130:200, 200:340] = True
    model = random_sheet(MAP_KINDS, mask=mask, columns=3)
    decoder = MapDecoder(model, device)
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
    decoder = MapDecoder(model, device)
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
    assert len(MapDecoder(model, device, mips=0).levels) == 1
    with pytest.raises(WlmError, match="mips: expected 0 to 7 for a map of 247x236, got 8"):
        MapDecoder(model, device, mips=8)


def test_mips_leave_out_tiles_that_the_file_lacks(device):
    decoder = MapDecoder(random_sheet((3, 0, 1, 3)), device)
    decoder.decode()
    light, whole = decoder.numpy().astype(np.float64), len(decoder.levels) - 1
    stored = np.ones(light.shape[:2], bool)
    stored[:128, 128:] = False
    # The mean is rounded at each level.
    np.testing.assert_allclose(decoder.numpy(whole)[0, 0], light[stored].mean(0), rtol=0.03)


def test_groups_are_added_in_one_texture(device):
    model = random_groups(np.random.default_rng(6).random((236, 247)) < 0.8)
    off = dict.fromkeys(model.groups, (0.0, 0.0, 0.0))
    alone = {group: sum64(model, 9.0, off | {group: (1.0, 1.0, 1.0)}) for group in model.groups}
    decoder = MapDecoder(model.maps(), device)
    decoder.set_time(9.0)
    decoder.decode()
    # A change of weights needs neither another decode nor another graph.
    graph = interop.StepGraph(decoder.add, device, warmup=1)
    for weights in ({}, {"sun": (0.25, 1.5, 0.0), "lamp": (3.0, 1.0, 0.5)}, off):
        decoder.set_weights(weights)
        graph()
        expected = sum(decoder.weights[group] * light for group, light in alone.items())
        # Half a step of the sum, and of each group at one or two times and mixed.
        steps = 0.5 * expected.max(2, keepdims=True)
        steps = steps + sum(1.5 * decoder.weights[group] * alone[group].max(2, keepdims=True) for group in alone)
        assert (np.abs(decoder.numpy() - expected) <= steps / 256 + 1e-6).all()
    assert not decoder.numpy().any()
    with pytest.raises(WlmError, match="expected a group among sky, sun, lamp, unlit, got 'moon'"):
        decoder.set_weights({"moon": 1.0})
    other = random_sheet((3,), 1)
    with pytest.raises(WlmError, match="expected a map of 247x236, got 119x108"):
        MapDecoder(model.maps() | {"other": other}, device)


def test_a_weight_dims_a_model_without_groups(device):
    decoder = MapDecoder(random_sheet((1, 3, 2, 0)), device, mips=1)
    decoder.decode()
    before = decoder.numpy()
    decoder.set_weights({"base": (0.5, 1.0, 0.0)})
    decoder.add()
    step = before.max(2, keepdims=True) / 256
    assert (np.abs(decoder.numpy() - before * [0.5, 1.0, 0.0]) <= 0.5 * step + 1e-6).all()
