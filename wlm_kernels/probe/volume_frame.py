"""Updates the nested grids of light around a viewer (`volume`) in each frame: finds the blocks whose light is missing,
decodes the nearest ones, and stores their light in rows of the array `pool`.

The launches of a frame have fixed sizes, so that a CUDA graph can contain them:

1. `Look` copies the new windows; `select` finds for each slot its block, whether a probe is near the block, and whether
   the pool still has its light. The blocks near probes that the pool lacks wait, counted by distance to the viewer.
   After them wait stale blocks, whose light is of another hour, by distance over the hours between; every fourth
   frame has these first, so that neither blocks without a row nor a fast viewer keep all others stale.
2. `select` then finds the distance within which enough blocks wait, gathers these blocks and ranks them. The nearest
   are decoded, by distances in units of their own edge; at equal distances first the finer block, then the lower slot.
3. Each chosen block gets a row of the pool: its own, if there is one for every block near a probe; else the least
   recently used row of a group of rows: each block takes from another group, and groups take turns. A row whose block
   is in a window is never given away.
4. `search` finds the probes within a block's reach, as 64 ranges of the probes sorted by cell; `volume_weights`
   computes weights of at most 16 of these probes.
5. `combine` computes a block's light as the weighted sum of these probes, clamped to the range of their values, which
   is extended by half its width on both sides, and stores it in half floats, with a factor for each row. A block whose
   light is not in memory yet, -infinity at a probe, gives its row back and waits.
"""

import numpy as np
import warp as wp

from wlm_kernels.least_recent import least_recent
from wlm_kernels.probe.volume import inside, wrap

PROBES = 16  # most probes that contribute to a block
HALVES = 64  # cells of a block's reach: four half sides along each axis
BINS = 4096  # bins of the distance, a cube of 16
TOTALS = BINS + BINS // 16 + BINS // 256  # with the sums over 16 bins, and over 256
GROUP = 64  # rows of the pool from which one is chosen
MOST = 4096  # most blocks that are ranked
QUEUED, DROPPED, CACHED, LEFT, UPDATED, DECODED, GATHERED, LACKING = range(8)
"""Counters of a frame; the last two are of the gathered blocks, and of those whose light is not in memory yet."""
STALE_FIRST = 4
"""A frame whose number this divides decodes stale blocks before missing ones."""
WAITING = -2
"""Entry of the page table for a block near probes whose light is missing; -1 for a block without a probe."""

