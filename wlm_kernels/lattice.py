"""The lattice Boltzmann step: streaming and collision in one pass over two buffers, and the fields that it carries.

A cell pulls what arrives, f_q(x, t + 1) = f*_q(x - c_q, t), and writes what leaves, f*. It knows no boundary: the
place that it would pull from beyond a wall or a face is one that nobody else reads, and ``lattice_links`` puts there
what comes back. So the kernel has no branch but the one that skips solid cells.

Collision operators, all by way of f* = f_eq(rho, u + F / rho) + R(f - f_eq(rho, u)), which is Kupershtokh's exact
difference for the force F; the velocity of the fluid is u + F / (2 rho):

- "bgk": R = 1 - 1 / tau of every population.
- "regularised": R keeps of them but the stress, the second-order Hermite part (Latt and Chopard 2006).
- "recursive": all Hermite orders that the lattice carries, those above the second from the stress by recursion
  (Malaspinas 2015; D2Q9 and D3Q27, whose sets are products of one axis).

With Smagorinsky's C the relaxation time is raised by the eddies that the grid can't hold, nu_t = C^2 |S|, and |S|
comes from the stress at hand: tau = (tau_0 + sqrt(tau_0^2 + 18 sqrt(2) C^2 |Pi| / rho)) / 2.

The paper names no operator or lattice (section 5 cites Li et al. 2023); plain BGK blows up at its viscosities.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.lattice_sets import (
    BRICK_CELLS,
    STORAGES,
    Tables,
    cell_in_brick,
    cell_of,
    crosses,
    equilibrium,
    index_of,
    lattice,
    memory_functions,
    wrapped,
)
from wlm_kernels.lattice_solids import Bodies, body_velocity

__all__ = [
    "CAUSES",
    "FORCES",
    "OPERATORS",
    "QUIET",
    "Spec",
    "eddy_factor",
    "fluid_kernels",
    "step_kernel",
    "trouble_of",
]

OPERATORS = ("bgk", "regularised", "recursive")
FORCES = ("none", "uniform", "field")

CAUSES = ("the density is not positive", "the speed exceeds that of sound", "not a number")
"""Why a run stops, in the order of their codes."""

QUIET = (1 << 62) - 1
"""What the trouble's key holds as long as there is none."""

