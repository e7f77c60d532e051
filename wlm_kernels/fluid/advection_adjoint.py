"""The backward pass of the advection of smoke, of its sources and of buoyancy: gradients to smoke and to velocities.

Read `advection` and `advection_sources` first. Every gradient is that of the discretised step, so the cases of the
forward pass are decided as there, and each is differentiated as it is computed:

- A trace is differentiated through both of its velocity reads. Along an axis on which it is clamped to a face its
  gradient is 0; where it is cut by a solid, the fraction of its length that remains is constant.
- Where MacCormack's limiter clamps a value, the gradient goes to the cell with the smallest of the eight values alone,
  the first of equal ones; where it drops the correction, to the prediction alone. Where smoke is uniform, rounding
  decides whether it does.
- Clean air from beyond an open face has no gradient, and neither have solid cells.

Values are float32. Gradients of neighbouring cells are summed in any order on CUDA.
"""

from collections.abc import Sequence

import warp as wp

from wlm_kernels.fluid.advection import Fields, fields_struct
from wlm_kernels.fluid.advection_places import (
    FREE,
    SOLID,
    Box,
    Stencil,
    beyond_open_face,
    clip_at_solid,
    corner,
    in_domain,
    interpolate_vectors,
    into_domain,
    is_solid,
    midpoint,
    side_of,
    stencil,
    wall_at,
)
from wlm_kernels.fluid.advection_sources import Region, cells_of, strength, within
from wlm_kernels.fluid.lattice_sets import cell_of, index_of

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

_FieldArrays = fields_struct(wp.float32)


@wp.struct
class Trace:
    """A trace from a cell back in time, with what its gradient needs.

    It is between the traces of the coarse cells `start`. Its `end` is within the domain; `stays` is its derivative by
    the unclamped and uncut end, along each axis. `left` tells whether it left the domain through an open face, `beside`
    whether its end is beside a solid.
    """

    start: Stencil
    end: wp.vec3
    stays: wp.vec3
    left: bool
    beside: bool


@wp.func
def _kept_axes(box: Box, x: wp.vec3) -> wp.vec3:
    """Returns 0 for each axis along which `into_domain` clamps a point, else 1."""
    kept = wp.vec3(1.0, 1.0, 1.0)
    for a in range(3):
        if box.periodic[a] == 0 and (x[a] < 0.0 or x[a] > float(box.n[a])):
            kept[a] = 0.0
    return kept


@wp.func
def _trace(box: Box, traces: wp.array1d[wp.vec3], walls: wp.array1d[wp.uint8], x: wp.vec3, first: int) -> Trace:
    """Traces a point x by the traces of the coarse cells from index `first` on."""
    out = Trace()
    out.start = stencil(box.coarse, box.periodic, box.voxel * x)
    out.start.base += first
    end = x + interpolate_vectors(traces, out.start)
    out.end = end
    out.stays = wp.vec3(1.0, 1.0, 1.0)
    if not in_domain(box, end):
        out.end = into_domain(box, end)
        out.stays = _kept_axes(box, end)
        out.left = beyond_open_face(box, end)
    if walls.shape[0] > 0:
        away = end - x
        near = wp.max(wp.abs(away)) <= 0.5 * float(box.refinement)
        if wall_at(box, walls, x) != FREE or not near:
            wall = wall_at(box, walls, out.end)
            out.beside = wall != FREE
            if wall == SOLID:
                cut = clip_at_solid(box, walls, x, end)
                fraction = wp.dot(cut - x, away) / wp.max(wp.dot(away, away), 1.0e-20)
                out.end = into_domain(box, cut)
                out.stays = fraction * _kept_axes(box, cut)
                out.left = beyond_open_face(box, cut)
    return out


