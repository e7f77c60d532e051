"""Interpolates vertex attributes at each pixel's surface point, and computes gradients of attributes and positions.

`wlm_kernels.raster.rasterize` defines barycentrics. Gradients take the visible triangle of each pixel as fixed.

Read `benchmarks/plain.py` first (`corner_weights`), which computes barycentrics in torch, differentiated by autograd.
"""

import warp as wp

from wlm_kernels.raster.edges import Frame, centre, corners_of, frame, functions, has_corners, total_of

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.func
def _readable(triangle: wp.array2d[int], t: int, count: int) -> bool:
    """Returns whether triangle t exists and has corner indices from 0 to `count` - 1."""
    if t < 0 or t >= triangle.shape[0]:
        return False
    return has_corners(triangle, t, count)


@wp.kernel
def _rasterize_backward(
    # in:
    position: wp.array2d[float],
    triangle: wp.array2d[int],
    frame: Frame,
    visible: wp.array2d[int],
    grad_barycentric: wp.array2d[wp.vec2],
    # out:
    grad: wp.array2d[float],
):
    row, column = wp.tid()
    t = visible[row, column]
    if not _readable(triangle, t, position.shape[0]):
        return
    k = corners_of(position, triangle, t)
    g = wp.vec2d(grad_barycentric[row, column])
    e = functions(k, frame, _ONE)
    p = centre(frame, row, column)
    x = wp.float64(frame.x + 2 * column)
    y = wp.float64(frame.y + frame.y_step * row)
    f = x * e.x + (y * e.y + e.c)
    total = total_of(f)
    if total == _ZERO:
        return
    common = (g[0] * f[0] + g[1] * f[1]) / total
    s = wp.vec3d(g[0] - common, g[1] - common, -common) / total
    # E_0 = p . (b x c), E_1 = p . (c x a), E_2 = p . (a x b).
    grad_a = wp.cross(s[1] * k.c - s[2] * k.b, -p)
    grad_b = wp.cross(s[2] * k.a - s[0] * k.c, -p)
    grad_c = wp.cross(s[0] * k.b - s[1] * k.a, -p)
    for i in range(3):
        corner = triangle[t, i]
        grad_corner = wp.where(i == 0, grad_a, wp.where(i == 1, grad_b, grad_c))
        wp.atomic_add(grad, corner, 0, float(grad_corner[0]))
        wp.atomic_add(grad, corner, 1, float(grad_corner[1]))
        if grad.shape[1] == 4:
            wp.atomic_add(grad, corner, 3, float(grad_corner[2]))


@wp.kernel
def _interpolate(
    # in:
    attribute: wp.array2d[float],
    triangle: wp.array2d[int],
    visible: wp.array2d[int],
    barycentric: wp.array2d[wp.vec2],
    # out:
    out: wp.array3d[float],
):
    row, column = wp.tid()
    t = visible[row, column]
    if not _readable(triangle, t, attribute.shape[0]):
        for c in range(out.shape[2]):
            out[row, column, c] = 0.0
        return
    uv = barycentric[row, column]
    i = triangle[t, 0]
    j = triangle[t, 1]
    k = triangle[t, 2]
    rest = 1.0 - uv[0] - uv[1]
    for c in range(out.shape[2]):
        out[row, column, c] = uv[0] * attribute[i, c] + uv[1] * attribute[j, c] + rest * attribute[k, c]


@wp.kernel
def _interpolate_backward(
    # in:
    attribute: wp.array2d[float],
    triangle: wp.array2d[int],
    visible: wp.array2d[int],
    barycentric: wp.array2d[wp.vec2],
    grad_out: wp.array3d[float],
    # out:
    grad_attribute: wp.array2d[float],
    grad_barycentric: wp.array2d[wp.vec2],
):
    row, column = wp.tid()
    t = visible[row, column]
    grad_u = float(0.0)
    grad_v = float(0.0)
    if _readable(triangle, t, attribute.shape[0]):
        uv = barycentric[row, column]
        i = triangle[t, 0]
        j = triangle[t, 1]
        k = triangle[t, 2]
        rest = 1.0 - uv[0] - uv[1]
        for c in range(grad_out.shape[2]):
            g = grad_out[row, column, c]
            if grad_attribute.shape[0] > 0:
                wp.atomic_add(grad_attribute, i, c, uv[0] * g)
                wp.atomic_add(grad_attribute, j, c, uv[1] * g)
                wp.atomic_add(grad_attribute, k, c, rest * g)
            grad_u += g * (attribute[i, c] - attribute[k, c])
            grad_v += g * (attribute[j, c] - attribute[k, c])
    if grad_barycentric.shape[0] > 0:
        grad_barycentric[row, column] = wp.vec2(grad_u, grad_v)


def rasterize_backward(position, triangle, visible, grad_barycentric, grad, space: str = "clip") -> None:
    """Computes the gradient of positions from the gradient of a raster's barycentrics; z has no gradient.

    On CUDA pixels are summed in any order, so that the last bits change from run to run.

    Args:
        position: float [V, 4], clip coordinates x, y, z, w of V vertices; or in UV space float [V, 2], u and v.
        triangle: int [F, 3], the vertices of each triangle.
        visible: int [H, W], the visible triangle of each pixel.
        grad_barycentric: vec2 [H, W], gradient of the weights of corners 0 and 1.
        grad: Shaped like `position`; the gradient is added to it.
        space: "clip" or "uv", as for `Rasterizer`.
    """
    inputs = [position, triangle, frame(*visible.shape, space), visible, grad_barycentric]
    wp.launch(_rasterize_backward, visible.shape, inputs=inputs, outputs=[grad], device=position.device)


def interpolate(attribute, triangle, visible, barycentric, out) -> None:
    """Interpolates the corners' attributes at each pixel's surface point.

    The result is 0 and has no gradient in uncovered pixels, and where the triangle or one of its corners doesn't exist.

    Args:
        attribute: float [V, C], rows of C attributes.
        triangle: int [F, 3], the row of `attribute` of each corner; may differ from the triangles of the positions.
        visible: int [H, W], the visible triangle of each pixel.
        barycentric: vec2 [H, W], weights of corners 0 and 1 of the visible triangle.
        out: float [H, W, C], written.
    """
    inputs = [attribute, triangle, visible, barycentric]
    wp.launch(_interpolate, visible.shape, inputs=inputs, outputs=[out], device=attribute.device)


def interpolate_backward(attribute, triangle, visible, barycentric, grad_out, grad_attribute, grad_barycentric) -> None:
    """Computes the gradients of attributes and barycentrics from `grad_out`, float [H, W, C], the gradient of a result
    of `interpolate`, and its arguments.

    `grad_attribute`, float [V, C], is added to, `grad_barycentric`, vec2 [H, W], is written; with no elements they are
    not wanted. On CUDA pixels are added in any order, so that the last bits of `grad_attribute` change from run to run.
    """
    inputs = [attribute, triangle, visible, barycentric, grad_out]
    outputs = [grad_attribute, grad_barycentric]
    wp.launch(_interpolate_backward, visible.shape, inputs=inputs, outputs=outputs, device=attribute.device)
