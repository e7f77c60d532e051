"""The runtime decoders, against the decoder on the host and the float64 path."""

import numpy as np
import pytest
import warp as wp
from builders.lightmap_codes import shares_of
from builders.synthetic import random_sheet

from benchmarks.lightmap_exact import bound64, colour_tile64
from wlm import interop
from wlm.formats.shared_exponent import LARGEST, pack_rgb9e5, unpack_rgb9e5
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.runtime import ExactDecoder, MatrixDecoder, fast_decoder
from wlm_kernels.shared_exponent import pack_rgb9e5 as pack_kernel
from wlm_kernels.shared_exponent import unpack_rgb9e5 as unpack_kernel

KINDS = (3, 4, 3, 1, 0, 3)


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
