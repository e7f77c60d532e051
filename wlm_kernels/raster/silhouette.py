"""Places where silhouettes cross between the centres of neighbouring pixels, and their gradients.

Two neighbouring pixels, side by side or one above the other, show different triangles. The nearer one covers its
pixel's centre P and not the other's, Q, so one of its edges (u, v) crosses the line between the two: with n = u x v,
corners and centres as homogeneous points (x, y, w), the crossing is at the fraction s = n.P / (n.P - n.Q) of the way,
and on the edge itself where it lies between the two corners and has w > 0. Nothing is divided by w, so that corners
behind the viewer need no clipping.

The edge is part of the silhouette unless another triangle with the same edge, of the same two vertices, continues on
the other side of it on the screen. In that triangle the way goes on, to the edge by which the line leaves it, until it
meets the silhouette or the other pixel's centre: near the silhouette of a round surface triangles are thinner than a
pixel.

An edge counts only between pixels side by side if it runs more down than across on the screen, and else only between
pixels one above the other: its crossings then cover one row or column each, and the area that a moving edge sweeps is
counted once.

Read `benchmarks/plain.py` first (`antialias`), which intersects lines on the screen. The idea is that of Laine et al.
2020, "Modular Primitives for High-Performance Differentiable Rendering", section 3.5, which ends at the first
triangle.
"""

import warp as wp

from wlm_kernels.raster.edges import Frame, centre, frame, has_corners

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
# That a way from one pixel to the next may cross; far more than of any mesh that a picture resolves.
_MOST_TRIANGLES = wp.constant(32)


@wp.func
def _corner(clip: wp.array3d[float], image: int, vertex: int) -> wp.vec3d:
    return wp.vec3d(
        wp.float64(clip[image, vertex, 0]), wp.float64(clip[image, vertex, 1]), wp.float64(clip[image, vertex, 3])
    )


