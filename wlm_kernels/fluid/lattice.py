"""The lattice Boltzmann step: streaming and collision in one pass, over two arrays or in place.

Read `tests/reference/lattice.py` first: it is the same step in float64 NumPy, cell by cell.

A cell reads the populations that arrive, f_q(x, t + 1) = f*_q(x - c_q, t), and writes the populations that leave, f*,
into another array or, in place, into the same elements, which no other cell reads (`lattice_sets.MemoryFunctions`). At
a wall at rest that closes a whole axis the population that the cell sent there itself arrives (half-way bounce-back).
All other boundaries are the work of `lattice_links`: the value that the boundary returns is written after the step into
the element of the population that arrives from beyond a face or out of a solid.

Collision, with Kupershtokh's exact difference for a force F; the velocity of the fluid is u + F / (2 rho):

    f* = f_eq(rho, u + F / rho) + R(f - f_eq(rho, u))

R projects onto the second-order Hermite part, the stress (Latt and Chopard 2006), multiplies it by 1 - 1 / tau, where
tau = 1/2 + 3 nu, and relaxes the trace of the stress, which only damps sound, in one step: a bulk viscosity of 1/9 (1/6
in two dimensions). Relaxed like the rest, the trace changes its sign at every step at viscosities near 0 and does not
decay: in a jet past a sphere a flutter of period 2 grew to a third of the velocity in 10,000 steps, at viscosities 1e-6
and 1e-4.

Smagorinsky's eddy viscosity nu_t = C^2 |S| adds what the grid cannot resolve; with |S| from the non-equilibrium stress
Pi it becomes tau = (tau_0 + sqrt(tau_0^2 + 18 sqrt(2) C^2 |Pi| / rho)) / 2.

The paper names neither operator nor lattice (section 5 cites Li et al. 2023); plain BGK blows up at its viscosities.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.fluid.lattice_sets import PAIRS, STORAGES, lattice, memory_functions

CAUSES = ("the density is not positive", "the speed exceeds that of sound", "not a number")
"""Reasons why a run stops, in the order of their codes."""

QUIET = (1 << 62) - 1
"""Key of an error while there is none."""

# fast_math's approximate quotients and roots affect only the stress, by 1e-7 of it, not density and momentum.
_OPTIONS = {"enable_backward": False, "max_unroll": 32, "fast_math": True}

# A key is (step * 2^31 + cell) * 4 + cause, so that the smallest key is that of the first cell in the first step.
_CELLS = wp.constant(wp.int64(1 << 31))
_CODES = wp.constant(wp.int64(4))
_ALL = wp.constant(wp.vec3i(1, 1, 1))
_SOUND2 = wp.constant(1.0 / 3.0)


def trouble_of(key: int) -> tuple[int, int, str]:
    """Returns the step, the index of the cell and the cause (one of `CAUSES`) that an error's key encodes."""
    place, code = divmod(key, 4)
    step, cell = divmod(place, 1 << 31)
    return step, cell, CAUSES[code]


def eddy_factor(smagorinsky: float) -> float:
    """Computes 18 sqrt(2) C^2, the factor in Smagorinsky's eddy viscosity; C = `smagorinsky`."""
    return 18.0 * math.sqrt(2.0) * smagorinsky * smagorinsky


@dataclass(frozen=True)
class Spec:
    """The settings of a lattice Boltzmann step for which its kernel is specialised.

    Attributes:
        lattice: "D2Q9", "D3Q19" or "D3Q27".
        storage: "float32" or "float16".
        eddies: Whether Smagorinsky's C is above 0.
        solids: Whether any cell may be solid.
        forced: Whether a force acts on the fluid.
        walls: For each axis whether both of its faces are walls at rest.
        wide: Whether elements are indexed in 64 bits, see `lattice_sets.memory_functions`.
        in_place: Whether a step writes into the array that it reads.
        group: Number of cells that a thread computes, see `lattice_sets.MemoryFunctions`.
    """

    lattice: str
    storage: str = "float32"
    eddies: bool = True
    solids: bool = False
    forced: bool = False
    walls: tuple[bool, bool, bool] = (False, False, False)
    wide: bool = False
    in_place: bool = False
    group: int = 1

    def __post_init__(self) -> None:
        lattice(self.lattice)
        if self.storage not in STORAGES:
            raise ValueError(f"storage: expected one of {', '.join(STORAGES)}, got {self.storage!r}")


