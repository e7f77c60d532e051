"""Kernel functions that evaluate a lightmap's feature maps in training and draw random training samples.

A tile has the maps F_uv, F_uvt, F_ut and F_vt over its coordinates u and v and the time t, and an MLP
(neural-dynamic-gi, eq. 5 and table 1). The MLP's inputs are, in order, 4 channels of F_uv, 4 of F_uvt, 2 of F_ut, 2 of
F_vt and 4 of the encoded time. A feature v in [0, 1] is scaled to (v - 1/2) sqrt(12): mean 0 and variance 1 where v is
uniform.

`step` is the training step that calls these functions; `gather` converts its sums to gradients; `adjoint` adds the
maps' gradients; `decode` decodes tiles from their stored bytes.

Read first: `train_features` in `tests/reference/temporal.py`.
"""

import warp as wp

from wlm_kernels.interpolate import axis_index, cell, fraction
from wlm_kernels.lightmap.blocks import texel
from wlm_kernels.native import native_source

INPUTS, MAP_INPUTS = 16, 12
"""Inputs of a network, and those of them that come from the maps; the encoded time follows."""

CENTRE = wp.constant(3.4641016151377544)  # sqrt(12)


@wp.struct
class Maps:
    """The feature maps of N tiles (see the module), with S slices in F_uvt."""

    uv_endpoints: wp.array4d[wp.vec4]  # [N, 32, 32, 2]
    uv_weights: wp.array3d[float]  # [N, 128, 128]
    uvt_endpoints: wp.array4d[wp.vec4]  # [N * S, R/4, R/4, 2]
    uvt_weights: wp.array3d[float]  # [N * S, R, R]
    ut: wp.array3d[wp.vec2]  # [N, rows of time, columns]
    vt: wp.array3d[wp.vec2]  # [N, rows of time, columns]


@wp.struct
class Offsets:
    """Index of the first gradient of each map in the flat array of all gradients."""

    uv_endpoints: int
    uv_weights: int
    uvt_endpoints: int
    uvt_weights: int
    ut: int
    vt: int


@wp.func
def ste_byte(v: float, quantised: int) -> float:
    """Returns v clamped to [0, 1], or if quantised a multiple of 1/255. The adjoint treats the derivative as 1."""
    c = wp.clamp(v, 0.0, 1.0)
    if quantised == 0:
        return c
    return wp.floor(c * 255.0 + 0.5) / 255.0


@wp.func_native(native_source(__package__, "plane_texel"))
def plane_texel(values: wp.array3d[wp.vec2], n: int, t: int, x: int) -> wp.vec2: ...


@wp.func
def level_at(plane: wp.array3d[wp.vec2], n: int, t: int, x: int, quantised: int) -> wp.vec2:
    v = plane_texel(plane, n, t, x)
    return wp.vec2(ste_byte(v[0], quantised), ste_byte(v[1], quantised))


@wp.func
def plane_at(plane: wp.array3d[wp.vec2], n: int, p: float, tau: float, periodic: int, quantised: int) -> wp.vec2:
    rows = plane.shape[1]
    columns = plane.shape[2]
    x = cell(p, columns)
    t = cell(tau, rows)
    fx = fraction(p, columns)
    ft = fraction(tau, rows)
    xa = axis_index(x, columns, 0)
    xb = axis_index(x + 1, columns, 0)
    ta = axis_index(t, rows, periodic)
    tb = axis_index(t + 1, rows, periodic)
    early = (1.0 - fx) * level_at(plane, n, ta, xa, quantised) + fx * level_at(plane, n, ta, xb, quantised)
    late = (1.0 - fx) * level_at(plane, n, tb, xa, quantised) + fx * level_at(plane, n, tb, xb, quantised)
    return (1.0 - ft) * early + ft * late


@wp.func
def volume_at(
    maps: Maps, n: int, slices: int, u: float, v: float, tau: float, periodic: int, quantised: int
) -> wp.vec4:
    height = maps.uvt_weights.shape[1]
    width = maps.uvt_weights.shape[2]
    x = cell(u, width)
    y = cell(v, height)
    t = cell(tau, slices)
    fx = fraction(u, width)
    fy = fraction(v, height)
    ft = fraction(tau, slices)
    f = wp.vec4()
    two = int(2)  # a variable keeps the loops rolled: unrolled, the code outgrows the GPU's instruction cache
    for k in range(two):
        s = n * slices + axis_index(t + k, slices, periodic)
        ct = wp.where(k == 0, 1.0 - ft, ft)
        for j in range(two):
            yy = axis_index(y + j, height, 0)
            cy = ct * wp.where(j == 0, 1.0 - fy, fy)
            for i in range(two):
                xx = axis_index(x + i, width, 0)
                c = cy * wp.where(i == 0, 1.0 - fx, fx)
                f += c * texel(maps.uvt_endpoints, maps.uvt_weights, s, yy, xx, quantised)
    return f


