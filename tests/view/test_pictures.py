"""Pictures of light."""

import numpy as np
import pytest

from wlm.view.display import white_of
from wlm.view.pictures import encode


def test_exposure():
    light = np.array([[[0.0, 0.5, 1.0], [2.0, -1.0, 0.001]]])
    encoded = encode(light, np.array([[True, True]]), 1.0)
    # sRGB of a half is 188, of a thousandth 12.92 / 1000.
    np.testing.assert_array_equal(encoded, [[[0, 188, 255], [255, 0, 3]]])
    assert (encode(light, np.zeros((1, 2), bool), 1.0) == 128).all()
    assert white_of(np.zeros((5, 3))) == 1.0 == white_of(np.zeros((0, 3)))
    dark = np.zeros((10000, 3))
    dark[0] = 3.0
    assert white_of(dark) == 3.0, "one lamp in the dark"
    assert white_of(np.arange(1001.0)) == pytest.approx(995.0)
