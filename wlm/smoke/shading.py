"""Directional lights and the colours of emission, for the shading of smoke in linear light."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.smoke.camera import Camera


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
            raise ValueError(f"ramp: expected finite colours and increasing finite stops, got {self.stops}")

    def __call__(self, emission: torch.Tensor) -> torch.Tensor:
        """Returns the colours [..., 3] for a tensor [...] of emissions."""
        stops = torch.tensor(self.stops, dtype=emission.dtype, device=emission.device)
        colours = torch.tensor(self.colours, dtype=emission.dtype, device=emission.device)
        after = torch.searchsorted(stops, emission.contiguous()).clamp(1, len(self.stops) - 1)
        share = ((emission - stops[after - 1]) / (stops[after] - stops[after - 1])).clamp(0, 1)[..., None]
        return (1 - share) * colours[after - 1] + share * colours[after]


def light_axes(toward: Sequence[float] | np.ndarray) -> list[float]:
    """Returns three orthogonal unit axes, of which the third points to the light, as a list of 9 numbers."""
    return Camera.look_at(toward, np.zeros(3), extent=1.0, height=1, width=1).axes.ravel().tolist()
