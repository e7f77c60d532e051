"""Multiple scattering by diffusion: accurate inside thick smoke, and approximate elsewhere.

Deep in smoke light has been scattered so often that it diffuses (Stam 1995, "Multiple scattering as a diffusion
process"). A coarse grid is enough for this light. Light that was scattered once, and the extinction along camera rays,
are computed at the resolution of the smoke.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import to_warp
from wlm.smoke.march.launch import medium_of
from wlm.smoke.shading import AnyLight, PointLight, in_voxels
from wlm.smoke.transport.lighting import Depths, Marching
from wlm_kernels.smoke import diffusion

CELLS = 32
"""Cells of the diffusion grid along the longest edge."""

_LEAST_ALBEDO = 0.01
_AT_ONCE = 3  # albedos solved together
_FADE = 0.25  # distance from the box, in edges of the box, over which diffusion fades out


def share_of(light: AnyLight, volume: DensityVolume) -> float:
    """Returns the share of a light's result that diffusion gives: 1 for a point light in the box, 0 far outside."""
    if not isinstance(light, PointLight):
        return 0.0
    place = in_voxels(light, volume)[0]
    beside = np.maximum(np.maximum(-place, place - np.asarray(volume.shape)), 0.0)
    return max(0.0, 1.0 - float(np.linalg.norm(beside)) / (_FADE * max(volume.shape)))


class Spreading:
    """Computes the diffusion of several lights, which are added one by one when a march has their optical depths."""

    def __init__(self, scene: Marching, volume: DensityVolume, lights: Sequence[AnyLight]) -> None:
        """Averages the smoke over the cells of the coarse grid; no light has been added yet."""
        self._scene, self._volume, self._lights = scene, volume, tuple(lights)
        self._coarse = CoarseSmoke(volume)
        self._source = torch.zeros(len(lights), *self._coarse.extinction.shape, device=volume.device)

    def add(self, number: int, depths: Depths) -> None:
        """Adds light `number`: the direct light that each coarse cell extinguishes is the source of its diffusion."""
        light, out = self._lights[number], self._source[number]
        if isinstance(light, PointLight):
            place, _, radius = in_voxels(light, self._volume)
            self._coarse.around(self._scene, place, radius, out)
        else:
            self._coarse.lit(self._scene, depths, out)

    def render(self, albedos: Sequence[float]) -> tuple[torch.Tensor, torch.Tensor]:
        """Computes the light that was scattered more than once and reaches the camera, for A albedos.

        Returns the light divided by the squared albedo, float32 [2, L, A, H, W], for L lights of irradiance 4 pi (point
        lights: intensity): all light, and its part from thin smoke. Also the opacity of thin smoke, float32 [H, W]; see
        `CoarseSmoke.render`.
        """
        size = (self._scene.view.height, self._scene.view.width)
        made = torch.empty(2, len(self._lights), len(albedos), *size, device=self._source.device)
        thin = torch.zeros(size, device=self._source.device)
        for first in range(0, len(albedos), _AT_ONCE):
            # Divided by the squared albedo, the light hardly depends on albedos near 0.
            some = [max(albedo, _LEAST_ALBEDO) for albedo in albedos[first : first + _AT_ONCE]]
            found, thin = self._coarse.render(self._scene, self._coarse.spread(self._source, some))
            for n, albedo in enumerate(some):
                torch.div(found[:, n :: len(some)], albedo, out=made[:, :, first + n])
        for n, light in enumerate(self._lights):
            if isinstance(light, PointLight):
                made[:, n] /= self._volume.voxel**2
        return made, thin


def thrown_by_fire(scene: Marching, volume: DensityVolume, albedos: Sequence[float]) -> torch.Tensor:
    """Computes the light that hot smoke emits and scatters to the camera of a march, [A, H, W] for one to three
    albedos."""
    coarse = CoarseSmoke(volume)
    source = coarse.mean(hot=True).mul_(4.0 * math.pi * volume.emission * volume.voxel)
    # Emitted light has not been scattered yet: `spread` multiplies it by the albedo.
    return coarse.render(scene, coarse.spread(source[None], albedos))[0][0]


