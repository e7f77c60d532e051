"""Encodes blocks of 4 x 4 texels as ASTC HDR with a small weighted squared error in linear light.

ASTC interpolates between two colours in a space that is roughly the logarithm of light. Lines are fitted there to the
texels as for BC6H (`wlm_kernels.block_lines`), then stored in several ways (`wlm.formats.astc.MODES`): one line or two,
two free ends or ends that differ by one factor for all channels, and more or fewer levels of weights with fewer or more
levels of endpoints. The way with the least error in linear light is kept, and its ends are fitted again to its weights.

The tables are those of `wlm.formats.astc`; astcenc's decoder is the reference.
"""

import warp as wp

from wlm_kernels import block_lines as lines

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_AXIS_ROUNDS = wp.constant(8)
_POWER_ROUNDS = wp.constant(3)
_REFITTED = wp.constant(2)  # number of refits of the best block's ends to its weights
_TRIED = wp.constant(2)  # number of partitions that are encoded
_GROUPS = wp.constant(4)
_ALONG = wp.constant(0.2)
_DIRECT = wp.constant(8)  # rows of the layouts
_BASE_SCALE = wp.constant(9)
_ABSOLUTE = wp.constant(14)
_LAST = wp.constant(15)

_Prefixes = wp.types.matrix(shape=(64, 4), dtype=float)
_Bytes = wp.types.vector(length=12, dtype=int)
_Wanted = wp.types.vector(length=6, dtype=float)
_Fields = wp.types.vector(length=8, dtype=int)
_Wholes = wp.types.matrix(shape=(4, 3), dtype=int)


@wp.struct
class Tables:
    """The tables of the format, `wlm.formats.astc.TABLES`, int; a range is a set of numbers, from two to 256.

    Attributes:
        modes: [M, 6], the ways to store a block, those of one line first, those of one endpoint mode side by side:
            number of lines, endpoint mode, range of the weights, number of its weights, range of the ends' bytes, and
            the format's block mode.
        ranges: [21, 2], a base, 1, 3 or 5, and a number of bits: a range has the base times two to the bits numbers.
        shares, weight_codes: [12, 32], for each range and rank of a weight: the second end's share in 64ths, and the
            number that is stored.
        rounded: [21, 5, 256], for each range, number of highest bits that are kept, and byte: its nearest byte.
        byte_codes: [21, 256], for each range and byte: the number that is stored.
        heads: [15, 2], for each layout of a line's ends: the shift from its fields to 12 bits, and its number.
        layouts: [15, 6, 5], for each layout and byte: the sources of its highest bits, 16 times a field plus the bit in
            it, where field 6 is the header; then the bits of the byte's own field, negative if it has a sign, whose low
            bits are the rest of the byte; then the number of those highest bits.
        groups: [2, 243], the bits of five trits and of three quints, as `_groups` of `wlm.formats.astc` says.
        partitions: [P, 2], for each division of a block: the texels on the second line, a bit each, and its number.
    """

    modes: wp.array2d[int]
    ranges: wp.array2d[int]
    shares: wp.array2d[int]
    weight_codes: wp.array2d[int]
    rounded: wp.array3d[int]
    byte_codes: wp.array2d[int]
    heads: wp.array2d[int]
    layouts: wp.array3d[int]
    groups: wp.array2d[int]
    partitions: wp.array2d[int]


@wp.struct
class _Block:
    """A block that is stored in one way, with the weighted squared error of its texels.

    `mode` and `partition` are rows of `Tables.modes` and `Tables.partitions`; `code` has the bytes of the lines' ends,
    `ends` the ends that they mean in 16 bits, two rows a line, and `index` the rank of each texel's weight.
    """

    error: float
    mode: int
    partition: int
    code: _Bytes
    ends: _Wholes
    index: lines.Indices


