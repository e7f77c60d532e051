"""The network that turns a guiding map into six-way lightmaps (section 4.3): a U-Net and adapters, four or one.

The U-Net is Ronneberger's (2015): two 3 x 3 convolutions a level, maxima on the way down. What its last level finds is
shared by the adapters, each a NAFBlock (Chen et al. 2022) for two opposite planes, or goes through one for all. A
NAFBlock has no activation but the product of one half of its channels with the other; its channel attention multiplies
by a linear map of the channels' means over the whole image.

Two things are known without learning and are built in:

- opacity differs little from the guide's, and light from the guide's light, but for the noise of its jitter: the
  outputs are a learned filter of the guide's planes, which begins as what least squares found of a pixel's own, plus
  what the U-Net finds, which begins as 0;
- where no smoke is near, all planes are 0: outputs are multiplied by a mask of where the guide, whose large steps can
  miss a wisp in one pixel and find it in the next, saw some within 8 to 16 pixels.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from pydantic import BaseModel, ConfigDict, Field
from torch import nn

from wlm.smoke.planes import GUIDES, PLANES

__all__ = [
    "ADAPTERS",
    "EPSILON",
    "REACH",
    "NafBlock",
    "NetworkSettings",
    "SixWayNetwork",
    "parameter_count",
    "support",
]

ADAPTERS = (("front", "back"), ("right", "left"), ("top", "bottom"), ("opacity", "emission"))
"""The planes that each adapter makes."""

REACH = 8
"""Pixels within which smoke in the guide lets lightmaps differ from 0, at least."""

_FILTER = 5  # pixels along the edge of what the filter of the guide sees

# What a plane begins as that the guide lacks: shares of its light, opacity and depth. Least squares over plumes of
# optical depths of 1 to 30 and the paper's guide, rounded, and alike for opposite sides.
_START = {
    "right": (0.45, 0.0, 0.1),
    "left": (0.45, 0.0, 0.1),
    "top": (0.65, -0.1, 0.0),
    "bottom": (0.65, -0.1, 0.0),
    "front": (0.4, 0.2, 0.25),
    "back": (1.05, -0.7, -0.15),
    "emission": (0.0, 0.0, 0.0),
}
EPSILON = 1e-6


class NetworkSettings(BaseModel):
    """The shape of a network.

    Attributes:
        width: Channels at the first level; each level has twice those of the one before, at half the resolution.
        levels: Of the U-Net, the bottom too.
        adapters: Whether each of the four groups of planes has a NAFBlock of its own; otherwise all share one.
        emission: Whether the last plane is made; otherwise it is 0.
        guide: What it reads, one of `samples.GUIDES`.
        depth: Whether the guide's depth, its last plane, is read.
        stem: Pixels along the edge of the squares that the first convolution takes as one: 1 is the paper's, 2 runs the
            whole network at half the resolution, a quarter of the work.
        residual: Whether a filter of the guide's planes is added to the outputs.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: int = Field(16, ge=8, le=64, multiple_of=8)
    levels: int = Field(5, ge=2, le=6)
    adapters: bool = True
    emission: bool = True
    guide: Literal["paper", "front", "sides", "six"] = "paper"
    depth: bool = True
    stem: Literal[1, 2] = 1
    residual: bool = True

    @property
    def channels(self) -> int:
        """Planes of the guide that are read."""
        return len(GUIDES[self.guide]) - (not self.depth)

    @property
    def multiple(self) -> int:
        """Pixels of which an image's height and width are made multiples by zeros at its end."""
        return self.stem * 2 ** (self.levels - 1)


