"""Reading a cascade of two textures, its ways back, and what else a step of its fit needs
(lightmap-uv-clustering-cascade, sections 3.3.2 and 3.3.3).

C(u) = T_p(F(T_c(u))) (eq. 7): T_c gives a coordinate, the triangle wave F brings it into [0, 1], T_p gives the colour.
Both textures are read between their texels and clamped at their borders, as ``texture`` says. An empty T_c stands for
none: C(u) = T_p(u).

Two things of the paper had to be settled. Eq. 8 has a floor where bars must be and would be -2 or 0 everywhere; here
F(x) = 2 |x/2 - floor(x/2 + 1/2)|. And F acts on what was read from T_c, as eq. 7 says, two waves a point; acting on its
texels it would be eight, and the same where they are in [0, 1], which is all that 16 bits without a sign can hold.
F(x) = x there, so a decoder of a stored T_c has no wave to compute.

A point is a coordinate u; one that is NaN stands for nothing to read: it reads NaN, its loss is 0, it has no gradient.
Gradients of textures are added by atomics: on CUDA in any order, so that the last bits change from run to run.
"""

import warp as wp

from wlm_kernels.raster.texture import Axis, add, axis_at, codes, read, read_slope

__all__ = ["corner_points", "image_loss", "pair_loss", "sample", "sample_backward", "surface_points"]

wp.set_module_options({"enable_backward": False})

_LINEAR, _CLAMP = (wp.constant(code) for code in codes("linear", "clamp"))
# A mirrored texture is one that is clamped after the wave.
_WAVE = wp.constant(codes("linear", "mirror")[1])
_CHANNELS = wp.constant(3)


@wp.struct
class _Place:
    """Where u leads: among the texels of T_c, if there are any, and of T_p."""

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
    at = _place(colour, lut, uv[i])
    for c in range(_CHANNELS):
        out[i, c] = read(colour, at.x, at.y, c)


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
    at = _place(colour, lut, uv[i])
    on = wp.vec2()
    for c in range(_CHANNELS):
        add(grad_colour, at.x, at.y, c, g[c])
        on += g[c] * read_slope(colour, at.x, at.y, c)
    if lut.shape[0] > 0:
        add(grad_lut, at.lut_x, at.lut_y, 0, on[0])
        add(grad_lut, at.lut_x, at.lut_y, 1, on[1])


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
    apart: float,
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
    # Above 0 and up to the whole, so that a triangle without area is never met.
    share = (wp.float64(i + 1) - wp.float64(wp.randf(state))) / wp.float64(count)
    t = wp.min(wp.lower_bound(area, share * area[last]), last)
    b = wp.vec2(wp.randf(state), wp.randf(state))
    if b[0] + b[1] > 1.0:
        b = wp.vec2(1.0 - b[0], 1.0 - b[1])
    turn = 2.0 * wp.pi * wp.randf(state)
    step_u = apart * wp.cos(turn)
    step_v = apart * wp.sin(turn)
    one = corner[t, 0] - corner[t, 2]
    two = corner[t, 1] - corner[t, 2]
    area_uv = one[0] * two[1] - one[1] * two[0]
    other = b
    if area_uv != 0.0:
        d = wp.vec2(step_u * two[1] - step_v * two[0], one[0] * step_v - one[1] * step_u) / area_uv
        if _inside(b + d):
            other = b + d
        elif _inside(b - d):
            other = b - d
    triangle[i] = t
    triangle[count + i] = t
    barycentric[i] = b
    barycentric[count + i] = other


@wp.func
def _or_zero(x: float) -> float:
    return wp.where(wp.isnan(x), 0.0, x)


@wp.func
def _sign(x: float) -> float:
    """Warp's own is 1 at 0, where L1 has no slope."""
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
    one = _or_zero(difference[i, c])
    two = _or_zero(difference[j, c])
    between = weight * _sign(one - two)
    grad[i, c] = _sign(one) + between
    grad[j, c] = _sign(two) - between


