"""Kernels of a cascade of two textures: its colours and their gradients, and the points and losses of a step
that tunes them (lightmap-uv-clustering-cascade, sections 3.3.2 and 3.3.3).

C(u) = T_p(F(T_c(u))) (eq. 7): the lookup texture T_c gives a coordinate, the triangle wave F folds it into [0, 1], and
the colour texture T_p gives the colour. Both textures are read bilinearly and clamped at their borders, see
`wlm_kernels.raster.texture`. An empty T_c means that there is none: C(u) = T_p(u).

Two points of the paper are corrected or made precise. Eq. 8 has a floor in place of an absolute value, and would be -2
or 0 everywhere; here F(x) = 2 |x/2 - floor(x/2 + 1/2)|. And F acts on the value read from T_c, as eq. 7 says, and not
on each texel of T_c. For texels in [0, 1], the range of unsigned 16-bit numbers, the two are equal and F(x) = x, so a
decoder of a stored T_c computes no wave.

A point is a coordinate u. A NaN coordinate is an empty point: its colour is NaN, its loss is 0, and it has no gradient.
On CUDA the gradients of textures are added by atomics in any order, so that the last bits change from run to run.

Read `tests/reference/cascade.py` first, which computes eq. 7 and the two losses in float64 and differentiates them by
autograd.
"""

import warp as wp

from wlm_kernels.raster.texture import Axis, add, axis_at, codes, read, read_slope

wp.set_module_options({"enable_backward": False})

_LINEAR, _CLAMP = (wp.constant(code) for code in codes("linear", "clamp"))
# A mirrored texture read is the triangle wave followed by a clamped read.
_WAVE = wp.constant(codes("linear", "mirror")[1])
_CHANNELS = wp.constant(3)


@wp.struct
class _Place:
    """The texels of the lookup texture T_c (if any) and of the colour texture T_p that a coordinate reads."""

    lut_x: Axis
    lut_y: Axis
    x: Axis
    y: Axis


@wp.func
def _place(colour: wp.array3d[float], lut: wp.array3d[float], u: wp.vec2) -> _Place:
    out = _Place()
    height = colour.shape[0]
    width = colour.shape[1]
    if lut.shape[0] == 0:
        out.x = axis_at(u[0], width, _LINEAR, _CLAMP)
        out.y = axis_at(u[1], height, _LINEAR, _CLAMP)
        return out
    out.lut_x = axis_at(u[0], lut.shape[1], _LINEAR, _CLAMP)
    out.lut_y = axis_at(u[1], lut.shape[0], _LINEAR, _CLAMP)
    out.x = axis_at(read(lut, out.lut_x, out.lut_y, 0), width, _LINEAR, _WAVE)
    out.y = axis_at(read(lut, out.lut_x, out.lut_y, 1), height, _LINEAR, _WAVE)
    return out


@wp.kernel
def _sample(
    # in:
    colour: wp.array3d[float],
    lut: wp.array3d[float],
    uv: wp.array1d[wp.vec2],
    # out:
    out: wp.array2d[float],
):
    i = wp.tid()
    place = _place(colour, lut, uv[i])
    for c in range(_CHANNELS):
        out[i, c] = read(colour, place.x, place.y, c)


@wp.kernel
def _sample_backward(
    # in:
    colour: wp.array3d[float],
    lut: wp.array3d[float],
    uv: wp.array1d[wp.vec2],
    grad_out: wp.array2d[float],
    # out:
    grad_colour: wp.array3d[float],
    grad_lut: wp.array3d[float],
):
    i = wp.tid()
    g = wp.vec3(grad_out[i, 0], grad_out[i, 1], grad_out[i, 2])
    if g[0] == 0.0 and g[1] == 0.0 and g[2] == 0.0:
        return
    place = _place(colour, lut, uv[i])
    grad_place = wp.vec2()
    for c in range(_CHANNELS):
        add(grad_colour, place.x, place.y, c, g[c])
        grad_place += g[c] * read_slope(colour, place.x, place.y, c)
    if lut.shape[0] > 0:
        add(grad_lut, place.lut_x, place.lut_y, 0, grad_place[0])
        add(grad_lut, place.lut_x, place.lut_y, 1, grad_place[1])


@wp.func
def _corners(corner: wp.array2d[wp.vec2], t: int, b: wp.vec2) -> wp.vec2:
    return b[0] * corner[t, 0] + b[1] * corner[t, 1] + (1.0 - b[0] - b[1]) * corner[t, 2]


@wp.kernel
def _corner_points(
    # in:
    triangle: wp.array1d[int],
    barycentric: wp.array1d[wp.vec2],
    corner: wp.array2d[wp.vec2],
    # out:
    uv: wp.array1d[wp.vec2],
):
    i = wp.tid()
    t = triangle[i]
    if t < 0:
        uv[i] = wp.vec2(wp.nan, wp.nan)
    else:
        uv[i] = _corners(corner, t, barycentric[i])


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
def _or_zero(x: float) -> float:
    return wp.where(wp.isnan(x), 0.0, x)


