"""Decodes tiles of a lightmap over time from their stored bytes: BC7 blocks, 8-bit planes and a small MLP.

`exact_kernel` evaluates one texel per thread, in the same order of operations as training. `matrix_network` is faster,
on a GPU's matrix units.

Read `benchmarks/lightmap_exact.py` first; it has the same decode in NumPy. `features` describes the maps F_uv to F_vt.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels import mlp
from wlm_kernels.interpolate import axis_index, cell, fraction
from wlm_kernels.lightmap.blocks import stored_texel
from wlm_kernels.lightmap.features import CENTRE, INPUTS, MAP_INPUTS, powers


@wp.struct
class Stored:
    """The stored feature maps of N tiles (see `features`), with S slices in F_uvt."""

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
def finish_radiance(time: TimeState, n: int, y: wp.vec3) -> wp.vec3:
    """Converts the output y of tile n's network to linear radiance, at least 0."""
    c = wp.max(wp.cw_mul(time.shift[n] + wp.cw_mul(time.spread[n], y), time.scale[n]), wp.vec3())
    return powers(c, time.gamma)


@functools.cache
def texel_network(hidden: int, gelu: str) -> Any:
    """Builds (once) the `wp.func` that evaluates the network of tile n at its texel (y, x), for the arguments of
    `exact_kernel`: network_output(stored, hidden, output, tau, encoding, n, y, x), a vec3. `tau` is the position on
    the time axis, and `encoding`, vec4, the encoded time."""
    net = mlp.kernels(INPUTS, hidden, gelu)
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
        for c in range(wp.static(MAP_INPUTS)):
            f[c] = (f[c] + 0.0 - 0.5) * CENTRE
        return third(output, n, act(second(hidden, n, act(first(hidden, n, f)))))

    return network_output


@functools.cache
def exact_kernel(hidden: int, gelu: str) -> wp.Kernel:
    """Builds (once) the kernel that decodes whole tiles, one texel per thread.

    Args:
        hidden: H, width of the hidden layers.
        gelu: One of `mlp.GELUS`.

    Returns:
        A kernel that writes linear radiance, vec3 [n, 128, 128]. Its inputs are `Stored`; hidden layers, vecH
        [N, 18 + H]; output layers, vec3 [N, H + 1]; `TimeState`; and int [n], the tiles to decode.
    """
    vec_hidden, network_output = wp.types.vector(hidden, float), texel_network(hidden, gelu)

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def decode(
        # in:
        stored: Stored,
        hidden: wp.array2d[vec_hidden],
        output: wp.array2d[wp.vec3],
        time: TimeState,
        tiles: wp.array1d[int],
        # out:
        out: wp.array3d[wp.vec3],
    ):
        i, y, x = wp.tid()
        n = tiles[i]
        texel = network_output(stored, hidden, output, time.tau, time.encoding, n, y, x)
        out[i, y, x] = finish_radiance(time, n, texel)

    return decode
