"""PSNR and its relatives by hand, SSIM and FLIP as their libraries have them, and light that is lost at a high PSNR."""

import math

import flip_evaluator
import numpy as np
import pytest
from builders.checks import error_of
from scipy.ndimage import distance_transform_edt
from skimage.metrics import structural_similarity

from wlm import texels
from wlm.metrics import (
    PSNR_CAP_DB,
    LostLight,
    evaluate_frame,
    flip_display,
    flip_exposures,
    flip_filled,
    psnr_from_mse,
    ssim,
)
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


def lines(reference, decoded, where="") -> list[str]:
    lost = LostLight()
    lost.add(np.asarray(reference, np.float32), np.asarray(decoded, np.float32), where)
    return lost.warnings("set", "texel", "its tile")


def wall(count: int = 16384) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 1.0, (count, 3))


def test_a_firefly_that_vanishes_behind_a_good_mean():
    reference = wall()
    reference[77] = 0.7, 6961.0, 0.7
    decoded = np.minimum(reference, 0.7)
    assert psnr_from_mse(np.square(reference - decoded).mean(), 6961.0) > 46.0
    assert lines(reference, decoded, "tile 3 at 5") == [
        "set: 1 texel among the brightest of its tile lost more than half of the light; the largest of 6961 decodes to "
        "0.7 (tile 3 at 5)"
    ]


def test_the_others_that_vanish_beside_a_firefly():
    reference = wall()
    reference[77] = 1e4
    decoded = np.where(reference > 1.0, reference, 3.0)
    assert psnr_from_mse(np.square(reference - decoded).mean(), 1e4) > 60.0
    (line,) = lines(reference, decoded)
    assert "16383 texels, most of its tile, are off by more than half" in line


def test_nothing_is_said_of_light_that_is_kept():
    reference = wall()
    noisy = reference * np.random.default_rng(1).uniform(0.6, 1.4, reference.shape)
    reference[77] = noisy[77] = 1e4
    for decoded in (reference, noisy):
        assert lines(reference, decoded) == []
    # Of the dark texels beside it a third may be off.
    third = np.arange(len(reference)) % 3 == 0
    third[77] = False
    assert lines(reference, np.where(third[:, None], 0.0, reference)) == []
    assert lines(np.zeros((9, 3)), np.ones((9, 3))) == lines(np.zeros((0, 3)), np.zeros((0, 3))) == []


def test_losses_of_several_groups_are_added():
    lost, other = LostLight(), LostLight()
    for own, light in ((lost, 3.0), (other, 8.0), (other, 5.0)):
        own.add(np.array([[light], [light]]), np.array([[0.0], [light]]), f"at {light:g}")
    lost.merge(other)
    assert (lost.count, lost.worst, lost.hidden) == (3, (8.0, 0.0, "at 8"), 0)


def test_negative_numbers_count_by_their_size():
    assert len(lines([[-4.0, 1.0]], [[-1.0, 1.0]])) == 1


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
    options = {"channel_axis": 2, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = structural_similarity(ref, test, data_range=float(np.ptp(ref)), **options)
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
