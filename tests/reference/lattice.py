"""A lattice Boltzmann step in float64, with complete populations f (not f - w).

    f = equilibrium(c, w, rho, u)
    while True:
        f = stream(box, collide(box, f, viscosity, smagorinsky, force))

It shares no code with the kernels: streaming finds for each cell and direction where the population comes from, and
collision uses Hermite polynomials.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
RANKS = ("wall", "inlet", "outlet", "slip")
CS2 = 1.0 / 3.0


@dataclass
class Box:
    """A domain and its boundaries.

    Attributes:
        c, w: Velocities [Q, 3] and weights [Q].
        solid: int [X, Y, Z], 0 is fluid.
        faces: For some of `FACES`: one of `RANKS`, and the velocity or the density (None: mass is conserved).
        velocity: Velocity of the solids; or a function that returns that of a body at a point.
    """

    c: np.ndarray
    w: np.ndarray
    solid: np.ndarray
    faces: dict[str, tuple[str, object]] = field(default_factory=dict)
    velocity: Sequence[float] | Callable[[int, np.ndarray], np.ndarray] = (0.0, 0.0, 0.0)

    def crossed(self, source: Sequence[int]) -> list[int]:
        """The faces, by their numbers in `FACES`, beyond which a cell lies; periodic ones don't count."""
        beyond = [out for at, n in zip(source, self.solid.shape, strict=True) for out in (at < 0, at >= n)]
        return [number for number in range(6) if beyond[number] and FACES[number] in self.faces]

    def face_of(self, source: Sequence[int]) -> tuple[str, object] | None:
        """The condition of a population that comes from `source`; None inside or across a periodic face."""
        ranked = []
        for number in self.crossed(source):
            kind, value = self.faces[FACES[number]]
            # Where two walls meet, a wall at rest decides.
            rank = -1 if kind == "wall" and not np.any(value) else RANKS.index(kind)
            ranked.append((rank, number, (kind, value)))
        return min(ranked, key=lambda entry: entry[:2])[2] if ranked else None


