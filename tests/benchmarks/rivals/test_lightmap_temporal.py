"""Temporal PCA and the video codec on small sets with known answers."""

import numpy as np
import pytest
from builders.checks import psnr
from builders.lightmaps import smooth_light

from benchmarks.rivals.lightmap import RIVALS
from benchmarks.rivals.lightmap_pca import encode_pca_bc4
from benchmarks.rivals.lightmap_video import fill_smoothly

# One of each kind; the rest differ in a number.
KINDS = ("pca-bc4-4", "av1-85")


def day(height=72, width=140, hours=5, seed=0) -> np.ndarray:
    """Lights of three kinds, each with a rhythm of its own, and a little noise; over one tile's edge."""
    light = smooth_light(height, width)
    lights = np.stack([light, light[::-1], light[:, ::-1] ** 2])
    share = 1.0 + np.sin(np.arange(hours)[:, None] * [1.0, 2.0, 0.7])
    noise = np.random.default_rng(seed).normal(1.0, 0.01, (hours, height, width, 3))
    return (np.einsum("tk,khwc->thwc", share, lights) * noise).astype(np.float32)


@pytest.mark.parametrize("name", KINDS)
def test_a_day_comes_back(name):
    frames = day()
    rival = RIVALS[name].encode(frames, np.ones((72, 140), bool))
    assert rival.name == name and rival.decoded.dtype == np.float32
    assert psnr(frames, rival.decoded) > 36.0
    assert 0 < rival.disk_bytes <= rival.bytes < frames.nbytes / 4
    assert rival.encode_seconds > 0.0 and rival.decode_seconds > 0.0


def test_one_light_in_three_strengths_is_one_component():
    light = smooth_light(64, 64)
    frames = np.stack([light, 0.5 * light, 0.1 * light])
    blocks = encode_pca_bc4(frames, np.ones((64, 64), bool), components=1)
    # Half a byte a texel; then mean and axis of 9 halves, two floats a map, and 12 bytes of ranges.
    assert blocks.bytes == 64 * 64 // 2 + 18 + 18 + 8 + 12
    assert psnr(frames, blocks.decoded) > 42.0


def test_gaps_are_filled_smoothly():
    image, mask = smooth_light(37, 50), np.ones((37, 50), bool)
    mask[5:30, 5:45] = False
    filled = fill_smoothly(np.where(mask[..., None], image, np.float32(np.nan)), mask)
    np.testing.assert_array_equal(filled[mask], image[mask])
    # Means of what is round them.
    gap = filled[~mask]
    assert image[mask].min() <= gap.min() and gap.max() <= image[mask].max() + 1e-5
    assert np.abs(np.diff(filled[17, 5:45], axis=0)).mean() < 0.1
    assert not fill_smoothly(image, np.zeros((37, 50), bool)).any()
