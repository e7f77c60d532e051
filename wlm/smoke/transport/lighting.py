"""Smoke under its actual lights: one march to each light's own direction or point, instead of six ways weighed.

Six lightmaps, weighed, are 30% off for lights between their axes. The march that they are made by, with its lattice
turned towards a light, costs as much for this light and the opposite one as for two of the six, and has the error of
its step alone. `wlm.smoke.transport.filtering` makes light of all orders from such planes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.marching import run
from wlm.smoke.shading import Light, Ramp
from wlm.smoke.transport.lights import AnyLight, checked_albedo, in_voxels
from wlm_kernels.smoke import march_lights
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
    """

    lights: tuple[AnyLight, ...]
    planes: torch.Tensor
    opposite: torch.Tensor
    transparency: torch.Tensor
    emission: torch.Tensor | None
    depth: torch.Tensor
    camera: Camera
    march: March

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
        colour = torch.tensor(checked_albedo(albedo)).to(self.planes)
        return self.compose(self.planes[..., None] * colour, background=background, ramp=ramp)

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
            part = plane * torch.tensor(np.asarray(colour) / (4 * math.pi)).to(plane)
            visibility = light.visibility if isinstance(light, Light) else None
            if visibility is not None:
                if visibility.shape != image.shape[:2]:
                    raise ValueError(f"visibility: expected {tuple(image.shape[:2])}, got {tuple(visibility.shape)}")
                part = part * visibility[..., None]
            image += part
        if self.emission is not None:
            image += self.emission[..., None] if ramp is None else ramp(self.emission)
        if background is None:
            return image
        return image + self.transparency[..., None] * torch.as_tensor(background).to(image)


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
    size = (len(lights), camera.height, camera.width)
    planes, opposite = torch.zeros(2, *size, device=volume.device)
    for n, light in enumerate(lights):
        place, _, radius = in_voxels(light, volume)
        if radius is None:
            planes[n], opposite[n] = run(march_lights.light, volume, camera, (2,), place, None, march, shadow)
        else:
            one = run(march_lights.light, volume, camera, (1,), place, radius, march, shadow)[0]
            planes[n] = one / volume.voxel**2
    transparency, emission, depth = run(march_lights.seen, volume, camera, (len(march_lights.PLANES),), march)
    hot = emission if volume.temperature is not None else None
    return LitSmoke(tuple(lights), planes, opposite, transparency, hot, depth, camera, march)
