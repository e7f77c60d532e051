"""SSIM over valid texels, with the range of the reference as the scale."""

import math

import numpy as np

from wlm.errors import WlmError
from wlm.metrics.error import check_pair
from wlm.texels import fill_gaps

# Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity", section III-B:
# a Gaussian window of 11x11 with a standard deviation of 1.5 and population (not sample) covariances.
SSIM_WINDOW = 11
_SIGMA = 1.5


def ssim_map(ref: np.ndarray, test: np.ndarray, data_range: float) -> np.ndarray:
    """Computes the structural similarity (SSIM) at every texel, averaged over the channels.

    Args:
        ref: `[H, W, C]`, linear, finite, at least `SSIM_WINDOW` high and wide.
        test: `[H, W, C]`, linear, finite.
        data_range: The signal's range in the images' units, above 0.

    Returns:
        `[H, W]` float64 in [-1, 1]. The outermost `SSIM_WINDOW // 2` texels use mirrored data; `ssim` excludes
        them.

    Raises:
        WlmError: The image is smaller than the window, or the range is not positive.
    """
    # Imported here because scikit-image takes longer to import than most commands take to run.
    from skimage.metrics import structural_similarity

    if min(ref.shape[:2]) < SSIM_WINDOW:
        raise WlmError(f"ssim: expected an image of at least {SSIM_WINDOW}x{SSIM_WINDOW}, got {ref.shape}")
    if not data_range > 0.0:
        raise WlmError(f"ssim: expected a range above 0, got {data_range}")
    _, similarity = structural_similarity(
        np.asarray(ref, np.float64),
        np.asarray(test, np.float64),
        data_range=data_range,
        channel_axis=2,
        gaussian_weights=True,
        sigma=_SIGMA,
        use_sample_covariance=False,
        full=True,
    )
    return similarity.mean(axis=2)


def ssim(ref: np.ndarray, test: np.ndarray, mask: np.ndarray | None = None, data_range: float | None = None) -> float:
    """Returns the mean SSIM over the valid texels whose window lies inside the image (Wang et al. 2004).

    Outside the mask both images take the reference's nearest valid value, so that decoded values there do not
    affect windows that cross a chart's edge. With a full mask the result equals scikit-image's mean.

    Args:
        ref: `[H, W, C]`, linear.
        test: `[H, W, C]`, linear.
        mask: `[H, W]`, true where a texel counts; None for all.
        data_range: The signal's range in the images' units; None takes the valid reference's maximum minus
            its minimum.

    Returns:
        The mean; NaN where the image is smaller than the window, no valid texel has its window inside, or the
        range is zero.

    Raises:
        WlmError: Shapes differ, or a valid texel is NaN or infinite.
    """
    ref, test, valid = check_pair(ref, test, mask, "ssim")
    if not valid.any():
        return math.nan
    filled = fill_gaps(ref, valid)
    return ssim_filled(filled, np.where(valid[..., None], test, filled), valid, data_range)


def ssim_filled(ref: np.ndarray, test: np.ndarray, valid: np.ndarray, data_range: float | None) -> float:
    """Computes `ssim` of float64 images that are already checked, and equal outside the mask."""
    inner = np.zeros_like(valid)
    border = SSIM_WINDOW // 2
    inner[border:-border, border:-border] = valid[border:-border, border:-border]
    if min(valid.shape) < SSIM_WINDOW or not inner.any():
        return math.nan
    scale = float(np.ptp(ref[valid])) if data_range is None else data_range
    if scale == 0.0:
        return math.nan
    return float(ssim_map(ref, test, scale)[inner].mean())
