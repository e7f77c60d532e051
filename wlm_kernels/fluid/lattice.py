"""The lattice Boltzmann step: streaming and collision in one pass, in place.

Read `tests/reference/lattice.py` first: it is the same step in float64 NumPy, cell by cell.

A cell reads the populations that arrive, f_q(x, t + 1) = f*_q(x - c_q, t), and writes the populations that leave, f*,
into the same elements; `lattice_links` describes the storage and the boundary conditions. A warp of cells without
boundaries, nearly every one, only reads that it is one.

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

from wlm_kernels.fluid.lattice_links import SOLID, Boundaries, is_link, word_of
from wlm_kernels.fluid.lattice_sets import PAIRS, STORAGES, cell_of, lattice, memory_functions

CAUSES = ("the density is not positive", "the speed exceeds that of sound", "not a number")
"""Reasons why a run stops, in the order of their codes."""

QUIET = (1 << 62) - 1
"""Key of an error while there is none."""

# fast_math's approximate quotients and roots affect only the stress, by 1e-7 of it, not density and momentum.
OPTIONS = {"enable_backward": False, "max_unroll": 32, "fast_math": True}

# A key is (step * 2^31 + cell) * 4 + cause, so that the smallest key is that of the first cell in the first step.
_CELLS = wp.constant(wp.int64(1 << 31))
_CODES = wp.constant(wp.int64(4))
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
        bounded: Whether there are faces or solid cells.
        slips: Whether walls without friction are among the faces.
        forced: Whether a force acts on the fluid.
        wide: Whether elements are indexed in 64 bits, see `lattice_sets.memory_functions`.
    """

    lattice: str
    storage: str = "float32"
    eddies: bool = True
    bounded: bool = False
    slips: bool = False
    forced: bool = False
    wide: bool = False

    def __post_init__(self) -> None:
        lattice(self.lattice)
        if self.storage not in STORAGES:
            raise ValueError(f"storage: expected one of {', '.join(STORAGES)}, got {self.storage!r}")


@functools.cache
def _relax(spec: Spec) -> Any:
    """Builds (once) the collision: a function from the populations that arrive at a cell to the ones that leave it."""
    velocities = lattice(spec.lattice)
    c, w, axes, flat = velocities.c, velocities.w, velocities.axes, velocities.axes == 2
    vec = memory_functions(spec.lattice, spec.storage, spec.wide).vec
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
def mirror_tables(lattice_name: str) -> tuple[list[list[int]], list[list[int]]]:
    """Returns for each velocity of a lattice the rows of its opposite with some of its components mirrored, where bit a
    of the index is that of axis a; and the axes that it goes up along, and down along, as bits."""
    c = lattice(lattice_name).c
    rows = [[c.index(tuple(v if m >> a & 1 else -v for a, v in enumerate(each))) for m in range(8)] for each in c]
    return rows, [[sum(1 << a for a in range(3) if sign * v[a] > 0) for sign in (1, -1)] for v in c]


@functools.cache
def _elements(spec: Spec, far: bool) -> Any:
    """Builds (once) a function that returns the elements that a cell without links reads or writes, in a far step or at
    home; see `lattice_links.element_of`, which does the same for one element of any lattice."""
    memory, c = memory_functions(spec.lattice, spec.storage, spec.wide), lattice(spec.lattice).c
    element, count = memory.element, len(c)
    stored, indices = STORAGES[spec.storage][0], wp.types.vector(count, memory.index)
    rows, signs = mirror_tables(spec.lattice)

    @wp.func
    def elements_at_home(f: wp.array2d[stored], b: Boundaries, i: int) -> indices:
        out = indices()
        for q in range(wp.static(count)):
            out[q] = element(f, q, i)
        return out

    @wp.func
    def elements_afar(f: wp.array2d[stored], b: Boundaries, i: int) -> indices:
        n = b.n
        p = cell_of(n, i)
        # The cells below and above, and whether slip walls are there.
        down = wp.vec3i()
        up = wp.vec3i()
        low = int(0)
        high = int(0)
        for a in range(3):
            down[a] = wp.where(p[a] == 0, n[a], p[a]) - 1
            up[a] = wp.where(p[a] == n[a] - 1, 0, p[a] + 1)
            if wp.static(spec.slips):
                if b.bounded[a] != 0 and p[a] == 0:
                    down[a] = 0
                    low = low | wp.static(1 << a)
                if b.bounded[a] != 0 and p[a] == n[a] - 1:
                    up[a] = p[a]
                    high = high | wp.static(1 << a)
        x = wp.vec3i(down[0], p[0], up[0])
        y = wp.vec3i(down[1], p[1], up[1])
        z = wp.vec3i(down[2], p[2], up[2])
        out = indices()
        out[0] = element(f, 0, i)
        for q in range(1, wp.static(count)):
            row = int(wp.static(rows[q][0]))
            if wp.static(spec.slips):
                crossed = (low & wp.static(signs[q][0])) | (high & wp.static(signs[q][1]))
                for m in range(1, 8):
                    if wp.static(m & ~(signs[q][0] | signs[q][1]) == 0):
                        row = wp.where(crossed == wp.static(m), wp.static(rows[q][m]), row)
            line = x[wp.static(1 - c[q][0])] * n[1] + y[wp.static(1 - c[q][1])]
            out[q] = element(f, row, line * n[2] + z[wp.static(1 - c[q][2])])
        return out

    return elements_afar if far else elements_at_home


