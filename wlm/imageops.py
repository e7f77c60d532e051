"""Operations on masked images that the metrics, the baselines and the systems share."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from wlm.errors import WlmError

__all__ = ["fill_gaps"]


def fill_gaps(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Give every texel outside the mask the value of the nearest texel inside it (Euclidean distance).

    A lightmap's gaps between charts are never seen but share codec blocks and filter windows with texels that
    are; zeros there cost a block codec 10 dB and more at chart edges.

    Args:
        image: `[..., H, W, C]`, any dtype; leading axes (time) are filled with one distance transform.
        mask: `[H, W]`, true (non-zero) where a texel is valid.

    Returns:
        A new array of the image's shape and dtype. Valid texels are copied unchanged. With an empty mask
        nothing is known about the image and the result is all zeros.

    Raises:
        WlmError: The mask's shape is not the image's height and width.
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
    rows, columns = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return image[..., rows, columns, :]
