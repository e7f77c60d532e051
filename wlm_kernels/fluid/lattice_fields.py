"""Velocity and density of the air on a lattice, its initial state, and cells that become fluid.

Read `fields` and `equilibrium` of `tests/reference/lattice.py` first: they compute the same in NumPy. The marks of
solid cells are those of `lattice_bodies`.
"""

import functools
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.lattice_bodies import Motion, centre_of, wall_velocity
from wlm_kernels.fluid.lattice_sets import (
    STORAGES,
    Layout,
    Tables,
    cell_of,
    crosses,
    equilibrium,
    index_of,
    memory_functions,
    opposite,
    owned,
    wrapped,
)
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set


@dataclass(frozen=True)
class FluidKernels:
    """Kernels for one lattice and storage type, with one thread per cell: `fields` computes the density minus 1 and the
    velocity in a slab, `start` sets the equilibrium of given ones; for each cell that becomes fluid, `neighbours`
    computes the means of the fluid around it, and `uncover` sets the equilibrium of these; `convert` converts all cells
    to another time step, in place; `unpack` copies a population that has left the cells."""

    fields: wp.Kernel
    start: wp.Kernel
    neighbours: wp.Kernel
    uncover: wp.Kernel
    convert: wp.Kernel
    unpack: wp.Kernel


