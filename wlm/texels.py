"""Operations on images of linear light, shared by the metrics, the systems and the benchmarks."""

import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.ndimage import distance_transform_edt

from wlm.errors import WlmError, counted
from wlm.formats.exr import HALF_MAX

REACH = 2
"""Distance from a chart, in texels, that filters read: 1 for a bilinear read, 2 for one of the half-size mip."""

OFFSETS = sorted(
    ((y, x) for y in range(-REACH, REACH + 1) for x in range(-REACH, REACH + 1) if (y, x) != (0, 0)),
    key=lambda at: (at[0] ** 2 + at[1] ** 2, at),
)
"""Offsets to a texel's neighbours within `REACH`, in search order: the nearest first, then by row."""

_STRIP = 1024  # rows of a lightmap searched for nearest texels at once

_WHITE, _PERCENTILE = 0.8, 99.0  # display value of that percentile of the light
_FILMIC_WHITE = 4.0

# Share of values at 1, median and brightest radiance, and mean distance from 8-bit levels that suggest other data than
# radiance; the numbers of a lightmap that are compared, and the fewest texels for the test of levels.
_AT_ONE, _BRIGHT, _DARK, _LEVELS, _NEAR_LEVEL = 0.02, 1000.0, 1e-4, 255.0, 0.08
_SAMPLES, _MANY = 3072, 500


def exposure(light: np.ndarray) -> float:
    """Returns the factor that scales nearly all values of linear light, of any shape, below white; 1 if all are 0."""
    lit = light[light > 0]
    return _WHITE / float(np.percentile(lit, _PERCENTILE)) if lit.size else 1.0


def filmic(light: np.ndarray) -> np.ndarray:
    """Tone maps linear light, at least 0, of any shape, by Reinhard's curve with a white point of 4 (Reinhard et al.
    2002, eq. 4)."""
    return light * (1 + light / _FILMIC_WHITE**2) / (1 + light)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Converts linear light to sRGB (IEC 61966-2-1), clipped to [0, 1]."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def fill_gaps(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Gives every texel of images [..., H, W, C] outside a mask [H, W] the value of the nearest texel inside it
    (Euclidean distance); returns a new array, zero everywhere if the mask is empty.

    The gaps between a lightmap's charts are never visible but share codec blocks and filter windows with visible
    texels; zeros there cost a block codec 10 dB and more at chart edges. Leading axes (time) are filled with one
    distance transform.
    """
    image = np.asarray(image)
    valid = np.asarray(mask).astype(bool)
    if image.ndim < 3 or valid.shape != image.shape[-3:-1]:
        shapes = f"{image.shape} and {valid.shape}"
        raise WlmError(f"fill_gaps: expected image [..., H, W, C] and mask [H, W], got {shapes}")
    if not valid.any():
        return np.zeros_like(image)
    if valid.all():
        return image.copy()
    rows, columns = (each[~valid] for each in nearest_valid(valid))
    filled = image.copy()
    filled[..., ~valid, :] = image[..., rows, columns, :]
    return filled


def near_gaps(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the invalid texels within `REACH` texels of a valid one, and the valid texel that is nearest to each.

    `mask` is bool [H, W], true where a texel is valid. Of several equally near texels the first in reading order is
    taken, so that all decoders (Python, shader, web page) take the same one. Returns row and column of each such texel,
    int [G, 2], in reading order, and those of its nearest valid texel.
    """
    height, width = mask.shape
    found = np.zeros(mask.shape, np.int8)  # 1 + the index in `OFFSETS`
    if not mask.all():
        padded = np.pad(mask, REACH)
        for i, (y, x) in enumerate(OFFSETS):
            valid = padded[REACH + y : REACH + y + height, REACH + x : REACH + x + width]
            found[valid & ~mask & (found == 0)] = i + 1
    target = np.argwhere(found)
    offsets = np.array(OFFSETS)[found[found > 0].astype(int) - 1]
    return target, target + offsets.reshape(-1, 2)


