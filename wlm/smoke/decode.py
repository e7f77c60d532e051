"""Runs a trained network on one image at a time: on a GPU in half floats as a CUDA graph, on a CPU in float32.

An adapter is one of the NAFBlocks (see `wlm.smoke.network.unet`) that turn features into planes. Some of its layers are
merged, which changes only rounding: the scale and shift of a norm into the weights of the 1 x 1 convolution after it,
and the factors beta and gamma into the convolution before them. All adapters run in one batch. An image is stored as a
matrix with a row of channels per pixel, so that 1 x 1 convolutions are matrix products.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
import warp as wp
from torch import nn

from wlm.interop import StepGraph, check_device, to_warp
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import GUIDES, PLANES
from wlm.smoke.network.unet import REACH, NafBlock, SixWayNetwork
from wlm_kernels.smoke import naf_block
from wlm_kernels.smoke import planes as smoke_planes

_WARMUP = 2


class Decoder:
    """A trained network for images of one size: predicts encoded lightmaps from an encoded guiding map.

    Attributes:
        height, width: Size of the images in pixels, H and W.
        device: Device on which it runs.
        guide: Kind of guiding map that it reads, a key of `planes.GUIDES`.
        half: Whether the network computes in half floats.
    """

    def __init__(self, model: SmokeModel, device: str = "cpu", *, height: int, width: int, half: bool = True) -> None:
        """Merges the layers of the network, with their current weights, and allocates buffers.

        Args:
            model: The network; it is not changed.
            device: "cpu", "cuda" or "cuda:N".
            height, width: Size of the images in pixels, H and W, at least 1.
            half: Whether a GPU computes in half floats; a CPU always computes in float32.

        Raises:
            ValueError: A size is below 1.
            WlmError: The device does not exist.
        """
        if height < 1 or width < 1:
            raise ValueError(f"height, width: expected at least 1 pixel, got {height}, {width}")
        settings = model.settings
        self.device = check_device(device)
        self.height, self.width, self.guide = height, width, settings.guide
        self.half = half and self.device != "cpu"
        dtype = torch.float16 if self.half else torch.float32
        with torch.no_grad():
            network = SixWayNetwork(settings)
            network.load_state_dict(model.network.state_dict())
            self._body = _Body(network, height, width, self.device, dtype)
            self._tail = _Tail(network, height, width, self.device, dtype)
        self._guide = torch.zeros(1, len(GUIDES[self.guide]), height, width, device=self.device, dtype=dtype)
        self._planes = torch.zeros(len(PLANES), height, width, device=self.device)
        self._run = StepGraph(self._work, self.device, warmup=_WARMUP)

    def __call__(self, encoded: torch.Tensor) -> torch.Tensor:
        """Predicts lightmaps, opacity and emission of one image; on CUDA it returns before the GPU has finished.

        Args:
            encoded: [C, H, W] on the device, a guiding map of the kind `guide` from `planes.render_guide`.

        Returns:
            float32 [8, H, W], encoded, in the order of `PLANES`, clamped to their ranges. The next call overwrites it.

        Raises:
            ValueError: The size or the device is wrong.
        """
        if encoded.shape != self._guide.shape[1:] or encoded.device != self._guide.device:
            expected = f"{list(self._guide.shape[1:])} on {self.device}"
            raise ValueError(
                f"encoded: expected a guiding map {expected}, got {list(encoded.shape)} on {encoded.device}"
            )
        self._guide[0].copy_(encoded)
        self._run()
        return self._planes

    @torch.no_grad()
    def _work(self) -> None:
        # cuDNN benchmarks its algorithms before the graph is captured; TF32 is used only with half floats.
        with torch.backends.cudnn.flags(enabled=True, benchmark=True, deterministic=False, allow_tf32=self.half):
            heads = self._body(self._guide)
        self._tail(heads, self._guide[0], self._planes)


class _Adapters:
    """Applies G NAFBlocks to one image with c channels; the caller must add `shift` [G, c], their constant part."""

    def __init__(self, blocks: list[NafBlock], height: int, width: int, device: str, dtype: torch.dtype) -> None:
        channels, groups, rows, cuda = blocks[0].attend.in_features, len(blocks), height * width, device != "cpu"
        self.height, self.width, self.channels, self.groups = height, width, channels, groups
        self.kernels = naf_block.kernels(channels, dtype == torch.float16, cuda)
        self.lanes = naf_block.lanes(channels, cuda)
        expand, expand_bias = zip(*(_after_norm(b.norm1, b.expand) for b in blocks), strict=True)
        self.expand = _halves(expand).t().to(device, dtype)
        self.expand_bias = _halves(expand_bias).to(device, dtype)
        widen, widen_bias = zip(*(_after_norm(b.norm2, b.widen) for b in blocks), strict=True)
        self.widen = torch.stack(widen).to(device, dtype).transpose(1, 2)
        self.widen_bias = torch.stack(widen_bias).to(device, dtype)[:, None]
        narrow = torch.stack([b.narrow.weight[:, :, 0, 0] * b.gamma[:, :, 0] for b in blocks])
        self.narrow = narrow.to(device, dtype).transpose(1, 2)
        depthwise = _halves([b.depthwise.weight.flatten(1) for b in blocks]).t()
        attend = torch.stack([b.attend.weight for b in blocks])
        attend_bias = torch.stack([b.attend.bias for b in blocks])
        project = torch.stack([(b.project.weight[:, :, 0, 0] * b.beta[:, :, 0]).t() for b in blocks])
        middle = torch.stack([b.project.bias * b.beta[:, 0, 0] for b in blocks])
        self.shift = middle + torch.stack([b.narrow.bias * b.gamma[:, 0, 0] for b in blocks])
        depthwise_bias = _halves([b.depthwise.bias for b in blocks])
        parts = (torch.zeros(1, channels), middle, depthwise, depthwise_bias, attend, attend_bias, project)
        self._zero, self._middle, self._depthwise, self._depthwise_bias, *self._attention = (
            to_warp(value.detach().float().contiguous().to(device)) for value in parts
        )
        options = {"device": device, "dtype": dtype}
        self._x = torch.empty(rows, channels, **options)
        self._between = torch.empty(groups, rows, channels, **options)
        self._normed = torch.empty(rows * groups, channels, **options)
        self._wide = torch.empty(rows, 2 * groups * channels, **options)
        self._gated = torch.empty(rows, groups * channels, **options)
        self._mean = torch.empty(groups * channels, device=device)
        self._project = torch.empty(groups, channels, channels, **options)

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        """Applies the blocks to an image [1, c, H, W]; returns [G, H * W, c], which the next call overwrites."""
        rows, channels, groups = len(self._x), self.channels, self.groups
        self._x.copy_(image[0].permute(1, 2, 0).reshape_as(self._x))
        _launch(self.kernels.norm, self.lanes * rows, [to_warp(self._x), self._zero, rows], self._normed)
        torch.addmm(self.expand_bias, self._normed[:rows], self.expand, out=self._wide)
        size = (-(-self.height // naf_block.STRIP), self.width, groups * channels)
        planes = (self.height, self.width, -1)
        inputs = [to_warp(self._wide.view(planes)), self._depthwise, self._depthwise_bias]
        _launch(self.kernels.gate, size, inputs, self._gated.view(planes))
        # In float32, as in training.
        torch.mean(self._gated, 0, dtype=torch.float32, out=self._mean)
        weights = [to_warp(self._mean), *self._attention]
        _launch(self.kernels.attend, self.lanes * groups * channels, weights, self._project)
        gated = self._gated.view(rows, groups, channels).transpose(0, 1)
        torch.baddbmm(self._x.expand(groups, -1, -1), gated, self._project, out=self._between)
        inputs = [to_warp(self._between.view(-1, channels)), self._middle, rows]
        _launch(self.kernels.norm, self.lanes * groups * rows, inputs, self._normed)
        wide = torch.baddbmm(self.widen_bias, self._normed.view(groups, rows, channels), self.widen)
        left, right = wide.chunk(2, -1)
        return self._between.baddbmm_(left * right, self.narrow)


class _Body:
    """The network up to its heads, the convolutions that make planes, for images of one size."""

    def __init__(self, network: SixWayNetwork, height: int, width: int, device: str, dtype: torch.dtype) -> None:
        self.settings = settings = network.settings
        self.fused = device != "cpu"
        multiple = settings.multiple
        self.padding = (0, -width % multiple, 0, -height % multiple)
        rows, columns = (height + self.padding[3]) // settings.stem, (width + self.padding[1]) // settings.stem
        options = (device, dtype)
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
        """Runs all heads on all adapters; returns [adapters, outputs, H / stem, W / stem] for a guide [1, C, H, W]."""
        settings, stem = self.settings, self.settings.stem
        padded = F.pad(guide, self.padding)
        x = F.pixel_unshuffle(padded, stem) if stem > 1 else padded
        x = x.contiguous(memory_format=torch.channels_last)
        skips = []
        for level, convolutions in enumerate(self.encoder):
            x = self._twice(F.max_pool2d(x, 2) if level else x, convolutions)
            skips.append(x)
        for level in reversed(range(len(self.up))):
            above = F.interpolate(F.conv2d(x, *self.up[level]), scale_factor=2.0, mode="nearest")
            x = self._twice(torch.cat([above, skips[level]], 1), self.decoder[level])
        # Each adapter runs through all heads and only its own head is used: one convolution is faster than four.
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
    """The network's last step: adds the heads' outputs to the filtered guide, and sets planes to 0 far from smoke."""

    def __init__(self, network: SixWayNetwork, height: int, width: int, device: str, dtype: torch.dtype) -> None:
        settings = network.settings
        self.stem, area = settings.stem, settings.stem**2
        order = [PLANES.index(name) for name in network.names]
        adapters = [i for i, group in enumerate(network.groups) for _ in group]
        # The adapter of each plane, and its first channel.
        places = torch.zeros(len(PLANES), 2, dtype=torch.int32)
        places[order] = torch.tensor([[adapter, n * area] for n, adapter in enumerate(adapters)], dtype=torch.int32)
        filters = network.filter.weight
        edge = filters.shape[-1]
        # Columns first, the order in which a thread reads them.
        taps = torch.zeros(filters.shape[1], edge, edge, len(PLANES))
        taps[..., order] = filters.permute(1, 3, 2, 0)
        self._places = to_warp(places.to(device))
        self._taps = to_warp(taps.view(-1, len(PLANES)).to(device), smoke_planes.Taps)
        self._kernels = smoke_planes.kernels(edge, REACH, dtype == torch.float16, device != "cpu")
        blocks = (-(-height // REACH), -(-width // REACH))
        self._smoke = torch.empty(blocks, dtype=torch.int32, device=device)

    def __call__(self, heads: torch.Tensor, guide: torch.Tensor, planes: torch.Tensor) -> None:
        """Writes `planes` [8, H, W]: the heads' outputs plus the filtered guide [C, H, W], and 0 far from smoke."""
        kernels, source = self._kernels, to_warp(guide)
        _launch(kernels.near, kernels.lanes * self._smoke.numel(), [source], self._smoke)
        pixels = to_warp(heads.permute(0, 2, 3, 1))
        inputs = [pixels, source, self._taps, self._places, self.stem, to_warp(self._smoke)]
        size = (-(-guide.shape[1] // smoke_planes.STRIP), guide.shape[2])
        _launch(kernels.compose, size, inputs, planes)


def _launch(kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, output: torch.Tensor) -> None:
    wp.launch(kernel, dim, inputs=inputs, outputs=[to_warp(output)], device=wp.device_from_torch(output.device))


def _weights(layer: nn.Conv2d, device: str, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    return layer.weight.to(device, dtype, memory_format=torch.channels_last), layer.bias.to(device, dtype)


def _halves(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """Concatenates the first halves of all tensors, then their second halves; a NAFBlock multiplies its two halves."""
    return torch.cat([half for side in (0, 1) for half in (part.chunk(2)[side] for part in parts)])


def _after_norm(norm: nn.Module, conv: nn.Conv2d) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the weights and biases of a 1 x 1 convolution, with the scale and shift of the norm before it merged."""
    weight = conv.weight[:, :, 0, 0]
    return weight * norm.weight[:, 0, 0], conv.bias + weight @ norm.bias[:, 0, 0]
