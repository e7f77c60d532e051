"""Draws random points on a mesh, at which the textures of a cascade are tuned (lightmap-uv-clustering-cascade,
section 3.3.3).

`tests/kernels/test_surface.py` tests their distribution.
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