# A key is (step * 2^31 + cell) * 4 + cause, so that the least one is the first step's first cell.
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
        operator: One of ``OPERATORS``.
        storage: "float32" or "float16".
        eddies: Whether Smagorinsky's C is above 0.
        solids: Whether any cell may be solid.
        force: One of ``FORCES``.
        bricks: Whether only listed bricks are worked on.
    """

    lattice: str
    operator: str = "regularised"
    storage: str = "float32"
    eddies: bool = True
    solids: bool = False
    force: str = "none"
    bricks: bool = False

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
    """Builds (once) the collision of a cell: what arrived and its moments -> what leaves."""
    found = lattice(spec.lattice)
    c, w, flat = found.c, found.w, found.axes == 2
    vec = memory_functions(spec.lattice, spec.storage).vec
    pairs, size = len(c) // 2, 3**found.axes
    vec_hermite = wp.types.vector(size, float)
    # Orders along x, y and z of each Hermite coefficient, and where a velocity's population ends up among them.
    order = [(k // 9, k // 3 % 3, k % 3) if found.axes == 3 else (k // 3, k % 3, 0) for k in range(size)]
    slot = [order.index((x + 1, y + 1, 0 if flat else z + 1)) for x, y, z in c]
    steps = (9, 3, 1) if found.axes == 3 else (3, 1)
    first = [[k for k in range(size) if order[k][a] == 0] for a in range(found.axes)]

    @wp.func
    def hermite(drho: float, j: wp.vec3, diagonal: wp.vec3, off: wp.vec3) -> vec:
        """The populations of given moments: density, momentum and stress, the latter as Hermite coefficients."""
        out = vec()
        rest = drho - 1.5 * (diagonal[0] + diagonal[1] + diagonal[2])
        out[0] = wp.static(w[0]) * rest
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
            out[2 * h + 1] = wp.static(w[2 * h + 1]) * (even + odd)
            out[2 * h + 2] = wp.static(w[2 * h + 1]) * (even - odd)
        return out

    @wp.func
    def product(drho: float, u: wp.vec3, after: wp.vec3, diagonal: wp.vec3, off: wp.vec3) -> vec:
        """Equilibrium of all orders at ``after``, and a stress with what follows from it at ``u``."""
        rho = 1.0 + drho
        ux = wp.vec3(1.0, u[0], u[0] * u[0])
        uy = wp.vec3(1.0, u[1], u[1] * u[1])
        uz = wp.vec3(1.0, u[2], u[2] * u[2])
        vx = wp.vec3(1.0, after[0], after[0] * after[0])
        vy = wp.vec3(1.0, after[1], after[1] * after[1])
        vz = wp.vec3(1.0, after[2], after[2] * after[2])
        a = vec_hermite()
        a[0] = drho
        for k in range(1, wp.static(size)):
            t = rho * vx[wp.static(order[k][0])] * vy[wp.static(order[k][1])] * vz[wp.static(order[k][2])]
            # Each pair of indices takes its stress, the others their velocity.
            if wp.static(order[k][0] == 2):
                t += diagonal[0] * uy[wp.static(order[k][1])] * uz[wp.static(order[k][2])]
            if wp.static(order[k][1] == 2):
                t += diagonal[1] * ux[wp.static(order[k][0])] * uz[wp.static(order[k][2])]
            if wp.static(order[k][2] == 2):
                t += diagonal[2] * ux[wp.static(order[k][0])] * uy[wp.static(order[k][1])]
            if wp.static(order[k][0] * order[k][1] > 0):
                s = off[0] * ux[wp.static(order[k][0] - 1)] * uy[wp.static(order[k][1] - 1)]
                t += wp.static(float(order[k][0] * order[k][1])) * s * uz[wp.static(order[k][2])]
            if wp.static(order[k][0] * order[k][2] > 0):
                s = off[1] * ux[wp.static(order[k][0] - 1)] * uz[wp.static(order[k][2] - 1)]
                t += wp.static(float(order[k][0] * order[k][2])) * s * uy[wp.static(order[k][1])]
            if wp.static(order[k][1] * order[k][2] > 0):
                s = off[2] * uy[wp.static(order[k][1] - 1)] * uz[wp.static(order[k][2] - 1)]
                t += wp.static(float(order[k][1] * order[k][2])) * s * ux[wp.static(order[k][0])]
            a[k] = t
        # Coefficients to populations, an axis at a time: of 1, c and c^2 - 1/3 with weights 1/6, 2/3, 1/6.
        for axis in range(wp.static(found.axes)):
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
        g: vec,
        drho: float,
        j: wp.vec3,
        diagonal: wp.vec3,
        off: wp.vec3,
        push: wp.vec3,
        tau: float,
        eddy: float,
    ) -> vec:
        rho = 1.0 + drho
        u = j / rho
        after = (j + push) / rho
        third = wp.static(1.0 / 3.0) * drho
        # The equilibrium's stress, and the rest, which is what friction makes of the flow.
        calm = wp.cw_mul(j, u)
        skew = wp.vec3(j[0] * u[1], j[0] * u[2], j[1] * u[2])
        strain = diagonal - calm - wp.vec3(third, third, third)
        if wp.static(flat):
            strain = wp.vec3(strain[0], strain[1], 0.0)
        shear = off - skew
        longer = float(tau)
        if wp.static(spec.eddies):
            size2 = wp.dot(strain, strain) + 2.0 * wp.dot(shear, shear)
            longer = 0.5 * (tau + wp.sqrt(tau * tau + eddy * wp.sqrt(size2) / rho))
        keep = 1.0 - 1.0 / longer
        if wp.static(spec.operator == "bgk"):
            before = hermite(drho, j, calm, skew)
            if wp.static(spec.force == "none"):
                return before + keep * (g - before)
            moved = wp.vec3(after[0] * after[1], after[0] * after[2], after[1] * after[2])
            return hermite(drho, rho * after, rho * wp.cw_mul(after, after), rho * moved) + keep * (g - before)
        if wp.static(spec.operator == "recursive"):
            return product(drho, u, after, keep * strain, keep * shear)
        if wp.static(spec.force == "none"):
            return hermite(drho, j, calm + keep * strain, skew + keep * shear)
        moved = wp.vec3(after[0] * after[1], after[0] * after[2], after[1] * after[2])
        return hermite(drho, rho * after, rho * wp.cw_mul(after, after) + keep * strain, rho * moved + keep * shear)

    return relax


@functools.cache
def step_kernel(spec: Spec) -> wp.Kernel:
    """Builds (once) the step of a spec.

    Launched over all cells; with bricks over ``BRICK_CELLS`` times any number of workers, which share out the list.

    Args of the kernel:
        n: Cells along x, y and z.
        f: [Q, N], what left every cell in the last step.
        solid: uint8 [N], above 0 where a cell is solid; used if ``spec.solids``.
        tau: 1/2 + 3 nu.
        eddy: ``eddy_factor``, used if ``spec.eddies``.
        push: Force on a cell's fluid, used if ``spec.force`` is "uniform".
        pushes: vec3 [N], used if it is "field".
        brick, listed, count, workers, quiet: A brick's cells; the bricks to work on and their number, on the device;
            how many workers share them; the square of the deviation from rest above which a brick counts as busy.
        parity: Which of the two numbers of ``clock`` is this step's.
        clock: int [2], counts steps.
        trouble: int64 [1], lowered to the key of the first cell that went wrong.
        busy: int [bricks], set to 1 where a brick isn't at rest.
        sums: float64 [2], set to 0 for ``lattice_links``.
        out: [Q, N], what leaves every cell now.
    """
    memory, relax = memory_functions(spec.lattice, spec.storage), _relax(spec)
    gather, moments, store = memory.gather, memory.moments, memory.store
    stored, count_q = STORAGES[spec.storage][0], len(lattice(spec.lattice).c)

    @wp.func
    def advance(
        n: wp.vec3i,
        f: wp.array2d[stored],
        p: wp.vec3i,
        i: int,
        solid: wp.array1d[wp.uint8],
        tau: float,
        eddy: float,
        push: wp.vec3,
        pushes: wp.array1d[wp.vec3],
        parity: int,
        clock: wp.array1d[int],
        trouble: wp.array1d[wp.int64],
        out: wp.array2d[stored],
    ) -> float:
        """Does one cell; gives the square of its deviation from rest."""
        if wp.static(spec.solids):
            if solid[i] != wp.uint8(0):
                return 0.0
        g = gather(f, n, p)
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
        force = wp.vec3()
        if wp.static(spec.force == "uniform"):
            force = push
        if wp.static(spec.force == "field"):
            force = pushes[i]
        g = relax(g, drho, j, diagonal, off, force, tau, eddy)
        for q in range(wp.static(count_q)):
            store(out, q, i, g[q])
        return j2 + drho * drho

    @wp.kernel(module="unique", module_options={"enable_backward": False, "max_unroll": 32})
    def step(
        # in:
        n: wp.vec3i,
        f: wp.array2d[stored],
        solid: wp.array1d[wp.uint8],
        tau: float,
        eddy: float,
        push: wp.vec3,
        pushes: wp.array1d[wp.vec3],
        brick: wp.vec3i,
        listed: wp.array1d[int],
        count: wp.array1d[int],
        workers: int,
        quiet: float,
        parity: int,
        # out:
        clock: wp.array1d[int],
        trouble: wp.array1d[wp.int64],
        busy: wp.array1d[int],
        sums: wp.array1d[wp.float64],
        out: wp.array2d[stored],
    ):
        i = wp.tid()
        if i == 0:
            clock[1 - parity] = clock[parity] + 1
            sums[0] = wp.float64(0.0)
            sums[1] = wp.float64(0.0)
        if wp.static(spec.bricks):
            for k in range(i // BRICK_CELLS, count[0], workers):
                b = listed[k]
                p = cell_in_brick(n, brick, b, i % BRICK_CELLS)
                if p[0] < n[0] and p[1] < n[1] and p[2] < n[2]:
                    away = advance(n, f, p, index_of(n, p), solid, tau, eddy, push, pushes, parity, clock, trouble, out)
                    if away > quiet:
                        busy[b] = 1
        else:
            p = cell_of(n, i)
            advance(n, f, p, i, solid, tau, eddy, push, pushes, parity, clock, trouble, out)

    return step


@dataclass(frozen=True)
class FluidKernels:
    """Of one lattice and storage.

    Attributes:
        fields: What the fluid does, over all cells.
        start: Sets all cells to an equilibrium, over all cells.
        neighbours: The mean of the fluid around each cell that stops being solid, over all cells.
        uncover: Sets those cells to it, over all cells.
    """

    fields: wp.Kernel
    start: wp.Kernel
    neighbours: wp.Kernel
    uncover: wp.Kernel


@functools.cache
def fluid_kernels(lattice_name: str, storage: str) -> FluidKernels:
    """Builds (once) the kernels of a lattice and a storage that are not run at every step."""
    memory = memory_functions(lattice_name, storage)
    gather, moments, load, store = memory.gather, memory.moments, memory.load, memory.store
    stored = STORAGES[storage][0]
    options = {"enable_backward": False, "max_unroll": 32}

    @wp.func
    def settle(t: Tables, n: wp.vec3i, bounded: wp.vec3i, p: wp.vec3i, drho: float, u: wp.vec3, f: wp.array2d[stored]):
        """Sets what leaves a cell, and what comes to it from beyond the domain's faces."""
        i = index_of(n, p)
        for q in range(t.w.shape[0]):
            value = equilibrium(t.w[q], t.c[q], drho, u)
            # What leaves through a face has no place: the one it would take is that of what comes in opposite.
            if not crosses(n, bounded, p + t.c[q]):
                store(f, q, i, value)
            if crosses(n, bounded, p - t.c[q]):
                store(f, q, index_of(n, wrapped(n, p - t.c[q])), value)

    @wp.kernel(module="unique", module_options=options)
    def fields(
        # in:
        n: wp.vec3i,
        f: wp.array2d[stored],
        solid: wp.array1d[wp.uint8],
        bodies: Bodies,
        push: wp.vec3,
        pushes: wp.array1d[wp.vec3],
        # out:
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
    ):
        i = wp.tid()
        p = cell_of(n, i)
        excess = float(0.0)
        v = wp.vec3()
        inside = int(0)
        if solid.shape[0] > 0:
            inside = int(solid[i])
        if inside > 0:
            v = body_velocity(bodies, inside, p)
        else:
            excess, j, _diagonal, _off = moments(gather(f, n, p))
            half = 0.5 * push
            if pushes.shape[0] > 0:
                half += 0.5 * pushes[i]
            v = (j + half) / (1.0 + excess)
        if drho.shape[0] > 0:
            drho[i] = excess
        if u.shape[0] > 0:
            u[i] = v

    @wp.kernel(module="unique", module_options=options)
    def start(
        # in:
        t: Tables,
        n: wp.vec3i,
        bounded: wp.vec3i,
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
        # out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        settle(t, n, bounded, cell_of(n, i), drho[i], u[i], f)

    @wp.kernel(module="unique", module_options=options)
    def neighbours(
        # in:
        t: Tables,
        n: wp.vec3i,
        bounded: wp.vec3i,
        f: wp.array2d[stored],
        old: wp.array1d[wp.uint8],
        new: wp.array1d[wp.uint8],
        # out:
        spare: wp.array2d[stored],
    ):
        i = wp.tid()
        if old[i] == wp.uint8(0) or new[i] != wp.uint8(0):
            return
        p = cell_of(n, i)
        total = wp.vec4()
        weight = float(0.0)
        for q in range(1, t.w.shape[0]):
            beside = p + t.c[q]
            if not crosses(n, bounded, beside):
                other = wrapped(n, beside)
                k = index_of(n, other)
                if old[k] == wp.uint8(0) and new[k] == wp.uint8(0):
                    excess, j, _diagonal, _off = moments(gather(f, n, other))
                    rho = 1.0 + excess
                    total += t.w[q] * wp.vec4(excess, j[0] / rho, j[1] / rho, j[2] / rho)
                    weight += t.w[q]
        if weight > 0.0:
            total = total / weight
        for k in range(4):
            store(spare, k, i, total[k])

    @wp.kernel(module="unique", module_options=options)
    def uncover(
        # in:
        t: Tables,
        n: wp.vec3i,
        bounded: wp.vec3i,
        old: wp.array1d[wp.uint8],
        new: wp.array1d[wp.uint8],
        # in, out:
        spare: wp.array2d[stored],
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        if old[i] == wp.uint8(0) or new[i] != wp.uint8(0):
            return
        drho = load(spare, 0, i)
        u = wp.vec3(load(spare, 1, i), load(spare, 2, i), load(spare, 3, i))
        for k in range(4):
            store(spare, k, i, 0.0)
        settle(t, n, bounded, cell_of(n, i), drho, u, f)

    return FluidKernels(fields, start, neighbours, uncover)
