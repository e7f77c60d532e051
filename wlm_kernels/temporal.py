"""Training of temporal lightmap tiles: sample the four maps, run the MLP, take the loss and every gradient, at once.

One launch handles B random samples of each of N tiles (neural-dynamic-gi, section 3.3, 3.4 and 4): it draws a valid
texel and a stored time, samples F_uv, F_uvt, F_ut and F_vt, adds the uniform noise of eq. 6, centres the features,
runs the network, takes the weighted squared error and writes the gradients. ``gather`` then turns what it left into
plain gradient arrays for an optimizer.

The same sums give the same result on one device. On CUDA the maps' gradients are added as 64-bit integers (integer
addition has no order), the networks' as one partial sum a block; on the CPU each lane (a range of samples, run by one
thread) has float buffers of its own. A tile's samples depend on the seed, the step and its number alone, so a tile
fits to the same result in any batch.

Inputs of the network, in order: F_uv 4, F_uvt 4, F_ut 2, F_vt 2, the encoded time 4. Tiles without temporal maps use
F_uv alone. Features v in [0, 1] enter as (v - 1/2) sqrt(12): mean 0 and variance 1 where v is uniform.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels import mlp
from wlm_kernels.blocks import ste_endpoint, ste_weight, texel
from wlm_kernels.grids import axis_index, cell, fraction

__all__ = [
    "BLOCK",
    "CENTRE",
    "STATIC_INPUTS",
    "TEMPORAL_INPUTS",
    "Maps",
    "StepKernels",
    "gather",
    "step_kernels",
]

TILE = 128
BLOCK = 128  # threads of a CUDA block; the samples of a tile are a multiple of it there
CENTRE = 3.4641016151377544  # sqrt(12)
NOISE = 1.0 / 256.0  # alpha of eq. 6: one step of 8 bits
TEMPORAL_INPUTS = 16
STATIC_INPUTS = 4
MAX_UNROLL = 16
LAUNCH_BOUNDS = (128, 4)
GRADIENT_UNIT = 2.0**40  # fixed point of the integer sums: 1e-12 steps, overflow beyond 8e6


@wp.struct
class Maps:
    """The feature maps of N tiles with S time slices in F_uvt. Static tiles leave all but the first two empty."""

    uv_endpoints: wp.array4d[wp.vec4]  # [N, 32, 32, 2]
    uv_weights: wp.array3d[float]  # [N, 128, 128]
    uvt_endpoints: wp.array4d[wp.vec4]  # [N * S, R/4, R/4, 2]
    uvt_weights: wp.array3d[float]  # [N * S, R, R]
    ut: wp.array3d[wp.vec2]  # [N, rows of time, columns]
    vt: wp.array3d[wp.vec2]  # [N, rows of time, columns]


@wp.struct
class Offsets:
    """Where the gradients of each map begin in the flat gradient array, in scalars."""

    uv_endpoints: int
    uv_weights: int
    uvt_endpoints: int
    uvt_weights: int
    ut: int
    vt: int


@wp.func
def ste_byte(v: float, quantised: int) -> float:
    """A plane's value as used: clamped, or on its 8-bit level; straight-through in ``scatter_plane``."""
    c = wp.clamp(v, 0.0, 1.0)
    if quantised == 0:
        return c
    return wp.floor(c * 255.0 + 0.5) / 255.0


@wp.func
def ste_byte2(v: wp.vec2, quantised: int) -> wp.vec2:
    return wp.vec2(ste_byte(v[0], quantised), ste_byte(v[1], quantised))


