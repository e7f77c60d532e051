"""The backward pass of a lattice Boltzmann step: gradients of what arrives in the cells to what arrived a step before.

Read `lattice` and `lattice_links` first. Populations are those that arrive, complete, as `lattice_fields` settles them.
A gradient has the layout of the populations it belongs to, and is that of the stored f_q - w_q, which is also that of
f_q. One set of kernels serves all lattices: it reads the velocities from `Tables`, in rolled loops.

Where a formula has a kink the gradient is that of one side: where the eddy viscosity is 0 because there is no strain,
and where an outlet's velocity is exactly 0. Nothing passes through a velocity that an outlet has set to 0.
"""

import warp as wp

from wlm_kernels.fluid.lattice_links import (
    FIXED,
    INLET,
    OUTFLOW,
    OUTLET,
    PRESSURE,
    SOLID,
    TERMS,
    Boundaries,
    along,
    body_behind,
    condition,
    element_of,
    face_cell,
    is_link,
    is_outlet,
    is_solid,
    mark,
    open_faces,
    risen,
    word_of,
)
from wlm_kernels.fluid.lattice_sets import Tables, cell_of

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

_INLET, _OUTLET, _PRESSURE = (wp.constant(kind) for kind in (INLET, OUTLET, PRESSURE))


@wp.struct
class Flow:
    """The properties of a lattice of N cells that the backward pass of a step needs, apart from its boundaries.

    Attributes:
        tau: Relaxation time, 1/2 + 3 nu.
        eddy: `lattice.eddy_factor`; 0: no eddy viscosity.
        axes: Number of dimensions, 2 or 3.
        forces: vec3 [N], acceleration of each cell's fluid; [0] without a force.
    """

    tau: float
    eddy: float
    axes: int
    forces: wp.array1d[wp.vec3]


@wp.func
def _mixed(c: wp.vec3) -> wp.vec3:
    """Returns the products xy, xz and yz of a vector's components."""
    return wp.vec3(c[0] * c[1], c[0] * c[2], c[1] * c[2])


@wp.func
def _times_mixed(m: wp.vec3, g: wp.vec3) -> wp.vec3:
    """Returns the gradient to m of the products of `_mixed`, whose gradients are g."""
    return wp.vec3(m[1] * g[0] + m[2] * g[1], m[0] * g[0] + m[2] * g[2], m[0] * g[1] + m[1] * g[2])


@wp.kernel
def _balance(
    # in:
    t: Tables,
    b: Boundaries,
    on_out: wp.array2d[float],
    # out:
    on_net: wp.array1d[wp.float64],
):
    i = wp.tid()
    word = word_of(b, i)
    if (word & OUTFLOW) == wp.uint32(0) or b.fixed[2] == wp.int64(0):
        return
    p = cell_of(b.n, i)
    total = float(0.0)
    for q in range(1, t.w.shape[0]):
        if is_link(word, q):
            kind, _excess = condition(t, b, p, q)
            if kind == _OUTLET:
                total -= t.w[q] * on_out[q, i]
    wp.atomic_add(on_net, 0, wp.float64(total) * FIXED / wp.float64(b.fixed[2]))


@wp.func
def _outflow(
    t: Tables, b: Boundaries, p: wp.vec3i, q: int, kind: int, excess: float, drho: float, u: wp.vec3, g: float
):
    """Returns the gradients of an outlet's population, times g, to the density and the velocity of the cell's fluid."""
    passes, hold = open_faces(b, p - t.c[q], u)
    kept = float(1.0)
    target = float(drho)
    if kind == _PRESSURE:
        kept = 1.0 - hold
        target += hold * (excess - drho)
    v = wp.cw_mul(passes, u)
    c = along(t, q)
    cu = wp.dot(c, v)
    g *= t.w[q]
    on_u = wp.cw_mul(passes, g * (1.0 + target) * ((3.0 + 9.0 * cu) * c - 3.0 * v))
    return kept * g * (1.0 + 3.0 * cu + 4.5 * cu * cu - 1.5 * wp.dot(v, v)), on_u


