"""The air on a lattice as fields: its velocity and density, how it starts, and what fills cells that were solid."""

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

__all__ = ["FluidKernels", "fluid_kernels"]


@dataclass(frozen=True)
class FluidKernels:
    """Of one lattice and storage.

    Attributes:
        fields: What the fluid does, over all cells.
        start: Lets an equilibrium leave all cells, over all cells.
        neighbours: The mean of the fluid around each cell that stops being solid, over all cells.
        uncover: Sets those cells to it, over all cells.
    """

    fields: wp.Kernel
    start: wp.Kernel
    neighbours: wp.Kernel
    uncover: wp.Kernel


@functools.cache
def fluid_kernels(lattice_name: str, storage: str, walls: tuple[bool, bool, bool]) -> FluidKernels:
    """Builds (once) the kernels that are not run at every step; the arguments are those of ``memory_functions``."""
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
                other = wrapped(n, beside)
                k = index_of(n, other)
                if covered[k] == wp.uint8(0) and solid[k] == wp.uint8(0):
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
            # A link's place holds what comes in next: of this cell's, that is the equilibrium too.
            if owned(n, bounded, walled, p + t.c[q]):
                store(f, q, i, value)
            if not owned(n, bounded, walled, p - t.c[q]):
                store(f, q, index_of(n, wrapped(n, p - t.c[q])), value)

    return FluidKernels(fields, start, neighbours, uncover)
