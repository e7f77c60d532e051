"""Check of the directions of six-way lightmaps, and the inverse of the encoding of their light."""

import numpy as np
import torch

from wlm.smoke.camera import DIRECTIONS
from wlm_kernels.smoke.planes import FOOT_CODE

_LEAST_SHIFT = 1e-3  # share of the image between the centres of brightness of opposite maps


def axis_faults(lightmaps: np.ndarray) -> tuple[str, ...]:
    """Checks that each of the lightmaps [..., 6, H, W] is bright on the side of its name, and returns the faults."""
    lightmaps = np.asarray(lightmaps, np.float64)
    height, width = lightmaps.shape[-2:]
    sums = lightmaps.reshape(-1, 6, height, width).sum(0)
    total = sums.sum((1, 2))
    if not (np.isfinite(total) & (total > 0)).all():
        dark = [name for name, value in zip(DIRECTIONS, total, strict=True) if not value > 0]
        return (f"no light in {', '.join(dark) or 'some lightmap'}",)
    x = (sums.sum(1) @ (np.arange(width) + 0.5)) / total / width
    y = 1.0 - (sums.sum(2) @ (np.arange(height) + 0.5)) / total / height
    faults = []
    if not x[0] > x[1] + _LEAST_SHIFT:
        faults.append(f"right isn't brighter on the right than left: centres at {x[0]:.3f} and {x[1]:.3f} of the width")
    if not y[2] > y[3] + _LEAST_SHIFT:
        faults.append(f"top isn't brighter above than bottom: centres at {y[2]:.3f} and {y[3]:.3f} of the height")
    if not total[4] > total[5]:
        faults.append(f"front isn't brighter than back: {total[4]:.4g} and {total[5]:.4g} in all")
    return tuple(faults)


def from_srgb(code: torch.Tensor) -> torch.Tensor:
    """Inverts `to_srgb`; values below 0 count as 0."""
    curve = ((code.clamp(min=FOOT_CODE) + 0.055) / 1.055) ** 2.4
    return torch.where(code <= FOOT_CODE, code.clamp(min=0.0) / 12.92, curve)
