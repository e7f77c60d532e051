"""Turbulence, wind with gusts, and fire, which move the air of a `Solver` besides smoke.

Lengths and times are in any units; `scaled` converts them to those of cells and steps.
"""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from wlm_kernels.fluid.forcing import Modes

EDDY = 4.0
"""Cells along the smallest wavelength of turbulence."""
_MODES = 16
_LARGEST = 1e18  # its square is within float32


@dataclass(frozen=True)
class Turbulence:
    """A random acceleration of all air, free of divergence; the same for a seed.

    Attributes:
        strength: Root mean square of the acceleration.
        size: Wavelength of its largest eddies, simulated as at least `EDDY` cells; the smallest are half as large.
        period: Mean duration in which an eddy comes and goes.
        seed: Seed of the random modes, at least 0.
    """

    strength: float
    size: float
    period: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("strength", 0.0), ("size", 1e-12), ("period", 1e-12), ("seed", 0)):
            if not least <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite number of at least {least:g}, got {getattr(self, name)}")

    def scaled(self, step: float, cell: float = 1.0) -> "Turbulence":
        """Returns the same in units of `cell` and `step`."""
        return Turbulence(self.strength * step * step / cell, self.size / cell, self.period / step, self.seed)

    def modes(self, device: str) -> Modes:
        """Makes the random Fourier modes on a device, see `wlm_kernels.fluid.forcing`."""
        random = np.random.default_rng(self.seed)
        way, other = random.normal(size=(2, _MODES, 3))
        length = 2.0 * np.pi / max(self.size, EDDY) * random.uniform(1.0, 2.0, (_MODES, 1))
        k = length * way / np.linalg.norm(way, axis=1, keepdims=True)
        push = np.cross(np.sin(k), other)
        push *= self.strength * math.sqrt(2.0 / _MODES) / np.linalg.norm(push, axis=1, keepdims=True)
        turn = random.normal(size=_MODES) * 2.0 * np.pi / self.period, random.uniform(0.0, 2.0 * np.pi, _MODES)
        out = Modes()
        out.k, out.push = (wp.array(each.astype(np.float32), dtype=wp.vec3, device=device) for each in (k, push))
        out.turn = wp.array(np.stack(turn, 1).astype(np.float32), dtype=wp.vec2, device=device)
        return out


@dataclass(frozen=True)
class Wind:
    """The velocity of the wind at the faces of the box that `Lattice.set_wind` opens to it.

    Attributes:
        keys: Rows (time, x, y, z) of velocities, linear between them and constant beyond, times increasing.
        gusts: Largest change of the speed in gusts, as a share of it, at most 1.
        period: Mean time from gust to gust.
        seed: Seed of the gusts.
    """

    keys: tuple[tuple[float, float, float, float], ...]
    gusts: float = 0.0
    period: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        keys = np.asarray(self.keys, np.float64)
        small = (np.abs(keys) <= _LARGEST).all()
        if keys.ndim != 2 or keys.shape[1] != 4 or not (small and (np.diff(keys[:, 0]) > 0).all()):
            text = f"rows of an increasing time and a velocity, of numbers up to {_LARGEST:g}"
            raise ValueError(f"keys: expected {text}, got {self.keys}")
        if not (0.0 <= self.gusts <= 1.0 and 0.0 < self.period < math.inf and self.seed >= 0):
            values = f"{self.gusts}, {self.period}, {self.seed}"
            raise ValueError(f"gusts, period, seed: expected 0 to 1, above 0, at least 0, got {values}")

    def scaled(self, step: float, cell: float = 1.0) -> "Wind":
        """Returns the same in units of `cell` and `step`."""
        keys = np.asarray(self.keys) * (1.0 / step, *[step / cell] * 3)
        return Wind(keys.tolist(), self.gusts, self.period / step, self.seed)

    def at(self, time: float) -> np.ndarray:
        """Returns the velocity at a time, float64 [3]."""
        keys, (rates, phases) = np.asarray(self.keys, np.float64), self._waves
        mean = np.array([np.interp(time, keys[:, 0], column) for column in keys.T[1:]])
        waves = np.sin(2.0 * np.pi * (rates * time / self.period + phases))
        return mean * (1.0 + self.gusts * float(waves.mean()))

    @functools.cached_property
    def _waves(self) -> tuple[np.ndarray, np.ndarray]:
        """Rates, relative to the mean one, and phases of the waves of which gusts are made."""
        random = np.random.default_rng(self.seed)
        return random.uniform(0.5, 2.0, 4), random.random(4)

    @property
    def fastest(self) -> float:
        """An upper bound of the speed."""
        return float(np.linalg.norm(np.asarray(self.keys)[:, 1:], axis=1).max()) * (1.0 + self.gusts)


@dataclass(frozen=True)
class Fire:
    """Fuel that burns, and hot gas that radiates and expands; see `wlm_kernels.fluid.fire` for the model.

    Attributes:
        rate: Fuel that burns per unit of time; of fuel below 1 this share of it.
        heat: Temperature that a unit of fuel adds, up to 1.
        smoke: Density that it makes.
        ignition: Least temperature at which it burns.
        radiation: c of the cooling dT/dt = -c T^4 per unit of time.
        expansion: Factor on the expansion of an ideal gas; 0: none.
        ambient, flame: Kelvins at the temperatures 0 and 1.
    """

    rate: float
    heat: float = 1.0
    smoke: float = 1.0
    ignition: float = 0.0
    radiation: float = 0.0
    expansion: float = 1.0
    ambient: float = 293.0
    flame: float = 1900.0

    def __post_init__(self) -> None:
        if not all(0.0 <= value <= 1e6 for value in vars(self).values()):
            raise ValueError(f"fire: expected numbers from 0 to 1e6, got {self}")
        if not 100.0 <= self.ambient < self.flame:
            raise ValueError(f"ambient, flame: expected 100 K <= ambient < flame, got {self.ambient} and {self.flame}")

    def scaled(self, step: float) -> "Fire":
        """Returns the same in units of `step`."""
        return replace(self, rate=self.rate * step, radiation=self.radiation * step)

    @property
    def growth(self) -> float:
        """Largest growth of burning gas per unit of time, as a share."""
        return self.expansion * self.rate * self.heat * (self.flame / self.ambient - 1.0)

    def kelvin(self, temperature: torch.Tensor) -> torch.Tensor:
        """Converts temperatures to kelvins; air at 0 stays 0, like space without smoke."""
        return torch.where(temperature > 0.0, self.ambient + (self.flame - self.ambient) * temperature, 0.0)


CALM = Modes()
"""No turbulence."""
