"""Encodes blocks of 4 x 4 texels as ASTC HDR with a small weighted squared error in linear light.

Lines in colour space are fitted to the texels as for BC6H (`wlm_kernels.block_lines`), then stored in several modes:
one line or two, with free ends or with ends that differ by one factor for all channels, and more levels of weights with
fewer levels of ends or the reverse. The mode with the least error in linear light is kept, and its ends are fitted
again to its weights. Two lines are tried for the one partition whose lines would fit best if they were parallel to the
line of the whole block. The tables are those of `wlm.formats.astc`; astcenc's decoder is the reference.
"""

import warp as wp

from wlm_kernels import block_lines as lines

# Without fused operations every device writes the same bytes.
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

_AXIS_ROUNDS = wp.constant(3)
_REFITTED = wp.constant(1)  # number of refits of the best block's ends to its weights
_ALONG = wp.constant(0.2)  # what weights leave of the distances along a line
_BASE_SCALE = wp.constant(7)  # endpoint mode whose ends differ by one factor

_Sums = wp.types.matrix(shape=(64, 4), dtype=float)
_Bytes = wp.types.vector(length=12, dtype=int)
_Fields = wp.types.vector(length=7, dtype=int)
_Wanted = wp.types.vector(length=6, dtype=float)


@wp.struct
class Tables:
    """The tables of `wlm.formats.astc.TABLES`, int.

    Attributes:
        modes: [M, 8], the ways to store a block: number of lines, endpoint mode, the block mode with the number of
            lines; number of weights; then 1 or 3 and a number of bits, whose power of two it is multiplied by, for the
            range of the weights and for that of the bytes.
        shares, weight_codes: [M, 32], for the weights from the smallest: the second end's share in 64ths, and the
            number that is stored.
        rounded: [M, 5, 256], for each number of highest bits that are kept, and byte: the nearest byte of the range.
        byte_codes: [M, 256], the number that is stored for a byte.
        heads: [L, 3], for each layout of a line's ends: the shift from its fields to 12 bits; the header is the second
            number plus the third times the number of the largest channel.
        layouts: [L, 6, 7], for each byte of a layout: the sources of its highest bits, 16 times a field plus the bit
            in it; how many they are; how many highest bits rounding keeps; the byte's own field, and its largest value.
        groups: [243], the bits of five trits, by the trits as a number.
        partitions: [P, 2], for each division of a block: the texels on the second line, a bit each, and its number.
    """

    modes: wp.array2d[int]
    shares: wp.array2d[int]
    weight_codes: wp.array2d[int]
    rounded: wp.array3d[int]
    byte_codes: wp.array2d[int]
    heads: wp.array2d[int]
    layouts: wp.array3d[int]
    groups: wp.array1d[int]
    partitions: wp.array2d[int]


@wp.struct
class _Block:
    """A block that is stored in one mode, with the weighted squared error of its texels.

    `mode` is a row of `Tables.modes`, and `mask` has the texels on the second line, a bit each; `code` has the bytes of
    the lines' ends, and `ends` the ends that they mean, whole numbers of 16 bits. `index` is the rank of each texel's
    weight, and `share` the second end's share.
    """

    error: float
    mode: int
    mask: int
    code: _Bytes
    ends: lines.Ends
    index: lines.Indices
    share: lines.Numbers


@wp.func
def _light_of(place: int) -> float:
    """Converts a number of the 16-bit space to light."""
    part = place & 2047
    bits = 4 * part - 512
    if part < 512:
        bits = 3 * part
    elif part >= 1536:
        bits = 5 * part - 2048
    return lines.light_of(wp.min(((place >> 11) << 10) + (bits >> 3), 0x7BFF))


@wp.func
def _mixed(a: wp.vec3, b: wp.vec3, share: float) -> wp.vec3:
    """Returns the light between two ends; all numbers are whole until the end."""
    place = (a * (64.0 - 64.0 * share) + b * (64.0 * share) + wp.vec3(32.0)) / 64.0
    return wp.vec3(_light_of(int(place[0])), _light_of(int(place[1])), _light_of(int(place[2])))


