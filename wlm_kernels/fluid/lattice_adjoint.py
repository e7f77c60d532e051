"""The backward pass of a lattice Boltzmann step: gradients of what leaves the cells to what left them a step before.

Read `lattice` and `lattice_links` first. The kernels here undo their work in the opposite order: `links_backward`, then
`step_backward`. A gradient has the layout of the populations it belongs to, and is that of the stored f_q - w_q, which
is also that of f_q. One set of kernels serves all lattices: it reads the velocities from `Tables`, in rolled loops.

Where a formula has a kink the gradient is that of one side: where the eddy viscosity is 0 because there is no strain,
and where an outlet's velocity is exactly 0. Nothing passes through a velocity that an outlet has set to 0.
"""

import warp as wp

from wlm_kernels.fluid.lattice_links import BOUNCE, HOLD, INLET, OUTLET, SLIP, Links, mirrored
from wlm_kernels.fluid.lattice_sets import Tables, cell_of, crosses, index_of, opposite, wrapped

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

_BOUNCE, _INLET, _OUTLET, _SLIP = (wp.constant(kind) for kind in (BOUNCE, INLET, OUTLET, SLIP))


@wp.struct
class Flow:
    """The properties of a lattice of N cells that the backward pass of a step needs.

    Attributes:
        n: Cells along x, y and z.
        bounded: 1 for each axis that is not periodic, else 0.
        walled: 1 for each axis that walls at rest close at both ends, else 0.
        tau: Relaxation time, 1/2 + 3 nu.
        eddy: `lattice.eddy_factor`; 0: no eddy viscosity.
        axes: Number of dimensions, 2 or 3.
        solid: uint8 [N], number of the body of each cell, 0 for fluid; [0] without solids.
        forces: vec3 [N], acceleration of each cell's fluid; [0] without a force.
    """

    n: wp.vec3i
    bounded: wp.vec3i
    walled: wp.vec3i
    tau: float
    eddy: float
    axes: int
    solid: wp.array1d[wp.uint8]
    forces: wp.array1d[wp.vec3]


@wp.func
def _is_solid(flow: Flow, i: int) -> bool:
    if flow.solid.shape[0] == 0:
        return False
    return flow.solid[i] != wp.uint8(0)


@wp.func
def _pulled(t: Tables, flow: Flow, i: int, p: wp.vec3i, q: int):
    """Returns the direction and the cell of the population that arrives at cell i (at p) as population q."""
    source = p - t.c[q]
    if crosses(flow.n, flow.walled, source):
        return opposite(q), i
    return q, index_of(flow.n, wrapped(flow.n, source))


@wp.func
def _direction(t: Tables, q: int) -> wp.vec3:
    return wp.vec3(float(t.c[q][0]), float(t.c[q][1]), float(t.c[q][2]))


@wp.func
def _mixed(c: wp.vec3) -> wp.vec3:
    """Returns the products xy, xz and yz of a vector's components."""
    return wp.vec3(c[0] * c[1], c[0] * c[2], c[1] * c[2])


@wp.func
def _times_mixed(m: wp.vec3, g: wp.vec3) -> wp.vec3:
    """Returns the gradient to m of the products of `_mixed`, whose gradients are g."""
    return wp.vec3(m[1] * g[0] + m[2] * g[1], m[0] * g[0] + m[2] * g[2], m[0] * g[1] + m[1] * g[2])


