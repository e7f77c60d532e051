"""A trained network at work: one image at a time, in half floats and as a CUDA graph on a GPU, in float32 on a CPU.

The weights of the adapters are folded, which changes nothing but the rounding: a norm's scale and shift go into the
1 x 1 convolution behind it, beta and gamma into the one before; the channel attention multiplies the weights of the
convolution behind it, which are few, instead of the image. The adapters run side by side, and their heads as one
convolution. Pixels lie as rows of channels, so that 1 x 1 convolutions are plain matrix products; what is between these
is done by `wlm_kernels.smoke.naf_block`, and what comes behind the heads by `wlm_kernels.smoke.planes`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
import warp as wp
from torch import nn

from wlm.fluid.volume import DensityVolume
from wlm.interop import StepGraph, check_device, to_warp
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.model import REACH, NafBlock, SixWayNetwork
from wlm.smoke.planes import GUIDES, PLANES, decode_lightmaps, render_guide
from wlm_kernels.smoke import naf_block
from wlm_kernels.smoke import planes as smoke_planes
from wlm_kernels.smoke.settings import March

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
            self._tail = _Tail(still, height, width, self.device, kind)
        self._guide = torch.zeros(1, len(GUIDES[network.settings.guide]), height, width, device=self.device, dtype=kind)
        self._planes = torch.zeros(len(PLANES), height, width, device=self.device)
        self._run = StepGraph(self._work, self.device, warmup=_WARMUP)

    def __call__(self, encoded: torch.Tensor) -> torch.Tensor:
        """Makes the planes of one image; on CUDA it is queued, not awaited.

        Args:
            encoded: [C, H, W], of `planes.render_guide` and the network's kind, on the device.

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
        # The quickest of cuDNN's ways, tried out before the graph; where float32 is asked for, it shall be that.
        with torch.backends.cudnn.flags(enabled=True, benchmark=True, deterministic=False, allow_tf32=self.half):
            heads = self._folded(self._guide)
        self._tail(heads, self._guide[0], self._planes)


def predict(volume: DensityVolume, camera: Camera, predictor: Predictor, march: March = March()) -> SixWay:
    """Makes six-way lightmaps of smoke: its guiding map, the network, and its planes decoded.

    Args:
        volume: On the predictor's device.
        camera: Orthographic; of the predictor's height and width.
        predictor: The network.
        march: Of the guiding map: what the network was trained with, which `DatasetSettings.look` gives.

    Returns:
        The lightmaps, with emission if the smoke has a temperature and the network makes it.

    Raises:
        ValueError: Another size or device.
    """
    planes = predictor(render_guide(volume, camera, predictor.guide, march))
    return decode_lightmaps(planes, hot=predictor.emission and volume.temperature is not None, camera=camera)


