"""Decodes tiles of a lightmap over time from their stored bytes: BC7 blocks, 8-bit planes and a small MLP.

`exact_kernels` evaluates one texel per thread, in the same order of operations as training. `strip_kernels` is faster,
for use at run time: it computes once what all texels of a frame share (F_uvt interpolated between two slices, and for
each column the contribution of F_ut and the encoded time to the first layer), and a thread decodes four texels, so that
each weight is loaded once for four texels.

Read `benchmarks/lightmap_exact.py` first; it has the same decode in NumPy. `features` describes the maps F_uv to F_vt.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels import mlp
from wlm_kernels.interpolate import axis_index, cell, fraction
from wlm_kernels.lightmap.blocks import bits7, byte_mix, index_level, stored_texel
from wlm_kernels.lightmap.features import CENTRE, STATIC_INPUTS, TEMPORAL_INPUTS
from wlm_kernels.shared_exponent import pack_rgb9e5


@wp.struct
class Stored:
    """The stored feature maps of N tiles (see `features`), with S slices in F_uvt. In static tiles all arrays but `uv`
    are empty."""

    uv: wp.array4d[wp.uint64]  # [N, 32, 32, 2]
    uvt: wp.array4d[wp.uint64]  # [N * S, R/4, R/4, 2]
    ut: wp.array3d[wp.vec2ub]  # [N, rows of time, columns]
    vt: wp.array3d[wp.vec2ub]  # [N, rows of time, columns]
    slices: int
    periodic: int


@wp.struct
class TimeState:
    """A time, and numbers that convert the output y of each tile's network to colour: (shift + spread y) scale."""

    tau: float
    encoding: wp.vec4
    gamma: float
    scale: wp.array1d[wp.vec3]  # [N] mean of each channel at this time
    inverse_peak: wp.array1d[float]  # [N] 1 / the bound of the tile at this time; 0 for a black one
    shift: wp.array1d[wp.vec3]  # [N]
    spread: wp.array1d[wp.vec3]  # [N]


@wp.func
def stored_plane(plane: wp.array3d[wp.vec2ub], n: int, t: int, x: int) -> wp.vec2:
    v = plane[n, t, x]
    return wp.vec2(float(v[0]) / 255.0, float(v[1]) / 255.0)


@wp.func
def stored_plane_at(plane: wp.array3d[wp.vec2ub], n: int, p: float, tau: float, periodic: int) -> wp.vec2:
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
    early = (1.0 - fx) * stored_plane(plane, n, ta, xa) + fx * stored_plane(plane, n, ta, xb)
    late = (1.0 - fx) * stored_plane(plane, n, tb, xa) + fx * stored_plane(plane, n, tb, xb)
    return (1.0 - ft) * early + ft * late


@wp.func
def stored_volume_at(stored: Stored, n: int, u: float, v: float, tau: float) -> wp.vec4:
    height = stored.uvt.shape[1] * 4
    width = stored.uvt.shape[2] * 4
    x = cell(u, width)
    y = cell(v, height)
    t = cell(tau, stored.slices)
    fx = fraction(u, width)
    fy = fraction(v, height)
    ft = fraction(tau, stored.slices)
    f = wp.vec4()
    for k in range(2):
        s = n * stored.slices + axis_index(t + k, stored.slices, stored.periodic)
        ct = wp.where(k == 0, 1.0 - ft, ft)
        for j in range(2):
            yy = axis_index(y + j, height, 0)
            cy = ct * wp.where(j == 0, 1.0 - fy, fy)
            for i in range(2):
                xx = axis_index(x + i, width, 0)
                c = cy * wp.where(i == 0, 1.0 - fx, fx)
                f += c * stored_texel(stored.uvt, s, yy, xx)
    return f


@wp.func
def finish_colour(time: TimeState, n: int, y: wp.vec3) -> wp.vec3:
    """Converts the output y of tile n's network to colour in gamma space, clamped to at least 0."""
    c = wp.cw_mul(time.shift[n] + wp.cw_mul(time.spread[n], y), time.scale[n])
    return wp.vec3(wp.max(c[0], 0.0), wp.max(c[1], 0.0), wp.max(c[2], 0.0))


