"""Decodes tiles that are stored as frames, one for each time: BC7 blocks of any mode.

A block's values 0 to 1 stand for the range between two colours that are stored for each frame. Blocks are uint64
`[N T, 32, 32, 2]` for N tiles at T times, the T frames of a tile one after another. The last axis is the low and the
high half of a block's 16 little-endian bytes. `wlm.formats.bc7` defines and describes the tables of BC7.
"""

import warp as wp

from wlm_kernels.lightmap.features import powers

wp.set_module_options({"enable_backward": False})


@wp.struct
class Tables:
    """The tables of the BC7 format, see `wlm.formats.bc7`."""

    modes: wp.array2d[int]  # [8, 10], by mode: bits and counts
    partitions: wp.array2d[wp.uint32]  # [3, 64], by subsets: the subset of each texel, two bits
    anchors: wp.array3d[int]  # [3, 64, 2]
    shares: wp.array2d[int]  # [3, 16], by an index's bits


@wp.struct
class StoredFrames:
    """N tiles with a frame at each of T times."""

    blocks: wp.array4d[wp.uint64]  # [N T, 32, 32, 2]
    least: wp.array1d[wp.vec3]  # [N T], colour of level 0
    span: wp.array1d[wp.vec3]  # [N T], colour of level 1 minus colour of level 0
    tables: Tables
    times: int
    gamma: float


@wp.func
def bits_of(low: wp.uint64, high: wp.uint64, at: int, count: int) -> int:
    """Returns bits `at` to `at + count - 1` of a block as an integer; `count` is at most 30."""
    word = low
    if at >= 64:
        word = wp.rshift(high, wp.uint64(at - 64))
    elif at > 0:
        word = wp.rshift(low, wp.uint64(at)) | wp.lshift(high, wp.uint64(64 - at))
    return int(word & (wp.lshift(wp.uint64(1), wp.uint64(count)) - wp.uint64(1)))


@wp.func
def share_of(
    low: wp.uint64, high: wp.uint64, tables: Tables, at: int, count: int, texel: int, first: int, second: int
) -> int:
    """Returns the weight of a texel's second endpoint, in 64ths. Indices have `count` bits and begin at bit `at`; the
    indices of the anchor texels 0, `first` and `second` have one bit less."""
    start = at + count * texel
    width = count
    if texel > 0:
        start -= 1
    if texel > first:
        start -= 1
    if texel > second:
        start -= 1
    if texel == 0 or texel == first or texel == second:
        width -= 1
    return tables.shares[count - 2, bits_of(low, high, start, width)]


@wp.func
def end_of(value: int, count: int, lowest: int) -> int:
    """Expands a channel of an endpoint, `count` bits, to a byte; `lowest` is the P bit to append, -1 for none."""
    v = value
    n = count
    if lowest >= 0:
        v = 2 * v + lowest
        n += 1
    v = v * (1 << (8 - n))
    return v | (v >> n)


@wp.func
def mixed(a: int, b: int, share: int) -> int:
    return ((64 - share) * a + share * b + 32) >> 6


