"""Encodes blocks of 4 x 4 texels as unsigned BC6H with a small weighted squared error in linear light.

BC6H interpolates between two colours in a space that is roughly the logarithm of light. A block is fitted there by
weighted least squares, with the squared derivative of light as a further weight of each texel; the texels' indices are
then chosen by their error in linear light. The most precise mode that can represent the endpoints is used.

A block has one line in colour space for all texels, or two lines, to which one of 32 partitions assigns the texels. The
one line and the two best partitions are encoded, and the encoding with the least error is kept.

The tables are those of `wlm.formats.bc6h`; imagecodecs' decoder is the reference.
"""

import warp as wp

from wlm_kernels import block_lines as lines

# Without fused operations every device writes the same bytes.
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

_POWER_ROUNDS = wp.constant(4)
_AXIS_ROUNDS = wp.constant(8)
_REFINED = wp.constant(2)  # number of fits of a line to its texels' nearest indices
_REFITTED = wp.constant(2)  # number of refits of a block's endpoints to its indices

_Codes = wp.types.matrix(shape=(4, 3), dtype=int)


@wp.struct
class Tables:
    """The tables of `wlm.formats.bc6h.TABLES`, int.

    Attributes:
        modes: [14, 7], a mode's number, its number of bits, whether x, y and z are differences, bits of w, and bits of
            the others' red, green and blue.
        layout: [14, 82], for each mode the meaning of each bit of a block: 16 times the number of the field, plus the
            bit in it; -1 for bits of the mode's number and of indices. Field 4 c + e is channel c of endpoint e (w, x,
            y, z), field 12 the partition.
        masks: [32], the texels on the second line of each partition, one bit per texel.
        anchors: [32], the anchor texel of the second line.
    """

    modes: wp.array2d[int]
    layout: wp.array2d[int]
    masks: wp.array1d[int]
    anchors: wp.array1d[int]


@wp.struct
class _Block:
    """A block that is encoded in one mode, with the weighted squared error of its texels and their indices and decoded
    light.

    `mode` and `partition` are rows of `Tables.modes` and `Tables.masks`; `code` has the endpoints w, x, y and z in the
    mode's number of bits, before differences to w are taken.
    """

    error: float
    mode: int
    partition: int
    code: _Codes
    index: lines.Indices
    light: lines.Colours


@wp.func
def _fitted(
    texels: lines.Texels, mask: int, ends: lines.Ends, line: int, moments: lines.Moments, steps: int
) -> lines.Ends:
    """Fits a line to the texels in `mask`: the extremes along their principal axis, refined twice by least squares.

    Of the endpoints of both lines, rows 2 `line` and 2 `line` + 1 are replaced. `moments` are those of these texels;
    `steps` is the largest index, which selects the line's second end.
    """
    axis, _scatter = lines.axis_of(moments, _AXIS_ROUNDS)
    a, b = lines.extremes(texels, mask, moments, axis)
    for _round in range(_REFINED):
        a, b = lines.ends_of(lines.sums_of(texels, mask, lines.nearest(texels, mask, a, b, steps)), a, b)
    ends[2 * line] = a
    ends[2 * line + 1] = b
    return ends


@wp.func
def _whole(code: int, bits: int) -> int:
    """Expands an endpoint's channel from `bits` bits to 16 bits."""
    if bits == 16 or code == 0:
        return code
    if code == (1 << bits) - 1:
        return 65535
    return ((code << 16) + 32768) >> bits


@wp.func
def _coded(place: float, bits: int) -> int:
    """Returns the code of `bits` bits that expands to the 16-bit value nearest to `place`."""
    top = (1 << bits) - 1
    if bits == 16:
        return wp.clamp(int(place + 0.5), 0, top)
    code = wp.clamp(int(place / float(1 << (16 - bits))), 0, top)
    best = code
    for other in range(wp.max(code - 1, 0), wp.min(code + 2, top + 1)):
        if wp.abs(float(_whole(other, bits)) - place) < wp.abs(float(_whole(best, bits)) - place):
            best = other
    return best


