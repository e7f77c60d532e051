"""Velocity and density of the air on a lattice, its start, and the refill of cells that are no longer solid.

Read `tests/reference/lattice.py` first: `fields` and `equilibrium` there are the same moments in float64 NumPy.
"""

import functools
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.lattice_sets import (
    STORAGES,
    Tables,
    cell_of,
    crosses,
    equilibrium,
    index_of,
    memory_functions,
    owned,
    wrapped,
)
from wlm_kernels.fluid.lattice_solids import Bodies, body_velocity


@dataclass(frozen=True)
class FluidKernels:
    """The kernels of one lattice and storage, each over all cells.

    Attributes:
        fields: Density less 1 and velocity of every cell.
        start: Sets every cell to an equilibrium.
        neighbours: The mean of the fluid around each cell that stops being solid.
        uncover: Sets those cells to the equilibrium of that mean.
    """

    fields: wp.Kernel
    start: wp.Kernel
    neighbours: wp.Kernel
    uncover: wp.Kernel


@functools.cache
def fluid_kernels(lattice_name: str, storage: str, walls: tuple[bool, bool, bool]) -> FluidKernels:
    """Builds (once) the kernels that don't run at every step; arguments as for `memory_functions`."""
    memory = memory_functions(lattice_name, storage, walls)
    gather, moments, load, store = memory.gather, memory.moments, memory.load, memory.store
    stored = STORAGES[storage][0]
    options = {"enable_backward": False, "max_unroll": 32}

    @wp.kernel(module="unique", module_options=options)
    def fields(
        # in:
        n: wp.vec3i,
        f: wp.array2d[stored],
        solid: wp.array1d[wp.uint8],
        bodies: Bodies,
        force: wp.vec3,
        forces: wp.array1d[wp.vec3],
        # out:
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
    ):
        i = wp.tid()
        p = cell_of(n, i)
        excess = float(0.0)
        v = wp.vec3()
        body = int(0)
        if solid.shape[0] > 0:
            body = int(solid[i])
        if body > 0:
            v = body_velocity(bodies, body, p)
        else:
            excess, j, _diagonal, _off = moments(gather(f, n, p))
            half = 0.5 * force
            if forces.shape[0] > 0:
                half += 0.5 * forces[i]
            v = (j + half) / (1.0 + excess)
        if drho.shape[0] > 0:
            drho[i] = excess
        if u.shape[0] > 0:
            u[i] = v

    @wp.kernel(module="unique", module_options=options)
    def start(
        # in:
        t: Tables,
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
        # out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        for q in range(t.w.shape[0]):
            store(f, q, i, equilibrium(t.w[q], t.c[q], drho[i], u[i]))

    @wp.kernel(module="unique", module_options=options)
    def neighbours(
        # in:
        t: Tables,
        n: wp.vec3i,
        bounded: wp.vec3i,
        f: wp.array2d[stored],
        covered: wp.array1d[wp.uint8],
        solid: wp.array1d[wp.uint8],
        # out:
        spare: wp.array2d[stored],
    ):
        i = wp.tid()
        if covered[i] == wp.uint8(0) or solid[i] != wp.uint8(0):
            return
        p = cell_of(n, i)
        total = wp.vec4()
        weight = float(0.0)
        for q in range(1, t.w.shape[0]):
            beside = p + t.c[q]
            if not crosses(n, bounded, beside):
                neighbour = wrapped(n, beside)
                k = index_of(n, neighbour)
                if covered[k] == wp.uint8(0) and solid[k] == wp.uint8(0):
                    excess, j, _diagonal, _off = moments(gather(f, n, neighbour))
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
        walled: wp.vec3i,
        covered: wp.array1d[wp.uint8],
        solid: wp.array1d[wp.uint8],
        spare: wp.array2d[stored],
        # out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        if covered[i] == wp.uint8(0) or solid[i] != wp.uint8(0):
            return
        drho = load(spare, 0, i)
        u = wp.vec3(load(spare, 1, i), load(spare, 2, i), load(spare, 3, i))
        p = cell_of(n, i)
        for q in range(t.w.shape[0]):
            value = equilibrium(t.w[q], t.c[q], drho, u)
            # A link's element holds what comes in next: for this cell that is the equilibrium too.
            if owned(n, bounded, walled, p + t.c[q]):
                store(f, q, i, value)
            if not owned(n, bounded, walled, p - t.c[q]):
                store(f, q, index_of(n, wrapped(n, p - t.c[q])), value)

    return FluidKernels(fields, start, neighbours, uncover)