@wp.func
def _light_of(place: int) -> float:
    """Converts a colour of the 16-bit space to light."""
    part = place & 2047
    bits = 4 * part - 512
    if part < 512:
        bits = 3 * part
    elif part >= 1536:
        bits = 5 * part - 2048
    bits = wp.min(((place >> 11) << 10) + (bits >> 3), 0x7BFF)
    if bits < 1024:
        return float(bits) / 16777216.0
    return wp.cast((bits + 114688) << 13, float)


@wp.func
def _mixed(ends: _Wholes, line: int, share: int) -> wp.vec3:
    """Returns the light between a line's ends, at the second end's share in 64ths."""
    light = wp.vec3()
    for c in range(3):
        light[c] = _light_of((ends[2 * line, c] * (64 - share) + ends[2 * line + 1, c] * share + 32) >> 6)
    return light


@wp.func
def _begun(texels: lines.Texels, mask: int, moments: lines.Moments, kind: int):
    """Returns the extremes of the texels in `mask` along their principal axis; for endpoint mode 7, along the axis on
    which all channels change alike."""
    principal = lines.axis_of(moments, _AXIS_ROUNDS)
    axis = wp.vec3(principal[0], principal[1], principal[2])
    if kind == 7:
        axis = wp.normalize(texels.metric)
    low = float(lines.HUGE)
    high = float(-lines.HUGE)
    for i in range(lines.TEXELS):
        if lines.in_mask(mask, i):
            t = wp.dot(lines.scaled_place(texels, i), axis)
            low = wp.min(low, t)
            high = wp.max(high, t)
    mean = wp.vec3(moments[1], moments[2], moments[3]) / wp.max(moments[0], 1.0e-30)
    centre = wp.dot(mean, axis)
    a = texels.middle + wp.cw_div(mean + axis * (low - centre), texels.metric)
    b = texels.middle + wp.cw_div(mean + axis * (high - centre), texels.metric)
    return a, b


@wp.func
def _shifted(sums: lines.Sums, a: wp.vec3, b: wp.vec3):
    """Solves the normal equations for ends that differ by one number in all channels."""
    total = sums.aa + 2.0 * sums.ab + sums.bb
    first = sums.aa + sums.ab
    right = sums.ay + sums.by
    above = float(0.0)
    below = float(0.0)
    for c in range(3):
        above += sums.ay[c] - right[c] * first[c] / total[c]
        below += sums.aa[c] - first[c] * first[c] / total[c]
    step = b[0] - a[0]
    if below > 1.0e-5 * (sums.aa[0] + sums.aa[1] + sums.aa[2]):
        step = -above / below
    high = wp.cw_div(right + step * first, total)
    return high - wp.vec3(step), high


@wp.func
def _fitted(texels: lines.Texels, sums: lines.Sums, a: wp.vec3, b: wp.vec3, kind: int):
    low, high = lines.ends_of(sums, a, b)
    if kind == 7:
        low, high = _shifted(sums, a, b)
    return low, high


@wp.func
def _layout_of(tables: Tables, wanted: _Wanted, kind: int) -> int:
    """Finds the finest layout that can hold the differences of two ends, in units of 12 bits."""
    first = int(0)
    last = int(_DIRECT)
    count = int(6)
    if kind == 7:
        first = _BASE_SCALE
        last = _ABSOLUTE
        count = 4
    for row in range(first, last):
        unit = 1.0 / float(1 << tables.heads[row, 0])
        fits = bool(True)
        for k in range(1, count):
            bits = tables.layouts[row, k, 3]
            most = (1 << (wp.abs(bits) - wp.where(bits < 0, 1, 0))) - 1
            if wp.abs(wanted[k]) * unit > float(most) + 0.5:
                fits = False
        if fits:
            return row
    return last