@wp.func
def _slope(f: wp.vec3, k: int) -> wp.vec3:
    """Returns the derivatives of the trilinear weight of the cell k of eight by the fractions between them."""
    side = side_of(k)
    w = wp.vec3()
    sign = wp.vec3()
    for a in range(3):
        w[a] = wp.where(side[a] == 0, 1.0 - f[a], f[a])
        sign[a] = wp.where(side[a] == 0, -1.0, 1.0)
    return wp.vec3(sign[0] * w[1] * w[2], w[0] * sign[1] * w[2], w[0] * w[1] * sign[2])


@wp.func
def _trace_backward(trace: Trace, on_end: wp.vec3, on_traces: wp.array1d[wp.vec3]):
    """Adds the gradients to the traces of the coarse cells around a trace."""
    on_way = wp.cw_mul(trace.stays, on_end)
    for k in range(8):
        i, weight = corner(trace.start, k)
        wp.atomic_add(on_traces, i, weight * on_way)


@wp.kernel
def _ways(
    # in:
    box: Box,
    u: wp.array1d[wp.vec3],
    dt: float,
    on_traces: wp.array1d[wp.vec3],
    # in, out:
    on_u: wp.array1d[wp.vec3],
):
    i = wp.tid()
    start = i % u.shape[0]
    duration = wp.where(i < u.shape[0], dt, -dt)
    middle = midpoint(box, u, start, duration)
    at = stencil(box.coarse, box.periodic, box.voxel * into_domain(box, middle))
    on_w = -duration * float(box.refinement) * on_traces[i]
    on_middle = wp.vec3()
    for k in range(8):
        j, weight = corner(at, k)
        on_middle += wp.dot(u[j], on_w) * _slope(at.f, k)
        wp.atomic_add(on_u, j, weight * on_w)
    wp.atomic_add(on_u, start, -0.5 * duration * wp.cw_mul(_kept_axes(box, middle), on_middle))


@wp.func
def _read_backward(
    box: Box, walls: wp.array1d[wp.uint8], field: wp.array1d[float], trace: Trace, g: float, on_field: wp.array1d[float]
) -> wp.vec3:
    """Adds the gradients to the eight values that a trace's end reads; returns that to its position."""
    at = stencil(box.n, box.periodic, trace.end)
    weight = float(1.0)
    mean = float(0.0)
    if trace.beside:
        weight = float(0.0)
        for k in range(8):
            i, w = corner(at, k)
            if not is_solid(box, walls, cell_of(box.n, i)):
                weight += w
                mean += w * field[i]
        if weight < 1.0e-6:
            return wp.vec3()
        mean /= weight
    on_end = wp.vec3()
    for k in range(8):
        i, w = corner(at, k)
        counts = bool(True)
        if trace.beside:
            counts = not is_solid(box, walls, cell_of(box.n, i))
        if counts:
            wp.atomic_add(on_field, i, g * w / weight)
            on_end += (field[i] - mean) * _slope(at.f, k)
    return g / weight * on_end


@wp.func
def _interpolate(field: wp.array1d[float], at: Stencil) -> float:
    total = float(0.0)
    for k in range(8):
        i, weight = corner(at, k)
        total += weight * field[i]
    return total


@wp.func
def _corrected_backward(
    box: Box,
    walls: wp.array1d[wp.uint8],
    field: wp.array1d[float],
    predicted: wp.array1d[float],
    i: int,
    origin: Stencil,
    target: Trace,
    g: float,
    on_field: wp.array1d[float],
    on_predicted: wp.array1d[float],
) -> wp.vec3:
    """Adds the gradients of the correction in cell i; returns that to the end of the trace forwards in time."""
    least = float(field[origin.base])
    most = float(least)
    i_least = int(origin.base)
    for k in range(1, 8):
        j = origin.base + wp.dot(side_of(k), origin.step)
        if field[j] < least:
            least = field[j]
            i_least = j
        most = wp.max(most, field[j])
    value = predicted[i] + 0.5 * (field[i] - _interpolate(predicted, stencil(box.n, box.periodic, target.end)))
    if value < least:
        wp.atomic_add(on_field, i_least, g)
        return wp.vec3()
    if value > most:
        wp.atomic_add(on_predicted, i, g)
        return wp.vec3()
    wp.atomic_add(on_predicted, i, g)
    wp.atomic_add(on_field, i, 0.5 * g)
    return _read_backward(box, walls, predicted, target, -0.5 * g, on_predicted)


