"""Decodes pages of a virtual texture: square parts of any mip level, with a border, from tiles of all kinds.

A page is read texel by texel at the coordinates of its sheet, so that its border continues into the neighbouring tiles.
A texel of level L stands for 2^L x 2^L texels. Its light is the mean of those of 4 x 4 samples of them that are valid:
up to level 2 the samples are all texels, and then each row and each column of an even grid of 16 x 16 has one. A texel
without a valid sample, in a gap between charts, takes the light of the nearest one within two texels that has one, as
`wlm.lightmap.runtime.MapDecoder` does; farther away from charts it is black.

From level `COARSE_LEVEL` on, texels are read from a table of `COARSE` x `COARSE` texels of each tile at each time, so
that a page of a whole map does not need its tiles. This table is itself decoded by the same kernel (`direct`).

Read first: `exact_kernels` in `wlm_kernels/lightmap/decode.py`.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels import mlp
from wlm_kernels.lightmap.blocks import stored_texel
from wlm_kernels.lightmap.decode import Maps, Stored, map_texel, texel_network
from wlm_kernels.lightmap.features import CENTRE, STATIC_INPUTS, TEMPORAL_INPUTS
from wlm_kernels.lightmap.frames import StoredFrames, frame_colour, power
from wlm_kernels.lightmap.matrix_decode import matrix_texels
from wlm_kernels.native import on_cuda
from wlm_kernels.shared_exponent import pack_rgb9e5, unpack_rgb9e5

COARSE_LEVEL, COARSE = 4, 8
"""The finest level that is read from the table of coarse texels, and their number along a side of a tile."""

WAITING, BROKEN = -1, -2
"""Values of `Tiles.slot`: the tile is not on the device; it is damaged."""

FULL, EMPTY = -1, -2
"""Values of `Tiles.mask`: all texels are valid; none is."""

BEFORE, AFTER, SHARE, TAU, WEIGHT, FIRST, SECOND, MIX, ENCODING, CLOCK = 0, 1, 2, 3, 5, 7, 9, 11, 13, 21
"""Columns of a time in a clock, a float array. First the stored times before and after it, and the weight of the later
one. Then for each of the two times at which networks are evaluated: its position on the time axis, its weight (0: it
is not evaluated), the two stored times between which tile scales are interpolated, the weight of the later one, and the
encoded time (four columns). The last is the number of columns."""

_BLOCK = 128  # threads
_LEVEL, _SIDE = wp.constant(COARSE_LEVEL), wp.constant(COARSE)
_FULL, _EMPTY = wp.constant(FULL), wp.constant(EMPTY)
_BEFORE, _AFTER, _SHARE, _TAU, _WEIGHT, _FIRST, _SECOND, _MIX, _ENCODING = (
    wp.constant(i) for i in (BEFORE, AFTER, SHARE, TAU, WEIGHT, FIRST, SECOND, MIX, ENCODING)
)
_CONSTANT, _STATIC, _FRAMES = wp.constant(1), wp.constant(2), wp.constant(4)  # of `wlm.lightmap.tiles.TileKind`


@wp.struct
class Tiles:
    """The N tiles of the S sheets of one light group, sheet after sheet and row by row.

    Attributes:
        sheet: Number of the group's first sheet among the sheets of all groups.
        size: [S], height and width of each sheet in texels.
        first, columns: [S], number of the sheet's first tile, and its tiles in a row.
        gamma: [S], exponent that converts colours to light.
        kind: [N], the kind of each tile, see `wlm.lightmap.tiles.TileKind`.
        slot: [N], row of the tile among the tiles of its kind on the device, or `WAITING` or `BROKEN`.
        mask: [N], row in `bits`, or `FULL` or `EMPTY`.
        bits: [M, 128, 4], valid texels of a tile, the first of a word in its lowest bit.
        coarse: [N, T, COARSE * COARSE], light of each tile at each stored time, RGB9E5.
        colours: [C, T], light of the constant tiles at each stored time.
    """

    sheet: int
    size: wp.array1d[wp.vec2i]
    first: wp.array1d[int]
    columns: wp.array1d[int]
    gamma: wp.array1d[float]
    kind: wp.array1d[int]
    slot: wp.array1d[int]
    mask: wp.array1d[int]
    bits: wp.array3d[wp.uint32]
    coarse: wp.array3d[wp.uint32]
    colours: wp.array2d[wp.vec3]


@wp.struct
class Mapped:
    """K tiles with feature maps: their maps, mean colours at T stored times, and the `shift` and `spread` of colours,
    see `wlm.lightmap.model`."""

    stored: Stored
    scale: wp.array2d[wp.vec3]  # [K, T]
    shift: wp.array1d[wp.vec3]  # [K]
    spread: wp.array1d[wp.vec3]  # [K]


@wp.struct
class Jobs:
    """Squares to decode.

    Attributes:
        place: [J], sheet, level, row and column of the first texel, which may lie outside the level.
        target: [J], row of the clock with the time.
        slot: [J], index of the square in the output, or -1 for nothing to decode.
    """

    place: wp.array1d[wp.vec4i]
    target: wp.array1d[int]
    slot: wp.array1d[int]


@wp.kernel(enable_backward=False)
def _put(
    # in:
    records: wp.array2d[wp.uint8],
    slots: wp.array1d[int],
    parts: wp.array2d[int],
    # out:
    memory: wp.array1d[wp.uint8],
):
    i, j = wp.tid()
    part = int(0)
    while j >= parts[part, 0] + parts[part, 1]:
        part += 1
    memory[parts[part, 2] + slots[i] * parts[part, 1] + j - parts[part, 0]] = records[i, j]


@wp.func
def _valid(tiles: Tiles, tile: int, y: int, x: int) -> int:
    mask = tiles.mask[tile]
    if mask == _FULL:
        return 1
    if mask == _EMPTY:
        return 0
    return int(wp.rshift(tiles.bits[mask, y, x // 32], wp.uint32(x % 32)) & wp.uint32(1))


@wp.func
def _sample(tiles: Tiles, sheet: int, level: int, depth: int, side: int, sample: int, y: int, x: int) -> wp.vec3i:
    """Returns tile, row and column of one of side x side samples of the texel (y, x) of a level, or a tile of -1 if the
    sample is not valid. With a `depth` below the level, samples are coarse texels, and all are valid."""
    a = sample // side
    b = sample - a * side
    whole = 2 * side * side
    ty = (y << level) + (2 * (a * side + b) + 1 << level) // whole
    tx = (x << level) + (2 * (b * side + side - 1 - a) + 1 << level) // whole
    if depth < level:  # of a coarse texel that reaches past the map's end, its first texel does not
        ty -= ty % 16
        tx -= tx % 16
    size = tiles.size[sheet]
    tile = int(-1)
    if ty < size[0] and tx < size[1]:
        tile = tiles.first[sheet] + (ty // 128) * tiles.columns[sheet] + tx // 128
        ty = ty % 128
        tx = tx % 128
        if depth == level:
            if _valid(tiles, tile, ty, tx) == 0:
                tile = -1
    return wp.vec3i(tile, ty, tx)


@wp.func
def _coarse_light(tiles: Tiles, clock: wp.array2d[float], target: int, tile: int, cell: int) -> wp.vec3:
    share = clock[target, _SHARE]
    early = unpack_rgb9e5(tiles.coarse[tile, int(clock[target, _BEFORE]), cell])
    return (1.0 - share) * early + share * unpack_rgb9e5(tiles.coarse[tile, int(clock[target, _AFTER]), cell])


@wp.func
def _stored_light(
    tiles: Tiles,
    frames: StoredFrames,
    clock: wp.array2d[float],
    target: int,
    gamma: float,
    kind: int,
    slot: int,
    y: int,
    x: int,
) -> wp.vec3:
    """Returns the light of a constant tile, or of one stored as frames, in the slot of its kind."""
    share = clock[target, _SHARE]
    before = int(clock[target, _BEFORE])
    after = int(clock[target, _AFTER])
    if kind == _CONSTANT:
        return (1.0 - share) * tiles.colours[slot, before] + share * tiles.colours[slot, after]
    first = slot * frames.times
    light = (1.0 - share) * power(frame_colour(frames, first + before, y, x), gamma)
    if share > 0.0:
        light += share * power(frame_colour(frames, first + after, y, x), gamma)
    return light


@wp.func
def _encoding_of(clock: wp.array2d[float], target: int, r: int) -> wp.vec4:
    at = _ENCODING + 4 * r
    return wp.vec4(clock[target, at], clock[target, at + 1], clock[target, at + 2], clock[target, at + 3])


@wp.func
def _light_of(
    mapped: Mapped, clock: wp.array2d[float], target: int, r: int, n: int, gamma: float, y: wp.vec3
) -> wp.vec3:
    """Converts the output y of the network of the mapped tile n at the time r of a clock's row to light."""
    share = clock[target, _MIX + r]
    early = mapped.scale[n, int(clock[target, _FIRST + r])]
    scale = (1.0 - share) * early + share * mapped.scale[n, int(clock[target, _SECOND + r])]
    c = wp.cw_mul(mapped.shift[n] + wp.cw_mul(mapped.spread[n], y), scale)
    return power(wp.vec3(wp.max(c[0], 0.0), wp.max(c[1], 0.0), wp.max(c[2], 0.0)), gamma)


