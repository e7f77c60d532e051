"""Advection of smoke, d rho / dt + u . grad rho = 0, on a grid finer than that of the velocities
(neural-six-way-lightmaps, section 5: 100^3 velocities, 400^3 densities).

Read `tests/reference/advection.py` first: it is the same step in float64 NumPy, cell by cell.

- Semi-Lagrangian: rho'(x) = rho(x_d), trilinear, at the departure point x_d = x - dt u(x - dt u(x) / 2), the midpoint
  rule (second-order Runge-Kutta). Unconditionally stable, no new extrema, first order. x_d - x is computed at the
  centres of coarse cells (`advection_places.trace`) and is trilinear between them, as the velocities are.
- MacCormack (Selle et al. 2008): with A a semi-Lagrangian step and A* the step back in time, rho' = A rho + (rho - A* A
  rho) / 2. It is clamped to the least of the eight values that A interpolates; above the largest it is A rho alone,
  since clamps at both ends add smoke: more values end below than above. Second order where the field is smooth.

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


@wp.struct
class Corners:
    """Indices of the eight cells around a point in a field, the lower and the upper of each pair along z, and the
    fractions between them; the pairs are those of (x, y), (x, y + 1), (x + 1, y) and (x + 1, y + 1)."""

    low: wp.vec4i
    high: wp.vec4i
    f: wp.vec3


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


@wp.func
def run_of_brick(box: Box, brick: int, i: int) -> wp.vec3i:
    """Returns the first of the cells along x in run i of a brick."""
    return BRICK * cell_of(box.bricks, brick) + wp.vec3i(0, i // BRICK, i % BRICK)


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
    def corners_of(box: Box, bricks: Bricks, x: int, y: int, z: int, along: wp.vec3i, f: wp.vec3) -> Corners:
        """Returns the eight cells from (x, y, z) to (x, y, z) + along, with the fractions f between them."""
        out = Corners()
        out.f = f
        if wp.static(in_bricks):
            # Brick and cell in the brick along each axis, of the lower and of the upper cells.
            brick_x = wp.vec2i(x >> 3, (x + along[0]) >> 3) * (box.bricks[1] * box.bricks[2])
            brick_y = wp.vec2i(y >> 3, (y + along[1]) >> 3) * box.bricks[2]
            brick_z = wp.vec2i(z >> 3, (z + along[2]) >> 3)
            cell_x = wp.vec2i((x & 7) << 6, ((x + along[0]) & 7) << 6)
            cell_y = wp.vec2i((y & 7) << 3, ((y + along[1]) & 7) << 3)
            cell_z = wp.vec2i(z & 7, (z + along[2]) & 7)
            for k in range(4):
                b = brick_x[k // 2] + brick_y[k % 2]
                c = cell_x[k // 2] + cell_y[k % 2]
                out.low[k] = (place_at(bricks.places, b + brick_z[0]) << 9) + c + cell_z[0]
                out.high[k] = (place_at(bricks.places, b + brick_z[1]) << 9) + c + cell_z[1]
        else:
            i = (x * box.n[1] + y) * box.n[2] + z
            j = i + along[0] * box.n[1] * box.n[2]
            row_step = along[1] * box.n[2]
            out.low = wp.vec4i(i, i + row_step, j, j + row_step)
            out.high = out.low + wp.vec4i(along[2], along[2], along[2], along[2])
        return out

    @wp.func
    def corners_around(box: Box, bricks: Bricks, p: wp.vec3) -> Corners:
        cell, along, f = lowest_cell(box.n, box.periodic, p)
        return corners_of(box, bricks, cell[0], cell[1], cell[2], along, f)

    @wp.func
    def interpolate(field: wp.array1d[stored], at: Corners) -> float:
        a = between(value_at(field, at.low[0]), value_at(field, at.high[0]), at.f[2])
        b = between(value_at(field, at.low[1]), value_at(field, at.high[1]), at.f[2])
        c = between(value_at(field, at.low[2]), value_at(field, at.high[2]), at.f[2])
        d = between(value_at(field, at.low[3]), value_at(field, at.high[3]), at.f[2])
        return between(between(a, b, at.f[1]), between(c, d, at.f[1]), at.f[0])

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
    def extremes(field: wp.array1d[stored], at: Corners):
        """Returns the least and the largest of the eight stored values around a point."""
        a = wp.vec4()
        b = wp.vec4()
        for k in range(4):
            a[k] = value_at(field, at.low[k])
            b[k] = value_at(field, at.high[k])
        return wp.min(wp.min(a, b)), wp.max(wp.max(a, b))

    @wp.func
    def corrected(
        field: wp.array1d[stored], predicted: wp.array1d[stored], i: int, to: Corners, low: float, high: float
    ) -> float:
        value = value_at(predicted, i)
        better = value + 0.5 * (value_at(field, i) - interpolate(predicted, to))
        return wp.where(better > high, value, wp.max(better, low))

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
            at = corners_around(box, bricks, p)
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
                    to = corners_around(box, bricks, q)
                    low, high = extremes(fields.density, at)
                    smoke = corrected(fields.density, predicted.density, i, to, low, high)
                    if wp.static(hot):
                        low, high = extremes(fields.temperature, at)
                        heat = corrected(fields.temperature, predicted.temperature, i, to, low, high)
            elif not left:
                if wp.static(solids):
                    if beside:
                        smoke = interpolate_beside(fields.density, walls, box, bricks, p)
                        if wp.static(hot):
                            heat = interpolate_beside(fields.temperature, walls, box, bricks, p)
                if not beside:
                    smoke = interpolate(fields.density, at)
                    if wp.static(hot):
                        heat = interpolate(fields.temperature, at)
        return smoke, heat

    @wp.func
    def between_cells(box: Box, bricks: Bricks, end: wp.vec3):
        """Returns the eight cells around a point, relative to the centre of cell (0, 0, 0), and whether all exist."""
        x = int(wp.floor(end[0]))
        y = int(wp.floor(end[1]))
        z = int(wp.floor(end[2]))
        f = end - wp.vec3(float(x), float(y), float(z))
        inside = is_below(x, box.n[0] - 1) and is_below(y, box.n[1] - 1) and is_below(z, box.n[2] - 1)
        if wp.static(in_bricks) and not inside:
            # Cells that do not exist have no brick.
            return Corners(), False
        return corners_of(box, bricks, x, y, z, wp.vec3i(1, 1, 1), f), inside

    @wp.func
    def line_along_x(traces: wp.array1d[wp.vec3], at: Stencil):
        """Returns the trace at the fractions 0, y and z between eight coarse cells, and its slope along x."""
        near = wp.vec3()
        far = wp.vec3()
        for k in range(2):
            i = at.base + k * at.step[0]
            a = vector_at(traces, i)
            a += at.f[2] * (vector_at(traces, i + at.step[2]) - a)
            b = vector_at(traces, i + at.step[1])
            b += at.f[2] * (vector_at(traces, i + at.step[1] + at.step[2]) - b)
            near = wp.vec3(far)
            far = a + at.f[1] * (b - a)
        return near, far - near

    @wp.func
    def patch_of(box: Box, i: int) -> int:
        """Returns the coarse cell, -1 or above, between whose centre and the next the centre of a fine cell is."""
        return (2 * i + 1 + box.refinement) // (2 * box.refinement) - 1

    @wp.func
    def run_of_tile(box: Box, begin: int, end: int, i: int) -> wp.vec3i:
        tile = cell_of(
            wp.vec3i(1, (box.n[1] + _TILE - 1) // _TILE, (box.n[2] + _TILE - 1) // _TILE), i // (_TILE * _TILE)
        )
        thread = i % (_TILE * _TILE)
        x = tile[0]
        if end - begin < box.n[0]:
            # A slab's tiles from its ends inwards: what they read of another device comes while others are computed.
            x = wp.where(x % 2 == 0, x // 2, (end - begin - 1) // _RUN - x // 2)
        return wp.vec3i(begin + x * _RUN, tile[1] * _TILE + thread // _TILE, tile[2] * _TILE + thread % _TILE)

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
        corners = Stencil()
        corners.f = wp.vec3(0.0, fy, fz)
        while x < end:
            low_x, along_x = pair(patch, box.coarse[0], box.periodic[0])
            corners.base = (low_x * box.coarse[1] + low_y) * box.coarse[2] + low_z
            corners.step = wp.vec3i(along_x * box.coarse[1] * box.coarse[2], along_y * box.coarse[2], along_z)
            near, slope = line_along_x(traces, corners)
            if wp.static(correcting):
                corners.base += box.coarse[0] * box.coarse[1] * box.coarse[2]
                near_ahead, slope_ahead = line_along_x(traces, corners)
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
                away = slope * fx + near
                at, simple = between_cells(box, bricks, cell + away)
                if wp.static(solids):
                    simple = simple and wall == FREE and is_short(box, away)
                smoke = float(0.0)
                heat = float(0.0)
                if simple:
                    if wp.static(correcting):
                        smoke = value_at(predicted.density, i)
                        low, high = extremes(fields.density, at)
                        varies = low < high
                        if wp.static(hot):
                            heat = value_at(predicted.temperature, i)
                            coldest, hottest = extremes(fields.temperature, at)
                            varies = varies or coldest < hottest
                        # Nothing is corrected between equal values.
                        if varies:
                            away = slope_ahead * fx + near_ahead
                            to, simple = between_cells(box, bricks, cell + away)
                            if wp.static(solids):
                                simple = simple and is_short(box, away)
                            if simple:
                                smoke = corrected(fields.density, predicted.density, i, to, low, high)
                                if wp.static(hot):
                                    heat = corrected(fields.temperature, predicted.temperature, i, to, coldest, hottest)
                    else:
                        smoke = interpolate(fields.density, at)
                        if wp.static(hot):
                            heat = interpolate(fields.temperature, at)
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

    @wp.func
    def is_needed(box: Box, bricks: Bricks, first: wp.vec3i, last: int) -> bool:
        """Tests whether smoke may reach the cells from `first` to below `last` along x."""
        needed = bool(bricks.places.shape[0] == 0)
        for x in range(first[0] // BRICK, (last - 1) // BRICK + 1):
            if not needed:
                b = index_of(box.bricks, wp.vec3i(x, first[1] // BRICK, first[2] // BRICK))
                needed = place_at(bricks.places, b) != 0
        return needed

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
                first = run_of_brick(box, bricks.listed[k], i % _BRICK_RUNS)
                if first[0] < box.n[0] and first[1] < box.n[1] and first[2] < box.n[2]:
                    most = carry_run(box, first, end, traces, walls, fields, predicted, decay, bricks, out)
                    if most > bricks.threshold:
                        bricks.busy[bricks.listed[k]] = 1
        else:
            first = run_of_tile(box, begin, end, i)
            if first[1] < box.n[1] and first[2] < box.n[2]:
                last = wp.min(first[0] + _RUN, end)
                if is_needed(box, bricks, first, last):
                    carry_run(box, first, end, traces, walls, fields, predicted, decay, bricks, out)
                else:
                    for x in range(first[0], last):
                        write(index_of(box.n, wp.vec3i(x, first[1], first[2])), 0.0, 0.0, decay, out)

    return carry


@functools.cache
def mark_kernel(stored: type) -> wp.Kernel:
    """Builds (once) a kernel that marks bricks in which smoke of the type `stored` is not 0; a thread reads 8 cells."""
    fields_type = fields_struct(stored)

    @wp.func_native("return fabsf((float)field.data[i]);")
    def size_at(field: wp.array1d[stored], i: int) -> float: ...

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def mark(
        # in:
        box: Box,
        fields: fields_type,
        begin: int,
        # out:
        bricks: Bricks,
    ):
        b = begin + wp.tid() // _BRICK_RUNS
        first = run_of_brick(box, b, wp.tid() % _BRICK_RUNS)
        if first[1] < box.n[1] and first[2] < box.n[2]:
            total = float(0.0)
            for k in range(BRICK):
                # Beyond the domain, its last cell is read again.
                i = index_of(box.n, wp.vec3i(wp.min(first[0] + k, box.n[0] - 1), first[1], first[2]))
                total += size_at(fields.density, i)
                if fields.temperature.shape[0] > 0:
                    total += size_at(fields.temperature, i)
            # Also true for NaN.
            if not (total == 0.0):
                bricks.busy[b] = 1

    return mark


def mark_smoke(box: Box, fields: Fields, bricks: Bricks, slab: Slab | None = None) -> None:
    """Marks as busy the bricks of smoke without a pool in which a density or temperature is not 0, for
    `advection_places.choose`. `slab` are the coarse cells in which smoke is looked for; default all."""
    slab, plane = slab or Slab(fields.density.device, 0, box.coarse[0]), box.bricks[1] * box.bricks[2]
    begin, end = slab.begin * box.refinement // BRICK, -(-slab.end * box.refinement // BRICK)
    kernel, threads = mark_kernel(fields.density.dtype), (end - begin) * plane * int(_BRICK_RUNS)
    wp.launch(kernel, threads, inputs=[box, fields.arrays, begin * plane], outputs=[bricks], device=slab.device)


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
        traces: The ways of the smoke, from `advection_places.trace`; back and ahead with `predicted`.
        walls: uint8 [coarse cells] from `advection_places.mark_walls`, or [0] without solids.
        fields: The smoke before the step.
        out: The smoke after the step, in other arrays of the same shapes and types.
        decay: Factors by which density and temperature are multiplied, at most 1; (1, 1) in the first half of a
            MacCormack step.
        bricks: The bricks to compute, stored by `advection_sources.store`, or chosen by `advection_places.choose`; in
            the latter case, smoke elsewhere becomes 0. Default all cells.
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
