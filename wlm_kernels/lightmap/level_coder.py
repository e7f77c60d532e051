"""What `wlm_kernels.lightmap.coder` codes of a tile that is stored as levels: which levels it has, and where.

Of each time and channel come the levels that occur, as steps from one to the next, and then of each valid texel the
place of its level among them. A place follows the texels beside and above it, what these missed in the channels before,
and what they missed at the time before, by weights that are learned on the way (normalised least mean squares).

Predictions are in 16ths of a place, weights in 65536ths.
"""

import warp as wp

from wlm_kernels.lightmap.coder import PREDICTIONS, Coder, Row, begin, ended, finish, number

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

LEVEL_BITS = 10

_CLASSES = 8  # of how much neighbours differ
_LISTS = 3 * _CLASSES  # where the mixtures of the levels that occur begin
_STEP_TREE, _COUNT_TREE = 3, 4  # behind those of the channels

LEVEL_MIXTURES = _LISTS + 1
LEVEL_TREES = _COUNT_TREE + 1

NEAR = 9
"""Differences that a place is learned from."""

_RATE = 5000  # of learning, in 65536ths
_CALM = 4096  # what is added to a sum of squares: a sixteenth of a few places teaches little
_MOST_WEIGHT = 1 << 20

_Near = wp.types.vector(length=NEAR, dtype=int)


@wp.func
def _class_of(differ: int) -> int:
    result = int(0)
    while result < _CLASSES - 1 and wp.lshift(1, result) <= differ:
        result += 1
    return result


@wp.func
def _bits_of(count: int) -> int:
    bits = int(0)
    while wp.lshift(1, bits) < count:
        bits += 1
    return bits


@wp.func
def _smooth(places: wp.array4d[int], t: int, channel: int, y: int, x: int, count: int) -> int:
    """A place as its neighbours have it, in 16ths; of a first texel the middle."""
    if x == 0 and y == 0:
        return 16 * (count // 2)
    last = places.shape[3] - 1
    if y == 0:
        return 16 * places[t, channel, y, x - 1]
    n = places[t, channel, y - 1, x]
    ne = places[t, channel, y - 1, wp.min(x + 1, last)]
    if x == 0:
        return 2 * (7 * n + ne)
    return 2 * (3 * places[t, channel, y, x - 1] + 3 * n + ne + places[t, channel, y - 1, x - 1])


@wp.func
def _code_list(c: Coder, listed: wp.array3d[int], counts: wp.array2d[int], t: int, channel: int):
    """The levels of a channel at a time, rising."""
    rows = Row()
    for k in range(PREDICTIONS):
        rows[k] = _LISTS
    predicted = Row()
    count = number(c, counts[t, channel] - 1, LEVEL_BITS, 0, predicted, rows, _COUNT_TREE, _LISTS) + 1
    counts[t, channel] = count
    level = int(-1)
    for i in range(count):
        step = number(c, listed[t, channel, i] - level - 1, LEVEL_BITS, 2, predicted, rows, _STEP_TREE, _LISTS)
        level += 1 + step
        listed[t, channel, i] = level
        predicted[1] = predicted[0]
        predicted[0] = 16 * step


@wp.kernel
def code_levels(
    c: Coder,
    # in: [H, W] whether a texel is coded
    valid: wp.array2d[int],
    # in, out: [T, 3, 1024] levels that occur; [T, 3] how many; [T, 3, H, W] places among them
    listed: wp.array3d[int],
    counts: wp.array2d[int],
    places: wp.array4d[int],
    # scratch: [3, NEAR], zeros
    weights: wp.array2d[int],
):
    begin(c)
    last = valid.shape[1] - 1
    for t in range(places.shape[0]):
        for channel in range(3):
            _code_list(c, listed, counts, t, channel)
        for y in range(valid.shape[0]):
            if ended(c):
                return
            for x in range(valid.shape[1]):
                missed = int(0)
                earlier = int(0)
                for channel in range(3):
                    count = counts[t, channel]
                    smooth = _smooth(places, t, channel, y, x, count)
                    if valid[y, x] == 0:
                        places[t, channel, y, x] = smooth // 16
                        continue
                    middle = smooth // 16
                    w = middle
                    n = middle
                    nw = middle
                    ne = middle
                    ww = middle
                    nn = middle
                    if x > 0:
                        w = places[t, channel, y, x - 1]
                        ww = places[t, channel, y, wp.max(x - 2, 0)]
                    if y > 0:
                        n = places[t, channel, y - 1, x]
                        ne = places[t, channel, y - 1, wp.min(x + 1, last)]
                        nw = places[t, channel, y - 1, wp.max(x - 1, 0)]
                        nn = places[t, channel, wp.max(y - 2, 0), x]
                    near = _Near()
                    near[0] = 16 * w - smooth
                    near[1] = 16 * n - smooth
                    near[2] = 16 * nw - smooth
                    near[3] = 16 * ne - smooth
                    near[4] = 16 * ww - smooth
                    near[5] = 16 * nn - smooth
                    near[6] = missed
                    near[7] = earlier
                    if t > 0:
                        before = places[t - 1, channel, y, x]
                        near[8] = 16 * before - _smooth(places, t - 1, channel, y, x, counts[t - 1, channel])
                    most = 16 * (count - 1)
                    total = wp.int64(0)
                    square = wp.int64(_CALM)
                    for i in range(NEAR):
                        total += wp.int64(weights[channel, i]) * wp.int64(near[i])
                        square += wp.int64(near[i]) * wp.int64(near[i])
                    learned = wp.clamp(smooth + int(wp.rshift(total, wp.int64(16))), 0, most)
                    other = wp.where(t > 0, near[8], (missed + earlier) // 2)
                    predicted = Row(
                        smooth,
                        16 * wp.clamp(w + n - nw, wp.min(w, n), wp.max(w, n)),
                        learned,
                        wp.clamp(smooth + missed, 0, most),
                        wp.clamp(smooth + other, 0, most),
                    )
                    differ = wp.abs(w - nw) + wp.abs(n - nw) + wp.abs(n - ne)
                    if channel > 0:
                        differ = (differ + wp.abs(missed - earlier) // 4) // 2
                    context = _CLASSES * channel + _class_of(differ)
                    rows = Row()
                    for k in range(PREDICTIONS):
                        rows[k] = context
                    place = number(
                        c,
                        places[t, channel, y, x],
                        _bits_of(count),
                        PREDICTIONS,
                        predicted,
                        rows,
                        channel,
                        context,
                    )
                    places[t, channel, y, x] = place
                    error = wp.int64(_RATE) * wp.int64(16 * place - learned)
                    for i in range(NEAR):
                        weight = weights[channel, i] + int(error * wp.int64(near[i]) // square)
                        weights[channel, i] = wp.clamp(weight, -_MOST_WEIGHT, _MOST_WEIGHT)
                    earlier = missed
                    missed = 16 * place - smooth
    finish(c)