@wp.func_native(on_cuda("return __reduce_max_sync(~0u, x);\n", "return x;"))
def _most_of_warp(x: int) -> int:
    """Returns the largest number of a warp, whose threads must all call it."""
    ...


def _plain_lights(hidden: int, gelu: str) -> tuple[Any, Any, tuple[Any, ...]]:
    """Builds the `wp.func`s that read moving and still tiles at a texel, each thread by itself, and the types of their
    networks' arrays."""
    vec_hidden = mlp.kernels(TEMPORAL_INPUTS, hidden, gelu).vec_hidden
    assert vec_hidden is mlp.kernels(STATIC_INPUTS, hidden, gelu).vec_hidden

    def build(temporal: bool) -> Any:
        network = texel_network(temporal, hidden, gelu)

        @wp.func
        def light(
            mapped: Mapped,
            first: wp.array2d[vec_hidden],
            later: wp.array2d[wp.vec3],
            clock: wp.array2d[float],
            target: int,
            gamma: float,
            n: int,
            y: int,
            x: int,
        ) -> wp.vec3:
            light = wp.vec3()
            if n >= 0:
                two = int(2)  # a variable keeps the loop rolled
                for r in range(two):
                    weight = clock[target, _WEIGHT + r]
                    if weight > 0.0:
                        tau = clock[target, _TAU + r]
                        out = network(mapped.stored, first, later, tau, _encoding_of(clock, target, r), n, y, x)
                        light += weight * _light_of(mapped, clock, target, r, n, gamma, out)
            return light

        return light

    return build(True), build(False), (vec_hidden, wp.vec3)


