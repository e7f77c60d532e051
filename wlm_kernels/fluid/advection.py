"""Advection of smoke, d rho / dt + u . grad rho = 0, on a grid finer than that of the velocities
(neural-six-way-lightmaps, section 5: 100^3 velocities, 400^3 densities).

Read `tests/reference/advection.py` first: it is the same step in float64 NumPy, cell by cell.

- Semi-Lagrangian: rho'(x) = rho(x_d), trilinear, at the departure point x_d = x - dt u(x - dt u(x) / 2), the midpoint
  rule (second-order Runge-Kutta). Unconditionally stable, no new extrema, first order. The velocity at a midpoint at
  most `REACH` coarse cells outside the eight velocities around x is extrapolated from them.
- MacCormack (Selle et al. 2008): with A a semi-Lagrangian step and A* the step back in time, rho' = A rho + (rho - A* A
  rho) / 2, clamped to the eight values that A interpolates. Second order where the field is smooth.

Neither scheme conserves mass.

Positions are in fine cells, centres at half integers; fields are flat, [X, Y, Z] with z fastest, or pools of bricks.
Velocities are in coarse cells per step at the centres of coarse cells, trilinear between them and constant beyond the
outermost centres. Special cases:

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
    CELLS,
    DENSE,
    FREE,
    SOLID,
    Box,
    Bricks,
    Stencil,
    beyond_open_face,
    clip_at_solid,
    in_domain,
    interpolate_vectors,
    into_domain,
    is_solid,
    lowest_cell,
    pair,
    place_at,
    share_of,
    side_of,
    stencil,
    stored_index,
    vector_at,
    wall_at,
)
from wlm_kernels.fluid.lattice_sets import Slab, cell_of, index_of

# Loops over eight cells run only beside solids; unrolled they would use registers in all other cells too.
_OPTIONS = {"enable_backward": False, "max_unroll": 4}

# Threads per block, and blocks per multiprocessor: fewer blocks, with more registers, are slower.
_BOUNDS, _BRICK_BOUNDS = (256, 4), (256, 3)

# Cells along x that one thread computes, so that cells between the same eight velocities read them once.
_RUN, _BRICK_RUN = 16, BRICK

# Threads of a block along y and z: neighbours share most of their reads.
_TILE = 16

# Cells along x by which values are fetched into the cache before they are read.
_AHEAD = 2

STORAGES = {"float32": wp.float32, "float16": wp.float16}

_PREFETCH = """
#if defined(__CUDA_ARCH__)
asm volatile("prefetch.global.L2 [%0];" :: "l"(field.data + i));
#endif
"""

_LARGEST_HALF = wp.constant(65504.0)
_BRICK_RUNS = wp.constant(CELLS // _BRICK_RUN)


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
    """The smoke: flat arrays [cells], or [512 P] of a pool of P bricks, of one type, float or half; [0] for the
    temperature of smoke that has none; `fuel` like the density, of smoke that burns."""

    density: wp.array
    temperature: wp.array
    fuel: wp.array | None = None

    @functools.cached_property
    def parts(self) -> list[wp.array]:
        """The arrays that the smoke has: density, temperature and fuel."""
        return [part for part in (self.density, self.temperature, self.fuel) if part is not None and part.size]

    @functools.cached_property
    def burning(self) -> "Fields":
        """The fuel as the density of cold smoke, which is moved alike."""
        return Fields(self.fuel, wp.empty(0, dtype=self.fuel.dtype, device=self.fuel.device))

    @functools.cached_property
    def arrays(self) -> Any:
        struct = fields_struct(self.density.dtype)()
        struct.density, struct.temperature = self.density, self.temperature
        return struct


@functools.cache
def carry_kernel(correcting: bool, stored: type, in_bricks: bool, solids: bool, hot: bool) -> wp.Kernel:
    """Builds (once) a kernel that advects smoke; a thread computes a run: neighbouring cells along x.

    Cells whose traces are long, end at a face or may meet a solid come after the others of a run, so that they need no
    registers while these are computed.

    With `correcting` the kernel does the second half of a MacCormack step, else a semi-Lagrangian step. Values are of
    the type `stored`, `wp.float32` or `wp.float16`. With `in_bricks` only listed bricks are computed. Without `solids`
    (solid cells) the code is half as long; without temperatures (`hot`) it uses fewer registers.
    """
    run = _BRICK_RUN if in_bricks else _RUN
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

    # True for 0 <= i < n.
    @wp.func_native("return (unsigned)i < (unsigned)n;")
    def is_below(i: int, n: int) -> bool: ...

    @wp.func_native(_PREFETCH)
    def prefetch(field: wp.array1d[stored], i: int): ...

    @wp.func
    def between(a: float, b: float, t: float) -> float:
        return (b - a) * t + a

    @wp.func
    def address(box: Box, bricks: Bricks, cell: wp.vec3i) -> int:
        if wp.static(in_bricks):
            return stored_index(box, bricks, cell)
        return index_of(box.n, cell)

    @wp.func
    def side_values(
        field: wp.array1d[stored], box: Box, bricks: Bricks, x: int, y: int, z: int, along_y: int, along_z: int
    ) -> wp.vec4:
        """Returns the values of the cells (x, y, z), (x, y, z + along_z), (x, y + along_y, z) and of the last."""
        out = wp.vec4()
        if wp.static(in_bricks):
            # Brick and cell in the brick along each axis, of the lower and of the upper cells.
            brick_y = wp.vec2i(y >> 3, (y + along_y) >> 3) * box.bricks[2]
            brick_z = wp.vec2i(z >> 3, (z + along_z) >> 3)
            cell_y = wp.vec2i((y & 7) << 3, ((y + along_y) & 7) << 3)
            cell_z = wp.vec2i(z & 7, (z + along_z) & 7)
            b = (x >> 3) * (box.bricks[1] * box.bricks[2])
            c = (x & 7) << 6
            for k in range(4):
                place = place_at(bricks.places, b + brick_y[k // 2] + brick_z[k % 2])
                out[k] = value_at(field, (place << 9) + c + cell_y[k // 2] + cell_z[k % 2])
        else:
            i = (x * box.n[1] + y) * box.n[2] + z
            j = i + along_y * box.n[2]
            out = wp.vec4(
                value_at(field, i), value_at(field, i + along_z), value_at(field, j), value_at(field, j + along_z)
            )
        return out

    @wp.func
    def blend(near: wp.vec4, far: wp.vec4, f: wp.vec3) -> float:
        """Interpolates between the values of `side_values` on both sides of a point."""
        a = between(between(near[0], near[1], f[2]), between(near[2], near[3], f[2]), f[1])
        b = between(between(far[0], far[1], f[2]), between(far[2], far[3], f[2]), f[1])
        return between(a, b, f[0])

    @wp.func
    def sides_around(field: wp.array1d[stored], box: Box, bricks: Bricks, p: wp.vec3):
        """Returns the values of the eight cells around a point, in two halves, and the fractions between them."""
        cell, along, f = lowest_cell(box.n, box.periodic, p)
        near = side_values(field, box, bricks, cell[0], cell[1], cell[2], along[1], along[2])
        far = side_values(field, box, bricks, cell[0] + along[0], cell[1], cell[2], along[1], along[2])
        return near, far, f

    @wp.func
    def interpolate(field: wp.array1d[stored], box: Box, bricks: Bricks, p: wp.vec3) -> float:
        near, far, f = sides_around(field, box, bricks, p)
        return blend(near, far, f)

    @wp.func
    def interpolate_beside(
        field: wp.array1d[stored], walls: wp.array1d[wp.uint8], box: Box, bricks: Bricks, p: wp.vec3
    ) -> float:
        first, along, f = lowest_cell(box.n, box.periodic, p)
        total = float(0.0)
        weight = float(0.0)
        for k in range(8):
            side = side_of(k)
            cell = first + wp.cw_mul(side, along)
            if not is_solid(box, walls, cell):
                w = share_of(side, f)
                total += w * value_at(field, address(box, bricks, cell))
                weight += w
        # The result is 0 if all eight cells are solid.
        return total / wp.max(weight, 1.0e-6)

    @wp.func
    def corrected(value: float, predicted: float, back: float, low: float, high: float) -> float:
        return wp.clamp(predicted + 0.5 * (value - back), low, high)

    @wp.func
    def correct(
        field: wp.array1d[stored],
        predicted: wp.array1d[stored],
        box: Box,
        bricks: Bricks,
        i: int,
        p: wp.vec3,
        q: wp.vec3,
    ) -> float:
        near, far, _f = sides_around(field, box, bricks, p)
        low = wp.min(wp.min(near, far))
        high = wp.max(wp.max(near, far))
        back = interpolate(predicted, box, bricks, q)
        return corrected(value_at(field, i), value_at(predicted, i), back, low, high)

    @wp.func
    def write(i: int, smoke: float, heat: float, decay: wp.vec2, out: fields_type) -> float:
        """Writes a cell after its decay, and returns the larger of its density and temperature."""
        most = decay[0] * smoke
        poke(out.density, i, in_range(most))
        if wp.static(hot):
            warmth = decay[1] * heat
            poke(out.temperature, i, in_range(warmth))
            most = wp.max(most, warmth)
        return most

    @wp.func
    def is_short(box: Box, away: wp.vec3) -> bool:
        """Tests whether a trace ends within half a coarse cell: if no solid is beside its start, none is at its end."""
        return wp.max(wp.abs(away)) <= 0.5 * float(box.refinement)

    @wp.func
    def end_of_trace(
        box: Box, traces: wp.array1d[wp.vec3], walls: wp.array1d[wp.uint8], x: wp.vec3, at: Stencil, wall: wp.uint8
    ):
        """Traces a point x by the traces of the coarse cells around it. Returns the end within the domain, whether the
        trace left the domain through an open face, and whether its end is beside a solid; `wall` is the mark of the
        cell of x."""
        end = x + interpolate_vectors(traces, at)
        p = wp.vec3(end)
        left = bool(False)
        beside = bool(False)
        if not in_domain(box, end):
            p = into_domain(box, end)
            left = beyond_open_face(box, end)
        if wp.static(solids):
            if wall != FREE or not is_short(box, end - x):
                end_wall = wall_at(box, walls, p)
                beside = end_wall != FREE
                if end_wall == SOLID:
                    end = clip_at_solid(box, walls, x, end)
                    p = into_domain(box, end)
                    left = beyond_open_face(box, end)
        return p, left, beside

    @wp.func
    def carry_cell(
        box: Box,
        bricks: Bricks,
        cell: wp.vec3i,
        i: int,
        traces: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        fields: fields_type,
        predicted: fields_type,
    ):
        """Returns the density and the temperature of any cell, of index i, after a step, before their decay."""
        smoke = float(0.0)
        heat = float(0.0)
        x = wp.vec3(float(cell[0]) + 0.5, float(cell[1]) + 0.5, float(cell[2]) + 0.5)
        wall = wp.uint8(0)
        if wp.static(solids):
            wall = wall_at(box, walls, x)
        if wall != SOLID:
            start = stencil(box.coarse, box.periodic, box.voxel * x)
            p, left, beside = end_of_trace(box, traces, walls, x, start, wall)
            if wp.static(correcting):
                smoke = value_at(predicted.density, i)
                if wp.static(hot):
                    heat = value_at(predicted.temperature, i)
                uncorrected = left or beside
                if not uncorrected:
                    start.base += box.coarse[0] * box.coarse[1] * box.coarse[2]
                    q, left_q, beside_q = end_of_trace(box, traces, walls, x, start, wall)
                    uncorrected = left_q or beside_q
                if not uncorrected:
                    smoke = correct(fields.density, predicted.density, box, bricks, i, p, q)
                    if wp.static(hot):
                        heat = correct(fields.temperature, predicted.temperature, box, bricks, i, p, q)
            elif not left:
                if wp.static(solids):
                    if beside:
                        smoke = interpolate_beside(fields.density, walls, box, bricks, p)
                        if wp.static(hot):
                            heat = interpolate_beside(fields.temperature, walls, box, bricks, p)
                if not beside:
                    smoke = interpolate(fields.density, box, bricks, p)
                    if wp.static(hot):
                        heat = interpolate(fields.temperature, box, bricks, p)
        return smoke, heat

    @wp.func
    def between_cells(box: Box, end: wp.vec3):
        """Returns the lowest of the eight cells around a point, relative to the centre of cell (0, 0, 0), the fractions
        between them, and whether all exist."""
        at = wp.vec3i(int(wp.floor(end[0])), int(wp.floor(end[1])), int(wp.floor(end[2])))
        f = end - wp.vec3(float(at[0]), float(at[1]), float(at[2]))
        inside = is_below(at[0], box.n[0] - 1) and is_below(at[1], box.n[1] - 1) and is_below(at[2], box.n[2] - 1)
        return at, f, inside

    @wp.func
    def trace_beside(
        box: Box,
        traces: wp.array1d[wp.vec3],
        which: int,
        low: wp.vec3i,
        along_y: int,
        along_z: int,
        fy: float,
        fz: float,
    ) -> wp.vec3:
        i = index_of(box.coarse, low) + which * box.coarse[0] * box.coarse[1] * box.coarse[2]
        j = i + along_y * box.coarse[2]
        a = vector_at(traces, i)
        a += fz * (vector_at(traces, i + along_z) - a)
        b = vector_at(traces, j)
        b += fz * (vector_at(traces, j + along_z) - b)
        return a + fy * (b - a)

    @wp.func
    def side_at(field: wp.array1d[stored], box: Box, bricks: Bricks, at: wp.vec3i, x: int) -> wp.vec4:
        return side_values(field, box, bricks, at[0] + x, at[1], at[2], 1, 1)

    @wp.func
    def patch_of(box: Box, i: int) -> int:
        """Returns the coarse cell, -1 or above, between whose centre and the next the centre of a fine cell is."""
        return (2 * i + 1 + box.refinement) // (2 * box.refinement) - 1

    @wp.func
    def first_of_run(box: Box, bricks: Bricks, begin: int, i: int, k: int) -> wp.vec3i:
        if wp.static(in_bricks):
            r = i % _BRICK_RUNS
            b = cell_of(box.bricks, bricks.listed[k])
            return BRICK * b + wp.vec3i(0, r // BRICK, r % BRICK)
        tile = cell_of(
            wp.vec3i(1, (box.n[1] + _TILE - 1) // _TILE, (box.n[2] + _TILE - 1) // _TILE), i // (_TILE * _TILE)
        )
        thread = i % (_TILE * _TILE)
        return wp.vec3i(begin + tile[0] * _RUN, tile[1] * _TILE + thread // _TILE, tile[2] * _TILE + thread % _TILE)

    @wp.func
    def carry_run(
        box: Box,
        first: wp.vec3i,
        last: int,
        traces: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        fields: fields_type,
        predicted: fields_type,
        decay: wp.vec2,
        bricks: Bricks,
        out: fields_type,
    ) -> float:
        """Advects up to `run` cells along x, below cell `last`, and returns their largest density or temperature."""
        most = float(0.0)
        others = int(0)
        sheet = wp.where(wp.static(in_bricks), BRICK * BRICK, box.n[1] * box.n[2])
        x = int(first[0])
        end = wp.min(first[0] + wp.static(run), last)
        begin = address(box, bricks, first)
        i = int(begin)
        patch = patch_of(box, first[0])
        patch_y = patch_of(box, first[1])
        patch_z = patch_of(box, first[2])
        low_y, along_y = pair(patch_y, box.coarse[1], box.periodic[1])
        low_z, along_z = pair(patch_z, box.coarse[2], box.periodic[2])
        fy = box.voxel * (float(first[1]) + 0.5) - 0.5 - float(patch_y)
        fz = box.voxel * (float(first[2]) + 0.5) - 0.5 - float(patch_z)
        # Traces at the fractions fy and fz, on both sides of the cells along x; the upper side is the next lower one.
        first_x, _along = pair(patch, box.coarse[0], box.periodic[0])
        far_trace = trace_beside(box, traces, 0, wp.vec3i(first_x, low_y, low_z), along_y, along_z, fy, fz)
        far_back = wp.vec3()
        if wp.static(correcting):
            far_back = trace_beside(box, traces, 1, wp.vec3i(first_x, low_y, low_z), along_y, along_z, fy, fz)
        # The cell whose side has been read last for each point, and that side: mostly the next cell needs it again.
        kept_place = int(-1)
        kept = wp.vec4()
        kept_low = float(0.0)
        kept_high = float(0.0)
        kept_heat = wp.vec4()
        back_place = int(-1)
        back = wp.vec4()
        back_heat = wp.vec4()
        while x < end:
            low_x, along_x = pair(patch, box.coarse[0], box.periodic[0])
            near_trace = wp.vec3(far_trace)
            far_trace = trace_beside(box, traces, 0, wp.vec3i(low_x + along_x, low_y, low_z), along_y, along_z, fy, fz)
            slope = far_trace - near_trace
            near_back = wp.vec3(far_back)
            slope_back = wp.vec3()
            if wp.static(correcting):
                far_back = trace_beside(
                    box, traces, 1, wp.vec3i(low_x + along_x, low_y, low_z), along_y, along_z, fy, fz
                )
                slope_back = far_back - near_back
            centre = float(patch) + 0.5
            stop = wp.min(end, (2 * patch + 3) * box.refinement // 2)
            for k in range(x, stop):
                if wp.static(not in_bricks):
                    ahead = i + wp.where(k + _AHEAD < box.n[0], _AHEAD * sheet, 0)
                    prefetch(fields.density, ahead)
                    if wp.static(correcting):
                        prefetch(predicted.density, ahead)
                cell = wp.vec3(float(k), float(first[1]), float(first[2]))
                fx = box.voxel * (cell[0] + 0.5) - centre
                # The order of the tests matters: it decides whether the compiler makes branches of them.
                if wp.static(solids):
                    wall = wall_at(box, walls, cell + wp.vec3(0.5, 0.5, 0.5))
                away = slope * fx + near_trace
                at, part, simple = between_cells(box, cell + away)
                if wp.static(solids):
                    simple = simple and wall == FREE and is_short(box, away)
                smoke = float(0.0)
                heat = float(0.0)
                if simple:
                    place = index_of(box.n, at)
                    if place != kept_place:
                        kept = side_at(fields.density, box, bricks, at, 0)
                        if wp.static(correcting):
                            kept_low = wp.min(kept)
                            kept_high = wp.max(kept)
                        if wp.static(hot):
                            kept_heat = side_at(fields.temperature, box, bricks, at, 0)
                    kept_place = place + box.n[1] * box.n[2]
                    far = side_at(fields.density, box, bricks, at, 1)
                    if wp.static(hot):
                        far_heat = side_at(fields.temperature, box, bricks, at, 1)
                    if wp.static(correcting):
                        smoke = value_at(predicted.density, i)
                        far_low = wp.min(far)
                        far_high = wp.max(far)
                        low = wp.min(kept_low, far_low)
                        high = wp.max(kept_high, far_high)
                        kept_low = far_low
                        kept_high = far_high
                        varies = low < high
                        if wp.static(hot):
                            heat = value_at(predicted.temperature, i)
                            coldest = wp.min(wp.min(kept_heat, far_heat))
                            hottest = wp.max(wp.max(kept_heat, far_heat))
                            varies = varies or coldest < hottest
                        # Nothing is corrected between equal values.
                        if varies:
                            away = slope_back * fx + near_back
                            to, part, simple = between_cells(box, cell + away)
                            if wp.static(solids):
                                simple = simple and is_short(box, away)
                            if simple:
                                place = index_of(box.n, to)
                                if place != back_place:
                                    back = side_at(predicted.density, box, bricks, to, 0)
                                    if wp.static(hot):
                                        back_heat = side_at(predicted.temperature, box, bricks, to, 0)
                                back_place = place + box.n[1] * box.n[2]
                                ahead_back = side_at(predicted.density, box, bricks, to, 1)
                                smoke = corrected(
                                    value_at(fields.density, i), smoke, blend(back, ahead_back, part), low, high
                                )
                                back = ahead_back
                                if wp.static(hot):
                                    ahead_heat = side_at(predicted.temperature, box, bricks, to, 1)
                                    warm = blend(back_heat, ahead_heat, part)
                                    heat = corrected(value_at(fields.temperature, i), heat, warm, coldest, hottest)
                                    back_heat = ahead_heat
                    else:
                        smoke = blend(kept, far, part)
                        if wp.static(hot):
                            heat = blend(kept_heat, far_heat, part)
                    if wp.static(not correcting):
                        kept = far
                    if wp.static(hot):
                        kept_heat = far_heat
                if simple:
                    most = wp.max(most, write(i, smoke, heat, decay, out))
                else:
                    others |= 1 << (k - first[0])
                i += sheet
            x = stop
            patch += 1
        if others != 0:
            for k in range(wp.static(run)):
                if (others >> k) & 1 != 0:
                    any_cell = wp.vec3i(first[0] + k, first[1], first[2])
                    at_cell = begin + k * sheet
                    any_smoke, any_heat = carry_cell(box, bricks, any_cell, at_cell, traces, walls, fields, predicted)
                    most = wp.max(most, write(at_cell, any_smoke, any_heat, decay, out))
        return most

    @wp.kernel(module="unique", module_options=_OPTIONS, launch_bounds=_BRICK_BOUNDS if in_bricks else _BOUNDS)
    def carry(
        # in:
        box: Box,
        traces: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        fields: fields_type,
        predicted: fields_type,
        decay: wp.vec2,
        begin: int,
        end: int,
        bricks: Bricks,
        # out:
        out: fields_type,
    ):
        i = wp.tid()
        if wp.static(in_bricks):
            for k in range(i // _BRICK_RUNS, bricks.counts[0], bricks.workers):
                first = first_of_run(box, bricks, begin, i, k)
                if first[0] < box.n[0] and first[1] < box.n[1] and first[2] < box.n[2]:
                    most = carry_run(box, first, end, traces, walls, fields, predicted, decay, bricks, out)
                    if most > bricks.threshold:
                        bricks.busy[bricks.listed[k]] = 1
        else:
            first = first_of_run(box, bricks, begin, i, 0)
            if first[1] < box.n[1] and first[2] < box.n[2]:
                carry_run(box, first, end, traces, walls, fields, predicted, decay, bricks, out)

    return carry


def advect(
    box: Box,
    traces: wp.array,
    walls: wp.array,
    fields: Fields,
    out: Fields,
    decay: tuple[float, float] = (1.0, 1.0),
    bricks: Bricks = DENSE,
    predicted: Fields | None = None,
    slab: Slab | None = None,
) -> None:
    """Does a semi-Lagrangian step, which is also the first half of a MacCormack step, or with `predicted` the second.

    Args:
        box: The domain, see `advection_places.make_box`.
        traces: The ways of the smoke in the step, from `advection_places.trace`; of twice the length with `predicted`.
        walls: uint8 [coarse cells] from `advection_places.mark_walls`, or [0] without solids.
        fields: The smoke before the step.
        out: The smoke after the step, in other arrays of the same shapes and types.
        decay: Factors by which density and temperature are multiplied, at most 1; (1, 1) in the first half of a
            MacCormack step.
        bricks: The bricks to compute, stored by `advection_sources.store`; default all cells.
        predicted: The result of the first half, in a third set of arrays.
        slab: The coarse cells to compute, without bricks; default all.
    """
    slab = slab or Slab(traces.device, 0, box.coarse[0])
    begin, end = slab.begin * box.refinement, slab.end * box.refinement
    stored, solids, hot = fields.density.dtype, walls.shape[0] > 0, fields.temperature.shape[0] > 0
    kernel = carry_kernel(predicted is not None, stored, bricks.workers > 0, solids, hot)
    tiles = -(-(end - begin) // _RUN) * -(-box.n[1] // _TILE) * -(-box.n[2] // _TILE)
    threads = bricks.workers * int(_BRICK_RUNS) or tiles * _TILE * _TILE
    # A semi-Lagrangian step does not read the prediction.
    smoke = [fields.arrays, (predicted or fields).arrays]
    inputs = [box, traces, walls, *smoke, wp.vec2(*decay), begin, end, bricks]
    wp.launch(kernel, threads, inputs=inputs, outputs=[out.arrays], device=slab.device)
