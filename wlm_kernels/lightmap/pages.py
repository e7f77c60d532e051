"""Decodes pages of a virtual texture: square parts of any mip level, with a border, from tiles of all kinds.

A page is read texel by texel at the coordinates of its sheet, so that its border continues into the neighbouring tiles.
A texel of level L has the mean light of the valid ones of the 2^L x 2^L texels below it, its samples. A texel without
a valid sample, in a gap between charts, takes the light of the nearest one that has one: at level 0 within `FAR`
texels, at others within two. Farther away it takes that of a coarse texel.

From level `COARSE_LEVEL` on, texels are means of a table of `COARSE` x `COARSE` texels of each tile at each time, so
that a page of a whole map does not need its tiles. This table is itself decoded by the same kernel (`direct`). A page
of the level below takes as many samples as `PARTS` others: it is decoded in as many parts, a quarter of its rows each.

Read first: `exact_kernel` in `wlm_kernels/lightmap/decode.py`.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.lightmap.decode import Stored, texel_network
from wlm_kernels.lightmap.features import powers
from wlm_kernels.lightmap.frames import StoredFrames, frame_colour
from wlm_kernels.shared_exponent import pack_rgb9e5, unpack_rgb9e5

COARSE_LEVEL, COARSE = 4, 8
"""The finest level that is read from the table of coarse texels, and their number along a side of a tile."""

PARTS = 4
"""Parts of a page of the level below `COARSE_LEVEL`, which are decoded one by one."""

FAR = 8
"""Largest distance at level 0 of a gap's texel to the valid one whose light it takes, at most 15."""

BLOCK = 128
"""Threads of a block of a launch."""

WAITING, BROKEN = -1, -2
"""Values of `Tiles.slot`: the tile is not on the device; it is damaged."""

FULL, EMPTY = -1, -2
"""Values of `Tiles.mask`: all texels are valid; none is."""

BEFORE, AFTER, SHARE, TAU, WEIGHT, FIRST, SECOND, MIX, ENCODING, CLOCK = 0, 1, 2, 3, 5, 7, 9, 11, 13, 21
"""Columns of a time in a clock, a float array. First the stored times before and after it, and the weight of the later
one. Then for each of the two times at which networks are evaluated: its position on the time axis, its weight (0: it
is not evaluated), the two stored times between which tile scales are interpolated, the weight of the later one, and the
encoded time (four columns). The last is the number of columns."""

