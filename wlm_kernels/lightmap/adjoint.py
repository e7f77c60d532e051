"""Hand-written adjoints of sampling feature maps: each adds a sample's gradient to the texels that were read.

On CUDA gradients are added as 64-bit integers: integer sums do not depend on the order of addition, so that one seed
gives one result. On the CPU each lane (a range of samples, run by one thread) has its own float buffers.

Read first: `train_features` in `tests/reference/temporal.py`, whose autograd gradients these functions reproduce.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.interpolate import axis_index, cell, fraction
from wlm_kernels.lightmap.features import Cell, Maps, corner_weights, corners_at, four_at, uv_place
from wlm_kernels.native import native_source


@wp.func_native(native_source(__package__, "add_fours"))
def _add_fours(acc: wp.array2d[wp.int64], row: int, first: int, second: int, a: float, b: float, g: wp.vec4):
    """Adds a * g to the sums with the indices `first` to `first` + 3, and b * g to those from `second` on; nothing if
    `first` < 0. All lanes of a warp must call it together; `row` is each lane's address in shared memory."""


@wp.func
def _joined(parts: wp.vec4, in_x: float, in_y: float) -> wp.vec4:
    """Returns the sums for the blocks of four corners, along x first, of parts for the corners. `in_x` and `in_y` are 1
    where corners along an axis have one block, the first one's, else 0."""
    return wp.vec4(
        parts[0] + in_x * parts[1] + in_y * parts[2] + in_x * in_y * parts[3],
        parts[1] + in_y * parts[3],
        parts[2] + in_x * parts[3],
        parts[3],
    )


@functools.cache
def _adders(device_kind: str) -> tuple[Any, ...]:
    """Returns a function that adds a number, the type of the sums, and a function like `_add_fours`."""
    if device_kind == "cuda":
        # Fixed point with steps of 2^-40, about 1e-12; a sum beyond 8e6 would overflow.

        @wp.func
        def add(acc: wp.array2d[wp.int64], lane: int, i: int, value: float):
            wp.atomic_add(acc, 0, i, wp.int64(value * 1099511627776.0))

        return add, wp.int64, _add_fours

    @wp.func
    def add(acc: wp.array2d[float], lane: int, i: int, value: float):
        acc[lane, i] += value

    @wp.func
    def add_fours(acc: wp.array2d[float], lane: int, first: int, second: int, a: float, b: float, g: wp.vec4):
        if first >= 0:
            for c in range(4):
                add(acc, lane, first + c, a * g[c])
                add(acc, lane, second + c, b * g[c])

    return add, float, add_fours


@functools.cache
def scatters(device_kind: str) -> tuple[Any, Any, Any, Any]:
    """Builds (once) for "cpu" or "cuda" the functions that add a sample's gradients to the gradient sums of the feature
    maps. Returns a `wp.func` for F_uv, one for F_uvt, one for the planes F_ut and F_vt, and the type of the sums. Their
    `lane` is the number of the sums on the CPU, on CUDA a thread's row of shared memory from `matrix_step`."""
    add, scalar, add_fours = _adders(device_kind)

    @wp.func
    def scatter_texel(acc: wp.array2d[scalar], lane: int, maps: Maps, n: int, flat: int, g: wp.vec4):
        place = uv_place(maps, n, flat)
        w = maps.values[place.weight]
        along = four_at(maps.values, place.endpoints + 4) - four_at(maps.values, place.endpoints)
        add(acc, lane, place.weight, wp.dot(along, g))
        add_fours(acc, lane, place.endpoints, place.endpoints + 4, 1.0 - w, w, g)

    @wp.func
    def scatter_volume(acc: wp.array2d[scalar], lane: int, maps: Maps, n: int, cell: Cell, g: wp.vec4):
        # The four corners of a slice lie in one to four blocks: endpoints get one sum per block, not per corner.
        in_x = wp.where(cell.in_x, 1.0, 0.0)
        in_y = wp.where(cell.in_y, 1.0, 0.0)
        two = int(2)  # rolled, as in volume_at
        for k in range(two):
            s = n * maps.slices + wp.where(k == 0, cell.t[0], cell.t[1])
            corners = corners_at(maps, s, cell)
            weights = corner_weights(cell, k)
            for q in range(4):
                add(acc, lane, corners.weights[q], weights[q] * wp.dot(corners.high[q] - corners.low[q], g))
            first = _joined(wp.cw_mul(weights, wp.vec4(1.0) - corners.w), in_x, in_y)
            second = _joined(wp.cw_mul(weights, corners.w), in_x, in_y)
            at = corners.endpoints
            if cell.in_x:
                at[1] = -1
                at[3] = -1
            if cell.in_y:
                at[2] = -1
                at[3] = -1
            for q in range(4):
                add_fours(acc, lane, at[q], at[q] + 4, first[q], second[q], g)

    if device_kind == "cuda":

        @wp.func
        def scatter_plane(
            acc: wp.array2d[scalar],
            lane: int,
            maps: Maps,
            offset: int,
            n: int,
            p: float,
            tau: float,
            periodic: int,
            g: wp.vec2,
        ):
            # Two neighbours of a row; beyond its last or before its first cell, the other one gets 0.
            x = cell(p, maps.columns)
            t = cell(tau, maps.rows)
            place = wp.clamp(x, 0, wp.max(maps.columns - 2, 0))
            fx = wp.clamp(p * float(maps.columns) - 0.5 - float(place), 0.0, wp.min(float(maps.columns) - 1.0, 1.0))
            ft = fraction(tau, maps.rows)
            early = offset + 2 * (maps.columns * (n * maps.rows + axis_index(t, maps.rows, periodic)) + place)
            late = offset + 2 * (maps.columns * (n * maps.rows + axis_index(t + 1, maps.rows, periodic)) + place)
            v = wp.vec4((1.0 - fx) * g[0], (1.0 - fx) * g[1], fx * g[0], fx * g[1])
            add_fours(acc, lane, early, late, 1.0 - ft, ft, v)

    else:

        @wp.func
        def scatter_plane(
            acc: wp.array2d[scalar],
            lane: int,
            maps: Maps,
            offset: int,
            n: int,
            p: float,
            tau: float,
            periodic: int,
            g: wp.vec2,
        ):
            x = cell(p, maps.columns)
            t = cell(tau, maps.rows)
            fx = fraction(p, maps.columns)
            ft = fraction(tau, maps.rows)
            two = int(2)
            for k in range(two):
                row = n * maps.rows + axis_index(t + k, maps.rows, periodic)
                ct = wp.where(k == 0, 1.0 - ft, ft)
                for i in range(two):
                    c = ct * wp.where(i == 0, 1.0 - fx, fx)
                    at = offset + 2 * (row * maps.columns + axis_index(x + i, maps.columns, 0))
                    add(acc, lane, at, c * g[0])
                    add(acc, lane, at + 1, c * g[1])

    return scatter_texel, scatter_volume, scatter_plane, scalar
