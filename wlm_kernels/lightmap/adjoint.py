"""Hand-written adjoints of sampling feature maps: each adds a sample's gradient to the texels that were read.

On CUDA gradients are added as 64-bit integers: integer sums do not depend on the order of addition, so that one seed
gives one result. On the CPU each lane (a range of samples, run by one thread) has its own float buffers.

Read first: `train_features` in `tests/reference/temporal.py`, whose autograd gradients these functions reproduce.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.interpolate import axis_index, cell, fraction
from wlm_kernels.lightmap.blocks import endpoint_at, ste_endpoint, ste_weight
from wlm_kernels.lightmap.features import Maps, Offsets
from wlm_kernels.native import native_source


@wp.func
def corner_weights(first: int, second: int, f: float, block: int) -> wp.vec2:
    """Returns the weights 1 - f and f of two texels along an axis; 0 for a texel outside the 4-texel block `block`."""
    a = wp.where(first // 4 == block, 1.0 - f, 0.0)
    b = wp.where(second // 4 == block, f, 0.0)
    return wp.vec2(a, b)


_Spread = wp.types.vector(8, float)

# The lanes of a warp share their additions, so that neighbours in memory are added at once: 8 lanes add the endpoints
# of one sample's block, then of another sample's. If each lane added its own sample, there would be one request to
# memory for each number, rather than one for four.


@wp.func_native(native_source(__package__, "spread_texels"))
def _spread_texels(g: wp.vec4) -> _Spread:
    """Redistributes g over a warp: component r of lane l's result is component l % 4 of g in lane 4 r + l / 8."""


@wp.func_native(native_source(__package__, "add_endpoints"))
def _add_endpoints(acc: wp.array2d[wp.int64], lane: int, at: int, a: float, b: float, g: _Spread):
    """Adds a * g to the sums with the indices `at` to `at` + 3, and b * g to the next four; nothing if `at` < 0. All
    lanes of a warp must call it together; their g comes from `_spread_texels`."""


@wp.func_native(native_source(__package__, "add_cells"))
def _add_cells(acc: wp.array2d[wp.int64], early: wp.vec2i, late: wp.vec2i, ft: float, v: wp.vec4):
    """Adds two channels of each of two texels, `v`, to the texels' sums in two rows of a plane: times 1 - ft at the
    indices `early`, times ft at `late`. All lanes of a warp must call it together."""


@wp.func
def _spread_none(g: wp.vec4) -> wp.vec4:
    return g


@functools.cache
def _adders(device_kind: str) -> tuple[Any, ...]:
    """Returns a function that adds a number, the type of the sums, a function that adds the gradient g to a block's two
    endpoints, and a function that prepares g for it."""
    if device_kind == "cuda":
        # Fixed point with steps of 2^-40, about 1e-12; a sum beyond 8e6 would overflow.

        @wp.func
        def add(acc: wp.array2d[wp.int64], lane: int, i: int, value: float):
            wp.atomic_add(acc, lane, i, wp.int64(value * 1099511627776.0))

        return add, wp.int64, _add_endpoints, _spread_texels

    @wp.func
    def add(acc: wp.array2d[float], lane: int, i: int, value: float):
        acc[lane, i] += value

    @wp.func
    def add_endpoints(acc: wp.array2d[float], lane: int, at: int, a: float, b: float, g: wp.vec4):
        if at >= 0:
            for c in range(4):
                add(acc, lane, at + c, a * g[c])
                add(acc, lane, at + 4 + c, b * g[c])

    return add, float, add_endpoints, _spread_none


