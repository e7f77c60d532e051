"""Decodes pages as `pages` does, on a GPU's matrix units (tensor cores), for hidden widths that are multiples of 16.

Neighbouring threads, at most `GROUP`, share the samples of a texel of a mip, since one page alone would not keep the
GPU busy. The threads of a warp evaluate their networks together. A block decodes texels of one page; `Jobs.first` has
the first block of each page. `BLOCKS` blocks are launched and take turns, since a frame mostly needs none.

Read first: `pages`.
"""

import functools

import warp as wp

from wlm_kernels.lightmap.frames import StoredFrames
from wlm_kernels.lightmap.matrix_network import Maps, map_inputs, matrix_texels
from wlm_kernels.lightmap.pages import (
    BLOCK,
    TAU,
    Jobs,
    Mapped,
    Tiles,
    encoding_of,
    gap_light,
    kind_of,
    light_of,
    rows_of,
    sample_at,
    samples_of,
    search_of,
    square_of,
    stored_light,
    texel_of,
    weight_at,
    weight_of,
)
from wlm_kernels.native import on_cuda
from wlm_kernels.shared_exponent import pack_rgb9e5

BLOCKS = 528
"""Blocks of a launch."""

GROUP = 16
"""Most threads that share a texel."""

_BLOCK, _GROUP = wp.constant(BLOCK), wp.constant(GROUP)
_TAU = wp.constant(TAU)
_DYNAMIC = wp.constant(3)  # of `wlm.lightmap.tiles.TileKind`


@wp.func
def blocks_of(level: int, edge: int) -> int:
    """Returns the blocks that a part of a page needs, whose side with borders is `edge`."""
    threads = wp.min(samples_of(level), _GROUP)
    return (rows_of(level, edge) * edge * threads + _BLOCK - 1) // _BLOCK


@wp.func_native(on_cuda("return __any_sync(~0u, x);\n", "return x;"))
def _any_of_warp(x: int) -> int:
    """Returns another number than 0 if `x` is one in a thread of the warp, whose threads must all call it."""
    ...


@wp.func_native(
    on_cuda(
        """
wp::vec_t<4, float> sum = x;
for (int step = 1; step < size; step *= 2)
    for (int c = 0; c < 4; ++c) sum[c] += __shfl_xor_sync(~0u, sum[c], step);
return sum;
""",
        "return x;",
    )
)
def _sum_of_group(x: wp.vec4, size: int) -> wp.vec4:
    """Returns the sum of the vectors of `size` neighbouring threads, 1, 2, 4, 8 or 16; all of the warp must call it."""
    ...


@functools.cache
def page_kernel(hidden: int) -> wp.Kernel:
    """Builds (once) the kernel that decodes squares of texels, for networks of one hidden width, a multiple of 16. The
    two arrays of the networks are those of `matrix_network.pack_biases` and `pack_networks`. GELU is its tanh form."""
    evaluate, vec_hidden = matrix_texels(hidden), wp.types.vector(hidden, float)

    @wp.func
    def mapped_light(
        mapped: Mapped,
        biases: wp.array2d[vec_hidden],
        packed: wp.array2d[wp.uint32],
        clock: wp.array2d[float],
        target: int,
        lead: float,
        gamma: float,
        n: int,
        y: int,
        x: int,
    ) -> wp.vec3:
        light = wp.vec3()
        two = int(2)  # a variable keeps the loop rolled
        for r in range(two):
            weight = weight_at(clock, target, lead, r)
            f = Maps()
            number = int(-1)
            if n >= 0 and weight > 0.0:
                number = n
                f = map_inputs(mapped.stored, n, clock[target, _TAU + r], y, x)
            out = evaluate(packed, biases, f, encoding_of(clock, target, r), number, 2 * target + r)
            if number >= 0:
                light += weight * light_of(mapped, clock, target, r, n, gamma, out)
        return light

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def decode_pages(
        # in:
        tiles: Tiles,
        mapped: Mapped,
        biases: wp.array2d[vec_hidden],
        packed: wp.array2d[wp.uint32],
        frames: StoredFrames,
        clock: wp.array2d[float],
        offsets: wp.array1d[wp.vec2i],
        jobs: Jobs,
        direct: int,
        blocks: int,
        # out:
        out: wp.array3d[wp.uint32],
    ):
        thread = wp.tid()
        block = int(thread // _BLOCK)
        count = jobs.slot.shape[0]
        edge = out.shape[1]
        while block < jobs.first[count]:
            k = int(0)
            beyond = int(count)
            while beyond - k > 1:
                middle = (k + beyond) // 2
                if jobs.first[middle] <= block:
                    k = middle
                else:
                    beyond = middle
            square = square_of(tiles, jobs, k, direct, edge)
            if square.slot >= 0:
                target = jobs.target[k]
                lead = jobs.lead[k]
                gamma = tiles.gamma[square.sheet]
                threads = int(1)  # coarse texels are quick to read: a thread reads all
                if square.depth == square.level:
                    threads = wp.min(1 << (2 * square.depth), _GROUP)
                turns = (1 << (2 * square.depth)) // threads
                flat = ((block - jobs.first[k]) * _BLOCK + thread % _BLOCK) // threads
                own = thread % threads
                i = square.top + flat // edge
                j = flat % edge
                inside = i < square.bottom
                texel = texel_of(square, jobs.place[k], i, j)
                start, reach = search_of(tiles, square, texel, offsets.shape[0])
                # The first offset at which a sample of the texel is valid.
                o = int(0)
                found = int(0)
                if not inside:
                    found = 1
                while _any_of_warp(1 - found) != 0 and o < reach:
                    valid = float(0.0)
                    if found == 0:
                        for turn in range(turns):
                            if sample_at(tiles, square, own + turn * threads, start + offsets[o])[0] >= 0:
                                valid = 1.0
                    if _sum_of_group(wp.vec4(valid, 0.0, 0.0, 0.0), threads)[0] > 0.0 and found == 0:
                        found = 1
                        start = start + offsets[o]
                    o += 1
                total = wp.vec4()
                for turn in range(turns):
                    at = wp.vec3i(-1, 0, 0)
                    if inside:
                        at = sample_at(tiles, square, own + turn * threads, start)
                    n = int(-1)
                    light = wp.vec3()
                    weight = float(0.0)
                    if at[0] >= 0:
                        weight = weight_of(tiles, square, at)
                        kind = kind_of(tiles, square, at[0])
                        if kind == _DYNAMIC:
                            n = tiles.slot[at[0]]
                        else:
                            light = stored_light(tiles, frames, clock, target, lead, gamma, kind, at)
                    light += mapped_light(mapped, biases, packed, clock, target, lead, gamma, n, at[1], at[2])
                    total += weight * wp.vec4(light[0], light[1], light[2], 1.0)
                total = _sum_of_group(total, threads)
                if inside and own == 0:
                    light = wp.vec3(total[0], total[1], total[2]) / total[3]
                    if total[3] == 0.0:
                        light = gap_light(tiles, frames, clock, target, lead, square, texel)
                    out[square.slot, i, j] = pack_rgb9e5(light)
            block += blocks

    return decode_pages
