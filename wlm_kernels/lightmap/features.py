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
from wlm_kernels.lightmap.blocks import ste_mix
from wlm_kernels.native import native_source, on_cuda

INPUTS, MAP_INPUTS = 16, 12
"""Inputs of a network, and those of them that come from the maps; the encoded time follows."""

CENTRE = wp.constant(3.4641016151377544)  # sqrt(12)


@wp.struct
class Maps:
    """The feature maps of N tiles (see the module) in one array: where each map begins, and its shape."""

    values: wp.array1d[float]  # in [0, 1]
    uv_endpoints: int  # [N, 32, 32, 2, 4]
    uv_weights: int  # [N, 128, 128]
    uvt_endpoints: int  # [N, slices, side / 4, side / 4, 2, 4]
    uvt_weights: int  # [N, slices, side, side]
    ut: int  # [N, rows, columns, 2]
    vt: int  # [N, rows, columns, 2]
    slices: int
    side: int
    rows: int
    columns: int


@wp.func_native(native_source(__package__, "cells_at"))
def cells_at(values: wp.array1d[float], i: int, j: int) -> wp.vec4: ...


@wp.func_native(native_source(__package__, "four_at"))
def four_at(values: wp.array1d[float], i: int) -> wp.vec4: ...


@wp.func_native(native_source(__package__, "pair_at"))
def pair_at(values: wp.array1d[float], i: int, j: int) -> wp.vec2: ...


@wp.struct
class Place:
    """Where numbers of a texel of F_uv are: index of its block's endpoints, 8 numbers, and of its weight."""

    endpoints: int
    weight: int


@wp.func
def uv_place(maps: Maps, n: int, flat: int) -> Place:
    place = Place()
    place.endpoints = maps.uv_endpoints + 8 * (1024 * n + 32 * (flat >> 9) + ((flat & 127) >> 2))
    place.weight = maps.uv_weights + 16384 * n + flat
    return place


@wp.struct
class Cell:
    """The texels of F_uvt around a sample, two along each axis, and its place between them."""

    x: wp.vec2i
    y: wp.vec2i
    t: wp.vec2i
    in_x: bool  # whether both along x lie in one block
    in_y: bool
    fx: float
    fy: float
    ft: float


@wp.func
def cell_of(maps: Maps, u: float, v: float, tau: float, periodic: int) -> Cell:
    x = cell(u, maps.side)
    y = cell(v, maps.side)
    t = cell(tau, maps.slices)
    c = Cell()
    c.x = wp.vec2i(axis_index(x, maps.side, 0), axis_index(x + 1, maps.side, 0))
    c.y = wp.vec2i(axis_index(y, maps.side, 0), axis_index(y + 1, maps.side, 0))
    c.t = wp.vec2i(axis_index(t, maps.slices, periodic), axis_index(t + 1, maps.slices, periodic))
    c.in_x = c.x[0] >> 2 == c.x[1] >> 2
    c.in_y = c.y[0] >> 2 == c.y[1] >> 2
    c.fx = fraction(u, maps.side)
    c.fy = fraction(v, maps.side)
    c.ft = fraction(tau, maps.slices)
    return c


@wp.struct
class Corners:
    """The four texels of a slice of F_uvt around a sample, along x first: where their blocks' endpoints and their
    weights are, and these."""

    endpoints: wp.vec4i
    weights: wp.vec4i
    w: wp.vec4
    low: wp.mat44
    high: wp.mat44


