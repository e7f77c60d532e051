"""A trained network at work: one image at a time, in half floats and as a CUDA graph on a GPU, in float32 on a CPU.

The weights are folded, which changes nothing but the rounding: a norm's scale and shift go into the 1 x 1 convolution
behind it, a block's beta and gamma into the one before; the channel attention multiplies the weights of the convolution
behind it, which are few, instead of the image. The adapters run as one block, and their heads as one convolution.
Pixels lie as rows of channels, so that 1 x 1 convolutions are plain matrix products; what is between these is done by
`wlm_kernels.naf_block`. All buffers but a few are made beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
import warp as wp
from torch import nn

from wlm.interop import StepGraph, check_device, to_warp
from wlm.smoke.axes import DIRECTIONS, Camera
from wlm.smoke.network import NafBlock, SixWayNetwork, support
from wlm.smoke.reference import SixWay
from wlm.smoke.samples import GUIDES, PLANES, decode_lightmaps, look_at
from wlm.smoke.volume import DensityVolume
from wlm_kernels import naf_block

__all__ = ["Predictor", "predict"]

_WARMUP = 2


class Predictor:
    """Turns encoded guides of one size into planes, with a network's weights as they are when it is made.

    Attributes:
        height, width: H and W of the images.
        device: Where it runs.
        emission: Whether the network makes emission.
        guide: Which kind of guiding map it reads, one of `samples.GUIDES`.
        half: Whether it computes in half floats.
    """

    def __init__(
        self, network: SixWayNetwork, height: int, width: int, *, device: str = "cpu", half: bool = True
    ) -> None:
        """Folds the weights and allocates the buffers.

        Args:
            network: Trained; it isn't changed.
            height, width: H and W, any from 1.
            device: As `check_device` takes it.
            half: Whether a GPU computes in half floats; a CPU always computes in float32.

        Raises:
            ValueError: A size below 1.
            WlmError: No such device.
        """
        if height < 1 or width < 1:
            raise ValueError(f"expected at least one pixel, got {height} x {width}")
        self.device = check_device(device)
        self.height, self.width, self.emission = height, width, network.settings.emission
        self.guide = network.settings.guide
        self.half = half and self.device != "cpu"
        kind = torch.float16 if self.half else torch.float32
        with torch.no_grad():
            still = SixWayNetwork(network.settings)
            still.load_state_dict(network.state_dict())
            self._folded = _Folded(still, height, width, self.device, kind)
        self._guide = torch.zeros(1, len(GUIDES[network.settings.guide]), height, width, device=self.device, dtype=kind)
        self._planes = torch.zeros(len(PLANES), height, width, device=self.device)
        self._run = StepGraph(self._work, self.device, warmup=_WARMUP)

    def __call__(self, encoded: torch.Tensor) -> torch.Tensor:
        """Makes the planes of one image; on CUDA it is queued, not awaited.

        Args:
            encoded: [C, H, W], of `samples.look_at` and the network's kind, on the device.

        Returns:
            float32 [8, H, W] in the order of `samples.PLANES`, clamped to what each can be. It is overwritten by the
            next call.

        Raises:
            ValueError: Another size, or another device.
        """
        if encoded.shape != self._guide.shape[1:] or encoded.device != self._guide.device:
            wanted = f"{list(self._guide.shape[1:])} on {self.device}"
            raise ValueError(f"encoded: expected {wanted}, got {list(encoded.shape)} on {encoded.device}")
        self._guide[0].copy_(encoded)
        self._run()
        return self._planes

    @torch.no_grad()
    def _work(self) -> None:
        self._planes.copy_(self._folded(self._guide))
        self._planes.clamp_(min=0.0)
        self._planes[len(DIRECTIONS) :].clamp_(max=1.0)


def predict(
    volume: DensityVolume,
    camera: Camera,
    predictor: Predictor,
    *,
    step: float = 10.0,
    jitter: float = 1.0,
    seed: int = 0,
    threshold: float = 0.01,
) -> SixWay:
    """Makes six-way lightmaps of smoke: its guiding map, the network, and its planes decoded.

    Args:
        volume: On the predictor's device.
        camera: Orthographic; of the predictor's height and width.
        predictor: The network.
        step, jitter, seed, threshold: Of the guiding map, as for `guide`: what the network was trained with, which
            `DatasetSettings.look` gives.

    Returns:
        The lightmaps, with emission if the smoke has a temperature and the network makes it.

    Raises:
        ValueError: Another size or device, or a setting out of its range.
    """
    look = {"step": step, "jitter": jitter, "seed": seed, "threshold": threshold}
    planes = predictor(look_at(volume, camera, predictor.guide, **look))
    return decode_lightmaps(planes, hot=predictor.emission and volume.temperature is not None)


class _Level:
    """The buffers that all blocks of a level share: H x W pixels of c channels, for G blocks side by side."""

    def __init__(self, height: int, width: int, channels: int, groups: int, device: str, kind: torch.dtype) -> None:
        self.height, self.width, self.channels, self.groups = height, width, channels, groups
        rows = height * width
        options = {"device": device, "dtype": kind}
        self.x = torch.empty(rows, channels, **options)
        self.normed = torch.empty(rows * groups, channels, **options)
        self.wide = torch.empty(rows, 2 * groups * channels, **options)
        self.gated = torch.empty(rows, groups * channels, **options)
        self.mean = torch.empty(groups * channels, device=device)
        self.project = torch.empty(groups, channels, channels, **options)
        image = (height, width, -1)
        self.wp_x, self.wp_normed, self.wp_mean, self.wp_project = map(
            to_warp, (self.x, self.normed, self.mean, self.project)
        )
        self.wp_wide, self.wp_gated = to_warp(self.wide.view(image)), to_warp(self.gated.view(image))


class _Block:
    """G NAFBlocks side by side on one input of c channels; one of the U-Net's own where G = 1.

    What is added to every pixel alike isn't: it is kept apart as a shift, which norms add, and which the products
    behind take into their biases.
    """

    def __init__(self, blocks: list[NafBlock], shift: torch.Tensor, device: str, kind: torch.dtype) -> None:
        """Folds the weights.

        Args:
            blocks: G of them.
            shift: [c], what the input lacks.
            device, kind: Where and in which numbers it runs.
        """
        self.device, self.groups, cuda = device, len(blocks), device != "cpu"
        self.kernels = naf_block.kernels(len(shift), kind == torch.float16, cuda)
        self.lanes = naf_block.lanes(len(shift), cuda)
        expand, expand_bias = zip(*(_after_norm(b.norm1, b.expand) for b in blocks), strict=True)
        self.expand = _halves(expand).t().to(device, kind)
        self.expand_bias = _halves(expand_bias).to(device, kind)
        self.widen, self.widen_bias = (
            torch.stack(part).to(device, kind)
            for part in zip(*(_after_norm(b.norm2, b.widen) for b in blocks), strict=True)
        )
        self.widen, self.widen_bias = self.widen.transpose(1, 2), self.widen_bias[:, None]
        narrow = torch.stack([b.narrow.weight[:, :, 0, 0] * b.gamma[:, :, 0] for b in blocks])
        self.narrow = narrow.to(device, kind).transpose(1, 2)
        depthwise = _halves([b.depthwise.weight.flatten(1) for b in blocks]).t()
        attend = torch.stack([b.attend.weight for b in blocks])
        attend_bias = torch.stack([b.attend.bias for b in blocks])
        project = torch.stack([(b.project.weight[:, :, 0, 0] * b.beta[:, :, 0]).t() for b in blocks])
        middle = shift + torch.stack([b.project.bias * b.beta[:, 0, 0] for b in blocks])
        self.shift = middle + torch.stack([b.narrow.bias * b.gamma[:, 0, 0] for b in blocks])
        self.before, self.middle, self.depthwise, self.depthwise_bias, self.attend, self.attend_bias, self.project = (
            to_warp(value.detach().float().contiguous().to(device))
            for value in (
                shift[None],
                middle,
                depthwise,
                _halves([b.depthwise.bias for b in blocks]),
                attend,
                attend_bias,
                project,
            )
        )

    def __call__(self, level: _Level) -> torch.Tensor:
        """Works on ``level.x`` where G = 1, and gives it; else gives a new tensor [G, P, c]."""
        rows, channels, groups = len(level.x), level.channels, self.groups
        self._launch("norm", self.lanes * rows, [level.wp_x, self.before, rows], level.wp_normed)
        torch.addmm(self.expand_bias, level.normed[:rows], self.expand, out=level.wide)
        size = (-(-level.height // naf_block.STRIP), level.width, groups * channels)
        self._launch("gate", size, [level.wp_wide, self.depthwise, self.depthwise_bias], level.wp_gated)
        # In float32, as in training.
        torch.mean(level.gated, 0, dtype=torch.float32, out=level.mean)
        weights = [level.wp_mean, self.attend, self.attend_bias, self.project]
        self._launch("attend", self.lanes * groups * channels, weights, level.wp_project)
        if groups == 1:
            x = level.x.addmm_(level.gated, level.project[0])
            self._launch("norm", self.lanes * rows, [level.wp_x, self.middle, rows], level.wp_normed)
            torch.addmm(self.widen_bias[0, 0], level.normed, self.widen[0], out=level.wide)
            torch.mul(level.wide[:, :channels], level.wide[:, channels:], out=level.gated)
            return x.addmm_(level.gated, self.narrow[0])
        gated = level.gated.view(rows, groups, channels).transpose(0, 1)
        x = torch.baddbmm(level.x.expand(groups, -1, -1), gated, level.project)
        shifted = [to_warp(x.view(-1, channels)), self.middle, rows]
        self._launch("norm", self.lanes * groups * rows, shifted, level.wp_normed)
        wide = torch.baddbmm(self.widen_bias, level.normed.view(groups, rows, channels), self.widen)
        left, right = wide.chunk(2, -1)
        return x.baddbmm_(left * right, self.narrow)

    def _launch(self, name: str, dim: int | tuple[int, ...], inputs: list, output: wp.array) -> None:
        wp.launch(getattr(self.kernels, name), dim, inputs=inputs, outputs=[output], device=self.device)


class _Folded:
    """A network for images of one size, [1, C, H, W] to [8, H, W]."""

    def __init__(self, network: SixWayNetwork, height: int, width: int, device: str, kind: torch.dtype) -> None:
        self.settings = settings = network.settings
        self.stem = network.stem.weight.to(device, kind), network.stem.bias.to(device, kind)
        multiple = settings.multiple
        self.padding = (0, -width % multiple, 0, -height % multiple)
        rows, columns = (height + self.padding[3]) // settings.stem, (width + self.padding[1]) // settings.stem
        options = (device, kind)
        self.levels, self.encoder, self.down, shifts = [], [], [], []
        shift = torch.zeros(settings.width)
        for level, blocks in enumerate(network.encoder):
            channels = settings.width << level
            self.levels.append(_Level(rows >> level, columns >> level, channels, 1, *options))
            made, shift = _chain(blocks, shift, *options)
            self.encoder.append(made)
            shifts.append(shift)
            if level < len(network.down):
                # Inputs in the order row, column, channel of a square of pixels.
                weight = network.down[level].weight.permute(0, 2, 3, 1).flatten(1)
                bias = network.down[level].bias + weight @ shift.repeat(4)
                self.down.append((weight.to(*options), bias.to(*options)))
                shift = torch.zeros(2 * channels)
        self.decoder, self.up = [None] * len(network.up), [None] * len(network.up)
        for level in reversed(range(len(network.up))):
            # Outputs in the order row, column, channel; pixel_shuffle has channels first.
            weight = network.up[level].weight[:, :, 0, 0].unflatten(0, (-1, 2, 2)).permute(1, 2, 0, 3).flatten(0, 2)
            self.up[level] = weight.to(*options), (weight @ shift).to(*options)
            self.decoder[level], shift = _chain(network.decoder[level], shifts[level], *options)
        first = self.levels[0]
        self.adapters = _Block(list(network.adapters), shift, *options)
        self.adapted = _Level(first.height, first.width, settings.width, len(network.adapters), *options)
        self.adapted.x, self.adapted.wp_x = first.x, first.wp_x
        self.shift = self.adapters.shift[:, None].to(*options)
        heads = network.heads
        self.heads = torch.cat([h.weight for h in heads]).to(*options), torch.cat([h.bias for h in heads]).to(*options)
        names = [name for group in network.groups for name in group]
        owner = [i for i, group in enumerate(network.groups) for _ in group]
        made = [name for name in PLANES if name in names]
        order = torch.tensor([names.index(name) for name in made])
        self.order, self.owner = order.to(device), torch.tensor(owner)[order].to(device)
        self.mix = network.mix[order].to(*options) if settings.residual else None

    def __call__(self, guide: torch.Tensor) -> torch.Tensor:
        """Planes in order and not clamped; a last one that isn't made is 0."""
        settings, stem, levels = self.settings, self.settings.stem, self.levels
        height, width = guide.shape[-2:]
        padded = F.pad(guide, self.padding)[:, : settings.channels]
        x = F.pixel_unshuffle(padded, stem) if stem > 1 else padded
        x = F.conv2d(x.contiguous(memory_format=torch.channels_last), *self.stem, padding=1)
        levels[0].x.copy_(x[0].permute(1, 2, 0).reshape_as(levels[0].x))
        for level, blocks in enumerate(self.encoder):
            for block in blocks:
                block(levels[level])
            if level < len(self.down):
                weight, bias = self.down[level]
                squares = _squares(levels[level]).reshape(-1, 4 * levels[level].channels)
                torch.addmm(bias, squares, weight.t(), out=levels[level + 1].x)
        for level in reversed(range(len(self.up))):
            weight, bias = self.up[level]
            squares = _squares(levels[level])
            squares += torch.addmm(bias, levels[level + 1].x, weight.t()).view_as(squares)
            for block in self.decoder[level]:
                block(levels[level])
        # Each adapter through all heads: of those only its own count, but one convolution is quicker than four.
        y = self.adapters(self.adapted) + self.shift
        y = y.view(-1, levels[0].height, levels[0].width, settings.width).permute(0, 3, 1, 2)
        y = F.conv2d(y, *self.heads, padding=1)
        y = y.unflatten(1, (-1, stem**2))[self.owner, self.order]
        y = F.pixel_shuffle(y, stem)[:, 0] if stem > 1 else y[:, 0]
        if self.mix is not None:
            y = y + (self.mix @ padded[0].flatten(1)).view_as(y)
        y = y[:, :height, :width] * support(guide[:, -2:-1])[0]
        return y if settings.emission else F.pad(y, (0, 0, 0, 0, 0, 1))


def _chain(blocks: nn.Sequential, shift: torch.Tensor, device: str, kind: torch.dtype):
    """Blocks one behind the other, and what their output lacks."""
    made = []
    for block in blocks:
        made.append(_Block([block], shift, device, kind))
        shift = made[-1].shift[0]
    return made, shift


def _squares(level: _Level) -> torch.Tensor:
    """A level's pixels as [H / 2, W / 2, 2, 2, c], sharing its memory."""
    return level.x.view(level.height // 2, 2, level.width // 2, 2, level.channels).transpose(1, 2)


def _halves(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """Joins what G groups expand to such that all first halves come before all second ones."""
    return torch.cat([half for side in (0, 1) for half in (part.chunk(2)[side] for part in parts)])


def _after_norm(norm: nn.Module, conv: nn.Conv2d) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights and biases of a 1 x 1 convolution that take in those of the norm before it."""
    weight = conv.weight[:, :, 0, 0]
    return weight * norm.weight[:, 0, 0], conv.bias + weight @ norm.bias[:, 0, 0]