@wp.struct
class Batch:
    """Training data of N tiles at T stored times; K is the largest number of valid texels of a tile."""

    targets: wp.array3d[wp.vec3]  # [N, T, 128 * 128] normalised gamma-space colour
    texels: wp.array2d[int]  # [N, K] flat indices of valid texels, padded
    texel_count: wp.array1d[int]  # [N]
    tau: wp.array1d[float]  # [T] place of each time on the features' time axis, in [0, 1]
    encoding: wp.array1d[wp.vec4]  # [T] gamma(t) of eq. 4
    weight: wp.array2d[wp.vec3]  # [N, T] weight of the squared error of each channel
    number: wp.array1d[int]  # [N] number of the tile in its lightmap
    scale: wp.array2d[wp.vec3]  # [N, T] divisor of the colours at each time
    control: wp.array1d[int]  # [0] number of the step
    slices: int  # S of F_uvt
    gamma: float
    inverse_range: wp.array2d[float]  # [N, T] 1 / the squared range of radiance; 0 where there is none
    tracked: wp.array4d[float]  # [lanes, N, T, 2] sum and count of squared errors of radiance; empty: not tracked
    seed: int
    shift: wp.array1d[wp.vec3]  # [N] colour over scale = shift + spread * target
    spread: wp.array1d[wp.vec3]  # [N]
    emphasis: float  # exponent of the colour over scale in the weight of a texel; 0: none
    periodic: int
    quantised: int  # as in `wlm_kernels.lightmap.blocks`
    frozen: int  # whether the maps get no gradients
    schedule: wp.array1d[wp.vec4]  # [steps] learning rates of maps and networks, and Adam's two corrections
    rates: wp.array1d[wp.vec4]  # [1] those of this step, written: the launch that uses them also counts the step


@wp.struct
class Sample:
    """A random training sample of a tile."""

    flat: int  # index of its texel
    k: int  # stored time
    state: wp.uint32  # of the generator, for what is drawn next


@wp.func
def draw_sample(batch: Batch, n: int, b: int, samples: int) -> Sample:
    """Draws random sample b of tile n for this step: a valid texel and a stored time; the first writes rates."""
    if n == 0 and b == 0:
        batch.rates[0] = batch.schedule[wp.min(batch.control[0], batch.schedule.shape[0] - 1)]
    state = wp.rand_init(batch.seed + batch.number[n] * 9973, batch.control[0] * samples + b)
    s = Sample()
    s.flat = batch.texels[n, wp.randi(state, 0, batch.texel_count[n])]
    s.k = wp.randi(state, 0, batch.tau.shape[0])
    s.state = state
    return s


@wp.func
def power(colour: wp.vec3, exponent: float) -> wp.vec3:
    return wp.vec3(wp.pow(colour[0], exponent), wp.pow(colour[1], exponent), wp.pow(colour[2], exponent))


@wp.func
def texel_weight(batch: Batch, n: int, k: int, target: wp.vec3) -> wp.vec3:
    weight = batch.weight[n, k]
    if batch.emphasis == 0.0:
        return weight
    colour = batch.shift[n] + wp.cw_mul(batch.spread[n], target)
    least = 0.02  # keeps black texels in the fit
    return wp.cw_mul(weight, power(wp.max(colour, wp.vec3(least)), batch.emphasis))


@wp.func
def radiance_of(batch: Batch, n: int, k: int, y: wp.vec3) -> wp.vec3:
    c = wp.cw_mul(batch.shift[n] + wp.cw_mul(batch.spread[n], y), batch.scale[n, k])
    return power(wp.max(c, wp.vec3()), batch.gamma)


@wp.func
def track_error(batch: Batch, lane: int, n: int, k: int, target: wp.vec3, error: wp.vec3):
    """Adds the squared radiance error of a sample to `batch.tracked`, for the PSNR in progress reports."""
    if batch.tracked.shape[0] > 0:
        e = radiance_of(batch, n, k, target + error) - radiance_of(batch, n, k, target)
        wp.atomic_add(batch.tracked, lane, n, k, 0, wp.dot(e, e) / 3.0 * batch.inverse_range[n, k])
        wp.atomic_add(batch.tracked, lane, n, k, 1, 1.0)