@wp.kernel
def _step(
    # in:
    t: Tables,
    b: Boundaries,
    flow: Flow,
    f: wp.array2d[float],
    on_out: wp.array2d[float],
    on_net: wp.array1d[wp.float64],
    done: int,
    row: wp.array1d[int],
    # out:
    on_f: wp.array2d[float],
    on_forces: wp.array1d[wp.vec3],
    on_inlet: wp.array1d[wp.vec3],
):
    i = wp.tid()
    word = word_of(b, i)
    if (word & SOLID) != wp.uint32(0):
        return
    p = cell_of(b.n, i)
    # The moments, as in the step.
    drho = float(0.0)
    j = wp.vec3()
    diagonal = wp.vec3()
    off = wp.vec3()
    for q in range(t.w.shape[0]):
        g = f[q, i]
        c = along(t, q)
        drho += g
        j += g * c
        diagonal += g * wp.cw_mul(c, c)
        off += g * _mixed(c)
    momentum = wp.vec3(j)
    if flow.forces.shape[0] > 0:
        momentum += flow.forces[i]
    inverse = 1.0 / (1.0 + drho)
    u = inverse * momentum
    # The gradients to the moments that make the populations that leave, and by way of outlets to density and velocity.
    on_rest = float(0.0)
    on_j = wp.vec3()
    square = wp.vec3()
    on_off = wp.vec3()
    on_outlet = float(0.0)
    on_u = wp.vec3()
    net = float(on_net[0])
    for q in range(t.w.shape[0]):
        k, to = element_of(t, b, word, p, i, q, 1)
        g = on_out[to, k]
        c = along(t, q)
        if is_link(word, q) and (word & TERMS) != wp.uint32(0):
            kind, number = condition(t, b, p, q)
            if is_outlet(kind):
                on_density, on_velocity = _outflow(t, b, p, q, kind, number, drho, u, g + net)
                on_outlet += on_density
                on_u += on_velocity
                g = -net
            elif kind == _INLET and on_inlet.shape[0] > 0:
                _face, cell = face_cell(b, p, p - t.c[q])
                wp.atomic_add(on_inlet, row[cell], 6.0 * risen(b, done + 1) * t.w[q] * (g + net) * c)
        wide = t.w[q] * g
        on_rest += wide
        on_j -= 3.0 * wide * c
        square += 4.5 * wide * wp.cw_mul(c, c)
        on_off += 9.0 * wide * _mixed(c)
    on_diagonal = square - 1.5 * on_rest * wp.vec3(1.0, 1.0, 1.0)

    # The collision, forwards.
    flat = flow.axes == 2
    third = drho / 3.0
    stress = diagonal - inverse * wp.cw_mul(j, j) - wp.vec3(third, third, third)
    if flat:
        stress[2] = 0.0
    shear = off - inverse * _mixed(j)
    norm = wp.sqrt(wp.dot(stress, stress) + 2.0 * wp.dot(shear, shear))
    root = wp.sqrt(flow.tau * flow.tau + flow.eddy * inverse * norm)
    tau = 0.5 * (flow.tau + root)
    keep = 1.0 - 1.0 / tau

    # The collision, backwards: first the equilibrium after the force.
    on_momentum = on_j + inverse * (on_u + 2.0 * wp.cw_mul(momentum, on_diagonal) + _times_mixed(momentum, on_off))
    on_inverse = wp.dot(wp.cw_mul(momentum, momentum), on_diagonal) + wp.dot(_mixed(momentum), on_off)
    on_inverse += wp.dot(momentum, on_u)
    on_drho = on_rest + on_outlet
    ones = wp.vec3(1.0, 1.0, wp.where(flat, 0.0, 1.0))
    part = 1.0 / float(flow.axes)
    trace = part * (stress[0] + stress[1] + stress[2])
    on_keep = wp.dot(stress - trace * ones, on_diagonal) + wp.dot(shear, on_off)
    mean = part * wp.dot(ones, on_diagonal)
    to_stress = keep * (on_diagonal - mean * wp.vec3(1.0, 1.0, 1.0))
    to_shear = keep * on_off
    if norm > 0.0:
        on_square_root = on_keep / (tau * tau) * 0.25 / root
        on_inverse += on_square_root * flow.eddy * norm
        scale = on_square_root * flow.eddy * inverse / norm
        to_stress += scale * stress
        to_shear += 2.0 * scale * shear
    if flat:
        to_stress[2] = 0.0
    on_drho -= (to_stress[0] + to_stress[1] + to_stress[2]) / 3.0
    to_j = on_momentum - inverse * (2.0 * wp.cw_mul(j, to_stress) + _times_mixed(j, to_shear))
    on_inverse -= wp.dot(wp.cw_mul(j, j), to_stress) + wp.dot(_mixed(j), to_shear)
    on_drho -= inverse * inverse * on_inverse
    if on_forces.shape[0] > 0:
        on_forces[i] += on_momentum

    for q in range(t.w.shape[0]):
        c = along(t, q)
        on_f[q, i] = on_drho + wp.dot(c, to_j) + wp.dot(wp.cw_mul(c, c), to_stress) + wp.dot(_mixed(c), to_shear)


