"""Error of HDR lightmaps and of pictures: PSNR, SSIM, FLIP and lost light, over masks and per tile.

The protocol of neural-dynamic-gi, section 10.2, is `evaluate_frame` and `summarise`: each lightmap is cut into
non-overlapping tiles (128x128). In each tile the metric is taken over the texels that the mask calls valid, with the
tile's own dynamic range (maximum minus minimum of the valid reference, all channels) as the scale, in linear RGB. The
report is the mean over all tiles of all lightmaps of a scene.

The paper does not define the following cases. A tile with fewer than `MIN_VALID_TEXELS` valid texels or a range of
zero has no score and is counted separately. PSNR is capped at `PSNR_CAP_DB`. FLIP depends on a neighbourhood and on
the display but not on a range, so it is computed over the whole lightmap and its map is averaged in each tile. FLIP
replaces the paper's LPIPS, a network trained on display-referred photographs.

SSIM: Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity". FLIP: Andersson et
al. 2020, "FLIP: A Difference Evaluator for Alternating Images". HDR-FLIP: Andersson et al. 2021, "Visualizing Errors in
Rendered High Dynamic Range Images": the largest LDR-FLIP over a range of exposures, each tone mapped. NVIDIA's
`flip_evaluator` computes it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.errors import WlmError, counted
from wlm.texels import fill_gaps

METRICS = ("psnr", "ssim", "flip")
# Four 4x4 blocks: with fewer, one bad block would determine the tile's score.
MIN_VALID_TEXELS = 64

# An exact reconstruction has infinite PSNR and would dominate every mean. Rounding to half float alone gives
# 70 to 90 dB in a tile that contains black, so no lossy half-float codec comes near 120; a float32 path that
# matches its reference within rounding does, and counts as exact.
PSNR_CAP_DB = 120.0

# Section III-B of the paper on SSIM: a Gaussian window of 11x11 with a standard deviation of 1.5 and population (not
# sample) covariances.
SSIM_WINDOW = 11
_SIGMA = 1.5

# HDR-FLIP chooses the exposures so that the reference's brightest luminance (at the first) and its median (at
# the last) are tone mapped to 0.85. With the ACES curve, flip_evaluator's default, this is the input that
# gives 0.85.
_TONE_MAPPED_TARGET_INPUT = 2.118873
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # linear sRGB, the weights of flip_evaluator
# The brightest texel of a bake is often a firefly; the paper's maximum would then use an exposure for one
# texel.
_BRIGHT_PERCENTILE = 99.0
_MEDIAN_PERCENTILE = 50.0
_EXPOSURES = 2  # for one exposure flip_evaluator returns 0, whatever the images
# Half float's normal numbers span 30 stops; a wider span wastes exposures on values that it can't represent.
_MAX_SPAN = 30.0
# The tone mapper squares its input in float32, so an exposed value must stay under 2**63; values far below
# 2**60 are already white.
_EXPOSED_LIMIT = 60.0

_BRIGHT = 0.5  # share of the group's maximum above which a point counts as one of its brightest
_KEPT = 0.5  # share of a point's own light: a bright point below it is lost, and a larger error makes a dim point lost
BRIGHTER = 10.0
"""Multiple of the median of a group of points above which its brightest point hides the errors of the others."""


def check_pair(
    ref: np.ndarray, test: np.ndarray, mask: np.ndarray | None, where: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Checks a reference and a test image, [H, W, C], and a mask [H, W], None for all texels, and returns them as
    float64, float64 and bool; `where` names the pair in messages ("city 12 h")."""
    ref = np.asarray(ref, np.float64)
    test = np.asarray(test, np.float64)
    if ref.ndim != 3 or ref.shape != test.shape:
        shapes = f"{ref.shape} and {test.shape}"
        raise WlmError(f"{where}: expected two images [H, W, C] of one shape, got {shapes}")
    valid = np.ones(ref.shape[:2], bool) if mask is None else np.asarray(mask).astype(bool)
    if valid.shape != ref.shape[:2]:
        raise WlmError(f"{where}: expected a mask of {ref.shape[:2]}, got {valid.shape}")
    for label, image in (("reference", ref), ("test image", test)):
        bad = valid & ~np.isfinite(image).all(axis=2)
        if bad.any():
            y, x = np.argwhere(bad)[0]
            raise WlmError(
                f"{where}: the {label} is NaN or infinite at {np.count_nonzero(bad)} valid texels, "
                f"first at row {y}, column {x}"
            )
    return ref, test, valid