@wp.func
def _store(tables: Tables, block: _Block, line: int, low: wp.vec3, high: wp.vec3, kind: int, range_row: int) -> _Block:
    """Stores a line's ends, in 16 bits, in bytes of a range; the second end is the brighter one."""
    if wp.max(low) > wp.max(high):
        swap = low
        low = high
        high = swap
    low = low / 16.0
    high = high / 16.0
    first = int(0)
    if high[1] > high[0] and high[1] >= high[2]:
        first = 1
    elif high[2] > high[0]:
        first = 2
    second = wp.where(first == 1, 0, 1)
    third = wp.where(first == 2, 0, 2)
    bright = wp.vec3(high[first], high[second], high[third])
    dark = wp.vec3(low[first], low[second], low[third])
    step = bright - dark
    wanted = _Wanted(
        bright[0], step[0], bright[0] - bright[1], bright[0] - bright[2], step[1] - step[0], step[2] - step[0]
    )
    count = int(6)
    if kind == 7:
        count = 4
        wanted[1] = bright[0] - bright[1]
        wanted[2] = bright[0] - bright[2]
        wanted[3] = step[0]
    row = _layout_of(tables, wanted, kind)
    shift = tables.heads[row, 0]
    unit = 1.0 / float(1 << shift)
    header = tables.heads[row, 1]
    if row == _DIRECT:
        header = 24
    elif kind == 11:
        header += 8 * first
    elif row == _ABSOLUTE - 1:
        header += first
    elif row < _ABSOLUTE:
        header += 4 * first
    if row == _DIRECT or row == _ABSOLUTE:
        first = 0
        second = 1
        third = 2
        bright = high
        dark = low
    f = _Fields()
    f[6] = header
    for k in range(count):
        # The rounding of each field is made good by the fields after it.
        target = bright[0] * unit
        if row == _DIRECT:
            end = dark
            if (k & 1) == 1:
                end = bright
            target = end[k >> 1] * wp.where(k < 4, unit, 0.5 * unit)
        elif k > 0 and kind == 7:
            if k == 3:
                target = float(f[0]) - dark[0] * unit
                if row < _ABSOLUTE:
                    target = float(f[0]) - (float(f[1] + f[2]) + (dark[0] + dark[1] + dark[2]) * unit) / 3.0
            else:
                target = bright[k] * unit
                if row < _ABSOLUTE:
                    target = float(f[0]) - target
        elif k == 1:
            target = float(f[0]) - dark[0] * unit
        elif k > 3:
            target = float(f[0] - f[1] - f[k - 2]) - dark[k - 3] * unit
        elif k > 1:
            target = float(f[0]) - bright[k - 1] * unit
        bits = tables.layouts[row, k, 3]
        least = int(0)
        most = (1 << wp.abs(bits)) - 1
        if bits < 0:
            most = most >> 1
            least = -most - 1
        tops = tables.layouts[row, k, 4]
        below = (1 << (8 - tops)) - 1
        value = wp.clamp(int(wp.floor(target + 0.5)), least, most)
        f[k] = value
        byte = value & below
        for i in range(tops):
            place = tables.layouts[row, k, i]
            byte = byte | (((f[place >> 4] >> (place & 15)) & 1) << (7 - i))
        byte = tables.rounded[range_row, tops + wp.where(bits == -5, 1, 0), byte]
        f[k] = value - (value & below) + (byte & below)
        block.code[count * line + k] = byte
    if row == _DIRECT:
        for c in range(3):
            size = shift + wp.where(c == 2, 1, 0)
            block.ends[2 * line, c] = f[2 * c] << (size + 4)
            block.ends[2 * line + 1, c] = f[2 * c + 1] << (size + 4)
    else:
        # The colours of the brighter end, then of the darker one.
        lit = wp.vec3i(f[0], f[0] - f[2], f[0] - f[3])
        dim = wp.vec3i(f[0] - f[1], f[0] - f[1] - f[2] - f[4], f[0] - f[1] - f[3] - f[5])
        if kind == 7:
            lit = wp.vec3i(f[0], f[0] - f[1], f[0] - f[2])
            if row == _ABSOLUTE:
                lit = wp.vec3i(f[0], f[1], f[2])
            dim = lit - wp.vec3i(f[3], f[3], f[3])
        for c in range(3):
            target_channel = wp.where(c == 0, first, wp.where(c == 1, second, third))
            block.ends[2 * line, target_channel] = wp.clamp(dim[c] << shift, 0, 4095) << 4
            block.ends[2 * line + 1, target_channel] = wp.clamp(lit[c] << shift, 0, 4095) << 4
    return block


