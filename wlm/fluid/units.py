"""Conversion of SI units to the units of a lattice: lengths in cells, times in steps."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Domain:
    """Converts SI units to units of a lattice.

    Attributes:
        cell: Edge of a cell in metres.
        step: Duration of a step in seconds.
    """

    cell: float
    step: float

    def __post_init__(self) -> None:
        for name in ("cell", "step"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: expected a positive number, got {value}")

    def speed(self, value: float) -> float:
        """Converts a speed from m/s to cells per step."""
        return value * self.step / self.cell

    def viscosity(self, value: float) -> float:
        """Converts a kinematic viscosity from m^2/s to square cells per step."""
        return value * self.step / self.cell**2

    def acceleration(self, value: float) -> float:
        """Converts an acceleration from m/s^2 to cells per step squared."""
        return value * self.step**2 / self.cell
