"""The contest's points, computed by hand."""

import math

import numpy as np
import pytest

from wlm.metrics.contest import block_scores, contest_points


@pytest.mark.parametrize(
    ("measures", "points", "total"),
    [
        ((0.0, 55.0, 0.999), (30.0, 20.0, 10.0), 60.0),
        ((0.0, 120.0, 1.0), (30.0, 20.0, 10.0), 60.0),
        ((0.5, 20.0, 0.73), (0.0, 0.0, 0.0), 0.0),
        ((3.0, -5.0, -1.0), (0.0, 0.0, 0.0), 0.0),
        # A tenth of 0.5, (48 - 20) / 35 = 0.8, and 0.8 of 0.269 above 0.73.
        ((0.05, 48.0, 0.9452), (27.0, 16.0, 8.0), 51.0),
    ],
)
def test_points_at_the_marks_and_between(measures, points, total):
    score = contest_points(*measures, 1.0, 24, "cpu")
    assert tuple(score.points.values()) == pytest.approx(points)
    assert score.total == pytest.approx(total) and score.most == 60.0


def test_a_measure_without_a_value_leaves_the_others_theirs():
    score = contest_points(0.25, 55.0, math.nan, 1.0, 24, "cpu")
    assert (score.total, score.most) == (35.0, 50.0) and math.isnan(score.points["ssim"])


def test_blocks_have_peaks_of_their_own():
    ref = np.zeros((300, 20, 3), np.float32)
    ref[:256], ref[256:] = 2.0, 8.0
    ref[5, 5], ref[260, 5] = 1.0, 4.0
    mask = np.ones((300, 20), bool)
    psnr, ssim = block_scores(ref, ref + 0.02, mask)
    # 20 log10(2 / 0.02) and 20 log10(8 / 0.02)
    assert psnr == pytest.approx([40.0, 52.0412], abs=1e-3)
    assert all(0.9 < value < 1.0 for value in ssim)
    assert block_scores(ref, ref, mask) == ([120.0, 120.0], [1.0, 1.0])


def test_the_gaps_count_neither_in_psnr_nor_in_ssim():
    ref = np.random.default_rng(0).uniform(1.0, 2.0, (64, 64, 3)).astype(np.float32)
    mask = np.ones((64, 64), bool)
    mask[:20] = False
    test = np.where(mask[..., None], ref, 1e4)
    assert block_scores(ref, test, mask) == ([120.0], [1.0])


def test_blocks_without_light_have_no_score_and_small_ones_no_ssim():
    dark = np.zeros((256, 512, 3), np.float32)
    mask = np.ones((256, 512), bool)
    assert block_scores(dark, dark + 1.0, mask) == ([], [])
    dark[:, 256:] = 1.0
    mask[:, 256:] = False
    assert block_scores(dark, dark, mask) == ([], [])
    (psnr,), (ssim,) = block_scores(dark[:5, 256:], dark[:5, 256:], np.ones((5, 256), bool))
    assert psnr == 120.0 and math.isnan(ssim)