@wp.func
def finish_radiance(time: TimeState, n: int, y: wp.vec3) -> wp.vec3:
    c = finish_colour(time, n, y)
    return wp.vec3(wp.pow(c[0], time.gamma), wp.pow(c[1], time.gamma), wp.pow(c[2], time.gamma))


@wp.func
def pack(v: wp.vec4ub) -> wp.uint32:
    return (
        wp.uint32(v[0])
        | wp.lshift(wp.uint32(v[1]), wp.uint32(8))
        | wp.lshift(wp.uint32(v[2]), wp.uint32(16))
        | wp.lshift(wp.uint32(v[3]), wp.uint32(24))
    )


@wp.func
def finish_byte(c: float, inverse_peak: float) -> wp.uint8:
    return wp.uint8(int(wp.clamp(c * inverse_peak, 0.0, 1.0) * 255.0 + 0.5))


@wp.func
def bytes_over(colour: wp.vec3, inverse_bound: float) -> wp.uint32:
    """Packs colour * `inverse_bound`, clamped to [0, 1], as 8-bit RGBA with R in the lowest byte; alpha is 255."""
    r = finish_byte(colour[0], inverse_bound)
    g = finish_byte(colour[1], inverse_bound)
    b = finish_byte(colour[2], inverse_bound)
    return pack(wp.vec4ub(r, g, b, wp.uint8(255)))


@wp.func
def finish_bytes(time: TimeState, n: int, y: wp.vec3) -> wp.uint32:
    """Converts the network's output y to 8-bit RGBA: gamma-space colour / the tile's largest colour; alpha is 255."""
    return bytes_over(finish_colour(time, n, y), time.inverse_peak[n])


@wp.func
def finish_shared(time: TimeState, n: int, y: wp.vec3) -> wp.uint32:
    """Converts the network's output y to linear radiance packed as RGB9E5."""
    return pack_rgb9e5(finish_radiance(time, n, y))


def finish_words(shared: bool) -> Any:
    """Returns the `wp.func` that packs a network's output: `finish_shared` (RGB9E5) or `finish_bytes` (8-bit RGBA)."""
    return finish_shared if shared else finish_bytes


@functools.cache
def texel_network(temporal: bool, hidden: int, gelu: str) -> Any:
    """Builds (once) the `wp.func` that evaluates the network of tile n at its texel (y, x), for the arguments of
    `exact_kernels`: network_output(stored, hidden, output, tau, encoding, n, y, x), a vec3. `tau` is the position on
    the time axis, and `encoding`, vec4, the encoded time."""
    inputs = TEMPORAL_INPUTS if temporal else STATIC_INPUTS
    centred = 12 if temporal else 4
    net = mlp.kernels(inputs, hidden, gelu)
    vec_in, vec_hidden = net.vec_in, net.vec_hidden
    first, second, third, act = net.first, net.second, net.third, net.act

    @wp.func
    def network_output(
        stored: Stored,
        hidden: wp.array2d[vec_hidden],
        output: wp.array2d[wp.vec3],
        tau: float,
        encoding: wp.vec4,
        n: int,
        y: int,
        x: int,
    ) -> wp.vec3:
        f = vec_in()
        uv = stored_texel(stored.uv, n, y, x)
        for c in range(4):
            f[c] = uv[c]
        if wp.static(temporal):
            u = (float(x) + 0.5) / 128.0
            v = (float(y) + 0.5) / 128.0
            uvt = stored_volume_at(stored, n, u, v, tau)
            ut = stored_plane_at(stored.ut, n, u, tau, stored.periodic)
            vt = stored_plane_at(stored.vt, n, v, tau, stored.periodic)
            for c in range(4):
                f[4 + c] = uvt[c]
                f[12 + c] = encoding[c]
            for c in range(2):
                f[8 + c] = ut[c]
                f[10 + c] = vt[c]
        for c in range(wp.static(centred)):
            f[c] = (f[c] + 0.0 - 0.5) * CENTRE
        return third(output, n, act(second(hidden, n, act(first(hidden, n, f)))))

    return network_output