@wp.func
def _weighted(texels: lines.Texels, tables: Tables, block: _Block, mask: int) -> _Block:
    """Chooses each texel's weight by its error in linear light, and sums the errors."""
    row = tables.modes[block.mode, 2]
    last = tables.modes[block.mode, 3] - 1
    error = float(0.0)
    for i in range(lines.TEXELS):
        line = int(0)
        if lines.in_mask(mask, i):
            line = 1
        pull = texels.pull[i]
        a = wp.vec3(float(block.ends[2 * line, 0]), float(block.ends[2 * line, 1]), float(block.ends[2 * line, 2]))
        along = (
            wp.vec3(
                float(block.ends[2 * line + 1, 0]),
                float(block.ends[2 * line + 1, 1]),
                float(block.ends[2 * line + 1, 2]),
            )
            - a
        )
        pulled = wp.cw_mul(pull, along)
        square = wp.dot(pulled, along)
        t = float(0.0)
        if square > 0.0:
            t = wp.dot(pulled, texels.place[i] - a) / square
        start = wp.clamp(int(wp.floor(t * float(last))), 0, last - 1)
        best = float(lines.HUGE)
        for k in range(start, start + 2):
            away = _mixed(block.ends, line, tables.shares[row, k]) - texels.light[i]
            off = wp.dot(away, away)
            if off < best:
                best = off
                block.index[i] = k
        error += texels.weight[i] * best
    block.error = error
    return block


@wp.func
def _refitted(texels: lines.Texels, tables: Tables, block: _Block, mask: int) -> lines.Sums:
    """Sums the normal equations of a line for the weights of the texels in `mask`."""
    sums = lines.Sums()
    for i in range(lines.TEXELS):
        if lines.in_mask(mask, i):
            t = float(tables.shares[tables.modes[block.mode, 2], block.index[i]]) / 64.0
            sums = lines.added(sums, texels.pull[i], texels.place[i], t)
    return sums


@wp.func
def _prefixes(texels: lines.Texels, axis: wp.vec3) -> _Prefixes:
    """Sums the weights and weighted colours of all subsets of the four texels of each row, 16 subsets a row. Along the
    `axis`, which the lines will follow, distances count as much less as weights leave of them."""
    sums = _Prefixes()
    square = wp.cw_mul(texels.metric, texels.metric)
    for i in range(lines.TEXELS):
        point = lines.scaled_place(texels, i)
        point = point - (1.0 - _ALONG) * wp.dot(point, axis) * axis
        weight = wp.dot(wp.cw_div(texels.pull[i], square), wp.vec3(1.0 / 3.0))
        row = 16 * (i >> 2)
        bit = 1 << (i & 3)
        for k in range(bit):
            before = sums[row + k]
            sums[row + bit + k] = before + weight * wp.vec4(1.0, point[0], point[1], point[2])
    return sums


@wp.func
def _gain(part: wp.vec4) -> float:
    return (part[1] * part[1] + part[2] * part[2] + part[3] * part[3]) / wp.max(part[0], 1.0e-30)


