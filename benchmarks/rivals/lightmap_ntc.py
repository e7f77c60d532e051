"""Neural texture compression of a day: latents on two grids, and one network whose outputs are all hours.

"Random-Access Neural Compression of Material Textures" (Vaidyanathan et al., 2023) and its successors keep the channels
of a material in two grids of quantised latents and a network of two hidden layers of 64, one for each texture set. Here
the colours at all hours are the channels, so that what hours share is stored once. A texel is decoded as:

    x = [fine latents at 4 nodes, coarse latents between 4 nodes, position in the coarse cell],   levels = network(x)

- The network gets the latents of all 4 nearest fine nodes; latents of the coarse grid are interpolated bilinearly.
- Fine latents have 4 bits, coarse ones 8. In training uniform noise of one step stands for the rounding; for the last
  twentieth of the steps latents are rounded and frozen, and the network is fitted to them.
- The position is given as sines and cosines with one and two periods per coarse cell, along both axes.
- The network's parameters are half floats; a map has one network for each 1024 x 1024 texels.

The output levels are colours with a gamma, scaled by a tile's range over the day (`benchmarks.rivals.lightmap_levels`).
Errors have weights half-way between equal ones and PSNR's, like ours, and texels just outside charts weigh a quarter.
The fit needs torch alone, and takes minutes on a GPU or hours on a CPU.
"""

import itertools
import lzma
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional

from benchmarks.rivals.lightmap_levels import GAMMA, TileRanges, areas, prepare, seen_texels, to_codes
from benchmarks.rivals.rival import Rival, measure
from wlm.errors import WlmError
from wlm.interop import check_device

NETWORK_TEXELS = 1024
"""Side in texels of the square of a map that one network decodes."""

_HIDDEN = 64
_FINE_BITS, _COARSE_BITS = 4, 8
_TURNS = (1, 2)  # periods per cell of the position encoding
_CENTRE = math.sqrt(12.0)  # latents that are uniform in [0, 1] have mean 0 and variance 1 as inputs
_FREEZE_FROM = 0.95  # share of the steps
_LATENT_RATE, _NETWORK_RATE = 5e-2, 2e-2  # Adam's first
_BETAS = (0.9, 0.99)  # betas of Adam; a latent is sampled every few steps alone, and its gradient shrinks during a fit
_TUNE_RATE = 1e-3  # learning rate of the network when latents are frozen; falls to a hundredth
_LAST = 0.02  # last learning rate of the network before that, as a share of the first
_RING_WEIGHT = 0.25  # weight of the squared error of texels that only filtered reads take in
_LEAST_CODE, _LEAST_WEIGHT = 1e-3, 0.02  # black texels count a little
_CHUNK = 1 << 14  # texels decoded at once


@dataclass(frozen=True)
class Latents:
    """Sizes of the two grids of latents, which are numbers that the fit learns.

    Attributes:
        fine_step, coarse_step: Texels along the side of a cell of the fine and of the coarse grid.
        fine, coarse: Number of latents at each node of the fine and of the coarse grid.
    """

    fine_step: int
    fine: int
    coarse_step: int
    coarse: int

    @property
    def bits(self) -> float:
        """Returns the bits per texel that the latents of both grids take."""
        return self.fine * _FINE_BITS / self.fine_step**2 + self.coarse * _COARSE_BITS / self.coarse_step**2

    @property
    def inputs(self) -> int:
        """Returns the number of inputs of the network."""
        return 4 * self.fine + self.coarse + 4 * len(_TURNS)


LADDER = {
    "low": Latents(2, 4, 4, 6),
    "medium": Latents(2, 8, 4, 8),
    "high": Latents(1, 4, 4, 16),
    "highest": Latents(1, 12, 4, 16),
}
"""Sizes of the grids by name: 7 to 56 bits of latents a texel."""


@dataclass(frozen=True, eq=False)
class _Region:
    """The part of the map that one network covers.

    Attributes:
        area: Slices of the map's rows and columns that the region covers.
        inside: bool [h, w], which texels of the region are decoded: N texels at and just around charts.
        fine, coarse: Quantised latents, uint8 [rows, columns, latents]; 0 where no decoded texel reads them.
        network: Weights [inputs, outputs] and biases [outputs] of three layers, half floats.
    """

    area: tuple[slice, slice]
    inside: np.ndarray
    fine: np.ndarray
    coarse: np.ndarray
    network: list[np.ndarray]


