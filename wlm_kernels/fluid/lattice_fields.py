"""Velocity and density of the air on a lattice, its initial state, and solid bodies: their cells and motion.

Read `fields` and `equilibrium` of `tests/reference/lattice.py`, and `test_sphere_voxels` and `test_mesh_voxels` of
`tests/kernels/test_lattice.py` first: they compute the same in NumPy.

An array of uint8 stores for each cell the number of its body, 1 to 255, or 0 for fluid. Cell centres are at half
integers, in units of a cell. `lattice_links` describes how populations are stored; `far` is 1 if the next step is far.
"""

import functools
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.lattice_links import (
    OUTFLOW,
    SLIP,
    SOLID,
    TERMS,
    Boundaries,
    add_up,
    along,
    body_behind,
    body_velocity,
    centre_of,
    condition,
    element_of,
    face_cell,
    face_cell_at,
    fixed_point,
    is_link,
    is_outlet,
    is_solid,
    mirrored,
    outflow,
    shift,
    term_of,
    word_of,
)
from wlm_kernels.fluid.lattice_sets import (
    STORAGES,
    Tables,
    cell_of,
    crosses,
    equilibrium,
    index_of,
    memory_functions,
    opposite,
    wrapped,
)
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set

wp.set_module_options({"enable_backward": False})

# The winding number is correct even where a sign from rays would fail because a ray grazes a triangle.
_INSIDE = wp.constant(0.5)
_SLIP = wp.constant(SLIP)


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
    _put(solid, i, body, wp.length(centre_of(cell_of(n, i)) - centre) < radius)


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
    x = (centre_of(cell_of(n, i)) - position) / scale
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
    """Kernels for one lattice and storage type, with one thread per cell.

    Attributes:
        fields: Computes the density minus 1 and the velocity.
        start: Sets the equilibrium of given ones.
        arrivals: Computes the populations that arrive, complete with what links add.
        settle: Adds to populations that arrive what links add to them, before a step: in the cells of faces, or in
            `every` cell.
        send_out: Sets what outlets send back, in the cells of faces, after a step that was far or not.
        neighbours: For each cell that becomes fluid, computes the means of the fluid around it.
        uncover: Sets the equilibrium of these, and moves what lies between a cell that changes and its neighbours.
        force: Sums the force of the fluid on each body.
        convert: Converts populations that arrive to another time step.
    """

    fields: wp.Kernel
    start: wp.Kernel
    arrivals: wp.Kernel
    settle: wp.Kernel
    send_out: wp.Kernel
    neighbours: wp.Kernel
    uncover: wp.Kernel
    force: wp.Kernel
    convert: wp.Kernel


