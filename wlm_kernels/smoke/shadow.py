"""Shadows of obstacles on the surface of smoke, by a shadow map (neural-six-way-lightmaps, section 4.5).

The map is square and is rendered from the light; it covers the obstacles and two texels on each side, so that its
border is empty. No data is read back to the host, so that a CUDA graph can capture everything. Lengths are in the
world's unit; positions are relative to the first corner of the first triangle, so that float32 also suffices for a
scene far from the world's origin.
"""

from collections.abc import Sequence

import warp as wp

from wlm_kernels.smoke.march import Empty, View, ray

wp.set_module_options({"enable_backward": False})

RESOLUTION = 512
"""Texels along an edge of a shadow map."""

_BORDER = wp.constant(4.0)  # texels of the empty border, sum of both sides
_LINES = wp.constant(32)  # threads per triangle, each of which draws every 32nd row
_CORNERS = wp.constant(64)  # corners per thread of `_bound`
_FAR = wp.constant(3.0e38)
_SMALLEST = wp.constant(1.0e-9)


@wp.struct
class _Map:
    """The square that a shadow map covers, in the light's axes: its centre, half its edge, and the edge of a texel."""

    middle: wp.vec3
    half: float
    texel: float


@wp.func
def _from_first(points: wp.array(dtype=wp.vec3), triangles: wp.array2d(dtype=wp.int32), p: wp.vec3) -> wp.vec3:
    return p - points[triangles[0, 0]]


@wp.func
def _place(bounds: wp.array(dtype=float), resolution: float) -> _Map:
    low = wp.vec3(bounds[0], bounds[1], bounds[2])
    high = wp.vec3(bounds[3], bounds[4], bounds[5])
    m = _Map()
    m.middle = 0.5 * (low + high)
    widest = wp.max(high[0] - low[0], high[1] - low[1])
    m.half = wp.max(0.5 * widest * resolution / (resolution - _BORDER), _SMALLEST)
    m.texel = 2.0 * m.half / resolution
    return m


@wp.func
def _on_map(m: _Map, resolution: float, p: wp.vec3) -> wp.vec3:
    """Converts a point in the light's axes to the map's column, row (integers at texel centres) and height."""
    column = (p[0] - m.middle[0]) / m.texel + 0.5 * resolution - 0.5
    row = (m.middle[1] - p[1]) / m.texel + 0.5 * resolution - 0.5
    return wp.vec3(column, row, p[2])


@wp.kernel
def _clear(
    # out:
    heights: wp.array2d(dtype=float),
    bounds: wp.array(dtype=float),
):
    row, column = wp.tid()
    heights[row, column] = -_FAR
    if row == 0 and column < 6:
        bounds[column] = wp.where(column < 3, _FAR, -_FAR)