@wp.kernel
def _fields(
    # in:
    t: Tables,
    b: Boundaries,
    forces: wp.array1d[wp.vec3],
    f: wp.array2d[float],
    on_excess: wp.array1d[float],
    on_u: wp.array1d[wp.vec3],
    # in, out:
    on_f: wp.array2d[float],
    on_forces: wp.array1d[wp.vec3],
):
    i = wp.tid()
    if is_solid(b, i):
        return
    drho = float(0.0)
    j = wp.vec3()
    for q in range(t.w.shape[0]):
        drho += f[q, i]
        j += f[q, i] * along(t, q)
    if forces.shape[0] > 0:
        j += 0.5 * forces[i]
    inverse = 1.0 / (1.0 + drho)
    on_j = inverse * on_u[i]
    on_drho = -inverse * wp.dot(j, on_j)
    if on_excess.shape[0] > 0:
        on_drho += on_excess[i]
    if on_forces.shape[0] > 0:
        on_forces[i] += 0.5 * on_j
    for q in range(t.w.shape[0]):
        on_f[q, i] += on_drho + wp.dot(along(t, q), on_j)


@wp.kernel
def _inlets(
    # in:
    row: wp.array1d[int],
    given: wp.array1d[wp.vec3],
    # out:
    velocity: wp.array1d[wp.vec3],
):
    k = wp.tid()
    if row[k] >= 0:
        velocity[k] = given[wp.where(given.shape[0] > 1, row[k], 0)]


@wp.kernel
def _force(
    # in:
    t: Tables,
    b: Boundaries,
    body: int,
    on_total: wp.array1d[wp.vec3],
    # out:
    on_f: wp.array2d[float],
):
    i = wp.tid()
    word = word_of(b, i)
    if word == wp.uint32(0) or is_solid(b, i):
        return
    p = cell_of(b.n, i)
    for q in range(1, t.w.shape[0]):
        if is_link(word, q):
            behind, c = body_behind(t, b, p, q)
            if behind == body:
                on_f[q, i] = -2.0 * wp.dot(wp.vec3(float(c[0]), float(c[1]), float(c[2])), on_total[0])


def set_inlets(tables: Tables, boundaries: Boundaries, row: wp.array, velocity: wp.array) -> None:
    """Sets the velocities of inlets in boundaries: vec3 [I] by inlet cell, or [1] for all, in cells per step; `row`,
    int [F], is the number of each face's cell among those of inlets, or -1."""
    wp.launch(_inlets, row.shape[0], inputs=[row, velocity], outputs=[boundaries.velocity], device=row.device)
    mark(tables, boundaries)


def step_backward(
    tables: Tables,
    boundaries: Boundaries,
    flow: Flow,
    f: wp.array,
    on_out: wp.array,
    done: int,
    row: wp.array,
    on_f: wp.array,
    on_forces: wp.array,
    on_inlet: wp.array,
) -> None:
    """Computes the gradients of a step and of the conditions at its boundaries.

    Args:
        tables: The velocity set, with Q velocities.
        boundaries: The boundaries, with the inlets of this step.
        flow: The lattice.
        f: [Q, N], the populations that arrive before the step.
        on_out: [Q, N], the gradient to those after it.
        done: Number of steps done before.
        row: As for `set_inlets`.
        on_f: [Q, N], 0 at the call, receives the gradient to `f`.
        on_forces: vec3 [N], the gradient to the forces, added to; [0] without.
        on_inlet: vec3 [I], the gradient to the velocities of inlet cells, added to; [0] without.
    """
    cells, device = f.shape[1], f.device
    on_net = wp.zeros(1, dtype=wp.float64, device=device)
    if boundaries.words.shape[0]:
        wp.launch(_balance, cells, inputs=[tables, boundaries, on_out], outputs=[on_net], device=device)
    inputs = [tables, boundaries, flow, f, on_out, on_net, done, row]
    wp.launch(_step, cells, inputs=inputs, outputs=[on_f, on_forces, on_inlet], device=device)


def fields_backward(
    tables: Tables,
    boundaries: Boundaries,
    forces: wp.array,
    f: wp.array,
    on_excess: wp.array,
    on_u: wp.array,
    on_f: wp.array,
    on_forces: wp.array,
) -> None:
    """Adds the gradients of the density minus 1, float [N] or [0], and of the velocity, vec3 [N], in a flow with
    `forces`, vec3 [N] or [0]; else as `step_backward`."""
    inputs, outputs = [tables, boundaries, forces, f, on_excess, on_u], [on_f, on_forces]
    wp.launch(_fields, f.shape[1], inputs=inputs, outputs=outputs, device=f.device)


def force_backward(tables: Tables, boundaries: Boundaries, body: int, on_total: wp.array, on_f: wp.array) -> None:
    """Computes the gradient [Q, N] to the populations, 0 at the call, of the force on a body, vec3 [1]."""
    inputs = [tables, boundaries, body, on_total]
    wp.launch(_force, on_f.shape[1], inputs=inputs, outputs=[on_f], device=on_f.device)