def encode_ntc(
    frames: np.ndarray,
    mask: np.ndarray,
    latents: str | Latents = "medium",
    *,
    steps: int = 30_000,
    samples: int = 8192,
    seed: int = 0,
    device: str = "cpu",
) -> Rival:
    """Encodes all lightmaps of a set as latents on two grids and a network.

    Args:
        frames: Lightmaps at T times, [T, H, W, 3], linear RGB.
        mask: [H, W], true where a texel is valid.
        latents: A key of `LADDER`, or the sizes of the two grids of latents.
        steps: Steps of each network's fit, at least 1.
        samples: Number of random texels in each step, each at all hours.
        seed: Seed of all random numbers; on the CPU the same seed gives the same result.
        device: "cpu", "cuda" or "cuda:N", for encoding and decoding.

    Returns:
        The rival; `decoded` is float32 [T, H, W, 3]; `disk_bytes` is the size under LZMA, which is part of Python.

    Raises:
        WlmError: As for the block codecs; or a setting is out of range, or there is no such device.
    """
    if isinstance(latents, str) and latents not in LADDER:
        raise WlmError(f"ntc: unknown latents {latents!r}, expected one of {', '.join(LADDER)}")
    name = latents if isinstance(latents, str) else "latents"
    sizes = LADDER[latents] if isinstance(latents, str) else latents
    if steps < 1 or samples < 1:
        raise WlmError(f"ntc: expected at least 1 step and 1 sample, got {steps} and {samples}")
    device = check_device(device)
    images, seen = prepare(frames, mask), seen_texels(mask)
    codes = to_codes(images)

    def encode() -> tuple[TileRanges, list[_Region]]:
        ranges = TileRanges.over_times(codes, seen)
        levels, weight = ranges.levels(codes), _weight(images, codes, ranges, mask)
        regions = []
        for number, area in enumerate(areas(*seen.shape, NETWORK_TEXELS)):
            if seen[area].any():
                everywhere = (slice(None), *area)
                fit = _Fit(levels[everywhere], weight[everywhere], seen[area], sizes, samples, seed + number, device)
                regions.append(fit.run(area, steps))
        return ranges, regions

    def decode(payload: tuple[TileRanges, list[_Region]]) -> np.ndarray:
        ranges, regions = payload
        levels = np.zeros(images.shape, np.float32)
        for region in regions:
            levels[(slice(None), *region.area)][:, region.inside] = _decode(region, sizes, device)
        return ranges.radiance(levels)

    return measure(
        f"ntc-{name}",
        encode,
        decode,
        bytes=lambda payload: len(_stored(*payload)),
        disk_bytes=lambda payload: _disk_bytes(*payload),
        option=lambda payload: f"{sizes.bits:g} bits of latents a texel, {steps:,} steps on {device}",
    )


def _weight(images: np.ndarray, codes: np.ndarray, ranges: TileRanges, mask: np.ndarray) -> np.ndarray:
    """Returns the relative weights of squared errors of levels in the loss, float32 [T, H, W, 3]."""
    height, width = mask.shape
    valid = np.asarray(mask).astype(bool)
    # PSNR is relative to a tile's range of radiance at that hour, over its valid texels.
    span = TileRanges.of(images, valid, by_channel=False).span(height, width)
    slope = GAMMA * np.maximum(codes, _LEAST_CODE) ** (GAMMA - 1.0) * ranges.span(height, width) / span
    ring = np.where(valid, np.float32(1.0), np.float32(_RING_WEIGHT))[..., None]
    return (np.maximum(slope, _LEAST_WEIGHT) * ring).astype(np.float32)