@wp.func
def _fitted(sums: lines.Sums, a: wp.vec3, b: wp.vec3, kind: int):
    """Solves the normal equations for the ends of a line, from its previous ends."""
    low, high = lines.ends_of(sums, a, b)
    if kind == _BASE_SCALE:
        total = sums.aa + 2.0 * sums.ab + sums.bb
        first = sums.aa + sums.ab
        right = sums.ay + sums.by
        away = wp.cw_div(wp.cw_mul(right, first), total) - sums.ay
        square = sums.aa - wp.cw_div(wp.cw_mul(first, first), total)
        step = b[0] - a[0]
        if wp.dot(square, wp.vec3(1.0)) > 1.0e-5 * wp.dot(sums.aa, wp.vec3(1.0)):
            step = wp.dot(away, wp.vec3(1.0)) / wp.dot(square, wp.vec3(1.0))
        high = wp.cw_div(right + step * first, total)
        low = high - wp.vec3(step)
    return low, high


@wp.func
def _fits(tables: Tables, wanted: _Wanted, row: int, count: int) -> bool:
    """Checks that a layout can hold the differences of ends, in units of 12 bits; the first number always fits."""
    for k in range(1, count):
        if wp.abs(wanted[tables.layouts[row, k, 5]]) > float(tables.layouts[row, k, 6] << tables.heads[row, 0]):
            return False
    return True


@wp.func
def _store(tables: Tables, block: _Block, line: int, low: wp.vec3, high: wp.vec3) -> _Block:
    """Stores a line's ends, in 16 bits, in the bytes of a block of some mode; the second end is the brighter one."""
    if wp.max(low) > wp.max(high):
        swap = low
        low = high
        high = swap
    # The largest channel comes first, in exchange for red.
    order = wp.vec3i(0, 1, 2)
    if high[1] > high[0] and high[1] >= high[2]:
        order = wp.vec3i(1, 0, 2)
    elif high[2] > high[0]:
        order = wp.vec3i(2, 1, 0)
    bright = wp.vec3(high[order[0]], high[order[1]], high[order[2]]) / 16.0
    dark = wp.vec3(low[order[0]], low[order[1]], low[order[2]]) / 16.0
    step = bright - dark
    wanted = _Wanted(
        bright[0], bright[0] - bright[1], bright[0] - bright[2], step[0], step[1] - step[0], step[2] - step[0]
    )
    row = int(0)
    last = int(7)
    count = int(6)
    if tables.modes[block.mode, 1] == _BASE_SCALE:
        row = 8
        last = 12
        count = 4
    while row < last and not _fits(tables, wanted, row, count):
        row += 1
    unit = 1.0 / float(1 << tables.heads[row, 0])
    f = _Fields()
    f[6] = tables.heads[row, 1] + tables.heads[row, 2] * order[0]
    for k in range(count):
        # The rounding of each field is made good by the fields after it.
        own = tables.layouts[row, k, 5]
        target = bright[0] * unit
        if own == 3:
            target = float(f[0]) - dark[0] * unit
        elif own > 3:
            target = float(f[0] - f[3] - f[own - 3]) - dark[own - 3] * unit
        elif own > 0:
            target = float(f[0]) - bright[own] * unit
        most = tables.layouts[row, k, 6]
        least = int(0)
        if own > 3:
            least = -most - 1
        value = wp.clamp(int(wp.floor(target + 0.5)), least, most)
        f[own] = value
        tops = tables.layouts[row, k, 3]
        below = (1 << (8 - tops)) - 1
        byte = value & below
        for i in range(tops):
            source = tables.layouts[row, k, i]
            byte = byte | (((f[source >> 4] >> (source & 15)) & 1) << (7 - i))
        byte = tables.rounded[block.mode, tables.layouts[row, k, 4], byte]
        f[own] = value - (value & below) + (byte & below)
        block.code[count * line + k] = byte
    for c in range(3):
        lit = f[0]
        dim = f[0] - f[3]
        if c > 0:
            lit = f[0] - f[c]
            dim = lit - f[3] - f[c + 3]
        block.ends[2 * line, order[c]] = float(wp.clamp(dim << tables.heads[row, 0], 0, 4095) << 4)
        block.ends[2 * line + 1, order[c]] = float(wp.clamp(lit << tables.heads[row, 0], 0, 4095) << 4)
    return block


