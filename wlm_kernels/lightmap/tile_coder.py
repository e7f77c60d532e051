"""What `wlm_kernels.lightmap.coder` codes of a tile: blocks of a map, a plane, and the bytes of a network.

A block's two ends follow those of the blocks before it along u, v and time, and the texels of a chart that it goes on
with. An index follows the texels beside it, put on the line between its block's ends.
"""

import warp as wp

from wlm_kernels.lightmap.blocks import index_level
from wlm_kernels.lightmap.coder import (
    ENDS,
    INDICES,
    LOWEST,
    PREDICTIONS,
    Coder,
    Row,
    begin,
    ended,
    finish,
    number,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

_FAR = 1 << 30


@wp.func
def _predicted(byte: int, coarse: int, levels: int) -> int:
    """A byte of an end as a number, in 16ths."""
    return wp.clamp(wp.rshift(8 * byte, coarse), 0, 16 * levels - 16)


@wp.func
def _edge(
    before_sums: wp.vec4i,
    before_count: int,
    used: wp.array2d[int],
    texels: wp.array3d[int],
    place: int,
    before: int,
    beside: int,
    apart: int,
    mine: int,
    step: int,
):
    """Adds what a block before has of the chart that this one goes on with: valid texels across their common edge."""
    sums = before_sums
    count = int(before_count)
    for i in range(4):
        other = apart + step * i
        if used[beside, other] != 0 and used[place, mine + step * i] != 0:
            for k in range(4):
                sums[k] = sums[k] + texels[before, other, k]
            count += 1
    return sums, count


@wp.func
def _code_ends(
    c: Coder,
    coarse: int,
    ends: wp.array2d[int],
    texels: wp.array3d[int],
    used: wp.array2d[int],
    b: int,
    place: int,
    valid: int,
    left: int,
    top: int,
    early: int,
    columns: int,
):
    levels = wp.rshift(128, coarse)
    sums = wp.vec4i()
    count = int(0)
    if left >= 0:
        sums, count = _edge(sums, count, used, texels, place, left, place - 1, 3, 0, 4)
    if top >= 0:
        sums, count = _edge(sums, count, used, texels, place, top, place - columns, 12, 0, 1)
    near = wp.where(left >= 0, 1, 0) + wp.where(top >= 0, 2, 0) + wp.where(count > 0, 4, 0)
    few = wp.where(valid == 1, 0, wp.where(valid <= 4, 1, 2))
    for end in range(2):
        lowest = int(0)
        if coarse == 0:
            row = Row()
            lowest = number(c, ends[b, 4 * end] & 1, 1, 0, row, row, 2 + end, LOWEST)
        mixture = ENDS + 24 * end + 8 * few + near
        rows = Row()
        for k in range(PREDICTIONS):
            rows[k] = mixture
        for k in range(4):
            j = 4 * end + k
            centre = wp.where(count > 0, sums[k] // wp.max(count, 1), 127)
            a = wp.where(left >= 0, ends[wp.max(left, 0), j], centre)
            d = wp.where(top >= 0, ends[wp.max(top, 0), j], centre)
            e = wp.where(early >= 0, ends[wp.max(early, 0), j], (a + d) // 2)
            middle = centre
            if end == 1:
                middle = 2 * centre - ends[b, k]
                if valid == 1:
                    e = ends[b, k]
            predicted = Row()
            predicted[0] = _predicted(a, coarse, levels)
            predicted[1] = _predicted(d, coarse, levels)
            predicted[2] = _predicted(middle, coarse, levels)
            predicted[3] = _predicted(e, coarse, levels)
            predicted[4] = _predicted((a + d + middle) // 3, coarse, levels)
            value = wp.rshift(ends[b, j], 1 + coarse)
            value = number(c, value, 7 - coarse, PREDICTIONS, predicted, rows, end, mixture)
            ends[b, j] = wp.lshift(value, 1 + coarse) + lowest


@wp.func
def _on_line(
    ends: wp.array2d[int], texels: wp.array3d[int], b: int, line: wp.vec4i, length: int, other: int, texel: int
):
    """Where a texel lies on the line between a block's ends, in 16ths of an index, and how far from it, squared."""
    along = int(0)
    square = int(0)
    for k in range(4):
        d = texels[other, texel, k] - ends[b, k]
        along += d * line[k]
        square += d * d
    if length == 0:
        return 120, square
    off = square - int(wp.int64(along) * wp.int64(along) // wp.int64(length))
    return wp.clamp(240 * along // length, -128, 368), off


@wp.func
def _class_of(off: int, length: int) -> int:
    if off == _FAR:
        return 3
    # A square is at most 4 times 255 squared, and 44 times that is below 2^31.
    return wp.where(44 * off < length, 0, wp.where(4 * off < length, 1, 2))


@wp.func
def _code_indices(
    c: Coder,
    ends: wp.array2d[int],
    indices: wp.array2d[int],
    texels: wp.array3d[int],
    used: wp.array2d[int],
    b: int,
    place: int,
    left: int,
    top: int,
    corner: int,
    early: int,
    columns: int,
):
    line = wp.vec4i()
    length = int(0)
    for k in range(4):
        line[k] = ends[b, 4 + k] - ends[b, k]
        length += line[k] * line[k]
    size = wp.where(length < 400, 0, wp.where(length < 1600, 1, wp.where(length < 6400, 2, 3)))
    size = wp.where(length < 19600, size, 4)
    for i in range(16):
        if used[place, i] == 0:
            indices[b, i] = 0
            continue
        y = i // 4
        x = i % 4
        # The texels beside it, above, above that one, after that one, and one slice before: their blocks and places.
        other = Row(
            wp.where(x > 0, b, left),
            wp.where(y > 0, b, top),
            wp.where(x > 0 and y > 0, b, wp.where(y > 0, left, wp.where(x > 0, top, corner))),
            wp.where(x == 3, -1, wp.where(y > 0, b, top)),
            early,
        )
        flat = Row(
            place - wp.where(x > 0, 0, 1),
            place - wp.where(y > 0, 0, columns),
            place - wp.where(x > 0, 0, 1) - wp.where(y > 0, 0, columns),
            place - wp.where(y > 0, 0, columns),
            place,
        )
        texel = Row(
            4 * y + (x + 3) % 4,
            4 * ((y + 3) % 4) + x,
            4 * ((y + 3) % 4) + (x + 3) % 4,
            4 * ((y + 3) % 4) + (x + 1) % 4,
            i,
        )
        at = Row()
        off = Row()
        for k in range(PREDICTIONS):
            at[k] = 120
            off[k] = _FAR
            if other[k] >= 0:
                if used[flat[k], texel[k]] != 0:
                    along, apart = _on_line(ends, texels, b, line, length, other[k], texel[k])
                    at[k] = along
                    off[k] = apart
        has0 = off[0] != _FAR
        has1 = off[1] != _FAR
        whole = at[1]
        if has0:
            whole = at[0]
            if has1:
                whole = (at[0] + at[1]) // 2
                if off[2] != _FAR:
                    whole = wp.clamp(at[0] + at[1] - at[2], -128, 368)
        if has0 and has1:
            at[2] = (at[0] + at[1]) // 2
        else:
            at[2] = whole
        off[2] = wp.min(off[0], off[1])
        if early < 0:
            at[4] = whole
            off[4] = off[2]
        rows = Row()
        for k in range(PREDICTIONS):
            rows[k] = INDICES + 4 * size + _class_of(off[k], length)
        mixture = INDICES + 4 * size + wp.where(x > 0, 1, 0) + wp.where(y > 0, 2, 0)
        index = number(c, indices[b, i], 4, PREDICTIONS, at, rows, 4 + i, mixture)
        indices[b, i] = index
        weight = index_level(index)
        for k in range(4):
            texels[b, i, k] = ((64 - weight) * ends[b, k] + weight * ends[b, 4 + k] + 32) // 64


@wp.kernel
def code_blocks(
    c: Coder,
    slices: int,
    columns: int,  # and rows, of blocks
    coarse: int,  # lowest bits that are 0: of 7, beside the lowest of 8
    # in: [columns * columns, 16] whether a texel is coded, in all slices alike
    used: wp.array2d[int],
    # in, out:
    ends: wp.array2d[int],
    indices: wp.array2d[int],
    # scratch: [blocks, 16, 4]
    texels: wp.array3d[int],
):
    begin(c)
    area = columns * columns
    for b in range(slices * area):
        if ended(c):
            return
        place = b % area
        valid = int(0)
        for i in range(16):
            valid += used[place, i]
        if valid == 0:
            for i in range(16):
                indices[b, i] = 0
                if i < 8:
                    ends[b, i] = 0
            continue
        left = int(-1)
        top = int(-1)
        corner = int(-1)
        if place % columns > 0:
            left = b - 1
        if place >= columns:
            top = b - columns
            if left >= 0:
                corner = top - 1
        early = b - area
        # A block without a valid texel says nothing.
        for k in range(3):
            other = wp.where(k == 0, left, wp.where(k == 1, top, corner))
            if other >= 0:
                some = int(0)
                for i in range(16):
                    some += used[other % area, i]
                if some == 0:
                    if k == 0:
                        left = -1
                    elif k == 1:
                        top = -1
                    else:
                        corner = -1
        _code_ends(c, coarse, ends, texels, used, b, place, valid, left, top, early, columns)
        _code_indices(c, ends, indices, texels, used, b, place, left, top, corner, early, columns)
    finish(c)


@wp.kernel
def code_planes(
    c: Coder,
    coarse: int,  # lowest bits that are 0
    # in, out: [channels, rows, columns]
    values: wp.array3d[int],
):
    begin(c)
    most = 16 * (wp.rshift(256, coarse) - 1)
    for channel in range(values.shape[0]):
        rows = Row()
        for k in range(PREDICTIONS):
            rows[k] = channel
        for y in range(values.shape[1]):
            if ended(c):
                return
            for x in range(values.shape[2]):
                left = wp.where(x > 0, values[channel, y, wp.max(x - 1, 0)], 127)
                top = wp.where(y > 0, values[channel, wp.max(y - 1, 0), x], 127)
                corner = wp.where(x > 0 and y > 0, values[channel, wp.max(y - 1, 0), wp.max(x - 1, 0)], 127)
                other = values[0, y, x]
                predicted = Row(
                    wp.rshift(16 * left, coarse),
                    wp.rshift(16 * top, coarse),
                    wp.rshift(8 * (left + top), coarse),
                    wp.clamp(wp.rshift(16 * (left + top - corner), coarse), 0, most),
                    wp.rshift(16 * wp.where(channel > 0, other, 127), coarse),
                )
                value = wp.rshift(values[channel, y, x], coarse)
                value = number(c, value, 8 - coarse, PREDICTIONS, predicted, rows, channel, channel)
                values[channel, y, x] = wp.lshift(value, coarse)
    finish(c)


@wp.kernel
def code_bytes(
    c: Coder,
    # in: [n] 0 to 7: bytes of one class are alike
    classes: wp.array[int],
    # in, out: [n]
    values: wp.array[int],
):
    begin(c)
    for i in range(values.shape[0]):
        if ended(c):
            return
        predicted = Row()
        predicted[0] = 2048
        rows = Row()
        kind = classes[i]
        rows[0] = kind
        # Whole numbers round 0 lie round the middle.
        value = number(c, (values[i] + 128) & 255, 8, 1, predicted, rows, kind, kind)
        values[i] = (value + 128) & 255
    finish(c)