@wp.func
def corners_at(maps: Maps, s: int, cell: Cell) -> Corners:
    side = maps.side
    endpoints = wp.vec4i()
    weights = wp.vec4i()
    for q in range(4):
        y = s * side + cell.y[q // 2]
        x = cell.x[q % 2]
        endpoints[q] = maps.uvt_endpoints + 8 * ((y >> 2) * (side >> 2) + (x >> 2))
        weights[q] = maps.uvt_weights + y * side + x
    early = pair_at(maps.values, weights[0], weights[1])
    late = pair_at(maps.values, weights[2], weights[3])
    # Most samples have one block, which is read once: a GPU's cache looks up one line of a load after another.
    low0 = four_at(maps.values, endpoints[0])
    high0 = four_at(maps.values, endpoints[0] + 4)
    low1 = low0
    high1 = high0
    if not cell.in_x:
        low1 = four_at(maps.values, endpoints[1])
        high1 = four_at(maps.values, endpoints[1] + 4)
    low2 = low0
    high2 = high0
    low3 = low1
    high3 = high1
    if not cell.in_y:
        low2 = four_at(maps.values, endpoints[2])
        high2 = four_at(maps.values, endpoints[2] + 4)
        low3 = low2
        high3 = high2
        if not cell.in_x:
            low3 = four_at(maps.values, endpoints[3])
            high3 = four_at(maps.values, endpoints[3] + 4)
    c = Corners()
    c.endpoints = endpoints
    c.weights = weights
    c.w = wp.vec4(early[0], early[1], late[0], late[1])
    c.low = wp.matrix_from_rows(low0, low1, low2, low3)
    c.high = wp.matrix_from_rows(high0, high1, high2, high3)
    return c


@wp.func
def corner_weights(cell: Cell, k: int) -> wp.vec4:
    """Returns the weights of the four texels around a sample in slice k of its two, along x first."""
    ct = wp.where(k == 0, 1.0 - cell.ft, cell.ft)
    early = ct * (1.0 - cell.fy)
    late = ct * cell.fy
    return wp.vec4(early * (1.0 - cell.fx), early * cell.fx, late * (1.0 - cell.fx), late * cell.fx)


@wp.func
def volume_at(maps: Maps, n: int, cell: Cell, quantised: int) -> wp.vec4:
    f = wp.vec4()
    two = int(2)  # a variable keeps the loop rolled: unrolled, the code outgrows the GPU's instruction cache
    for k in range(two):
        s = n * maps.slices + wp.where(k == 0, cell.t[0], cell.t[1])
        corners = corners_at(maps, s, cell)
        weights = corner_weights(cell, k)
        for q in range(4):
            f += weights[q] * ste_mix(corners.low[q], corners.high[q], corners.w[q], quantised)
    return f


@wp.func
def plane_at(maps: Maps, offset: int, n: int, p: float, tau: float, periodic: int) -> wp.vec2:
    x = cell(p, maps.columns)
    t = cell(tau, maps.rows)
    fx = fraction(p, maps.columns)
    ft = fraction(tau, maps.rows)
    xa = offset + 2 * axis_index(x, maps.columns, 0)
    xb = offset + 2 * axis_index(x + 1, maps.columns, 0)
    ta = 2 * maps.columns * (n * maps.rows + axis_index(t, maps.rows, periodic))
    tb = 2 * maps.columns * (n * maps.rows + axis_index(t + 1, maps.rows, periodic))
    a = cells_at(maps.values, ta + xa, ta + xb)
    b = cells_at(maps.values, tb + xa, tb + xb)
    early = (1.0 - fx) * wp.vec2(a[0], a[1]) + fx * wp.vec2(a[2], a[3])
    late = (1.0 - fx) * wp.vec2(b[0], b[1]) + fx * wp.vec2(b[2], b[3])
    return (1.0 - ft) * early + ft * late


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
    gamma: float
    inverse_range: wp.array2d[float]  # [N, T] 1 / the squared range of radiance; 0 where there is none
    tracked: wp.array4d[float]  # [lanes, N, T, 2] sum and count of squared errors of radiance; empty: not tracked
    seed: int
    shift: wp.array1d[wp.vec3]  # [N] colour over scale = shift + spread * target
    spread: wp.array1d[wp.vec3]  # [N]
    emphasis: float  # exponent of the colour over scale in the weight of a texel; 0: none
    periodic: int
    quantised: int  # whether the maps are on the levels of the file; until then features get noise
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


@wp.func_native(
    on_cuda(
        """
float y;
asm("{.reg .f32 l; lg2.approx.f32 l, %1; mul.f32 l, l, %2; ex2.approx.f32 %0, l;}" : "=f"(y) : "f"(x), "f"(exponent));
return y;
""",
        "return wp::pow(x, exponent);",
    )
)
def _power(x: float, exponent: float) -> float: ...


@wp.func
def powers(c: wp.vec3, exponent: float) -> wp.vec3:
    """Returns c ** exponent for c above 0, or 0 if the exponent is above 0; a GPU's relative error is about 1e-6."""
    return wp.vec3(_power(c[0], exponent), _power(c[1], exponent), _power(c[2], exponent))


@wp.func
def texel_weight(batch: Batch, n: int, k: int, target: wp.vec3) -> wp.vec3:
    weight = batch.weight[n, k]
    if batch.emphasis == 0.0:
        return weight
    colour = batch.shift[n] + wp.cw_mul(batch.spread[n], target)
    least = 0.02  # keeps black texels in the fit
    return wp.cw_mul(weight, powers(wp.max(colour, wp.vec3(least)), batch.emphasis))


@wp.func
def radiance_of(batch: Batch, n: int, k: int, y: wp.vec3) -> wp.vec3:
    c = wp.cw_mul(batch.shift[n] + wp.cw_mul(batch.spread[n], y), batch.scale[n, k])
    return powers(wp.max(c, wp.vec3()), batch.gamma)


@wp.func
def track_error(batch: Batch, lane: int, n: int, k: int, target: wp.vec3, error: wp.vec3):
    """Adds the squared radiance error of a sample to `batch.tracked`, for the PSNR in progress reports."""
    if batch.tracked.shape[0] > 0:
        e = radiance_of(batch, n, k, target + error) - radiance_of(batch, n, k, target)
        wp.atomic_add(batch.tracked, lane, n, k, 0, wp.dot(e, e) / 3.0 * batch.inverse_range[n, k])
        wp.atomic_add(batch.tracked, lane, n, k, 1, 1.0)
