"""Decodes tiles with temporal maps and at least 32 hidden units on a GPU's matrix units (tensor cores).

Activations and weights are half floats, sums are float32, and GELU is its tanh approximation with the GPU's tanh
instruction. A thread decodes eight texels of a column one after another, so that a block of threads loads its tile's
weights once for 1,024 texels.

Read first: `exact_kernels` in `wlm_kernels/lightmap/decode.py`.
"""

import functools

import warp as wp

from wlm_kernels.lightmap.blocks import bits7
from wlm_kernels.lightmap.decode import (
    FastKernels,
    Stored,
    TimeState,
    centred_texel,
    finish_words,
    frame_volume_at,
    stored_plane_at,
)
from wlm_kernels.lightmap.features import CENTRE, TEMPORAL_INPUTS
from wlm_kernels.native import native_source, on_cuda

ROWS = 8
"""Number of texels per thread."""

_STEP = 16  # size of a matrix product: the hidden width is a multiple of it


@wp.kernel(enable_backward=False)
def _frame_planes(
    # in:
    stored: Stored,
    tau: float,
    # out:
    ut: wp.array2d[wp.vec2],
    vt: wp.array2d[wp.vec2],
):
    """Writes F_ut and F_vt at the time `tau` to `ut` and `vt` [N, 128], scaled as inputs of the network."""
    n, i = wp.tid()
    p = (float(i) + 0.5) / 128.0
    half = wp.vec2(0.5)
    ut[n, i] = (stored_plane_at(stored.ut, n, p, tau, stored.periodic) - half) * CENTRE
    vt[n, i] = (stored_plane_at(stored.vt, n, p, tau, stored.periodic) - half) * CENTRE


@functools.cache
def matrix_kernels(hidden: int, shared: bool = False) -> FastKernels:
    """Builds (once) the decoder, whose networks are of half floats, for one hidden width.

    Args:
        hidden: H, width of the hidden layers, a multiple of 16.
        shared: Whether to write RGB9E5 instead of 8-bit RGBA.

    Raises:
        ValueError: The width is not a multiple of 16.
    """
    if hidden % _STEP or hidden < _STEP:
        raise ValueError(f"hidden: expected a width that is a multiple of {_STEP} units, got {hidden}")
    vec_in, vec_hidden = wp.types.vector(TEMPORAL_INPUTS, float), wp.types.vector(hidden, float)
    finish = finish_words(shared)
    constants = {"H": hidden, "NT": hidden // 8, "KT": hidden // _STEP}

    code = native_source(__package__, "matrix_units") + native_source(__package__, "matrix_forward", **constants)

    @wp.func_native(on_cuda(code, "return wp::vec_t<3, float>();"))
    def forward(
        hidden: wp.array2d[vec_hidden], output: wp.array2d[wp.vec3], n: int, fresh: int, f: vec_in
    ) -> wp.vec3: ...

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def decode(
        # in:
        stored: Stored,
        hidden: wp.array2d[vec_hidden],
        output: wp.array2d[wp.vec3],
        time: TimeState,
        volume: wp.array3d[wp.vec4],
        ut: wp.array2d[wp.vec2],
        vt: wp.array2d[wp.vec2],
        places: wp.array1d[int],
        tiles: wp.array1d[int],
        # out:
        out: wp.array3d[wp.uint32],
    ):
        i, part, x = wp.tid()
        n = tiles[i]
        place = places[n]
        across = ut[n, x]
        rows = int(wp.static(ROWS))  # a variable keeps the loop rolled
        for r in range(rows):
            y = part * wp.static(ROWS) + r
            low = stored.uv[n, y // 4, x // 4, 0]
            high = stored.uv[n, y // 4, x // 4, 1]
            p0 = float(int(wp.rshift(low, wp.uint64(63))))
            p1 = float(int(high & wp.uint64(1)))
            a = wp.vec4(bits7(low, 7), bits7(low, 21), bits7(low, 35), bits7(low, 49)) * 2.0 + wp.vec4(p0)
            b = wp.vec4(bits7(low, 14), bits7(low, 28), bits7(low, 42), bits7(low, 56)) * 2.0 + wp.vec4(p1)
            uv = centred_texel(a, b, high, (y % 4) * 4 + x % 4)
            uvt = frame_volume_at(volume, n, y, x)
            down = vt[n, y]
            f = vec_in()
            for c in range(4):
                f[c] = uv[c]
                f[4 + c] = uvt[c]
                f[12 + c] = time.encoding[c]
            for c in range(2):
                f[8 + c] = across[c]
                f[10 + c] = down[c]
            out[i, y, x] = finish(time, place, forward(hidden, output, n, wp.where(r == 0, 1, 0), f))

    return FastKernels(hidden, _frame_planes, decode, ROWS, False)