_LEVEL, _SIDE, _PARTS, _FAR = (wp.constant(i) for i in (COARSE_LEVEL, COARSE, PARTS, FAR))
_ALL = wp.constant(wp.uint32(0xFFFFFFFF))
_FULL, _EMPTY = wp.constant(FULL), wp.constant(EMPTY)
_BEFORE, _AFTER, _SHARE, _TAU, _WEIGHT, _FIRST, _SECOND, _MIX, _ENCODING = (
    wp.constant(i) for i in (BEFORE, AFTER, SHARE, TAU, WEIGHT, FIRST, SECOND, MIX, ENCODING)
)
_CONSTANT, _DYNAMIC = wp.constant(1), wp.constant(3)  # of `wlm.lightmap.tiles.TileKind`
COARSE_TEXELS = -1
"""Instead of the kind of a tile: its coarse texels are read."""
_COARSE_TEXELS = wp.constant(COARSE_TEXELS)


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
        covered: [N, COARSE * COARSE], valid texels below each coarse texel; 1/1024 in place of 0.
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
    covered: wp.array2d[wp.float16]
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
        lead: [J], added to the weight of the later stored time: light is decoded for so much later.
        slot: [J], index of the square in the output, or -1 for nothing to decode.
        part: [J], the part to decode, see `PARTS`.
        first: [J + 1], first block of `BLOCK` threads of each square, and at the end their number, for `matrix_pages`.
    """

    place: wp.array1d[wp.vec4i]
    target: wp.array1d[int]
    lead: wp.array1d[float]
    slot: wp.array1d[int]
    part: wp.array1d[int]
    first: wp.array1d[int]


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
def _valid(tiles: Tiles, sheet: int, y: int, column: int) -> wp.uint32:
    """Returns which of 32 texels of a row of a sheet are valid, the first in the lowest bit, and none outside of it;
    `column`, that of the first, is a multiple of 32."""
    size = tiles.size[sheet]
    word = wp.uint32(0)
    if y >= 0 and column >= 0 and y < size[0] and column < size[1]:
        mask = tiles.mask[tiles.first[sheet] + (y // 128) * tiles.columns[sheet] + column // 128]
        if mask == _FULL:
            word = _ALL
        elif mask != _EMPTY:
            word = tiles.bits[mask, y % 128, (column % 128) // 32]
    return word


@wp.func
def nearest_of(tiles: Tiles, sheet: int, at: wp.vec2i) -> wp.vec2i:
    """Returns row and column of the valid texel of a sheet that is nearest to one, of several the first in reading
    order; and `at` itself if none is within `FAR` texels."""
    found = wp.vec2i(at[0], at[1])
    x = at[1] - _FAR
    shift = wp.uint32(x & 31)
    best = int(_FAR * _FAR + 1)
    row = int(-_FAR)
    while row <= _FAR:
        # The texels from x on, of which that at `at` has number FAR.
        window = wp.rshift(_valid(tiles, sheet, at[0] + row, x - (x & 31)), shift)
        if shift > wp.uint32(0):
            after = _valid(tiles, sheet, at[0] + row, x - (x & 31) + 32)
            window = window | wp.lshift(after, wp.uint32(32) - shift)
        step = int(0)
        while window != wp.uint32(0) and step <= _FAR and row * row + step * step < best:
            side = int(0)
            if (wp.rshift(window, wp.uint32(_FAR - step)) & wp.uint32(1)) != wp.uint32(0):
                side = -1
            elif (wp.rshift(window, wp.uint32(_FAR + step)) & wp.uint32(1)) != wp.uint32(0):
                side = 1
            if side != 0:
                best = row * row + step * step
                found = wp.vec2i(at[0] + row, at[1] + side * step)
            step += 1
        row += 1
    return found


@wp.struct
class Square:
    """A square of texels that is decoded.

    Attributes:
        slot: Its index in the output, or -1 if there is nothing to decode in this light group.
        sheet: The sheet, among those of its group.
        level: The mip level.
        depth: The level below it whose texels are the samples: the first one, or that of coarse texels.
        rows, columns: Size of the level.
        top, bottom: First row of the part that is decoded, and the row behind it.
    """

    slot: int
    sheet: int
    level: int
    depth: int
    rows: int
    columns: int
    top: int
    bottom: int


@wp.func
def parts_of(level: int) -> int:
    return wp.where(level == _LEVEL - 1, _PARTS, 1)


@wp.func
def rows_of(level: int, edge: int) -> int:
    """Returns the rows of a part of a page, whose side with borders is `edge`."""
    return (edge + parts_of(level) - 1) // parts_of(level)


@wp.func
def square_of(tiles: Tiles, jobs: Jobs, k: int, direct: int, edge: int) -> Square:
    """Returns the square of a job; `edge` is its side."""
    square = Square()
    place = jobs.place[k]
    square.sheet = place[0] - tiles.sheet
    square.slot = -1
    if square.sheet >= 0 and square.sheet < tiles.size.shape[0]:
        square.slot = jobs.slot[k]
        size = tiles.size[square.sheet]
        square.level = place[1]
        square.rows = ((size[0] - 1) >> place[1]) + 1
        square.columns = ((size[1] - 1) >> place[1]) + 1
        square.depth = place[1]
        if place[1] >= _LEVEL and direct == 0:
            square.depth = place[1] - _LEVEL
        square.top = jobs.part[k] * rows_of(place[1], edge)
        square.bottom = wp.min(square.top + rows_of(place[1], edge), edge)
    return square


@wp.func
def samples_of(level: int) -> int:
    """Returns the samples of a part of a page for each texel of the page; 1 for a level that is read from coarse
    texels, which cost little."""
    return wp.where(level < _LEVEL, (1 << (2 * level)) // parts_of(level), 1)


@wp.func
def texel_of(square: Square, place: wp.vec4i, i: int, j: int) -> wp.vec2i:
    """Returns row and column of a texel of a square in its level; beyond the level's end those of its last texel."""
    return wp.vec2i(wp.clamp(place[2] + i, 0, square.rows - 1), wp.clamp(place[3] + j, 0, square.columns - 1))


@wp.func
def search_of(tiles: Tiles, square: Square, texel: wp.vec2i, offsets: int):
    """Returns row and column from which a texel's valid samples are searched, and at how many of the offsets: at level
    0 those of the nearest valid texel, and 1."""
    start = wp.vec2i(texel[0], texel[1])
    reach = int(offsets)
    if square.level == 0:
        start = nearest_of(tiles, square.sheet, texel)
        reach = 1
    return start, reach