@functools.cache
def _relax(spec: Spec) -> Any:
    """Builds (once) the collision: a function from the populations that arrive at a cell to the ones that leave it."""
    velocities = lattice(spec.lattice)
    c, w, axes, flat = velocities.c, velocities.w, velocities.axes, velocities.axes == 2
    vec = memory_functions(spec.lattice, spec.storage, spec.walls, spec.wide).vec
    # Populations are linear in the moments, and scaling the weights is less work than scaling all populations.
    scale = STORAGES[spec.storage][1]
    pairs = len(c) // 2

    @wp.func
    def hermite(drho: float, j: wp.vec3, diagonal: wp.vec3, off: wp.vec3) -> vec:
        """Returns the populations with a given density minus 1, momentum, and stress (as Hermite coefficients)."""
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
                if wp.static(c[2 * h + 1][PAIRS[a][0]] * c[2 * h + 1][PAIRS[a][1]] != 0):
                    even += wp.static(9.0 * c[2 * h + 1][PAIRS[a][0]] * c[2 * h + 1][PAIRS[a][1]]) * off[a]
            out[2 * h + 1] = wp.static(w[2 * h + 1] * scale) * (even + odd)
            out[2 * h + 2] = wp.static(w[2 * h + 1] * scale) * (even - odd)
        return out

    @wp.func
    def relax(drho: float, j: wp.vec3, diagonal: wp.vec3, off: wp.vec3, force: wp.vec3, tau: float, eddy: float) -> vec:
        rho = 1.0 + drho
        # The only division by the density in the step.
        inverse = 1.0 / rho
        u = inverse * j
        third = wp.static(1.0 / 3.0) * drho
        # The equilibrium stress, and the non-equilibrium stress, which the strain of the flow causes.
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
        mean = wp.static(1.0 / axes) * (neq_diagonal[0] + neq_diagonal[1] + neq_diagonal[2])
        neq_diagonal -= wp.vec3(mean, mean, wp.static(0.0 if flat else 1.0) * mean)
        # The equilibrium after the force has acted; rho (u + F / rho) is j + F.
        momentum = wp.vec3(j)
        if wp.static(spec.forced):
            momentum = j + force
        after = inverse * momentum
        after_diagonal = wp.cw_mul(momentum, after)
        after_off = wp.vec3(momentum[0] * after[1], momentum[0] * after[2], momentum[1] * after[2])
        return hermite(drho, momentum, after_diagonal + keep * neq_diagonal, after_off + keep * neq_off)

    return relax


@functools.cache
def step_kernel(spec: Spec) -> wp.Kernel:
    """Builds (once) the kernel that does a step with the settings of a spec, one thread per group of cells
    of a slab.

    Args of the kernel, for N cells and Q velocities:
        first: Index of the slab's first cell.
        n: Cells along x, y and z.
        f: [Q, N], the populations that left every cell in the last step; in place, of parity `parity`.
        solid: uint8 [N], above 0 where a cell is solid; used if `spec.solids`.
        tau: Relaxation time, 1/2 + 3 nu.
        eddy: `eddy_factor`, used if `spec.eddies`.
        forces: vec3 [N], acceleration of each cell's fluid in cells per step squared, used if `spec.forced`.
        parity: 0 or 1: `clock[parity]` is the number of steps done; the step writes one more to the other element.
        clock: int [2], counts steps.
        trouble: int64 [1], lowered to the key of the first cell in which the flow blew up, see `trouble_of`.
        sums: float64 [2 P], set to 0, for `lattice_links.apply`.
        out: [Q, N], the populations that leave every cell in this step: in place `f`, else another array.
    """
    settings = spec.lattice, spec.storage, spec.walls, spec.wide, spec.in_place, spec.group
    memory, relax, group, count = memory_functions(*settings), _relax(spec), spec.group, len(lattice(spec.lattice).c)
    gather, moments, scatter, stored = memory.gather, memory.moments, memory.scatter, STORAGES[spec.storage][0]
    vec, cell_vec = memory.vec, wp.types.vector(count, float)

    # A loop over blocks, which no launch here needs, would take a tenth of the instructions.
    @wp.kernel(module="unique", module_options=_OPTIONS, grid_stride=False)
    def step(
        # in:
        first: int,
        n: wp.vec3i,
        f: wp.array2d[stored],
        solid: wp.array1d[wp.uint8],
        tau: float,
        eddy: float,
        forces: wp.array1d[wp.vec3],
        parity: int,
        # out:
        clock: wp.array1d[int],
        trouble: wp.array1d[wp.int64],
        sums: wp.array1d[wp.float64],
        out: wp.array2d[stored],
    ):
        i = first + group * wp.tid()
        if i == 0:
            clock[1 - parity] = clock[parity] + 1
            for k in range(sums.shape[0]):
                sums[k] = wp.float64(0.0)
        covered = int(0)
        if wp.static(spec.solids):
            for m in range(wp.static(group)):
                covered += int(solid[i + m] != wp.uint8(0)) << m
            if covered == wp.static((1 << group) - 1):
                return
        arrived = gather(f, n, _ALL, i, parity)
        left = vec()  # 0 for solid cells, where nothing reads it
        for m in range(wp.static(group)):
            if (covered >> m) & 1 == 0:
                g = cell_vec()
                for q in range(wp.static(count)):
                    g[q] = arrived[m * wp.static(count) + q]
                drho, j, diagonal, off = moments(g)
                rho = 1.0 + drho
                j2 = wp.dot(j, j)
                if not (rho > 0.0 and j2 < _SOUND2 * rho * rho):
                    code = int(1)
                    if not (j2 >= 0.0):
                        code = 2
                    elif rho <= 0.0:
                        code = 0
                    key = wp.int64(clock[parity]) * _CELLS + wp.int64(i + m)
                    wp.atomic_min(trouble, 0, key * _CODES + wp.int64(code))
                push = wp.vec3()
                if wp.static(spec.forced):
                    push = forces[i + m]
                g = relax(drho, j, diagonal, off, push, tau, eddy)
                for q in range(wp.static(count)):
                    left[m * wp.static(count) + q] = g[q]
        scatter(out, n, _ALL, i, 1 - parity, left)

    return step