def _check(colour, lut) -> None:
    if colour.ndim != 3 or 0 in colour.shape or colour.shape[2] != 3:
        raise ValueError(f"colour: expected [Hp, Wp, 3], no side 0, got {tuple(colour.shape)}")
    if lut.ndim != 3 or lut.shape[2] != 2 or (lut.shape[0] == 0) != (lut.shape[1] == 0):
        raise ValueError(f"lut: expected [Hc, Wc, 2] or [0, 0, 2], got {tuple(lut.shape)}")


def sample(colour, lut, uv, out) -> None:
    """C(u) at any points (eq. 7).

    Args:
        colour: float [Hp, Wp, 3], T_p.
        lut: float [Hc, Wc, 2], T_c, coordinates x and y of T_p, any numbers; [0, 0, 2]: none.
        uv: vec2 [N], u right, v down, clamped to [0, 1]. NaN reads NaN.
        out: float [N, 3], written.

    Raises:
        ValueError: A texture's shape is wrong.
    """
    _check(colour, lut)
    wp.launch(_sample, uv.shape, inputs=[colour, lut, uv], outputs=[out], device=colour.device)


def sample_backward(colour, lut, uv, grad_out, grad_colour, grad_lut) -> None:
    """The gradients of ``sample`` by its textures.

    Args:
        colour, lut, uv: As for ``sample``.
        grad_out: float [N, 3].
        grad_colour: float [Hp, Wp, 3], added to.
        grad_lut: float [Hc, Wc, 2] as ``lut``, added to.

    Raises:
        ValueError: A texture's shape is wrong.
    """
    _check(colour, lut)
    inputs = [colour, lut, uv, grad_out]
    wp.launch(_sample_backward, uv.shape, inputs=inputs, outputs=[grad_colour, grad_lut], device=colour.device)


def corner_points(triangle, barycentric, corner, uv) -> None:
    """Coordinates of points in triangles.

    Args:
        triangle: int [N], of each point, -1: none.
        barycentric: vec2 [N], weights of its corners 0 and 1.
        corner: vec2 [F, 3], coordinates of the corners.
        uv: vec2 [N], written; NaN where there is no triangle.
    """
    wp.launch(
        _corner_points, triangle.shape, inputs=[triangle, barycentric, corner], outputs=[uv], device=triangle.device
    )


def surface_points(area, corner, apart: float, seed: int, step, triangle, barycentric) -> None:
    """Draws pairs of random points: the first spread evenly over a surface, the second near it in the same triangle.

    Args:
        area: float64 [F], the areas of the triangles up to and with each one; the last is above 0.
        corner: vec2 [F, 3], coordinates of the corners, of any area.
        apart: How far apart the two are, in units of the coordinates. Where the triangle has no room for that in the
            direction drawn, they are one point.
        seed: Of the draw, together with the step.
        step: int [1], on the device.
        triangle: int [2 N], written: the first points, then the second.
        barycentric: vec2 [2 N], written, weights of the corners 0 and 1.
    """
    count = triangle.shape[0] // 2
    inputs = [area, corner, apart, seed, step]
    wp.launch(_surface_points, count, inputs=inputs, outputs=[triangle, barycentric], device=area.device)


def image_loss(difference, weight: float, grad) -> None:
    """The gradient of an image's loss: the sum of |d| over all pixels and channels, and ``weight`` times that of the
    differences of d between neighbours, to the right and below (section 3.3.3: L1 of the colours and of the images'
    gradients, of which the difference is the gradient of the difference).

    Args:
        difference: float [H, W, 3], d, the image less the reference. NaN is where both show nothing: 0.
        weight: Of the second part.
        grad: float [H, W, 3], written; 0 where d is NaN.
    """
    device = difference.device
    wp.launch(_image_loss, difference.shape, inputs=[difference, weight], outputs=[grad], device=device)


def pair_loss(difference, weight: float, grad) -> None:
    """The gradient of the loss of pairs of points: the sum of |d|, and ``weight`` times that of |d_i - d_(N + i)|.

    Args:
        difference: float [2 N, 3], d; NaN counts as 0.
        weight: Of the second part.
        grad: float [2 N, 3], written.
    """
    size = (difference.shape[0] // 2, 3)
    wp.launch(_pair_loss, size, inputs=[difference, weight], outputs=[grad], device=difference.device)