def _matrix_lights(hidden: int) -> tuple[Any, Any, tuple[Any, ...]]:
    """Builds the same as `_plain_lights` for a GPU's matrix units: all threads of a warp must call the functions."""
    evaluate, vec_hidden = matrix_texels(hidden), wp.types.vector(hidden, float)

    def build(temporal: bool) -> Any:
        @wp.func
        def light(
            mapped: Mapped,
            first: wp.array2d[vec_hidden],
            later: wp.array2d[wp.uint32],
            clock: wp.array2d[float],
            target: int,
            gamma: float,
            n: int,
            y: int,
            x: int,
        ) -> wp.vec3:
            light = wp.vec3()
            two = int(2)
            for r in range(two):
                weight = clock[target, _WEIGHT + r]
                number = wp.where(weight > 0.0, n, -1)
                f = Maps()
                if number >= 0:
                    if wp.static(temporal):
                        f = map_texel(mapped.stored, n, clock[target, _TAU + r], y, x)
                        for c in range(4, 12):
                            f[c] = (f[c] - 0.5) * CENTRE
                    else:
                        uv = stored_texel(mapped.stored.uv, n, y, x)
                        for c in range(4):
                            f[c] = uv[c]
                    for c in range(4):
                        f[c] = f[c] * 255.0 - 128.0
                out = evaluate(later, first, f, _encoding_of(clock, target, r), number, 2 * target + r)
                if number >= 0:
                    light += weight * _light_of(mapped, clock, target, r, n, gamma, out)
            return light

        return light

    return build(True), build(False), (vec_hidden, wp.uint32)