@wp.func
def tile_of(tiles: Tiles, sheet: int, y: int, x: int) -> wp.vec3i:
    """Returns the tile of a texel of a sheet, and its row and column in the tile."""
    return wp.vec3i(tiles.first[sheet] + (y // 128) * tiles.columns[sheet] + x // 128, y % 128, x % 128)


@wp.func
def sample_at(tiles: Tiles, square: Square, sample: int, at: wp.vec2i) -> wp.vec3i:
    """Returns tile, row and column of one of the samples of a texel of a level, or a tile of -1 if the texel
    lies outside or the sample is not valid. With a `depth` below the level, samples are coarse texels, all valid."""
    place = wp.vec3i(-1, 0, 0)
    if at[0] >= 0 and at[1] >= 0 and at[0] < square.rows and at[1] < square.columns:
        step = 1 << (square.level - square.depth)
        y = (at[0] << square.level) + (sample >> square.depth) * step
        x = (at[1] << square.level) + (sample & ((1 << square.depth) - 1)) * step
        size = tiles.size[square.sheet]
        if y < size[0] and x < size[1]:
            valid = wp.uint32(1)
            if square.depth == square.level:
                valid = wp.rshift(_valid(tiles, square.sheet, y, x - (x & 31)), wp.uint32(x & 31))
            if (valid & wp.uint32(1)) != wp.uint32(0):
                place = tile_of(tiles, square.sheet, y, x)
    return place


@wp.func
def weight_of(tiles: Tiles, square: Square, at: wp.vec3i) -> float:
    """Returns the weight of a sample in the mean of a texel."""
    weight = float(1.0)
    if square.depth < square.level:
        weight = float(tiles.covered[at[0], (at[1] // 16) * _SIDE + at[2] // 16])
    return weight


@wp.func
def kind_of(tiles: Tiles, square: Square, tile: int) -> int:
    """Returns how a sample in a tile is read: the kind of the tile, or `COARSE_TEXELS`."""
    kind = tiles.kind[tile]
    if square.depth < square.level or tiles.slot[tile] < 0:
        kind = _COARSE_TEXELS
    return kind


@wp.func
def stored_light(
    tiles: Tiles,
    frames: StoredFrames,
    clock: wp.array2d[float],
    target: int,
    lead: float,
    gamma: float,
    kind: int,
    at: wp.vec3i,
) -> wp.vec3:
    """Returns the light of a sample, from `sample_at`, for which no network is evaluated."""
    share = clock[target, _SHARE] + lead
    before = int(clock[target, _BEFORE])
    after = int(clock[target, _AFTER])
    if kind == _COARSE_TEXELS:
        cell = (at[1] // 16) * _SIDE + at[2] // 16
        early = unpack_rgb9e5(tiles.coarse[at[0], before, cell])
        return (1.0 - share) * early + share * unpack_rgb9e5(tiles.coarse[at[0], after, cell])
    slot = tiles.slot[at[0]]
    if kind == _CONSTANT:
        return (1.0 - share) * tiles.colours[slot, before] + share * tiles.colours[slot, after]
    first = slot * frames.times
    light = (1.0 - share) * powers(frame_colour(frames, first + before, at[1], at[2]), gamma)
    if share > 0.0:
        light += share * powers(frame_colour(frames, first + after, at[1], at[2]), gamma)
    return light


@wp.func
def gap_light(
    tiles: Tiles, frames: StoredFrames, clock: wp.array2d[float], target: int, lead: float, square: Square, at: wp.vec2i
) -> wp.vec3:
    """Returns the light of a texel of a level, clamped to it, without a valid sample nearby: that of a coarse texel."""
    size = tiles.size[square.sheet]
    y = wp.min(at[0] << square.level, size[0] - 1)
    x = wp.min(at[1] << square.level, size[1] - 1)
    return stored_light(tiles, frames, clock, target, lead, 1.0, _COARSE_TEXELS, tile_of(tiles, square.sheet, y, x))


@wp.func
def encoding_of(clock: wp.array2d[float], target: int, r: int) -> wp.vec4:
    at = _ENCODING + 4 * r
    return wp.vec4(clock[target, at], clock[target, at + 1], clock[target, at + 2], clock[target, at + 3])


@wp.func
def weight_at(clock: wp.array2d[float], target: int, lead: float, r: int) -> float:
    """Returns the weight of the networks' light at the time r of a clock's row, see `Jobs.lead`."""
    return clock[target, _WEIGHT + r] + wp.where(r == 1, lead, -lead)


@wp.func
def light_of(
    mapped: Mapped, clock: wp.array2d[float], target: int, r: int, n: int, gamma: float, y: wp.vec3
) -> wp.vec3:
    """Converts the output y of the network of the mapped tile n at the time r of a clock's row to light."""
    share = clock[target, _MIX + r]
    early = mapped.scale[n, int(clock[target, _FIRST + r])]
    scale = (1.0 - share) * early + share * mapped.scale[n, int(clock[target, _SECOND + r])]
    c = wp.cw_mul(mapped.shift[n] + wp.cw_mul(mapped.spread[n], y), scale)
    return powers(wp.max(c, wp.vec3()), gamma)


@functools.cache
def page_kernel(hidden: int, gelu: str) -> wp.Kernel:
    """Builds (once) the kernel that decodes squares of texels, one texel per thread, for networks of one hidden width.

    Args:
        hidden: H, width of the hidden layers.
        gelu: One of `wlm_kernels.mlp.GELUS`.
    """
    network, vec_hidden = texel_network(hidden, gelu), wp.types.vector(hidden, float)

    @wp.func
    def mapped_light(
        mapped: Mapped,
        hidden_layers: wp.array2d[vec_hidden],
        output_layers: wp.array2d[wp.vec3],
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
            if weight > 0.0:
                tau = clock[target, _TAU + r]
                encoding = encoding_of(clock, target, r)
                out = network(mapped.stored, hidden_layers, output_layers, tau, encoding, n, y, x)
                light += weight * light_of(mapped, clock, target, r, n, gamma, out)
        return light

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def decode_pages(
        # in:
        tiles: Tiles,
        mapped: Mapped,
        hidden_layers: wp.array2d[vec_hidden],
        output_layers: wp.array2d[wp.vec3],
        frames: StoredFrames,
        clock: wp.array2d[float],
        offsets: wp.array1d[wp.vec2i],
        jobs: Jobs,
        direct: int,
        # out:
        out: wp.array3d[wp.uint32],
    ):
        k, i, j = wp.tid()
        square = square_of(tiles, jobs, k, direct, out.shape[1])
        if square.slot >= 0 and i >= square.top and i < square.bottom:
            target = jobs.target[k]
            lead = jobs.lead[k]
            gamma = tiles.gamma[square.sheet]
            samples = 1 << (2 * square.depth)
            texel = texel_of(square, jobs.place[k], i, j)
            start, reach = search_of(tiles, square, texel, offsets.shape[0])
            # The search comes first, so that the threads of a warp evaluate their networks together.
            o = int(0)
            found = int(0)
            while o < reach and found == 0:
                sample = int(0)
                while sample < samples and found == 0:
                    if sample_at(tiles, square, sample, start + offsets[o])[0] >= 0:
                        found = 1
                    sample += 1
                o += 1
            light = wp.vec3()
            total = float(0.0)
            if found == 1:
                for sample in range(samples):
                    at = sample_at(tiles, square, sample, start + offsets[o - 1])
                    if at[0] >= 0:
                        kind = kind_of(tiles, square, at[0])
                        n = tiles.slot[at[0]]
                        weight = weight_of(tiles, square, at)
                        each = wp.vec3()
                        if kind == _DYNAMIC:
                            each = mapped_light(
                                mapped, hidden_layers, output_layers, clock, target, lead, gamma, n, at[1], at[2]
                            )
                        else:
                            each = stored_light(tiles, frames, clock, target, lead, gamma, kind, at)
                        light += weight * each
                        total += weight
                light = light / total
            else:
                light = gap_light(tiles, frames, clock, target, lead, square, texel)
            out[square.slot, i, j] = pack_rgb9e5(light)

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
    kernel: wp.Kernel,
    source: tuple[Any, ...],
    clock,
    offsets,
    jobs: Jobs,
    direct: bool,
    out,
    blocks: int | None = None,
) -> None:
    """Decodes squares of texels of one light group with one launch, which a CUDA graph can capture.

    Args:
        kernel: From `page_kernel` or `matrix_pages.page_kernel`.
        source: `Tiles`; `Mapped` and the two arrays of the networks; the tiles stored as frames. The arrays are the
            hidden and output layers, or those of `matrix_pages`.
        clock: float [times, CLOCK], the times.
        offsets: vec2i [25], 0 and the offsets to the texels of a mip that may fill a gap, in search order.
        jobs: J squares; those of other groups are left as they are.
        direct: Whether to decode tiles at every level, instead of reading coarse texels from `COARSE_LEVEL` on.
        out: uint32 [slots, side, side], RGB9E5, written: the J squares, whose sides are those of this array.
        blocks: For a kernel of `matrix_pages` the blocks to launch, which take turns.
    """
    inputs = [*source, clock, offsets, jobs, int(direct), *([] if blocks is None else [blocks])]
    dim = (jobs.slot.shape[0], *out.shape[1:]) if blocks is None else blocks * BLOCK
    wp.launch(kernel, dim, inputs=inputs, outputs=[out], device=out.device, block_dim=BLOCK)
