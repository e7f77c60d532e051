"""Light of all orders by diffusion: as good as all of it in the middle of thick smoke, and near it elsewhere.

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
from wlm.smoke.march.launch import medium_of
from wlm.smoke.transport.lighting import Depths, Marching
from wlm.smoke.transport.lights import AnyLight, PointLight, in_voxels
from wlm_kernels.smoke import diffusion

CELLS = 32
"""Of a grid of diffusion, along the longest edge."""

_LEAST_ALBEDO = 0.01
_AT_ONCE = 3  # albedos
_FADE = 0.25  # edges of the smoke's box, over which diffusion fades out beside it


def share_of(light: AnyLight, volume: DensityVolume) -> float:
    """How much of a light's further orders is diffusion's: all in the smoke's box, and nothing far beside it."""
    if not isinstance(light, PointLight):
        return 0.0
    place = in_voxels(light, volume)[0]
    beside = np.maximum(np.maximum(-place, place - np.asarray(volume.shape)), 0.0)
    return max(0.0, 1.0 - float(np.linalg.norm(beside)) / (_FADE * max(volume.shape)))


class Spreading:
    """What diffusion makes of lights, as a march goes to one after the other."""

    def __init__(self, scene: Marching, volume: DensityVolume, lights: Sequence[AnyLight]) -> None:
        """Begins without light.

        Args:
            scene: A march through the smoke.
            volume: The smoke.
            lights: Any number.
        """
        self._scene, self._volume, self._lights = scene, volume, tuple(lights)
        self._coarse = CoarseSmoke(volume)
        self._source = torch.zeros(len(lights), *self._coarse.extinction.shape, device=volume.device)

    def add(self, number: int, depths: Depths) -> None:
        """Leaves what comes straight from a light to the cells that stop it."""
        light, out = self._lights[number], self._source[number]
        if isinstance(light, PointLight):
            place, _, radius = in_voxels(light, self._volume)
            self._coarse.around(self._scene, place, radius, out)
        else:
            self._coarse.lit(self._scene, depths, out)

    def seen(self, albedos: Sequence[float]) -> tuple[torch.Tensor, torch.Tensor]:
        """What a camera sees of it.

        Lights have an irradiance of 4 pi, point lights an intensity of 4 pi.

        Args:
            albedos: Any number.

        Returns:
            Light that was scattered more than once over the square of its albedo, float32 [2, L, A, H, W]: all of it,
            and what thin smoke sends; and the opacity of thin smoke, float32 [H, W], as `CoarseSmoke.seen` has it.
        """
        size = (self._scene.view.height, self._scene.view.width)
        made = torch.empty(2, len(self._lights), len(albedos), *size, device=self._source.device)
        thin = torch.zeros(size, device=self._source.device)
        for first in range(0, len(albedos), _AT_ONCE):
            # Over its square it hardly changes where the albedo is next to nothing.
            some = [max(albedo, _LEAST_ALBEDO) for albedo in albedos[first : first + _AT_ONCE]]
            seen, thin = self._coarse.seen(self._scene, self._coarse.spread(self._source, some))
            for n, albedo in enumerate(some):
                torch.div(seen[:, n :: len(some)], albedo, out=made[:, :, first + n])
        for n, light in enumerate(self._lights):
            if isinstance(light, PointLight):
                made[:, n] /= self._volume.voxel**2
        return made, thin


def thrown_by_fire(scene: Marching, volume: DensityVolume, albedos: Sequence[float]) -> torch.Tensor:
    """What hot smoke scatters to a camera of the light that it gives off, [A, H, W].

    Args:
        scene: A march through the smoke.
        volume: The smoke.
        albedos: One to three.
    """
    coarse = CoarseSmoke(volume)
    source = coarse.mean(volume.temperature).mul_(4.0 * math.pi * volume.emission * volume.voxel)
    # Light that is given off was scattered by nothing yet: `spread` takes an albedo's share of it, as the camera would.
    return coarse.seen(scene, coarse.spread(source[None], albedos))[0][0]


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
        light = torch.empty(len(source) * len(albedos), *self.extinction.shape, device=source.device)
        if not len(light):
            return light
        extinction, source, out = (to_warp(part) for part in (self.extinction, source.contiguous(), light))
        three = wp.vec3(*albedos, *[0.0] * (3 - len(albedos)))
        diffusion.spread(self.medium, extinction, source, wp.vec3(*self.edges), three, len(albedos), out)
        return light

    def seen(self, scene: Marching, light: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What smoke of albedo 1 sends to the camera of a march.

        Args:
            scene: The march.
            light: float32 tensor [N, X, Y, Z], fluences.

        Returns:
            float32 [2, N, H, W], all of it and what thin smoke sends, where each place counts by the transparency of a
            cell of smoke as dense as there; and likewise the opacity of thin smoke, float32 [H, W].
        """
        size = (scene.view.height, scene.view.width)
        out, thin = torch.empty(2, len(light), *size, device=light.device), torch.zeros(size, device=light.device)
        if len(light):
            arrays = (to_warp(part) for part in (light, out, thin))
            diffusion.gather(scene.medium, scene.view, scene.march, wp.vec3(*self.edges), *arrays)
        return out, thin

    def lit(self, scene: Marching, depths: Depths, out: torch.Tensor) -> None:
        """What cells stop of the light that comes straight from infinitely far off, of an irradiance of 4 pi.

        Args:
            scene: A march through the smoke.
            depths: Of the light, by `scene`.
            out: float32 tensor [X, Y, Z], written.
        """
        cell = wp.vec3(*self.edges)
        diffusion.stop(scene.medium, depths, cell, scene.march.step, to_warp(out))

    def around(self, scene: Marching, place: Sequence[float], radius: float, out: torch.Tensor) -> None:
        """Adds what cells stop of the light that comes straight from a point light.

        Args:
            scene: A march through the smoke.
            place, radius: Of the light, in voxels; its irradiance is 4 pi at a distance of one voxel.
            out: float32 tensor [X, Y, Z].
        """
        step = max(0.5, min(self.edges) / 8)
        power = 16.0 * math.pi**2 / math.prod(self.edges)
        cell = wp.vec3(*self.edges)
        diffusion.shoot(scene.medium, wp.vec3(*place), radius, step, cell, power, to_warp(out))


def _shares(voxels: int, cells: int, device: torch.device) -> torch.Tensor:
    """Of each cell's mean along an axis what each voxel has, [voxels, cells]."""
    low = torch.arange(voxels, device=device)[:, None]
    first = torch.arange(cells, device=device) * (voxels / cells)
    over = torch.minimum(low + 1.0, first + voxels / cells) - torch.maximum(low.float(), first)
    return over.clamp(min=0.0) * (cells / voxels)
