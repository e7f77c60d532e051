"""Random points on a mesh, at which the textures of a cascade are tuned, and the gradient of the loss there
(lightmap-uv-clustering-cascade, section 3.3.3).

`tests/kernels/test_surface.py` tests the points' distribution, `tests/atlas/test_cascade.py` the gradient.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def _inside(b: wp.vec2) -> bool:
    return b[0] >= 0.0 and b[1] >= 0.0 and b[0] + b[1] <= 1.0


@wp.kernel
def _surface_points(
    # in:
    area: wp.array1d[wp.float64],
    corner: wp.array2d[wp.vec2],
    distance: float,
    seed: int,
    step: wp.array1d[int],
    # out:
    triangle: wp.array1d[int],
    barycentric: wp.array1d[wp.vec2],
):
    i = wp.tid()
    count = triangle.shape[0] // 2
    state = wp.rand_init(seed + step[0], i)
    last = area.shape[0] - 1
    # The number lies in (0, 1], so that a triangle without area is never drawn.
    share = (wp.float64(i + 1) - wp.float64(wp.randf(state))) / wp.float64(count)
    t = wp.min(wp.lower_bound(area, share * area[last]), last)
    b = wp.vec2(wp.randf(state), wp.randf(state))
    if b[0] + b[1] > 1.0:
        b = wp.vec2(1.0 - b[0], 1.0 - b[1])
    angle = 2.0 * wp.pi * wp.randf(state)
    step_u = distance * wp.cos(angle)
    step_v = distance * wp.sin(angle)
    e0 = corner[t, 0] - corner[t, 2]
    e1 = corner[t, 1] - corner[t, 2]
    area_uv = e0[0] * e1[1] - e0[1] * e1[0]
    partner = b
    if area_uv != 0.0:
        d = wp.vec2(step_u * e1[1] - step_v * e1[0], e0[0] * step_v - e0[1] * step_u) / area_uv
        if _inside(b + d):
            partner = b + d
        elif _inside(b - d):
            partner = b - d
    triangle[i] = t
    triangle[count + i] = t
    barycentric[i] = b
    barycentric[count + i] = partner


@wp.func
def _difference(value: wp.array3d[float], target: wp.array3d[float], y: int, x: int, c: int) -> float:
    d = value[y, x, c] - target[y, x, c]
    return wp.where(wp.isnan(d), 0.0, d)


@wp.kernel
def _loss_gradient(
    # in:
    value: wp.array3d[float],
    target: wp.array3d[float],
    weight: float,
    across: int,
    # out:
    grad: wp.array3d[float],
):
    y, x, c = wp.tid()
    d = _difference(value, target, y, x, c)
    # `wp.sign(0)` is 1, where the L1 has the gradient 0.
    g = wp.where(d == 0.0, 0.0, wp.sign(d))
    for k in range(2 * (1 + across)):
        row = y + wp.where(k == 0, 1, wp.where(k == 1, -1, 0))
        column = x + wp.where(k == 2, 1, wp.where(k == 3, -1, 0))
        if row >= 0 and row < value.shape[0] and column >= 0 and column < value.shape[1]:
            change = d - _difference(value, target, row, column, c)
            g += weight * wp.where(change == 0.0, 0.0, wp.sign(change))
    grad[y, x, c] = g


def loss_gradient(value, target, weight: float, across: bool, grad) -> None:
    """Computes the gradient, by an image float [H, W, 3], of the L1 of its difference to a target plus `weight` times
    the L1 of the changes of this difference from pixel to pixel, and writes it to `grad`.

    The difference is 0 where one of them is NaN. `across` tells whether changes between horizontal neighbours count,
    besides those between vertical neighbours.
    """
    inputs = [value, target, weight, int(across)]
    wp.launch(_loss_gradient, value.shape, inputs=inputs, outputs=[grad], device=value.device)


def surface_points(area, corner, distance: float, seed: int, step, triangle, barycentric) -> None:
    """Draws pairs of random points: the first point stratified over a surface, the second near it in the same triangle.

    Args:
        area: float64 [F], cumulative areas of the triangles; the last is above 0.
        corner: vec2 [F, 3], coordinates of the triangles' corners; triangles may have no area.
        distance: Distance between the two points, in units of the coordinates. If the triangle ends sooner in the
            random direction, the two points are equal.
        seed: Seed of the draw, together with the step.
        step: int [1], number of the step, on the device.
        triangle: int [2 N], written: the first points, then the second.
        barycentric: vec2 [2 N], written, barycentric weights of the corners 0 and 1.
    """
    count = triangle.shape[0] // 2
    inputs = [area, corner, distance, seed, step]
    wp.launch(_surface_points, count, inputs=inputs, outputs=[triangle, barycentric], device=area.device)