def psnr_from_mse(error: float, peak: float) -> float:
    """Converts a mean squared error to PSNR in dB, at most 120; NaN if the error is NaN or the peak is not above 0."""
    if math.isnan(error) or not peak > 0.0:
        return math.nan
    if error == 0.0:
        return PSNR_CAP_DB
    # Two logarithms avoid squaring the peak: the square of a peak of 1e-200 would underflow to zero.
    return min(PSNR_CAP_DB, 20.0 * math.log10(peak) - 10.0 * math.log10(error))


def ssim(ref: np.ndarray, test: np.ndarray, mask: np.ndarray, data_range: float) -> float:
    """Returns the mean SSIM, for a signal of the given range, of images [H, W, C] over the texels of a mask [H, W]
    whose window lies inside the image; NaN if there is none or the range is zero.

    Outside the mask both images take the reference's nearest valid value, so that decoded values there do not affect
    windows that cross a chart's edge. With a full mask the result equals scikit-image's mean.
    """
    ref, test, valid = check_pair(ref, test, mask, "ssim")
    filled = fill_gaps(ref, valid)
    return _ssim_filled(filled, np.where(valid[..., None], test, filled), valid, data_range)


def _ssim_filled(ref: np.ndarray, test: np.ndarray, valid: np.ndarray, data_range: float) -> float:
    # Imported here because scikit-image takes longer to import than most commands take to run.
    from skimage.metrics import structural_similarity

    inner = np.zeros_like(valid)
    border = SSIM_WINDOW // 2
    inner[border:-border, border:-border] = valid[border:-border, border:-border]
    if min(valid.shape) < SSIM_WINDOW or not inner.any() or data_range == 0.0:
        return math.nan
    _, similarity = structural_similarity(
        ref,
        test,
        data_range=data_range,
        channel_axis=2,
        gaussian_weights=True,
        sigma=_SIGMA,
        use_sample_covariance=False,
        full=True,
    )
    return float(similarity.mean(axis=2)[inner].mean())


def flip_exposures(ref: np.ndarray, valid: np.ndarray) -> tuple[float, float] | None:
    """Chooses the first and last exposure for HDR-FLIP, `(start, stop)` in stops (log2), from the reference's luminance
    where `valid`; None where no valid texel is above zero.

    HDR-FLIP uses the maximum and the median of all texels; this function uses the 99th percentile and the median of the
    texels above zero, because most of a lightmap is black at night and a median of zero has no exposure.
    """
    _check_rgb(ref)
    luminance = np.maximum(ref[valid], 0.0) @ _LUMINANCE
    lit = luminance[luminance > 0.0]
    if lit.size == 0:
        return None
    bright, median = np.percentile(lit, [_BRIGHT_PERCENTILE, _MEDIAN_PERCENTILE])
    start = math.log2(_TONE_MAPPED_TARGET_INPUT) - math.log2(bright)
    return start, start + min(math.log2(bright) - math.log2(median), _MAX_SPAN)


