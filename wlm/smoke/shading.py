"""Directional lights and the colours of emission, for the shading of smoke in linear light."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch


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
    """Returns the light of fire, [H, W, 3], or [H, W, 1] if it is grey.

    Args:
        emission: [H, W], light that the smoke emits.
        ramp: Colour of the emission; None: grey.
        thrown: [H, W, 3], emitted light that the smoke scatters, which gets the mean colour of the visible fire.
    """
    glow = emission[..., None] if ramp is None else ramp(emission)
    if thrown is None:
        return glow
    return glow + thrown * (1.0 if ramp is None else glow.sum((0, 1)) / emission.sum().clamp(min=1e-12))
