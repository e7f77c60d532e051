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
    opposite,
    owned,
    wrapped,
)
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set
from wlm_kernels.fluid.mesh_inside import in_mesh

wp.set_module_options({"enable_backward": False})


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
    shell: float,
    # out:
    solid: wp.array1d[wp.uint8],
):
    i = wp.tid()
    x = (_centre(n, i) - position) / scale
    _put(solid, i, body, in_mesh(mesh, x, reach, shell / scale))


def voxelise_sphere(solid, body: int, centre, radius: float) -> None:
    """Marks the cells of `solid`, uint8 [X, Y, Z], whose centres are in a sphere, in cells, with a body's number, 1 to
    255, and clears the body's other cells."""
    n = wp.vec3i(*solid.shape)
    inputs = [n, wp.uint8(body), wp.vec3(*centre), float(radius)]
    wp.launch(_sphere, solid.size, inputs=inputs, outputs=[solid.flatten()], device=solid.device)


def voxelise_mesh(solid, body: int, mesh: wp.Mesh, position, scale: float, shell: float = 0.0) -> None:
    """Marks the cells of `solid`, uint8 [X, Y, Z], whose centres are in a mesh or within `shell` cells of its surface
    (`mesh_inside`), with a body's number, 1 to 255, and clears the body's other cells.

    The mesh, on the same device, was made with `support_winding_number=True`. `position` is that of its origin in
    cells, and `scale` the cells per unit of the mesh.
    """
    n = wp.vec3i(*solid.shape)
    # No cell is farther away than the domain's diagonal.
    reach = 4.0 * float(sum(solid.shape)) / scale
    inputs = [n, wp.uint8(body), mesh.id, wp.vec3(*position), float(scale), reach, float(shell)]
    wp.launch(_mesh, solid.size, inputs=inputs, outputs=[solid.flatten()], device=solid.device)


@dataclass(frozen=True)
class FluidKernels:
    """Kernels for one lattice and storage type, with one thread per cell: `fields` computes the density minus 1 and the
    velocity, `start` sets the equilibrium of given ones; for each cell that becomes fluid, `neighbours` computes the
    means of the fluid around it, and `uncover` sets the equilibrium of these; `convert` converts all cells to another
    time step.
    """

    fields: wp.Kernel
    start: wp.Kernel
    neighbours: wp.Kernel
    uncover: wp.Kernel
    convert: wp.Kernel


@functools.cache
def fluid_kernels(lattice_name: str, storage: str, walls: tuple[bool, bool, bool]) -> FluidKernels:
    """Builds (once) the kernels that read and set the fluid's density and velocity; `walls`: axes with walls."""
    memory = memory_functions(lattice_name, storage, walls)
    gather, moments, load, store = memory.gather, memory.moments, memory.load, memory.store
    stored = STORAGES[storage][0]
    flat = velocity_set(lattice_name).axes == 2
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

    @wp.kernel(module="unique", module_options=options)
    def convert(
        # in:
        t: Tables,
        n: wp.vec3i,
        bounded: wp.vec3i,
        walled: wp.vec3i,
        f: wp.array2d[stored],
        solid: wp.array1d[wp.uint8],
        forces: wp.array1d[wp.vec3],
        tau: float,
        eddy: float,
        factor: float,
        # out:
        out: wp.array2d[stored],
    ):
        i = wp.tid()
        if solid.shape[0] > 0:
            if solid[i] != wp.uint8(0):
                return
        p = cell_of(n, i)
        g = gather(f, n, p)
        drho, j, diagonal, off = moments(g)
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
            if crosses(n, walled, source):
                store(out, opposite(q), i, value)
            else:
                k = index_of(n, wrapped(n, source))
                store(out, q, k, value)
                if solid.shape[0] > 0 and not crosses(n, bounded, source):
                    if solid[k] != wp.uint8(0):
                        # The population that left towards the body, from which a wall's velocity sends it back.
                        wall = load(f, q, k) - load(f, opposite(q), i)
                        store(out, opposite(q), i, value - factor * wall)

    return FluidKernels(fields, start, neighbours, uncover, convert)
