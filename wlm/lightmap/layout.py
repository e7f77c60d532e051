"""Detects frames that belong to different atlases: in one atlas, charts have the same borders at all times.

A chart's border is visible in a frame because the texels around the chart have no light, or an alpha of 0. Light also
ends inside charts, at a sun shadow for example, so that one frame of an atlas can have borders that another lacks; but
both frames have the borders of the charts that are lit in both. Borders of two different atlases only coincide by
chance. On 20 of our own sets, 0.74 to 0.99 of the border texels of two frames of one atlas coincide beyond chance, and
at most 0.11 for frames of different atlases.
"""

from collections.abc import Callable

import numpy as np

PICTURES = 8
"""Largest number of frames of a set that are compared."""

_LEAST_BORDER = 0.005  # share of the lit texels; a shorter border is no evidence
_MOST_BORDER = 0.6  # share of the lit texels; a longer border is noise
_LEAST_SHARED = 0.2  # share of the texels of the darker frame that must be lit in both
_COINCIDE = 0.2  # share of a border that coincides beyond chance in frames of one atlas


def odd_layout(count: int, lit: Callable[[int], np.ndarray]) -> tuple[int, int] | None:
    """Finds two of `count` frames that belong to different atlases; returns their indices, or None if all may belong to
    one atlas, or if too few texels are dark to tell.

    `lit` returns the texels of a frame that have light or belong to a chart, bool [H, W]; it is called for at most 8
    evenly spaced frames.
    """
    chosen = spread(count, PICTURES)
    pictures = [lit(i) for i in chosen]
    if not pictures:
        return None
    borders = [_border(picture) for picture in pictures]
    most = int(np.argmax([np.count_nonzero(picture) for picture in pictures]))
    for i in range(len(chosen)):
        if i != most and _differ(pictures[i], borders[i], pictures[most], borders[most]):
            first, second = sorted((chosen[i], chosen[most]))
            return first, second
    return None


def spread(count: int, most: int) -> list[int]:
    """Returns at most `most` evenly spaced numbers from 0 to count - 1."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()


def _differ(a: np.ndarray, border_a: np.ndarray, b: np.ndarray, border_b: np.ndarray) -> bool:
    shared = np.count_nonzero(a & b)
    if shared < _LEAST_SHARED * min(np.count_nonzero(a), np.count_nonzero(b)):
        return False
    both = np.count_nonzero(border_a & border_b)
    for one, border_one, other, border_other in ((a, border_a, b, border_b), (b, border_b, a, border_a)):
        if not _LEAST_BORDER <= np.count_nonzero(border_one) / max(np.count_nonzero(one), 1) <= _MOST_BORDER:
            return False
        border = np.count_nonzero(border_one & other)
        chance = np.count_nonzero(border_other & one) / max(shared, 1)
        if both > (chance + _COINCIDE * (1.0 - chance)) * border:
            return False
    return True


def _border(lit: np.ndarray) -> np.ndarray:
    """Returns the lit texels next to dark ones, bool [H, W]; single dark texels are ignored as noise."""
    dark = ~lit
    dark &= _near(dark)
    return _near(dark) & ~dark


def _near(mask: np.ndarray) -> np.ndarray:
    """Returns the texels that have a horizontal or vertical neighbour in a mask, bool [H, W]."""
    near = np.zeros_like(mask)
    near[1:] |= mask[:-1]
    near[:-1] |= mask[1:]
    near[:, 1:] |= mask[:, :-1]
    near[:, :-1] |= mask[:, 1:]
    return near