@wp.func
def _weighted(texels: lines.Texels, tables: Tables, block: _Block) -> _Block:
    """Chooses each texel's weight by its error in linear light, and sums the errors."""
    last = tables.modes[block.mode, 3] - 1
    for i in range(lines.TEXELS):
        line = wp.where(lines.in_mask(block.mask, i), 1, 0)
        a = block.ends[2 * line]
        b = block.ends[2 * line + 1]
        start = int(lines.along(texels, i, a, b) * float(last))
        best = float(lines.HUGE)
        light = texels.light[i]
        for k in range(wp.min(start, last - 1), wp.min(start, last - 1) + 2):
            share = float(tables.shares[block.mode, k]) / 64.0
            away = _mixed(a, b, share) - light
            if wp.dot(away, away) < best:
                best = wp.dot(away, away)
                block.index[i] = k
                block.share[i] = share
        block.error += texels.weight[i] * best
    return block


@wp.func
def _subsets(texels: lines.Texels, axis: wp.vec3) -> _Sums:
    """Sums weights and weighted colours of the 16 subsets of the texels of each row of a block. Distances along the
    `axis` count less, as weights leave less of them."""
    sums = _Sums()
    square = wp.cw_mul(texels.metric, texels.metric)
    for i in range(lines.TEXELS):
        point = lines.scaled_place(texels, i)
        point = point - (1.0 - _ALONG) * wp.dot(point, axis) * axis
        weight = wp.dot(wp.cw_div(texels.pull[i], square), wp.vec3(1.0 / 3.0))
        bit = 1 << (i & 3)
        start = 16 * (i >> 2)
        for k in range(start, start + bit):
            sums[k + bit] = sums[k] + weight * wp.vec4(1.0, point[0], point[1], point[2])
    return sums


@wp.func
def _scatter(part: wp.vec4) -> float:
    return (part[1] * part[1] + part[2] * part[2] + part[3] * part[3]) / wp.max(part[0], 1.0e-30)


@wp.func
def _split(tables: Tables, sums: _Sums) -> int:
    """Finds the partition with the largest scatter between its parts."""
    most = float(-1.0)
    best = int(0)
    total = sums[15] + sums[31] + sums[47] + sums[63]
    for p in range(tables.partitions.shape[0]):
        mask = tables.partitions[p, 0]
        part = sums[mask & 15] + sums[16 + ((mask >> 4) & 15)] + sums[32 + ((mask >> 8) & 15)] + sums[48 + (mask >> 12)]
        scatter = _scatter(part) + _scatter(total - part)
        if scatter > most:
            most = scatter
            best = p
    return best


@wp.func
def _put(word: wp.vec4ui, place: int, value: int, count: int, down: bool) -> wp.vec4ui:
    """Writes the lowest bits of a value, upwards from bit `place`, or downwards from the highest bit less `place`."""
    for i in range(count):
        at = wp.where(down, 127 - place - i, place + i)
        word[at >> 5] = word[at >> 5] | (wp.uint32((value >> i) & 1) << wp.uint32(at & 31))
    return word


