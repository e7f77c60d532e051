"""Six-way lightmaps of one frame, which ray marches and the network compute, and their shading under lights.

A lightmap stores the light that smoke of albedo 1 sends to the camera under one light of irradiance 4 pi from the map's
direction. With isotropic scattering it is at most 1/2 under the front light and 1 under other lights. All values are
linear. Lightmaps are orthographic, the only view of a flat billboard.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.smoke.camera import DIRECTIONS, Camera, weights
from wlm.smoke.shading import Light, Ramp, checked_albedo, checked_colour, glow_of

_DARKEST = 1e-20
_LEAST_SHIFT = 1e-3  # of the image, between the centres of light of opposite lightmaps


@dataclass(frozen=True)
class StepError:
    """Difference between the lightmaps of two marches, of which the finer has half the step: the largest difference of
    a pixel in any lightmap, and in its transparency; and the root mean square of the differences divided by that of the
    lightmaps, 0 if these are black.

    The error falls with the square of the step, so that the error of the finer one is about a third of the difference.
    """

    largest: float
    rms: float
    transparency: float


@dataclass(frozen=True, eq=False)
class SixWay:
    """Six-way lightmaps of one frame; H x W pixels.

    Attributes:
        lightmaps: float32 tensor [6, H, W], in the order of `wlm.smoke.camera.DIRECTIONS`.
        transparency: float32 tensor [H, W]; None: unknown, as in files without it.
        emission: float32 tensor [H, W], light that the smoke emits; None: the smoke is cold.
        camera: Camera of the lightmaps; None: unknown, as for an engine's textures.
        depth: float32 tensor [H, W], distance along the ray to the smoke's surface in the world's unit, 0 where there
            is none; None: unknown.
        error: Estimate of the march's error; None: not estimated.
        method: The method that made them, in words; empty: unknown, as in files.
    """

    lightmaps: torch.Tensor
    transparency: torch.Tensor | None
    emission: torch.Tensor | None = None
    camera: Camera | None = None
    depth: torch.Tensor | None = None
    error: StepError | None = None
    method: str = ""

    def __post_init__(self) -> None:
        if self.lightmaps.ndim != 3 or self.lightmaps.shape[0] != 6:
            raise ValueError(f"lightmaps: expected shape [6, H, W], got {tuple(self.lightmaps.shape)}")
        size = tuple(self.lightmaps.shape[1:])
        for name in ("transparency", "emission", "depth"):
            plane = getattr(self, name)
            if plane is not None and tuple(plane.shape) != size:
                raise ValueError(f"{name}: expected shape {size}, as the lightmaps have, got {tuple(plane.shape)}")
        if self.camera is not None and (self.camera.height, self.camera.width) != size:
            seen = (self.camera.height, self.camera.width)
            raise ValueError(f"camera: expected the height and width of the lightmaps, {size}, got {seen}")

    def __getitem__(self, direction: str) -> torch.Tensor:
        """Returns the lightmap of a direction, such as "front", [H, W]."""
        return self.lightmaps[DIRECTIONS.index(direction)]

    def shade(
        self,
        lights: Sequence[Light],
        *,
        background: torch.Tensor | Sequence[float] | None = None,
        rule: str = "squared",
        ramp: Ramp | None = None,
        albedo: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> torch.Tensor:
        """Renders the smoke: each light adds irradiance / (4 pi) times a weighted sum of lightmaps (eq. 4 and 5).

        Args:
            lights: Any number of directional lights.
            background: Linear light behind the smoke, [H, W, 3] or one colour; None: only the smoke's light, to which
                the background times the transparency must be added.
            rule: Rule for the weights of the lightmaps, one of `wlm.smoke.camera.RULES`.
            ramp: Colour of the emission; None: grey.
            albedo: R, G, B, share of light that survives a scattering, 0 to 1.

        Returns:
            float32 [H, W, 3], linear.

        Raises:
            ValueError: The camera, or the transparency for a background, is needed and unknown; a light has no
                direction or a negative irradiance; or the albedo is invalid.
        """
        if self.camera is None and lights:
            raise ValueError("camera: the lightmaps have no camera, which lights need: set it by dataclasses.replace")
        height, width = self.lightmaps.shape[1:]
        scattered = checked_albedo(albedo) / (4 * math.pi)
        image = torch.zeros((height, width, 3), dtype=torch.float32, device=self.lightmaps.device)
        for light in lights:
            irradiance = checked_colour("irradiance", light.irradiance)
            share = weights(self.camera.axes @ np.asarray(light.toward, np.float64), rule)
            grey = torch.einsum("c,chw->hw", torch.tensor(share).to(self.lightmaps), self.lightmaps)
            image += grey[..., None] * torch.tensor(irradiance * scattered).to(image)
        if self.emission is not None:
            image += glow_of(self.emission, ramp)
        if background is None:
            return image
        if self.transparency is None:
            raise ValueError("transparency: the lightmaps have no transparency, which a background needs")
        return image + self.transparency[..., None] * torch.as_tensor(background).to(image)


def light_centres(planes: torch.Tensor) -> torch.Tensor:
    """Returns where the light is in planes [N, C, H, W] of N frames, float64 [C, 3]: the mean place of the light to the
    right and upwards, 0 to 1, and the plane's share of the light of all planes."""
    height, width = planes.shape[2:]
    planes = planes.clamp(min=0.0)
    right = (torch.arange(width, device=planes.device) + 0.5) / width
    up = 1.0 - (torch.arange(height, device=planes.device) + 0.5) / height
    total = planes.sum((0, 2, 3)).clamp(min=_DARKEST)
    sums = planes.sum((0, 2)) @ right / total, planes.sum((0, 3)) @ up / total, total / total.sum()
    return torch.stack(sums, 1).double().cpu()


def axis_shifts(centres: torch.Tensor) -> torch.Tensor:
    """Returns how far right is to the right of left, top above bottom, and front brighter than back, [3]."""
    return (centres[0::2] - centres[1::2]).diagonal()


def axis_faults(lightmaps: torch.Tensor) -> tuple[str, ...]:
    """Checks that lightmaps [..., 6, H, W] are bright where the light of their direction falls.

    A lightmap is brighter on the side from which its light comes, whatever the smoke, and smoke that scatters evenly is
    brighter under a light from the front than from behind. Returns a line for each pair of directions that may be
    exchanged, or one that names the black lightmaps if some are; none if all six are black, or where the light shows no
    direction.
    """
    maps = lightmaps.reshape(-1, *lightmaps.shape[-3:])
    dark = [name for name, light in zip(DIRECTIONS, maps.amax((0, 2, 3)).tolist(), strict=True) if not light > 0.0]
    if dark:
        return () if len(dark) == len(DIRECTIONS) else (f"no light in {', '.join(dark)}",)
    texts = ("to the right of", "above", "brighter than")
    shifts = zip(axis_shifts(light_centres(maps)).tolist(), DIRECTIONS[::2], DIRECTIONS[1::2], texts, strict=True)
    return tuple(
        f"warning: {one} and {other} may be exchanged: the light of {one} is not {text} that of {other}"
        for shift, one, other, text in shifts
        if shift < -_LEAST_SHIFT
    )
