"""SSIM and FLIP against the libraries called directly."""

import math

import flip_evaluator
import numpy as np
import pytest
from builders.checks import error_of
from skimage.metrics import structural_similarity

from wlm.metrics import flip_display, flip_exposures, flip_filled, ssim
from wlm.texels import fill_gaps


def make_pair(height=48, width=40, seed=0):
    """A smooth HDR image and a noisy copy, float32."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 12.0
    base = 0.2 + (np.sin(y) * np.cos(x) + 1.0) ** 3
    ref = base[..., None] * np.array([1.0, 0.8, 0.5])
    return ref.astype(np.float32), (ref * (1.0 + 0.05 * rng.standard_normal(ref.shape))).astype(np.float32)


def flip_map(ref, test, mask=None):
    """FLIP of images whose texels outside the mask take the reference's nearest valid value."""
    valid = np.ones(ref.shape[:2], bool) if mask is None else mask
    filled = fill_gaps(ref.astype(np.float64), valid)
    test = np.where(valid[..., None], test, filled)
    return flip_filled(filled, test, flip_exposures(filled, valid))


def exposures_of(ref):
    return flip_exposures(ref.astype(np.float64), np.ones(ref.shape[:2], bool))


def ssim_of(ref, test, mask=None):
    """SSIM with the range of the reference's valid texels."""
    mask = np.ones(ref.shape[:2], bool) if mask is None else mask
    return ssim(ref, test, mask, float(np.ptp(ref[mask].astype(np.float64))))


def test_ssim_of_a_full_mask_is_scikit_images():
    ref, test = (image.astype(np.float64) for image in make_pair())
    expected = structural_similarity(
        ref,
        test,
        data_range=float(np.ptp(ref)),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert 0.5 < expected < 0.999
    assert ssim_of(ref, test) == pytest.approx(expected, abs=1e-12)


def test_ssim_where_it_does_not_exist():
    ref, test = make_pair(10, 40)
    assert math.isnan(ssim_of(ref, test))
    ref, test = make_pair()
    edge = np.zeros(ref.shape[:2], bool)
    edge[:5] = True
    assert math.isnan(ssim_of(ref, test, edge))
    assert math.isnan(ssim(ref, test, np.zeros_like(edge), 1.0))
    flat = np.full_like(ref, 2.0)
    assert math.isnan(ssim_of(flat, test))


def test_flip_of_identical_images_is_zero_and_of_a_pair_the_librarys():
    ref, test = make_pair()
    assert flip_map(ref, ref).max() == 0.0
    start, stop = exposures_of(ref)
    expected, _, _ = flip_evaluator.evaluate(
        ref, test, "HDR", applyMagma=False,
        parameters={"startExposure": start, "stopExposure": stop, "numExposures": 2},
    )  # fmt: skip
    ours = flip_map(ref, test)
    assert expected.mean() > 0.01
    # The library keeps exposures as float32, and ours reach it moved by a whole number of stops.
    np.testing.assert_allclose(ours, expected[..., 0], atol=2e-5)


def test_exposures_are_the_librarys_where_its_definition_is_ours():
    """Grey levels of which the brightest is so frequent that the 99th percentile is the maximum."""
    levels = np.concatenate([np.linspace(0.1, 4.0, 101), np.full(20, 4.0)]).astype(np.float32)
    ref = np.repeat(levels[None, :, None], 3, axis=2)
    _, _, library = flip_evaluator.evaluate(ref, ref, "HDR", applyMagma=False)
    start, stop = exposures_of(ref)
    assert start == pytest.approx(library["startExposure"], abs=1e-5)
    # Its median takes a neighbour, ours interpolates.
    assert stop == pytest.approx(library["stopExposure"], abs=0.03)


def test_exposures_follow_the_scale_and_ignore_black():
    ref, _ = make_pair()
    start, stop = exposures_of(ref)
    scaled = exposures_of(ref * 8.0)
    assert scaled == pytest.approx((start - 3.0, stop - 3.0), abs=1e-5)
    night = np.concatenate([ref, np.zeros((200, ref.shape[1], 3), np.float32)])
    assert exposures_of(night) == pytest.approx((start, stop), abs=1e-9)
    assert exposures_of(np.zeros((4, 4, 3))) is None


def test_flip_of_a_black_reference():
    black = np.zeros((8, 8, 3))
    assert flip_map(black, black).max() == 0.0
    dim, bright = flip_map(black, black + 0.01).mean(), flip_map(black, black + 1.0).mean()
    assert 0.0 < dim < bright <= 1.0
    # A reference that is black where it counts is black.
    ref = np.ones((8, 8, 3))
    mask = np.zeros((8, 8), bool)
    mask[2:4, 2:4] = True
    ref[mask] = 0.0
    assert flip_map(ref, black, mask).max() == 0.0


def test_flip_survives_a_test_that_explodes():
    ref, _ = make_pair()
    error = flip_map(ref, np.full_like(ref, 1e38))
    assert np.isfinite(error).all()
    # As far from the reference as any white: not the small number that an overflow gives.
    np.testing.assert_allclose(error, flip_map(ref, np.full_like(ref, 1e9)), atol=1e-3)
    assert np.isfinite(flip_map(ref, -ref)).all()
    np.testing.assert_array_equal(flip_map(ref, -ref), flip_map(ref, np.zeros_like(ref)))


def test_flip_rejects_what_is_not_rgb():
    ref, _ = make_pair()
    assert "RGB" in error_of(flip_map, ref[..., :2], ref[..., :2])


def test_flip_of_what_a_display_shows_is_the_librarys():
    shown = np.random.default_rng(5).uniform(0.0, 1.0, (2, 40, 48, 3))
    options = {"inputsRGB": True, "applyMagma": False, "computeMeanError": False}
    expected, _, _ = flip_evaluator.evaluate(*shown.astype(np.float32), "LDR", **options)
    np.testing.assert_array_equal(flip_display(*shown), expected[..., 0])
    assert flip_display(shown[0], shown[0]).max() == 0.0 and flip_display(*shown).mean() > 0.1
    assert "test image is NaN or infinite" in error_of(flip_display, shown[0], shown[1] * np.nan)
    assert "expected RGB" in error_of(flip_display, shown[0][..., :1], shown[1][..., :1])
