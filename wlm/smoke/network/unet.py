"""The network that turns a guiding map into six-way lightmaps (neural-six-way-lightmaps, section 4.3).

A U-Net (Ronneberger et al. 2015; two 3 x 3 convolutions per level, max pooling) computes features. Adapters turn these
into planes: each is a NAFBlock (Chen et al. 2022), either one for each pair of planes or one for all planes. The only
nonlinearity of a NAFBlock is the product of the two halves of its channels; its channel attention multiplies them by a
linear map of the channels' means over the whole image.

Two properties are built in rather than learned:

- Opacity and light differ little from those of the guide, except for the noise of its jitter. The output is therefore a
  learned filter of the guide's planes, initialised by a least squares fit, plus the U-Net's output, initialised to 0.
- Far from smoke all planes are 0. Outputs are multiplied by a mask, which is 1 within 8 to 16 pixels of smoke in the
  guide: the guide's large steps can miss a wisp in one pixel and hit it in the next.
"""

import torch
import torch.nn.functional as F
from torch import nn

from wlm.smoke.network.planes import GUIDES, PLANES
from wlm.smoke.network.settings import NetworkSettings

ADAPTERS = (("front", "back"), ("right", "left"), ("top", "bottom"), ("opacity", "emission"))
"""Planes of each adapter, the NAFBlock that computes them."""

REACH = 8
"""Smallest distance in pixels from smoke in the guide within which lightmaps may differ from 0."""

EPSILON = 1e-6
"""Added to the variance in a channel norm."""

_FILTER = 5  # edge of the guide's filter, pixels

# Initial weights of the guide's light, opacity and depth for planes that the guide lacks: least squares over plumes of
# optical depths 1 to 30 with the paper's guide, rounded, and equal for opposite sides.
_START = {
    "right": (0.45, 0.0, 0.1),
    "left": (0.45, 0.0, 0.1),
    "top": (0.65, -0.1, 0.0),
    "bottom": (0.65, -0.1, 0.0),
    "front": (0.4, 0.2, 0.25),
    "back": (1.05, -0.7, -0.15),
    "emission": (0.0, 0.0, 0.0),
}


class ChannelNorm(nn.Module):
    """Layer norm over the channels of each pixel, [N, C, H, W]; torch's norm needs channels contiguous in memory."""

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
    """Channel norm with a hand-written backward pass, which stores half as much as that of autograd."""

    @staticmethod
    def forward(ctx, x, weight, bias):
        y, inverse = _normalised(x)
        ctx.save_for_backward(y, inverse, weight)
        return torch.addcmul(bias.to(x.dtype), y, weight.to(x.dtype))

    @staticmethod
    def backward(ctx, gradient):
        y, inverse, weight = ctx.saved_tensors
        inner = gradient * weight.to(y.dtype)
        grad_x = (inner - y * (inner * y).mean(1, keepdim=True) - inner.mean(1, keepdim=True)) * inverse
        grad_weight, grad_bias = (
            part.sum((0, 2, 3), dtype=torch.float32)[:, None, None] for part in (gradient * y, gradient)
        )
        return grad_x, grad_weight, grad_bias


class NafBlock(nn.Module):
    """Network layers that add two corrections to their input: one mixes neighbouring pixels, one mixes channels. Before
    training both corrections are 0. The block has 7 c^2 + 33 c parameters for c channels."""

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
        # In float32: half floats would overflow in the sum over a whole image.
        mean = y.mean((2, 3), dtype=torch.float32)
        y = y * self.attend(mean.to(self.attend.weight.dtype))[:, :, None, None].to(y.dtype)
        x = x + self.beta * self.project(y)
        left, right = self.widen(self.norm2(x)).chunk(2, 1)
        return x + self.gamma * self.narrow(left * right)


def support(opacity: torch.Tensor) -> torch.Tensor:
    """Returns the mask [N, 1, H, W] of pixels whose planes may differ from 0, in the type of the guiding map's
    `opacity`: 1 within 8 to 16 pixels of its smoke, else 0."""
    height, width = opacity.shape[-2:]
    coarse = F.max_pool2d(opacity, REACH, ceil_mode=True)
    near = (F.max_pool2d(coarse, 3, stride=1, padding=1) > 0).to(opacity.dtype)
    return near.repeat_interleave(REACH, 2)[:, :, :height].repeat_interleave(REACH, 3)[:, :, :, :width]


class SixWayNetwork(nn.Module):
    """Maps encoded guiding maps to encoded lightmaps, at any resolution: the planes `names`, of which each adapter
    computes one of `groups`.

    Outputs are not clamped to their ranges, so that there is a gradient everywhere; `decode_lightmaps` clamps them.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        widths = [settings.width * 2**level for level in range(settings.levels)]
        first, area = widths[0], settings.stem**2
        inputs = [settings.channels * area, *widths[:-1]]
        self.encoder = nn.ModuleList(_twice(before, c) for before, c in zip(inputs, widths, strict=True))
        # They follow a repetition of pixels; transposed 2 x 2 convolutions would have four times the weights.
        self.up = nn.ModuleList(nn.Conv2d(2 * c, c, 1) for c in widths[:-1])
        self.decoder = nn.ModuleList(_twice(2 * c, c) for c in widths[:-1])
        self.groups = list(ADAPTERS) if settings.adapters else [sum(ADAPTERS, ())]
        self.names = [name for group in self.groups for name in group]
        self.adapters = nn.ModuleList(NafBlock(first) for _ in self.groups)
        self.heads = nn.ModuleList(nn.Conv2d(first, len(group) * area, 3, padding=1) for group in self.groups)
        # A plane that the guide has starts as the guide's, another plane as a mix of the guide's.
        guide = GUIDES[settings.guide]
        mixes = [[float(p == name) for p in guide] if name in guide else _START[name] for name in self.names]
        self.filter = nn.Conv2d(settings.channels, len(mixes), _FILTER, padding=_FILTER // 2, bias=False)
        with torch.no_grad():
            self.filter.weight.zero_()
            self.filter.weight[:, :, _FILTER // 2, _FILTER // 2] = torch.tensor(mixes)
        for head in self.heads:
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def features(self, guide: torch.Tensor) -> torch.Tensor:
        """Returns the U-Net's features, [N, C, H / stem, W / stem]; H and W must be multiples of `multiple`."""
        x = F.pixel_unshuffle(guide, self.settings.stem) if self.settings.stem > 1 else guide
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
        """Predicts encoded lightmaps, opacity and emission, [N, 8, H, W] in the order of `PLANES`, from encoded guiding
        maps [N, C, H, W] of the kind that the settings name, in their type."""
        height, width = guide.shape[-2:]
        multiple = self.settings.multiple
        padded = F.pad(guide, (0, -width % multiple, 0, -height % multiple))
        x = self.features(padded)
        planes = torch.cat([head(adapter(x)) for adapter, head in zip(self.adapters, self.heads, strict=True)], 1)
        if self.settings.stem > 1:
            planes = F.pixel_shuffle(planes, self.settings.stem)
        planes = planes + self.filter(padded)
        planes = (planes[:, :, :height, :width] * support(guide[:, -2:-1])).to(guide.dtype)
        return torch.stack([planes[:, self.names.index(name)] for name in PLANES], 1)


def _twice(before: int, after: int) -> nn.Sequential:
    """Makes two 3 x 3 convolutions with ReLU, initialised such that activations keep their scale."""
    layers = []
    for inputs in (before, after):
        convolution = nn.Conv2d(inputs, after, 3, padding=1)
        nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        nn.init.zeros_(convolution.bias)
        layers += [convolution, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)