@functools.cache
def scatters(device_kind: str) -> tuple[Any, Any, Any, Any]:
    """Builds (once) for "cpu" or "cuda" the functions that add a sample's gradients to the gradient sums of the feature
    maps. Returns a `wp.func` for F_uv, one for F_uvt, one for the planes F_ut and F_vt, and the type of the sums."""
    add, scalar, add_endpoints, spread = _adders(device_kind)

    @wp.func
    def scatter_texel(
        acc: wp.array2d[scalar],
        lane: int,
        offsets: Offsets,
        maps: Maps,
        n: int,
        y: int,
        x: int,
        quantised: int,
        g: wp.vec4,
    ):
        width = maps.uv_weights.shape[2]
        height = maps.uv_weights.shape[1]
        e0 = ste_endpoint(endpoint_at(maps.uv_endpoints, n, y // 4, x // 4, 0), quantised)
        e1 = ste_endpoint(endpoint_at(maps.uv_endpoints, n, y // 4, x // 4, 1), quantised)
        w = ste_weight(maps.uv_weights[n, y, x], quantised)
        add(acc, lane, offsets.uv_weights + (n * height + y) * width + x, wp.dot(e1 - e0, g))
        block = (n * (height // 4) + y // 4) * (width // 4) + x // 4
        add_endpoints(acc, lane, offsets.uv_endpoints + block * 8, 1.0 - w, w, spread(g))

    @wp.func
    def scatter_volume(
        acc: wp.array2d[scalar],
        lane: int,
        offsets: Offsets,
        maps: Maps,
        n: int,
        slices: int,
        u: float,
        v: float,
        tau: float,
        periodic: int,
        quantised: int,
        g: wp.vec4,
    ):
        height = maps.uvt_weights.shape[1]
        width = maps.uvt_weights.shape[2]
        x = cell(u, width)
        y = cell(v, height)
        t = cell(tau, slices)
        fx = fraction(u, width)
        fy = fraction(v, height)
        ft = fraction(tau, slices)
        xa = axis_index(x, width, 0)
        xb = axis_index(x + 1, width, 0)
        ya = axis_index(y, height, 0)
        yb = axis_index(y + 1, height, 0)
        parts = spread(g)
        two = int(2)  # rolled, as in volume_at
        four = int(4)
        for k in range(two):
            s = n * slices + axis_index(t + k, slices, periodic)
            ct = wp.where(k == 0, 1.0 - ft, ft)
            # The four corners of a slice lie in one to four blocks: endpoints get one sum per block, not per corner.
            for j in range(two):
                by = wp.where(j == 0, ya // 4, yb // 4)
                for i in range(two):
                    bx = wp.where(i == 0, xa // 4, xb // 4)
                    at = int(-1)
                    first = float(0.0)
                    second = float(0.0)
                    if (j == 0 or by != ya // 4) and (i == 0 or bx != xa // 4):
                        cy = corner_weights(ya, yb, fy, by) * ct
                        cx = corner_weights(xa, xb, fx, bx)
                        e0 = ste_endpoint(endpoint_at(maps.uvt_endpoints, s, by, bx, 0), quantised)
                        e1 = ste_endpoint(endpoint_at(maps.uvt_endpoints, s, by, bx, 1), quantised)
                        along = wp.dot(e1 - e0, g)
                        for q in range(four):
                            c = cy[q // 2] * cx[q % 2]
                            if c != 0.0:
                                yy = wp.where(q // 2 == 0, ya, yb)
                                xx = wp.where(q % 2 == 0, xa, xb)
                                w = ste_weight(maps.uvt_weights[s, yy, xx], quantised)
                                first += c * (1.0 - w)
                                second += c * w
                                add(acc, lane, offsets.uvt_weights + (s * height + yy) * width + xx, c * along)
                        at = offsets.uvt_endpoints + ((s * (height // 4) + by) * (width // 4) + bx) * 8
                    add_endpoints(acc, lane, at, first, second, parts)

    if device_kind == "cuda":

        @wp.func
        def scatter_plane(
            acc: wp.array2d[scalar],
            lane: int,
            offset: int,
            rows: int,
            columns: int,
            n: int,
            p: float,
            tau: float,
            periodic: int,
            g: wp.vec2,
        ):
            x = cell(p, columns)
            t = cell(tau, rows)
            fx = fraction(p, columns)
            cells = wp.vec2i(axis_index(x, columns, 0), axis_index(x + 1, columns, 0))
            at = wp.vec2i(offset) + 2 * cells
            early = wp.vec2i((n * rows + axis_index(t, rows, periodic)) * columns * 2)
            late = wp.vec2i((n * rows + axis_index(t + 1, rows, periodic)) * columns * 2)
            v = wp.vec4((1.0 - fx) * g[0], (1.0 - fx) * g[1], fx * g[0], fx * g[1])
            _add_cells(acc, at + early, at + late, fraction(tau, rows), v)

    else:

        @wp.func
        def scatter_plane(
            acc: wp.array2d[scalar],
            lane: int,
            offset: int,
            rows: int,
            columns: int,
            n: int,
            p: float,
            tau: float,
            periodic: int,
            g: wp.vec2,
        ):
            x = cell(p, columns)
            t = cell(tau, rows)
            fx = fraction(p, columns)
            ft = fraction(tau, rows)
            two = int(2)
            for k in range(two):
                tt = axis_index(t + k, rows, periodic)
                ct = wp.where(k == 0, 1.0 - ft, ft)
                for i in range(two):
                    xx = axis_index(x + i, columns, 0)
                    c = ct * wp.where(i == 0, 1.0 - fx, fx)
                    at = offset + ((n * rows + tt) * columns + xx) * 2
                    add(acc, lane, at, c * g[0])
                    add(acc, lane, at + 1, c * g[1])

    return scatter_texel, scatter_volume, scatter_plane, scalar