@wp.func
def _packed(block: _Block, tables: Tables, partition: int) -> wp.vec4ui:
    """Packs a block into 128 bits."""
    mode = block.mode
    kind = tables.modes[mode, 1]
    word = wp.vec4ui()
    word[0] = wp.uint32(tables.modes[mode, 2] | (kind << 13))
    place = int(17)
    if tables.modes[mode, 0] == 2:
        word[0] = wp.uint32(tables.modes[mode, 2] | (tables.partitions[partition, 1] << 13) | (kind << 25))
        place = 29
    total = tables.modes[mode, 0] * wp.where(kind == _BASE_SCALE, 4, 6)
    for section in range(2):  # bytes, then weights
        base = tables.modes[mode, 6 - 2 * section]
        bits = tables.modes[mode, 7 - 2 * section]
        if section == 1:
            place = 0
            total = 16
        for start in range(0, total, 5):
            # Five trits are packed together, and stored in parts after the low bits of their numbers.
            trits = int(0)
            factor = int(1)
            codes = _Fields()
            count = wp.min(5, total - start)
            for i in range(count):
                if section == 1:
                    codes[i] = tables.weight_codes[mode, block.index[start + i]]
                else:
                    codes[i] = tables.byte_codes[mode, block.code[start + i]]
                trits += (codes[i] >> bits) * factor
                factor *= 3
            group = tables.groups[trits]
            for i in range(count):
                word = _put(word, place, codes[i], bits, section == 1)
                place += bits
                if base == 3:
                    part = wp.where(i == 2 or i == 4, 1, 2)
                    word = _put(word, place, group, part, section == 1)
                    group = group >> part
                    place += part
    return word


@wp.func
def _one_colour(light: wp.vec3):
    """Packs a block of one colour; returns it, and the colour as half floats."""
    half = wp.vec3ui()
    for c in range(3):
        small = wp.float16(light[c])
        half[c] = wp.uint32(wp.cast(small, wp.uint16))
        light[c] = float(small)
    high = half[2] | wp.uint32(0x3C000000)
    return wp.vec4ui(~wp.uint32(3), ~wp.uint32(0), half[0] | (half[1] << wp.uint32(16)), high), light


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
    """Encodes one block per thread; every function is called at one place, since compilers inline each call."""
    number = wp.tid()
    texels = lines.gathered(light, weight, number, True)
    word, colour = _one_colour(texels.light[0])
    single = bool(True)
    for i in range(lines.TEXELS):
        decoded[number, i] = colour
        for c in range(3):
            single = single and texels.light[i, c] == texels.light[0, c]
    if not single:
        terms = lines.terms_of(texels)
        axis, _along = lines.axis_of(lines.moments_of(terms, lines.ALL), _AXIS_ROUNDS)
        partition = _split(tables, _subsets(texels, axis))
        best = _Block()
        best.error = lines.HUGE
        modes = tables.modes.shape[0]
        for step in range(modes + _REFITTED):
            block = _Block()
            block.mode = step
            if step >= modes:
                block.mode = best.mode
            count = tables.modes[block.mode, 0]
            kind = tables.modes[block.mode, 1]
            if count == 2:
                block.mask = tables.partitions[partition, 0]
            for line in range(count):
                own = block.mask
                if line == 0:
                    own = lines.ALL ^ own
                a = best.ends[2 * line]
                b = best.ends[2 * line + 1]
                shares = best.share
                if step < modes:
                    part = lines.moments_of(terms, own)
                    axis = wp.normalize(texels.metric)
                    if kind != _BASE_SCALE:
                        axis, _along = lines.axis_of(part, _AXIS_ROUNDS)
                    a, b = lines.extremes(texels, own, part, axis)
                    shares = lines.nearest(texels, own, a, b, tables.modes[block.mode, 3] - 1)
                a, b = _fitted(lines.sums_of(texels, own, shares), a, b, kind)
                block = _store(tables, block, line, a, b)
            block = _weighted(texels, tables, block)
            if block.error < best.error:
                best = block
        word = _packed(best, tables, partition)
        for i in range(lines.TEXELS):
            line = wp.where(lines.in_mask(best.mask, i), 1, 0)
            decoded[number, i] = _mixed(best.ends[2 * line], best.ends[2 * line + 1], best.share[i])
    for k in range(4):
        blocks[number, k] = word[k]


def encode(light, weight, tables: Tables, blocks, decoded) -> None:
    """Encodes N blocks of 4 x 4 texels, vec3 [N, 16], row by row, finite, clamped to [0, 65504], as ASTC HDR.

    `weight`, float [N, 16], is that of each texel's squared error, 0 or more. Written are `blocks`, uint32 [N, 4], 16
    bytes per block, the lowest first, and `decoded`, vec3 [N, 16], the decoded texels.
    """
    wp.launch(_encode, len(light), inputs=[light, weight, tables], outputs=[blocks, decoded], device=light.device)
