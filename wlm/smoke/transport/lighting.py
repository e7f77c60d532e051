"""Smoke under lights from any direction and point lights: one march per light, instead of weighted lightmaps.

Six weighted lightmaps have an error for lights between their axes. A march whose lattice of optical depths is turned
towards a light has only the error of its step. `wlm.smoke.transport.orders` adds multiple scattering to these results.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp
from wlm.smoke.camera import Camera
from wlm.smoke.march.launch import medium_of
from wlm.smoke.shading import AnyLight, Light, Ramp, checked_albedo, glow_of, in_voxels
from wlm_kernels.smoke import depth_lattice, marches
from wlm_kernels.smoke.march import Medium, View
from wlm_kernels.smoke.settings import March

_CLOSE, _FINEST = 0.1, 0.25  # optical depth per step, and least step in voxels


@dataclass(frozen=True, eq=False)
class LitSmoke:
    """Linear images, H x W pixels, of smoke of albedo 1 under each of L lights alone.

    Attributes:
        lights: The lights.
        planes: float32 tensor [L, H, W], light scattered once under a light of irradiance 4 pi (point light: of
            intensity 4 pi).
        opposite: Like `planes`, but under a light from the opposite direction; 0 for a point light.
        transparency: float32 tensor [H, W].
        emission: float32 tensor [H, W]; None: the smoke is cold.
        depth: float32 tensor [H, W], distance along the ray to the smoke's surface in world units; 0: no surface.
        camera: Camera of the images.
        march: Settings of the march that computed them.
        thrown: float32 tensor [H, W, 3], light that the smoke emits and scatters to the camera, not yet multiplied by
            the colour of the emission; None: the smoke is cold, or this light was not computed.
    """

    lights: tuple[AnyLight, ...]
    planes: torch.Tensor
    opposite: torch.Tensor
    transparency: torch.Tensor
    emission: torch.Tensor | None
    depth: torch.Tensor
    camera: Camera
    march: March
    thrown: torch.Tensor | None = None

    def shade(
        self,
        *,
        albedo: Sequence[float] = (1.0, 1.0, 1.0),
        background: torch.Tensor | Sequence[float] | None = None,
        ramp: Ramp | None = None,
    ) -> torch.Tensor:
        """Returns the picture of the smoke: light of all lights, scattered once, plus the emission.

        Args:
            albedo: R, G, B, share of light that survives a scattering, 0 to 1.
            background: Linear light behind the smoke, [H, W, 3] or one colour; None: only the smoke's light.
            ramp: Colour of the emission; None: grey.

        Returns:
            float32 [H, W, 3].

        Raises:
            ValueError: The albedo is not three numbers from 0 to 1.
        """
        planes = torch.stack([float(value) * self.planes for value in checked_albedo(albedo)], -1)
        return self.compose(planes, background=background, ramp=ramp)

    def compose(
        self,
        planes: torch.Tensor,
        *,
        background: torch.Tensor | Sequence[float] | None = None,
        ramp: Ramp | None = None,
    ) -> torch.Tensor:
        """Adds up images [L, H, W, 3] of L lights, the emission and a background; returns a picture as `shade` does."""
        image = torch.zeros((*self.transparency.shape, 3), dtype=torch.float32, device=planes.device)
        for light, plane in zip(self.lights, planes, strict=True):
            colour = light.irradiance if isinstance(light, Light) else light.intensity
            _add(image, plane, np.asarray(colour) / (4 * math.pi))
        if self.emission is not None:
            image += glow_of(self.emission, ramp, self.thrown)
        if background is None:
            return image
        if isinstance(background, torch.Tensor) or np.ndim(background) > 1:
            return image + self.transparency[..., None] * torch.as_tensor(background).to(image)
        return _add(image, self.transparency[..., None].expand_as(image), background)


def _add(image: torch.Tensor, planes: torch.Tensor, colour: Sequence[float] | np.ndarray) -> torch.Tensor:
    """Adds planes [H, W, 3] times a colour to an image, without a copy of the colour to the GPU, which would wait."""
    for channel, value in enumerate(colour):
        image[..., channel].add_(planes[..., channel], alpha=float(value))
    return image


def fine_march(volume: DensityVolume, g: float = 0.0) -> March:
    """Returns settings of a march with an error of about 0.5%. Its step is at most a voxel, and at most an optical
    depth of 0.1 in the densest smoke, but at least 1/4 voxel."""
    densest = float(volume.density.max()) * volume.extinction * volume.voxel
    return March(step=min(max(_CLOSE / max(densest, 1e-30), _FINEST), 1.0), jitter=0.0, g=g)


def light_smoke(
    volume: DensityVolume,
    camera: Camera,
    lights: Sequence[AnyLight],
    march: March | None = None,
    *,
    shadow: float = 1.0,
) -> LitSmoke:
    """Computes light that was scattered once, by a separate march for each light.

    Args:
        volume: The smoke; its `solid` shadows it, and camera rays end there.
        camera: Any camera, outside the smoke or inside.
        lights: Any number of lights.
        march: Settings of the marches; None: those of `fine_march`.
        shadow: Factor of the extinction on the ways to the lights; 1 is physical, a smaller value approximates an
            octave of multiple scattering.

    Returns:
        The light on the smoke's device.

    Raises:
        ValueError: A light has a direction of length 0, or a negative or infinite colour.
    """
    march = fine_march(volume) if march is None else march
    with marching(volume, camera, march, shadow) as scene:
        return light_in(scene, volume, camera, lights)


Depths = tuple[depth_lattice.Lattice, wp.array]
"""A lattice, and optical depths at its nodes to a light and to the opposite light."""


@dataclass(frozen=True, eq=False)
class Marching:
    """A prepared march from a camera through a volume, for any number of lights: empty bricks are found only once."""

    medium: Medium
    view: View
    march: March
    shadow: float

    def reach(self, place: Sequence[float], radius: float | None) -> Depths:
        """Computes the optical depths from the smoke to a light; arguments as for `depth_lattice.reach`."""
        return depth_lattice.reach(self.medium, place, radius, self.march)

    def light(self, depths: Depths, out: torch.Tensor) -> None:
        """Computes light scattered once into `out`, float32 [1 or 2, H, W]: from the light and the opposite light."""
        marches.light(self.medium, self.view, depths, self.march, self.shadow, to_warp(out))

    def unlit(self) -> torch.Tensor:
        """Returns the planes that need no light: transparency, emission and depth, [3, H, W]."""
        size = (len(marches.UNLIT_PLANES), self.view.height, self.view.width)
        out = torch.empty(size, device=wp.device_to_torch(self.medium.density.device))
        marches.unlit(self.medium, self.view, self.march, to_warp(out))
        return out


@contextmanager
def marching(volume: DensityVolume, camera: Camera, march: March, shadow: float = 1.0) -> Iterator[Marching]:
    """Prepares a march on the smoke's device; arguments as for `light_smoke`."""
    with stream(device_name(volume.device)):
        yield Marching(medium_of(volume).in_bricks(), camera.view(volume), march, shadow)


def light_in(
    scene: Marching,
    volume: DensityVolume,
    camera: Camera,
    lights: Sequence[AnyLight],
    visit: Callable[[int, Depths], None] | None = None,
) -> LitSmoke:
    """Computes light scattered once from each light, in a prepared march; `visit` gets each light's optical depths."""
    planes = torch.zeros(2, len(lights), camera.height, camera.width, device=volume.device)
    for n, light in enumerate(lights):
        place, _, radius = in_voxels(light, volume)
        depths = scene.reach(place, radius)
        scene.light(depths, planes[:, n] if radius is None else planes[:1, n])
        if radius is not None:
            planes[0, n] /= volume.voxel**2
        if visit is not None:
            visit(n, depths)
    transparency, emission, depth = scene.unlit()
    hot = emission if volume.temperature is not None else None
    return LitSmoke(tuple(lights), *planes, transparency, hot, depth, camera, scene.march)
