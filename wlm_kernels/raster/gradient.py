"""Attributes at the point that each pixel sees, and the ways back: to the attributes and to the triangles' corners.

``raster`` says what barycentrics are. What is visible is a constant to all gradients.
"""

import warp as wp

from wlm_kernels.raster.edges import Frame, centre, check_position, corners_of, frame, functions, has_corners, total_of

__all__ = ["interpolate", "interpolate_backward", "rasterize_backward"]

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.func
def _readable(triangle: wp.array2d[int], t: int, count: int) -> bool:
    """Whether there is such a triangle, with corners below a count."""
    if t < 0 or t >= triangle.shape[0]:
        return False
    return has_corners(triangle, t, count)


@wp.kernel
def _rasterize_backward(
    # in:
    position: wp.array2d[float],
    triangle: wp.array2d[int],
    frame: Frame,
    found: wp.array2d[int],
    grad_barycentric: wp.array2d[wp.vec2],
    # out:
    grad: wp.array2d[float],
):
    row, column = wp.tid()
    t = found[row, column]
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
    on_a = wp.cross(s[1] * k.c - s[2] * k.b, -p)
    on_b = wp.cross(s[2] * k.a - s[0] * k.c, -p)
    on_c = wp.cross(s[0] * k.b - s[1] * k.a, -p)
    for i in range(3):
        to = triangle[t, i]
        on = wp.where(i == 0, on_a, wp.where(i == 1, on_b, on_c))
        wp.atomic_add(grad, to, 0, float(on[0]))
        wp.atomic_add(grad, to, 1, float(on[1]))
        if grad.shape[1] == 4:
            wp.atomic_add(grad, to, 3, float(on[2]))


@wp.kernel
def _interpolate(
    # in:
    attribute: wp.array2d[float],
    triangle: wp.array2d[int],
    found: wp.array2d[int],
    barycentric: wp.array2d[wp.vec2],
    # out:
    out: wp.array3d[float],
):
    row, column = wp.tid()
    t = found[row, column]
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
    found: wp.array2d[int],
    barycentric: wp.array2d[wp.vec2],
    grad_out: wp.array3d[float],
    # out:
    grad_attribute: wp.array2d[float],
    grad_barycentric: wp.array2d[wp.vec2],
):
    row, column = wp.tid()
    t = found[row, column]
    on_u = float(0.0)
    on_v = float(0.0)
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
            on_u += g * (attribute[i, c] - attribute[k, c])
            on_v += g * (attribute[j, c] - attribute[k, c])
    if grad_barycentric.shape[0] > 0:
        grad_barycentric[row, column] = wp.vec2(on_u, on_v)


def rasterize_backward(position, triangle, found, grad_barycentric, grad, space: str = "clip") -> None:
    """The gradient of a raster's barycentrics by the positions; z has none.

    On CUDA pixels are added in any order, so that the last bits change from run to run.

    Args:
        position: float [V, 4], or [V, 2] in UV space.
        triangle: int [F, 3].
        found: int [H, W], the triangle that each pixel sees.
        grad_barycentric: vec2 [H, W].
        grad: Like position; added to.
        space: As for ``Rasterizer``.
    """
    check_position(position, space)
    inputs = [position, triangle, frame(*found.shape, space), found, grad_barycentric]
    wp.launch(_rasterize_backward, found.shape, inputs=inputs, outputs=[grad], device=position.device)


def interpolate(attribute, triangle, found, barycentric, out) -> None:
    """The attributes of the corners at the point that each pixel sees.

    They are 0 and have no gradient where a pixel sees nothing, or a triangle that isn't there or lacks a corner.

    Args:
        attribute: float [V, C].
        triangle: int [F, 3], numbers of rows of ``attribute``; they need not be those drawn with.
        found: int [H, W], the triangle that each pixel sees.
        barycentric: vec2 [H, W], where in it.
        out: float [H, W, C], written.
    """
    inputs = [attribute, triangle, found, barycentric]
    wp.launch(_interpolate, found.shape, inputs=inputs, outputs=[out], device=attribute.device)


def interpolate_backward(attribute, triangle, found, barycentric, grad_out, grad_attribute, grad_barycentric) -> None:
    """The gradients of ``interpolate``.

    On CUDA pixels are added to ``grad_attribute`` in any order, so that the last bits change from run to run.

    Args:
        attribute, triangle, found, barycentric: As for ``interpolate``.
        grad_out: float [H, W, C].
        grad_attribute: float [V, C], added to; of shape [0, 0]: not wanted.
        grad_barycentric: vec2 [H, W], written; of shape [0, 0]: not wanted.
    """
    inputs = [attribute, triangle, found, barycentric, grad_out]
    outputs = [grad_attribute, grad_barycentric]
    wp.launch(_interpolate_backward, found.shape, inputs=inputs, outputs=outputs, device=attribute.device)