@wp.func
def _share(index: int, steps: int) -> int:
    """Returns the second end's interpolation weight at an index, in 64ths; `steps` is the largest index, 7 or 15."""
    return (index * 64 + steps // 2) // steps


@wp.func
def _finest(tables: Tables, ends: lines.Ends, first: int, last: int, count: int) -> int:
    """Finds the most precise of the modes `first` to `last` - 1 that can store the first `count` ends; -1 if none can.
    Most modes store all ends but the first as differences to it, which have fewer bits."""
    best = int(-1)
    for mode in range(first, last):
        bits = tables.modes[mode, 3]
        fits = bool(True)
        if tables.modes[mode, 2] == 1:
            for c in range(3):
                most = (1 << (tables.modes[mode, 4 + c] - 1)) - 1
                base = _coded(ends[0][c], bits)
                for e in range(1, count):
                    if wp.abs(_coded(ends[e][c], bits) - base) > most:
                        fits = False
        if fits and (best < 0 or bits > tables.modes[best, 3]):
            best = mode
    return best


@wp.func
def _encoded(texels: lines.Texels, tables: Tables, ends: lines.Ends, mode: int, partition: int) -> _Block:
    """Encodes a block in a mode: rounds the ends and chooses the index with the least error for each texel."""
    block = _Block()
    block.mode = mode
    block.partition = partition
    bits = tables.modes[mode, 3]
    count = int(1)
    mask = int(0)
    anchor = int(0)
    steps = int(15)
    if mode < 10:
        count = 2
        mask = tables.masks[partition]
        anchor = tables.anchors[partition]
        steps = 7
    palette = lines.Colours()
    for line in range(count):
        for c in range(3):
            block.code[2 * line, c] = _coded(ends[2 * line][c], bits)
            block.code[2 * line + 1, c] = _coded(ends[2 * line + 1][c], bits)
            low = _whole(block.code[2 * line, c], bits)
            high = _whole(block.code[2 * line + 1, c], bits)
            for k in range(steps + 1):
                share = _share(k, steps)
                mixed = ((64 - share) * low + share * high + 32) >> 6
                palette[8 * line + k, c] = lines.light_of((mixed * 31) >> 6)
    error = float(0.0)
    for i in range(lines.TEXELS):
        start = wp.where(lines.in_mask(mask, i), 8, 0)
        last = wp.where(i == 0 or (count == 2 and i == anchor), steps // 2, steps)
        best = float(lines.HUGE)
        index = int(0)
        light = texels.light[i]  # each read of a struct's matrix copies all of it: not in the inner loop
        for k in range(last + 1):
            away = palette[start + k] - light
            square = wp.dot(away, away)
            if square < best:
                best = square
                index = k
        block.index[i] = index
        block.light[i] = palette[start + index]
        error += texels.weight[i] * best
    block.error = error
    return block


@wp.func
def _turned(texels: lines.Texels, ends: lines.Ends, line: int, anchor: int) -> lines.Ends:
    """Swaps a line's ends if that brings the first end nearer to the anchor texel, whose index has one bit less."""
    a, b = ends[2 * line], ends[2 * line + 1]
    pull = texels.pull[anchor]
    along = wp.cw_mul(pull, b - a)
    if wp.dot(along, texels.place[anchor] - 0.5 * (a + b)) > 0.0:
        ends[2 * line] = b
        ends[2 * line + 1] = a
    return ends


@wp.func
def _refitted(texels: lines.Texels, block: _Block, mask: int, ends: lines.Ends, line: int, steps: int) -> lines.Ends:
    """Refits the ends of a line by least squares to the indices of its texels."""
    shares = lines.Numbers()
    for i in range(lines.TEXELS):
        shares[i] = float(_share(block.index[i], steps)) / 64.0
    a, b = lines.ends_of(lines.sums_of(texels, mask, shares), ends[2 * line], ends[2 * line + 1])
    ends[2 * line] = a
    ends[2 * line + 1] = b
    return ends


@wp.func
def _split(terms: lines.Terms, tables: Tables, whole: lines.Moments) -> wp.vec4:
    """Finds the two partitions whose two lines fit best. Returns the number of each and its expected weighted sum of
    squared errors."""
    best = wp.vec4(0.0, lines.HUGE, 0.0, lines.HUGE)
    for p in range(32):
        second = lines.moments_of(terms, tables.masks[p])
        left = float(0.0)
        along = float(0.0)
        for line in range(2):
            part = second
            if line == 0:
                part = whole - second
            left += lines.spread(part)
            _axis, scatter = lines.axis_of(part, _POWER_ROUNDS)
            along += scatter
        # An index of three bits leaves 1/49 of the scatter along a line.
        left = left - along * (48.0 / 49.0)
        if left < best[1]:
            best = wp.vec4(float(p), left, best[0], best[1])
        elif left < best[3]:
            best = wp.vec4(best[0], best[1], float(p), left)
    return best


@wp.func
def _write_block(number: int, block: _Block, tables: Tables, blocks: wp.array2d[wp.uint32]):
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
    for i in range(lines.TEXELS):
        own = wp.where(i == 0 or i == anchor, width - 1, width)
        for b in range(own):
            bit = wp.uint32((block.index[i] >> b) & 1)
            word[place >> 5] = word[place >> 5] | (bit << wp.uint32(place & 31))
            place += 1
    for k in range(4):
        blocks[number, k] = word[k]


@wp.kernel
def _encode(
    # in:
    light: wp.array2d[wp.vec3],
    weight: wp.array2d[float],
    tables: Tables,
    # out:
    blocks: wp.array2d[wp.uint32],
    decoded: wp.array2d[wp.vec3],
):
    """Encodes one block per thread.

    Every function is called at one place, in loops over partitions, lines and fits: compilers inline each call, and ten
    copies of a function took the CUDA compiler half a minute.
    """
    number = wp.tid()
    texels = lines.gathered(light, weight, number, False)
    terms = lines.terms_of(texels)
    whole = lines.moments_of(terms, lines.ALL)
    # An index of four bits leaves 1/225 of the scatter along a line.
    _axis, along = lines.axis_of(whole, _AXIS_ROUNDS)
    alone = lines.spread(whole) - along * (224.0 / 225.0)
    best = _Block()
    best.error = lines.HUGE
    split = _split(terms, tables, whole)
    for attempt in range(3):  # one line, then the two lines of each partition
        count = int(1)
        steps = int(15)
        partition = int(0)
        mask = int(0)
        anchor = int(0)
        promising = bool(True)
        if attempt > 0:
            partition = int(split[2 * attempt - 2])
            promising = split[2 * attempt - 1] < alone
            count = 2
            steps = 7
            mask = tables.masks[partition]
            anchor = tables.anchors[partition]
        if promising:
            second = lines.moments_of(terms, mask)
            ends = lines.Ends()
            block = _Block()
            for round in range(1 + _REFITTED):
                for line in range(count):
                    own = lines.ALL ^ mask
                    part = whole - second
                    start = int(0)
                    if line == 1:
                        own = mask
                        part = second
                        start = anchor
                    if round == 0:
                        ends = _fitted(texels, own, ends, line, part, steps)
                    else:
                        ends = _refitted(texels, block, own, ends, line, steps)
                    ends = _turned(texels, ends, line, start)
                mode = _finest(tables, ends, wp.where(count == 1, 10, 0), wp.where(count == 1, 14, 10), 2 * count)
                block = _encoded(texels, tables, ends, mode, partition)
                if block.error < best.error:
                    best = block
                if count == 1:
                    block = best
    for i in range(lines.TEXELS):
        decoded[number, i] = best.light[i]
    _write_block(number, best, tables, blocks)


def encode(light, weight, tables: Tables, blocks, decoded) -> None:
    """Encodes N blocks of 4 x 4 texels, vec3 [N, 16], row by row, finite, clamped to [0, 65504], as unsigned BC6H.

    `weight`, float [N, 16], is that of each texel's squared error, 0 or more. Written are `blocks`, uint32 [N, 4], 16
    bytes per block, the lowest first, and `decoded`, vec3 [N, 16], the decoded texels.
    """
    wp.launch(_encode, len(light), inputs=[light, weight, tables], outputs=[blocks, decoded], device=light.device)