@wp.func
def _split(texels: lines.Texels, tables: Tables, whole: lines.Moments, sums: _Prefixes, before: int) -> int:
    """Finds the partition, other than `before`, whose two lines fit best: of a few whose lines would fit best if they
    were parallel to the line of the whole block."""
    total = sums[15] + sums[31] + sums[47] + sums[63]
    least = float(lines.HUGE)
    partition = int(0)
    for group in range(_GROUPS):
        most = float(-1.0)
        candidate = int(0)
        for p in range(group, tables.partitions.shape[0], _GROUPS):
            mask = tables.partitions[p, 0]
            own = sums[mask & 15] + sums[16 + ((mask >> 4) & 15)]
            own += sums[32 + ((mask >> 8) & 15)] + sums[48 + (mask >> 12)]
            gain = _gain(own) + _gain(total - own)
            if gain > most and p != before:
                most = gain
                candidate = p
        second = lines.moments_of(texels, tables.partitions[candidate, 0])
        left = float(0.0)
        for line in range(2):
            part = second
            if line == 0:
                part = whole - second
            left += lines.spread(part) - lines.axis_of(part, _POWER_ROUNDS)[3] * (48.0 / 49.0)
        if left < least:
            least = left
            partition = candidate
    return partition


@wp.func
def _put(word: wp.vec4ui, place: int, value: int, count: int, down: bool) -> wp.vec4ui:
    """Writes the lowest bits of a value, upwards from bit `place`, or downwards from the highest bit less `place`."""
    for i in range(count):
        at = place + i
        if down:
            at = 127 - at
        word[at >> 5] = word[at >> 5] | (wp.uint32((value >> i) & 1) << wp.uint32(at & 31))
    return word


@wp.func
def _write(number: int, block: _Block, tables: Tables, blocks: wp.array2d[wp.uint32]):
    """Packs a block into 128 bits."""
    mode = block.mode
    count = tables.modes[mode, 0]
    kind = tables.modes[mode, 1]
    header = tables.modes[mode, 5] | (kind << 13)
    if count == 2:
        header = tables.modes[mode, 5] | (1 << 11) | (tables.partitions[block.partition, 1] << 13) | (kind << 25)
    word = wp.vec4ui()
    word[0] = wp.uint32(header)
    for section in range(2):  # bytes, then weights
        place = int(17)
        if count == 2:
            place = 29
        total = count * 6
        if kind == 7:
            total = count * 4
        row = tables.modes[mode, 4]
        if section == 1:
            place = 0
            total = 16
            row = tables.modes[mode, 2]
        base = tables.ranges[row, 0]
        bits = tables.ranges[row, 1]
        size = int(1)
        if base == 3:
            size = 5
        elif base == 5:
            size = 3
        for start in range(0, total, size):
            # The digits of a group are packed together, and stored in parts behind the low bits of its numbers.
            digits = int(0)
            factor = int(1)
            codes = _Fields()
            for i in range(wp.min(size, total - start)):
                code = tables.byte_codes[row, block.code[wp.min(start + i, 11)]]
                if section == 1:
                    code = tables.weight_codes[row, block.index[start + i]]
                codes[i] = code
                digits += (code >> bits) * factor
                factor *= base
            packed = int(0)
            if base > 1:
                packed = tables.groups[(base - 3) >> 1, digits]
            for i in range(wp.min(size, total - start)):
                word = _put(word, place, codes[i], bits, section == 1)
                place += bits
                part = int(2)
                if base == 1:
                    part = 0
                elif base == 3 and (i == 2 or i == 4):
                    part = 1
                elif base == 5 and i == 0:
                    part = 3
                word = _put(word, place, packed, part, section == 1)
                packed = packed >> part
                place += part
    for k in range(4):
        blocks[number, k] = word[k]