_PROBES = wp.constant(PROBES)
_QUEUED, _DROPPED, _CACHED, _LEFT, _UPDATED, _GATHERED, _LACKING = (
    wp.constant(i) for i in (QUEUED, DROPPED, CACHED, LEFT, UPDATED, GATHERED, LACKING)
)
_WAITING = wp.constant(WAITING)
_LARGEST = wp.constant(16384.0)  # of the numbers in a row of the pool: half floats hold it
_BINS = wp.constant(BINS)
_DAY, _NOON, _SOON = (wp.constant(hours) for hours in (24.0, 12.0, 0.1))
_STALE_FIRST = wp.constant(STALE_FIRST)
_SIXTEENS = wp.constant(BINS + BINS // 16)
_BEYOND = wp.constant(0.5)  # share of the probes' range by which light is extrapolated at most
_LIMIT = wp.constant(1 << 20)  # blocks along an axis of the finest level
SPREAD = (0x001F00000000FFFF, 0x001F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249)
"""Masks of Morton keys: after shifts by 32, 16, 8, 4 and 2, they spread 21 bits out to every third bit."""

_M0, _M1, _M2, _M3, _M4 = (wp.constant(wp.int64(mask)) for mask in SPREAD)

vec16i = wp.types.vector(length=16, dtype=int)

Row = wp.types.vector(length=PROBES, dtype=float)

LEVELS = 8
Bases = wp.types.matrix(shape=(LEVELS, 3), dtype=int)
Views = wp.types.matrix(shape=(LEVELS, 4), dtype=float)


@wp.struct
class Index:
    """N probes sorted by the cell of a grid, and the W blocks near probes; see `wlm.probe.volume.index`.

    Attributes:
        key: [N], Morton keys of the probes' cells, rising.
        number: [N], index of each probe in the input.
        place: [N], position of each probe in its cell, 0 to 1 along each axis.
        normal: [N], unit normal of the surface on which each probe lies, 0 if there is none; or [0]: none is known.
        block: [W], Morton keys of the blocks, rising within a level.
        level_start: [L + 1], index in `block` at which each level begins.
        ratios: [L], edge of a block of each level divided by that of the finest level.
    """

    key: wp.array1d[wp.int64]
    number: wp.array1d[int]
    place: wp.array1d[wp.vec3]
    normal: wp.array1d[wp.vec3]
    block: wp.array1d[wp.int64]
    level_start: wp.array1d[int]
    ratios: wp.array1d[int]


@wp.struct
class Windows:
    """The windows of all L levels, with S slots in all, each of which holds one block.

    Attributes:
        starts, sides, bases, views: [L], see `wlm_kernels.probe.volume`.
        before: [L], the bases of the frame before.
        pages: [S], row of the light of each slot's block in the pool; -1 or `WAITING` where it is missing.
    """

    starts: wp.array1d[int]
    sides: wp.array1d[wp.vec3i]
    bases: wp.array1d[wp.vec3i]
    before: wp.array1d[wp.vec3i]
    views: wp.array1d[wp.vec4]
    pages: wp.array1d[wp.int16]


@wp.struct
class Pool:
    """Which blocks have their light in the R rows of the pool, because they are in a window or were lately.

    Attributes:
        light: [R, D], half floats, the blocks' light in units of `factor`.
        factor: [R].
        rows: [W], row of the light of each block in `Index.block`, or -1.
        hour: [R], hour of the day of each row's light, if light changes over the day; or [0].
        stamp: [R], last frame in which the row's block was in a window; -1 for an empty row. [0] where R = W: row w is
            that of block w, and no row is given away.
        owner: [R] or [0], as `stamp`: index in `Index.block` of the row's block, or -1.
    """

    light: wp.array2d[wp.int16]
    factor: wp.array1d[float]
    stamp: wp.array1d[int]
    owner: wp.array1d[int]
    rows: wp.array1d[int]
    hour: wp.array1d[float]


@wp.struct
class Work:
    """Data that the launches of a frame pass on; a frame decodes at most B blocks, from at most P <= 16 probes each.

    Attributes:
        clock: [1], the frame's number.
        hour: [1], hour of the day of the light that is decoded.
        counters: [8], counts of blocks and probes in this frame.
        histogram: [TOTALS], number of blocks that wait to be decoded, by distance.
        gathered: [G], slots of the gathered blocks.
        distance: [G], rank of each gathered block: its squared distance from the viewer in units of the block's edge,
            over hours if it is stale, and more for the kind that comes second.
        chosen: [B], slots of the chosen blocks, or -1.
        taken: [B], row of the pool for each chosen block, or -1.
        blocks: [B], coordinates of each chosen block, and its level.
        begin, count: [B, 64], first index and length of each range of probes in `Index` near a chosen block.
        picked: [B], number of probes that contribute to a block, P at most.
        noise: [B], variance of the noise of each contributing probe.
        places: [B, P], position of each contributing probe relative to the block's centre, in units of the block's
            edge, and the probe's additional variance of noise.
        rows: [B, P], covariance of each probe with the probes before it and with itself, then 0.
        hats: [B, P], covariance of each probe with the block.
        numbers: [B * P], index of each contributing probe in the input, or -1.
        weights: [B, P], weight of each contributing probe.
    """

    clock: wp.array1d[int]
    hour: wp.array1d[float]
    counters: wp.array1d[int]
    histogram: wp.array1d[int]
    gathered: wp.array1d[int]
    distance: wp.array1d[float]
    chosen: wp.array1d[int]
    taken: wp.array1d[int]
    blocks: wp.array1d[wp.vec4i]
    begin: wp.array2d[int]
    count: wp.array2d[int]
    picked: wp.array1d[int]
    noise: wp.array1d[float]
    places: wp.array2d[wp.vec4]
    rows: wp.array2d[Row]
    hats: wp.array2d[float]
    numbers: wp.array1d[int]
    weights: wp.array2d[float]


@wp.func
def _spread(i: int) -> wp.int64:
    b = wp.int64(i)
    b = (b | b << wp.int64(32)) & _M0
    b = (b | b << wp.int64(16)) & _M1
    b = (b | b << wp.int64(8)) & _M2
    b = (b | b << wp.int64(4)) & _M3
    return (b | b << wp.int64(2)) & _M4


@wp.func
def morton(cell: wp.vec3i) -> wp.int64:
    return _spread(cell[0]) | _spread(cell[1]) << wp.int64(1) | _spread(cell[2]) << wp.int64(2)


@wp.func
def _gather_bits(key: wp.int64) -> int:
    b = key & _M4
    b = (b | b >> wp.int64(2)) & _M3
    b = (b | b >> wp.int64(4)) & _M2
    b = (b | b >> wp.int64(8)) & _M1
    b = (b | b >> wp.int64(16)) & _M0
    return int((b | b >> wp.int64(32)) & wp.int64(0x1FFFFF))


@wp.func
def cell_of(key: wp.int64) -> wp.vec3i:
    """Returns the cell of a Morton key."""
    return wp.vec3i(_gather_bits(key), _gather_bits(key >> wp.int64(1)), _gather_bits(key >> wp.int64(2)))


@wp.func
def _lower(keys: wp.array1d[wp.int64], first: int, last: int, key: wp.int64) -> int:
    """Returns the first index i in the sorted keys[first:last] with keys[i] >= key, or `last` if there is none."""
    low = first
    high = last
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def _find(index: Index, level: int, block: wp.vec3i) -> int:
    if wp.min(wp.min(block[0], block[1]), block[2]) < 0 or wp.max(wp.max(block[0], block[1]), block[2]) >= _LIMIT:
        return -1
    last = index.level_start[level + 1]
    key = morton(block)
    i = _lower(index.block, index.level_start[level], last, key)
    if i < last:
        if index.block[i] == key:
            return i
    return -1


@wp.func
def _locate(windows: Windows, s: int):
    """Returns the level of slot s, and the place of its block in the window, from 0 along each axis."""
    level = int(0)
    for i in range(1, windows.starts.shape[0]):
        if s >= windows.starts[i]:
            level = i
    n = windows.sides[level]
    base = windows.bases[level]
    at = s - windows.starts[level]
    x = wrap(at // (n[1] * n[2]) - base[0], n[0])
    y = wrap(at // n[2] % n[1] - base[1], n[1])
    z = wrap(at % n[2] - base[2], n[2])
    return level, wp.vec3i(x, y, z)


@wp.func
def _distance(windows: Windows, level: int, local: wp.vec3i) -> float:
    """Returns the squared distance of a block from the viewer, who is moved into the window if outside of it."""
    view = windows.views[level]
    n = windows.sides[level]
    x = float(local[0]) - wp.clamp(view[0], 0.0, float(n[0] - 1))
    y = float(local[1]) - wp.clamp(view[1], 0.0, float(n[1] - 1))
    z = float(local[2]) - wp.clamp(view[2], 0.0, float(n[2] - 1))
    return x * x + y * y + z * z


@wp.func
def _rank_of(
    windows: Windows, pool: Pool, work: Work, tolerance: float, side: int, level: int, local: wp.vec3i, row: int
) -> float:
    """Returns the rank among waiting blocks of a block whose light is in a row of the pool, or is missing; lower ones
    are decoded first. It is negative if the block does not wait."""
    rank = float(-1.0)
    farthest = 3.0 * float(side * side)
    stale_first = work.clock[0] % _STALE_FIRST == 0
    if row == _WAITING:
        rank = wp.where(stale_first, farthest, 0.0) + _distance(windows, level, local)
    elif row >= 0 and pool.hour.shape[0] > 0:
        late = wp.abs(work.hour[0] - pool.hour[row])
        late = wp.where(late > _NOON, _DAY - late, late)
        if late > tolerance:
            share = _SOON / wp.max(late, _SOON)  # a block twice as far away comes when it is twice as late
            rank = wp.where(stale_first, 0.0, farthest) + share * share * _distance(windows, level, local)
    return rank


@wp.func
def _bin(rank: float, side: int) -> int:
    return wp.min(int(rank * float(_BINS) / (6.0 * float(side * side))), _BINS - 1)


@wp.kernel(enable_backward=False)
def _look(bases: Bases, before: Bases, views: Views, frame: int, hour: float, windows: Windows, work: Work):
    i = wp.tid()
    if i < windows.bases.shape[0]:
        windows.bases[i] = wp.vec3i(bases[i, 0], bases[i, 1], bases[i, 2])
        windows.before[i] = wp.vec3i(before[i, 0], before[i, 1], before[i, 2])
        windows.views[i] = wp.vec4(views[i, 0], views[i, 1], views[i, 2], views[i, 3])
    if i == 0:
        work.clock[0] = frame
        work.hour[0] = hour
    if i < work.counters.shape[0]:
        work.counters[i] = 0
    if i < work.chosen.shape[0]:
        work.chosen[i] = -1


@wp.kernel(enable_backward=False)
def _scroll(index: Index, windows: Windows, pool: Pool, tolerance: float, side: int, work: Work):
    s = wp.tid()
    level, local = _locate(windows, s)
    block = windows.bases[level] + local
    row = int(windows.pages[s])
    if not inside(block - windows.before[level], windows.sides[level]):
        if row == _WAITING:
            wp.atomic_add(work.counters, _DROPPED, 1)
        row = int(-1)
        wanted = _find(index, level, block)
        if wanted >= 0:
            row = pool.rows[wanted]
            wp.atomic_add(work.counters, wp.where(row >= 0, _CACHED, _QUEUED), 1)
            if row < 0:
                row = _WAITING
        windows.pages[s] = wp.int16(row)
    if row >= 0 and pool.stamp.shape[0] > 0:
        pool.stamp[row] = work.clock[0]
    rank = _rank_of(windows, pool, work, tolerance, side, level, local, row)
    if rank >= 0.0:
        bin = _bin(rank, side)
        wp.atomic_add(work.histogram, bin, 1)
        wp.atomic_add(work.histogram, _BINS + bin // 16, 1)
        wp.atomic_add(work.histogram, _SIXTEENS + bin // 256, 1)


@wp.func
def _descend(histogram: wp.array1d[int], first: int, budget: int, before: int):
    """Adds the 16 counts from histogram[first] on to `before` until the sum reaches `budget`. Returns which count, 0 to
    15, reached it (15 if none did), and the sum before this count."""
    counts = vec16i()
    for i in range(16):  # unrolled, so that all loads are in flight at once
        counts[i] = histogram[first + i]
    at = int(15)
    sum_before = before
    found = int(0)
    for i in range(16):
        if found == 0:
            if before + counts[i] >= budget or i == 15:
                at = i
                sum_before = before
                found = 1
            before += counts[i]
    return at, sum_before


@wp.func
def _limit(histogram: wp.array1d[int], budget: int) -> int:
    """Returns the last bin of the histogram whose blocks are gathered, so that there are enough."""
    group, before = _descend(histogram, _SIXTEENS, budget, 0)
    sixteen, before_sixteen = _descend(histogram, _BINS + 16 * group, budget, before)
    bin, _before = _descend(histogram, 16 * (16 * group + sixteen), budget, before_sixteen)
    return 16 * (16 * group + sixteen) + bin


@wp.kernel(enable_backward=False)
def _gather(windows: Windows, pool: Pool, tolerance: float, side: int, work: Work):
    s = wp.tid()
    if s == 0:
        total = int(0)
        for i in range(16):
            total += work.histogram[_SIXTEENS + i]
        work.counters[_LEFT] = total
    row = int(windows.pages[s])
    if row == _WAITING or (row >= 0 and pool.hour.shape[0] > 0):
        level, local = _locate(windows, s)
        rank = _rank_of(windows, pool, work, tolerance, side, level, local, row)
        # Each thread that has a waiting block finds the limit itself, which saves a launch.
        if rank >= 0.0 and _bin(rank, side) <= _limit(work.histogram, work.chosen.shape[0]):
            i = wp.atomic_add(work.counters, _GATHERED, 1)
            if i < work.gathered.shape[0]:
                work.gathered[i] = s
                work.distance[i] = rank


@wp.kernel(enable_backward=False)
def _rank(work: Work):
    i = wp.tid()
    if i < work.histogram.shape[0]:
        work.histogram[i] = 0
    count = wp.min(work.counters[_GATHERED], work.gathered.shape[0])
    if i < count:
        slot = work.gathered[i]
        away = work.distance[i]
        nearer = int(0)
        for j in range(count):
            d = work.distance[j]
            if d < away or (d == away and work.gathered[j] < slot):
                nearer += 1
        if nearer < work.chosen.shape[0]:
            work.chosen[nearer] = slot


@wp.kernel(enable_backward=False)
def _allocate(index: Index, windows: Windows, pool: Pool, size: int, work: Work):
    k = wp.tid()
    taken = int(-1)
    slot = work.chosen[k]
    if slot >= 0:
        level, local = _locate(windows, slot)
        block = windows.bases[level] + local
        wanted = _find(index, level, block)
        work.blocks[k] = wp.vec4i(block[0], block[1], block[2], level)
        if pool.stamp.shape[0] == 0:
            taken = wanted
        elif windows.pages[slot] >= wp.int16(0):
            taken = int(windows.pages[slot])  # a stale block keeps its row
        else:
            frame = work.clock[0]
            taken = least_recent(pool.stamp, size, frame, k, work.chosen.shape[0], frame)
            if taken >= 0:
                before = pool.owner[taken]
                if before >= 0:
                    pool.rows[before] = -1
                pool.owner[taken] = wanted
                pool.stamp[taken] = frame
        if taken >= 0:
            pool.rows[wanted] = taken
            if pool.hour.shape[0] > 0:
                pool.hour[taken] = work.hour[0]
            wp.atomic_add(work.counters, _UPDATED, 1)
            wp.atomic_sub(work.counters, _LEFT, 1)
    work.taken[k] = taken


@wp.kernel(enable_backward=False)
def _find_ranges(index: Index, work: Work):
    k, j = wp.tid()
    count = int(0)
    if work.taken[k] >= 0:
        block = work.blocks[k]
        ratio = index.ratios[block[3]]
        # Coordinates in half sides of the block; a half side is `ratio` cells wide, and a cell of the octree.
        half = 2 * wp.vec3i(block[0], block[1], block[2]) + wp.vec3i(j // 16 - 1, j // 4 % 4 - 1, j % 4 - 1)
        if wp.min(wp.min(half[0], half[1]), half[2]) >= 0:
            last = index.key.shape[0]
            begin = _lower(index.key, 0, last, morton(ratio * half))
            # The cells of one half are neighbours in the list; this is the end of the last one.
            end = _lower(index.key, begin, last, morton(ratio * half + wp.vec3i(ratio - 1)) + wp.int64(1))
            work.begin[k, j] = begin
            count = end - begin
    work.count[k, j] = count


@wp.kernel(enable_backward=False)
def _combine(work: Work, light: wp.array2d[float]):
    """Writes the light of block k over that of its first probe, light[k * P]."""
    k, c = wp.tid()
    many = work.weights.shape[1]
    if work.taken[k] >= 0:
        s = float(0.0)
        low = float(wp.inf)
        high = -float(wp.inf)
        for i in range(_PROBES):
            w = float(0.0)
            if i < many:
                w = work.weights[k, i]
            if w != 0.0:
                value = light[k * many + i, c]
                s += w * value
                low = wp.min(low, value)
                high = wp.max(high, value)
        room = _BEYOND * (high - low)
        value = wp.where(wp.isfinite(s), wp.clamp(s, low - room, high + room), wp.nan)
        light[k * many, c] = wp.where(low == -wp.inf, low, value)


@wp.kernel(enable_backward=False)
def _store(work: Work, light: wp.array2d[float], windows: Windows, pool: Pool):
    k, c = wp.tid()
    row = work.taken[k]
    at = k * work.weights.shape[1]
    if row >= 0 and light[at, 0] == -wp.inf:
        if c == 0:
            slot = work.chosen[k]
            if windows.pages[slot] >= wp.int16(0):
                # It keeps showing its light, which is of another hour.
                hour = pool.hour[row] + _NOON
                pool.hour[row] = wp.where(hour < _DAY, hour, hour - _DAY)
            else:
                block = row
                if pool.stamp.shape[0] > 0:
                    block = pool.owner[row]
                    pool.owner[row] = -1
                    pool.stamp[row] = -1
                pool.rows[block] = -1
            wp.atomic_sub(work.counters, _UPDATED, 1)
            wp.atomic_add(work.counters, _LEFT, 1)
            wp.atomic_add(work.counters, _LACKING, 1)
    elif row >= 0:
        most = float(0.0)
        finite = int(1)
        for j in range(light.shape[1]):
            value = light[at, j]
            most = wp.max(most, wp.abs(value))
            if not wp.isfinite(value):
                finite = 0
        factor = most / _LARGEST
        number = float(0.0)
        if finite == 0:
            factor = wp.nan  # whoever reads the block is told
        elif factor > 0.0:
            number = light[at, c] / factor
        pool.light[row, c] = wp.cast(wp.float16(number), wp.int16)
        if c == 0:
            pool.factor[row] = factor
            windows.pages[work.chosen[k]] = wp.int16(row)


@wp.kernel(enable_backward=False)
def _take_rows(values: wp.array2d[float], numbers: wp.array1d[int], out: wp.array2d[float]):
    i, c = wp.tid()
    out[i, c] = values[wp.max(numbers[i], 0), c]


@wp.kernel(enable_backward=False)
def _take_points(
    # in:
    points: wp.array1d[wp.vec3],
    regions: wp.array1d[int],
    numbers: wp.array1d[int],
    # out:
    out: wp.array1d[wp.vec3],
    region: wp.array1d[int],
):
    i = wp.tid()
    number = numbers[i]
    out[i] = points[wp.max(number, 0)]
    if region.shape[0] > 0:
        region[i] = wp.where(number >= 0, regions[wp.max(number, 0)], -1)


class Look:
    """A launch, prepared once, that copies a frame's windows and number to the device.

    A volume makes one such object, since packing all arguments again takes longer than the launch.

    Args:
        windows, work: Every launch writes the bases and views of `windows` and `work.clock`, and resets `work.counters`
            and `work.chosen`.
        scales: [L], 1 / edge of a block of each level.
    """

    def __init__(self, windows: Windows, work: Work, scales: np.ndarray) -> None:
        count = max(LEVELS, work.counters.shape[0], work.chosen.shape[0])
        self._bases, self._before = np.zeros((2, LEVELS, 3), np.int32)
        self._views = np.zeros((LEVELS, 4), np.float32)
        self._views[: len(scales), 3] = scales
        # The launch reads its arguments from these arrays' memory.
        places = [Bases.from_buffer(self._bases), Bases.from_buffer(self._before), Views.from_buffer(self._views)]
        self._launch = wp.launch(
            _look, count, [*places, 0, 0.0, windows, work], device=work.clock.device, record_cmd=True
        )

    def __call__(self, bases: np.ndarray, before: np.ndarray, origins: np.ndarray, frame: int, hour: float) -> None:
        """Launches the kernel on the current stream.

        Args:
            bases: Integers [L, 3], coordinates of the first block of each level's window.
            before: Integers [L, 3], the same of the frame before.
            origins: [L, 3], origin of the points in each window, see `wlm_kernels.probe.volume`.
            frame: Number of the frame, higher than in the frame before.
            hour: Hour of the day of the light that is decoded; any number if light does not change.
        """
        count = len(bases)
        self._bases[:count], self._before[:count], self._views[:count, :3] = bases, before, origins
        self._launch.set_param_at_index(3, frame)
        self._launch.set_param_at_index(4, hour)
        self._launch.launch()


def select(index: Index, windows: Windows, pool: Pool, tolerance: float, side: int, work: Work) -> None:
    """Finds the block of each slot of the windows, chooses the blocks to decode in this frame, and gives each a row of
    the pool; a block whose group of rows has no free one waits for a later frame. `side` is the longest side of the
    windows in blocks; light that is more than `tolerance` hours off is decoded again."""
    device, slots = work.clock.device, windows.pages.shape
    wp.launch(_scroll, slots, inputs=[index, windows, pool, tolerance, side, work], device=device)
    wp.launch(_gather, slots, inputs=[windows, pool, tolerance, side, work], device=device)
    wp.launch(_rank, max(work.gathered.shape[0], work.histogram.shape[0]), inputs=[work], device=device)
    size = max(1, min(GROUP, pool.stamp.shape[0] // work.chosen.shape[0]))
    wp.launch(_allocate, work.chosen.shape, inputs=[index, windows, pool, size, work], device=device)


def search(index: Index, work: Work) -> None:
    """Finds the probes within reach of each chosen block, as 64 ranges of the sorted probes of `index`."""
    wp.launch(_find_ranges, work.count.shape, inputs=[index, work], device=work.clock.device)


def combine(work: Work, light: wp.array, windows: Windows, pool: Pool) -> None:
    """Writes the light of the chosen blocks to their rows of the pool. Blocks with a probe of -infinity wait again.

    Args:
        work: Data of the frame, after `volume_weights.weigh`.
        light: float [B * P, D], light of the probes `work.numbers`, overwritten.
        windows: The page table, in which the blocks get their rows.
        pool: The light of blocks, written.
    """
    shape = (work.chosen.shape[0], light.shape[1])
    wp.launch(_combine, shape, inputs=[work, light], device=light.device)
    wp.launch(_store, shape, inputs=[work, light, windows, pool], device=light.device)


def take_rows(values: wp.array, numbers: wp.array, out: wp.array) -> None:
    """Copies the rows of `values` [N, D] with indices `numbers` [M] to `out` [M, D]; the index -1 yields any row."""
    wp.launch(_take_rows, out.shape, inputs=[values, numbers, out], device=out.device)


def take_points(points: wp.array, regions: wp.array, numbers: wp.array, out: wp.array, region: wp.array) -> None:
    """Copies the points of `points` [N] with indices `numbers` [M] to `out` [M], and of `regions` [N] to `region` [M],
    where -1 is no point; `region` may be empty."""
    wp.launch(_take_points, out.shape, inputs=[points, regions, numbers], outputs=[out, region], device=out.device)