class ChannelNorm(nn.Module):
    """Layer norm over the channels of a pixel, [N, C, H, W].

    torch's own wants the channels together in memory, and gives a GPU a block of threads a pixel, for 16 numbers.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels, 1, 1))
        self.bias = nn.Parameter(torch.zeros(channels, 1, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if torch.is_grad_enabled():
            return _Norm.apply(x, self.weight, self.bias)
        return torch.addcmul(self.bias.to(x.dtype), _normalised(x)[0], self.weight.to(x.dtype))


def _normalised(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    variance, mean = torch.var_mean(x, 1, keepdim=True, correction=0)
    inverse = (variance + EPSILON).rsqrt()
    return (x - mean) * inverse, inverse


class _Norm(torch.autograd.Function):
    """With its gradient by hand: autograd's goes through the variance, and keeps twice as much."""

    @staticmethod
    def forward(ctx, x, weight, bias):
        y, inverse = _normalised(x)
        ctx.save_for_backward(y, inverse, weight)
        return torch.addcmul(bias.to(x.dtype), y, weight.to(x.dtype))

    @staticmethod
    def backward(ctx, gradient):
        y, inverse, weight = ctx.saved_tensors
        along = gradient * y
        inner = gradient * weight.to(y.dtype)
        of_x = (inner - y * (inner * y).mean(1, keepdim=True) - inner.mean(1, keepdim=True)) * inverse
        of_weight = along.sum((0, 2, 3), dtype=torch.float32)[:, None, None]
        return of_x, of_weight, gradient.sum((0, 2, 3), dtype=torch.float32)[:, None, None]