@functools.cache
def page_kernel(hidden: int, gelu: str, matrix: bool = False) -> wp.Kernel:
    """Builds (once) the kernel that decodes squares of texels, for networks of one hidden width.

    Args:
        hidden: H, width of the hidden layers; a multiple of 16 for matrix units.
        gelu: One of `mlp.GELUS`; matrix units have their own.
        matrix: Whether to evaluate networks on a GPU's matrix units, with half floats. The networks' two arrays are
            then those of `pack_biases` and `pack_networks` instead of their hidden and output layers.
    """
    moving_light, still_light, (first_type, later_type) = (
        _matrix_lights(hidden) if matrix else _plain_lights(hidden, gelu)
    )

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def decode_pages(
        # in:
        tiles: Tiles,
        moving: Mapped,
        moving_first: wp.array2d[first_type],
        moving_later: wp.array2d[later_type],
        still: Mapped,
        still_first: wp.array2d[first_type],
        still_later: wp.array2d[later_type],
        frames: StoredFrames,
        clock: wp.array2d[float],
        offsets: wp.array1d[wp.vec2i],
        jobs: Jobs,
        grid: int,
        direct: int,
        # out:
        out: wp.array3d[wp.uint32],
    ):
        i = wp.tid()
        edge = out.shape[1]
        k = i // (edge * edge)
        slot = int(-1)
        sheet = int(0)
        if k < jobs.slot.shape[0]:
            sheet = jobs.place[k][0] - tiles.sheet
            if sheet >= 0 and sheet < tiles.size.shape[0]:
                slot = jobs.slot[k]
        side = int(1)
        found = int(0)
        level = int(0)
        depth = int(0)
        yy = int(0)
        xx = int(0)
        target = int(0)
        if slot >= 0:
            target = jobs.target[k]
            place = jobs.place[k]
            level = place[1]
            size = tiles.size[sheet]
            rows = ((size[0] - 1) >> level) + 1
            columns = ((size[1] - 1) >> level) + 1
            y = wp.clamp(place[2] + i // edge % edge, 0, rows - 1)
            x = wp.clamp(place[3] + i % edge, 0, columns - 1)
            depth = level
            if level >= _LEVEL and direct == 0:
                depth = level - _LEVEL
            side = wp.min(1 << depth, grid)
            # The search comes first, so that the threads of a warp evaluate their networks together.
            o = int(0)
            while o < offsets.shape[0] and found == 0:
                yy = y + offsets[o][0]
                xx = x + offsets[o][1]
                if yy >= 0 and xx >= 0 and yy < rows and xx < columns:
                    sample = int(0)
                    while sample < side * side and found == 0:
                        if _sample(tiles, sheet, level, depth, side, sample, yy, xx)[0] >= 0:
                            found = 1
                        sample += 1
                o += 1
        light = wp.vec3()
        count = int(0)
        own = int(0)
        if found == 1:
            own = side * side
        # Matrix units serve whole warps: a thread without a sample takes part in the others' networks.
        most = int(own)
        if wp.static(matrix):
            most = _most_of_warp(own)
        for sample in range(most):
            n_moving = int(-1)
            n_still = int(-1)
            at = wp.vec3i(-1, 0, 0)
            if sample < own:
                at = _sample(tiles, sheet, level, depth, side, sample, yy, xx)
            if at[0] >= 0:
                count += 1
                kind = tiles.kind[at[0]]
                row = tiles.slot[at[0]]
                if depth < level or row < 0:
                    light += _coarse_light(tiles, clock, target, at[0], (at[1] // 16) * _SIDE + at[2] // 16)
                elif kind == _STATIC:
                    n_still = row
                elif kind == _CONSTANT or kind == _FRAMES:
                    light += _stored_light(tiles, frames, clock, target, tiles.gamma[sheet], kind, row, at[1], at[2])
                else:
                    n_moving = row
            gamma = float(1.0)
            if own > 0:
                gamma = tiles.gamma[sheet]
            light += moving_light(moving, moving_first, moving_later, clock, target, gamma, n_moving, at[1], at[2])
            light += still_light(still, still_first, still_later, clock, target, gamma, n_still, at[1], at[2])
        if slot >= 0:
            out[slot, i // edge % edge, i % edge] = pack_rgb9e5(light / float(wp.max(count, 1)))

    return decode_pages


def put(records, slots, parts, memory) -> None:
    """Distributes tiles to the arrays of all tiles, which lie one after another in one memory.

    Args:
        records: uint8 [n, bytes], the tiles, each with its part of each array one after another.
        slots: int [n], row of each tile in the arrays.
        parts: int [arrays, 3], for each array its first byte in a record, its bytes of a tile, and its first byte in
            the memory.
        memory: uint8 [bytes], written.
    """
    wp.launch(_put, records.shape, inputs=[records, slots, parts], outputs=[memory], device=memory.device)


def decode(
    kernel: wp.Kernel, source: tuple[Any, ...], clock, offsets, jobs: Jobs, grid: int, direct: bool, out
) -> None:
    """Decodes squares of texels of one light group with one launch, which a CUDA graph can capture.

    Args:
        kernel: From `page_kernel`.
        source: `Tiles`; `Mapped` and the two arrays of the networks of the dynamic tiles, see `page_kernel`, and the
            same of the static ones; the tiles stored as frames.
        clock: float [times, CLOCK], the times.
        offsets: vec2i [25], 0 and the offsets to the texels that may fill a gap, in search order.
        jobs: J squares; those of other groups are left as they are.
        grid: Most samples of a texel of a mip along each axis.
        direct: Whether to decode tiles at every level, instead of reading coarse texels from `COARSE_LEVEL` on.
        out: uint32 [slots, side, side], RGB9E5, written: the J squares, whose sides are those of this array.
    """
    inputs = [*source, clock, offsets, jobs, grid, int(direct)]
    texels = jobs.slot.shape[0] * out.shape[1] * out.shape[2]
    # Whole blocks: the matrix units serve whole warps.
    dim = -(-texels // _BLOCK) * _BLOCK
    wp.launch(kernel, dim, inputs=inputs, outputs=[out], device=out.device, block_dim=_BLOCK)
