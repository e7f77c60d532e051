"""Decodes pages as `pages` does, on a GPU's matrix units (tensor cores), for hidden widths that are multiples of 16.

A thread reads one sample of a texel. Neighbouring threads read the samples of a texel of a mip, since one page alone
would not keep the GPU busy. The threads of a warp evaluate their networks together. A block decodes texels of one page;
`Jobs.first` has the first block of each page.

Read first: `pages`.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.lightmap.blocks import stored_texel
from wlm_kernels.lightmap.frames import StoredFrames
from wlm_kernels.lightmap.matrix_decode import Maps, map_inputs, matrix_texels
from wlm_kernels.lightmap.pages import (
    BLOCK,
    COARSE_TEXELS,
    TAU,
    WEIGHT,
    Jobs,
    Mapped,
    Tiles,
    encoding_of,
    kind_of,
    light_of,
    sample_at,
    samples_of,
    square_of,
    stored_light,
    texel_of,
)
from wlm_kernels.native import on_cuda
from wlm_kernels.shared_exponent import pack_rgb9e5

_BLOCK, _COARSE_TEXELS = wp.constant(BLOCK), wp.constant(COARSE_TEXELS)
_TAU, _WEIGHT = wp.constant(TAU), wp.constant(WEIGHT)
_STATIC, _DYNAMIC = wp.constant(2), wp.constant(3)  # of `wlm.lightmap.tiles.TileKind`


@wp.func
def blocks_of(level: int, texels: int) -> int:
    """Returns the blocks that a page needs: a thread for each sample of a texel, or for each texel of coarse texels."""
    return (texels * samples_of(level) + _BLOCK - 1) // _BLOCK


@wp.func_native(on_cuda("return __any_sync(~0u, x);\n", "return x;"))
def _any_of_warp(x: int) -> int:
    """Returns another number than 0 if `x` is one in a thread of the warp, whose threads must all call it."""
    ...


@wp.func_native(
    on_cuda(
        """
const unsigned votes = __ballot_sync(~0u, x) >> (threadIdx.x & 31 & -size);
return __popc(votes & ((1u << size) - 1u));
""",
        "return x;",
    )
)
def _count_of_group(x: int, size: int) -> int:
    """Returns in how many threads of a group `x` is not 0: of `size` neighbours, 1, 2, 4, 8 or 16."""
    ...


@wp.func_native(
    on_cuda(
        """
wp::vec_t<3, float> sum = x;
for (int step = 1; step < size; step *= 2)
    for (int c = 0; c < 3; ++c) sum[c] += __shfl_xor_sync(~0u, sum[c], step);
return sum;
""",
        "return x;",
    )
)
def _sum_of_group(x: wp.vec3, size: int) -> wp.vec3:
    """Returns the sum of a group's vectors, see `_count_of_group`."""
    ...


