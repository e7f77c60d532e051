"""Steps of air and of smoke in float64, as functions of what has gradients, for finite differences.

`Air` continues the flow of `reference.lattice` from stored populations; `Smoke` is advection without any code of the
kernels, with sources and buoyancy. Its positions are in fine cells.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np

from . import lattice as reference


@dataclass
class Air:
    """A flow.

    Attributes:
        box: The domain and its boundaries.
        viscosity, smagorinsky: As for `reference.collide`.
        ramp: Steps in which inlets rise.
        force: [X, Y, Z, 3], if no other is given.
    """

    box: reference.Box
    viscosity: float
    smagorinsky: float
    ramp: int
    force: np.ndarray

    def __post_init__(self) -> None:
        faces = self.box.faces
        still = {name for name, (kind, value) in faces.items() if kind == "wall" and not np.any(value)}
        self.closed = [{f"-{axis}", f"+{axis}"} <= still for axis in "xyz"]

    def arrived(self, stored: np.ndarray) -> np.ndarray:
        """The populations [X, Y, Z, Q] that arrive, from those that the lattice stores, [Q, X, Y, Z]."""
        c, out = self.box.c, []
        for q, velocity in enumerate(c):
            came = np.roll(stored[q], velocity, (0, 1, 2))
            back = stored[int(np.flatnonzero((c == -velocity).all(1))[0])]
            for axis in range(3):
                at = np.arange(stored.shape[1 + axis]) - velocity[axis]
                beyond = self.closed[axis] & ((at < 0) | (at >= len(at)))
                came = np.where(np.expand_dims(beyond, tuple(a for a in range(3) if a != axis)), back, came)
            out.append(came)
        return np.stack(out, -1) + self.box.w

    def step(self, f: np.ndarray, done: int, inlet: np.ndarray | None = None, force=None) -> np.ndarray:
        """The populations that arrive after one more step than `done`; `inlet` is the velocity at face -x."""
        force = self.force if force is None else force
        left = reference.collide(self.box, f, self.viscosity, self.smagorinsky, force)
        if inlet is not None:
            risen = min(1.0, (done + 2) / max(self.ramp, 1))
            self.box.faces["-x"] = ("inlet", risen**2 * (3 - 2 * risen) * inlet)
        return reference.stream(self.box, left)

    def fields(self, f: np.ndarray, force=None) -> tuple[np.ndarray, np.ndarray]:
        """Density minus 1 and velocity; 0 and the solid's velocity in solid cells."""
        rho, u = reference.fields(self.box, f + (self.box.solid[..., None] > 0), self.force if force is None else force)
        fluid = self.box.solid == 0
        return np.where(fluid, rho - 1.0, 0.0), np.where(fluid[..., None], u, self.box.velocity)

    def drag(self, f: np.ndarray) -> np.ndarray:
        """The force on the solid, by the momentum of the populations that came back from it; no wall may be nearby."""
        c, w, total = self.box.c, self.box.w, np.zeros(3)
        for cell in np.argwhere(self.box.solid == 0):
            for q, velocity in enumerate(c):
                source = cell - velocity
                inside = not self.box.crossed(source)
                if inside and self.box.solid[tuple(source % self.box.solid.shape)]:
                    term = 6.0 * w[q] * (velocity @ np.asarray(self.box.velocity))
                    total += (term - 2.0 * (f[tuple(cell)][q] - w[q])) * velocity
        return total