def equilibrium(c: np.ndarray, w: np.ndarray, rho: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Second order; rho [...], u [..., 3] -> [..., Q]."""
    cu = u @ c.T
    return w * rho[..., None] * (1 + cu / CS2 + cu**2 / (2 * CS2**2) - (u**2).sum(-1, keepdims=True) / (2 * CS2))


def fields(box: Box, f: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density and velocity of the populations that have arrived, f [X, Y, Z, Q]."""
    rho = f.sum(-1)
    return rho, (f @ box.c + 0.5 * force) / rho[..., None]


def collide(box: Box, f: np.ndarray, viscosity: float, smagorinsky: float, force) -> np.ndarray:
    """The populations that leave each cell, from those that have arrived."""
    c, w, fluid = box.c, box.w, box.solid == 0
    traceless = np.einsum("qa,qb->qab", c, c) - CS2 * np.eye(3) * c.any(0)
    came, push = f[fluid], force[fluid]
    rho = came.sum(1)
    u = came @ c / rho[:, None]
    f_eq, after = equilibrium(c, w, rho, u), equilibrium(c, w, rho, u + push / rho[:, None])
    stress = np.einsum("nq,qa,qb->nab", came - f_eq, c, c)
    # |S| = sqrt(2) 3 |Pi| / (2 rho tau) and tau = tau_0 + 3 C^2 |S|, by iteration to the fixed point.
    tau, previous = np.full(len(rho), 0.5 + 3.0 * viscosity), 0.0
    while np.abs(tau - previous).max() > 1e-15:
        rate = np.sqrt(2.0) * 1.5 / (rho * tau) * np.linalg.norm(stress, axis=(1, 2))
        previous, tau = tau, 0.5 + 3.0 * viscosity + 3.0 * smagorinsky**2 * rate
    keep = 1.0 - 1.0 / tau[:, None]
    axes = np.diag(c.any(0).astype(float))
    shear = stress - axes * np.trace(stress, axis1=1, axis2=2)[:, None, None] / np.trace(axes)
    out = np.empty_like(f)
    out[fluid] = after + keep * w * np.einsum("qab,nab->nq", traceless, shear) / (2 * CS2**2)
    return out


def change_step(box: Box, f: np.ndarray, viscosity: float, smagorinsky: float, force, factor: float) -> np.ndarray:
    """The populations that have arrived, for a step whose duration is changed by a factor.

    Velocity and pressure are those of before; the stress is that of the same strain by the same viscosities.
    """
    c, w, fluid = box.c, box.w, box.solid == 0
    came, push = f[fluid], force[fluid]
    rho = came.sum(1, keepdims=True)
    u = came @ c / rho
    stress = np.einsum("nq,qa,qb->nab", came - equilibrium(c, w, rho[:, 0], u), c, c)
    norm = np.linalg.norm(stress, axis=(1, 2))
    # The total viscosity by the positive root of tau (tau - tau_0) = 9 C^2 |Pi| / (sqrt(2) rho).
    tau0 = 0.5 + 3.0 * viscosity
    tau = 0.5 * (tau0 + np.sqrt(tau0**2 + 18.0 * np.sqrt(2.0) * smagorinsky**2 * norm / rho[:, 0]))
    strain = -3.0 * stress / (2.0 * rho * tau[:, None])[..., None]
    new_rho = 1.0 + factor**2 * (rho - 1.0)
    new_u = factor * (u + 0.5 * push / rho) - 0.5 * factor**2 * push / new_rho
    new_tau = 0.5 + factor * (tau - 0.5)
    new_stress = -2.0 * (rho * new_tau[:, None])[..., None] * factor * strain / 3.0
    projection = np.einsum("qa,qb->qab", c, c) - CS2 * np.eye(3) * c.any(0)
    out = np.zeros_like(f)
    extra = w * np.einsum("qab,nab->nq", projection, new_stress) / (2 * CS2**2)
    out[fluid] = equilibrium(c, w, new_rho[:, 0], new_u) + extra
    return out


def uncover(box: Box, f: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The populations that leave each cell, also those that were solid before: at the mean of the fluid beside them."""
    out = f.copy()
    for cell in np.argwhere((before > 0) & (box.solid == 0)):
        means, weights = [], []
        for q in range(1, len(box.c)):
            beside = cell + box.c[q]
            k = tuple(beside % np.array(box.solid.shape))
            if not box.crossed(beside) and before[k] == 0 and box.solid[k] == 0:
                rho = f[k].sum()
                means.append([rho, *(f[k] @ box.c / rho)])
                weights.append(box.w[q])
        rho, *u = np.average(means, axis=0, weights=weights)
        out[tuple(cell)] = equilibrium(box.c, box.w, np.array(rho), np.array(u))
    return out


def stream(box: Box, f: np.ndarray) -> np.ndarray:
    """The populations that arrive in each cell, from those that left."""
    c, w, shape = box.c, box.w, box.solid.shape
    directions = c.tolist()
    opposite = [int(np.flatnonzero((c == -velocity).all(1))[0]) for velocity in c]
    out = np.zeros_like(f)
    balance, open_weight, balanced = 0.0, 0.0, []
    for cell in np.ndindex(f.shape[:3]):
        if box.solid[cell]:
            continue
        for q, direction in enumerate(directions):
            source = [at - step for at, step in zip(cell, direction, strict=True)]
            leaves = f[cell][opposite[q]]
            face = box.face_of(source)
            if face is None:
                inside = tuple(at % n for at, n in zip(source, shape, strict=True))
                if box.solid[inside]:
                    u = box.velocity
                    if callable(u):
                        u = u(box.solid[inside], np.array(cell) + 0.5 - 0.5 * c[q])
                    out[cell][q] = leaves + 2 * w[q] * (c[q] @ np.asarray(u)) / CS2
                    balance += out[cell][q] - leaves
                else:
                    out[cell][q] = f[inside][q]
                continue
            kind, value = face
            if kind in ("wall", "inlet"):
                out[cell][q] = leaves + 2 * w[q] * (c[q] @ np.asarray(value)) / CS2
            elif kind == "slip":
                out[cell][q] = _mirrored(box, f, cell, q, opposite)
            else:
                rho = f[cell].sum()
                u = f[cell] @ c / rho
                hold = 1.0
                for number in box.crossed(source):
                    axis, high = divmod(number, 2)
                    u[axis] = max(u[axis], 0.0) if high else min(u[axis], 0.0)
                    hold = min(hold, 0.3 / shape[axis])
                if value is not None:
                    rho += hold * (value - rho)
                out[cell][q] = equilibrium(c, w, np.array(rho), u)[q]
                if value is None:
                    balanced.append((cell, q))
                    open_weight += w[q]
            balance += out[cell][q] - leaves
    for cell, q in balanced:
        out[cell][q] -= w[q] * balance / open_weight
    return out


def _mirrored(box: Box, f: np.ndarray, cell: tuple, q: int, opposite: list[int]) -> float:
    turned, along = box.c[q].copy(), box.c[q].copy()
    for number in box.crossed(np.array(cell) - box.c[q]):
        axis = number // 2
        turned[axis], along[axis] = -turned[axis], 0
    neighbour = tuple((np.array(cell) - along) % np.array(box.solid.shape))
    if box.solid[neighbour]:
        return f[cell][opposite[q]]
    return f[neighbour][int(np.flatnonzero((box.c == turned).all(1))[0])]
