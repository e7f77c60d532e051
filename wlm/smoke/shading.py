"""Directional lights, point lights, skies, and the colours of emission, in linear light."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import unit

BRIGHTEST = 1e12
"""Largest irradiance or intensity: its products with any phase function are within float32."""


@dataclass(frozen=True)
class Light:
    """A directional light.

    Attributes:
        toward: Direction to the light in the world, of any length except 0.
        irradiance: R, G, B on a surface that faces the light; not negative.
    """

    toward: tuple[float, float, float]
    irradiance: tuple[float, float, float] = (4 * math.pi,) * 3


@dataclass(frozen=True)
class Ramp:
    """Colour of emission, linear between stops and constant beyond them.

    Attributes:
        stops: Values of emission, increasing.
        colours: R, G, B of each stop, not negative.
    """

    stops: tuple[float, ...]
    colours: tuple[tuple[float, float, float], ...]

    def __post_init__(self) -> None:
        if len(self.stops) < 2 or np.shape(self.colours) != (len(self.stops), 3):
            raise ValueError("ramp: expected at least two stops and a colour R, G, B for each of them")
        if not (np.isfinite(self.stops).all() and np.isfinite(self.colours).all() and (np.diff(self.stops) > 0).all()):
            raise ValueError(f"ramp: expected finite colours and increasing stops, got {self.colours} at {self.stops}")

    def __call__(self, emission: torch.Tensor) -> torch.Tensor:
        """Returns the colours [..., 3] for a tensor [...] of emissions."""
        stops, colours = _on_device(self, emission.dtype, emission.device)
        after = torch.searchsorted(stops, emission.contiguous()).clamp(1, len(self.stops) - 1)
        share = ((emission - stops[after - 1]) / (stops[after] - stops[after - 1])).clamp(0, 1)[..., None]
        return (1 - share) * colours[after - 1] + share * colours[after]


@functools.lru_cache(maxsize=8)
def _on_device(ramp: Ramp, dtype: torch.dtype, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns a ramp's stops and colours as tensors; they are kept, since a CUDA graph cannot copy them to the GPU."""
    return torch.tensor(ramp.stops, dtype=dtype, device=device), torch.tensor(ramp.colours, dtype=dtype, device=device)


def glow_of(emission: torch.Tensor, ramp: Ramp | None, thrown: torch.Tensor | None = None) -> torch.Tensor:
    """Returns the light of fire, [H, W, 3], or [H, W, 1] if it is grey (without a ramp), from the light [H, W] that
    smoke emits.

    `thrown`, [H, W, 3], is emitted light that the smoke scatters, which gets the mean colour of the visible fire.
    """
    glow = emission[..., None] if ramp is None else ramp(emission)
    if thrown is None:
        return glow
    return glow + thrown * (1.0 if ramp is None else glow.sum((0, 1)) / emission.sum().clamp(min=1e-12))


@dataclass(frozen=True)
class PointLight:
    """A point light, inside the smoke or outside.

    Attributes:
        position: Position in world units.
        intensity: R, G, B per solid angle; the irradiance at a distance r is intensity / r^2.
        radius: Distance in the world's unit within which the irradiance is constant. 0: unbounded irradiance, with
            which a path tracer has unbounded noise if the light is inside the smoke.
    """

    position: tuple[float, float, float]
    intensity: tuple[float, float, float] = (1.0, 1.0, 1.0)
    radius: float = 0.0

    def __post_init__(self) -> None:
        if np.shape(self.position) != (3,) or not np.isfinite(self.position).all():
            raise ValueError(f"position: expected three finite numbers, got {self.position}")
        if not 0 <= self.radius < math.inf:
            raise ValueError(f"radius: expected a finite length of at least 0, got {self.radius}")
        checked_colour("intensity", self.intensity)


AnyLight = Light | PointLight
"""A light at infinity or a point light."""


def sky_lights(radiance: Sequence[float], count: int = 12) -> tuple[Light, ...]:
    """Returns evenly spread directional lights that approximate a sky with the same radiance in all directions.

    Args:
        radiance: Radiance of the sky, R, G, B.
        count: Number of lights, even and at least 2.

    Raises:
        ValueError: The radiance is not three numbers of at least 0.
    """
    each = tuple(map(float, checked_colour("sky", radiance) * 4.0 * math.pi / count))
    ways = half_sphere(count // 2)
    return tuple(Light(tuple(map(float, way)), each) for way in (*ways, *-ways))


def half_sphere(count: int) -> np.ndarray:
    """Returns directions, float64 [count, 3], that together with their opposites are evenly spread over the sphere."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - k / count, np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), height, across * np.sin(turn)], -1)


def checked_colour(name: str, colour: Sequence[float]) -> np.ndarray:
    """Checks that a colour is three numbers of at least 0 and returns it as float64 [3]."""
    values = np.asarray(colour, np.float64)
    if values.shape != (3,) or not ((values >= 0) & (values <= BRIGHTEST)).all():
        raise ValueError(f"{name}: expected three numbers from 0 to {BRIGHTEST:g}, got {colour}")
    return values


def checked_albedo(albedo: Sequence[float]) -> np.ndarray:
    """Checks that an albedo is three numbers from 0 to 1 and returns it as float64 [3]."""
    colour = checked_colour("albedo", albedo)
    if not (colour <= 1).all():
        raise ValueError(f"albedo: expected three numbers from 0 to 1, got {tuple(albedo)}")
    return colour


def in_voxels(light: AnyLight, volume: DensityVolume) -> tuple[np.ndarray, np.ndarray, float | None]:
    """Returns a light in a volume's voxel coordinates: direction or position, irradiance / (4 pi), and radius. The
    irradiance of a point light is that at a distance of one voxel. The radius of a directional light is None."""
    if isinstance(light, Light):
        return unit(light.toward), checked_colour("irradiance", light.irradiance) / (4.0 * math.pi), None
    place = (np.asarray(light.position, np.float64) - np.asarray(volume.origin, np.float64)) / volume.voxel
    colour = checked_colour("intensity", light.intensity) / (4.0 * math.pi * volume.voxel**2)
    return place, colour, light.radius / volume.voxel
