"""The float64 path against the decoder and by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from builders.synthetic import random_sheet

from wlm.errors import WlmError
from wlm.formats.bc7 import pack_mode6
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.exact import bound64, colour_tile64, decode_tile64

TIMES = (0.0, 7.5, 10.0, 13.0, 21.7, 23.99)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"period": None},
        {"time_axis": "paper"},
        {"gelu": "tanh", "hidden": 16, "uvt_slices": 1},
        {"times": (3.0,)},
    ],
    ids=str,
)
def test_the_decoder_agrees(settings, device):
    model = random_sheet(**settings)
    decoder = SheetDecoder(model, device)
    for time in TIMES:
        tiles = decoder.tiles(range(4), time)
        codes, bounds = decoder.tiles_8bit(range(4), time)
        for number in range(4):
            expected = decode_tile64(model, number, time)
            # float32 arithmetic through two layers, and a power: 2e-6 measured.
            np.testing.assert_allclose(tiles[number], expected, rtol=0, atol=2e-5 * max(1.0, expected.max()))
            colour, bound = colour_tile64(model, number, time), bound64(model, number, time)
            np.testing.assert_allclose(colour**2.2, expected, rtol=1e-9, atol=1e-12)
            assert bounds[number] == pytest.approx(bound, rel=1e-6)
            if bound > 0:
                share = np.minimum(colour / bound, 1.0)
                assert np.abs(codes[number, ..., :3] / 255.0 - share).max() < 0.5 / 255.0 + 1e-5


def test_a_network_that_passes_its_features_through():
    """One texel by hand: the first layer reads F_uv's red alone, far on GELU's linear side, and the rest copies it."""
    model = random_sheet(kinds=(2, 0), seed=3)
    net = np.zeros_like(model.net_static)
    hidden, width = net[0], model.profile.hidden
    hidden[0 * width] = 1.0  # input 0 to unit 0
    hidden[4 * width] = 64.0  # its bias, from where on GELU is the identity
    hidden[5 * width] = 1.0  # unit 0 to unit 0 of the second layer
    hidden[-3 * (width + 1)] = 1.0  # and to red
    hidden[-3] = -64.0  # the bias taken off again
    affine = np.zeros_like(model.affine)
    affine[0, :, 0] = 2.0, 1.0
    scale = np.full_like(model.scale_static, 8.0)
    model = replace(model, net_static=net, affine=affine, scale_static=scale)
    red = np.array([[64, 192]], np.float64) / 255.0
    endpoints = np.zeros((1, 32, 32, 2, 4), np.uint8)
    endpoints[..., 0, 0], endpoints[..., 1, 0] = 64, 192
    indices = np.zeros((1, 32, 32, 16), np.uint8)
    indices[..., 1::2] = 15
    model = replace(model, uv=pack_mode6(endpoints, indices))
    expected = 8.0 * (2.0 + (red - 0.5) * math.sqrt(12.0))
    colour = colour_tile64(model, 0, 5.0)
    np.testing.assert_allclose(colour[:, :, 0], np.tile(expected, (128, 64)), rtol=1e-12)
    assert not colour[..., 1:].any()


def test_what_is_not_there():
    model = random_sheet()
    with pytest.raises(WlmError, match="tile 4 is outside"):
        decode_tile64(model, 4, 0.0)
    with pytest.raises(WlmError, match="finite"):
        colour_tile64(model, 0, math.nan)
    assert not decode_tile64(model, 3, 1.0).any() and bound64(model, 3, 1.0) == 0.0