def nearest_valid(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the texel that is nearest (Euclidean distance) to each texel of a lightmap among those of a mask [H, W],
    which has one: row and column, int32 [H, W] each, so that `image[rows, columns]` has its gaps filled.

    Up to a distance of `REACH` texels the result equals that of `near_gaps`; at larger distances any of several equally
    near texels is chosen.
    """
    rows, columns = _nearest_in_strips(mask) or _nearest(mask)
    target, source = near_gaps(mask)
    rows[tuple(target.T)], columns[tuple(target.T)] = source.T
    return rows, columns


def _nearest(mask: np.ndarray) -> np.ndarray:
    return distance_transform_edt(~mask, return_distances=False, return_indices=True)


def _nearest_in_strips(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Finds nearest valid texels by threads, on overlapping strips of rows; None if strips may overlap too little."""
    height, width = mask.shape
    rows, columns = (np.empty(mask.shape, np.int32) for _ in range(2))

    def strip(first: int) -> bool:
        end = min(first + _STRIP, height)
        low, high = max(first - _STRIP // 8, 0), min(end + _STRIP // 8, height)
        if not mask[low:high].any():
            return False
        found = _nearest(mask[low:high])[:, first - low : end - low]
        rows[first:end], columns[first:end] = found[0] + low, found[1]
        row, column = np.nonzero(~mask[first:end])
        row += first
        distance = (rows[row, column] - row) ** 2 + (columns[row, column] - column) ** 2
        far = height + width  # no texel lies beyond the lightmap's border
        beyond = np.minimum(row - low + 1 if low > 0 else far, high - row if high < height else far)
        return bool((distance <= beyond**2).all())

    starts = range(0, height, _STRIP)
    with ThreadPoolExecutor(min(len(starts), os.cpu_count() or 1)) as threads:
        done = list(threads.map(strip, starts))
    return (rows, columns) if all(done) else None


def doubts(light: np.ndarray) -> list[str]:
    """Compares the range of a lightmap [H, W, 3] with what radiance usually is, on some of its texels. Returns one line
    for each reason why the values may be something else: another unit, an exposure, or screen colours."""
    step = max(1, round((light.size / _SAMPLES) ** 0.5))
    used = light[::step, ::step].reshape(-1, 3)
    red, green, blue = used.T
    largest = np.maximum(np.maximum(red, green), blue)  # NaN where one of the three is
    with np.errstate(invalid="ignore"):
        chosen = (largest > 0) & (largest < np.inf)
    largest = largest[chosen]
    if not len(largest):
        return []
    found, brightest = [], float(largest.max())
    if 2 * np.count_nonzero(largest > _BRIGHT) >= len(largest):
        found.append(f"half of the texels exceed {_BRIGHT:,.0f}: are they in lux, or scaled for an encoding?")
    if brightest < _DARK:
        found.append(f"no texel exceeds {_DARK:g}, where half floats lose precision: were they scaled by an exposure?")
    if brightest <= 1.0:
        lit = used[chosen]
        if brightest == 1.0 and np.count_nonzero(lit == 1.0) > _AT_ONE * lit.size:
            found.append("values are clamped at 1: are they screen colours instead of radiance?")
        codes = lit * _LEVELS
        if len(lit) >= _MANY and float(np.abs(codes - np.rint(codes)).mean()) < _NEAR_LEVEL:
            found.append("values have 256 levels: were they converted from an 8-bit picture?")
    if found and used[chosen].min() == brightest:
        return []  # one value everywhere tells nothing
    return found


def repair(frame: np.ndarray, mask: np.ndarray, where: str) -> list[str]:
    """Replaces non-finite values of a lightmap [H, W, 3], in place, and clamps it to [0, 65504], half float's range;
    returns one line with the count for each kind of change to the valid texels of the mask."""
    notes, good = [], mask
    with np.errstate(invalid="ignore"):
        least, greatest = float(frame.min()), float(frame.max())  # NaN if there is one
    all_finite = math.isfinite(least) and math.isfinite(greatest)
    if not all_finite:
        finite = np.isfinite(frame).all(axis=2)
        good = mask & finite
    if not good.any():
        raise WlmError(f"{where}: expected a finite texel inside the mask, found only NaN and infinity")
    if not all_finite:
        broken = np.count_nonzero(mask & ~finite)
        if broken:
            notes.append(f"{counted(broken, 'texel')} NaN or infinite: replaced by the nearest finite one in the mask")
            frame[mask & ~finite] = fill_gaps(frame, good)[mask & ~finite]
        frame[~mask & ~finite] = 0.0
        least, greatest = float(frame.min()), float(frame.max())
    if least < 0:
        negative = np.count_nonzero((frame < 0).any(axis=2) & good)
        if negative:
            notes.append(f"{counted(negative, 'texel')} negative: clamped to 0")
    if greatest > HALF_MAX:
        bright = np.count_nonzero((frame > HALF_MAX).any(axis=2) & good)
        if bright:
            notes.append(f"{counted(bright, 'texel')} above {HALF_MAX:,.0f}: clamped to it")
    np.clip(frame, 0.0, HALF_MAX, out=frame)
    return notes
