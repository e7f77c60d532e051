"""Light of all orders by diffusion: of a point light in the smoke, whose light goes all ways and not one.

Deep in smoke light has been scattered so often that it only spreads, from where there is more to where there is less
(Stam 1995, "Multiple scattering as a diffusion process"). A grid of few cells holds all of it that there is to see; the
smoke before it and light that was scattered once stay as fine as they are.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import to_warp
from wlm.smoke.marching import medium_of
from wlm.smoke.transport.lighting import Marching
from wlm.smoke.transport.lights import AnyLight, PointLight, in_voxels
from wlm_kernels.smoke import diffusion

CELLS = 32
"""Of a grid of diffusion, along the longest edge."""


_FADE = 0.25  # edges of the smoke's box, over which diffusion fades out beside it


def share_of(light: AnyLight, volume: DensityVolume) -> float:
    """How much of a light's further orders is diffusion's: all in the smoke's box, and nothing far beside it."""
    if not isinstance(light, PointLight):
        return 0.0
    place = in_voxels(light, volume)[0]
    beside = np.maximum(np.maximum(-place, place - np.asarray(volume.shape)), 0.0)
    return max(0.0, 1.0 - float(np.linalg.norm(beside)) / (_FADE * max(volume.shape)))


def scattered_again(
    scene: Marching, volume: DensityVolume, light: PointLight, albedos: Sequence[float]
) -> torch.Tensor:
    """What a camera sees of a point light's further orders, of an intensity of 4 pi, [A, H, W].

    Args:
        scene: A march through the smoke.
        volume: The smoke.
        light: The light.
        albedos: One to three.
    """
    place, _, radius = in_voxels(light, volume)
    coarse = CoarseSmoke(volume)
    seen = coarse.seen(scene, coarse.spread(coarse.around(scene, place, radius), albedos))
    return torch.stack([albedo * plane for albedo, plane in zip(albedos, seen, strict=True)]) / volume.voxel**2


def thrown_by_fire(scene: Marching, volume: DensityVolume, albedos: Sequence[float]) -> torch.Tensor:
    """What hot smoke scatters to a camera of the light that it gives off, [A, H, W]; arguments as above."""
    coarse = CoarseSmoke(volume)
    source = coarse.mean(volume.temperature).mul_(4.0 * math.pi * volume.emission * volume.voxel)
    # Light that is given off was scattered by nothing yet: `spread` takes an albedo's share of it, as the camera would.
    return coarse.seen(scene, coarse.spread(source[None], albedos))


class CoarseSmoke:
    """Smoke in cells, in which light spreads.

    Attributes:
        medium: The smoke itself.
        extinction: float32 tensor [X, Y, Z], per voxel, the mean over each cell.
        edges: Of a cell, in voxels.
    """

    def __init__(self, volume: DensityVolume, cells: int = CELLS) -> None:
        """Makes it, inside `wlm.interop.stream`.

        Args:
            volume: The smoke.
            cells: As `CELLS`.
        """
        self.medium = medium_of(volume)
        longest = max(volume.shape)
        self._counts = [max(1, round(cells * n / longest)) for n in volume.shape]
        self.edges = tuple(n / count for n, count in zip(volume.shape, self._counts, strict=True))
        self.extinction = self.mean(volume.density).mul_(volume.extinction * volume.voxel)

    def mean(self, voxels: torch.Tensor) -> torch.Tensor:
        """Means over the cells of a grid of the smoke's voxels, float32 [X, Y, Z]."""
        mean = voxels.float()
        for count in self._counts:
            # Over one axis, which then is the last: after three the first is the first again.
            mean = torch.tensordot(mean, _shares(mean.shape[0], count, mean.device), ([0], [0]))
        return mean.contiguous()

    def spread(self, source: torch.Tensor, albedos: Sequence[float]) -> torch.Tensor:
        """The fluence of light that was scattered at least once.

        Args:
            source: float32 tensor [L, X, Y, Z], what each cell stops of light that comes straight from its source,
                per volume.
            albedos: One to three.

        Returns:
            float32 tensor [L * A, X, Y, Z], the albedos of each source one after another.
        """
        light = torch.zeros(len(source) * len(albedos), *self.extinction.shape, device=source.device)
        extinction, source, out = (to_warp(part) for part in (self.extinction, source.contiguous(), light))
        three = wp.vec3(*albedos, *[0.0] * (3 - len(albedos)))
        diffusion.spread(self.medium, extinction, source, wp.vec3(*self.edges), three, len(albedos), out)
        return light

    def seen(self, scene: Marching, light: torch.Tensor) -> torch.Tensor:
        """What smoke of albedo 1 in fluences [N, X, Y, Z] sends to the camera of a march, [N, H, W]."""
        out = torch.empty(len(light), scene.view.height, scene.view.width, device=light.device)
        march = scene.march
        settings = (march.step, march.cutoff, wp.vec3(*self.edges))
        diffusion.gather(scene.medium, scene.view, *settings, to_warp(light), to_warp(out), bricks=scene.bricks)
        return out

    def around(self, scene: Marching, place: Sequence[float], radius: float) -> torch.Tensor:
        """What cells stop of the light that comes straight from a point light, [1, X, Y, Z].

        Args:
            scene: A march through the smoke.
            place, radius: Of the light, in voxels; its irradiance is 4 pi at a distance of one voxel.
        """
        out = torch.zeros(self.extinction.shape, device=self.extinction.device)
        step = max(0.5, min(self.edges) / 8)
        power = 16.0 * math.pi**2 / math.prod(self.edges)
        cell = wp.vec3(*self.edges)
        diffusion.shoot(scene.medium, wp.vec3(*place), radius, step, cell, power, to_warp(out), bricks=scene.bricks)
        return out[None]


def _shares(voxels: int, cells: int, device: torch.device) -> torch.Tensor:
    """Of each cell's mean along an axis what each voxel has, [voxels, cells]."""
    low = torch.arange(voxels, device=device)[:, None]
    first = torch.arange(cells, device=device) * (voxels / cells)
    over = torch.minimum(low + 1.0, first + voxels / cells) - torch.maximum(low.float(), first)
    return over.clamp(min=0.0) * (cells / voxels)