@functools.cache
def exact_kernels(temporal: bool, hidden: int, gelu: str) -> tuple[Any, Any, Any]:
    """Builds (once) three kernels that decode whole tiles, one texel per thread.

    Args:
        temporal: Whether the tiles have the temporal maps F_uvt, F_ut and F_vt.
        hidden: H, width of the hidden layers.
        gelu: One of `mlp.GELUS`.

    Returns:
        Kernels that write, in this order, linear radiance as vec3; gamma-space colour as uint32, 8-bit RGBA from the
        lowest byte; and linear radiance as uint32, RGB9E5. Their inputs are `Stored`; hidden layers, vecH
        [N, I + H + 2] with I inputs; output layers, vec3 [N, H + 1]; `TimeState`; int [N], the index of each tile in
        `TimeState`; and int [n], the tiles to decode. Their output is [n, 128, 128].
    """
    net = mlp.kernels(TEMPORAL_INPUTS if temporal else STATIC_INPUTS, hidden, gelu)
    vec_hidden, network_output = net.vec_hidden, texel_network(temporal, hidden, gelu)

    def decode_kernel(dtype: Any, finish: Any) -> wp.Kernel:
        @wp.kernel(module="unique", module_options={"enable_backward": False})
        def decode(
            # in:
            stored: Stored,
            hidden: wp.array2d[vec_hidden],
            output: wp.array2d[wp.vec3],
            time: TimeState,
            places: wp.array1d[int],
            tiles: wp.array1d[int],
            # out:
            out: wp.array3d[dtype],
        ):
            i, y, x = wp.tid()
            n = tiles[i]
            texel = network_output(stored, hidden, output, time.tau, time.encoding, n, y, x)
            out[i, y, x] = finish(time, places[n], texel)

        return decode

    words = (decode_kernel(wp.uint32, finish_words(shared)) for shared in (False, True))
    return decode_kernel(wp.vec3, finish_radiance), *words


@wp.kernel(enable_backward=False)
def frame_volume(
    # in:
    stored: Stored,
    tau: float,
    # out:
    volume: wp.array3d[wp.vec4],
):
    """Writes F_uvt at the time `tau` to `volume` [N, R, R], scaled as an input of the network; see `features`."""
    n, y, x = wp.tid()
    t = cell(tau, stored.slices)
    ft = fraction(tau, stored.slices)
    sa = n * stored.slices + axis_index(t, stored.slices, stored.periodic)
    sb = n * stored.slices + axis_index(t + 1, stored.slices, stored.periodic)
    f = (1.0 - ft) * stored_texel(stored.uvt, sa, y, x) + ft * stored_texel(stored.uvt, sb, y, x)
    volume[n, y, x] = (f - wp.vec4(0.5)) * CENTRE


@dataclass(frozen=True)
class FastKernels:
    """Kernels of a fast decoder for networks with H units in each hidden layer; see `decode`."""

    _lines: Any  # writes `columns` and `rows`
    _decode: Any

    def decode(
        self,
        stored: Stored,
        hidden: wp.array,
        output: wp.array,
        time: TimeState,
        volume: wp.array,
        columns: wp.array,
        rows: wp.array,
        places: wp.array,
        tiles: wp.array,
        out: wp.array,
    ) -> None:
        """Decodes n of N tiles at one time to 32 bits per texel.

        Args:
            stored: The N tiles, all with temporal maps.
            hidden: vecH [N, I + H + 2], hidden layers with H units and I inputs, see `wlm_kernels.mlp`.
            output: vec3 [N, H + 1], output layers.
            time: The time, and the numbers that convert the networks' outputs to colour.
            volume: vec4 [N, R, R], scratch memory: F_uvt of all N tiles.
            columns: float [N, H, 128], scratch memory: each column's part of the first layer.
            rows: vec2 [N, 128], scratch memory: F_vt of each row.
            places: int [N], index of each tile in `time`.
            tiles: int [n], the tiles to decode.
            out: uint32 [n, 128, 128], written: colour as 8-bit RGBA from the lowest byte, or radiance as RGB9E5.
        """
        device = out.device
        wp.launch(frame_volume, volume.shape, inputs=[stored, time.tau], outputs=[volume], device=device)
        wp.launch(self._lines, rows.shape, inputs=[stored, hidden, time], outputs=[columns, rows], device=device)
        wp.launch(
            self._decode,
            (out.shape[0], 32, 128),
            inputs=[stored, hidden, output, time, volume, columns, rows, places, tiles],
            outputs=[out],
            device=device,
            block_dim=128,
        )


