"""A BC6H block during encoding, and its packing into 128 bits."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_TEXELS = wp.constant(16)
Colours = wp.types.matrix(shape=(16, 3), dtype=float)
Indices = wp.types.vector(length=16, dtype=int)
Codes = wp.types.matrix(shape=(4, 3), dtype=int)


@wp.struct
class Tables:
    """The tables of the format, described in `wlm.formats.bc6h`.

    Attributes:
        modes: int [14, 7], bit counts of each mode: `MODES`.
        layout: int [14, 82], meaning of each bit in each mode: `LAYOUT`.
        masks: int [32], texels on the second line of each partition: `MASKS`.
        anchors: int [32], anchor texel of the second line of each partition: `SECOND_ANCHORS`.
        halves: float [31,744], the value of each half float by its bit pattern.
    """

    modes: wp.array2d[int]
    layout: wp.array2d[int]
    masks: wp.array1d[int]
    anchors: wp.array1d[int]
    halves: wp.array1d[float]


@wp.struct
class Block:
    """A block that is encoded in one mode.

    Attributes:
        error: Weighted squared error of its texels.
        mode, partition: Rows of the mode and of the partition in `Tables.modes` and `Tables.masks`.
        code: The endpoints w, x, y and z in the mode's number of bits, before differences to w are taken.
        index: Index of each texel.
        light: Decoded light of each texel.
    """

    error: float
    mode: int
    partition: int
    code: Codes
    index: Indices
    light: Colours


@wp.func
def write_block(number: int, block: Block, tables: Tables, blocks: wp.array2d[wp.uint32]):
    """Packs a block into 128 bits and writes them to row `number` of `blocks`."""
    mode = block.mode
    word = wp.vec4ui()
    word[0] = wp.uint32(tables.modes[mode, 0])
    begin = tables.modes[mode, 1]
    for place in range(begin, 82):
        code = tables.layout[mode, place]
        if code >= 0:
            field = code >> 4
            value = block.partition
            if field < 12:
                channel, end = field >> 2, field & 3
                value = block.code[end, channel]
                if end > 0 and tables.modes[mode, 2] == 1:
                    value = value - block.code[0, channel]
            bit = wp.uint32((value >> (code & 15)) & 1)
            word[place >> 5] = word[place >> 5] | (bit << wp.uint32(place & 31))
    anchor = int(0)
    width = int(4)
    if mode < 10:
        anchor = tables.anchors[block.partition]
        width = 3
    place = int(65)
    if mode < 10:
        place = 82
    for i in range(_TEXELS):
        own = width
        if i == 0 or i == anchor:
            own = width - 1
        for b in range(own):
            bit = wp.uint32((block.index[i] >> b) & 1)
            word[place >> 5] = word[place >> 5] | (bit << wp.uint32(place & 31))
            place += 1
    for k in range(4):
        blocks[number, k] = word[k]