@wp.kernel
def _bound(
    # in:
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array2d(dtype=wp.int32),
    axes: wp.mat33,
    # out:
    bounds: wp.array(dtype=float),
):
    thread = wp.tid()
    low = wp.vec3(_FAR, _FAR, _FAR)
    high = -low
    for n in range(_CORNERS):
        corner = thread * _CORNERS + n
        if corner < 3 * triangles.shape[0]:
            p = axes * _from_first(points, triangles, points[triangles[corner // 3, corner % 3]])
            low = wp.min(low, p)
            high = wp.max(high, p)
    for axis in range(3):
        wp.atomic_min(bounds, axis, low[axis])
        wp.atomic_max(bounds, 3 + axis, high[axis])


@wp.kernel
def _draw(
    # in:
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array2d(dtype=wp.int32),
    axes: wp.mat33,
    bounds: wp.array(dtype=float),
    # out:
    heights: wp.array2d(dtype=float),
):
    face, line = wp.tid()
    resolution = float(heights.shape[0])
    m = _place(bounds, resolution)
    a = _on_map(m, resolution, axes * _from_first(points, triangles, points[triangles[face, 0]]))
    b = _on_map(m, resolution, axes * _from_first(points, triangles, points[triangles[face, 1]]))
    c = _on_map(m, resolution, axes * _from_first(points, triangles, points[triangles[face, 2]]))
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area == 0.0:
        return
    # Slopes of the triangle's plane over the map; heights are clamped to those of its corners.
    across = ((b[2] - a[2]) * (c[1] - a[1]) - (c[2] - a[2]) * (b[1] - a[1])) / area
    down = ((b[0] - a[0]) * (c[2] - a[2]) - (c[0] - a[0]) * (b[2] - a[2])) / area
    lowest = wp.min(wp.min(a[2], b[2]), c[2])
    highest = wp.max(wp.max(a[2], b[2]), c[2])
    first = int(wp.ceil(wp.min(wp.min(a[1], b[1]), c[1])))
    last = int(wp.floor(wp.max(wp.max(a[1], b[1]), c[1])))
    row = first + (line - first % _LINES + _LINES) % _LINES
    while row <= last:
        y = float(row)
        begin = float(_FAR)
        end = float(-_FAR)
        for edge in range(3):
            p = wp.where(edge == 0, a, wp.where(edge == 1, b, c))
            q = wp.where(edge == 0, b, wp.where(edge == 1, c, a))
            if wp.min(p[1], q[1]) <= y and y <= wp.max(p[1], q[1]):
                if p[1] == q[1]:
                    begin = wp.min(begin, wp.min(p[0], q[0]))
                    end = wp.max(end, wp.max(p[0], q[0]))
                else:
                    x = p[0] + (y - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
                    begin = wp.min(begin, x)
                    end = wp.max(end, x)
        for column in range(int(wp.ceil(begin)), int(wp.floor(end)) + 1):
            height = a[2] + across * (float(column) - a[0]) + down * (y - a[1])
            wp.atomic_max(heights, row, column, wp.clamp(height, lowest, highest))
        row += _LINES


@wp.kernel
def _look_up(
    # in:
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array2d(dtype=wp.int32),
    axes: wp.mat33,
    bounds: wp.array(dtype=float),
    heights: wp.array2d(dtype=float),
    view: View,
    depth: wp.array2d(dtype=float),
    bias: float,
    # out:
    out: wp.array2d(dtype=float),
):
    i, j = wp.tid()
    if depth[i, j] <= 0.0:
        out[i, j] = 1.0
        return
    r = ray(view, i, j)
    size = heights.shape[0]
    m = _place(bounds, float(size))
    p = _from_first(points, triangles, r.origin) + depth[i, j] * r.direction
    at = _on_map(m, float(size), axes * p)
    offset = wp.where(bias < 0.0, 1.5 * m.texel, bias)
    # Points outside the map are lit, as the empty border is.
    column = wp.clamp(at[0], -1.0, float(size))
    row = wp.clamp(at[1], -1.0, float(size))
    hidden = float(0.0)
    for n in range(4):
        r0 = wp.floor(row) + float(n // 2)
        c0 = wp.floor(column) + float(n % 2)
        height = heights[wp.clamp(int(r0), 0, size - 1), wp.clamp(int(c0), 0, size - 1)]
        if height > at[2] + offset:
            hidden += (1.0 - wp.abs(row - r0)) * (1.0 - wp.abs(column - c0))
    out[i, j] = wp.clamp(1.0 - hidden, 0.0, 1.0)


def visibility(
    points: wp.array,
    triangles: wp.array,
    axes: Sequence[float],
    view: View,
    depth: wp.array,
    out: wp.array,
    *,
    empty: Empty,
    resolution: int = RESOLUTION,
    bias: float = -1.0,
) -> None:
    """Computes for each pixel the share of a directional light that obstacles let through to the smoke's surface.

    The shadow map is looked up only at the surface of the smoke, not inside, bilinearly between four texels.

    Args:
        points: vec3 [V], corners of the obstacles in the world.
        triangles: int32 [F, 3], indices of each triangle's corners in `points`; at least one triangle.
        axes: 9 numbers, rows of a rotation to axes of which the third points to the light.
        view: The camera in the world; its `voxel` and `moved` are not used.
        depth: float [H, W], distance along the rays to the surface; 0: no surface, which counts as lit.
        out: float [H, W], written: the share of the light, 0 to 1.
        empty: Allocates buffers.
        resolution: Texels along the map's edge, at least 8.
        bias: Distance in the world's unit by which an obstacle must be nearer to the light to shadow the surface; below
            0: 1.5 texels.
    """
    heights, bounds = empty((resolution, resolution), float), empty((6,), float)
    turn, device, faces = wp.mat33(*axes), depth.device, triangles.shape[0]
    wp.launch(_clear, heights.shape, [], [heights, bounds], device=device)
    threads = -(-3 * faces // _CORNERS)
    wp.launch(_bound, threads, [points, triangles, turn], [bounds], device=device)
    wp.launch(_draw, (faces, int(_LINES)), [points, triangles, turn, bounds], [heights], device=device)
    inputs = [points, triangles, turn, bounds, heights, view, depth, float(bias)]
    wp.launch(_look_up, depth.shape, inputs, [out], device=device)
