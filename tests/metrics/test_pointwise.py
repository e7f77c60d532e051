"""PSNR and its relatives against sums done by hand."""

import math

import numpy as np
import pytest
from builders.checks import error_of
from scipy.ndimage import distance_transform_edt

from wlm import texels
from wlm.metrics import PSNR_CAP_DB, evaluate_frame, psnr_from_mse
from wlm.texels import fill_gaps


def test_psnr_of_an_error_and_its_cap():
    assert psnr_from_mse(0.25, 5.0) == pytest.approx(10.0 * math.log10(25.0 / 0.25), rel=1e-14)
    assert psnr_from_mse(1e-10, 1.0) == pytest.approx(100.0)
    assert psnr_from_mse(0.0, 1.0) == psnr_from_mse(1e-24, 1.0) == PSNR_CAP_DB
    for error, peak in ((math.nan, 1.0), (1.0, 0.0), (1.0, math.nan), (1.0, -1.0)):
        assert math.isnan(psnr_from_mse(error, peak))
    assert psnr_from_mse(1e-300, 1e-200) == pytest.approx(-1000.0)  # the square of the peak would be 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_bad_values_are_named_and_only_inside_the_mask(value):
    good = np.ones((4, 5, 3))
    bad = good.copy()
    bad[2, 3, 1] = value
    whole, part = np.ones((4, 5), bool), np.ones((4, 5), bool)
    part[2, 3] = False
    text = error_of(evaluate_frame, good, bad, whole, name="noon")
    assert text == "noon: the test image is NaN or infinite at 1 valid texels, first at row 2, column 3"
    assert "noon: the reference is NaN" in error_of(evaluate_frame, bad, good, whole, name="noon")
    for pair in ((good, bad), (bad, good)):
        assert evaluate_frame(*pair, part).max_abs_error == 0.0
    assert "images [H, W, C] of one shape" in error_of(evaluate_frame, good, good[:3], whole)
    assert "expected a mask of (4, 5), got (3, 5)" in error_of(evaluate_frame, good, good, whole[:3])


def test_fill_gaps_takes_the_nearest_valid_texel():
    image = np.zeros((1, 6, 1))
    image[0, 1], image[0, 4] = 3.0, 7.0
    mask = np.array([[False, True, False, False, True, False]])
    np.testing.assert_array_equal(fill_gaps(image, mask)[0, :, 0], [3, 3, 3, 7, 7, 7])
    # Leading axes share the mask; types stay.
    stack = np.stack([image, 2 * image]).astype(np.float16)
    filled = fill_gaps(stack, mask)
    assert filled.dtype == np.float16
    np.testing.assert_array_equal(filled[1, 0, :, 0], [6, 6, 6, 14, 14, 14])


@pytest.mark.parametrize("share", [0.0005, 0.02, 0.5])
def test_nearest_texels_of_strips_are_the_nearest(share, monkeypatch):
    """However far they are: where a strip doesn't hold them, all is looked at."""
    monkeypatch.setattr(texels, "_STRIP", 16)
    random, (y, x) = np.random.default_rng(3), np.mgrid[:90, :50]
    in_strips = 0
    for empty in (0, 5, 60):
        mask = random.random(y.shape) < share
        mask[:empty], mask[-1, 7] = False, True
        rows, columns = texels.nearest_valid(mask)
        assert mask[rows, columns].all()
        distance = np.hypot(rows - y, columns - x)
        np.testing.assert_allclose(distance, distance_transform_edt(~mask), rtol=1e-12)
        in_strips += texels._nearest_in_strips(mask) is not None
    assert in_strips == {0.0005: 0, 0.02: 0, 0.5: 2}[share]


def test_fill_gaps_at_its_limits():
    image = np.full((3, 4, 2), np.nan)
    assert not fill_gaps(image, np.zeros((3, 4))).any()  # nothing valid: zeros, not NaN
    image[1, 2] = [5.0, 6.0]
    one = np.zeros((3, 4))
    one[1, 2] = 255
    np.testing.assert_array_equal(fill_gaps(image, one), np.broadcast_to([5.0, 6.0], (3, 4, 2)))
    whole = np.ones((3, 4, 2))
    copy = fill_gaps(whole, np.ones((3, 4)))
    copy[0, 0] = 9.0
    assert whole[0, 0, 0] == 1.0