@wp.func
def centred_texel(a: wp.vec4, b: wp.vec4, high: wp.uint64, i: int) -> wp.vec4:
    """Returns texel i of a BC7 block, scaled as an input of the network. `a` and `b` are the bytes of the block's
    endpoints; `high` is its upper half, which contains the texels' indices."""
    index = int(wp.rshift(high, wp.uint64(4 * i)) & wp.uint64(15))
    if i == 0:
        index = int(wp.rshift(high, wp.uint64(1)) & wp.uint64(7))
    k = float(index_level(index))
    f = wp.vec4(byte_mix(a[0], b[0], k), byte_mix(a[1], b[1], k), byte_mix(a[2], b[2], k), byte_mix(a[3], b[3], k))
    return f * 0.013584712361323677 - wp.vec4(1.7320508075688772)  # (f / 255 - 1/2) sqrt(12)


@wp.func
def frame_volume_at(volume: wp.array3d[wp.vec4], n: int, y: int, x: int) -> wp.vec4:
    size = volume.shape[1]
    u = (float(x) + 0.5) / 128.0
    v = (float(y) + 0.5) / 128.0
    x0 = cell(u, size)
    y0 = cell(v, size)
    fx = fraction(u, size)
    fy = fraction(v, size)
    xa = wp.max(x0, 0)
    xb = wp.min(x0 + 1, size - 1)
    ya = wp.max(y0, 0)
    yb = wp.min(y0 + 1, size - 1)
    top = (1.0 - fx) * volume[n, ya, xa] + fx * volume[n, ya, xb]
    bottom = (1.0 - fx) * volume[n, yb, xa] + fx * volume[n, yb, xb]
    return (1.0 - fy) * top + fy * bottom


STRIP_BOUNDS = (128, 3)  # threads of a block, blocks of a multiprocessor: 168 registers per thread, no spills