@dataclass
class Smoke:
    """Smoke in a domain.

    Attributes:
        solid: bool [X, Y, Z], coarse cells.
        refinement: Fine cells along an edge of a coarse one.
        ends: For each axis its low and high end: 0 periodic, 1 open, 2 closed.
        dt: Steps of the lattice in a step.
        scheme: "maccormack" or "semi-lagrangian".
        decay: Factors of density and temperature.
    """

    solid: np.ndarray
    refinement: int
    ends: tuple[tuple[int, int], ...]
    dt: float
    scheme: str
    decay: tuple[float, float] = (1.0, 1.0)
    near: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        r = self.refinement
        self.coarse = np.array(self.solid.shape)
        self.n = r * self.coarse
        self.fine_solid = np.kron(self.solid, np.ones((r, r, r), bool))
        near = self.solid
        for axis, (low, _) in enumerate(self.ends):
            near = np.pad(near, [(int(a == axis),) * 2 for a in range(3)], mode="wrap" if low == 0 else "edge")
        self.near = np.lib.stride_tricks.sliding_window_view(near, (3, 3, 3)).any((3, 4, 5))
        self.x = np.stack(np.meshgrid(*(np.arange(k) + 0.5 for k in self.n), indexing="ij"), -1).reshape(-1, 3)

    def _corners(self, p: np.ndarray, n: np.ndarray):
        base = np.floor(p - 0.5)
        f = p - 0.5 - base
        for corner in itertools.product((0, 1), repeat=3):
            cell = (base + corner).astype(int)
            for axis, (low, _) in enumerate(self.ends):
                at = cell[:, axis]
                cell[:, axis] = at % n[axis] if low == 0 else np.clip(at, 0, n[axis] - 1)
            yield tuple(cell.T), np.prod(np.where(corner, f, 1 - f), 1)

    def _into(self, p: np.ndarray) -> np.ndarray:
        periodic = np.array([low == 0 for low, _ in self.ends])
        return np.where(periodic, p % self.n, np.clip(p, 0, self.n))

    def _outside(self, p: np.ndarray) -> np.ndarray:
        low, high = (np.array(side) == 1 for side in zip(*self.ends, strict=True))
        return ((p < 0) & low | (p > self.n) & high).any(1)

    def _at(self, cells: np.ndarray, p: np.ndarray) -> np.ndarray:
        at = np.minimum((self._into(p) / self.refinement).astype(int), self.coarse - 1)
        return cells[tuple(at.T)]

    def _trace(self, u: np.ndarray, dt: float) -> np.ndarray:
        x, r = self.x, self.refinement
        centres = np.stack(np.meshgrid(*(np.arange(k) + 0.5 for k in self.coarse), indexing="ij"), -1).reshape(-1, 3)
        middle = self._into(r * (centres - 0.5 * dt * u.reshape(-1, 3))) / r
        way = -dt * r * sum(w[:, None] * u[c] for c, w in self._corners(middle, self.coarse))
        way = way.reshape(u.shape)
        end = x + sum(w[:, None] * way[c] for c, w in self._corners(x / r, self.coarse))
        cut = self._at(self.solid, end)
        free, solid = x.copy(), end.copy()
        for _ in range(6):
            half = 0.5 * (free + solid)
            hit = self._at(self.solid, half)[:, None]
            free, solid = np.where(hit, free, half), np.where(hit, half, solid)
        return np.where(cut[:, None], free, end)

    def _beside(self, p: np.ndarray) -> np.ndarray:
        short = (np.abs(p - self.x) <= 0.5 * self.refinement).all(1) & ~self._at(self.near, self.x)
        return self._at(self.near, p) & ~short

    def _read(self, values: np.ndarray, p: np.ndarray) -> np.ndarray:
        total = weight = 0.0
        within = self._into(p)
        for cell, w in self._corners(within, self.n):
            w = np.where(self.fine_solid[cell], 0.0, w)
            total, weight = total + w * values[cell], weight + w
        return total / np.maximum(weight, 1e-6)

    def carry(self, u: np.ndarray, *fields: np.ndarray) -> list[np.ndarray]:
        """The fields after a step in air of velocity u, [X, Y, Z, 3], with their decay."""
        p, q, free = self._trace(u, self.dt), self._trace(u, -self.dt), ~self.fine_solid.ravel()
        plain = self._outside(p) | self._outside(q) | self._beside(p) | self._beside(q) | ~free
        inside, results = self._into(p), []
        for values, decay in zip(fields, self.decay, strict=False):
            predicted = np.where(free & ~self._outside(p), self._read(values, p), 0.0)
            out = predicted
            if self.scheme == "maccormack":
                back = self._read(predicted.reshape(self.n), q)
                around = np.stack([values[c] for c, _ in self._corners(inside, self.n)])
                raw = predicted + 0.5 * (values.ravel() - back)
                out = np.where(plain | (raw > around.max(0)), predicted, np.maximum(raw, around.min(0)))
            results.append(decay * out.reshape(self.n))
        return results

    def means(self, values: np.ndarray) -> np.ndarray:
        """The mean of each coarse cell, 0 in solids."""
        r, (x, y, z) = self.refinement, self.coarse
        return np.where(self.solid, 0.0, values.reshape(x, r, y, r, z, r).mean((1, 3, 5)))

    def region(self, centre, size, sphere: bool) -> np.ndarray:
        """bool, the cells of a source, with lengths in coarse cells."""
        away = np.abs(self.x / self.refinement - np.array(centre)) / np.array(size)
        inside = (away**2).sum(1) <= 1 if sphere else (away <= 1).all(1)
        return inside.reshape(self.n) & ~self.fine_solid
