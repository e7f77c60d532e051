"""PSNR and its relatives against sums done by hand."""

import math

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from wlm import texels
from wlm.errors import WlmError
from wlm.metrics import PSNR_CAP_DB, dynamic_range, half_ulp, mse, psnr
from wlm.texels import fill_gaps


def test_psnr_of_four_numbers_by_hand():
    ref = np.array([[[0.0, 1.0, 2.0]], [[3.0, 4.0, 5.0]]])
    test = ref + np.array([[[0.5, 0.0, 0.0]], [[0.0, -0.5, 1.0]]])
    # Squared errors 0.25, 0.25 and 1 over six values; the peak is 5.
    assert mse(ref, test) == pytest.approx(1.5 / 6.0, rel=1e-15)
    assert psnr(ref, test) == pytest.approx(10.0 * math.log10(25.0 / 0.25), rel=1e-14)
    assert psnr(ref, test, peak=1.0) == pytest.approx(10.0 * math.log10(1.0 / 0.25), rel=1e-14)
    assert dynamic_range(ref) == 5.0


def test_mask_chooses_texels_for_error_and_range():
    ref = np.array([[[0.0], [1.0], [9.0]]])
    test = np.array([[[0.5], [1.0], [0.0]]])
    mask = np.array([[True, True, False]])
    assert psnr(ref, test, mask) == pytest.approx(10.0 * math.log10(1.0 / 0.125), rel=1e-14)
    assert dynamic_range(ref, mask) == 1.0


def test_sums_are_float64():
    # 2**24 + 1 is no float32: an error of 1 would vanish in float32 arithmetic.
    ref = np.full((2, 2, 3), 2.0**24)
    assert mse(ref, ref + 1.0) == 1.0
    # And a million float16 ones overflow if summed in their own type.
    ones = np.ones((1000, 1000, 1), np.float16)
    assert mse(ones, np.zeros_like(ones)) == 1.0


def test_exact_and_nearly_exact_are_capped():
    ref = np.linspace(0.0, 1.0, 48).reshape(4, 4, 3)
    assert psnr(ref, ref) == PSNR_CAP_DB
    assert psnr(ref, ref + 1e-12) == PSNR_CAP_DB
    assert psnr(ref, ref + 1e-5) == pytest.approx(100.0)


def test_nothing_to_measure_is_nan():
    image = np.ones((3, 3, 3))
    empty = np.zeros((3, 3), bool)
    assert math.isnan(mse(image, image, empty))
    assert math.isnan(psnr(image, image, empty))
    assert math.isnan(dynamic_range(image, empty))
    assert math.isnan(psnr(image, image + 1.0))  # constant: no range


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_bad_values_are_named_and_only_inside_the_mask(value):
    good = np.ones((4, 5, 3))
    bad = good.copy()
    bad[2, 3, 1] = value
    with pytest.raises(WlmError, match=r"test image .* 1 valid texels, first at row 2, column 3"):
        mse(good, bad)
    with pytest.raises(WlmError, match="reference"):
        mse(bad, good)
    mask = np.ones((4, 5), bool)
    mask[2, 3] = False
    assert mse(good, bad, mask) == 0.0
    assert mse(bad, good, mask) == 0.0


def test_shapes_and_peak_are_checked():
    with pytest.raises(WlmError, match="one shape"):
        mse(np.ones((4, 4, 3)), np.ones((4, 5, 3)))
    with pytest.raises(WlmError, match="mask"):
        mse(np.ones((4, 4, 3)), np.ones((4, 4, 3)), np.ones((4, 5)))
    with pytest.raises(WlmError, match="peak"):
        psnr(np.ones((4, 4, 3)), np.zeros((4, 4, 3)), peak=math.inf)


@pytest.mark.parametrize(
    ("value", "step"),
    [(1.0, 2.0**-10), (-1.0, 2.0**-10), (1.999, 2.0**-10), (2.0, 2.0**-9), (60000.0, 32.0), (0.0, 2.0**-24),
     (65504.0, 32.0), (1e9, 32.0)],
)  # fmt: skip
def test_half_steps(value, step):
    assert half_ulp(value) == step


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
    with pytest.raises(WlmError, match="fill_gaps"):
        fill_gaps(whole, np.ones((4, 3)))
