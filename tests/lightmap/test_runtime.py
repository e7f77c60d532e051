"""The runtime decoders, against the float64 path."""

import numpy as np
import pytest
import warp as wp
from builders.synthetic import random_sheet

from benchmarks.lightmap_exact import bound64, decode_tile64
from wlm import interop
from wlm.formats.shared_exponent import LARGEST, pack_rgb9e5, unpack_rgb9e5
from wlm.lightmap.model import SheetModel
from wlm.lightmap.runtime import ExactDecoder, FrameDecoder, MatrixDecoder, RuntimeDecoder, fast_decoder
from wlm_kernels.shared_exponent import pack_rgb9e5 as pack_kernel
from wlm_kernels.shared_exponent import unpack_rgb9e5 as unpack_kernel

KINDS = (3, 4, 3, 1, 0, 3)


def _check(decoder: RuntimeDecoder, model: SheetModel, time: float, most: float) -> None:
    """Compares with the float64 path: half a step of RGB9E5, and a share of the tile's bound in gamma space."""
    decoder.set_time(time)
    decoder.decode()
    gamma = model.profile.gamma
    for number, found in zip(decoder.numbers.tolist(), decoder.numpy(), strict=True):
        light, bound = decode_tile64(model, number, time), bound64(model, number, time)
        allowed = (light ** (1.0 / gamma) + most * bound) ** gamma - light + light.max(-1, keepdims=True) / 500.0
        assert (np.abs(found - light) <= allowed).all()


@pytest.mark.parametrize(
    ("hidden", "gelu"),
    [(8, "tanh"), *(pytest.param(*shape, marks=pytest.mark.slow) for shape in ((17, "exact"), (64, "tanh")))],
)
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