@wp.func
def plane_at(
    plane: wp.array3d[wp.vec2], n: int, p: float, tau: float, periodic: int, quantised: int
) -> wp.vec2:
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
    early = (1.0 - fx) * ste_byte2(plane[n, ta, xa], quantised) + fx * ste_byte2(plane[n, ta, xb], quantised)
    late = (1.0 - fx) * ste_byte2(plane[n, tb, xa], quantised) + fx * ste_byte2(plane[n, tb, xb], quantised)
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
    for k in range(2):
        s = n * slices + axis_index(t + k, slices, periodic)
        ct = wp.where(k == 0, 1.0 - ft, ft)
        for j in range(2):
            yy = axis_index(y + j, height, 0)
            cy = ct * wp.where(j == 0, 1.0 - fy, fy)
            for i in range(2):
                xx = axis_index(x + i, width, 0)
                c = cy * wp.where(i == 0, 1.0 - fx, fx)
                f += c * texel(maps.uvt_endpoints, maps.uvt_weights, s, yy, xx, quantised)
    return f


@wp.func
def corner_share(base: int, at: int, other: int, f: float, block: int) -> wp.vec2:
    """The linear weights of an axis's two cells (at, other), kept where the cell lies in ``block``."""
    a = wp.where(at // 4 == block, 1.0 - f, 0.0)
    b = wp.where(other // 4 == block, f, 0.0)
    return wp.vec2(a, b)


@functools.cache
def _adders(device_kind: str):
    """How a gradient is added: as an integer on CUDA, as a float into a lane's own buffer on the CPU."""
    if device_kind == "cuda":

        @wp.func
        def add(acc: wp.array2d[wp.int64], lane: int, i: int, value: float):
            wp.atomic_add(acc, lane, i, wp.int64(value * 1099511627776.0))

        return add, wp.int64

    @wp.func
    def add(acc: wp.array2d[float], lane: int, i: int, value: float):
        acc[lane, i] += value

    return add, float


@functools.cache
def _scatters(device_kind: str):
    """The adjoints of texel, volume and plane sampling, by hand."""
    add, scalar = _adders(device_kind)

    @wp.func
    def add_endpoints(acc: wp.array2d[scalar], lane: int, at: int, a: float, b: float, g: wp.vec4):
        for c in range(4):
            add(acc, lane, at + c, a * g[c])
            add(acc, lane, at + 4 + c, b * g[c])

    @wp.func
    def scatter_texel(
        acc: wp.array2d[scalar],
        lane: int,
        offsets: Offsets,
        maps: Maps,
        n: int,
        y: int,
        x: int,
        quantised: int,
        g: wp.vec4,
    ):
        width = maps.uv_weights.shape[2]
        height = maps.uv_weights.shape[1]
        e0 = ste_endpoint(maps.uv_endpoints[n, y // 4, x // 4, 0], quantised)
        e1 = ste_endpoint(maps.uv_endpoints[n, y // 4, x // 4, 1], quantised)
        w = ste_weight(maps.uv_weights[n, y, x], quantised)
        add(acc, lane, offsets.uv_weights + (n * height + y) * width + x, wp.dot(e1 - e0, g))
        block = (n * (height // 4) + y // 4) * (width // 4) + x // 4
        add_endpoints(acc, lane, offsets.uv_endpoints + block * 8, 1.0 - w, w, g)

    @wp.func
    def scatter_volume(
        acc: wp.array2d[scalar],
        lane: int,
        offsets: Offsets,
        maps: Maps,
        n: int,
        slices: int,
        u: float,
        v: float,
        tau: float,
        periodic: int,
        quantised: int,
        g: wp.vec4,
    ):
        height = maps.uvt_weights.shape[1]
        width = maps.uvt_weights.shape[2]
        x = cell(u, width)
        y = cell(v, height)
        t = cell(tau, slices)
        fx = fraction(u, width)
        fy = fraction(v, height)
        ft = fraction(tau, slices)
        xa = axis_index(x, width, 0)
        xb = axis_index(x + 1, width, 0)
        ya = axis_index(y, height, 0)
        yb = axis_index(y + 1, height, 0)
        for k in range(2):
            s = n * slices + axis_index(t + k, slices, periodic)
            ct = wp.where(k == 0, 1.0 - ft, ft)
            # The eight corners lie in one to four blocks a slice: a block's endpoints get one sum, not one a corner.
            for j in range(2):
                by = wp.where(j == 0, ya // 4, yb // 4)
                if j == 0 or by != ya // 4:
                    cy = corner_share(y, ya, yb, fy, by) * ct
                    for i in range(2):
                        bx = wp.where(i == 0, xa // 4, xb // 4)
                        if i == 0 or bx != xa // 4:
                            cx = corner_share(x, xa, xb, fx, bx)
                            e0 = ste_endpoint(maps.uvt_endpoints[s, by, bx, 0], quantised)
                            e1 = ste_endpoint(maps.uvt_endpoints[s, by, bx, 1], quantised)
                            along = wp.dot(e1 - e0, g)
                            first = float(0.0)
                            second = float(0.0)
                            for q in range(4):
                                c = cy[q // 2] * cx[q % 2]
                                if c != 0.0:
                                    yy = wp.where(q // 2 == 0, ya, yb)
                                    xx = wp.where(q % 2 == 0, xa, xb)
                                    w = ste_weight(maps.uvt_weights[s, yy, xx], quantised)
                                    first += c * (1.0 - w)
                                    second += c * w
                                    add(
                                        acc,
                                        lane,
                                        offsets.uvt_weights + (s * height + yy) * width + xx,
                                        c * along,
                                    )
                            block = (s * (height // 4) + by) * (width // 4) + bx
                            add_endpoints(acc, lane, offsets.uvt_endpoints + block * 8, first, second, g)

    @wp.func
    def scatter_plane(
        acc: wp.array2d[scalar],
        lane: int,
        offset: int,
        rows: int,
        columns: int,
        n: int,
        p: float,
        tau: float,
        periodic: int,
        g: wp.vec2,
    ):
        x = cell(p, columns)
        t = cell(tau, rows)
        fx = fraction(p, columns)
        ft = fraction(tau, rows)
        for k in range(2):
            tt = axis_index(t + k, rows, periodic)
            ct = wp.where(k == 0, 1.0 - ft, ft)
            for i in range(2):
                xx = axis_index(x + i, columns, 0)
                c = ct * wp.where(i == 0, 1.0 - fx, fx)
                at = offset + ((n * rows + tt) * columns + xx) * 2
                add(acc, lane, at, c * g[0])
                add(acc, lane, at + 1, c * g[1])

    return scatter_texel, scatter_volume, scatter_plane, scalar


@wp.struct
class Batch:
    """What a step is trained on. T stored times, K the longest list of valid texels."""

    targets: wp.array3d[wp.vec3]  # [N, T, 128 * 128] normalised gamma-space colour
    texels: wp.array2d[int]  # [N, K] flat indices of valid texels, padded
    texel_count: wp.array1d[int]  # [N]
    tau: wp.array1d[float]  # [T] place of each time on the features' time axis, in [0, 1]
    encoding: wp.array1d[wp.vec4]  # [T] gamma(t) of eq. 4
    weight: wp.array2d[wp.vec3]  # [N, T] weight of the squared error of each channel
    number: wp.array1d[int]  # [N] number of the tile in its lightmap
    control: wp.array1d[int]  # [0] step
    slices: int  # S of F_uvt
    seed: int
    shift: wp.array1d[wp.vec3]  # [N] colour over scale = shift + spread * target
    spread: wp.array1d[wp.vec3]  # [N]
    emphasis: float  # exponent of the colour over scale in the weight of a texel; 0: none
    periodic: int
    quantised: int


@wp.func
def draw_state(batch: Batch, n: int, b: int, samples: int) -> wp.uint32:
    return wp.rand_init(batch.seed + batch.number[n] * 9973, batch.control[0] * samples + b)


@wp.func
def texel_weight(batch: Batch, n: int, k: int, target: wp.vec3) -> wp.vec3:
    weight = batch.weight[n, k]
    if batch.emphasis == 0.0:
        return weight
    colour = batch.shift[n] + wp.cw_mul(batch.spread[n], target)
    least = 0.02  # keeps black texels in the fit
    return wp.cw_mul(
        weight,
        wp.vec3(
            wp.pow(wp.max(colour[0], least), batch.emphasis),
            wp.pow(wp.max(colour[1], least), batch.emphasis),
            wp.pow(wp.max(colour[2], least), batch.emphasis),
        ),
    )


@dataclass(frozen=True)
class StepKernels:
    """The training step of one network shape on one kind of device; see ``launch``."""

    inputs: int
    hidden: int
    device_kind: str
    net: mlp.MlpKernels
    scalar: Any
    draw: Any
    _step: Any

    def launch(
        self,
        maps,
        offsets,
        hidden,
        output,
        batch,
        samples,
        acc,
        partial,
        partial_out,
        loss,
        base=0,
        count=None,
    ):
        """Adds the gradients of B samples a tile.

        Args:
            maps: ``Maps``, the parameters.
            offsets: ``Offsets`` into ``acc``.
            hidden: vecH [N, I + H + 2], see ``wlm_kernels.mlp``.
            output: vec3 [N, H + 1].
            batch: ``Batch``.
            samples: B; on CUDA a multiple of ``BLOCK``.
            acc: [lanes, M], gradient sums of the maps: int64 on CUDA (one lane), float on the CPU.
            partial: float [P, N, I + H + 2, H]: written on CUDA, one P a block; added to on the CPU, one P a lane.
            partial_out: float [P, N, H + 1, 3], likewise.
            loss: float [P, N], likewise: the sum of weighted squared errors over samples and channels / (3 B).
            base, count: The CPU's lane: samples base to base + count - 1 of each tile.
        """
        tiles = hidden.shape[0]
        span = samples if count is None else count
        wp.launch(
            self._step,
            (tiles, span),
            inputs=[maps, offsets, hidden, output, batch, samples, base],
            outputs=[acc, partial, partial_out, loss],
            device=hidden.device,
            block_dim=BLOCK,
        )


@functools.cache
def step_kernels(temporal: bool, hidden: int, gelu: str, device_kind: str) -> StepKernels:
    """Builds (once) the training step for tiles with or without temporal maps.

    Args:
        temporal: Whether the tiles have F_uvt, F_ut, F_vt and the encoded time.
        hidden: H, width of the hidden layers.
        gelu: "exact" or "tanh".
        device_kind: "cpu" or "cuda".
    """
    inputs = TEMPORAL_INPUTS if temporal else STATIC_INPUTS
    noisy = 12 if temporal else 4
    net = mlp.kernels(inputs, hidden, gelu)
    vec_in, vec_hidden = net.vec_in, net.vec_hidden
    vec_in1 = wp.types.vector(inputs + 1, float)
    vec_hidden1 = wp.types.vector(hidden + 1, float)
    first, second, third = net.first, net.second, net.third
    act, act_slope = net.act, net.act_slope
    back_hidden, back_output, back_input = net.back_hidden, net.back_output, net.back_input
    scatter_texel, scatter_volume, scatter_plane, scalar = _scatters(device_kind)
    columns_2 = inputs + 1

    @wp.func
    def features(maps: Maps, batch: Batch, n: int, y: int, x: int, k: int, state: wp.uint32) -> vec_in:
        f = vec_in()
        uv = texel(maps.uv_endpoints, maps.uv_weights, n, y, x, batch.quantised)
        for c in range(4):
            f[c] = uv[c]
        if wp.static(temporal):
            u = (float(x) + 0.5) / 128.0
            v = (float(y) + 0.5) / 128.0
            tau = batch.tau[k]
            uvt = volume_at(maps, n, batch.slices, u, v, tau, batch.periodic, batch.quantised)
            ut = plane_at(maps.ut, n, u, tau, batch.periodic, batch.quantised)
            vt = plane_at(maps.vt, n, v, tau, batch.periodic, batch.quantised)
            e = batch.encoding[k]
            for c in range(4):
                f[4 + c] = uvt[c]
                f[12 + c] = e[c]
            for c in range(2):
                f[8 + c] = ut[c]
                f[10 + c] = vt[c]
        for c in range(wp.static(noisy)):
            # Quantised maps are on their levels already; eq. 6 stands in for the rounding before that.
            noise = wp.where(batch.quantised == 0, (wp.randf(state) - 0.5) * 0.00390625, 0.0)
            f[c] = (f[c] + noise - 0.5) * 3.4641016151377544
        return f

    @wp.func
    def scatter(
        acc: wp.array2d[scalar],
        lane: int,
        offsets: Offsets,
        maps: Maps,
        batch: Batch,
        n: int,
        y: int,
        x: int,
        k: int,
        g: vec_in,
    ):
        c = 3.4641016151377544
        scatter_texel(acc, lane, offsets, maps, n, y, x, batch.quantised, c * wp.vec4(g[0], g[1], g[2], g[3]))
        if wp.static(temporal):
            u = (float(x) + 0.5) / 128.0
            v = (float(y) + 0.5) / 128.0
            tau = batch.tau[k]
            scatter_volume(
                acc,
                lane,
                offsets,
                maps,
                n,
                batch.slices,
                u,
                v,
                tau,
                batch.periodic,
                batch.quantised,
                c * wp.vec4(g[4], g[5], g[6], g[7]),
            )
            rows = maps.ut.shape[1]
            columns = maps.ut.shape[2]
            scatter_plane(
                acc, lane, offsets.ut, rows, columns, n, u, tau, batch.periodic, c * wp.vec2(g[8], g[9])
            )
            scatter_plane(
                acc, lane, offsets.vt, rows, columns, n, v, tau, batch.periodic, c * wp.vec2(g[10], g[11])
            )

    options = {"enable_backward": False, "enable_mathdx_gemm": False, "max_unroll": MAX_UNROLL}

    @wp.kernel(module="unique", module_options=options)
    def draw(
        # in:
        maps: Maps,
        batch: Batch,
        samples: int,
        # out:
        place: wp.array2d[wp.vec3i],
        f: wp.array2d[vec_in],
    ):
        n, b = wp.tid()
        state = draw_state(batch, n, b, samples)
        flat = batch.texels[n, wp.randi(state, 0, batch.texel_count[n])]
        k = wp.randi(state, 0, batch.tau.shape[0])
        place[n, b] = wp.vec3i(flat // 128, flat % 128, k)
        f[n, b] = features(maps, batch, n, flat // 128, flat % 128, k, state)

    if device_kind == "cpu":

        @wp.kernel(module="unique", module_options=options)
        def step(
            # in:
            maps: Maps,
            offsets: Offsets,
            w: wp.array2d[vec_hidden],
            o: wp.array2d[wp.vec3],
            batch: Batch,
            samples: int,
            base: int,
            # out:
            acc: wp.array2d[scalar],
            partial: wp.array3d[vec_hidden],
            partial_out: wp.array3d[wp.vec3],
            loss: wp.array2d[float],
        ):
            n, i = wp.tid()
            b = base + i
            lane = wp.where(base == 0, 0, 1)
            state = draw_state(batch, n, b, samples)
            flat = batch.texels[n, wp.randi(state, 0, batch.texel_count[n])]
            k = wp.randi(state, 0, batch.tau.shape[0])
            y = flat // 128
            x = flat % 128
            f = features(maps, batch, n, y, x, k, state)
            a1 = first(w, n, f)
            h1 = act(a1)
            a2 = second(w, n, h1)
            h2 = act(a2)
            target = batch.targets[n, k, flat]
            error = third(o, n, h2) - target
            d3 = wp.cw_mul(texel_weight(batch, n, k, target), error) / (3.0 * float(samples))
            loss[lane, n] += wp.dot(d3, error)
            d3 = 2.0 * d3
            d2 = wp.cw_mul(back_output(o, n, d3), act_slope(a2))
            d1 = wp.cw_mul(back_hidden(w, n, d2), act_slope(a1))
            for c in range(wp.static(inputs)):
                partial[lane, n, c] += d1 * f[c]
            partial[lane, n, wp.static(inputs)] += d1
            for c in range(wp.static(hidden)):
                partial[lane, n, wp.static(columns_2) + c] += d2 * h1[c]
                partial_out[lane, n, c] += d3 * h2[c]
            partial[lane, n, wp.static(columns_2 + hidden)] += d2
            partial_out[lane, n, wp.static(hidden)] += d3
            scatter(acc, lane, offsets, maps, batch, n, y, x, k, back_input(w, n, d1))

    else:

        @wp.kernel(module="unique", module_options=options, launch_bounds=LAUNCH_BOUNDS)
        def step(
            # in:
            maps: Maps,
            offsets: Offsets,
            w: wp.array2d[vec_hidden],
            o: wp.array2d[wp.vec3],
            batch: Batch,
            samples: int,
            base: int,
            # out:
            acc: wp.array2d[scalar],
            partial: wp.array2d[float],
            partial_out: wp.array2d[float],
            loss: wp.array1d[float],
        ):
            n, b = wp.tid()
            state = draw_state(batch, n, b, samples)
            flat = batch.texels[n, wp.randi(state, 0, batch.texel_count[n])]
            k = wp.randi(state, 0, batch.tau.shape[0])
            y = flat // 128
            x = flat % 128
            f = features(maps, batch, n, y, x, k, state)
            a1 = first(w, n, f)
            h1 = act(a1)
            a2 = second(w, n, h1)
            h2 = act(a2)
            target = batch.targets[n, k, flat]
            error = third(o, n, h2) - target
            d3 = wp.cw_mul(texel_weight(batch, n, k, target), error) / (3.0 * float(samples))
            value = wp.dot(d3, error)
            d3 = 2.0 * d3
            d2 = wp.cw_mul(back_output(o, n, d3), act_slope(a2))
            d1 = wp.cw_mul(back_hidden(w, n, d2), act_slope(a1))
            scatter(acc, 0, offsets, maps, batch, n, y, x, k, back_input(w, n, d1))

            # The networks' gradients: outer products summed over the block as small matrix products; the appended
            # 1 of each input gives the bias. Every block writes a row of its own.
            f1 = vec_in1()
            for c in range(wp.static(inputs)):
                f1[c] = f[c]
            f1[wp.static(inputs)] = 1.0
            h1b = vec_hidden1()
            h2b = vec_hidden1()
            for c in range(wp.static(hidden)):
                h1b[c] = h1[c]
                h2b[c] = h2[c]
            h1b[wp.static(hidden)] = 1.0
            h2b[wp.static(hidden)] = 1.0
            tiles = w.shape[0]
            row = (b // wp.static(BLOCK)) * tiles + n
            t1 = wp.tile_matmul(wp.tile(f1), wp.tile_transpose(wp.tile(d1)))
            wp.tile_store(partial, t1, offset=(row * wp.static(inputs + hidden + 2), 0))
            t2 = wp.tile_matmul(wp.tile(h1b), wp.tile_transpose(wp.tile(d2)))
            wp.tile_store(
                partial, t2, offset=(row * wp.static(inputs + hidden + 2) + wp.static(inputs + 1), 0)
            )
            t3 = wp.tile_matmul(wp.tile(h2b), wp.tile_transpose(wp.tile(d3)))
            wp.tile_store(partial_out, t3, offset=(row * wp.static(hidden + 1), 0))
            wp.tile_store(loss, wp.tile_sum(wp.tile(value)), offset=row)

    return StepKernels(inputs, hidden, device_kind, net, scalar, draw, step)


@wp.kernel(enable_backward=False)
def _gather_maps_cpu(
    # in and out:
    acc: wp.array2d[float],
    parameters: wp.array1d[float],
    # out:
    grad: wp.array1d[float],
):
    i = wp.tid()
    s = float(0.0)
    for lane in range(acc.shape[0]):
        s += acc[lane, i]
        acc[lane, i] = 0.0
    grad[i] = s
    parameters[i] = wp.clamp(parameters[i], 0.0, 1.0)


@wp.kernel(enable_backward=False)
def _gather_maps_cuda(
    # in and out:
    acc: wp.array2d[wp.int64],
    parameters: wp.array1d[float],
    # out:
    grad: wp.array1d[float],
):
    i = wp.tid()
    grad[i] = float(acc[0, i]) * 9.094947017729282e-13
    acc[0, i] = wp.int64(0)
    parameters[i] = wp.clamp(parameters[i], 0.0, 1.0)


@wp.kernel(enable_backward=False)
def _gather_net(
    # in and out:
    partial: wp.array2d[float],
    partial_out: wp.array2d[float],
    loss: wp.array2d[float],
    clear: int,
    schedule: wp.array1d[float],
    first_rates: wp.vec2,
    control: wp.array1d[int],
    # out:
    grad: wp.array1d[float],
    grad_out: wp.array1d[float],
    mean_loss: wp.array1d[float],
    rates: wp.array1d[float],
):
    i = wp.tid()
    parts = partial.shape[0]
    if i < grad.shape[0]:
        s = float(0.0)
        for p in range(parts):
            s += partial[p, i]
            if clear != 0:
                partial[p, i] = 0.0
        grad[i] = s
    if i < grad_out.shape[0]:
        s = float(0.0)
        for p in range(parts):
            s += partial_out[p, i]
            if clear != 0:
                partial_out[p, i] = 0.0
        grad_out[i] = s
    if i < mean_loss.shape[0]:
        s = float(0.0)
        for p in range(parts):
            s += loss[p, i]
            if clear != 0:
                loss[p, i] = 0.0
        mean_loss[i] = mean_loss[i] + (s - mean_loss[i]) * 0.02  # a running mean over about 50 steps
    if i == 0:
        share = schedule[wp.min(control[0], schedule.shape[0] - 1)]
        rates[0] = share * first_rates[0]
        rates[1] = share * first_rates[1]
        control[0] = control[0] + 1


def gather(
    acc,
    parameters,
    grad,
    partial,
    partial_out,
    loss,
    schedule,
    first_rates,
    control,
    grad_net,
    grad_out,
    mean_loss,
    rates,
):
    """Turns what ``StepKernels.launch`` left into gradients, clears it, and moves on by one step.

    Args:
        acc: [lanes, M], the maps' sums; cleared.
        parameters: float [M], the maps; put back into [0, 1].
        grad: float [M], written.
        partial, partial_out, loss: The networks' sums as float [P, ...]; cleared on the CPU.
        schedule: float [steps], share of the first learning rates at each step.
        first_rates: The first learning rates of the maps and of the networks.
        control: int [1], the step; increased.
        grad_net, grad_out: float, the networks' gradients, written.
        mean_loss: float [N], running mean of each tile's loss, updated.
        rates: float [2], the learning rates of this step, written.
    """
    device = parameters.device
    on_cpu = device.is_cpu
    kernel = _gather_maps_cpu if on_cpu else _gather_maps_cuda
    wp.launch(kernel, parameters.shape, inputs=[acc, parameters], outputs=[grad], device=device)
    dim = max(grad_net.shape[0], grad_out.shape[0], mean_loss.shape[0])
    wp.launch(
        _gather_net,
        dim,
        inputs=[partial, partial_out, loss, int(on_cpu), schedule, wp.vec2(*first_rates), control],
        outputs=[grad_net, grad_out, mean_loss, rates],
        device=device,
    )