class NafBlock(nn.Module):
    """Mixes neighbours and channels, each as a correction to what came in; at first, both corrections are 0.

    7 c^2 + 33 c parameters for c channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm1 = ChannelNorm(channels)
        self.expand = nn.Conv2d(channels, 2 * channels, 1)
        self.depthwise = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1, groups=2 * channels)
        self.attend = nn.Linear(channels, channels)
        self.project = nn.Conv2d(channels, channels, 1)
        self.beta = nn.Parameter(torch.zeros(channels, 1, 1))
        self.norm2 = ChannelNorm(channels)
        self.widen = nn.Conv2d(channels, 2 * channels, 1)
        self.narrow = nn.Conv2d(channels, channels, 1)
        self.gamma = nn.Parameter(torch.zeros(channels, 1, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.depthwise(self.expand(self.norm1(x)))
        left, right = y.chunk(2, 1)
        y = left * right
        # Summed in float32: over a whole image, half floats would overflow.
        mean = y.mean((2, 3), dtype=torch.float32)
        y = y * self.attend(mean.to(self.attend.weight.dtype))[:, :, None, None].to(y.dtype)
        x = x + self.beta * self.project(y)
        left, right = self.widen(self.norm2(x)).chunk(2, 1)
        return x + self.gamma * self.narrow(left * right)


def support(opacity: torch.Tensor) -> torch.Tensor:
    """Where smoke may be: within ``REACH`` pixels of where the guide has some; at most twice as far.

    Args:
        opacity: [N, 1, H, W] of the guide.

    Returns:
        As the opacity, 0 or 1.
    """
    height, width = opacity.shape[-2:]
    coarse = F.max_pool2d(opacity, REACH, ceil_mode=True)
    near = (F.max_pool2d(coarse, 3, stride=1, padding=1) > 0).to(opacity.dtype)
    return near.repeat_interleave(REACH, 2)[:, :, :height].repeat_interleave(REACH, 3)[:, :, :, :width]


class SixWayNetwork(nn.Module):
    """Guiding maps to lightmaps, both as planes of `samples`, at any resolution.

    The outputs aren't clamped, so that there is a gradient everywhere; `decode_lightmaps` clamps them.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        widths = [settings.width * 2**level for level in range(settings.levels)]
        first, area = widths[0], settings.stem**2
        inputs = [settings.channels * area, *widths[:-1]]
        self.encoder = nn.ModuleList(_twice(before, c) for before, c in zip(inputs, widths, strict=True))
        # With pixels repeated, in place of up-convolutions of 2 x 2 pixels: a quarter of their weights.
        self.up = nn.ModuleList(nn.Conv2d(2 * c, c, 1) for c in widths[:-1])
        self.decoder = nn.ModuleList(_twice(2 * c, c) for c in widths[:-1])
        self.groups = _groups(settings)
        self.adapters = nn.ModuleList(NafBlock(first) for _ in self.groups)
        self.heads = nn.ModuleList(nn.Conv2d(first, len(group) * area, 3, padding=1) for group in self.groups)
        if settings.residual:
            shares = torch.tensor([_start(name, GUIDES[settings.guide]) for group in self.groups for name in group])
            self.filter = nn.Conv2d(settings.channels, len(shares), _FILTER, padding=_FILTER // 2, bias=False)
            with torch.no_grad():
                self.filter.weight.zero_()
                self.filter.weight[:, :, _FILTER // 2, _FILTER // 2] = shares[:, : settings.channels]
            for head in self.heads:
                nn.init.zeros_(head.weight)
                nn.init.zeros_(head.bias)

    def features(self, guide: torch.Tensor) -> torch.Tensor:
        """What the U-Net finds, [N, C, H / stem, W / stem], of a guide whose sides are multiples."""
        x = guide[:, : self.settings.channels]
        if self.settings.stem > 1:
            x = F.pixel_unshuffle(x, self.settings.stem)
        x = x.contiguous(memory_format=torch.channels_last)
        skips = []
        for level, convolutions in enumerate(self.encoder):
            x = convolutions(F.max_pool2d(x, 2) if level else x)
            skips.append(x)
        for level in reversed(range(len(self.up))):
            above = F.interpolate(self.up[level](x), scale_factor=2.0, mode="nearest")
            x = self.decoder[level](torch.cat([above, skips[level]], 1))
        return x

    def forward(self, guide: torch.Tensor) -> torch.Tensor:
        """Makes the planes.

        Args:
            guide: [N, C, H, W], encoded, of the settings' kind.

        Returns:
            [N, 8, H, W] in the order of `samples.PLANES`, of the guide's type.
        """
        height, width = guide.shape[-2:]
        multiple = self.settings.multiple
        padded = F.pad(guide, (0, -width % multiple, 0, -height % multiple))
        x = self.features(padded)
        made = torch.cat([head(adapter(x)) for adapter, head in zip(self.adapters, self.heads, strict=True)], 1)
        if self.settings.stem > 1:
            made = F.pixel_shuffle(made, self.settings.stem)
        if self.settings.residual:
            made = made + self.filter(padded[:, : self.settings.channels])
        made = made[:, :, :height, :width] * support(guide[:, -2:-1])
        return self.order(made.to(guide.dtype))

    def order(self, made: torch.Tensor) -> torch.Tensor:
        """The adapters' planes in the order of `samples.PLANES`, with zeros for one that isn't made."""
        names = [name for group in self.groups for name in group]
        planes = dict(zip(names, made.unbind(1), strict=True))
        nothing = torch.zeros_like(made[:, 0])
        return torch.stack([planes.get(name, nothing) for name in PLANES], 1)


def parameter_count(network: nn.Module) -> int:
    """Numbers that are learned."""
    return sum(parameter.numel() for parameter in network.parameters())


def _start(name: str, planes: tuple[str, ...]) -> tuple[float, ...]:
    """Of a guide's planes those that an output begins as."""
    return tuple(float(plane == name) for plane in planes) if name in planes else _START[name]


def _twice(before: int, after: int) -> nn.Sequential:
    """Two convolutions, which keep the size of what goes through them."""
    layers = []
    for inputs in (before, after):
        convolution = nn.Conv2d(inputs, after, 3, padding=1)
        nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        nn.init.zeros_(convolution.bias)
        layers += [convolution, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


def _groups(settings: NetworkSettings) -> tuple[tuple[str, ...], ...]:
    kept = [tuple(name for name in group if settings.emission or name != "emission") for group in ADAPTERS]
    return tuple(kept) if settings.adapters else (tuple(name for group in kept for name in group),)
