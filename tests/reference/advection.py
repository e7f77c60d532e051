"""Advection in float64 on points, cell by cell; nothing is shared with the kernels.

Places are in fine cells; ``ends`` gives for each axis its low and high end: 0 periodic, 1 open, 2 closed.
"""

import itertools
from dataclasses import dataclass

import numpy as np


@dataclass
class Domain:
    """Velocities [x, y, z, 3], coarse cells a step; solid: bool [x, y, z]; ratio: fine cells a coarse one."""

    u: np.ndarray
    solid: np.ndarray
    ratio: int
    ends: tuple[tuple[int, int], ...]

    @property
    def shape(self) -> np.ndarray:
        return np.array(self.solid.shape) * self.ratio

    @property
    def fine_solid(self) -> np.ndarray:
        out = self.solid
        for axis in range(3):
            out = out.repeat(self.ratio, axis)
        return out

    def corners(self, p: np.ndarray, shape: np.ndarray, about: np.ndarray | None = None):
        """The eight cells about a place, or about another one, among cells of size 1, with their weights for it."""
        base = np.floor((p if about is None else about) - 0.5)
        f = p - 0.5 - base
        for corner in itertools.product((0, 1), repeat=3):
            cell = (base + corner).astype(int)
            for axis, (low, _) in enumerate(self.ends):
                n = shape[axis]
                cell[axis] = cell[axis] % n if low == 0 else min(max(cell[axis], 0), n - 1)
            yield tuple(cell), np.prod([f[a] if corner[a] else 1 - f[a] for a in range(3)])

    def held(self, p: np.ndarray) -> np.ndarray:
        """A place as periodic, or held within the domain."""
        n = self.shape
        return np.array([p[a] % n[a] if self.ends[a][0] == 0 else np.clip(p[a], 0, n[a]) for a in range(3)])

    def outside(self, p: np.ndarray) -> bool:
        n = self.shape
        return any((p[a] < 0 and e[0] == 1) or (p[a] > n[a] and e[1] == 1) for a, e in enumerate(self.ends))

    def velocity(self, p: np.ndarray) -> np.ndarray:
        """At a place, fine cells a step."""
        coarse = np.array(self.solid.shape)
        at = self.held(p) / self.ratio
        return self.ratio * sum(w * self.u[c] for c, w in self.corners(at, coarse))

    def is_solid(self, p: np.ndarray, reach: int = 0) -> bool:
        """Whether the coarse cell of a place is solid, or one within ``reach`` of it."""
        coarse = np.array(self.solid.shape)
        cell = np.minimum((self.held(p) / self.ratio).astype(int), coarse - 1)
        for step in itertools.product(range(-reach, reach + 1), repeat=3):
            beside = cell + step
            for a, (low, _) in enumerate(self.ends):
                beside[a] = beside[a] % coarse[a] if low == 0 else np.clip(beside[a], 0, coarse[a] - 1)
            if self.solid[tuple(beside)]:
                return True
        return False

    def trace(self, x: np.ndarray, dt: float) -> np.ndarray:
        middle = x - 0.5 * dt * self.velocity(x)
        away = middle / self.ratio - 0.5 - np.floor(x / self.ratio - 0.5)
        v = self.velocity(middle)
        if (np.abs(away - 0.5) <= 0.75).all():
            # Read from the velocities about the start.
            around = self.corners(middle / self.ratio, np.array(self.solid.shape), x / self.ratio)
            v = self.ratio * sum(w * self.u[c] for c, w in around)
        end = x - dt * v
        if self.is_solid(end):
            free = x
            for _ in range(6):
                middle = 0.5 * (free + end)
                if self.is_solid(middle):
                    end = middle
                else:
                    free = middle
            return free
        return end

    def is_near(self, x: np.ndarray, p: np.ndarray) -> bool:
        """Whether what lies at the end of a trace from x counts as beside a solid."""
        short = (np.abs(p - x) <= 0.5 * self.ratio).all() and not self.is_solid(x, 1)
        return self.is_solid(p, 1) and not short

    def read(self, field: np.ndarray, p: np.ndarray) -> float:
        found = [(field[c], w) for c, w in self.corners(self.held(p), self.shape) if not self.fine_solid[c]]
        return sum(v * w for v, w in found) / max(sum(w for _, w in found), 1e-6)

    def semi_lagrangian(self, field: np.ndarray, dt: float) -> np.ndarray:
        out = np.zeros(self.shape)
        for cell in np.ndindex(out.shape):
            if not self.fine_solid[cell]:
                p = self.trace(np.array(cell) + 0.5, dt)
                out[cell] = 0.0 if self.outside(p) else self.read(field, p)
        return out

    def maccormack(self, field: np.ndarray, dt: float) -> np.ndarray:
        predicted = self.semi_lagrangian(field, dt)
        out = predicted.copy()
        for cell in np.ndindex(out.shape):
            x = np.array(cell) + 0.5
            if self.fine_solid[cell]:
                continue
            p, q = self.trace(x, dt), self.trace(x, -dt)
            if self.outside(p) or self.outside(q) or self.is_near(x, p) or self.is_near(x, q):
                continue
            value = predicted[cell] + 0.5 * (field[cell] - self.read(predicted, q))
            values = [field[c] for c, _ in self.corners(self.held(p), self.shape)]
            out[cell] = np.clip(value, min(values), max(values))
        return out
