"""Smoke under its actual lights: one march to each light's own direction or point, instead of six ways weighed.

Six lightmaps, weighed, are 30% off for lights between their axes. The march that they are made by, with its lattice
turned towards a light, costs as much for this light and the opposite one as for two of the six, and has the error of
its step alone. `wlm.smoke.transport.orders` makes light of all orders from such planes.
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
from wlm.smoke.shading import Light, Ramp
from wlm.smoke.transport.lights import AnyLight, checked_albedo, in_voxels
from wlm_kernels.smoke import depth_lattice, march_lights
from wlm_kernels.smoke.march import Medium, View
from wlm_kernels.smoke.settings import March

_CLOSE, _FINEST = 0.1, 0.25  # optical depth between nodes, and voxels


@dataclass(frozen=True, eq=False)
class LitSmoke:
    """Smoke of albedo 1 under each of L lights alone; H x W pixels, linear.

    Attributes:
        lights: The lights.
        planes: float32 tensor [L, H, W], light scattered once: of an irradiance of 4 pi, of a point light an intensity
            of 4 pi.
        opposite: As the planes, under a light from the opposite direction; of a point light 0.
        transparency: float32 tensor [H, W].
        emission: float32 tensor [H, W], or None: it is cold.
        depth: float32 tensor [H, W], distance along the ray to the smoke's surface in the world's unit, 0: none.
        camera: The view.
        march: What it was made by.
        thrown: float32 tensor [H, W, 3], light that its own fire throws on it and that it scatters to the camera, grey
            but for the smoke's albedo; None: it is cold, or light is scattered once alone.
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
        """The light scattered once, of all lights in their colours, and the smoke's own.

        Args:
            albedo: R, G, B, the share of light that a scattering leaves, 0 to 1.
            background: Linear light behind the smoke, [H, W, 3] or one colour; None: the smoke's light alone.
            ramp: Colour of the emission; None: grey, as it is.

        Returns:
            float32 [H, W, 3].

        Raises:
            ValueError: Not an albedo, or a light's visibility has another shape.
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
        """Puts light of each light, [L, H, W, 3], the emission and a background into one picture, as `shade` does."""
        image = torch.zeros((*self.transparency.shape, 3), dtype=torch.float32, device=planes.device)
        for light, plane in zip(self.lights, planes, strict=True):
            colour = light.irradiance if isinstance(light, Light) else light.intensity
            visibility = light.visibility if isinstance(light, Light) else None
            if visibility is not None:
                if visibility.shape != image.shape[:2]:
                    raise ValueError(f"visibility: expected {tuple(image.shape[:2])}, got {tuple(visibility.shape)}")
                plane = plane * visibility[..., None]
            _add(image, plane, np.asarray(colour) / (4 * math.pi))
        if self.emission is not None:
            glow = self.emission[..., None] if ramp is None else ramp(self.emission)
            image += glow
            if self.thrown is not None:
                # In the mean colour of the fire that is seen.
                whole = self.emission.sum().clamp(min=1e-12)
                image += self.thrown * (1.0 if ramp is None else glow.sum((0, 1)) / whole)
        if background is None:
            return image
        if isinstance(background, torch.Tensor) or np.ndim(background) > 1:
            return image + self.transparency[..., None] * torch.as_tensor(background).to(image)
        return _add(image, self.transparency[..., None].expand_as(image), background)


def _add(image: torch.Tensor, planes: torch.Tensor, colour: Sequence[float] | np.ndarray) -> torch.Tensor:
    """Adds planes [H, W, 3] times a colour, without a copy to the device, which would wait for it."""
    for channel, value in enumerate(colour):
        image[..., channel].add_(planes[..., channel], alpha=float(value))
    return image


def fine_march(volume: DensityVolume, g: float = 0.0) -> March:
    """A march whose light is within 0.5% of the whole: in steps of a voxel, or of a tenth of optical depth where
    the smoke is densest, but for a quarter of a voxel at least.

    Args:
        volume: The smoke.
        g: Mean cosine of the Henyey-Greenstein phase function.
    """
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
    """Marches through smoke to each of its lights.

    Args:
        volume: The smoke.
        camera: Any, outside the smoke or inside.
        lights: Any number.
        march: Its steps, the distance between the lattice's nodes, its phase function. None: `fine_march`.
        shadow: Extinction on the ways to the lights over that along the camera's rays; 1 is smoke as it is, less an
            octave of light that was scattered more often.

    Returns:
        The light on the smoke's device.

    Raises:
        ValueError: A light without direction, or of a colour that isn't one.
    """
    march = fine_march(volume) if march is None else march
    with marching(volume, camera, march, shadow) as scene:
        return light_in(scene, volume, camera, lights)


Depths = tuple[depth_lattice.Lattice, wp.array]
"""Optical depths to a light and to the opposite one, at the nodes of a lattice."""


@dataclass(frozen=True, eq=False)
class Marching:
    """A march through one volume from one side, for any number of lights: the map of its bricks is made once."""

    medium: Medium
    view: View
    march: March
    shadow: float

    def reach(self, place: Sequence[float], radius: float | None) -> Depths:
        """Optical depths to a light, see `depth_lattice.reach`."""
        return depth_lattice.reach(self.medium, place, radius, self.march)

    def light(self, depths: Depths, out: torch.Tensor) -> None:
        """Light scattered once, see `march_lights.light`; `out` is float32 [2, H, W], for a point light [1, H, W]."""
        march_lights.light(self.medium, self.view, depths, self.march, self.shadow, to_warp(out))

    def unlit(self) -> torch.Tensor:
        """Transparency, emission and depth, [3, H, W]."""
        size = (len(march_lights.PLANES), self.view.height, self.view.width)
        out = torch.empty(size, device=wp.device_to_torch(self.medium.density.device))
        march_lights.unlit(self.medium, self.view, self.march, to_warp(out))
        return out


@contextmanager
def marching(volume: DensityVolume, camera: Camera, march: March, shadow: float = 1.0) -> Iterator[Marching]:
    """Opens a march, on the smoke's device; arguments as for `light_smoke`."""
    with stream(device_name(volume.device)):
        yield Marching(medium_of(volume).in_bricks(), camera.view(volume), march, shadow)


def light_in(
    scene: Marching,
    volume: DensityVolume,
    camera: Camera,
    lights: Sequence[AnyLight],
    visit: Callable[[int, Depths], None] | None = None,
) -> LitSmoke:
    """As `light_smoke`, in a march that has been opened.

    Args:
        scene: The march.
        volume, camera, lights: As for `light_smoke`.
        visit: Called with each light's number and the depths to it, which aren't kept.
    """
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
