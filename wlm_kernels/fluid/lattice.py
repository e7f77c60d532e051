"""The lattice Boltzmann step: streaming and collision in one pass over two buffers.

Read `tests/reference/lattice.py` first: the same step in float64 NumPy, cell by cell.

A cell pulls the populations that arrive, f_q(x, t + 1) = f*_q(x - c_q, t), and writes those that leave, f*. From a wall
at rest that closes an axis it pulls what it sent there (half-way bounce-back). It knows no other boundary: nothing else
reads the element that it would pull from beyond a face or out of a solid, and `lattice_links` writes there what comes
back. So the kernel has no branch but the one that skips solid cells.

Collision, with Kupershtokh's exact difference for a force F; the velocity of the fluid is u + F / (2 rho):

    f* = f_eq(rho, u + F / rho) + R(f - f_eq(rho, u))

- "bgk": R multiplies every population by 1 - 1 / tau, where tau = 1/2 + 3 nu.
- "regularised": R also projects onto the second-order Hermite part, the stress (Latt and Chopard 2006).
- "recursive": the same with all Hermite orders that the lattice carries, those above the second from the stress by
  recursion (Malaspinas 2015; D2Q9 and D3Q27, which are products of one axis).

Except for "bgk" the trace of the stress, which only damps sound, is relaxed in one step: a bulk viscosity of 1/9 (1/6
in two dimensions). Relaxed like the rest, at viscosities near 0 it changes its sign at every step and doesn't decay: in
a jet past a sphere a flutter of period 2 grew to a third of the velocity in 10,000 steps, at 1e-6 and at 1e-4.

Smagorinsky's eddy viscosity nu_t = C^2 |S| adds what the grid can't resolve; with |S| from the non-equilibrium stress
Pi it becomes tau = (tau_0 + sqrt(tau_0^2 + 18 sqrt(2) C^2 |Pi| / rho)) / 2.

The paper names no operator or lattice (section 5 cites Li et al. 2023); plain BGK blows up at its viscosities.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.fluid.lattice_sets import STORAGES, cell_of, lattice, memory_functions

OPERATORS = ("bgk", "regularised", "recursive")
FORCES = ("none", "uniform", "field")

CAUSES = ("the density is not positive", "the speed exceeds that of sound", "not a number")
"""Why a run stops, in the order of their codes."""

QUIET = (1 << 62) - 1
"""The trouble's key as long as there is none."""

# fast_math's approximate quotients and roots enter the stress alone, at 1e-7 of it; density and momentum take none.
_OPTIONS = {"enable_backward": False, "max_unroll": 32, "fast_math": True}

# A key is (step * 2^31 + cell) * 4 + cause, so that the least is that of the first step's first cell.
_CELLS = wp.constant(wp.int64(1 << 31))
_CODES = wp.constant(wp.int64(4))
_SOUND2 = wp.constant(1.0 / 3.0)


def trouble_of(key: int) -> tuple[int, int, str]:
    """The step, the cell and the cause that a key names."""
    place, code = divmod(key, 4)
    step, cell = divmod(place, 1 << 31)
    return step, cell, CAUSES[code]


def eddy_factor(smagorinsky: float) -> float:
    """18 sqrt(2) C^2."""
    return 18.0 * math.sqrt(2.0) * smagorinsky * smagorinsky


@dataclass(frozen=True)
class Spec:
    """Everything that changes the code of a step.

    Attributes:
        lattice: "D2Q9", "D3Q19" or "D3Q27".
        operator: One of `OPERATORS`.
        storage: "float32" or "float16".
        eddies: Whether Smagorinsky's C is above 0.
        solids: Whether any cell may be solid.
        force: One of `FORCES`.
        walls: The axes of which both faces are walls at rest.
        wide: Whether elements are indexed in 64 bits, see `lattice_sets.memory_functions`.
    """

    lattice: str
    operator: str = "regularised"
    storage: str = "float32"
    eddies: bool = True
    solids: bool = False
    force: str = "none"
    walls: tuple[bool, bool, bool] = (False, False, False)
    wide: bool = False

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("operator", self.operator, OPERATORS),
            ("storage", self.storage, tuple(STORAGES)),
            ("force", self.force, FORCES),
        ):
            if value not in allowed:
                raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {value!r}")
        if self.operator == "recursive" and lattice(self.lattice).name == "D3Q19":
            raise ValueError("operator: 'recursive' needs D2Q9 or D3Q27, got D3Q19")


