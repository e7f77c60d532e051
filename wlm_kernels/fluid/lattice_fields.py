"""Velocity and density of the air on a lattice, its initial state, and solid bodies: their cells and motion.

Read `fields` and `equilibrium` of `tests/reference/lattice.py`, and `test_sphere_voxels` and `test_mesh_voxels` of
`tests/kernels/test_lattice.py` first: they compute the same in NumPy.

An array of uint8 stores for each cell the number of its body, 1 to 255, or 0 for fluid. Cell centres are at half
integers, in units of a cell. Bodies do not rotate; an array of velocities, vec3, has that of body k at index k, in
cells per step.
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

wp.set_module_options({"enable_backward": False})

# The winding number is correct even where a sign from rays would fail because a ray grazes a triangle.
_INSIDE = wp.constant(0.5)


@wp.func
def _centre(n: wp.vec3i, i: int) -> wp.vec3:
    p = cell_of(n, i)
    return wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)


@wp.func
def _put(solid: wp.array1d[wp.uint8], i: int, body: wp.uint8, inside: bool):
    if inside:
        solid[i] = body
    elif solid[i] == body:
        solid[i] = wp.uint8(0)


@wp.kernel
def _sphere(
    # in:
    n: wp.vec3i,
    body: wp.uint8,
    centre: wp.vec3,
    radius: float,
    # out:
    solid: wp.array1d[wp.uint8],
):
    i = wp.tid()
    _put(solid, i, body, wp.length(_centre(n, i) - centre) < radius)


@wp.kernel
def _mesh(
    # in:
    n: wp.vec3i,
    body: wp.uint8,
    mesh: wp.uint64,
    position: wp.vec3,
    scale: float,
    reach: float,
    # out:
    solid: wp.array1d[wp.uint8],
):
    i = wp.tid()
    x = (_centre(n, i) - position) / scale
    query = wp.mesh_query_point_sign_winding_number(mesh, x, reach, 2.0, _INSIDE)
    _put(solid, i, body, query.result and query.sign < 0.0)


def voxelise_sphere(solid, body: int, centre, radius: float) -> None:
    """Marks the cells of `solid`, uint8 [X, Y, Z], whose centres are in a sphere, in cells, with a body's number, 1 to
    255, and clears the body's other cells."""
    n = wp.vec3i(*solid.shape)
    inputs = [n, wp.uint8(body), wp.vec3(*centre), float(radius)]
    wp.launch(_sphere, solid.size, inputs=inputs, outputs=[solid.flatten()], device=solid.device)


def voxelise_mesh(solid, body: int, mesh: wp.Mesh, position, scale: float) -> None:
    """Marks the cells of `solid`, uint8 [X, Y, Z], whose centres are in a closed mesh with a body's number, 1 to 255,
    and clears the body's other cells.

    The mesh, on the same device, was made with `support_winding_number=True`. `position` is that of its origin in
    cells, and `scale` the cells per unit of the mesh.
    """
    n = wp.vec3i(*solid.shape)
    # No cell is farther away than the domain's diagonal.
    reach = 4.0 * float(sum(solid.shape)) / scale
    inputs = [n, wp.uint8(body), mesh.id, wp.vec3(*position), float(scale), reach]
    wp.launch(_mesh, solid.size, inputs=inputs, outputs=[solid.flatten()], device=solid.device)


@dataclass(frozen=True)
class FluidKernels:
    """Kernels for one lattice and storage type, with one thread per cell: `fields` computes the density minus 1 and the
    velocity, `start` sets the equilibrium of given ones; for each cell that becomes fluid, `neighbours` computes the
    means of the fluid around it, and `uncover` sets the equilibrium of these.
    """

    fields: wp.Kernel
    start: wp.Kernel
    neighbours: wp.Kernel
    uncover: wp.Kernel


@functools.cache
def fluid_kernels(lattice_name: str, storage: str, walls: tuple[bool, bool, bool]) -> FluidKernels:
    """Builds (once) the kernels that read and set the fluid's density and velocity; `walls`: axes with walls."""
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
        velocity: wp.array1d[wp.vec3],
        forces: wp.array1d[wp.vec3],
        # out:
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
    ):
        i = wp.tid()
        excess = float(0.0)
        v = wp.vec3()
        body = int(0)
        if solid.shape[0] > 0:
            body = int(solid[i])
        if body > 0:
            v = velocity[body]
        else:
            excess, j, _diagonal, _off = moments(gather(f, n, cell_of(n, i)))
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
            # The element of a link stores the population that comes in next, for this cell also the equilibrium.
            if owned(n, bounded, walled, p + t.c[q]):
                store(f, q, i, value)
            if not owned(n, bounded, walled, p - t.c[q]):
                store(f, q, index_of(n, wrapped(n, p - t.c[q])), value)

    return FluidKernels(fields, start, neighbours, uncover)