@functools.cache
def fluid_kernels(lattice_name: str, storage: str) -> FluidKernels:
    """Builds (once) the kernels that read and set the fluid's density and velocity.

    An argument `clock` has the numbers of steps of `lattice.step_kernel`, the larger of which is that of the steps
    done; it is empty for populations that are complete.
    """
    memory = memory_functions(lattice_name, storage)
    load, store = memory.load, memory.store
    stored = STORAGES[storage][0]
    flat = velocity_set(lattice_name).axes == 2
    options = {"enable_backward": False}

    @wp.func
    def steps_done(clock: wp.array1d[int]) -> int:
        if clock.shape[0] == 0:
            return -1
        return wp.max(clock[0], clock[1])

    @wp.func
    def arrival(
        t: Tables,
        b: Boundaries,
        f: wp.array2d[stored],
        word: wp.uint32,
        p: wp.vec3i,
        i: int,
        q: int,
        far: int,
        done: int,
    ) -> float:
        """Returns the population q that arrives at cell i, at p; `done` is negative if the populations are complete."""
        k, row = element_of(t, b, word, p, i, q, far)
        value = load(f, row, k)
        if done >= 0 and is_link(word, q) and (word & TERMS) != wp.uint32(0):
            value += term_of(t, b, p, q, done, shift(b, word, done))
        return value

    @wp.func
    def collected(t: Tables, b: Boundaries, f: wp.array2d[stored], i: int, far: int, done: int):
        """Returns the density minus 1 and the momentum of the populations that arrive at a cell."""
        word = word_of(b, i)
        p = cell_of(b.n, i)
        drho = float(0.0)
        j = wp.vec3()
        for q in range(t.w.shape[0]):
            g = arrival(t, b, f, word, p, i, q, far, done)
            drho += g
            j += g * along(t, q)
        return drho, j

    @wp.kernel(module="unique", module_options=options)
    def fields(
        # in:
        t: Tables,
        b: Boundaries,
        f: wp.array2d[stored],
        far: int,
        clock: wp.array1d[int],
        forces: wp.array1d[wp.vec3],
        # out:
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
    ):
        i = wp.tid()
        excess = float(0.0)
        v = wp.vec3()
        if is_solid(b, i):
            v = body_velocity(b, int(b.solid[i]), centre_of(cell_of(b.n, i)))
        else:
            excess, j = collected(t, b, f, i, far, steps_done(clock))
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
        b: Boundaries,
        drho: wp.array1d[float],
        u: wp.array1d[wp.vec3],
        far: int,
        clock: wp.array1d[int],
        # out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        word = word_of(b, i)
        if (word & SOLID) != wp.uint32(0):
            return
        p = cell_of(b.n, i)
        net = float(0.0)
        for q in range(t.w.shape[0]):
            back = opposite(q)
            value = equilibrium(t.w[back], t.c[back], drho[i], u[i])
            if is_link(word, q) and (word & OUTFLOW) != wp.uint32(0):
                kind, excess = condition(t, b, p, q)
                if is_outlet(kind):
                    net -= value
                    value = outflow(t, b, p, q, kind, excess, drho[i], u[i])
                    net += value
            k, row = element_of(t, b, word, p, i, q, 1 - far)
            store(f, row, k, value)
        if net != 0.0:
            wp.atomic_add(b.net, 0, fixed_point(net))

    @wp.kernel(module="unique", module_options=options)
    def arrivals(
        # in:
        t: Tables,
        b: Boundaries,
        f: wp.array2d[stored],
        far: int,
        clock: wp.array1d[int],
        # out:
        out: wp.array2d[stored],
    ):
        i = wp.tid()
        word = word_of(b, i)
        p = cell_of(b.n, i)
        for q in range(t.w.shape[0]):
            value = float(0.0)
            if (word & SOLID) == wp.uint32(0):
                value = arrival(t, b, f, word, p, i, q, far, steps_done(clock))
            store(out, q, i, value)

    @wp.kernel(module="unique", module_options=options)
    def settle(
        # in:
        t: Tables,
        b: Boundaries,
        every: int,
        clock: wp.array1d[int],
        # in, out:
        f: wp.array2d[stored],
    ):
        i = int(wp.tid())
        if every == 0:
            i = face_cell_at(b, i)
            if i < 0:
                return
        word = word_of(b, i)
        if (word & TERMS) != wp.uint32(0):
            p = cell_of(b.n, i)
            shifted = shift(b, word, steps_done(clock))
            for q in range(1, t.w.shape[0]):
                if is_link(word, q):
                    store(f, q, i, load(f, q, i) + term_of(t, b, p, q, steps_done(clock), shifted))

    @wp.kernel(module="unique", module_options=options)
    def send_out(
        # in:
        t: Tables,
        b: Boundaries,
        far: int,
        # in, out:
        f: wp.array2d[stored],
    ):
        i = face_cell_at(b, wp.tid())
        if i < 0:
            return
        word = word_of(b, i)
        if (word & OUTFLOW) == wp.uint32(0):
            return
        p = cell_of(b.n, i)
        drho = float(0.0)
        j = wp.vec3()
        for q in range(t.w.shape[0]):
            k, row = element_of(t, b, word, p, i, q, far)
            g = load(f, row, k)
            drho += g
            j -= g * along(t, q)
        net = float(0.0)
        for q in range(1, t.w.shape[0]):
            if is_link(word, q):
                kind, excess = condition(t, b, p, q)
                if is_outlet(kind):
                    v = outflow(t, b, p, q, kind, excess, drho, j / (1.0 + drho))
                    net += v - load(f, q, i)
                    store(f, q, i, v)
        add_up(b.net, fixed_point(net))

    @wp.kernel(module="unique", module_options=options)
    def neighbours(
        # in:
        t: Tables,
        b: Boundaries,
        solid: wp.array1d[wp.uint8],
        f: wp.array2d[stored],
        far: int,
        clock: wp.array1d[int],
        # out:
        means: wp.array1d[wp.vec4],
    ):
        i = wp.tid()
        if not is_solid(b, i) or solid[i] != wp.uint8(0):
            return
        p = cell_of(b.n, i)
        total = wp.vec4()
        weight = float(0.0)
        for q in range(1, t.w.shape[0]):
            beside = p + t.c[q]
            if not crosses(b.n, b.bounded, beside):
                k = index_of(b.n, wrapped(b.n, beside))
                if not is_solid(b, k) and solid[k] == wp.uint8(0):
                    excess, j = collected(t, b, f, k, far, steps_done(clock))
                    rho = 1.0 + excess
                    total += t.w[q] * wp.vec4(excess, j[0] / rho, j[1] / rho, j[2] / rho)
                    weight += t.w[q]
        if weight > 0.0:
            total = total / weight
        means[i] = total

    @wp.kernel(module="unique", module_options=options)
    def uncover(
        # in:
        t: Tables,
        b: Boundaries,
        solid: wp.array1d[wp.uint8],
        means: wp.array1d[wp.vec4],
        far: int,
        # in, out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        freed = is_solid(b, i) and solid[i] == wp.uint8(0)
        covered = not is_solid(b, i) and solid[i] != wp.uint8(0)
        if not freed and not covered:
            return
        p = cell_of(b.n, i)
        u = wp.vec3(means[i][1], means[i][2], means[i][3])
        for q in range(t.w.shape[0]):
            back = opposite(q)
            value = equilibrium(t.w[back], t.c[back], means[i][0], u)
            face, cell = face_cell(b, p, p - t.c[q])
            kind = int(_SLIP)
            if face >= 0:
                kind = int(b.kind[cell])
            if is_outlet(kind):
                value = equilibrium(t.w[q], t.c[q], means[i][0], u)
            # The element of the population that leaves towards the neighbour, if that is fluid.
            k = int(i)
            row = int(q)
            if far == 0 and kind == _SLIP:
                k, row = mirrored(t, b, p, q)
            if k == i and row == q:
                if freed:
                    store(f, q, i, value)
            elif freed:
                if solid[k] != wp.uint8(0):
                    store(f, q, i, value)
                else:
                    came = load(f, row, k)
                    store(f, row, k, value)
                    if not is_solid(b, k):
                        store(f, q, i, came)
            elif not is_solid(b, k) and solid[k] == wp.uint8(0):
                store(f, row, k, load(f, q, i))

    @wp.kernel(module="unique", module_options=options)
    def force(
        # in:
        t: Tables,
        b: Boundaries,
        f: wp.array2d[stored],
        far: int,
        clock: wp.array1d[int],
        # out:
        total: wp.array1d[wp.vec3d],
    ):
        i = wp.tid()
        word = word_of(b, i)
        if word == wp.uint32(0) or is_solid(b, i):
            return
        p = cell_of(b.n, i)
        for q in range(1, t.w.shape[0]):
            if is_link(word, q):
                body, c = body_behind(t, b, p, q)
                if body > 0:
                    # What came back; what went in is that minus the term.
                    came = arrival(t, b, f, word, p, i, q, far, steps_done(clock))
                    _kind, term = condition(t, b, p, q)
                    wp.atomic_add(total, body, wp.float64(term - 2.0 * came) * c)

    @wp.kernel(module="unique", module_options=options)
    def convert(
        # in:
        t: Tables,
        b: Boundaries,
        came: wp.array2d[stored],
        far: int,
        clock: wp.array1d[int],
        forces: wp.array1d[wp.vec3],
        tau: float,
        eddy: float,
        factor: float,
        # out:
        f: wp.array2d[stored],
    ):
        i = wp.tid()
        word = word_of(b, i)
        if (word & SOLID) != wp.uint32(0):
            return
        drho = float(0.0)
        j = wp.vec3()
        stress = wp.mat33()
        for q in range(t.w.shape[0]):
            g, c = load(came, q, i), along(t, q)
            drho += g
            j += g * c
            stress += g * wp.outer(c, c)
        identity = wp.identity(n=3, dtype=float)
        if wp.static(flat):
            identity[2, 2] = 0.0
        stress -= wp.outer(j, j) / (1.0 + drho) + drho / 3.0 * identity
        tau_eddy = 0.5 * (tau + wp.sqrt(tau * tau + eddy * wp.sqrt(wp.ddot(stress, stress)) / (1.0 + drho)))
        push = wp.vec3()
        if forces.shape[0] > 0:
            push = forces[i]
        # The speed scales with the step, the pressure with its square, the stress with the strain and the viscosity.
        after = factor * factor * drho
        j = factor * (1.0 + after) / (1.0 + drho) * (j + 0.5 * push) - 0.5 * factor * factor * push
        stress = factor * (0.5 + factor * (tau_eddy - 0.5)) / tau_eddy * stress + wp.outer(j, j) / (1.0 + after)
        p = cell_of(b.n, i)
        for q in range(t.w.shape[0]):
            c = along(t, q)
            value = t.w[q] * (after + 3.0 * wp.dot(c, j) + 4.5 * wp.dot(c, stress * c) - 1.5 * wp.trace(stress))
            if is_link(word, q) and (word & TERMS) != wp.uint32(0):
                value -= term_of(t, b, p, q, steps_done(clock), shift(b, word, steps_done(clock)))
            k, row = element_of(t, b, word, p, i, q, far)
            store(f, row, k, value)

    return FluidKernels(fields, start, arrivals, settle, send_out, neighbours, uncover, force, convert)