@wp.kernel
def _step(
    # in:
    t: Tables,
    flow: Flow,
    f: wp.array2d[float],
    on_out: wp.array2d[float],
    # out:
    on_f: wp.array2d[float],
    on_forces: wp.array1d[wp.vec3],
):
    i = wp.tid()
    if _is_solid(flow, i):
        return
    p = cell_of(flow.n, i)
    # The moments, as in the step; the gradients to the moments that make the populations that leave.
    drho = float(0.0)
    j = wp.vec3()
    diagonal = wp.vec3()
    off = wp.vec3()
    on_rest = float(0.0)
    on_j = wp.vec3()
    square = wp.vec3()
    on_off = wp.vec3()
    for q in range(t.w.shape[0]):
        along, cell = _pulled(t, flow, i, p, q)
        g = f[along, cell]
        c = _direction(t, q)
        drho += g
        j += g * c
        diagonal += g * wp.cw_mul(c, c)
        off += g * _mixed(c)
        wide = t.w[q] * on_out[q, i]
        on_rest += wide
        on_j += 3.0 * wide * c
        square += 4.5 * wide * wp.cw_mul(c, c)
        on_off += 9.0 * wide * _mixed(c)
    on_diagonal = square - 1.5 * on_rest * wp.vec3(1.0, 1.0, 1.0)

    # The collision, forwards.
    inverse = 1.0 / (1.0 + drho)
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
    momentum = wp.vec3(j)
    if flow.forces.shape[0] > 0:
        momentum += flow.forces[i]

    # The collision, backwards: first the equilibrium after the force.
    on_momentum = on_j + inverse * (2.0 * wp.cw_mul(momentum, on_diagonal) + _times_mixed(momentum, on_off))
    on_inverse = wp.dot(wp.cw_mul(momentum, momentum), on_diagonal) + wp.dot(_mixed(momentum), on_off)
    on_drho = float(on_rest)
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
        along, cell = _pulled(t, flow, i, p, q)
        c = _direction(t, q)
        g = on_drho + wp.dot(c, to_j) + wp.dot(wp.cw_mul(c, c), to_stress) + wp.dot(_mixed(c), to_shear)
        on_f[along, cell] = g


@wp.kernel
def _fields(
    # in:
    t: Tables,
    flow: Flow,
    f: wp.array2d[float],
    on_excess: wp.array1d[float],
    on_u: wp.array1d[wp.vec3],
    # in, out:
    on_f: wp.array2d[float],
    on_forces: wp.array1d[wp.vec3],
):
    i = wp.tid()
    if _is_solid(flow, i):
        return
    p = cell_of(flow.n, i)
    drho = float(0.0)
    j = wp.vec3()
    for q in range(t.w.shape[0]):
        along, cell = _pulled(t, flow, i, p, q)
        drho += f[along, cell]
        j += f[along, cell] * _direction(t, q)
    if flow.forces.shape[0] > 0:
        j += 0.5 * flow.forces[i]
    inverse = 1.0 / (1.0 + drho)
    on_j = inverse * on_u[i]
    on_drho = -inverse * wp.dot(j, on_j)
    if on_excess.shape[0] > 0:
        on_drho += on_excess[i]
    if on_forces.shape[0] > 0:
        on_forces[i] += 0.5 * on_j
    for q in range(t.w.shape[0]):
        along, cell = _pulled(t, flow, i, p, q)
        on_f[along, cell] += on_drho + wp.dot(_direction(t, q), on_j)


@wp.func
def _stored_at(t: Tables, n: wp.vec3i, i: int, q: int) -> int:
    """Returns the cell whose population q stores what a link of cell i and direction q sends back."""
    return index_of(n, wrapped(n, cell_of(n, i) - t.c[q]))


@wp.kernel
def _links_written(
    # in:
    t: Tables,
    flow: Flow,
    links: Links,
    weight: wp.array1d[wp.float64],
    # in, out:
    on_f: wp.array2d[float],
    # out:
    on_net: wp.array1d[wp.float64],
):
    at = wp.tid()
    if at >= links.used[0]:
        return
    q = int(links.code[at]) & 31
    cell = _stored_at(t, flow.n, links.cell[at], q)
    g = on_f[q, cell]
    on_f[q, cell] = 0.0
    links.value[at] = g
    if int(links.code[at]) >> 5 == _OUTLET and weight[1] > wp.float64(0.0):
        wp.atomic_add(on_net, 0, -wp.float64(t.w[q] * g) / weight[1])