@wp.func
def _write_colour(number: int, light: wp.vec3, blocks: wp.array2d[wp.uint32]) -> wp.vec3:
    """Packs a block of one colour; returns the colour as half floats."""
    half = wp.vec3i()
    for c in range(3):
        small = wp.float16(light[c])
        half[c] = int(wp.cast(small, wp.uint16))
        light[c] = float(small)
    blocks[number, 0] = ~wp.uint32(3)
    blocks[number, 1] = ~wp.uint32(0)
    blocks[number, 2] = wp.uint32(half[0]) | (wp.uint32(half[1]) << wp.uint32(16))
    blocks[number, 3] = wp.uint32(half[2]) | wp.uint32(0x3C000000)
    return light


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
    single = bool(True)
    for i in range(1, lines.TEXELS):
        for c in range(3):
            if texels.light[i, c] != texels.light[0, c]:
                single = False
    if single:
        colour = _write_colour(number, texels.light[0], blocks)
        for i in range(lines.TEXELS):
            decoded[number, i] = colour
        return
    whole = lines.moments_of(texels, lines.ALL)
    best = _Block()
    best.error = lines.HUGE
    principal = lines.axis_of(whole, _AXIS_ROUNDS)
    sums = _prefixes(texels, wp.vec3(principal[0], principal[1], principal[2]))
    partition = int(-1)
    modes = tables.modes.shape[0]
    singles = int(0)
    for mode in range(modes):
        if tables.modes[mode, 0] == 1:
            singles += 1
    fresh = modes + _TRIED
    double = int(0)  # the best mode of two lines
    least = float(lines.HUGE)
    fitted = int(-1)
    start = lines.Ends()
    for step in range(fresh + _REFITTED):
        block = _Block()
        mode = step
        if step == singles or (step >= modes and step < fresh):
            partition = _split(texels, tables, whole, sums, partition)
        if step >= modes:
            mode = double
        if step >= fresh:
            mode = best.mode
            partition = best.partition
        block.mode = mode
        block.partition = partition
        kind = tables.modes[mode, 1]
        mask = int(0)
        count = tables.modes[mode, 0]
        if count == 2:
            mask = tables.partitions[partition, 0]
        if step < fresh and fitted != 16 * partition + kind:
            fitted = 16 * partition + kind
            second = lines.moments_of(texels, mask)
            for line in range(count):
                own = lines.ALL ^ mask
                part = whole - second
                if line == 1:
                    own = mask
                    part = second
                a, b = _begun(texels, own, part, kind)
                start[2 * line] = a
                start[2 * line + 1] = b
        for line in range(count):
            own = lines.ALL ^ mask
            if line == 1:
                own = mask
            a = start[2 * line]
            b = start[2 * line + 1]
            normal = lines.Sums()
            if step < fresh:
                normal = lines.sums_of(texels, own, a, b, tables.modes[mode, 3] - 1)
            else:
                normal = _refitted(texels, tables, best, own)
            a, b = _fitted(texels, normal, a, b, kind)
            block = _store(tables, block, line, a, b, kind, tables.modes[mode, 4])
        block = _weighted(texels, tables, block, mask)
        if block.error < best.error:
            best = block
        if step >= singles and step < modes and block.error < least:
            least = block.error
            double = mode
    mask = int(0)
    if tables.modes[best.mode, 0] == 2:
        mask = tables.partitions[best.partition, 0]
    for i in range(lines.TEXELS):
        line = wp.where(lines.in_mask(mask, i), 1, 0)
        decoded[number, i] = _mixed(best.ends, line, tables.shares[tables.modes[best.mode, 2], best.index[i]])
    _write(number, best, tables, blocks)


def encode(light, weight, tables: Tables, blocks, decoded) -> None:
    """Encodes N blocks of 4 x 4 texels, vec3 [N, 16], row by row, finite, clamped to [0, 65504], as ASTC HDR.

    `weight`, float [N, 16], is that of each texel's squared error, 0 or more. Written are `blocks`, uint32 [N, 4], 16
    bytes per block, the lowest first, and `decoded`, vec3 [N, 16], the decoded texels.
    """
    wp.launch(_encode, len(light), inputs=[light, weight, tables], outputs=[blocks, decoded], device=light.device)
