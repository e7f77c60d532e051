"""Pointwise error over the valid texels of linear HDR images, accumulated in float64."""

import math

import numpy as np

from wlm.errors import WlmError

# An exact reconstruction has infinite PSNR and would dominate every mean. Rounding to half float alone gives
# 70 to 90 dB in a tile that contains black, so no lossy half-float codec comes near 120; a float32 path that
# matches its reference within rounding does, and counts as exact.
PSNR_CAP_DB = 120.0


def check_pair(
    ref: np.ndarray, test: np.ndarray, mask: np.ndarray | None, where: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Checks a reference, a test image and a mask, and returns them as float64, float64 and bool.

    Args:
        ref: `[H, W, C]`, linear.
        test: `[H, W, C]`, linear.
        mask: `[H, W]`, or None for all texels.
        where: Name of this pair in error messages ("city 12 h").

    Raises:
        WlmError: Shapes differ, or a valid texel of either image is NaN or infinite; the message names the
            image, the first such texel and their number. Texels outside the mask may hold anything.
    """
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


def mse(ref: np.ndarray, test: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Returns the mean squared error over valid texels and channels of linear images [H, W, C]; NaN if none is valid.

    `mask`, [H, W], is true where a texel counts; None counts all.

    Raises:
        WlmError: Shapes differ, or a valid texel is NaN or infinite.
    """
    ref, test, valid = check_pair(ref, test, mask, "mse")
    if not valid.any():
        return math.nan
    return float(np.mean(np.square(ref[valid] - test[valid])))


def dynamic_range(ref: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Returns the maximum minus the minimum of a linear image [H, W, C] over the valid texels (neural-dynamic-gi,
    section 10.2); see `mse`.

    Raises:
        WlmError: The mask does not fit, or a valid texel is NaN or infinite.
    """
    ref, _, valid = check_pair(ref, ref, mask, "dynamic_range")
    return float(np.ptp(ref[valid])) if valid.any() else math.nan


def psnr(ref: np.ndarray, test: np.ndarray, mask: np.ndarray | None = None, peak: float | None = None) -> float:
    """Peak signal-to-noise ratio `10 log10(peak² / mse)` in decibels over the valid texels and all channels; see `mse`.

    `peak` is in the images' units; None takes the reference's `dynamic_range`. The result is at most `PSNR_CAP_DB`, the
    score of an exact reconstruction; it is NaN with an empty mask or a peak of zero, which define no scale.

    Raises:
        WlmError: Shapes differ, a valid texel is NaN or infinite, or the peak is negative or not finite.
    """
    error = mse(ref, test, mask)
    peak = dynamic_range(ref, mask) if peak is None else float(peak)
    if math.isnan(error):
        return math.nan
    if not (math.isfinite(peak) and peak >= 0.0):
        raise WlmError(f"psnr: expected a finite peak of at least 0, got {peak}")
    return psnr_from_mse(error, peak)


def psnr_from_mse(error: float, peak: float) -> float:
    """Converts a mean squared error to PSNR, with `psnr`'s cap; NaN if the error is NaN or the peak is not positive."""
    if math.isnan(error) or not peak > 0.0:
        return math.nan
    if error == 0.0:
        return PSNR_CAP_DB
    # Two logarithms avoid squaring the peak: the square of a peak of 1e-200 would underflow to zero.
    return min(PSNR_CAP_DB, 20.0 * math.log10(peak) - 10.0 * math.log10(error))


def half_ulp(value: float) -> float:
    """Returns the step between neighbouring half floats at `value`: the resolution of a stored lightmap.

    Args:
        value: Any finite number; magnitudes above 65,504 return the step of the largest half float.

    Returns:
        The step in the units of `value`, at least 2**-24.
    """
    magnitude = np.float16(min(abs(float(value)), float(np.finfo(np.float16).max)))
    if magnitude == np.finfo(np.float16).max:
        return 32.0  # the next larger value, to which np.spacing measures, is infinity
    return float(np.spacing(magnitude))