@wp.func
def _outflow(t: Tables, flow: Flow, i: int, q: int, kind: int, term: float, g: float, f: wp.array2d[float]):
    """Returns the gradients of an outlet's population, times g, to the density and the momentum of cell i."""
    drho = float(0.0)
    j = wp.vec3()
    for k in range(t.w.shape[0]):
        drho += f[k, i]
        j += f[k, i] * _direction(t, k)
    inverse = 1.0 / (1.0 + drho)
    u = inverse * j
    passes = wp.vec3(1.0, 1.0, 1.0)
    hold = float(1.0)
    source = cell_of(flow.n, i) - t.c[q]
    for a in range(3):
        if flow.bounded[a] != 0:
            if (source[a] < 0 and u[a] > 0.0) or (source[a] >= flow.n[a] and u[a] < 0.0):
                passes[a] = 0.0
            if source[a] < 0 or source[a] >= flow.n[a]:
                hold = wp.min(hold, HOLD / float(flow.n[a]))
    u = wp.cw_mul(passes, u)
    kept = float(1.0)
    target = float(drho)
    if kind != _OUTLET:
        kept = 1.0 - hold
        target += hold * (term - drho)
    c = _direction(t, q)
    cu = wp.dot(c, u)
    g *= t.w[q]
    on_u = wp.cw_mul(passes, g * (1.0 + target) * ((3.0 + 9.0 * cu) * c - 3.0 * u))
    on_target = g * (1.0 + 3.0 * cu + 4.5 * cu * cu - 1.5 * wp.dot(u, u))
    return kept * on_target - inverse * wp.dot(u, on_u), inverse * on_u


@wp.kernel
def _links_valued(
    # in:
    t: Tables,
    flow: Flow,
    links: Links,
    row: wp.array1d[int],
    risen: float,
    f: wp.array2d[float],
    on_net: wp.array1d[wp.float64],
    # in, out:
    on_f: wp.array2d[float],
    on_inlet: wp.array1d[wp.vec3],
):
    at = wp.tid()
    if at >= links.used[0]:
        return
    i = links.cell[at]
    if _is_solid(flow, i):
        return
    q = int(links.code[at]) & 31
    kind = int(links.code[at]) >> 5
    # The net mass is that of the value minus that of the population that went out.
    net = float(on_net[0])
    g = links.value[at] + net
    back = opposite(q)
    wp.atomic_add(on_f, back, i, -net)
    if kind == _SLIP:
        k, c = mirrored(t, flow.n, flow.bounded, i, q)
        if _is_solid(flow, k):
            wp.atomic_add(on_f, back, i, g)
        else:
            wp.atomic_add(on_f, t.index[9 * (c[0] + 1) + 3 * (c[1] + 1) + c[2] + 1], k, g)
    elif kind == _BOUNCE or kind == _INLET:
        wp.atomic_add(on_f, back, i, g)
        if kind == _INLET and on_inlet.shape[0] > 0:
            wp.atomic_add(on_inlet, row[at], 6.0 * risen * t.w[q] * g * _direction(t, q))
    else:
        on_drho, on_j = _outflow(t, flow, i, q, kind, links.term[at], g, f)
        for k in range(t.w.shape[0]):
            wp.atomic_add(on_f, k, i, on_drho + wp.dot(_direction(t, k), on_j))


@wp.kernel
def _inlets(
    # in:
    t: Tables,
    links: Links,
    row: wp.array1d[int],
    velocity: wp.array1d[wp.vec3],
    # out:
    term: wp.array1d[float],
):
    at = wp.tid()
    if int(links.code[at]) >> 5 == _INLET and at < links.faces:
        q = int(links.code[at]) & 31
        u = velocity[wp.where(velocity.shape[0] > 1, row[at], 0)]
        term[at] = 6.0 * t.w[q] * wp.dot(_direction(t, q), u)


