"""Advection in float64, cell by cell, without any code of the kernels.

`Domain.semi_lagrangian` and `Domain.maccormack` are the two steps. Positions are in fine cells; `ends` gives for
each axis its low and high end: 0 periodic, 1 open, 2 closed.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass
class Domain:
    """A domain and its air.

    Attributes:
        u: Velocities [X, Y, Z, 3], coarse cells a step.
        solid: bool [X, Y, Z], coarse cells.
        refinement: Fine cells along an edge of a coarse one.
        ends: See the module.
    """

    u: np.ndarray
    solid: np.ndarray
    refinement: int
    ends: tuple[tuple[int, int], ...]

    @cached_property
    def ends_of_traces(self) -> dict:
        return {}

    @cached_property
    def ways(self) -> dict:
        return {}

    @cached_property
    def shape(self) -> np.ndarray:
        return np.array(self.solid.shape) * self.refinement

    @cached_property
    def fine_solid(self) -> np.ndarray:
        return np.kron(self.solid, np.ones((self.refinement,) * 3, bool))

    def corners(self, p: np.ndarray, shape: np.ndarray):
        """The eight cells around p, among cells of size 1, with their trilinear weights."""
        base = np.floor(p - 0.5)
        f = p - 0.5 - base
        for corner in itertools.product((0, 1), repeat=3):
            cell = (base + corner).astype(int)
            for axis, (low, _) in enumerate(self.ends):
                n = shape[axis]
                cell[axis] = cell[axis] % n if low == 0 else min(max(cell[axis], 0), n - 1)
            yield tuple(cell), np.prod([f[a] if corner[a] else 1 - f[a] for a in range(3)])

    def into_domain(self, p: np.ndarray) -> np.ndarray:
        """A point wrapped along periodic axes and clamped to the faces of the others."""
        n = self.shape
        return np.array([p[a] % n[a] if self.ends[a][0] == 0 else np.clip(p[a], 0, n[a]) for a in range(3)])

    def outside(self, p: np.ndarray) -> bool:
        n = self.shape
        return any((p[a] < 0 and e[0] == 1) or (p[a] > n[a] and e[1] == 1) for a, e in enumerate(self.ends))

    def velocity(self, p: np.ndarray) -> np.ndarray:
        """Returns the velocity of the air at a point, in fine cells per step."""
        coarse = np.array(self.solid.shape)
        at = self.into_domain(p) / self.refinement
        return self.refinement * sum(w * self.u[c] for c, w in self.corners(at, coarse))

    @cached_property
    def beside(self) -> np.ndarray:
        """bool [X, Y, Z], the coarse cells that are solid or touch one that is."""
        cells = self.solid
        for axis, (low, _) in enumerate(self.ends):
            cells = np.pad(cells, [(int(a == axis),) * 2 for a in range(3)], mode="wrap" if low == 0 else "edge")
        return np.lib.stride_tricks.sliding_window_view(cells, (3, 3, 3)).any((3, 4, 5))

    def at(self, cells: np.ndarray, p: np.ndarray) -> bool:
        """The value of the coarse cell that holds a point."""
        cell = (self.into_domain(p) / self.refinement).astype(int)
        return bool(cells[tuple(np.minimum(cell, np.array(cells.shape) - 1))])

    def way(self, cell: tuple[int, ...], dt: float) -> np.ndarray:
        """-dt u(x - dt u(x) / 2) for the centre x of a coarse cell, in fine cells; each is computed once."""
        if (cell, dt) not in self.ways:
            middle = self.refinement * (np.array(cell) + 0.5 - 0.5 * dt * self.u[cell])
            self.ways[cell, dt] = -dt * self.velocity(middle)
        return self.ways[cell, dt]

    def departure_point(self, x: np.ndarray, dt: float) -> np.ndarray:
        """x and the way between those of the coarse cells, cut where it meets a solid; each is computed once."""
        key = *x, dt
        if key not in self.ends_of_traces:
            self.ends_of_traces[key] = self._trace(x, dt)
        return self.ends_of_traces[key]

    def _trace(self, x: np.ndarray, dt: float) -> np.ndarray:
        around = self.corners(x / self.refinement, np.array(self.solid.shape))
        end = x + sum(w * self.way(c, dt) for c, w in around)
        if self.at(self.solid, end):
            free = x
            for _ in range(6):
                middle = 0.5 * (free + end)
                if self.at(self.solid, middle):
                    end = middle
                else:
                    free = middle
            return free
        return end

    def is_near(self, x: np.ndarray, p: np.ndarray) -> bool:
        """Whether the end p of a trace from x counts as beside a solid."""
        short = (np.abs(p - x) <= 0.5 * self.refinement).all() and not self.at(self.beside, x)
        return self.at(self.beside, p) and not short

    def read(self, field: np.ndarray, p: np.ndarray) -> float:
        """A field at a point, of the cells that aren't solid."""
        cells = [(c, w) for c, w in self.corners(self.into_domain(p), self.shape) if not self.fine_solid[c]]
        return sum(w * field[c] for c, w in cells) / max(sum(w for _, w in cells), 1e-6)

    def semi_lagrangian(self, field: np.ndarray, dt: float) -> np.ndarray:
        """A step of dt: every cell takes the field at its departure point, or clean air from beyond an open face."""
        out = np.zeros(self.shape)
        for cell in np.ndindex(out.shape):
            if not self.fine_solid[cell]:
                p = self.departure_point(np.array(cell) + 0.5, dt)
                out[cell] = 0.0 if self.outside(p) else self.read(field, p)
        return out

    def maccormack(self, field: np.ndarray, dt: float) -> np.ndarray:
        """The same, corrected by half of what a step there and back loses, within the values that the trace reads."""
        predicted = self.semi_lagrangian(field, dt)
        out = predicted.copy()
        for cell in np.ndindex(out.shape):
            x = np.array(cell) + 0.5
            if self.fine_solid[cell]:
                continue
            p, q = self.departure_point(x, dt), self.departure_point(x, -dt)
            if self.outside(p) or self.outside(q) or self.is_near(x, p) or self.is_near(x, q):
                continue
            value = predicted[cell] + 0.5 * (field[cell] - self.read(predicted, q))
            values = [field[c] for c, _ in self.corners(self.into_domain(p), self.shape)]
            out[cell] = predicted[cell] if value > max(values) else max(value, min(values))
        return out