class _Adapters:
    """G NAFBlocks side by side on one image of H x W pixels of c channels.

    What a block adds to every pixel alike isn't added: it is kept apart as a shift, which the norm adds.

    Attributes:
        shift: [G, c], what the outputs lack.
    """

    def __init__(self, blocks: list[NafBlock], height: int, width: int, device: str, kind: torch.dtype) -> None:
        """Folds the weights and makes the buffers.

        Args:
            blocks: G of them.
            height, width: H and W.
            device, kind: Where and in which numbers they run.
        """
        channels, groups, rows, cuda = blocks[0].attend.in_features, len(blocks), height * width, device != "cpu"
        self.height, self.width, self.channels, self.groups, self.device = height, width, channels, groups, device
        self.kernels = naf_block.kernels(channels, kind == torch.float16, cuda)
        self.lanes = naf_block.lanes(channels, cuda)
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
        middle = torch.stack([b.project.bias * b.beta[:, 0, 0] for b in blocks])
        self.shift = middle + torch.stack([b.narrow.bias * b.gamma[:, 0, 0] for b in blocks])
        depthwise_bias = _halves([b.depthwise.bias for b in blocks])
        parts = (torch.zeros(1, channels), middle, depthwise, depthwise_bias, attend, attend_bias, project)
        self._nothing, self._middle, self._depthwise, self._depthwise_bias, *self._attention = (
            to_warp(value.detach().float().contiguous().to(device)) for value in parts
        )
        options = {"device": device, "dtype": kind}
        self._x = torch.empty(rows, channels, **options)
        self._between = torch.empty(groups, rows, channels, **options)
        self._normed = torch.empty(rows * groups, channels, **options)
        self._wide = torch.empty(rows, 2 * groups * channels, **options)
        self._gated = torch.empty(rows, groups * channels, **options)
        self._mean = torch.empty(groups * channels, device=device)
        self._project = torch.empty(groups, channels, channels, **options)

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        """Works on [1, c, H, W], and gives [G, P, c], which the next call overwrites."""
        rows, channels, groups = len(self._x), self.channels, self.groups
        self._x.copy_(image[0].permute(1, 2, 0).reshape_as(self._x))
        self._launch("norm", self.lanes * rows, [to_warp(self._x), self._nothing, rows], self._normed)
        torch.addmm(self.expand_bias, self._normed[:rows], self.expand, out=self._wide)
        size = (-(-self.height // naf_block.STRIP), self.width, groups * channels)
        planes = (self.height, self.width, -1)
        inputs = [to_warp(self._wide.view(planes)), self._depthwise, self._depthwise_bias]
        self._launch("gate", size, inputs, self._gated.view(planes))
        # In float32, as in training.
        torch.mean(self._gated, 0, dtype=torch.float32, out=self._mean)
        weights = [to_warp(self._mean), *self._attention]
        self._launch("attend", self.lanes * groups * channels, weights, self._project)
        gated = self._gated.view(rows, groups, channels).transpose(0, 1)
        torch.baddbmm(self._x.expand(groups, -1, -1), gated, self._project, out=self._between)
        inputs = [to_warp(self._between.view(-1, channels)), self._middle, rows]
        self._launch("norm", self.lanes * groups * rows, inputs, self._normed)
        wide = torch.baddbmm(self.widen_bias, self._normed.view(groups, rows, channels), self.widen)
        left, right = wide.chunk(2, -1)
        return self._between.baddbmm_(left * right, self.narrow)

    def _launch(self, name: str, dim: int | tuple[int, ...], inputs: list, output: torch.Tensor) -> None:
        kernel = getattr(self.kernels, name)
        wp.launch(kernel, dim, inputs=inputs, outputs=[to_warp(output)], device=self.device)


class _Folded:
    """A network's U-Net, adapters and heads for images of one size."""

    def __init__(self, network: SixWayNetwork, height: int, width: int, device: str, kind: torch.dtype) -> None:
        self.settings = settings = network.settings
        self.fused = device != "cpu"
        multiple = settings.multiple
        self.padding = (0, -width % multiple, 0, -height % multiple)
        rows, columns = (height + self.padding[3]) // settings.stem, (width + self.padding[1]) // settings.stem
        options = (device, kind)
        self.encoder, self.decoder = (
            [[_weights(layer, *options) for layer in level if isinstance(layer, nn.Conv2d)] for level in levels]
            for levels in (network.encoder, network.decoder)
        )
        self.up = [_weights(layer, *options) for layer in network.up]
        self.size = (rows, columns)
        self.adapters = _Adapters(list(network.adapters), rows, columns, *options)
        self.shift = self.adapters.shift[:, None].to(*options)
        heads = network.heads
        self.heads = torch.cat([h.weight for h in heads]).to(*options), torch.cat([h.bias for h in heads]).to(*options)

    def __call__(self, guide: torch.Tensor) -> torch.Tensor:
        """Of [1, C, H, W] what all heads make of each adapter, [G, N, H / stem, W / stem] of the padded image."""
        settings, stem = self.settings, self.settings.stem
        padded = F.pad(guide, self.padding)[:, : settings.channels]
        x = F.pixel_unshuffle(padded, stem) if stem > 1 else padded
        x = x.contiguous(memory_format=torch.channels_last)
        skips = []
        for level, convolutions in enumerate(self.encoder):
            x = self._twice(F.max_pool2d(x, 2) if level else x, convolutions)
            skips.append(x)
        for level in reversed(range(len(self.up))):
            above = F.interpolate(F.conv2d(x, *self.up[level]), scale_factor=2.0, mode="nearest")
            x = self._twice(torch.cat([above, skips[level]], 1), self.decoder[level])
        # Each adapter through all heads: of those only its own count, but one convolution is quicker than four.
        y = self.adapters(x) + self.shift
        y = y.view(-1, *self.size, settings.width).permute(0, 3, 1, 2)
        return F.conv2d(y, *self.heads, padding=1)

    def _twice(self, x: torch.Tensor, convolutions: list[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
        for weight, bias in convolutions:
            if self.fused:
                x = torch.cudnn_convolution_relu(x, weight, bias, (1, 1), (1, 1), (1, 1), 1)
            else:
                x = F.relu(F.conv2d(x, weight, bias, padding=1))
        return x


class _Tail:
    """Makes planes of what the heads make: their pixels in place, the filter of the guide, no smoke where none is near.

    The filter runs in float32.
    """

    def __init__(self, network: SixWayNetwork, height: int, width: int, device: str, kind: torch.dtype) -> None:
        settings = network.settings
        self.device, self.stem, area = device, settings.stem, settings.stem**2
        order = [PLANES.index(name) for group in network.groups for name in group]
        places = torch.tensor([[-1, 0]] * len(PLANES), dtype=torch.int32)
        owner = [i for i, group in enumerate(network.groups) for _ in group]
        places[order] = torch.tensor([[i, n * area] for n, i in enumerate(owner)], dtype=torch.int32)
        filters = network.filter.weight if settings.residual else torch.zeros(len(order), 0, 1, 1)
        edge = filters.shape[-1]
        # Down a column first, as a thread goes.
        weights = torch.zeros(filters.shape[1], edge, edge, len(PLANES))
        weights[..., order] = filters.permute(1, 3, 2, 0)
        self._places = to_warp(places.to(device))
        self._weights = to_warp(weights.view(-1, len(PLANES)).to(device), smoke_planes.Taps)
        self._kernels = smoke_planes.kernels(edge, REACH, kind == torch.float16, device != "cpu")
        blocks = (-(-height // REACH), -(-width // REACH))
        self._smoke = to_warp(torch.empty(blocks, dtype=torch.int32, device=device))

    def __call__(self, heads: torch.Tensor, guide: torch.Tensor, planes: torch.Tensor) -> None:
        """Writes planes [8, H, W], of `_Folded`'s outputs and its guide [C, H, W]."""
        made, seen = self._kernels, to_warp(guide)
        self._launch(made.near, made.lanes * self._smoke.size, [seen], self._smoke)
        pixels = to_warp(heads.permute(0, 2, 3, 1))
        inputs = [pixels, seen, self._weights, self._places, self.stem, self._smoke]
        self._launch(made.compose, (-(-guide.shape[1] // smoke_planes.STRIP), guide.shape[2]), inputs, to_warp(planes))

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, output: wp.array) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=[output], device=self.device)


def _weights(layer: nn.Conv2d, device: str, kind: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """A convolution's weights, their channels together as the image's, and its biases."""
    return layer.weight.to(device, kind, memory_format=torch.channels_last), layer.bias.to(device, kind)


def _halves(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """Joins what G groups expand to such that all first halves come before all second ones."""
    return torch.cat([half for side in (0, 1) for half in (part.chunk(2)[side] for part in parts)])


def _after_norm(norm: nn.Module, conv: nn.Conv2d) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights and biases of a 1 x 1 convolution that take in those of the norm before it."""
    weight = conv.weight[:, :, 0, 0]
    return weight * norm.weight[:, 0, 0], conv.bias + weight @ norm.bias[:, 0, 0]