@wp.func
def block_texel(low: wp.uint64, high: wp.uint64, tables: Tables, texel: int) -> wp.vec3:
    """Decodes the red, green and blue of a texel of a block, 0 to 255; blocks of the reserved mode are black."""
    mode = int(0)
    while mode < 8 and bits_of(low, high, mode, 1) == 0:
        mode += 1
    if mode == 8:
        return wp.vec3()
    subsets = tables.modes[mode, 0]
    at = mode + 1
    partition = bits_of(low, high, at, tables.modes[mode, 1])
    at += tables.modes[mode, 1]
    rotation = bits_of(low, high, at, tables.modes[mode, 2])
    at += tables.modes[mode, 2]
    selection = bits_of(low, high, at, tables.modes[mode, 3])
    at += tables.modes[mode, 3]
    colour = tables.modes[mode, 4]
    alpha = tables.modes[mode, 5]
    own = tables.modes[mode, 6]
    shared = tables.modes[mode, 7]
    count = tables.modes[mode, 8]
    second = tables.modes[mode, 9]
    alpha_at = at + 6 * subsets * colour
    lowest_at = alpha_at + 2 * subsets * alpha
    index_at = lowest_at + 2 * subsets * own + subsets * shared
    subset = int(wp.rshift(tables.partitions[subsets - 1, partition], wp.uint32(2 * texel)) & wp.uint32(3))
    p0 = int(-1)
    p1 = int(-1)
    if own == 1:
        p0 = bits_of(low, high, lowest_at + 2 * subset, 1)
        p1 = bits_of(low, high, lowest_at + 2 * subset + 1, 1)
    if shared == 1:
        p0 = bits_of(low, high, lowest_at + subset, 1)
        p1 = p0
    share = share_of(
        low,
        high,
        tables,
        index_at,
        count,
        texel,
        tables.anchors[subsets - 1, partition, 0],
        tables.anchors[subsets - 1, partition, 1],
    )
    alpha_share = share
    if second > 0:
        other = share_of(low, high, tables, index_at + 16 * count - 1, second, texel, 16, 16)
        if selection == 1:
            share = other
        else:
            alpha_share = other
    rgb = wp.vec3()
    for c in range(3):
        start = at + (c * 2 * subsets + 2 * subset) * colour
        a = end_of(bits_of(low, high, start, colour), colour, p0)
        b = end_of(bits_of(low, high, start + colour, colour), colour, p1)
        rgb[c] = float(mixed(a, b, share))
    if rotation > 0:  # a channel is swapped with alpha; only modes with one subset have a rotation
        a = end_of(bits_of(low, high, alpha_at, alpha), alpha, p0)
        b = end_of(bits_of(low, high, alpha_at + alpha, alpha), alpha, p1)
        rgb[rotation - 1] = float(mixed(a, b, alpha_share))
    return rgb


@wp.func
def frame_colour(stored: StoredFrames, frame: int, y: int, x: int) -> wp.vec3:
    """Decodes a texel of a frame to colour in gamma space."""
    low = stored.blocks[frame, y // 4, x // 4, 0]
    high = stored.blocks[frame, y // 4, x // 4, 1]
    level = block_texel(low, high, stored.tables, 4 * (y % 4) + x % 4) / 255.0
    return stored.least[frame] + wp.cw_mul(level, stored.span[frame])


@wp.func
def frame_radiance(stored: StoredFrames, early: int, late: int, share: float, n: int, y: int, x: int) -> wp.vec3:
    """Interpolates a texel's linear radiance between two frames; `share` is the weight of the later frame."""
    light = powers(frame_colour(stored, n * stored.times + early, y, x), stored.gamma)
    if share > 0.0:
        other = powers(frame_colour(stored, n * stored.times + late, y, x), stored.gamma)
        light = (1.0 - share) * light + share * other
    return light


@wp.kernel
def _decode(
    # in:
    stored: StoredFrames,
    early: int,
    late: int,
    share: float,
    tiles: wp.array1d[int],
    # out:
    out: wp.array3d[wp.vec3],
):
    i, y, x = wp.tid()
    out[i, y, x] = frame_radiance(stored, early, late, share, tiles[i], y, x)


def decode(stored: StoredFrames, early: int, late: int, share: float, tiles: wp.array, out: wp.array) -> None:
    """Decodes tiles at one time with one kernel launch.

    Args:
        stored: The frames.
        early, late, share: Indices of the two frames around the time, and the weight of the later one, 0 to below 1.
        tiles: int [n], the tiles to decode.
        out: vec3 [n, 128, 128], written: linear radiance.
    """
    wp.launch(_decode, out.shape, inputs=[stored, early, late, share, tiles], outputs=[out], device=out.device)