@functools.cache
def strip_kernels(hidden: int, gelu: str, shared: bool = False) -> FastKernels:
    """Builds (once) the fast decoder of tiles with temporal maps, for networks of one hidden width.

    Args:
        hidden: H, width of the hidden layers.
        gelu: One of `mlp.GELUS`.
        shared: Whether to write RGB9E5 instead of 8-bit RGBA.
    """
    net = mlp.kernels(TEMPORAL_INPUTS, hidden, gelu)
    finish = finish_words(shared)
    units, vec_hidden, act = net.hidden, net.vec_hidden, net.act
    options = {"enable_backward": False}

    @wp.kernel(module="unique", module_options=options)
    def frame_lines(
        # in:
        stored: Stored,
        hidden: wp.array2d[vec_hidden],
        time: TimeState,
        # out:
        columns: wp.array3d[float],
        rows: wp.array2d[wp.vec2],
    ):
        """Writes to `columns` what F_ut, the time and the bias add to the first layer in each column, and to `rows`
        F_vt of each row, scaled as an input of the network."""
        n, i = wp.tid()
        p = (float(i) + 0.5) / 128.0
        ut = stored_plane_at(stored.ut, n, p, time.tau, stored.periodic)
        vt = stored_plane_at(stored.vt, n, p, time.tau, stored.periodic)
        h = hidden[n, 16]
        for c in range(4):
            h += hidden[n, 12 + c] * time.encoding[c]
        for c in range(2):
            h += hidden[n, 8 + c] * ((ut[c] - 0.5) * CENTRE)
        for j in range(wp.static(units)):
            columns[n, j, i] = h[j]
        rows[n, i] = (vt - wp.vec2(0.5)) * CENTRE

    @wp.kernel(module="unique", module_options=options, launch_bounds=STRIP_BOUNDS)
    def decode(
        # in:
        stored: Stored,
        hidden: wp.array2d[vec_hidden],
        output: wp.array2d[wp.vec3],
        time: TimeState,
        volume: wp.array3d[wp.vec4],
        columns: wp.array3d[float],
        rows: wp.array2d[wp.vec2],
        places: wp.array1d[int],
        tiles: wp.array1d[int],
        # out:
        out: wp.array3d[wp.uint32],
    ):
        """Decodes a column of four texels per thread; the threads of a warp are neighbours in x."""
        i, block, x = wp.tid()
        n = tiles[i]
        place = places[n]
        y = block * 4
        low = stored.uv[n, block, x // 4, 0]
        high = stored.uv[n, block, x // 4, 1]
        p0 = float(int(wp.rshift(low, wp.uint64(63))))
        p1 = float(int(high & wp.uint64(1)))
        a = wp.vec4(bits7(low, 7), bits7(low, 21), bits7(low, 35), bits7(low, 49)) * 2.0 + wp.vec4(p0)
        b = wp.vec4(bits7(low, 14), bits7(low, 28), bits7(low, 42), bits7(low, 56)) * 2.0 + wp.vec4(p1)
        at = x % 4
        f0 = centred_texel(a, b, high, at)
        f1 = centred_texel(a, b, high, at + 4)
        f2 = centred_texel(a, b, high, at + 8)
        f3 = centred_texel(a, b, high, at + 12)
        h0 = vec_hidden()
        for j in range(wp.static(units)):
            h0[j] = columns[n, j, x]
        h1 = h0
        h2 = h0
        h3 = h0
        for c in range(4):
            column = hidden[n, c]
            h0 += column * f0[c]
            h1 += column * f1[c]
            h2 += column * f2[c]
            h3 += column * f3[c]
        f0 = frame_volume_at(volume, n, y, x)
        f1 = frame_volume_at(volume, n, y + 1, x)
        f2 = frame_volume_at(volume, n, y + 2, x)
        f3 = frame_volume_at(volume, n, y + 3, x)
        for c in range(4):
            column = hidden[n, 4 + c]
            h0 += column * f0[c]
            h1 += column * f1[c]
            h2 += column * f2[c]
            h3 += column * f3[c]
        r0 = rows[n, y]
        r1 = rows[n, y + 1]
        r2 = rows[n, y + 2]
        r3 = rows[n, y + 3]
        for c in range(2):
            column = hidden[n, 10 + c]
            h0 += column * r0[c]
            h1 += column * r1[c]
            h2 += column * r2[c]
            h3 += column * r3[c]
        h0 = act(h0)
        h1 = act(h1)
        h2 = act(h2)
        h3 = act(h3)
        k0 = hidden[n, wp.static(17 + units)]
        k1 = k0
        k2 = k0
        k3 = k0
        for c in range(wp.static(units)):
            column = hidden[n, 17 + c]
            k0 += column * h0[c]
            k1 += column * h1[c]
            k2 += column * h2[c]
            k3 += column * h3[c]
        k0 = act(k0)
        k1 = act(k1)
        k2 = act(k2)
        k3 = act(k3)
        y0 = output[n, wp.static(units)]
        y1 = y0
        y2 = y0
        y3 = y0
        for c in range(wp.static(units)):
            colour = output[n, c]
            y0 += colour * k0[c]
            y1 += colour * k1[c]
            y2 += colour * k2[c]
            y3 += colour * k3[c]
        out[i, y, x] = finish(time, place, y0)
        out[i, y + 1, x] = finish(time, place, y1)
        out[i, y + 2, x] = finish(time, place, y2)
        out[i, y + 3, x] = finish(time, place, y3)

    return FastKernels(frame_lines, decode)