@functools.cache
def fluid_kernels(
    lattice_name: str, storage: str, walls: tuple[bool, bool, bool], in_place: bool = False
) -> FluidKernels:
    """Builds (once) the kernels that read and set the fluid's density and velocity; see `memory_functions`."""
    memory = memory_functions(lattice_name, storage, walls, in_place=in_place)
    gather, moments, load, store = memory.gather, memory.moments, memory.load, memory.store
    element, arriving, leaving = memory.element, memory.arriving, memory.leaving
    stored, scale = STORAGES[storage]
    flat = velocity_set(lattice_name).axes == 2
    options = {"enable_backward": False, "max_unroll": 32}

    @wp.kernel(module="unique", module_options=options)
    def fields(
        # in:
        first: int,
        at: Layout,
        f: wp.array2d[stored],
        solid: wp.array1d[wp.uint8],
        motion: Motion,
        forces: wp.array1d[wp.vec3],
        # out:
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
    ):
        i = first + wp.tid()
        excess = float(0.0)
        v = wp.vec3()
        body = int(0)
        if solid.shape[0] > 0:
            body = int(solid[i])
        if body > 0:
            v = wall_velocity(motion, body, centre_of(cell_of(at.n, i)))
        else:
            excess, j, _diagonal, _off = moments(gather(f, at.n, at.walled, i, at.parity))
            if forces.shape[0] > 0:
                j += 0.5 * forces[i]
            v = j / (1.0 + excess)
        if drho.shape[0] > 0:
            drho[i] = excess
        if u.shape[0] > 0:
            u[i] = v

    @wp.kernel(module="unique", module_options=options)
    def start(
        # in:
        t: Tables,
        at: Layout,
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
        # out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        p = cell_of(at.n, i)
        for q in range(t.w.shape[0]):
            store(f, leaving(f, at, i, p, q, t.c[q]), equilibrium(t.w[q], t.c[q], drho[i], u[i]))

    @wp.kernel(module="unique", module_options=options)
    def neighbours(
        # in:
        t: Tables,
        at: Layout,
        f: wp.array2d[stored],
        covered: wp.array1d[wp.uint8],
        solid: wp.array1d[wp.uint8],
        # out:
        means: wp.array2d[stored],
    ):
        i = wp.tid()
        if covered[i] == wp.uint8(0) or solid[i] != wp.uint8(0):
            return
        p = cell_of(at.n, i)
        total = wp.vec4()
        weight = float(0.0)
        for q in range(1, t.w.shape[0]):
            beside = p + t.c[q]
            if not crosses(at.n, at.bounded, beside):
                k = index_of(at.n, wrapped(at.n, beside))
                if covered[k] == wp.uint8(0) and solid[k] == wp.uint8(0):
                    excess, j, _diagonal, _off = moments(gather(f, at.n, at.walled, k, at.parity))
                    rho = 1.0 + excess
                    total += t.w[q] * wp.vec4(excess, j[0] / rho, j[1] / rho, j[2] / rho)
                    weight += t.w[q]
        if weight > 0.0:
            total = total / weight
        for k in range(4):
            store(means, element(means, k, i), total[k])

    @wp.kernel(module="unique", module_options=options)
    def uncover(
        # in:
        t: Tables,
        at: Layout,
        covered: wp.array1d[wp.uint8],
        solid: wp.array1d[wp.uint8],
        means: wp.array2d[stored],
        # out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        if covered[i] == wp.uint8(0) or solid[i] != wp.uint8(0):
            return
        drho = load(means, element(means, 0, i))
        u = wp.vec3()
        for a in range(3):
            u[a] = load(means, element(means, a + 1, i))
        p = cell_of(at.n, i)
        for q in range(t.w.shape[0]):
            value = equilibrium(t.w[q], t.c[q], drho, u)
            # The element of a link stores the population that comes in next, for this cell also the equilibrium.
            if owned(at, p + t.c[q]):
                store(f, leaving(f, at, i, p, q, t.c[q]), value)
            if not owned(at, p - t.c[q]):
                store(f, arriving(f, at, i, p, q, t.c[q]), value)

    @wp.kernel(module="unique", module_options=options)
    def convert(
        # in:
        t: Tables,
        at: Layout,
        solid: wp.array1d[wp.uint8],
        forces: wp.array1d[wp.vec3],
        tau: float,
        eddy: float,
        factor: float,
        # in, out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        if solid.shape[0] > 0:
            if solid[i] != wp.uint8(0):
                return
        p = cell_of(at.n, i)
        drho, j, diagonal, off = moments(gather(f, at.n, at.walled, i, at.parity))
        u = j / (1.0 + drho)
        third = drho / 3.0
        diagonal -= wp.cw_mul(j, u) + wp.vec3(third, third, third)
        if wp.static(flat):
            diagonal = wp.vec3(diagonal[0], diagonal[1], 0.0)
        off -= wp.vec3(j[0] * u[1], j[0] * u[2], j[1] * u[2])
        norm2 = wp.dot(diagonal, diagonal) + 2.0 * wp.dot(off, off)
        tau_eddy = 0.5 * (tau + wp.sqrt(tau * tau + eddy * wp.sqrt(norm2) / (1.0 + drho)))
        push = wp.vec3()
        if forces.shape[0] > 0:
            push = forces[i]
        # The speed scales with the step, the pressure with its square, the stress with the strain and the viscosity.
        after = factor * factor * drho
        j = factor * (1.0 + after) / (1.0 + drho) * (j + 0.5 * push) - 0.5 * factor * factor * push
        u = j / (1.0 + after)
        ratio = factor * (0.5 + factor * (tau_eddy - 0.5)) / tau_eddy
        diagonal = wp.cw_mul(j, u) + ratio * diagonal
        off = wp.vec3(j[0] * u[1], j[0] * u[2], j[1] * u[2]) + ratio * off
        for q in range(t.w.shape[0]):
            c = wp.vec3(float(t.c[q][0]), float(t.c[q][1]), float(t.c[q][2]))
            stress = 4.5 * wp.dot(diagonal, wp.cw_mul(c, c)) - 1.5 * (diagonal[0] + diagonal[1] + diagonal[2])
            stress += 9.0 * (off[0] * c[0] * c[1] + off[1] * c[0] * c[2] + off[2] * c[1] * c[2])
            value = t.w[q] * (after + 3.0 * wp.dot(c, j) + stress)
            source = p - t.c[q]
            came = arriving(f, at, i, p, q, t.c[q])
            if solid.shape[0] > 0 and not crosses(at.n, at.bounded, source):
                if solid[index_of(at.n, wrapped(at.n, source))] != wp.uint8(0):
                    # The population that left towards the body, from which a wall's velocity sends it back.
                    toward = leaving(f, at, i, p, opposite(q), -t.c[q])
                    store(f, toward, value - factor * (load(f, came) - load(f, toward)))
            store(f, came, value)

    @wp.kernel(module="unique", module_options=options)
    def unpack(
        # in:
        at: Layout,
        q: int,
        c_q: wp.vec3i,
        f: wp.array2d[stored],
        # out:
        out: wp.array1d[stored],
    ):
        i = wp.tid()
        out[i] = stored(wp.static(scale) * load(f, leaving(f, at, i, cell_of(at.n, i), q, c_q)))

    return FluidKernels(fields, start, neighbours, uncover, convert, unpack)
