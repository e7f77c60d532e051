"""Feature patches of triangles and their similarity (lightmap-uv-clustering-cascade, section 3.1, eq. 1 to 4).

A patch of size n stores a triangle's colours on a triangular lattice: sample (i, j, k), i + j + k = n - 1, lies at the
barycentrics (i, j, k) / (n - 1), and is stored at `j n - j (j - 1) / 2 + i`. Another order of the vertices only
permutes (i, j, k), so one stored patch serves all six orders. Order o is the permutation p = `ORDERS[o]`: vertex k of
one triangle goes to vertex p[k] of the other.

Sizes are 2, 3, 5, 9 and so on (`SIZES`), so that every lattice lies in all larger ones. A patch of one colour has the
smallest size, whatever the size of the triangle, since interpolating it gives that colour everywhere.

Colours have 8 bits per channel, packed as r + 256 g + 65536 b. Every decision is made in integers, so that no result
depends on the device:

- The lightmap has 16 bits per channel, vertices are in 1/65536 of a texel, and a sample's place is rounded to 1/256 of
  a texel, as texture filters of GPUs do.
- Dist (eq. 2) is summed exactly, in 64 bits. If two patches differ in size, the smaller one is interpolated linearly
  in the triangles of its lattice, in multiples of 1 / (n - 1) of an 8-bit level. Triangles favour no vertex; in square
  cells the result would depend on the order of the vertices.

The paper does not define |.| of a colour. Here it is the mean of |.| over the three channels, as fractions of 255, so
that Dist is in [0, 1].

`tests/reference/patches.py` computes the same per triangle in float64 NumPy and is easier to read.
"""

import itertools

import numpy as np
import warp as wp

ORDERS = tuple(itertools.permutations(range(3)))
"""The six orders of a triangle's vertices, as permutations p; order 0 is the identity."""

SIZES = tuple(2**level + 1 for level in range(13))
"""Sizes of patches in samples along a side, up to 4097."""

BINS = 32
"""Number of bins of the colour histogram per channel (section 3.2.1)."""

_LEVELS = wp.constant(255)
_BIN_SHIFT = wp.constant(3)  # 256 levels in 32 bins
_BEYOND = wp.constant(BINS**3)