@functools.cache
def _relax(spec: Spec) -> Any:
    """Builds (once) the collision of a cell: scaled populations that arrived, and their moments -> those that leave."""
    velocities = lattice(spec.lattice)
    c, w, axes, flat = velocities.c, velocities.w, velocities.axes, velocities.axes == 2
    vec = memory_functions(spec.lattice, spec.storage, spec.walls, spec.wide).vec
    # Populations are linear in the moments: to scale these, or the weights, is less work than to scale all populations.
    scale = STORAGES[spec.storage][1]
    pairs, size = len(c) // 2, 3**axes
    vec_hermite = wp.types.vector(size, float)
    # Orders along x, y and z of each Hermite coefficient, and the place of each velocity's population among them.
    order = [(k // 9, k // 3 % 3, k % 3) if axes == 3 else (k // 3, k % 3, 0) for k in range(size)]
    slot = [order.index((x + 1, y + 1, 0 if flat else z + 1)) for x, y, z in c]
    steps = (9, 3, 1) if axes == 3 else (3, 1)
    first = [[k for k in range(size) if order[k][a] == 0] for a in range(axes)]

    @wp.func
    def hermite(drho: float, j: wp.vec3, diagonal: wp.vec3, off: wp.vec3) -> vec:
        """Populations of the moments density, momentum and stress, the last as Hermite coefficients."""
        out = vec()
        rest = drho - 1.5 * (diagonal[0] + diagonal[1] + diagonal[2])
        out[0] = wp.static(w[0] * scale) * rest
        for h in range(wp.static(pairs)):
            even = float(rest)
            odd = float(0.0)
            for a in range(3):
                if wp.static(c[2 * h + 1][a] != 0):
                    even += 4.5 * diagonal[a]
                    odd += wp.static(3.0 * c[2 * h + 1][a]) * j[a]
            if wp.static(c[2 * h + 1][0] * c[2 * h + 1][1] != 0):
                even += wp.static(9.0 * c[2 * h + 1][0] * c[2 * h + 1][1]) * off[0]
            if wp.static(c[2 * h + 1][0] * c[2 * h + 1][2] != 0):
                even += wp.static(9.0 * c[2 * h + 1][0] * c[2 * h + 1][2]) * off[1]
            if wp.static(c[2 * h + 1][1] * c[2 * h + 1][2] != 0):
                even += wp.static(9.0 * c[2 * h + 1][1] * c[2 * h + 1][2]) * off[2]
            out[2 * h + 1] = wp.static(w[2 * h + 1] * scale) * (even + odd)
            out[2 * h + 2] = wp.static(w[2 * h + 1] * scale) * (even - odd)
        return out

    @wp.func
    def product(drho: float, u: wp.vec3, after: wp.vec3, diagonal: wp.vec3, off: wp.vec3) -> vec:
        """Equilibrium of all orders at `after`, plus a stress and the orders that follow from it at `u`."""
        unit = wp.static(scale)
        mass = unit * (1.0 + drho)
        trace = unit * diagonal
        skew = unit * off
        ux = wp.vec3(1.0, u[0], u[0] * u[0])
        uy = wp.vec3(1.0, u[1], u[1] * u[1])
        uz = wp.vec3(1.0, u[2], u[2] * u[2])
        vx = wp.vec3(1.0, after[0], after[0] * after[0])
        vy = wp.vec3(1.0, after[1], after[1] * after[1])
        vz = wp.vec3(1.0, after[2], after[2] * after[2])
        a = vec_hermite()
        a[0] = unit * drho
        for k in range(1, wp.static(size)):
            t = mass * vx[wp.static(order[k][0])] * vy[wp.static(order[k][1])] * vz[wp.static(order[k][2])]
            # Each pair of indices takes its stress, the others their velocity.
            if wp.static(order[k][0] == 2):
                t += trace[0] * uy[wp.static(order[k][1])] * uz[wp.static(order[k][2])]
            if wp.static(order[k][1] == 2):
                t += trace[1] * ux[wp.static(order[k][0])] * uz[wp.static(order[k][2])]
            if wp.static(order[k][2] == 2):
                t += trace[2] * ux[wp.static(order[k][0])] * uy[wp.static(order[k][1])]
            if wp.static(order[k][0] * order[k][1] > 0):
                s = skew[0] * ux[wp.static(order[k][0] - 1)] * uy[wp.static(order[k][1] - 1)]
                t += wp.static(float(order[k][0] * order[k][1])) * s * uz[wp.static(order[k][2])]
            if wp.static(order[k][0] * order[k][2] > 0):
                s = skew[1] * ux[wp.static(order[k][0] - 1)] * uz[wp.static(order[k][2] - 1)]
                t += wp.static(float(order[k][0] * order[k][2])) * s * uy[wp.static(order[k][1])]
            if wp.static(order[k][1] * order[k][2] > 0):
                s = skew[2] * uy[wp.static(order[k][1] - 1)] * uz[wp.static(order[k][2] - 1)]
                t += wp.static(float(order[k][1] * order[k][2])) * s * ux[wp.static(order[k][0])]
            a[k] = t
        # Coefficients to populations, an axis at a time: of 1, c and c^2 - 1/3 with weights 1/6, 2/3, 1/6.
        for axis in range(wp.static(axes)):
            for k in range(wp.static(size // 3)):
                low = a[wp.static(first[axis][k])]
                mid = a[wp.static(first[axis][k] + steps[axis])]
                top = a[wp.static(first[axis][k] + 2 * steps[axis])]
                even = low / 6.0 + 0.5 * top
                a[wp.static(first[axis][k])] = even - 0.5 * mid
                a[wp.static(first[axis][k] + steps[axis])] = wp.static(2.0 / 3.0) * low - top
                a[wp.static(first[axis][k] + 2 * steps[axis])] = even + 0.5 * mid
        out = vec()
        for q in range(wp.static(len(c))):
            out[q] = a[wp.static(slot[q])]
        return out

    @wp.func
    def relax(
        g: vec, drho: float, j: wp.vec3, diagonal: wp.vec3, off: wp.vec3, force: wp.vec3, tau: float, eddy: float
    ) -> vec:
        rho = 1.0 + drho
        # One division by the density serves all of the step.
        inverse = 1.0 / rho
        u = inverse * j
        after = inverse * (j + force)
        third = wp.static(1.0 / 3.0) * drho
        # The stress of the equilibrium, and the non-equilibrium stress, which is that of the flow's strain.
        eq_diagonal = wp.cw_mul(j, u)
        eq_off = wp.vec3(j[0] * u[1], j[0] * u[2], j[1] * u[2])
        neq_diagonal = diagonal - eq_diagonal - wp.vec3(third, third, third)
        if wp.static(flat):
            neq_diagonal = wp.vec3(neq_diagonal[0], neq_diagonal[1], 0.0)
        neq_off = off - eq_off
        tau_eddy = float(tau)
        if wp.static(spec.eddies):
            norm2 = wp.dot(neq_diagonal, neq_diagonal) + 2.0 * wp.dot(neq_off, neq_off)
            tau_eddy = 0.5 * (tau + wp.sqrt(tau * tau + eddy * inverse * wp.sqrt(norm2)))
        keep = 1.0 - 1.0 / tau_eddy
        if wp.static(spec.operator != "bgk"):
            mean = wp.static(1.0 / axes) * (neq_diagonal[0] + neq_diagonal[1] + neq_diagonal[2])
            neq_diagonal -= wp.vec3(mean, mean, wp.static(0.0 if flat else 1.0) * mean)
        if wp.static(spec.operator == "bgk"):
            equilibrium = hermite(drho, j, eq_diagonal, eq_off)
            if wp.static(spec.force == "none"):
                return equilibrium + keep * (g - equilibrium)
            cross = wp.vec3(after[0] * after[1], after[0] * after[2], after[1] * after[2])
            forced = hermite(drho, rho * after, rho * wp.cw_mul(after, after), rho * cross)
            return forced + keep * (g - equilibrium)
        if wp.static(spec.operator == "recursive"):
            return product(drho, u, after, keep * neq_diagonal, keep * neq_off)
        if wp.static(spec.force == "none"):
            return hermite(drho, j, eq_diagonal + keep * neq_diagonal, eq_off + keep * neq_off)
        cross = wp.vec3(after[0] * after[1], after[0] * after[2], after[1] * after[2])
        stress = rho * wp.cw_mul(after, after) + keep * neq_diagonal
        return hermite(drho, rho * after, stress, rho * cross + keep * neq_off)

    return relax


@functools.cache
def step_kernel(spec: Spec) -> wp.Kernel:
    """Builds (once) the step of a spec, over all cells.

    Args of the kernel:
        n: Cells along x, y and z.
        f: [Q, N], the populations that left every cell in the last step.
        solid: uint8 [N], above 0 where a cell is solid; used if `spec.solids`.
        tau: Relaxation time, 1/2 + 3 nu.
        eddy: `eddy_factor`, used if `spec.eddies`.
        force: Force on a cell's fluid, used if `spec.force` is "uniform".
        forces: vec3 [N], used if it is "field".
        parity: Which of the two elements of `clock` is this step's.
        clock: int [2], counts steps.
        trouble: int64 [1], lowered to the key of the first cell that went wrong.
        sums: float64 [2], set to 0 for `lattice_links`.
        out: [Q, N], the populations that leave every cell now.
    """
    memory, relax = memory_functions(spec.lattice, spec.storage, spec.walls, spec.wide), _relax(spec)
    gather, moments, put = memory.gather, memory.moments, memory.put
    stored, count_q = STORAGES[spec.storage][0], len(lattice(spec.lattice).c)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def step(
        # in:
        n: wp.vec3i,
        f: wp.array2d[stored],
        solid: wp.array1d[wp.uint8],
        tau: float,
        eddy: float,
        force: wp.vec3,
        forces: wp.array1d[wp.vec3],
        parity: int,
        # out:
        clock: wp.array1d[int],
        trouble: wp.array1d[wp.int64],
        sums: wp.array1d[wp.float64],
        out: wp.array2d[stored],
    ):
        i = wp.tid()
        if i == 0:
            clock[1 - parity] = clock[parity] + 1
            sums[0] = wp.float64(0.0)
            sums[1] = wp.float64(0.0)
        if wp.static(spec.solids):
            if solid[i] != wp.uint8(0):
                return
        g = gather(f, n, cell_of(n, i))
        drho, j, diagonal, off = moments(g)
        rho = 1.0 + drho
        j2 = wp.dot(j, j)
        if not (rho > 0.0 and j2 < _SOUND2 * rho * rho):
            code = int(1)
            if not (j2 >= 0.0):
                code = 2
            elif rho <= 0.0:
                code = 0
            key = wp.int64(clock[parity]) * _CELLS + wp.int64(i)
            wp.atomic_min(trouble, 0, key * _CODES + wp.int64(code))
        push = wp.vec3()
        if wp.static(spec.force == "uniform"):
            push = force
        if wp.static(spec.force == "field"):
            push = forces[i]
        g = relax(g, drho, j, diagonal, off, push, tau, eddy)
        for q in range(wp.static(count_q)):
            put(out, q, i, g[q])

    return step
