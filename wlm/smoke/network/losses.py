"""Training losses (neural-six-way-lightmaps, section 4.4, eq. 7, 9 and 10), of encoded planes as `planes` defines them.

- Reconstruction, eq. 7: the mean square error over all planes that the network predicts.
- Temporal, in place of eq. 9: the paper compares the optical flow that a pretrained FlowNet estimates in predictions
  and targets. No such network comes in a package, and the solver knows the motion exactly. So the earlier frame is
  warped by that motion, and what changes beside it is compared with the target's change (shadows don't move as the
  smoke does): L1 over visible smoke that the warp reads inside the image.
"""

import torch
import torch.nn.functional as F
from torch import nn

from wlm.smoke.network.planes import OPACITY_PLANE, PLANES, from_srgb
from wlm.smoke.network.settings import LossSettings

_BITS = 40  # of the largest number in an integer sum; there are 22 more for the sum itself
_VISIBLE = 0.01  # opacity above which change counts


def warp(earlier: torch.Tensor, motion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Warps an earlier frame onto a later one.

    Args:
        earlier: [N, C, H, W].
        motion: [N, 2, H, W], as `Pool.motion`.

    Returns:
        The warped frame, and a mask [N, 1, H, W], 1 where it was read inside the image.
    """
    height, width = earlier.shape[-2:]
    motion = motion.to(earlier.dtype)
    column = torch.arange(width, device=earlier.device, dtype=earlier.dtype) - motion[:, 0]
    row = torch.arange(height, device=earlier.device, dtype=earlier.dtype)[:, None] - motion[:, 1]
    inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    # NaN counts as outside, but is no index.
    axes = ((row, height), (column, width))
    warped = _Bilinear.apply(earlier, *(at.nan_to_num(0.0).clamp(0, size - 1) for at, size in axes))
    return warped, inside[:, None].to(earlier.dtype)


class _Bilinear(torch.autograd.Function):
    """Samples images [N, C, H, W] at rows and columns [N, H', W'] inside the image: [N, C, H', W'].

    Several pixels can read the same one. On a GPU, torch's gradient sums these in any order, so that trainings don't
    repeat to the bit; this one sums integers. There is no gradient with respect to rows and columns.
    """

    @staticmethod
    def forward(ctx, image, row, column):
        height, width = image.shape[-2:]
        top, left = (at.floor().clamp(0, max(size - 2, 0)) for at, size in ((row, height), (column, width)))
        across, down = (column - left)[:, None], (row - top)[:, None]
        first = (top.long() * width + left.long())[:, None]
        # In an image of one row or column, the neighbour beyond it has weight 0.
        below, beside = width if height > 1 else 0, 1 if width > 1 else 0
        corners = [first, first + beside, first + below, first + below + beside]
        weights = [(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across]
        ctx.save_for_backward(*corners, *weights)
        ctx.shape = image.shape
        flat = image.flatten(2)
        parts = (
            flat.gather(2, _spread(corner, flat)).view(*flat.shape[:2], *row.shape[1:]) * weight
            for corner, weight in zip(corners, weights, strict=True)
        )
        return sum(parts)

    @staticmethod
    def backward(ctx, gradient):
        saved = ctx.saved_tensors
        total = torch.zeros(*ctx.shape[:2], ctx.shape[2] * ctx.shape[3], dtype=torch.int64, device=gradient.device)
        # A power of 2: all but the smallest values keep float32's full precision.
        largest = gradient.abs().amax().clamp(min=1e-30).double()
        # NaN where a gradient isn't finite, which an integer sum couldn't express.
        unit = torch.exp2(largest.log2().ceil() - _BITS) + 0.0 * largest
        for corner, weight in zip(saved[:4], saved[4:], strict=True):
            part = ((gradient * weight).double() / unit).round().long()
            total.scatter_add_(2, _spread(corner, total), part.flatten(2))
        return (total.double() * unit).to(gradient.dtype).view(ctx.shape), None, None


def _spread(index: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Expands [N, 1, H, W] to [N, C, H * W]."""
    return index.flatten(2).expand(-1, like.shape[1], -1)


def residual(frames: torch.Tensor, motion: torch.Tensor, opacity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sums the change between two frames that the motion doesn't explain, L1.

    Args:
        frames: [N, 2, P, H, W], the earlier first.
        motion: [N, 2, H, W], as `Pool.motion`.
        opacity: [N, H, W] of the later frame. Only visible smoke counts that was inside the image before.

    Returns:
        The sum of the absolute change, and the number of values summed.
    """
    warped, inside = warp(frames[:, 0], motion.to(frames.dtype))
    mask = inside * (opacity[:, None] > _VISIBLE)
    return ((frames[:, 1] - warped).abs() * mask).sum(), mask.sum() * frames.shape[2]


def temporal(predicted: torch.Tensor, target: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
    """The temporal loss: L1 between a prediction's and its target's change along the motion (in place of eq. 9).

    Warping is linear, so the difference of the two changes is the error's change, and takes one warp.

    Args:
        predicted, target: [N, 2, P, H, W], the first P of `PLANES`, opacity among them.
        motion: [N, 2, H, W], as `Pool.motion`.

    Returns:
        The mean over visible smoke that was inside the image before; 0 where there is none.
    """
    total, count = residual(predicted.float() - target.float(), motion, target[:, 1, OPACITY_PLANE])
    return total / count.clamp(min=1.0)


class Losses(nn.Module):
    """The weighted sum of the losses (eq. 10).

    Args:
        settings: The weights.
        emission: Whether the network predicts emission; otherwise that plane is left out.
    """

    def __init__(self, settings: LossSettings, *, emission: bool = True) -> None:
        super().__init__()
        self.settings = settings
        self.planes = len(PLANES) - (not emission)

    def forward(
        self, predicted: torch.Tensor, target: torch.Tensor, motion: torch.Tensor | None
    ) -> dict[str, torch.Tensor]:
        """Computes `loss`, the weighted sum, and its unweighted parts by name.

        Args:
            predicted, target: [N, K, 8, H, W], encoded; K = 2 frames for the temporal part.
            motion: [N, 2, H, W], for the temporal part.
        """
        predicted, target = predicted[:, :, : self.planes].float(), target[:, :, : self.planes].float()
        parts = {}
        if self.settings.mse > 0:
            pair = (predicted, target) if self.settings.srgb else (_linear(predicted), _linear(target))
            parts["mse"] = F.mse_loss(*pair)
        if self.settings.temporal > 0:
            parts["temporal"] = temporal(predicted, target, motion)
        total = sum((getattr(self.settings, name) * part for name, part in parts.items()), predicted.new_zeros(()))
        return {"loss": total, **parts}


def _linear(planes: torch.Tensor) -> torch.Tensor:
    """Planes [..., P, H, W] with their light decoded to linear."""
    light = from_srgb(planes)
    # Below 0 the curve's linear part goes on: clamped, it would have no gradient there.
    light = torch.where(planes < 0, planes / 12.92, light)
    opacity = torch.arange(planes.shape[-3], device=planes.device)[:, None, None] == OPACITY_PLANE
    return torch.where(opacity, planes, light)
