"""Pictures of one atlas are distinguished from pictures of several atlases, whatever the light is."""

import numpy as np
import pytest

from wlm.lightmap.data import from_arrays
from wlm.lightmap.layout import odd_layout


def charts(seed: int, gap: int = 2) -> np.ndarray:
    """An atlas of rectangles with gaps between them: the chart of each texel of 256 x 256, -1 in gaps."""
    random, atlas, top, number = np.random.default_rng(seed), np.full((256, 256), -1), 0, 0
    while top < 256:
        height, left = int(random.integers(12, 50)), 0
        while left < 256:
            width = int(random.integers(12, 60))
            atlas[top : top + height, left : left + width] = number
            number, left = number + 1, left + width + gap
        top += height + gap
    return atlas


def picture(atlas: np.ndarray, seed: int, dark: float = 0.0, shadow: bool = False) -> np.ndarray:
    """Light on it; a share of the charts has none, and half of each has none where a shadow ends in it."""
    random = np.random.default_rng(seed)
    light = np.where(random.random(atlas.max() + 1) < dark, 0.0, random.random(atlas.max() + 1) + 0.1)[atlas]
    if shadow:
        rows, columns = np.mgrid[:256, :256]
        light = light * (np.sin(random.random() * 0.3 * rows + random.random() * 0.3 * columns + seed) > 0)
    return np.repeat((light * (atlas >= 0))[..., None], 3, 2).astype(np.float32)


@pytest.mark.parametrize("options", [{}, {"dark": 0.3}, {"shadow": True}, {"dark": 0.3, "shadow": True}])
def test_one_atlas_at_any_time_is_one(options):
    atlas = charts(0)
    assert from_arrays([picture(atlas, seed, **options) for seed in range(12)], range(12)).warnings == ()


@pytest.mark.parametrize("options", [{}, {"dark": 0.2}, {"shadow": True}])
def test_another_atlas_among_them_is_told(options):
    frames = [picture(charts(0), seed, **options) for seed in range(4)]
    frames[2] = picture(charts(1), 2, **options)
    (warning,) = from_arrays(frames, range(4), name="day").warnings
    assert all(words in warning for words in ("day: frame ", "frame 2 (time 2)", "don't look like one atlas"))


def test_little_to_tell_by_is_no_reason():
    random, atlas, full = np.random.default_rng(0), charts(0), np.ones((256, 256), bool)
    noise = [random.random((256, 256)) > 0.4 for _ in range(2)]
    halves = [(atlas >= 0) & (np.arange(256)[:, None] // 128 == side) for side in range(2)]
    for pictures in (noise, halves, [full, atlas >= 0], [~full, atlas >= 0], [full], []):
        assert odd_layout(len(pictures), pictures.__getitem__) is None
