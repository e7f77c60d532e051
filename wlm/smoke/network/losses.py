"""Training losses (neural-six-way-lightmaps, section 4.4, eq. 7, 9 and 10), on encoded planes as in `planes`.

- Reconstruction, eq. 7: the mean square error over all planes.
- Temporal, in place of eq. 9: the paper compares the optical flow that a pretrained FlowNet estimates in predictions
  and targets. No package contains such a network, and the solver knows the motion exactly. The earlier frame is
  therefore warped by that motion, and the remaining change is compared with the target's remaining change (shadows do
  not move as the smoke does): L1 over visible smoke that the warp reads inside the image.
"""

import torch
import torch.nn.functional as F

from wlm.smoke.network.planes import OPACITY_PLANE

_BITS = 40  # bits of the largest summand in an integer sum; 22 more bits hold the sum
_VISIBLE = 0.01  # opacity above which a change counts


def warp(earlier: torch.Tensor, motion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Moves the pixels of earlier frames [N, C, H, W] along a `Pool.motion` [N, 2, H, W], so that they are comparable
    with the later frames.

    Returns the moved frames, and a mask [N, 1, H, W]: 1 where the motion starts inside the image, else 0.
    """
    height, width = earlier.shape[-2:]
    motion = motion.to(earlier.dtype)
    column = torch.arange(width, device=earlier.device, dtype=earlier.dtype) - motion[:, 0]
    row = torch.arange(height, device=earlier.device, dtype=earlier.dtype)[:, None] - motion[:, 1]
    inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    # NaN counts as outside, but cannot be an index.
    axes = ((row, height), (column, width))
    warped = _Bilinear.apply(earlier, *(at.nan_to_num(0.0).clamp(0, size - 1) for at, size in axes))
    return warped, inside[:, None].to(earlier.dtype)


class _Bilinear(torch.autograd.Function):
    """Samples images [N, C, H, W] bilinearly at given rows and columns [N, H', W']; returns [N, C, H', W']. Several
    pixels can read the same pixel. On a GPU, torch's gradient adds up in any order, so that a training would not repeat
    to the bit; this gradient adds integers instead. Rows and columns get no gradient."""

    @staticmethod
    def forward(ctx, image, row, column):
        height, width = image.shape[-2:]
        top, left = (at.floor().clamp(0, max(size - 2, 0)) for at, size in ((row, height), (column, width)))
        across, down = (column - left)[:, None], (row - top)[:, None]
        first = (top.long() * width + left.long())[:, None]
        # In an image of one row or column the neighbour has weight 0.
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
        # A power of 2: except for the smallest, values keep float32's full precision.
        largest = gradient.abs().amax().clamp(min=1e-30).double()
        # NaN where a gradient is not finite, which an integer sum cannot express.
        unit = torch.exp2(largest.log2().ceil() - _BITS) + 0.0 * largest
        for corner, weight in zip(saved[:4], saved[4:], strict=True):
            part = ((gradient * weight).double() / unit).round().long()
            total.scatter_add_(2, _spread(corner, total), part.flatten(2))
        return (total.double() * unit).to(gradient.dtype).view(ctx.shape), None, None


def _spread(index: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return index.flatten(2).expand(-1, like.shape[1], -1)


def residual(frames: torch.Tensor, motion: torch.Tensor, opacity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sums the absolute change between N pairs of frames, [N, 2, P, H, W], the earlier first, that a `Pool.motion` [N,
    2, H, W] does not explain; returns the sum and the number of values in it.

    Only smoke that is visible in the later frame by its `opacity`, [N, H, W], and was inside the earlier image is
    counted.
    """
    warped, inside = warp(frames[:, 0], motion.to(frames.dtype))
    mask = inside * (opacity[:, None] > _VISIBLE)
    return ((frames[:, 1] - warped).abs() * mask).sum(), mask.sum() * frames.shape[2]


def temporal(predicted: torch.Tensor, target: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
    """Computes the temporal loss (in place of eq. 9): how differently prediction and target, [N, 2, P, H, W], pairs of
    frames of the first P of `PLANES`, which include the opacity, change along the motion.

    It is the mean absolute difference of the two changes, over visible smoke that was inside the earlier image; 0 if
    there is none. Since warping is linear, this equals the change of the error, prediction minus target, which takes
    only one warp.
    """
    total, count = residual(predicted.float() - target.float(), motion, target[:, 1, OPACITY_PLANE])
    return total / count.clamp(min=1.0)


def losses(
    predicted: torch.Tensor, target: torch.Tensor, motion: torch.Tensor, weight: float
) -> dict[str, torch.Tensor]:
    """Computes the training losses (eq. 10) of K encoded frames of N samples, [N, K, 8, H, W]; the temporal loss needs
    K = 2.

    `motion` is `Pool.motion`, [N, 2, H, W], and `weight` that of the temporal loss, which 0 leaves out. Returns the
    weighted sum `loss`, and its unweighted parts `mse` and, unless the weight is 0, `temporal`.
    """
    predicted, target = predicted.float(), target.float()
    parts = {"mse": F.mse_loss(predicted, target)}
    total = parts["mse"]
    if weight > 0:
        parts["temporal"] = temporal(predicted, target, motion)
        total = total + weight * parts["temporal"]
    return {"loss": total, **parts}
