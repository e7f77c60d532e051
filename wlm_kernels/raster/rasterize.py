"""Rasterization in clip space or UV space: the visible triangle at each pixel centre, its barycentrics and its depth.

A pixel centre P and a corner v are homogeneous points (x, y, w). The edge function of corner i, E_i = det[P, v_j, v_k],
is linear in the pixel. P shows the part of the triangle in front of the viewer (w > 0) where all three edge functions
have the sign of det[v_0, v_1, v_2]; E_i / (E_0 + E_1 + E_2) are the barycentrics of the point seen there. Nothing is
divided by w, so a triangle that reaches behind the viewer needs no clipping; there is no near and no far plane.

Coverage is decided without rounding. Where float64 can't decide the sign of an edge function, it is computed exactly.
Where it is exactly zero, the pixel counts as moved to the right by an infinitesimal step, and down by an infinitely
smaller one: the top-left rule, for both windings. So of the triangles around a shared edge or corner exactly one covers
a pixel on it, even if they have different vertices at equal positions.

The visible triangle has the least 64-bit key, of the depth and then the triangle's number: the same in every run.

Row 0 is the top row of the image. In clip space y points up, pixel (row j, column i) of H x W has its centre at x/w =
(2 i + 1) / W - 1, y/w = 1 - (2 j + 1) / H, and the triangle with the least z/w is visible. In UV space v points down,
as in glTF, the centre is u = (i + 1/2) / W, v = (j + 1/2) / H, and the triangle with the least number is visible.

A triangle covers nothing if a corner isn't finite or doesn't exist, or if it has no area.

Edge functions are in `edges`; interpolation and gradients in `gradient`. `rasterize` of `benchmarks/plain.py`
is to be read first: it solves for the corners' weights at each pixel instead.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.raster.edges import (
    MOST_PIXELS,
    Box,
    Corners,
    Frame,
    box_of,
    corners_of,
    covers,
    edges_at,
    edges_of,
    finite,
    first_pixel,
    frame,
    has_corners,
    last_pixel,
    total_of,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

# Large triangles are cut into tiles of this side, one thread per tile of 64 pixels.
_TILE = wp.constant(8)
# A triangle with no more pixels in its box is drawn by one thread. On the CPU, where a launch is a loop, all are.
_SMALL = 64
# Threads that share the tiles, about as many as an H100 keeps resident.
_SHARERS = 65536

_EMPTY = wp.constant(wp.int64(2**63 - 1))  # a key behind all depths
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))


@wp.func
def _draw(
    k: Corners,
    t: int,
    box: Box,
    frame: Frame,
    cull: int,
    names: wp.int64,
    keys: wp.array2d[wp.int64],
    coverage: wp.array2d[int],
):
    """Draws the part of a triangle in a box of pixels: updates the pixels' depth keys and coverage counts."""
    e = edges_of(k, frame, cull)
    if e.sign == _ZERO:
        return
    # z / w is linear on the screen: the sum of E_i z_i over det scale W H.
    det = wp.abs(wp.dot(k.a, wp.cross(k.b, k.c))) * wp.float64(frame.scale) * wp.float64(frame.width)
    det = det * wp.float64(frame.height)
    z_x = wp.dot(e.x, k.z) / det
    z_y = wp.dot(e.y, k.z) / det
    z_c = wp.dot(e.c, k.z) / det
    # The sum may cancel completely for a sliver, so it is clamped to the depths of the corners.
    z_low = wp.float64(-wp.inf)
    z_high = wp.float64(wp.inf)
    if k.a[2] > _ZERO and k.b[2] > _ZERO and k.c[2] > _ZERO:
        z = wp.vec3d(k.z[0] / k.a[2], k.z[1] / k.b[2], k.z[2] / k.c[2])
        z_low = wp.min(z)
        z_high = wp.max(z)
    for row in range(box.top, box.bottom + 1):
        y = wp.float64(frame.y + frame.y_step * row)
        rest = y * e.y + e.c
        low = wp.float64(frame.x + 2 * box.left)
        high = wp.float64(frame.x + 2 * box.right)
        for i in range(3):
            if e.x[i] > _ZERO:
                low = wp.max(low, (-e.limit[i] - rest[i]) / e.x[i])
            elif e.x[i] < _ZERO:
                high = wp.min(high, (-e.limit[i] - rest[i]) / e.x[i])
            elif rest[i] < -e.limit[i]:
                high = wp.float64(-wp.inf)
        first = first_pixel((low - wp.float64(frame.x)) / _TWO, frame.width)
        last = last_pixel((high - wp.float64(frame.x)) / _TWO, frame.width)
        for column in range(first, last + 1):
            x = wp.float64(frame.x + 2 * column)
            f = x * e.x + rest
            inside = f[0] > e.limit[0] and f[1] > e.limit[1] and f[2] > e.limit[2]
            if not inside:
                if f[0] >= -e.limit[0] and f[1] >= -e.limit[1] and f[2] >= -e.limit[2]:
                    inside = covers(e, k, frame, row, column)
            if inside:
                depth = x * z_x + (y * z_y + z_c)
                if not depth > z_low:
                    depth = z_low
                if depth > z_high:
                    depth = z_high
                # The depth becomes an integer of the same order; adding 0 turns -0 into 0.
                bits = wp.cast(depth + _ZERO, wp.int64)
                if bits < wp.int64(0):
                    bits = bits ^ _EMPTY
                key = (bits & ~names) | wp.int64(t)
                if key < keys[row, column]:
                    wp.atomic_min(keys, row, column, key)
                if coverage.shape[0] > 0:
                    wp.atomic_add(coverage, row, column, 1)


