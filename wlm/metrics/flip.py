"""HDR-FLIP over a whole frame, with exposures computed from the reference alone.

FLIP: Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images". HDR-FLIP: Andersson et al.
2021, "Visualizing Errors in Rendered High Dynamic Range Images": the largest LDR-FLIP over a range of
exposures, each tone mapped. NVIDIA's `flip_evaluator` does the computation; this module prepares lightmaps for it
and handles masks and extreme values.
"""

import math

import numpy as np

from wlm.errors import WlmError
from wlm.metrics.error import check_pair

# HDR-FLIP chooses the exposures so that the reference's brightest luminance (at the first) and its median (at
# the last) are tone mapped to 0.85. With the ACES curve, flip_evaluator's default, this is the input that
# gives 0.85.
_TONE_MAPPED_TARGET_INPUT = 2.118873
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # linear sRGB, the weights of flip_evaluator
# The brightest texel of a bake is often a firefly; the paper's maximum would then use an exposure for one
# texel.
_BRIGHT_PERCENTILE = 99.0
_MEDIAN_PERCENTILE = 50.0
# flip_evaluator returns 0 for one exposure, whatever the images, so a range of exposures needs at least two.
_MIN_EXPOSURES = 2
# Half float's normal numbers span 30 stops; a wider span wastes exposures on values that it can't represent.
_MAX_SPAN = 30.0
# The tone mapper squares its input in float32, so an exposed value must stay under 2**63; values far below
# 2**60 are already white.
_EXPOSED_LIMIT = 60.0


def flip_exposures(ref: np.ndarray, mask: np.ndarray | None = None) -> tuple[float, float] | None:
    """Chooses the first and last exposure for HDR-FLIP, from percentiles of the valid reference's luminance.

    HDR-FLIP uses the maximum and the median of all texels; this function uses the 99th percentile and the median of
    the texels above zero, because most of a lightmap is black at night and a median of zero has no exposure.

    Args:
        ref: `[H, W, 3]`, linear RGB.
        mask: `[H, W]`, true where a texel counts; None for all.

    Returns:
        `(start, stop)` in stops (log2), start <= stop; None where no valid texel is above zero.

    Raises:
        WlmError: The image is not RGB, the mask does not fit, or a valid texel is NaN or infinite.
    """
    ref, _, valid = check_pair(ref, ref, mask, "flip_exposures")
    _check_rgb(ref)
    luminance = np.maximum(ref[valid], 0.0) @ _LUMINANCE
    lit = luminance[luminance > 0.0]
    if lit.size == 0:
        return None
    bright, median = np.percentile(lit, [_BRIGHT_PERCENTILE, _MEDIAN_PERCENTILE])
    start = math.log2(_TONE_MAPPED_TARGET_INPUT) - math.log2(bright)
    return start, start + min(math.log2(bright) - math.log2(median), _MAX_SPAN)


def flip_display(ref: np.ndarray, test: np.ndarray) -> np.ndarray:
    """LDR-FLIP between two display images, sRGB in [0, 1], [H, W, 3], at flip_evaluator's default of 67 pixels per
    degree.

    Returns:
        `[H, W]` float64 in [0, 1].

    Raises:
        WlmError: Shapes differ, the images are not RGB, or a value is NaN or infinite.
    """
    ref, test, _ = check_pair(ref, test, None, "flip")
    _check_rgb(ref)
    return _ldr_flip(ref, test, srgb=True)


def flip_filled(ref: np.ndarray, test: np.ndarray, span: tuple[float, float] | None, exposures: int = 2) -> np.ndarray:
    """Computes the HDR-FLIP error at every texel, at flip_evaluator's default of 67 pixels per degree.

    Negative values count as zero. If no valid texel of the reference is above zero, no exposure can be chosen: the
    error is zero if the test is black too, else LDR-FLIP between black and the test clipped to [0, 1].

    Args:
        ref: `[H, W, 3]`, linear RGB, finite; texels outside the mask hold the nearest valid value.
        test: `[H, W, 3]`, linear RGB, equal to `ref` outside the mask.
        span: Result of `flip_exposures`.
        exposures: Number of exposures, at least 2; the time grows with it.

    Returns:
        `[H, W]` float64 in [0, 1], 0 where no difference is visible.

    Raises:
        WlmError: The images are not RGB, or there are fewer than two exposures.
    """
    import flip_evaluator  # imported here because the import is slow, like scikit-image's in structural.py

    _check_rgb(ref)
    if exposures < _MIN_EXPOSURES:
        raise WlmError(f"flip: expected at least {_MIN_EXPOSURES} exposures, got {exposures}")
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
        parameters={"startExposure": start - shift, "stopExposure": stop - shift, "numExposures": exposures},
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