@wp.func
def _centre(p: wp.vec3i) -> wp.vec3:
    return wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)


@wp.kernel
def _carry(
    # in:
    box: Box,
    traces: wp.array1d[wp.vec3],
    walls: wp.array1d[wp.uint8],
    fields: _FieldArrays,
    decay: wp.vec2,
    on_out: _FieldArrays,
    # in, out:
    on_fields: _FieldArrays,
    on_traces: wp.array1d[wp.vec3],
):
    i = wp.tid()
    hot = fields.temperature.shape[0] > 0
    smoke = decay[0] * on_out.density[i]
    heat = float(0.0)
    if hot:
        heat = decay[1] * on_out.temperature[i]
    if smoke == 0.0 and heat == 0.0:
        return
    p = cell_of(box.n, i)
    if is_solid(box, walls, p):
        return
    trace = _trace(box, traces, walls, _centre(p), 0)
    if trace.left:
        return
    on_end = _read_backward(box, walls, fields.density, trace, smoke, on_fields.density)
    if hot:
        on_end += _read_backward(box, walls, fields.temperature, trace, heat, on_fields.temperature)
    _trace_backward(trace, on_end, on_traces)


@wp.kernel
def _correct(
    # in:
    box: Box,
    traces: wp.array1d[wp.vec3],
    walls: wp.array1d[wp.uint8],
    fields: _FieldArrays,
    predicted: _FieldArrays,
    decay: wp.vec2,
    on_out: _FieldArrays,
    # in, out:
    on_fields: _FieldArrays,
    on_predicted: _FieldArrays,
    on_traces: wp.array1d[wp.vec3],
):
    i = wp.tid()
    hot = fields.temperature.shape[0] > 0
    smoke = decay[0] * on_out.density[i]
    heat = float(0.0)
    if hot:
        heat = decay[1] * on_out.temperature[i]
    if smoke == 0.0 and heat == 0.0:
        return
    p = cell_of(box.n, i)
    if is_solid(box, walls, p):
        return
    source = _trace(box, traces, walls, _centre(p), 0)
    target = _trace(box, traces, walls, _centre(p), traces.shape[0] // 2)
    if source.left or target.left or source.beside or target.beside:
        wp.atomic_add(on_predicted.density, i, smoke)
        if hot:
            wp.atomic_add(on_predicted.temperature, i, heat)
        return
    at = stencil(box.n, box.periodic, source.end)
    on_end = _corrected_backward(
        box, walls, fields.density, predicted.density, i, at, target, smoke, on_fields.density, on_predicted.density
    )
    if hot:
        on_end += _corrected_backward(
            box,
            walls,
            fields.temperature,
            predicted.temperature,
            i,
            at,
            target,
            heat,
            on_fields.temperature,
            on_predicted.temperature,
        )
    _trace_backward(target, on_end, on_traces)


@wp.kernel
def _source(
    # in:
    box: Box,
    walls: wp.array1d[wp.uint8],
    region: Region,
    kept: float,
    low: wp.vec3i,
    cells: wp.vec3i,
    number: int,
    # in, out:
    on_fields: _FieldArrays,
    on_values: wp.array1d[wp.vec2],
):
    p = low + cell_of(cells, wp.tid())
    if not within(box, walls, region, p):
        return
    i = index_of(box.n, p)
    on_both = wp.vec2(on_fields.density[i], 0.0)
    on_fields.density[i] = kept * on_both[0]
    if on_fields.temperature.shape[0] > 0:
        on_both[1] = on_fields.temperature[i]
        on_fields.temperature[i] = kept * on_both[1]
    wp.atomic_add(on_values, number, strength(region, p) * on_both)


@wp.kernel
def _lift(
    # in:
    box: Box,
    walls: wp.array1d[wp.uint8],
    by_density: wp.vec3,
    by_temperature: wp.vec3,
    on_force: wp.array1d[wp.vec3],
    # in, out:
    on_fields: _FieldArrays,
):
    i = wp.tid()
    p = cell_of(box.n, i)
    if is_solid(box, walls, p):
        return
    r = box.refinement
    g = on_force[index_of(box.coarse, wp.vec3i(p[0] // r, p[1] // r, p[2] // r))]
    volume = box.voxel * box.voxel * box.voxel
    on_fields.density[i] += volume * wp.dot(by_density, g)
    if on_fields.temperature.shape[0] > 0:
        on_fields.temperature[i] += volume * wp.dot(by_temperature, g)


def trace_backward(box: Box, velocity: wp.array, dt: float, on_traces: wp.array, on_velocity: wp.array) -> None:
    """Adds the gradients of `advection_places.trace`, which describes the first arguments, to `on_velocity`, vec3
    [coarse cells]; `on_traces` are the gradients to its result."""
    inputs = [box, velocity, float(dt), on_traces]
    wp.launch(_ways, on_traces.shape[0], inputs=inputs, outputs=[on_velocity], device=on_traces.device)


def advect_backward(
    box: Box,
    traces: wp.array,
    walls: wp.array,
    fields: Fields,
    on_out: Fields,
    on_fields: Fields,
    on_traces: wp.array,
    decay: tuple[float, float] = (1.0, 1.0),
    predicted: Fields | None = None,
    on_predicted: Fields | None = None,
) -> None:
    """Adds the gradients of `advection.advect`, which describes the first arguments, in float32, or with `predicted`
    and `on_predicted` those of its second half.

    `on_out` are the gradients to its result. Added to are `on_fields`, `on_traces`, like `traces`, and `on_predicted`.
    """
    cells, device = fields.density.shape[0], fields.density.device
    settings = [wp.vec2(*decay), on_out.arrays]
    if predicted is None or on_predicted is None:
        inputs, outputs = [box, traces, walls, fields.arrays, *settings], [on_fields.arrays, on_traces]
        wp.launch(_carry, cells, inputs=inputs, outputs=outputs, device=device)
    else:
        inputs = [box, traces, walls, fields.arrays, predicted.arrays, *settings]
        outputs = [on_fields.arrays, on_predicted.arrays, on_traces]
        wp.launch(_correct, cells, inputs=inputs, outputs=outputs, device=device)


def source_backward(
    box: Box, walls: wp.array, region: Region, number: int, on_fields: Fields, on_values: wp.array, *, fixed: bool
) -> None:
    """Computes the gradients of `advection_sources.add_source`, which describes the first arguments, for values of at
    least 0, so that nothing is clamped.

    `on_fields`, the gradients to the fields after it, are overwritten by those to the fields before it. Those to the
    density and the temperature that source `number` adds or sets are added to its row of `on_values`, vec2 [S].
    """
    low, cells, total = cells_of(box, region)
    if total > 0:
        inputs = [box, walls, region, 0.0 if fixed else 1.0, low, cells, number]
        wp.launch(_source, total, inputs=inputs, outputs=[on_fields.arrays, on_values], device=on_values.device)


def buoyancy_backward(
    box: Box,
    walls: wp.array,
    by_density: Sequence[float],
    by_temperature: Sequence[float],
    on_force: wp.array,
    on_fields: Fields,
) -> None:
    """Adds the gradients of `advection_sources.buoyancy`, which describes the first arguments, to those of the fields;
    `on_force`, vec3 [coarse cells], is the gradient to its result."""
    inputs = [box, walls, wp.vec3(*by_density), wp.vec3(*by_temperature), on_force]
    cells, device = on_fields.density.shape[0], on_force.device
    wp.launch(_lift, cells, inputs=inputs, outputs=[on_fields.arrays], device=device)