@wp.kernel
def _draw_small(
    # in:
    position: wp.array2d[float],
    triangle: wp.array2d[int],
    frame: Frame,
    cull: int,
    names: wp.int64,
    small: int,
    unit: wp.int64,
    # out:
    keys: wp.array2d[wp.int64],
    coverage: wp.array2d[int],
    queued: wp.array1d[wp.int64],
    queue: wp.array1d[int],
    starts: wp.array1d[wp.int64],
):
    """Draws one small triangle per thread; puts a larger one into a queue, cut into tiles of pixels for `_draw_tiles`.

    `queued` counts triangles and tiles in one number, triangles * unit + tiles. One atomic addition changes the two, so
    that `starts`, the number of each queued triangle's first tile, is ascending.
    """
    t = wp.tid()
    if not has_corners(triangle, t, position.shape[0]):
        return
    k = corners_of(position, triangle, t)
    if finite(k):
        box = box_of(k, frame)
        across = box.right - box.left + 1
        down = box.bottom - box.top + 1
        if across > 0 and down > 0:
            if across * down <= small:
                _draw(k, t, box, frame, cull, names, keys, coverage)
            else:
                tiles = wp.int64((across + _TILE - 1) // _TILE) * wp.int64((down + _TILE - 1) // _TILE)
                before = wp.atomic_add(queued, 0, unit + tiles)
                place = int(before / unit)
                queue[place] = t
                starts[place] = before % unit


@wp.kernel
def _draw_tiles(
    # in:
    position: wp.array2d[float],
    triangle: wp.array2d[int],
    frame: Frame,
    cull: int,
    names: wp.int64,
    unit: wp.int64,
    sharers: int,
    queued: wp.array1d[wp.int64],
    queue: wp.array1d[int],
    starts: wp.array1d[wp.int64],
    # out:
    keys: wp.array2d[wp.int64],
    coverage: wp.array2d[int],
):
    """Draws the tiles of queued triangles: thread i draws the tiles i, i + sharers, i + 2 sharers and so on."""
    item = wp.int64(wp.tid())
    count = int(queued[0] / unit)
    items = queued[0] % unit
    while item < items:
        low = int(0)
        high = int(count)
        while high - low > 1:
            middle = (low + high) // 2
            if starts[middle] <= item:
                low = middle
            else:
                high = middle
        t = queue[low]
        k = corners_of(position, triangle, t)
        box = box_of(k, frame)
        tile = int(item - starts[low])
        across = (box.right - box.left + _TILE) // _TILE
        box.left = box.left + (tile % across) * _TILE
        box.top = box.top + (tile // across) * _TILE
        box.right = wp.min(box.right, box.left + _TILE - 1)
        box.bottom = wp.min(box.bottom, box.top + _TILE - 1)
        _draw(k, t, box, frame, cull, names, keys, coverage)
        item += wp.int64(sharers)


@wp.kernel
def _resolve(
    # in:
    position: wp.array2d[float],
    triangle: wp.array2d[int],
    frame: Frame,
    names: wp.int64,
    keys: wp.array2d[wp.int64],
    # out:
    visible: wp.array2d[int],
    barycentric: wp.array2d[wp.vec2],
    depth: wp.array2d[float],
    derivative: wp.array2d[wp.vec4],
):
    """Computes the results of one pixel per thread from its depth key."""
    row, column = wp.tid()
    key = keys[row, column]
    if key == _EMPTY:
        visible[row, column] = -1
        barycentric[row, column] = wp.vec2()
        depth[row, column] = 0.0
        if derivative.shape[0] > 0:
            derivative[row, column] = wp.vec4()
        return
    t = int(key & names)
    k = corners_of(position, triangle, t)
    f, f_x, f_y = edges_at(k, frame, row, column)
    total = total_of(f)
    # Where all edge functions underflow, any point of the triangle is as right.
    u = _ONE / wp.float64(3.0)
    v = u
    scale = _ZERO
    if total > _ZERO:
        scale = _ONE / total
        u = f[0] * scale
        v = f[1] * scale
    share = wp.vec3d(u, v, _ONE - u - v)
    visible[row, column] = t
    barycentric[row, column] = wp.vec2(float(u), float(v))
    depth[row, column] = float(wp.dot(share, k.z) / wp.dot(share, wp.vec3d(k.a[2], k.b[2], k.c[2])))
    if derivative.shape[0] > 0:
        step_x = _TWO * scale
        step_y = wp.float64(frame.y_step) * scale
        derivative[row, column] = wp.vec4(
            float(step_x * (f_x[0] - u * total_of(f_x))),
            float(step_y * (f_y[0] - u * total_of(f_y))),
            float(step_x * (f_x[1] - v * total_of(f_x))),
            float(step_y * (f_y[1] - v * total_of(f_y))),
        )


@dataclass(frozen=True)
class Raster:
    """The visible surface point of each pixel.

    Attributes:
        triangle: int [H, W], number of the visible triangle; -1 if there is none.
        barycentric: vec2 [H, W], weights of its corners 0 and 1, perspective-correct, in [0, 1]; corner 2 has 1 minus
            their sum. 0 where there is no triangle, like the attributes below.
        depth: float [H, W], z / w.
        derivative: vec4 [H, W], derivatives of the weights (u, v) per pixel: du/dx, du/dy, dv/dx, dv/dy, with x to the
            right and y down; None if they are not computed.
        coverage: int [H, W], number of triangles, also hidden ones, over the pixel's centre; None if not computed.
    """

    triangle: Any
    barycentric: Any
    depth: Any
    derivative: Any | None
    coverage: Any | None


class Rasterizer:
    """Draws the same triangles many times. Buffers are allocated once: `run` may be captured in a CUDA graph.

    Besides the result it allocates 8 bytes per pixel and 12 bytes per triangle.

    Args:
        triangle: int [F, 3], the vertices of each triangle.
        height, width: Size of the image, 1 to `MOST_PIXELS` pixels.
        space: Space of the positions, "clip" or "uv"; see the module.
        cull: Whether to leave out clockwise triangles: as seen on the screen in clip space, and with v up in UV space.
        derivative, coverage: Whether to compute these attributes of `Raster`.
        split: Most pixels in the bounding box of a triangle that one thread draws; None: 64 on CUDA, any on the CPU.
        empty: Function that allocates a buffer, `empty(shape, dtype=...)`, on the triangles' device; None: Warp's.

    Attributes:
        raster: `Raster`, the output of `run`.
    """

    def __init__(
        self,
        triangle,
        height: int,
        width: int,
        *,
        space: str = "clip",
        cull: bool = False,
        derivative: bool = False,
        coverage: bool = False,
        split: int | None = None,
        empty: Callable[..., Any] | None = None,
    ) -> None:
        device, count = triangle.device, triangle.shape[0]
        empty = empty or (lambda shape, dtype: wp.empty(shape, dtype=dtype, device=device))
        self._triangle = triangle
        self._frame = frame(height, width, space)
        self._cull = int(cull)
        self._split = split if split is not None else MOST_PIXELS**2 if device.is_cpu else _SMALL
        self._sharers = 1 if device.is_cpu else _SHARERS
        bits = max(1, (count - 1).bit_length())
        self._names = (1 << bits) - 1
        self._unit = 1 << (62 - bits)
        if max(1, count) * math.ceil(height / _TILE) * math.ceil(width / _TILE) >= self._unit:
            raise ValueError(f"triangle: {count} triangles are too many for {height} x {width} pixels; draw fewer")
        size = (height, width)
        none = empty((0, 0), dtype=int)
        self._keys = empty(size, dtype=wp.int64)
        self._queued = empty((1,), dtype=wp.int64)
        self._queue = empty((count,), dtype=int)
        self._starts = empty((count,), dtype=wp.int64)
        self._slopes = empty(size if derivative else (0, 0), dtype=wp.vec4)
        self._coverage = empty(size, dtype=int) if coverage else none
        self.raster = Raster(
            empty(size, dtype=int),
            empty(size, dtype=wp.vec2),
            empty(size, dtype=float),
            self._slopes if derivative else None,
            self._coverage if coverage else None,
        )

    def run(self, position) -> Raster:
        """Draws the triangles with their V corners at float [V, 4], clip coordinates x, y, z, w, or in UV space float
        [V, 2], u and v. Returns the attribute `raster`, which the next run overwrites."""
        device, count = self._triangle.device, self._triangle.shape[0]
        self._keys.fill_(_EMPTY)
        self._queued.zero_()
        if self.raster.coverage is not None:
            self._coverage.zero_()
        shared = [position, self._triangle, self._frame]
        rule = [self._cull, self._names]
        work = [self._queued, self._queue, self._starts]
        pixels = [self._keys, self._coverage]
        inputs = [*shared, *rule, self._split, self._unit]
        wp.launch(_draw_small, count, inputs=inputs, outputs=[*pixels, *work], device=device)
        inputs = [*shared, *rule, self._unit, self._sharers, *work]
        wp.launch(_draw_tiles, self._sharers, inputs=inputs, outputs=pixels, device=device)
        r = self.raster
        outputs = [r.triangle, r.barycentric, r.depth, self._slopes]
        wp.launch(_resolve, self._keys.shape, inputs=[*shared, self._names, self._keys], outputs=outputs, device=device)
        return r