class CoarseSmoke:
    """Smoke on the coarse grid of the diffusion: the smoke at full resolution, the mean extinction per voxel of each
    cell, float32 tensor [X, Y, Z], and the edges of a cell along x, y and z in voxels."""

    def __init__(self, volume: DensityVolume, cells: int = CELLS) -> None:
        """Averages the smoke over `cells` cells along its longest edge; to be called inside `wlm.interop.stream`."""
        self.medium, self._device = medium_of(volume), volume.device
        longest = max(volume.shape)
        self._counts = [max(1, round(cells * n / longest)) for n in volume.shape]
        self.edges = tuple(n / count for n, count in zip(volume.shape, self._counts, strict=True))
        self.extinction = self.mean().mul_(volume.extinction * volume.voxel)

    def mean(self, hot: bool = False) -> torch.Tensor:
        """Returns the mean of the volume's density, or of its temperature, over each coarse cell, float32 [X, Y, Z]."""
        # Bricks that are known as empty have no smoke, but may be hot.
        medium = replace(self.medium, bricks=None) if hot else self.medium
        out = torch.empty(self._counts, device=self._device)
        diffusion.mean(medium, medium.temperature if hot else medium.density, wp.vec3(*self.edges), to_warp(out))
        return out

    def spread(self, source: torch.Tensor, albedos: Sequence[float]) -> torch.Tensor:
        """Computes the fluence, the light from all directions, of light that was scattered at least once, by diffusion.

        `source`, float32 [L, X, Y, Z], is the direct light of L lights that each cell extinguishes, per volume. Returns
        float32 [L * A, X, Y, Z] for one to three albedos: all albedos of the first light, then all of the second, and
        so on.
        """
        light = torch.empty(len(source) * len(albedos), *self.extinction.shape, device=source.device)
        if not len(light):
            return light
        extinction, source, out = (to_warp(part) for part in (self.extinction, source.contiguous(), light))
        three = wp.vec3(*albedos, *[0.0] * (3 - len(albedos)))
        diffusion.spread(self.medium, extinction, source, wp.vec3(*self.edges), three, len(albedos), out)
        return light

    def render(self, scene: Marching, light: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Computes the light that smoke of albedo 1 sends to the camera of a march, for N fluences from `spread`, [N,
        X, Y, Z].

        Returns all light and the light from thin smoke, float32 [2, N, H, W], and the opacity of thin smoke, float32
        [H, W]. For thin smoke each sample is weighted by the transparency of a whole cell of its density.
        """
        size = (scene.view.height, scene.view.width)
        out, thin = torch.empty(2, len(light), *size, device=light.device), torch.zeros(size, device=light.device)
        if len(light):
            arrays = (to_warp(part) for part in (light, out, thin))
            diffusion.gather(scene.medium, scene.view, scene.march, wp.vec3(*self.edges), *arrays)
        return out, thin

    def lit(self, scene: Marching, depths: Depths, out: torch.Tensor) -> None:
        """Computes the direct light that each cell extinguishes from a light at infinity of irradiance 4 pi, float32
        [X, Y, Z], into `out`; `depths` are those to the light, from `scene.reach`."""
        cell = wp.vec3(*self.edges)
        diffusion.stop(scene.medium, depths, cell, scene.march.step, to_warp(out))

    def around(self, scene: Marching, place: Sequence[float], radius: float, out: torch.Tensor) -> None:
        """Adds to `out`, float32 [X, Y, Z], the direct light that each cell extinguishes from a point light at a place
        in voxels; its irradiance is 4 pi at a distance of one voxel."""
        step = max(0.5, min(self.edges) / 8)
        power = 16.0 * math.pi**2 / math.prod(self.edges)
        cell = wp.vec3(*self.edges)
        diffusion.shoot(scene.medium, wp.vec3(*place), radius, step, cell, power, to_warp(out))
