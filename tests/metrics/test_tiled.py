"""The paper's protocol on frames small enough to check by hand."""

import math

import numpy as np
import pytest

from wlm.metrics import PSNR_CAP_DB, evaluate_frame, flip_exposures, flip_filled, ssim, summarise
from wlm.texels import fill_gaps


def make_pair(height, width, seed=0):
    rng = np.random.default_rng(seed)
    ref = (rng.random((height, width, 3)) ** 2 * 4.0).astype(np.float32)
    return ref, (ref + 0.02 * rng.standard_normal(ref.shape)).astype(np.float32)


def assert_same(a, b, rtol=0.0):
    for field in ("psnr", "ssim", "flip"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=rtol, atol=1e-6 * (rtol > 0))


def test_each_tile_by_hand_at_a_size_that_128_does_not_divide():
    ref, test = make_pair(130, 70)
    mask = np.ones((130, 70), bool)
    mask[:100, :30] = False
    frame = evaluate_frame(ref, test, mask, metrics=("psnr", "ssim"))
    assert frame.psnr.shape == (2, 1)
    for row, area in enumerate((slice(0, 128), slice(128, 130))):
        a = ref[area].astype(np.float64)[mask[area]]
        b = test[area].astype(np.float64)[mask[area]]
        peak = a.max() - a.min()
        expected = 10.0 * math.log10(peak**2 / np.mean((a - b) ** 2))
        assert frame.psnr[row, 0] == pytest.approx(expected, rel=1e-12)
        assert frame.range[row, 0] == peak
        assert frame.valid[row, 0] == mask[area].sum()
        assert frame.max_abs_error[row, 0] == np.abs(a - b).max()
    assert math.isnan(frame.ssim[1, 0])  # two rows hold no window
    assert np.isnan(frame.flip).all()  # not asked for
    summary = summarise([frame])
    assert summary.scored == 2
    assert summary.psnr == pytest.approx(frame.psnr.mean(), rel=1e-12)
    assert summary.ssim == frame.ssim[0, 0]


def test_tile_ssim_uses_the_tiles_range():
    ref, test = make_pair(64, 32)
    ref[32:] *= 100.0  # the other tile's range must not matter
    mask = np.ones((64, 32), bool)
    frame = evaluate_frame(ref, test, mask, tile=32, metrics=("ssim",))
    assert frame.ssim[0, 0] == pytest.approx(ssim(ref[:32], test[:32], mask[:32], np.ptp(ref[:32])), abs=1e-12)


def test_flip_is_of_the_whole_frame_averaged_over_valid_texels():
    ref, test = make_pair(40, 64)
    mask = np.ones((40, 64), bool)
    mask[5:20, 10:50] = False
    frame = evaluate_frame(ref, test, mask, tile=32, metrics=("flip",))
    filled = fill_gaps(ref.astype(np.float64), mask)
    error = flip_filled(filled, np.where(mask[..., None], test, filled), flip_exposures(filled, mask))
    assert frame.flip[0, 1] == pytest.approx(error[:32, 32:][mask[:32, 32:]].mean(), rel=1e-12)
    assert frame.flip[0, 1] > 0.01


def test_garbage_outside_the_mask_changes_nothing():
    ref, test = make_pair(64, 64)
    mask = np.ones((64, 64), bool)
    mask[10:40, 20:44] = False
    before = evaluate_frame(ref, test, mask, tile=32)
    assert np.isfinite(before.flip).all() and np.isfinite(before.ssim).all()
    ref[~mask] = 60000.0
    test[~mask] = np.nan
    assert_same(before, evaluate_frame(ref, test, mask, tile=32))


@pytest.mark.parametrize("scale", [2.0**-10, 4000.0])
def test_scores_do_not_change_with_brightness(scale):
    ref, test = (image.astype(np.float64) for image in make_pair(64, 64))
    mask = np.ones((64, 64), bool)
    tiled = evaluate_frame(ref, test, mask, tile=32)
    assert_same(tiled, evaluate_frame(ref * scale, test * scale, mask, tile=32), rtol=1e-4)