def flip_display(ref: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Computes LDR-FLIP, float64 [H, W] in [0, 1], between two display images, sRGB in [0, 1], [H, W, 3], at
    flip_evaluator's default of 67 pixels per degree."""
    ref, test, _ = check_pair(ref, test, None, "flip")
    _check_rgb(ref)
    return _ldr_flip(ref, test, srgb=True)


def flip_filled(ref: np.ndarray, test: np.ndarray, span: tuple[float, float] | None) -> np.ndarray:
    """Computes the HDR-FLIP error at every texel, float64 [H, W] in [0, 1], at flip_evaluator's default of 67 pixels
    per degree.

    Both images are linear RGB [H, W, 3]; texels outside the mask hold the nearest valid value in both. Negative values
    count as zero. If no valid texel of the reference is above zero, `flip_exposures` gives no `span`: the error is zero
    if the test is black too, else LDR-FLIP between black and the test clipped to [0, 1].
    """
    import flip_evaluator  # imported here because the import is slow

    _check_rgb(ref)
    test = np.maximum(test, 0.0)
    if span is None:
        if not test.any():
            return np.zeros(ref.shape[:2])
        return _ldr_flip(np.zeros(ref.shape), np.clip(test, 0.0, 1.0), srgb=False)
    start, stop = span
    # Images and exposures are scaled by one power of two: the result is the same, and float32 inputs stay far
    # from overflow and from subnormals for very bright and very dim scenes.
    shift = round(start)
    scale = 2.0**shift
    ceiling = 2.0 ** (_EXPOSED_LIMIT - (stop - shift))
    error, _, _ = flip_evaluator.evaluate(
        np.minimum(np.maximum(ref, 0.0) * scale, ceiling).astype(np.float32),
        np.minimum(test * scale, ceiling).astype(np.float32),
        "HDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"startExposure": start - shift, "stopExposure": stop - shift, "numExposures": _EXPOSURES},
    )
    return error[..., 0].astype(np.float64)


def _ldr_flip(ref: np.ndarray, test: np.ndarray, srgb: bool) -> np.ndarray:
    import flip_evaluator

    images = (image.astype(np.float32) for image in (ref, test))
    error, _, _ = flip_evaluator.evaluate(*images, "LDR", inputsRGB=srgb, applyMagma=False, computeMeanError=False)
    return error[..., 0].astype(np.float64)


def _check_rgb(image: np.ndarray) -> None:
    if image.shape[2] != 3:
        raise WlmError(f"flip: expected RGB images [H, W, 3], got {image.shape}")


def picture_error(reference: np.ndarray, test: np.ndarray, seen: np.ndarray, flip: bool = True) -> tuple[float, float]:
    """Returns the mean squared error and the mean LDR-FLIP, or NaN without `flip`, of the covered pixels of a test
    picture.

    Both pictures are [H, W, 3], sRGB in [0, 1]; `seen`, bool [H, W], is true for covered pixels, at least one; all
    others have the same value in both.
    """
    error = float(np.square(reference - test, dtype=np.float64)[seen].mean())
    if not flip:
        return error, math.nan
    # FLIP also spends time on empty pixels, so they are cropped.
    window = tuple(slice(at.min(), at.max() + 1) for at in np.nonzero(seen))
    return error, float(flip_display(reference[window], test[window])[seen[window]].mean())


class Pictures:
    """Image pairs of one object; every score is a mean over the covered pixels of all pairs.

    Attributes:
        count: Number of pairs with at least one covered pixel.
        mse: Mean squared error over pixels and channels; like all scores below, NaN without a pair.
        flip: Mean LDR-FLIP, in [0, 1].
        ssim: Mean SSIM over the pixels whose window lies inside the image; NaN if it was not requested.
    """

    def __init__(self, structural: bool = False) -> None:
        """Creates an empty collection; `structural` tells whether SSIM is also computed."""
        self._structural = structural
        self.count = 0
        self._squared, self._flip, self._pixels, self._similar, self._windows = 0.0, 0.0, 0, 0.0, 0

    @property
    def mse(self) -> float:
        return self._squared / self._pixels if self._pixels else math.nan

    @property
    def psnr(self) -> float:
        """PSNR in dB for a peak of 1."""
        return psnr_from_mse(self.mse, 1.0)

    @property
    def flip(self) -> float:
        return self._flip / self._pixels if self._pixels else math.nan

    @property
    def ssim(self) -> float:
        return self._similar / self._windows if self._windows else math.nan

    def add(self, reference: np.ndarray, test: np.ndarray, seen: np.ndarray) -> dict[str, float] | None:
        """Adds a pair of pictures [H, W, 3], sRGB in [0, 1], and returns its `psnr` and `flip`; None if no pixel is
        covered. `seen`, bool [H, W], is true for covered pixels; all others have the same value in both pictures."""
        count = int(np.count_nonzero(seen))
        if not count:
            return None
        error, flip = picture_error(reference, test, seen)
        if self._structural:
            similar = ssim(reference, test, seen, 1.0)
            if not math.isnan(similar):
                self._similar, self._windows = self._similar + similar * count, self._windows + count
        self.count += 1
        self._squared, self._flip = self._squared + error * count, self._flip + flip * count
        self._pixels += count
        return {"psnr": psnr_from_mse(error, 1.0), "flip": flip}


class LostLight:
    """Counts the points that lost more than half of their light without a visible effect on PSNR.

    PSNR can stay at 48 dB although the one texel of 16,384 that is ten thousand times brighter than the others, and
    therefore sets the peak, decodes to black, or although that texel is kept and all the others decode to black.

    Attributes:
        count: Number of such points among the brightest of their group.
        worst: The brightest counted point: its value, decoded value and location; None if `count` is 0.
        hidden: Number of points with an error, up or down, of more than half of their own light, in groups where most
            lit points have such an error and the maximum is more than ten times the median.
    """

    def __init__(self) -> None:
        self.count = self.hidden = 0
        self.worst: tuple[float, float, str] | None = None

    def add(self, reference: np.ndarray | torch.Tensor, decoded: np.ndarray | torch.Tensor, where: str = "") -> None:
        """Adds a group of points, such as a tile at one time of day or a whole probe set. `reference` and `decoded` are
        [K, C], on one device; a point's light is the largest magnitude of its channels. `where` is the name of the
        group in the warning."""
        if not len(reference):
            return
        reference, decoded = torch.as_tensor(reference), torch.as_tensor(decoded)
        light, kept = _largest(reference), _largest(decoded)
        if not (largest := light.max()) > 0:
            return
        lost = (light >= _BRIGHT * largest) & (kept < _KEPT * light)
        if count := int(lost.count_nonzero()):
            self.count += count
            worst = int(torch.where(lost, light, 0.0).argmax())
            if self.worst is None or light[worst] > self.worst[0]:
                self.worst = float(light[worst]), float(kept[worst]), where
        if largest > BRIGHTER * light.median():
            lit = light > 0
            off = int(((_largest(decoded - reference) > _KEPT * light) & lit).count_nonzero())
            if 2 * off > int(lit.count_nonzero()):
                self.hidden += off

    @staticmethod
    def groups_to_add(reference: np.ndarray, decoded: np.ndarray) -> np.ndarray:
        """Returns in which of N groups `add` may count points, bool [N]; both are [N, K, 3], at least 0, and 0 where a
        group has no point."""
        error = np.abs(decoded - reference)
        light, kept, off = (
            np.maximum(np.maximum(x[..., 0], x[..., 1]), x[..., 2]) for x in (reference, decoded, error)
        )
        lost = (light >= _BRIGHT * light.max(1, keepdims=True)) & (kept < _KEPT * light)
        lit = light > 0
        return lost.any(1) | (2 * ((off > _KEPT * light) & lit).sum(1) > lit.sum(1))

    def merge(self, other: "LostLight") -> None:
        """Adds the groups of another search, as if they had been added here in their order."""
        self.count += other.count
        self.hidden += other.hidden
        if other.worst is not None and (self.worst is None or other.worst[0] > self.worst[0]):
            self.worst = other.worst

    def warnings(self, name: str, point: str, group: str) -> list[str]:
        """Returns one line for each kind of loss that occurred. `name` is the name of the compressed data. `point` and
        `group` are words for a point and for its group, such as "texel" and "its tile"."""
        lines = []
        if self.worst is not None:
            light, kept, where = self.worst
            lines.append(
                f"{name}: {counted(self.count, point)} among the brightest of {group} lost more than half of the "
                f"light; the largest of {light:.4g} decodes to {kept:.4g}{where and f' ({where})'}"
            )
        if self.hidden:
            lines.append(
                f"{name}: {counted(self.hidden, point)}, most of {group}, are off by more than half of their own "
                "light; PSNR hides it, since others are over ten times as bright"
            )
        return lines


def _largest(values: torch.Tensor) -> torch.Tensor:
    """Returns the largest channel magnitude of each row, [K]; looping over columns is faster than over rows."""
    result = values[:, 0].abs()
    for channel in range(1, values.shape[1]):
        torch.maximum(result, values[:, channel].abs(), out=result)
    return result


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
        valid: Number of valid texels.
        metrics: The requested metrics.
    """

    psnr: np.ndarray
    ssim: np.ndarray
    flip: np.ndarray
    max_abs_error: np.ndarray
    range: np.ndarray
    valid: np.ndarray
    metrics: tuple[str, ...]

    @property
    def scored(self) -> np.ndarray:
        """`[ny, nx]` bool: tiles that count in the means."""
        return (self.valid >= MIN_VALID_TEXELS) & (self.range > 0.0)


@dataclass(frozen=True)
class Summary:
    """Means over the scored tiles of all lightmaps of a scene. A mean over no tile is NaN.

    Attributes:
        psnr, ssim, flip: Mean over every scored tile of every lightmap.
        psnr_by_tile: `[ny, nx]`, mean over the lightmaps.
        psnr_by_time, ssim_by_time, flip_by_time: `[T]`, mean over the tiles of one lightmap.
        worst_tile: The tile with the lowest PSNR, as `lowest` returns it; None if no tile is scored.
        max_abs_error: Largest absolute error of a valid texel, scored or not, in the images' units.
        scored: Number of tiles that count in the means.
        few_texels: Number of tiles excluded for fewer than `MIN_VALID_TEXELS` valid texels, including empty tiles.
        zero_range: Number of tiles excluded because the reference is constant.
    """

    psnr: float
    ssim: float
    flip: float
    psnr_by_tile: np.ndarray
    psnr_by_time: np.ndarray
    ssim_by_time: np.ndarray
    flip_by_time: np.ndarray
    worst_tile: dict[str, float | int] | None
    max_abs_error: float
    scored: int
    few_texels: int
    zero_range: int


def evaluate_frame(
    ref: np.ndarray,
    test: np.ndarray,
    mask: np.ndarray,
    tile: int = 128,
    metrics: Sequence[str] = METRICS,
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
        name: Name of this lightmap in error messages.
        peak: The scale of every tile, above 0, for data with a fixed range that is not light; None uses each tile's
            own range.

    Returns:
        Scores for each tile.
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
        *(np.full(shape, math.nan) for _ in range(5)), valid=np.zeros(shape, np.int64), metrics=tuple(metrics)
    )
    error = None
    if "flip" in metrics and valid.any():
        error = flip_filled(ref, test, flip_exposures(ref, valid))

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
        result.max_abs_error[index] = np.abs(a - b).max()
        if count < MIN_VALID_TEXELS or span == 0.0:
            continue
        if "psnr" in metrics:
            result.psnr[index] = psnr_from_mse(float(np.mean(np.square(a - b))), span)
        if "ssim" in metrics:
            result.ssim[index] = _ssim_filled(ref[area], test[area], inside, span)
        if error is not None:
            result.flip[index] = error[area][inside].mean()
    return result


def summarise(frames: Sequence[FrameMetrics], times: Sequence[float] | np.ndarray | None = None) -> Summary:
    """Averages the scores of a scene's lightmaps over all tiles and lightmaps. `frames` are the scores of each
    lightmap, in order of time. `times` has the time of each lightmap; None: 0, 1, 2 and so on."""
    if not frames:
        raise WlmError("summarise: expected at least one lightmap's metrics")
    first = frames[0]
    if any(f.valid.shape != first.valid.shape or set(f.metrics) != set(first.metrics) for f in frames):
        raise WlmError("summarise: expected lightmaps of one size with scores of the same metrics, found others")

    psnr, ssim, flip, errors = (
        np.stack([getattr(f, field) for f in frames]) for field in ("psnr", "ssim", "flip", "max_abs_error")
    )
    valid = np.stack([f.valid for f in frames])
    scored = np.stack([f.scored for f in frames])
    enough = valid >= MIN_VALID_TEXELS

    return Summary(
        psnr=float(nanmean(psnr)),
        ssim=float(nanmean(ssim)),
        flip=float(nanmean(flip)),
        psnr_by_tile=nanmean(psnr, axis=0),
        psnr_by_time=nanmean(psnr, axis=(1, 2)),
        ssim_by_time=nanmean(ssim, axis=(1, 2)),
        flip_by_time=nanmean(flip, axis=(1, 2)),
        worst_tile=lowest(psnr, range(len(frames)) if times is None else times),
        max_abs_error=math.nan if np.isnan(errors).all() else float(np.nanmax(errors)),
        scored=int(scored.sum()),
        few_texels=int((~enough).sum()),
        zero_range=int((enough & ~scored).sum()),
    )


def lowest(psnr: np.ndarray, times: Sequence[float] | np.ndarray) -> dict[str, float | int] | None:
    """Returns the lowest PSNR of tiles, [T, ny, nx] in dB, NaN for tiles without a score, and its place; None if all
    are NaN. The keys are `psnr`; `time`; `tile`, the number of the tile, row by row; its `row` and `column`."""
    if np.isnan(psnr).all():
        return None
    at = np.unravel_index(np.nanargmin(psnr), psnr.shape)
    index, row, column = (int(i) for i in at)
    place = {"tile": row * psnr.shape[2] + column, "row": row, "column": column}
    return {"psnr": float(psnr[at]), "time": float(times[index])} | place


def nanmean(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    """`np.nanmean` without its warning for an empty mean, which is NaN and expected here."""
    valid = ~np.isnan(values)
    count = valid.sum(axis=axis)
    total = np.where(valid, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), math.nan)