@functools.cache
def collision(spec: Spec) -> Any:
    """Builds (once) a `wp.func` that computes from the populations that cell i reads those that leave it."""
    memory, relax = memory_functions(spec.lattice, spec.storage, spec.wide), _relax(spec)
    moments, vec = memory.moments, memory.vec

    @wp.func
    def collide(
        g: vec, i: int, tau: float, eddy: float, forces: wp.array1d[wp.vec3], done: int, trouble: wp.array1d[wp.int64]
    ) -> vec:
        drho, j, diagonal, off = moments(g)
        rho = 1.0 + drho
        j2 = wp.dot(j, j)
        if not (rho > 0.0 and j2 < _SOUND2 * rho * rho):
            code = int(1)
            if not (j2 >= 0.0):
                code = 2
            elif rho <= 0.0:
                code = 0
            key = wp.int64(done) * _CELLS + wp.int64(i)
            wp.atomic_min(trouble, 0, key * _CODES + wp.int64(code))
        push = wp.vec3()
        if wp.static(spec.forced):
            push = forces[i]
        return relax(drho, j, diagonal, off, push, tau, eddy)

    return collide


@functools.cache
def step_kernel(spec: Spec, reads: bool, writes: bool) -> wp.Kernel:
    """Builds (once) the kernel that does a step with the settings of a spec, one thread per cell.

    Args:
        spec: The settings.
        reads: Whether populations are read far, see `lattice_links`.
        writes: Whether they are written far. In place it is the same as `reads`. If only `writes` is true, both arrays
            have the populations that arrive.

    Args of the kernel, for N cells and Q velocities:
        b: The boundaries; `net` is set to 0.
        f: [Q, N], the populations, settled, see `lattice_fields`.
        tau: Relaxation time, 1/2 + 3 nu.
        eddy: `eddy_factor`, used if `spec.eddies`.
        forces: vec3 [N], acceleration of each cell's fluid in cells per step squared, used if `spec.forced`.
        parity: 0 or 1: `clock[parity]` is the number of steps done; the step writes one more to the other element.
        clock: int [2], counts steps.
        trouble: int64 [1], lowered to the key of the first cell in which the flow blew up, see `trouble_of`.
        out: [Q, N], the populations after the step; `f` itself in place.
    """
    memory, collide = memory_functions(spec.lattice, spec.storage, spec.wide), collision(spec)
    elements_read, elements_written = _elements(spec, reads), _elements(spec, writes)
    element, peek, poke, vec = memory.element, memory.peek, memory.poke, memory.vec
    stored, count = STORAGES[spec.storage][0], len(lattice(spec.lattice).c)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def step(
        # in:
        b: Boundaries,
        f: wp.array2d[stored],
        tau: float,
        eddy: float,
        forces: wp.array1d[wp.vec3],
        parity: int,
        # out:
        clock: wp.array1d[int],
        trouble: wp.array1d[wp.int64],
        out: wp.array2d[stored],
    ):
        i = wp.tid()
        if i == 0:
            clock[1 - parity] = clock[parity] + 1
            b.net[0] = wp.int64(0)
        elements = elements_read(f, b, i)
        g = vec()
        for q in range(wp.static(count)):
            g[q] = float(peek(f, elements[q]))
        word = wp.uint32(0)
        if wp.static(spec.bounded):
            # After the populations, for which it would be one more latency.
            word = word_of(b, i)
            if (word & SOLID) != wp.uint32(0):
                return
            if wp.static(reads):
                if word != wp.uint32(0):
                    for q in range(1, wp.static(count)):
                        if is_link(word, wp.static(q)):
                            elements[q] = element(f, wp.static(q), i)
                            g[q] = float(peek(f, elements[q]))
        left = collide(g, i, tau, eddy, forces, clock[parity], trouble)
        if wp.static(reads != writes):
            elements = elements_written(f, b, i)
            for q in range(1, wp.static(count)):
                if is_link(word, wp.static(q)):
                    elements[q] = element(f, wp.static(q), i)
        for q in range(wp.static(count)):
            poke(out, elements[q], out.dtype(left[wp.static(((q - 1) ^ 1) + 1 if q else 0)]))

    return step
