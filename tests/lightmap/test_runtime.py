"""The runtime decoders against the decoder on the host's side and the float64 path."""

import numpy as np
import pytest
from builders.synthetic import random_sheet

from wlm import interop
from wlm.errors import WlmError
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.exact import colour_tile64
from wlm.lightmap.runtime import ExactDecoder, MatrixDecoder, StripDecoder
from wlm.lightmap.tiles import TileKind

KINDS = (3, 2, 3, 1, 0, 3)  # the static tile's place lies between two dynamic ones


def test_strip_and_exact_agree_at_any_time(device):
    model = random_sheet(KINDS, hidden=16)
    strip, exact, decoder = StripDecoder(model, device), ExactDecoder(model, device), SheetDecoder(model, device)
    assert strip.numbers.tolist() == exact.numbers.tolist() == [0, 2, 5]
    for time in (None, 13.0, 21.7, 3.1):
        for runtime in (strip, exact):
            if time is not None:
                runtime.set_time(time)
            runtime.decode()
        codes, bounds = decoder.tiles_8bit([0, 2, 5], model.times[0] if time is None else time)
        # Between stored times the two are mixed after each was rounded.
        stored = time in (None, 13.0)
        assert np.abs(exact.numpy().astype(int) - codes).max() <= (0 if stored else 2)
        assert np.abs(strip.numpy().astype(int) - codes).max() <= (1 if stored else 2)
        np.testing.assert_allclose(strip.bounds, bounds, rtol=1e-6)


@pytest.mark.parametrize(("gelu", "most"), [("exact", 1e-4), ("tanh", 2e-2), ("fast", 2e-2)])
def test_a_cheaper_gelu_stays_close(gelu, most, device):
    model = random_sheet((3,), columns=1)
    strip = StripDecoder(model, device, gelu)
    strip.set_time(7.5)
    strip.decode()
    share = np.minimum(colour_tile64(model, 0, 7.5) / strip.bounds[0], 1.0)
    assert np.abs(strip.numpy()[0, ..., :3] / 255.0 - share).max() < 0.5 / 255.0 + most


def test_static_tiles(device):
    model = random_sheet(KINDS)
    exact = ExactDecoder(model, device, kind=TileKind.STATIC)
    exact.set_time(13.0)
    exact.decode()
    assert exact.numbers.tolist() == [1]
    assert np.array_equal(exact.numpy(), SheetDecoder(model, device).tiles_8bit([1], 13.0)[0])


@pytest.mark.parametrize("hidden", [16, 48, 64])
def test_matrix_units_are_close(hidden, device):
    if device == "cpu":
        pytest.skip("a CPU has none")
    model = random_sheet(KINDS, hidden=hidden, gelu="tanh")
    matrix, exact = MatrixDecoder(model, device), ExactDecoder(model, device)
    assert matrix.numbers.tolist() == [0, 2, 5]
    for time in (13.0, 21.7):
        for runtime in (matrix, exact):
            runtime.set_time(time)
            runtime.decode()
        off = np.abs(matrix.numpy().astype(int) - exact.numpy())
        assert off.max() <= 3 and off.mean() < 0.2, "half floats: some thousandths of an activation"


def test_a_captured_decode_repeats(device):
    model = random_sheet((3, 3))
    strip = StripDecoder(model, device)
    strip.decode()
    expected = strip.numpy()
    graph = interop.StepGraph(strip.decode, device, warmup=1)
    for _ in range(3):
        strip.out.zero_()
        graph()
        assert np.array_equal(strip.numpy(), expected)
    assert graph.captured == (device != "cpu")


def test_what_is_refused():
    with pytest.raises(WlmError, match="expected at least one dynamic tile, found none"):
        StripDecoder(random_sheet((2, 0)))
    with pytest.raises(WlmError, match="expected at least one static tile, found none"):
        ExactDecoder(random_sheet((3, 0)), kind=TileKind.STATIC)
    with pytest.raises(WlmError, match="expected cuda for the matrix path, got cpu"):
        MatrixDecoder(random_sheet((3, 0)), "cpu")
    with pytest.raises(WlmError, match="gelu: expected one of"):
        StripDecoder(random_sheet((3, 0)), gelu="relu")
    with pytest.raises(WlmError, match="finite"):
        StripDecoder(random_sheet((3, 0))).set_time(float("inf"))