@wp.kernel
def _force(
    # in:
    t: Tables,
    flow: Flow,
    links: Links,
    body: int,
    on_total: wp.array1d[wp.vec3],
    # out:
    on_f: wp.array2d[float],
):
    at = wp.tid()
    if at >= links.used[0]:
        return
    i = links.cell[at]
    q = int(links.code[at]) & 31
    c = t.c[q]
    element = _stored_at(t, flow.n, i, q)
    k = int(element)
    if int(links.code[at]) >> 5 == _SLIP:
        k, c = mirrored(t, flow.n, flow.bounded, i, q)
    elif crosses(flow.n, flow.bounded, cell_of(flow.n, i) - c):
        return
    if int(flow.solid[k]) == body and not _is_solid(flow, i):
        on_f[q, element] = -2.0 * wp.dot(wp.vec3(float(c[0]), float(c[1]), float(c[2])), on_total[0])


def set_inlets(tables: Tables, links: Links, row: wp.array, velocity: wp.array) -> None:
    """Sets the terms of the links of inlets to those of given velocities, vec3 [I] by inlet cell, or [1] for all, in
    cells per step; `row`, int [L], is the inlet cell of each link."""
    inputs = [tables, links, row, velocity]
    wp.launch(_inlets, links.cell.shape[0], inputs=inputs, outputs=[links.term], device=row.device)


def step_backward(tables: Tables, flow: Flow, f: wp.array, on_out: wp.array, on_f: wp.array, on_forces: wp.array):
    """Computes the gradients of a step without the links of its faces and solids.

    `f`, [Q, N], are the populations before the step, and `on_out` the gradient to those that leave the cells. `on_f`, 0
    at the call, receives that to `f`; that to the forces is added to `on_forces`, vec3 [N], [0] without.
    """
    inputs, outputs = [tables, flow, f, on_out], [on_f, on_forces]
    wp.launch(_step, f.shape[1], inputs=inputs, outputs=outputs, device=f.device)


def fields_backward(
    tables: Tables, flow: Flow, f: wp.array, on_excess: wp.array, on_u: wp.array, on_f: wp.array, on_forces: wp.array
) -> None:
    """Adds the gradients of the density minus 1, float [N] or [0], and of the velocity, vec3 [N]; else as
    `step_backward`."""
    inputs, outputs = [tables, flow, f, on_excess, on_u], [on_f, on_forces]
    wp.launch(_fields, f.shape[1], inputs=inputs, outputs=outputs, device=f.device)


def links_backward(
    tables: Tables,
    flow: Flow,
    links: Links,
    row: wp.array,
    risen: float,
    f: wp.array,
    sums: wp.array,
    on_f: wp.array,
    on_inlet: wp.array,
) -> None:
    """Computes the gradients of `lattice_links.apply`, in place.

    Args:
        tables: The velocity set, with Q velocities.
        flow: The lattice.
        links: The links; `value` is overwritten.
        row: int [L], the inlet cell of each link of an inlet.
        risen: The factor of the inlets' velocities in this step, 1 after their ramp.
        f: [Q, N], the populations before `apply`; read only if there are outlets.
        sums: float64 [2], as `apply` left them: the sum of the weights of outlet links is read.
        on_f: [Q, N], the gradient to the populations after `apply`, overwritten by that to `f`.
        on_inlet: vec3 [I], the gradient to the velocities of inlet cells, added to; [0] without.
    """
    size, device = links.cell.shape[0], on_f.device
    if size == 0:
        return
    on_net = wp.zeros(1, dtype=wp.float64, device=device)
    wp.launch(_links_written, size, inputs=[tables, flow, links, sums], outputs=[on_f, on_net], device=device)
    inputs = [tables, flow, links, row, float(risen), f, on_net]
    wp.launch(_links_valued, size, inputs=inputs, outputs=[on_f, on_inlet], device=device)


def force_backward(tables: Tables, flow: Flow, links: Links, body: int, on_total: wp.array, on_f: wp.array) -> None:
    """Computes the gradient [Q, N] to the populations, 0 at the call, of the force on a body, vec3 [1]."""
    inputs = [tables, flow, links, body, on_total]
    wp.launch(_force, links.cell.shape[0], inputs=inputs, outputs=[on_f], device=on_f.device)
