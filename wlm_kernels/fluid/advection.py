"""Advection of smoke, d rho / dt + u . grad rho = 0, on a grid finer than that of the velocities
(neural-six-way-lightmaps, section 5: 100^3 velocities, 400^3 densities).

Read `tests/reference/advection.py` first: it is the same step in float64 NumPy, cell by cell.

- Semi-Lagrangian: rho'(x) = rho(x_d), trilinear, at the departure point x_d = x - dt u(x - dt u(x) / 2), the midpoint
  rule (second-order Runge-Kutta). Unconditionally stable, no new extrema, first order. The velocity at a midpoint at
  most `REACH` coarse cells outside the eight velocities around x is extrapolated from them.
- MacCormack (Selle et al. 2008): with A a semi-Lagrangian step and A* the step back in time, rho' = A rho + (rho - A* A
  rho) / 2, clamped to the eight values that A interpolates. Second order where the field is smooth.

Neither scheme conserves mass.

Positions are in fine cells, centres at half integers; fields are flat, [X, Y, Z] with z fastest. Velocities are in
coarse cells per step at the centres of coarse cells, trilinear between them and constant beyond the outermost centres.
Special cases:

===============================  =====================================================================
a trace that leaves the domain   through an open face: 0, clean air; at a closed face: clamped to it
a trace that ends in a solid     cut where it enters the solid, by bisection to 1/64 of its length
a read beside a solid            solid cells are excluded, the other weights are scaled up
a cell in a solid                no smoke
a MacCormack trace that ends     its cell takes a semi-Lagrangian step
beside a solid or past a face
a velocity that is not a number  the trace reads some cell of the grid, never memory outside it
more than half floats can hold   clamped to 65504
===============================  =====================================================================

A trace shorter than a coarse cell cannot jump over a wall. The gradients are those of `advection_adjoint`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.fluid.advection_places import (
    BRICK,
    BRICK_RUN,
    DENSE,
    FREE,
    RUN,
    SOLID,
    Box,
    Bricks,
    Stencil,
    TrilinearVelocity,
    beyond_open_face,
    clip_at_solid,
    corner,
    evaluate,
    fetch,
    in_domain,
    into_domain,
    is_solid,
    side_of,
    stencil,
    trace_back,
    wall_at,
)
from wlm_kernels.fluid.lattice_sets import cell_of, index_of

# Loops over eight cells run only beside solids; unrolled they would use registers in all other cells too.
_OPTIONS = {"enable_backward": False, "max_unroll": 4}

# Threads per block, and blocks per multiprocessor: a kernel that would use 110 registers then allows more threads, and
# spills registers in rare branches; fewer blocks are slower.
_BOUNDS = (256, 4)

STORAGES = {"float32": wp.float32, "float16": wp.float16}

_LARGEST_HALF = wp.constant(65504.0)
_BRICK_RUNS = wp.constant(BRICK * BRICK * BRICK // BRICK_RUN)


@functools.cache
def fields_struct(stored: type) -> Any:
    """Builds (once) the struct in which kernels take fields of `wp.float32` or `wp.float16`."""

    @wp.struct
    class FieldArrays:
        density: wp.array1d[stored]
        temperature: wp.array1d[stored]

    return FieldArrays


@dataclass(frozen=True, eq=False)
class Fields:
    """The smoke: flat arrays [cells] of one type, float or half; [0] for the temperature of smoke that has none."""

    density: wp.array
    temperature: wp.array

    @functools.cached_property
    def arrays(self) -> Any:
        struct = fields_struct(self.density.dtype)()
        struct.density, struct.temperature = self.density, self.temperature
        return struct


@functools.cache
def carry_kernel(correcting: bool, stored: type, in_bricks: bool, solids: bool, hot: bool) -> wp.Kernel:
    """Builds (once) a kernel that advects smoke; a thread computes a run: neighbouring cells along x.

    With `correcting` the kernel does the second half of a MacCormack step, else a semi-Lagrangian step. Values are of
    the type `stored`, `wp.float32` or `wp.float16`. With `in_bricks` only listed bricks are computed. Without `solids`
    (solid cells) the code is half as long; without temperatures (`hot`) it uses fewer registers.
    """
    run = BRICK_RUN if in_bricks else RUN
    fields_type = fields_struct(stored)

    @wp.func
    def in_range(value: float) -> stored:
        if wp.static(stored is wp.float16):
            return stored(wp.min(value, _LARGEST_HALF))
        return stored(value)

    # Addresses from Warp's 64-bit strides would take a third of the time.
    @wp.func_native("return field.data[i];")
    def peek(field: wp.array1d[stored], i: int) -> stored: ...

    @wp.func_native("field.data[i] = value;")
    def poke(field: wp.array1d[stored], i: int, value: stored): ...

    @wp.func
    def value_at(field: wp.array1d[stored], i: int) -> float:
        return float(peek(field, i))

    @wp.func
    def interpolate(field: wp.array1d[stored], at: Stencil) -> float:
        i00 = at.base
        i01 = at.base + at.step[1]
        i10 = at.base + at.step[0]
        i11 = i10 + at.step[1]
        a = wp.lerp(value_at(field, i00), value_at(field, i00 + at.step[2]), at.f[2])
        b = wp.lerp(value_at(field, i01), value_at(field, i01 + at.step[2]), at.f[2])
        c = wp.lerp(value_at(field, i10), value_at(field, i10 + at.step[2]), at.f[2])
        d = wp.lerp(value_at(field, i11), value_at(field, i11 + at.step[2]), at.f[2])
        return wp.lerp(wp.lerp(a, b, at.f[1]), wp.lerp(c, d, at.f[1]), at.f[0])

    @wp.func
    def interpolate_beside(field: wp.array1d[stored], walls: wp.array1d[wp.uint8], box: Box, p: wp.vec3) -> float:
        at = stencil(box.n, box.periodic, p)
        total = float(0.0)
        weight = float(0.0)
        # Integer divisions are slow: one cell is found by them, the others by its neighbours along each axis.
        first = cell_of(box.n, at.base)
        along = wp.vec3i(at.step[0] // (box.n[1] * box.n[2]), at.step[1] // box.n[2], at.step[2])
        for k in range(8):
            i, w = corner(at, k)
            if not is_solid(box, walls, first + wp.cw_mul(side_of(k), along)):
                total += w * value_at(field, i)
                weight += w
        # The result is 0 if all eight cells are solid.
        return total / wp.max(weight, 1.0e-6)

    @wp.func
    def limited(field: wp.array1d[stored], at: Stencil, value: float) -> float:
        """Clamps a value to the range of the eight stored values around a point."""
        i00 = at.base
        i01 = at.base + at.step[1]
        i10 = at.base + at.step[0]
        i11 = i10 + at.step[1]
        a = wp.vec4(value_at(field, i00), value_at(field, i01), value_at(field, i10), value_at(field, i11))
        i00 += at.step[2]
        i01 += at.step[2]
        i10 += at.step[2]
        i11 += at.step[2]
        b = wp.vec4(value_at(field, i00), value_at(field, i01), value_at(field, i10), value_at(field, i11))
        return wp.clamp(value, wp.min(wp.min(a, b)), wp.max(wp.max(a, b)))

    @wp.func
    def departure_point(
        box: Box,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        around: TrilinearVelocity,
        f: wp.vec3,
        x: wp.vec3,
        v: wp.vec3,
        dt: float,
        wall: wp.uint8,
    ):
        """Traces a point x back in time. Returns the end of the trace within the domain, whether the trace left the
        domain through an open face, and whether its end is beside a solid; `wall` is the mark of the cell of x."""
        end = trace_back(box, u, around, f, x, v, dt)
        p = wp.vec3(end)
        left = bool(False)
        beside = bool(False)
        if not in_domain(box, end):
            p = into_domain(box, end)
            left = beyond_open_face(box, end)
        if wp.static(solids):
            # Within half a coarse cell of a start without a solid beside it, a read meets no solid either.
            reach = 0.5 * float(box.refinement)
            away = end - x
            short = wp.abs(away[0]) <= reach and wp.abs(away[1]) <= reach and wp.abs(away[2]) <= reach
            if wall != FREE or not short:
                end_wall = wall_at(box, walls, p)
                beside = end_wall != FREE
                if end_wall == SOLID:
                    end = clip_at_solid(box, walls, x, end)
                    p = into_domain(box, end)
                    left = beyond_open_face(box, end)
        return p, left, beside

    @wp.func
    def first_of_run(box: Box, bricks: Bricks, i: int, k: int) -> wp.vec3i:
        if wp.static(in_bricks):
            r = i % _BRICK_RUNS
            b = cell_of(box.bricks, bricks.listed[k])
            within = cell_of(wp.vec3i(BRICK // BRICK_RUN, BRICK, BRICK), r)
            return wp.vec3i(b[0] * BRICK + within[0] * BRICK_RUN, b[1] * BRICK + within[1], b[2] * BRICK + within[2])
        p = cell_of(box.n, i)
        return wp.vec3i(p[0] * RUN, p[1], p[2])

    @wp.func
    def carry_run(
        box: Box,
        first: wp.vec3i,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        fields: fields_type,
        predicted: fields_type,
        dt: float,
        decay: wp.vec2,
        out: fields_type,
    ) -> float:
        """Advects up to `run` cells along x and returns their largest density or temperature."""
        most = float(0.0)
        around = TrilinearVelocity()
        around_x = float(-2.0)
        wall = wp.uint8(0)
        wall_x = float(-1.0)
        for x_cell in range(first[0], wp.min(first[0] + wp.static(run), box.n[0])):
            cell = wp.vec3i(x_cell, first[1], first[2])
            i = index_of(box.n, cell)
            smoke = float(0.0)
            heat = float(0.0)
            if wp.static(correcting):
                smoke = value_at(predicted.density, i)
                if wp.static(hot):
                    heat = value_at(predicted.temperature, i)
            x = wp.vec3(float(cell[0]) + 0.5, float(cell[1]) + 0.5, float(cell[2]) + 0.5)
            if wp.static(solids):
                coarse_x = wp.floor(box.voxel * x[0])
                if coarse_x != wall_x:
                    wall = wall_at(box, walls, x)
                    wall_x = coarse_x
            if wall != SOLID:
                f = box.voxel * x - wp.vec3(0.5, 0.5, 0.5)
                least = wp.vec3(wp.floor(f[0]), wp.floor(f[1]), wp.floor(f[2]))
                if least[0] != around_x:
                    around = fetch(u, stencil(box.coarse, box.periodic, box.voxel * x))
                    around_x = least[0]
                f -= least
                v = evaluate(around, f)
                p, left, beside = departure_point(box, u, walls, around, f, x, v, dt, wall)
                if wp.static(correcting):
                    q, left_q, beside_q = departure_point(box, u, walls, around, f, x, v, -dt, wall)
                    if not (left or left_q or beside or beside_q):
                        origin = stencil(box.n, box.periodic, p)
                        target = stencil(box.n, box.periodic, q)
                        back = interpolate(predicted.density, target)
                        change = 0.5 * (value_at(fields.density, i) - back)
                        smoke = limited(fields.density, origin, smoke + change)
                        if wp.static(hot):
                            back = interpolate(predicted.temperature, target)
                            change = 0.5 * (value_at(fields.temperature, i) - back)
                            heat = limited(fields.temperature, origin, heat + change)
                elif not left:
                    if wp.static(solids):
                        if beside:
                            smoke = interpolate_beside(fields.density, walls, box, p)
                            if wp.static(hot):
                                heat = interpolate_beside(fields.temperature, walls, box, p)
                    if not beside:
                        at = stencil(box.n, box.periodic, p)
                        smoke = interpolate(fields.density, at)
                        if wp.static(hot):
                            heat = interpolate(fields.temperature, at)
            smoke *= decay[0]
            heat *= decay[1]
            poke(out.density, i, in_range(smoke))
            most = wp.max(most, smoke)
            if wp.static(hot):
                poke(out.temperature, i, in_range(heat))
                most = wp.max(most, heat)
        return most

    @wp.kernel(module="unique", module_options=_OPTIONS, launch_bounds=_BOUNDS)
    def carry(
        # in:
        box: Box,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        fields: fields_type,
        predicted: fields_type,
        dt: float,
        decay: wp.vec2,
        bricks: Bricks,
        # out:
        out: fields_type,
    ):
        i = wp.tid()
        if wp.static(in_bricks):
            for k in range(i // _BRICK_RUNS, bricks.count[0], bricks.workers):
                first = first_of_run(box, bricks, i, k)
                if first[0] < box.n[0] and first[1] < box.n[1] and first[2] < box.n[2]:
                    most = carry_run(box, first, u, walls, fields, predicted, dt, decay, out)
                    if most > bricks.threshold:
                        bricks.busy[bricks.listed[k]] = 1
        else:
            carry_run(box, first_of_run(box, bricks, i, 0), u, walls, fields, predicted, dt, decay, out)

    return carry


def advect(
    box: Box,
    velocity: wp.array,
    walls: wp.array,
    fields: Fields,
    out: Fields,
    dt: float,
    decay: tuple[float, float] = (1.0, 1.0),
    bricks: Bricks = DENSE,
    predicted: Fields | None = None,
) -> None:
    """Does a semi-Lagrangian step, which is also the first half of a MacCormack step, or with `predicted` the second.

    Args:
        box: The domain, see `advection_places.make_box`.
        velocity: Velocity of the air, vec3 [coarse cells], coarse cells per lattice step.
        walls: uint8 [coarse cells] from `advection_places.mark_walls`, or [0] without solids.
        fields: The smoke before the step.
        out: The smoke after the step, in other arrays of the same shapes and types.
        dt: Duration in lattice steps.
        decay: Factors by which density and temperature are multiplied, at most 1; (1, 1) in the first half of a
            MacCormack step.
        bricks: The bricks to compute, listed by `advection_places.relist`; default all cells.
        predicted: The result of the first half, in a third set of arrays.
    """
    stored, solids, hot = fields.density.dtype, walls.shape[0] > 0, fields.temperature.shape[0] > 0
    kernel = carry_kernel(predicted is not None, stored, bricks.workers > 0, solids, hot)
    threads = bricks.workers * int(_BRICK_RUNS) or -(-box.n[0] // RUN) * box.n[1] * box.n[2]
    # A semi-Lagrangian step does not read the prediction.
    inputs = [box, velocity, walls, fields.arrays, (predicted or fields).arrays, float(dt), wp.vec2(*decay), bricks]
    wp.launch(kernel, threads, inputs=inputs, outputs=[out.arrays], device=fields.density.device)