def test_what_is_left_out_is_counted_and_its_error_shown():
    ref, test = make_pair(64, 96)
    mask = np.ones((64, 96), bool)
    mask[:32, :32] = False  # empty
    mask[:32, 32:64] = False
    mask[0, 32:95] = True  # 63 valid texels, one across the border
    ref[32:, :32] = 2.0  # constant
    test[32:, :32] = 2.75
    frame = evaluate_frame(ref, test, mask, tile=32, metrics=("psnr",))
    summary = summarise([frame])
    assert frame.valid[0, 0] == 0 and frame.valid[0, 1] == 32
    assert (summary.scored, summary.few_texels, summary.zero_range) == (3, 2, 1)
    assert np.isnan(frame.psnr[0, :2]).all() and math.isnan(frame.psnr[1, 0])
    assert np.isfinite(frame.psnr[0, 2]) and np.isfinite(frame.psnr[1, 1:]).all()


@pytest.mark.parametrize("count", [0, 1, 63, 64])
def test_the_least_number_of_valid_texels(count):
    ref, test = make_pair(16, 16)
    mask = np.zeros((16, 16), bool)
    mask.flat[:count] = True
    frame = evaluate_frame(ref, test, mask)
    summary = summarise([frame])
    assert summary.scored == (count >= 64)
    assert summary.few_texels == (count < 64)
    assert math.isnan(summary.psnr) == (count < 64)
    assert math.isnan(summary.max_abs_error) == (count == 0)
    assert (summary.worst_tile is None) == (count < 64)


def test_black_frames():
    black = np.zeros((32, 32, 3))
    mask = np.ones((32, 32), bool)
    summary = summarise([evaluate_frame(black, black, mask), evaluate_frame(black, black + 3.0, mask)])
    assert (summary.scored, summary.zero_range) == (0, 2)
    assert math.isnan(summary.psnr) and math.isnan(summary.flip)


def test_exact_reconstruction_keeps_means_finite():
    ref, test = make_pair(32, 32)
    mask = np.ones((32, 32), bool)
    exact = evaluate_frame(ref, ref, mask)
    assert exact.psnr[0, 0] == PSNR_CAP_DB
    assert exact.ssim[0, 0] == pytest.approx(1.0, abs=1e-12)
    assert exact.flip[0, 0] == 0.0
    noisy = evaluate_frame(ref, test, mask)
    assert summarise([exact, noisy]).psnr == pytest.approx((PSNR_CAP_DB + noisy.psnr[0, 0]) / 2.0)


def test_values_near_the_top_of_half_float():
    rng = np.random.default_rng(2)
    ref = (60000.0 * rng.random((32, 32, 3))).astype(np.float16)
    test = (ref.astype(np.float64) * 0.99).astype(np.float16)
    frame = evaluate_frame(ref, test, np.ones((32, 32), bool))
    a, b = ref.astype(np.float64), test.astype(np.float64)
    expected = 10.0 * math.log10(np.ptp(a) ** 2 / np.mean((a - b) ** 2))
    assert frame.psnr[0, 0] == pytest.approx(expected)
    assert 0.0 < frame.flip[0, 0] < 0.2


def test_means_by_tile_and_time_and_the_worst():
    mask = np.ones((32, 64), bool)
    frames = []
    for seed, noise in enumerate((0.01, 0.1)):
        ref, _ = make_pair(32, 64, seed)
        test = ref.astype(np.float64)
        test[:, :32] += noise
        test[:, 32:] += 2.0 * noise
        frames.append(evaluate_frame(ref, test, mask, tile=32, metrics=("psnr",)))
    summary = summarise(frames)
    grid = np.stack([frame.psnr for frame in frames])
    np.testing.assert_allclose(summary.psnr_by_tile, grid.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(summary.psnr_by_time, grid.mean(axis=(1, 2)), rtol=1e-14)
    place = {"psnr": grid[1, 0, 1], "tile": 1, "row": 0, "column": 1}
    assert summary.worst_tile == {"time": 1} | place and summarise(frames, [6, 18]).worst_tile == {"time": 18} | place
    assert summary.max_abs_error == pytest.approx(0.2)


def test_the_mean_is_over_all_tiles_of_all_lightmaps():
    """Two scored tiles in one lightmap and one in the next weigh as three, not as two lightmaps."""
    ref, test = make_pair(32, 64)
    both, left = np.ones((32, 64), bool), np.ones((32, 64), bool)
    left[:, 32:] = False
    frames = [evaluate_frame(ref, test, mask, tile=32, metrics=("psnr",)) for mask in (both, left)]
    a, b = frames[0].psnr[0]
    assert summarise(frames).psnr == pytest.approx((a + b + a) / 3.0, rel=1e-12)
    assert summarise(frames).psnr_by_tile[0, 1] == b