@wp.func
def _sign(x: float) -> float:
    """Returns the sign of x: -1, 0 or 1. At 0, where |x| has no slope, it is 0; `wp.sign` would return 1."""
    return wp.where(x > 0.0, 1.0, wp.where(x < 0.0, -1.0, 0.0))


@wp.kernel
def _image_loss(
    # in:
    difference: wp.array3d[float],
    weight: float,
    # out:
    grad: wp.array3d[float],
):
    y, x, c = wp.tid()
    d = difference[y, x, c]
    if wp.isnan(d):
        grad[y, x, c] = 0.0
        return
    g = float(0.0)
    if x > 0:
        g += _sign(d - _or_zero(difference[y, x - 1, c]))
    if x + 1 < difference.shape[1]:
        g += _sign(d - _or_zero(difference[y, x + 1, c]))
    if y > 0:
        g += _sign(d - _or_zero(difference[y - 1, x, c]))
    if y + 1 < difference.shape[0]:
        g += _sign(d - _or_zero(difference[y + 1, x, c]))
    grad[y, x, c] = _sign(d) + weight * g


@wp.kernel
def _pair_loss(
    # in:
    difference: wp.array2d[float],
    weight: float,
    # out:
    grad: wp.array2d[float],
):
    i, c = wp.tid()
    j = i + difference.shape[0] // 2
    d_i = _or_zero(difference[i, c])
    d_j = _or_zero(difference[j, c])
    between = weight * _sign(d_i - d_j)
    grad[i, c] = _sign(d_i) + between
    grad[j, c] = _sign(d_j) - between


def _check(colour, lut) -> None:
    if colour.ndim != 3 or 0 in colour.shape or colour.shape[2] != 3:
        raise ValueError(f"colour: expected shape [height, width, 3] with sides above 0, got {tuple(colour.shape)}")
    if lut.ndim != 3 or lut.shape[2] != 2 or (lut.shape[0] == 0) != (lut.shape[1] == 0):
        raise ValueError(f"lut: expected shape [height, width, 2], or [0, 0, 2] for none, got {tuple(lut.shape)}")


def sample(colour, lut, uv, out) -> None:
    """Writes the cascade's colour C(u) at each of N points (eq. 7).

    Args:
        colour: float [Hp, Wp, 3], the colour texture T_p.
        lut: float [Hc, Wc, 2], the lookup texture T_c: any coordinates (x, y) in T_p; [0, 0, 2] if there is none.
        uv: vec2 [N], coordinates (u, v), u right and v down, clamped to [0, 1]. The colour at NaN is NaN.
        out: float [N, 3], written.
    """
    _check(colour, lut)
    wp.launch(_sample, uv.shape, inputs=[colour, lut, uv], outputs=[out], device=colour.device)


def sample_backward(colour, lut, uv, grad_out, grad_colour, grad_lut) -> None:
    """Adds the gradients of the two textures of `sample` to `grad_colour` and `grad_lut`, which have the textures'
    shapes. `grad_out`, float [N, 3], is the gradient of the colours at the points."""
    _check(colour, lut)
    inputs = [colour, lut, uv, grad_out]
    wp.launch(_sample_backward, uv.shape, inputs=inputs, outputs=[grad_colour, grad_lut], device=colour.device)


def corner_points(triangle, barycentric, corner, uv) -> None:
    """Writes the coordinates of N points to `uv`, vec2 [N]. `triangle`, int [N], is the triangle of each point, and
    `barycentric`, vec2 [N], its weights of the corners 0 and 1; `corner`, vec2 [F, 3], has the coordinates of all F
    triangles' corners. Points of triangle -1 are NaN."""
    wp.launch(
        _corner_points, triangle.shape, inputs=[triangle, barycentric, corner], outputs=[uv], device=triangle.device
    )


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


def image_loss(difference, weight: float, grad) -> None:
    """Writes the gradient of the loss between an image and its reference to `grad`, float [H, W, 3] (section 3.3.3).

    The loss is the sum of |d| over all pixels and channels, plus `weight` times the sum of |d_p - d_q| over all pairs
    of horizontal or vertical neighbours p and q. d is `difference`, float [H, W, 3]: the image minus the reference. It
    is NaN in pixels where neither shows the mesh, and counts as 0 there.
    """
    device = difference.device
    wp.launch(_image_loss, difference.shape, inputs=[difference, weight], outputs=[grad], device=device)


def pair_loss(difference, weight: float, grad) -> None:
    """Writes the gradient of the loss of N pairs of points i and N + i to `grad`, float [2 N, 3]. The loss is the sum
    of |d| plus `weight` times the sum of |d_i - d_(N + i)|, where d is `difference`, float [2 N, 3]: colours minus
    reference colours. NaN counts as 0."""
    size = (difference.shape[0] // 2, 3)
    wp.launch(_pair_loss, size, inputs=[difference, weight], outputs=[grad], device=difference.device)