@wp.func
def _beyond(
    clip: wp.array3d[float],
    triangle: wp.array2d[int],
    sides: wp.array1d[int],
    group: wp.array2d[int],
    image: int,
    edge: int,
    n: wp.vec3d,
) -> int:
    """Returns the same edge of a triangle that lies on the other side of it; -1 if there is none."""
    own = wp.dot(n, _corner(clip, image, triangle[edge // 3, edge % 3]))
    i = triangle[edge // 3, (edge % 3 + 1) % 3]
    j = triangle[edge // 3, (edge % 3 + 2) % 3]
    for place in range(group[edge, 0], group[edge, 1]):
        other = sides[place]
        if other != edge and has_corners(triangle, other // 3, clip.shape[1]):
            vertex = triangle[other // 3, other % 3]
            # A third corner that is an end of the edge lies on neither side, but rounding may put it on one.
            if vertex != i and vertex != j and wp.dot(n, _corner(clip, image, vertex)) * own < _ZERO:
                return other
    return -1


@wp.func
def _on_edge(u: wp.vec3d, v: wp.vec3d, p: wp.vec3d, axis: int) -> bool:
    """Returns whether the line through P, along a row (axis 0) or a column (axis 1), meets the edge before the
    viewer."""
    a = u[1 - axis] * p[2] - p[1 - axis] * u[2]
    b = v[1 - axis] * p[2] - p[1 - axis] * v[2]
    if a * b > _ZERO or a == b:
        return False
    # The point is (1 - t) u + t v, with t = a / (a - b).
    return (u[2] * b - v[2] * a) / (b - a) > _ZERO


@wp.kernel
def _find(
    # in:
    clip: wp.array3d[float],
    triangle: wp.array2d[int],
    sides: wp.array1d[int],
    group: wp.array2d[int],
    frame: Frame,
    visible: wp.array3d[int],
    depth: wp.array3d[float],
    # out:
    offset: wp.array4d[float],
    edge: wp.array4d[int],
):
    image, row, column, axis = wp.tid()
    offset[image, row, column, axis] = 0.0
    edge[image, row, column, axis] = -1
    other_row = row + axis
    other_column = column + 1 - axis
    if other_row == frame.height or other_column == frame.width:
        return
    t = int(visible[image, row, column])
    other = visible[image, other_row, other_column]
    if t == other:
        return
    if t < 0 or (other >= 0 and depth[image, other_row, other_column] < depth[image, row, column]):
        t = other
    if t >= triangle.shape[0] or not has_corners(triangle, t, clip.shape[1]):
        return
    p = centre(frame, row, column)
    q = centre(frame, other_row, other_column)
    # From the nearer triangle's pixel to the other one.
    onwards = wp.where(t == other, -_ONE, _ONE)
    entered = int(-1)
    for _step in range(_MOST_TRIANGLES):
        left = int(-1)
        for k in range(3):
            edge_k = 3 * t + k
            if left < 0 and edge_k != entered:
                u = _corner(clip, image, triangle[t, (k + 1) % 3])
                v = _corner(clip, image, triangle[t, (k + 2) % 3])
                n = wp.cross(u, v)
                inside = wp.dot(n, _corner(clip, image, triangle[t, k]))
                if onwards * wp.dot(n, q - p) * inside < _ZERO and _on_edge(u, v, p, axis):
                    left = edge_k
        if left < 0:
            return
        u = _corner(clip, image, triangle[t, (left + 1) % 3])
        v = _corner(clip, image, triangle[t, (left + 2) % 3])
        n = wp.cross(u, v)
        at_p = wp.dot(n, p)
        at_q = wp.dot(n, q)
        if at_p * at_q > _ZERO:
            return
        entered = _beyond(clip, triangle, sides, group, image, left, n)
        if entered < 0:
            across = wp.abs(n[0]) * wp.float64(frame.height)
            down = wp.abs(n[1]) * wp.float64(frame.width)
            if (axis == 0) == (across >= down):
                offset[image, row, column, axis] = float(at_p / (at_p - at_q) - _HALF)
                edge[image, row, column, axis] = left
            return
        t = entered // 3


@wp.kernel
def _find_backward(
    # in:
    clip: wp.array3d[float],
    triangle: wp.array2d[int],
    frame: Frame,
    edge: wp.array4d[int],
    grad_offset: wp.array4d[float],
    # out:
    grad_clip: wp.array3d[float],
):
    image, row, column, axis = wp.tid()
    slot = edge[image, row, column, axis]
    if slot < 0:
        return
    i = triangle[slot // 3, (slot + 1) % 3]
    j = triangle[slot // 3, (slot + 2) % 3]
    u = _corner(clip, image, i)
    v = _corner(clip, image, j)
    p = centre(frame, row, column)
    q = centre(frame, row + axis, column + 1 - axis)
    n = wp.cross(u, v)
    at_p = wp.dot(n, p)
    at_q = wp.dot(n, q)
    on_n = (at_p * q - at_q * p) * (wp.float64(grad_offset[image, row, column, axis]) / ((at_p - at_q) * (at_p - at_q)))
    on_u = wp.cross(v, on_n)
    on_v = wp.cross(on_n, u)
    for c in range(3):
        # z has no gradient.
        wp.atomic_add(grad_clip, image, i, c + c // 2, float(on_u[c]))
        wp.atomic_add(grad_clip, image, j, c + c // 2, float(on_v[c]))


def find(clip, triangle, sides, group, visible, depth, offset, edge) -> None:
    """Finds the crossings of silhouettes between neighbouring pixels of B images.

    Args:
        clip: float [B, V, 4], the vertices of each image in clip space.
        triangle: int [F, 3], the vertices of each triangle.
        sides: int [3 F]: the edges, in groups of the same two vertices; edge 3 t + k is opposite corner k of triangle
            t.
        group: int [3 F, 2], for each edge, the first place in `sides` of its group, and the place behind the last.
        visible: int [B, H, W], the visible triangle of each pixel, -1 for none.
        depth: float [B, H, W], its z / w.
        offset: float [B, H, W, 2], written: where a silhouette crosses the line from the centre of a pixel to that of
            the next one to the right, and below: -1/2 at its own centre, 1/2 at the other; 0 where none does.
        edge: int [B, H, W, 2], written: the edge that crosses there; -1 for none.
    """
    inputs = [clip, triangle, sides, group, frame(*visible.shape[1:], "clip"), visible, depth]
    wp.launch(_find, offset.shape, inputs=inputs, outputs=[offset, edge], device=clip.device)


def find_backward(clip, triangle, edge, grad_offset, grad_clip) -> None:
    """Adds the gradient of the vertices, float [B, V, 4], z without any, from that of the offsets that `find` returns,
    float [B, H, W, 2]. On CUDA crossings are added in any order, so that the last bits change from run to run."""
    inputs = [clip, triangle, frame(*edge.shape[1:3], "clip"), edge, grad_offset]
    wp.launch(_find_backward, edge.shape, inputs=inputs, outputs=[grad_clip], device=clip.device)
