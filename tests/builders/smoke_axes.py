"""The inverse of the encoding of light in the targets of the network."""

import torch

from wlm_kernels.smoke.planes import FOOT_CODE


def from_srgb(code: torch.Tensor) -> torch.Tensor:
    """Inverts `to_srgb`; values below 0 count as 0."""
    curve = ((code.clamp(min=FOOT_CODE) + 0.055) / 1.055) ** 2.4
    return torch.where(code <= FOOT_CODE, code.clamp(min=0.0) / 12.92, curve)