# This divisor converts 16 bits, weighted with a sum of 256 * 256, to 8 bits.
_TO_BYTE = wp.constant(wp.int64(65536 * 257))
_HALF_BYTE = wp.constant(wp.int64(65536 * 257 // 2))


@wp.struct
class Patch:
    """A patch, which stores the colours of a triangle, without its samples: the index of its first one in the array of
    all, and the index `level` of its size n in `SIZES`, n = 2 ** level + 1. Packed as colours, it has the lowest and
    highest value of each channel, and the histogram bin of the dominant colour, one number per channel."""

    start: int
    level: int
    low: int
    high: int
    colour: int


def samples_of(size):
    """Returns the number of samples of a patch of size n: n (n + 1) / 2."""
    return size * (size + 1) // 2


@wp.func
def size_of(level: int) -> int:
    return (1 << level) + 1


@wp.func
def _index(size: int, i: int, j: int) -> int:
    return j * size - j * (j - 1) // 2 + i


@wp.func
def channel(colour: int, c: int) -> int:
    return (colour >> (8 * c)) & _LEVELS


@wp.func
def _place(i: int, j: int, k: int, a: wp.int64, b: wp.int64, c: wp.int64, side: int) -> int:
    """Returns a sample's position along an axis of `side` texels in 1/256 texel, clamped to the outer texel centres."""
    steps = wp.int64(i + j + k)
    last = wp.int64(side - 1) * wp.int64(65536) * steps
    at = wp.clamp(wp.int64(i) * a + wp.int64(j) * b + wp.int64(k) * c, wp.int64(0), last)
    return int((at + wp.int64(128) * steps) // (wp.int64(256) * steps))


@wp.func
def _bright_inside(lightmap: wp.array3d[wp.uint16], corner: wp.array3d[wp.int64], t: int) -> int:
    """Returns 1 if the centre of a texel that is too bright lies inside triangle t or on its border, else 0."""
    low = wp.vec2i()
    high = wp.vec2i()
    for a in range(2):
        least = wp.min(corner[t, 0, a], wp.min(corner[t, 1, a], corner[t, 2, a]))
        most = wp.max(corner[t, 0, a], wp.max(corner[t, 1, a], corner[t, 2, a]))
        last = wp.int64(lightmap.shape[1 - a] - 1)
        low[a] = int(wp.clamp((least + wp.int64(65535)) >> wp.int64(16), wp.int64(0), last))
        high[a] = int(wp.clamp(most >> wp.int64(16), wp.int64(0), last))
    for y in range(low[1], high[1] + 1):
        for x in range(low[0], high[0] + 1):
            if lightmap[y, x, 3] != wp.uint16(0):
                px = wp.int64(x) << wp.int64(16)
                py = wp.int64(y) << wp.int64(16)
                left = int(0)
                right = int(0)
                for v in range(3):
                    w = (v + 1) % 3
                    across = (corner[t, w, 0] - corner[t, v, 0]) * (py - corner[t, v, 1])
                    across -= (corner[t, w, 1] - corner[t, v, 1]) * (px - corner[t, v, 0])
                    left += wp.where(across > wp.int64(0), 1, 0)
                    right += wp.where(across < wp.int64(0), 1, 0)
                if left == 0 or right == 0:
                    return 1
    return 0


@wp.kernel(enable_backward=False)
def _sample(
    # in:
    lightmap: wp.array3d[wp.uint16],
    corner: wp.array3d[wp.int64],
    start: wp.array1d[int],
    level: wp.array1d[int],
    # out:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    bright: wp.array1d[wp.uint8],
):
    t = wp.tid()
    n = size_of(level[t])
    rows = lightmap.shape[0]
    columns = lightmap.shape[1]
    low = wp.vec3i(255, 255, 255)
    high = wp.vec3i(0, 0, 0)
    over = int(0)
    at = start[t]
    for j in range(n):
        for i in range(n - j):
            k = n - 1 - i - j
            x = _place(i, j, k, corner[t, 0, 0], corner[t, 1, 0], corner[t, 2, 0], columns)
            y = _place(i, j, k, corner[t, 0, 1], corner[t, 1, 1], corner[t, 2, 1], rows)
            sums = wp.vec3l()
            for tap in range(4):
                u = (x >> 8) + (tap & 1)
                v = (y >> 8) + (tap >> 1)
                w = wp.where((tap & 1) == 1, x & 255, 256 - (x & 255))
                w *= wp.where((tap >> 1) == 1, y & 255, 256 - (y & 255))
                # Texels beyond the border have weight 0 and must not be read.
                if w > 0:
                    for c in range(3):
                        sums[c] += wp.int64(w) * wp.int64(lightmap[v, u, c])
                    over = wp.max(over, int(lightmap[v, u, 3]))
            colour = int(0)
            for c in range(3):
                value = int((sums[c] + _HALF_BYTE) // _TO_BYTE)
                low[c] = wp.min(low[c], value)
                high[c] = wp.max(high[c], value)
                colour += value << (8 * c)
            samples[at] = colour
            at += 1
    if over == 0:
        over = _bright_inside(lightmap, corner, t)
    p = Patch()
    p.start = start[t]
    p.level = level[t]
    p.low = low[0] + (low[1] << 8) + (low[2] << 16)
    p.high = high[0] + (high[1] << 8) + (high[2] << 16)
    if p.low == p.high:
        p.level = 0
    patches[t] = p
    bright[t] = wp.uint8(over)


@wp.func
def _bin(colour: int) -> int:
    """Returns the index of a colour's histogram bin, with red in the highest bits."""
    r = channel(colour, 0) >> _BIN_SHIFT
    g = channel(colour, 1) >> _BIN_SHIFT
    b = channel(colour, 2) >> _BIN_SHIFT
    return (r << 10) + (g << 5) + b


@wp.kernel(enable_backward=False)
def _dominant(
    # in:
    samples: wp.array1d[int],
    # out:
    patches: wp.array1d[Patch],
):
    """Finds the dominant colour of one patch per thread: goes through the histogram bins that have samples, from the
    lowest to the highest, counts the samples in each, and takes the colour of the fullest bin."""
    t = wp.tid()
    p = patches[t]
    size = size_of(p.level)
    stop = p.start + size * (size + 1) // 2
    best = int(0)
    most = int(0)
    key = int(-1)  # below the first bin
    while key < _BEYOND:
        after = int(_BEYOND)
        count = int(0)
        for i in range(p.start, stop):
            other = _bin(samples[i])
            if other == key:
                count += 1
            elif other > key and other < after:
                after = other
        if count > most:
            most = count
            best = key
        key = after
    p.colour = (best >> 10) + (((best >> 5) & 31) << 8) + ((best & 31) << 16)
    patches[t] = p


@wp.func
def _difference(a: int, b: int) -> int:
    return (
        wp.abs(channel(a, 0) - channel(b, 0))
        + wp.abs(channel(a, 1) - channel(b, 1))
        + wp.abs(channel(a, 2) - channel(b, 2))
    )


@wp.func
def turned(w: wp.vec3i, order: int) -> wp.vec3i:
    """Permutes a vector: returns (w[p[0]], w[p[1]], w[p[2]]), where p is the permutation `ORDERS[order]`."""
    if order == 0:
        return w
    if order == 1:
        return wp.vec3i(w[0], w[2], w[1])
    if order == 2:
        return wp.vec3i(w[1], w[0], w[2])
    if order == 3:
        return wp.vec3i(w[1], w[2], w[0])
    if order == 4:
        return wp.vec3i(w[2], w[0], w[1])
    return wp.vec3i(w[2], w[1], w[0])


@wp.func
def _inverse(order: int) -> int:
    """Returns the order with the inverse permutation: another one only for the two rotations, orders 3 and 4."""
    if order == 3:
        return 4
    if order == 4:
        return 3
    return order


@wp.func
def spread(samples: wp.array1d[int], small: Patch, i: int, j: int, level: int) -> wp.vec3i:
    """Returns the colour of a patch at (i, j) of the lattice of size 2 ** level + 1, times 2 ** level, which makes it
    whole. The patch's own lattice must not be larger; if it is smaller, the colour is interpolated."""
    # One step of the small lattice is 2 ** shift steps of the other.
    shift = level - small.level
    size = size_of(small.level)
    mask = (1 << shift) - 1
    k = (1 << level) - i - j
    rx = i & mask
    ry = j & mask
    rz = k & mask
    x = i >> shift
    y = j >> shift
    rest = rx + ry + rz
    a = samples[small.start + _index(size, x, y)]
    if rest == 0:
        return (1 << level) * wp.vec3i(channel(a, 0), channel(a, 1), channel(a, 2))
    b = samples[small.start + _index(size, x, y + 1)]
    c = samples[small.start + _index(size, x + 1, y)]
    # In an upright triangle of the lattice the corners have z, y or x one step higher.
    wa = rz
    wb = ry
    wc = rx
    if rest > mask + 1:
        # In an inverted one all coordinates except z, except x or except y are one step higher.
        a = samples[small.start + _index(size, x + 1, y + 1)]
        wa = mask + 1 - rz
        wb = mask + 1 - rx
        wc = mask + 1 - ry
    return (1 << small.level) * wp.vec3i(
        wa * channel(a, 0) + wb * channel(b, 0) + wc * channel(c, 0),
        wa * channel(a, 1) + wb * channel(b, 1) + wc * channel(c, 1),
        wa * channel(a, 2) + wb * channel(b, 2) + wc * channel(c, 2),
    )


@wp.func
def distance_sum(samples: wp.array1d[int], large: Patch, small: Patch, order: int, limit: wp.int64) -> wp.int64:
    """Sums the absolute colour differences of two patches over the samples of the large one, with vertex k of the small
    patch on vertex p[k] of the large one, p = `ORDERS[order]`; in levels, or for two sizes in 1 / (n - 1) of a level,
    where n is the larger size. Stops early once the sum reaches `limit`."""
    steps = 1 << large.level
    size = steps + 1
    at = large.start
    total = wp.int64(0)
    for j in range(size):
        for i in range(size - j):
            w = turned(wp.vec3i(i, j, steps - i - j), order)
            a = samples[at]
            at += 1
            if small.level == large.level:
                total += wp.int64(_difference(a, samples[small.start + _index(size, w[0], w[1])]))
            else:
                b = spread(samples, small, w[0], w[1], large.level)
                total += wp.int64(
                    wp.abs(steps * channel(a, 0) - b[0])
                    + wp.abs(steps * channel(a, 1) - b[1])
                    + wp.abs(steps * channel(a, 2) - b[2])
                )
        if total >= limit:
            return total
    return total


@wp.kernel(enable_backward=False)
def _compare(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    member: wp.array1d[int],
    representative: wp.array1d[int],
    # out:
    order: wp.array1d[wp.int8],
    distance: wp.array1d[wp.float64],
):
    t = wp.tid()
    a = patches[representative[t]]
    b = patches[member[t]]
    large = a
    small = b
    if a.level < b.level:
        large = b
        small = a
    limit = wp.int64(0x7FFFFFFFFFFFFFFF)
    best = int(0)
    for o in range(6):
        permutation = o
        if a.level < b.level:
            permutation = _inverse(o)
        total = distance_sum(samples, large, small, permutation, limit)
        if total < limit:
            limit = total
            best = o
    order[t] = wp.int8(best)
    size = wp.int64(size_of(large.level))
    levels = wp.int64(765) * (size * (size + wp.int64(1)) // wp.int64(2))
    if large.level != small.level:
        levels *= size - wp.int64(1)
    distance[t] = wp.float64(limit) / wp.float64(levels)


def sample(lightmap: np.ndarray, corner: np.ndarray, level: np.ndarray, device) -> tuple:
    """Samples the colours of F triangles as patches (section 3.1).

    Args:
        lightmap: uint16 [H, W, 4]: red, green, blue, and 1 where the texel exceeds their range (is too bright), else 0.
        corner: int64 [F, 3, 2], (x, y) of the vertices in 1/65536 of a texel from the centre of texel (0, 0).
        level: int32 [F], index in `SIZES` of the size of each triangle's patch.
        device: Device of the results.

    Returns:
        The samples of all patches, int; the patches, Patch [F], still without dominant colours; and uint8 [F], 1 for
        triangles that contain the centre of a texel that is too bright, or whose patch reads one.
    """
    start = np.concatenate([[0], np.cumsum(samples_of(np.array(SIZES, np.int64))[level])])
    if start[-1] > np.iinfo(np.int32).max:
        raise ValueError(f"level: expected at most {np.iinfo(np.int32).max} samples in all patches, got {start[-1]}")
    samples = wp.empty(int(start[-1]), dtype=int, device=device)
    patches = wp.empty(len(level), dtype=Patch, device=device)
    bright = wp.empty(len(level), dtype=wp.uint8, device=device)
    inputs = [
        wp.array(lightmap, dtype=wp.uint16, device=device),
        wp.array(corner, dtype=wp.int64, device=device),
        wp.array(start[:-1].astype(np.int32), dtype=int, device=device),
        wp.array(level, dtype=int, device=device),
    ]
    wp.launch(_sample, len(level), inputs=inputs, outputs=[samples, patches, bright], device=device)
    return samples, patches, bright


def dominant(samples, patches) -> None:
    """Sets the dominant colour of each patch of `sample`: the most frequent of 32 x 32 x 32 histogram bins
    (section 3.2.1). Of equally frequent bins it is the lowest."""
    wp.launch(_dominant, patches.shape, inputs=[samples], outputs=[patches], device=samples.device)


def compare(samples, patches, member, representative) -> tuple[np.ndarray, np.ndarray]:
    """Finds for each of N pairs of patches, `member` and `representative`, int [N], the order of vertices with the
    least distance Dist (eq. 2 and 3), the first if several are equal. Returns the orders o, int8 [N], such that vertex
    k of the member maps to vertex `ORDERS[o][k]` of the representative; and the distances, float64 [N], in [0, 1]."""
    device, count = samples.device, member.shape[0]
    order = wp.empty(count, dtype=wp.int8, device=device)
    distance = wp.empty(count, dtype=wp.float64, device=device)
    inputs = [samples, patches, member, representative]
    wp.launch(_compare, count, inputs=inputs, outputs=[order, distance], device=device)
    return order.numpy(), distance.numpy()
