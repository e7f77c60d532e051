"""The protocol of neural-dynamic-gi, section 10.2: scores for each tile, averaged over tiles and lightmaps.

Each lightmap is cut into non-overlapping tiles (128x128). In each tile the metric is taken over the texels
that the mask calls valid, with the tile's own dynamic range (maximum minus minimum of the valid reference, all
channels) as the scale, in linear RGB. The report is the mean over all tiles of all lightmaps of a scene.

The paper does not define the following cases. A tile with fewer than `MIN_VALID_TEXELS` valid texels or a range of
zero has no score and is counted separately. PSNR is capped at `PSNR_CAP_DB`. A tile whose range is a few half-float
steps is part of the mean, and the mean without such tiles is reported too. FLIP depends on a neighbourhood and on the
display but not on a range, so it is computed over the whole lightmap and its map is averaged in each tile. FLIP
replaces the paper's LPIPS, a network trained on display-referred photographs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.metrics.error import check_pair, half_ulp, psnr_from_mse
from wlm.metrics.flip import flip_exposures, flip_filled
from wlm.metrics.structural import ssim_filled
from wlm.texels import fill_gaps

METRICS = ("psnr", "ssim", "flip")
# Four 4x4 blocks: with fewer, one bad block would determine the tile's score.
MIN_VALID_TEXELS = 64
# In a tile whose range is at most this number of half-float steps at its brightest value, rounding to half float
# limits the score of every codec (to about 29 dB at 8 steps).
FORMAT_LIMITED_ULPS = 8


@dataclass(frozen=True)
class FrameMetrics:
    """Scores of one lightmap, one entry per tile; every array is `[ny, nx]`, tile rows from the top.

    Attributes:
        psnr: Decibels; NaN where the tile is not scored or the metric was not requested.
        ssim: In [-1, 1]; NaN in the same cases and where the tile is smaller than the window.
        flip: Mean FLIP error in [0, 1]; NaN in the same cases as `psnr`.
        max_abs_error: Largest absolute error in the images' units, for every tile with a valid texel, scored
            or not; NaN without one.
        range: Dynamic range in the images' units, or the peak that was given; NaN without a valid texel.
        half_step: Step between half floats at the tile's largest magnitude, in the images' units; NaN without a
            valid texel.
        valid: Number of valid texels.
        metrics: The requested metrics.
    """

    psnr: np.ndarray
    ssim: np.ndarray
    flip: np.ndarray
    max_abs_error: np.ndarray
    range: np.ndarray
    half_step: np.ndarray
    valid: np.ndarray
    metrics: tuple[str, ...]

    @property
    def scored(self) -> np.ndarray:
        """`[ny, nx]` bool: tiles that count in the means."""
        return (self.valid >= MIN_VALID_TEXELS) & (self.range > 0.0)

    @property
    def format_limited(self) -> np.ndarray:
        """`[ny, nx]` bool: scored tiles whose range is at most `FORMAT_LIMITED_ULPS` half-float steps."""
        return self.scored & (self.range <= FORMAT_LIMITED_ULPS * self.half_step)


@dataclass(frozen=True)
class Summary:
    """Means over the scored tiles of all lightmaps of a scene. A mean over no tile is NaN.

    Attributes:
        psnr, ssim, flip: Mean over every scored tile of every lightmap.
        psnr_unlimited: Mean PSNR over the scored tiles except the tiles in `format_limited`.
        psnr_by_tile, ssim_by_tile, flip_by_tile: `[ny, nx]`, mean over the lightmaps.
        psnr_by_time, ssim_by_time, flip_by_time: `[T]`, mean over the tiles of one lightmap.
        worst_psnr: Lowest PSNR of a tile.
        worst_tile: `(lightmap, tile row, tile column)` of that tile; None if no tile is scored.
        max_abs_error: Largest absolute error of a valid texel, scored or not, in the images' units.
        tiles: Number of tiles in all lightmaps.
        scored: Number of tiles that count in the means.
        few_texels: Number of tiles excluded for fewer than `MIN_VALID_TEXELS` valid texels, including empty tiles.
        zero_range: Number of tiles excluded because the reference is constant.
        format_limited: `(lightmap, tile row, tile column)` of each scored tile that spans only a few
            half-float steps.
    """

    psnr: float
    ssim: float
    flip: float
    psnr_unlimited: float
    psnr_by_tile: np.ndarray
    ssim_by_tile: np.ndarray
    flip_by_tile: np.ndarray
    psnr_by_time: np.ndarray
    ssim_by_time: np.ndarray
    flip_by_time: np.ndarray
    worst_psnr: float
    worst_tile: tuple[int, int, int] | None
    max_abs_error: float
    tiles: int
    scored: int
    few_texels: int
    zero_range: int
    format_limited: list[tuple[int, int, int]]


def evaluate_frame(
    ref: np.ndarray,
    test: np.ndarray,
    mask: np.ndarray,
    tile: int = 128,
    metrics: Sequence[str] = METRICS,
    flip_exposure_count: int = 2,
    name: str = "lightmap",
    peak: float | None = None,
) -> FrameMetrics:
    """Scores one lightmap tile by tile (neural-dynamic-gi, section 10.2, with this module's additions).

    Args:
        ref: `[H, W, 3]`, linear RGB, any float dtype. Texels outside the mask are ignored.
        test: `[H, W, 3]`, linear RGB.
        mask: `[H, W]`, true where a texel is valid.
        tile: Side of a tile in texels; tiles at the right and the bottom edge are smaller if it does not
            divide the lightmap's size.
        metrics: Any of `METRICS`. FLIP takes most of the time.
        flip_exposure_count: Exposures for HDR-FLIP, at least 2.
        name: Name of this lightmap in error messages.
        peak: The scale of every tile, above 0, for data with a fixed range that is not light; None uses each tile's
            own range.

    Returns:
        Scores for each tile.

    Raises:
        WlmError: Shapes differ, a valid texel of either image is NaN or infinite, or an argument is out of
            range.
    """
    unknown = [metric for metric in metrics if metric not in METRICS]
    if unknown:
        raise WlmError(f"{name}: unknown metric {unknown[0]!r}, expected some of {', '.join(METRICS)}")
    if tile < 1:
        raise WlmError(f"{name}: expected a tile of at least 1 texel, got {tile}")
    ref, test, valid = check_pair(ref, test, mask, name)
    if "ssim" in metrics or "flip" in metrics:
        ref = fill_gaps(ref, valid)
    test = np.where(valid[..., None], test, ref)

    height, width = valid.shape
    shape = (-(-height // tile), -(-width // tile))
    result = FrameMetrics(
        *(np.full(shape, math.nan) for _ in range(6)),
        valid=np.zeros(shape, np.int64),
        metrics=tuple(metrics),
    )
    error = None
    if "flip" in metrics and valid.any():
        error = flip_filled(ref, test, flip_exposures(ref, valid), flip_exposure_count)

    for index in np.ndindex(shape):
        area = tuple(slice(i * tile, (i + 1) * tile) for i in index)
        inside = valid[area]
        count = np.count_nonzero(inside)
        result.valid[index] = count
        if count == 0:
            continue
        a, b = ref[area][inside], test[area][inside]
        span = float(np.ptp(a)) if peak is None else peak
        result.range[index] = span
        result.half_step[index] = half_ulp(np.abs(a).max())
        result.max_abs_error[index] = np.abs(a - b).max()
        if count < MIN_VALID_TEXELS or span == 0.0:
            continue
        if "psnr" in metrics:
            result.psnr[index] = psnr_from_mse(float(np.mean(np.square(a - b))), span)
        if "ssim" in metrics:
            result.ssim[index] = ssim_filled(ref[area], test[area], inside, span)
        if error is not None:
            result.flip[index] = error[area][inside].mean()
    return result


def summarise(frames: Sequence[FrameMetrics]) -> Summary:
    """Averages the scores of a scene's lightmaps, in order of time, over all tiles and lightmaps.

    Raises:
        WlmError: No frames, or frames of different grids or metrics.
    """
    if not frames:
        raise WlmError("summarise: expected at least one lightmap's metrics")
    first = frames[0]
    if any(f.valid.shape != first.valid.shape or set(f.metrics) != set(first.metrics) for f in frames):
        raise WlmError("summarise: lightmaps differ in size or metrics; summarise each kind on its own")

    psnr, ssim, flip, errors = (
        np.stack([getattr(f, field) for f in frames]) for field in ("psnr", "ssim", "flip", "max_abs_error")
    )
    valid = np.stack([f.valid for f in frames])
    scored = np.stack([f.scored for f in frames])
    limited = np.stack([f.format_limited for f in frames])
    enough = valid >= MIN_VALID_TEXELS

    worst_tile = None
    if not np.isnan(psnr).all():
        worst_tile = tuple(int(i) for i in np.unravel_index(np.nanargmin(psnr), psnr.shape))
    return Summary(
        psnr=float(nanmean(psnr)),
        ssim=float(nanmean(ssim)),
        flip=float(nanmean(flip)),
        psnr_unlimited=float(nanmean(np.where(limited, math.nan, psnr))),
        psnr_by_tile=nanmean(psnr, axis=0),
        ssim_by_tile=nanmean(ssim, axis=0),
        flip_by_tile=nanmean(flip, axis=0),
        psnr_by_time=nanmean(psnr, axis=(1, 2)),
        ssim_by_time=nanmean(ssim, axis=(1, 2)),
        flip_by_time=nanmean(flip, axis=(1, 2)),
        worst_psnr=math.nan if worst_tile is None else float(psnr[worst_tile]),
        worst_tile=worst_tile,
        max_abs_error=_nanmax(errors),
        tiles=scored.size,
        scored=int(scored.sum()),
        few_texels=int((~enough).sum()),
        zero_range=int((enough & ~scored).sum()),
        format_limited=[tuple(int(i) for i in where) for where in np.argwhere(limited)],
    )


def nanmean(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    """`np.nanmean` without its warning for an empty mean, which is NaN and expected here."""
    valid = ~np.isnan(values)
    count = valid.sum(axis=axis)
    total = np.where(valid, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), math.nan)


def _nanmax(values: np.ndarray) -> float:
    valid = values[~np.isnan(values)]
    return float(valid.max()) if valid.size else math.nan