class _Places:
    """Nodes, bilinear weights and positions at which the N decoded texels of a region read the grids of latents."""

    def __init__(self, inside: np.ndarray, sizes: Latents, device: str) -> None:
        self.texels = np.nonzero(inside)
        self.fine_shape, self.fine, _ = self._nodes(inside.shape, sizes.fine_step)
        self.coarse_shape, self.coarse, share = self._nodes(inside.shape, sizes.coarse_step)
        turns = [2.0 * np.pi * k * (i + 0.5) / sizes.coarse_step for k in _TURNS for i in self.texels]
        place = np.stack([wave(turn) for turn in turns for wave in (np.sin, np.cos)], 1)
        self.share, self.place = (torch.from_numpy(a.astype(np.float32)).to(device) for a in (share, place))
        self.fine, self.coarse = (torch.from_numpy(a).to(device) for a in (self.fine, self.coarse))

    def _nodes(self, shape: tuple[int, int], step: int) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
        """Returns a grid's rows and columns, and the texels' nearest 4 nodes [N, 4] and bilinear weights [N, 4]."""
        rows, columns = (-(-size // step) + 1 for size in shape)
        at = [(i + 0.5) / step for i in self.texels]
        (y, x), (fy, fx) = ([part(a) for a in at] for part in (lambda a: a.astype(np.int64), lambda a: a % 1.0))
        corners = [(j, i) for j in (0, 1) for i in (0, 1)]
        nodes = np.stack([(y + j) * columns + x + i for j, i in corners], 1)
        return (rows, columns), nodes, np.stack([(fy if j else 1 - fy) * (fx if i else 1 - fx) for j, i in corners], 1)


class _Fit:
    def __init__(
        self,
        levels: np.ndarray,
        weight: np.ndarray,
        inside: np.ndarray,
        sizes: Latents,
        samples: int,
        seed: int,
        device: str,
    ) -> None:
        self._inside, self._samples, self._device = inside, samples, device
        self._random = torch.Generator(device).manual_seed(seed)
        self._places = _Places(inside, sizes, device)

        def per_texel(values: np.ndarray) -> torch.Tensor:
            rows = values[:, inside].transpose(1, 0, 2)
            return torch.from_numpy(np.ascontiguousarray(rows.reshape(len(rows), -1))).to(device)

        self._levels, self._weight = per_texel(levels), per_texel(weight)
        self._weight /= self._weight.mean()
        grids = (self._places.fine_shape, sizes.fine), (self._places.coarse_shape, sizes.coarse)
        self._latents = [0.25 + 0.5 * self._rand(rows * columns, count) for (rows, columns), count in grids]
        widths = (sizes.inputs, _HIDDEN, _HIDDEN, self._levels.shape[1])
        self._network = []
        for inputs, outputs in itertools.pairwise(widths):
            first = (2.0 * self._rand(inputs, outputs) - 1.0) / math.sqrt(inputs)
            self._network += [first, torch.zeros(outputs, device=device)]
        # It begins at each hour's mean.
        self._network[-2] *= 0.1
        self._network[-1] += self._levels.mean(0)
        for values in (*self._latents, *self._network):
            values.requires_grad_()

    def _rand(self, *shape: int) -> torch.Tensor:
        return torch.rand(*shape, device=self._device, generator=self._random)

    def run(self, area: tuple[slice, slice], steps: int) -> _Region:
        """Fits latents and network together, then the network alone to the rounded latents. Returns the region."""
        freeze = math.ceil(_FREEZE_FROM * steps)
        groups = [{"params": self._latents}, {"params": self._network}]
        adam = torch.optim.Adam(groups, fused=True, eps=1e-10, betas=_BETAS)
        for step in range(freeze):
            share = 0.5 * (1.0 + math.cos(math.pi * step / steps))
            adam.param_groups[0]["lr"] = _LATENT_RATE * share
            adam.param_groups[1]["lr"] = _NETWORK_RATE * max(share, _LAST)
            self._descend(adam, noise=True)
            with torch.no_grad():
                for values in self._latents:
                    values.clamp_(0.0, 1.0)
        with torch.no_grad():
            for values, top in zip(self._latents, _TOPS, strict=True):
                values.mul_(top).round_().div_(top)
        adam = torch.optim.Adam(self._network, fused=True, eps=1e-10, betas=_BETAS)
        for step in range(freeze, steps):
            adam.param_groups[0]["lr"] = _TUNE_RATE * ((steps - step) / (steps - freeze) + 0.01)
            self._descend(adam, noise=False)
        return self._region(area)

    def _descend(self, adam: torch.optim.Adam, noise: bool) -> None:
        chosen = torch.randint(len(self._levels), (self._samples,), device=self._device, generator=self._random)
        random = self._random if noise else None
        error = _answer(*self._latents, self._network, self._places, chosen, random) - self._levels[chosen]
        loss = (self._weight[chosen] * error * error).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()

    def _region(self, area: tuple[slice, slice]) -> _Region:
        places = self._places
        grids = []
        shapes, nodes = (places.fine_shape, places.coarse_shape), (places.fine, places.coarse)
        for values, top, shape, used in zip(self._latents, _TOPS, shapes, nodes, strict=True):
            levels = (values.detach().cpu().numpy() * top + 0.5).astype(np.uint8)
            kept = np.zeros((len(levels), 1), bool)
            kept[used.cpu().numpy()] = True
            grids.append(np.where(kept, levels, np.uint8(0)).reshape(*shape, -1))
        network = [values.detach().cpu().numpy().astype(np.float16) for values in self._network]
        return _Region(area, self._inside, *grids, network)


_TOPS = 2**_FINE_BITS - 1, 2**_COARSE_BITS - 1  # the greatest levels of fine and coarse latents


def _answer(
    fine: torch.Tensor,
    coarse: torch.Tensor,
    network: list[torch.Tensor],
    places: _Places,
    chosen: torch.Tensor,
    random: torch.Generator | None,
) -> torch.Tensor:
    """Computes levels [B, 3 T] at T times for B chosen texels; if `random` is given, training noise is added."""

    def read(latents: torch.Tensor, nodes: torch.Tensor, top: int) -> torch.Tensor:
        values = functional.embedding(nodes[chosen], latents)  # [B, 4, count]
        if random is not None:
            noise = torch.rand(values.shape, device=values.device, generator=random)
            values = values + (noise - 0.5) / top
        return (values - 0.5) * _CENTRE

    between = (read(coarse, places.coarse, _TOPS[1]) * places.share[chosen][..., None]).sum(1)
    x = torch.cat([read(fine, places.fine, _TOPS[0]).flatten(1), between, places.place[chosen]], 1)
    for i in range(0, len(network), 2):
        x = torch.addmm(network[i + 1], x, network[i])
        x = functional.gelu(x, approximate="tanh") if i < len(network) - 2 else x
    return x


@torch.no_grad()
def _decode(region: _Region, sizes: Latents, device: str) -> np.ndarray:
    """Decodes the levels of a region's N texels `inside` at all T times, float32 [T, N, 3]."""
    places = _Places(region.inside, sizes, device)
    grids = zip((region.fine, region.coarse), _TOPS, strict=True)
    latents = [torch.from_numpy(a.reshape(-1, a.shape[-1])).to(device).float() / top for a, top in grids]
    network = [torch.from_numpy(values).to(device).float() for values in region.network]
    chunks = torch.arange(len(places.fine), device=device).split(_CHUNK)
    levels = torch.cat([_answer(*latents, network, places, chosen, None) for chosen in chunks])
    return levels.cpu().numpy().reshape(len(levels), -1, 3).transpose(1, 0, 2)


def _stored(ranges: TileRanges, regions: list[_Region]) -> bytes:
    """Returns the data that a GPU stores, as bytes: packed latents, networks and ranges."""
    parts = [ranges.tobytes()]
    for region in regions:
        parts += [_nibbles(region.fine), region.coarse.tobytes(), *(values.tobytes() for values in region.network)]
    return b"".join(parts)


def _nibbles(levels: np.ndarray) -> bytes:
    """Packs integers below 16 as 4 bits each, two in a byte."""
    flat = np.append(levels.ravel(), np.zeros(levels.size % 2, np.uint8))
    return (flat[::2] | flat[1::2] << 4).tobytes()


def _disk_bytes(ranges: TileRanges, regions: list[_Region]) -> int:
    """Returns the size in bytes under LZMA. Each 4-bit latent takes a byte first, as this compresses better."""
    rest = [ranges.tobytes(), *(values.tobytes() for region in regions for values in region.network)]
    planes = [np.moveaxis(grid, -1, 0).tobytes() for region in regions for grid in (region.fine, region.coarse)]
    packed = sum(len(lzma.compress(part)) for part in (*planes, b"".join(rest)))
    return min(packed, len(_stored(ranges, regions)))