@functools.cache
def page_kernel(hidden: int) -> wp.Kernel:
    """Builds (once) the kernel that decodes squares of texels, for networks of one hidden width, a multiple of 16.

    The two arrays of the networks are those of `matrix_decode.pack_biases` and `pack_networks`, for static tiles with
    weights of 0 for the inputs that they lack. GELU is its tanh form.
    """
    evaluate, vec_hidden = matrix_texels(hidden), wp.types.vector(hidden, float)

    def build(temporal: bool) -> Any:
        @wp.func
        def light(
            mapped: Mapped,
            biases: wp.array2d[vec_hidden],
            packed: wp.array2d[wp.uint32],
            clock: wp.array2d[float],
            target: int,
            gamma: float,
            n: int,
            y: int,
            x: int,
        ) -> wp.vec3:
            light = wp.vec3()
            two = int(2)  # a variable keeps the loop rolled
            for r in range(two):
                weight = clock[target, _WEIGHT + r]
                f = Maps()
                number = int(-1)
                if n >= 0 and weight > 0.0:
                    number = n
                    if wp.static(temporal):
                        f = map_inputs(mapped.stored, n, clock[target, _TAU + r], y, x)
                    else:
                        uv = stored_texel(mapped.stored.uv, n, y, x)
                        for c in range(4):
                            f[c] = uv[c] * 255.0 - 128.0
                out = evaluate(packed, biases, f, encoding_of(clock, target, r), number, 2 * target + r)
                if number >= 0:
                    light += weight * light_of(mapped, clock, target, r, n, gamma, out)
            return light

        return light

    moving_light, still_light = build(True), build(False)

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def decode_pages(
        # in:
        tiles: Tiles,
        moving: Mapped,
        moving_biases: wp.array2d[vec_hidden],
        moving_packed: wp.array2d[wp.uint32],
        still: Mapped,
        still_biases: wp.array2d[vec_hidden],
        still_packed: wp.array2d[wp.uint32],
        frames: StoredFrames,
        clock: wp.array2d[float],
        offsets: wp.array1d[wp.vec2i],
        jobs: Jobs,
        direct: int,
        # out:
        out: wp.array3d[wp.uint32],
    ):
        thread = wp.tid()
        block = thread // _BLOCK
        count = jobs.slot.shape[0]
        if block >= jobs.first[count]:
            return
        k = int(0)
        beyond = int(count)
        while beyond - k > 1:
            middle = (k + beyond) // 2
            if jobs.first[middle] <= block:
                k = middle
            else:
                beyond = middle
        square = square_of(tiles, jobs, k, direct)
        if square.slot < 0:
            return
        target = jobs.target[k]
        gamma = tiles.gamma[square.sheet]
        samples = 1 << (2 * square.bits)
        shift = 2 * square.bits
        turns = int(1)
        if square.depth < square.level:  # coarse texels are quick to read: a thread reads all
            shift = 0
            turns = samples
        threads = 1 << shift
        edge = out.shape[1]
        flat = (thread - jobs.first[k] * _BLOCK) >> shift
        inside = flat < edge * edge
        own = thread & (threads - 1)
        i = flat // edge
        j = flat % edge
        start = texel_of(square, jobs.place[k], i, j)
        # The first offset at which a sample of the texel is valid.
        at = wp.vec3i(-1, 0, 0)
        o = int(0)
        found = int(0)
        if not inside:
            found = 1
        while _any_of_warp(1 - found) != 0 and o < offsets.shape[0]:
            near = wp.vec3i(-1, 0, 0)
            if found == 0:
                for turn in range(turns):
                    if near[0] < 0:
                        near = sample_at(tiles, square, own + turn, start + offsets[o])
            valid = int(0)
            if near[0] >= 0:
                valid = 1
            if _count_of_group(valid, threads) > 0 and found == 0:
                found = 1
                at = near
                start = start + offsets[o]
            o += 1
        light = wp.vec3()
        number = int(0)
        n_moving = int(-1)
        n_still = int(-1)
        if at[0] >= 0:
            number = 1
            kind = kind_of(tiles, square, at[0])
            if kind == _DYNAMIC:
                n_moving = tiles.slot[at[0]]
            elif kind == _STATIC:
                n_still = tiles.slot[at[0]]
            elif square.depth == square.level:
                light = stored_light(tiles, frames, clock, target, gamma, kind, at)
            else:
                number = int(0)
                for turn in range(turns):
                    each = sample_at(tiles, square, turn, start)
                    if each[0] >= 0:
                        number += 1
                        light += stored_light(tiles, frames, clock, target, gamma, _COARSE_TEXELS, each)
        light += moving_light(moving, moving_biases, moving_packed, clock, target, gamma, n_moving, at[1], at[2])
        light += still_light(still, still_biases, still_packed, clock, target, gamma, n_still, at[1], at[2])
        total = _sum_of_group(light, threads)
        valid_samples = number
        if threads > 1:
            valid_samples = _count_of_group(number, threads)
        if inside and own == 0:
            out[square.slot, i, j] = pack_rgb9e5(total / float(wp.max(valid_samples, 1)))

    return decode_pages
