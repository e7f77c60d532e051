"""An adaptive binary arithmetic coder of a tile's maps, network or levels, in whole numbers: the same bits everywhere.

Each number is coded bit by bit, from its highest. The probability of a bit is a mixture, in the logistic domain, of
what a few predictions of the number say and of how often the bit was met after the same higher bits (the mixing of PAQ:
Mahoney, "Adaptive weighing of context models for lossless data compression", 2005). A prediction is a logistic
distribution round a value made of neighbours; its width follows its errors so far. Weights, widths and counts are those
of one stream, which is therefore read alone.

The code is a carryless range coder of 32 bits. A decoder that runs past the end of its stream reads zeros and stops.

What is coded lies in arrays of int32, which are read when `encode` is 1 and written when it is 0. A launch codes one
stream, on the CPU, and releases Python's lock.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

PREDICTIONS = 5
INPUTS = PREDICTIONS + 1
"""What is mixed: the predictions and the counts."""

LIMIT = 60  # of counts
MET = 2  # each count at first
PREDICTION_WEIGHT, COUNT_WEIGHT = 9175, 19661  # in a mixture at first, in 65536ths
AHEAD = 3  # bytes that a reader is ahead of what its numbers needed
HALF = 2048  # entries of the sigmoid's table on each side of 0, 256 to one

ENDS, LOWEST, INDICES = 0, 48, 49
"""Where the mixtures of a map's numbers, lowest bits and indices begin."""

MIXTURES = 69
TREES = 20

_LEAST, _MOST = 256, 65280  # of a probability in 65536ths: no bit is so cheap that a short stream is long to read

_WHOLE = wp.uint32(0xFFFFFFFF)

Row = wp.types.vector(length=PREDICTIONS, dtype=int)
Mixed = wp.types.vector(length=INPUTS, dtype=int)


@wp.struct
class Coder:
    """A stream, and all that its code depends on."""

    data: wp.array[wp.uint8]  # the stream, or room for it
    range: wp.array[wp.uint32]  # [3] lower and upper end of the range, and the code
    place: wp.array[int]  # [1] bytes written or read; of a writer it goes on past the room
    encode: int
    logarithm: wp.array[int]  # [65537] 256 ln, of 0 that of 1
    sigmoid: wp.array[int]  # [4096] of (i - 2048) / 256, in 65536ths
    rate: wp.array[int]  # [LIMIT + 1] what a count moves by, in 65536ths
    weights: wp.array3d[int]  # [mixtures, bits, inputs] in 65536ths
    widths: wp.array2d[int]  # [mixtures, predictions] in 1024ths
    chance: wp.array2d[int]  # [trees, nodes] of a 1 at each node, in 65536ths
    met: wp.array2d[int]  # [trees, nodes] how often


@wp.func
def _next(c: Coder) -> wp.uint32:
    place = c.place[0]
    c.place[0] = place + 1
    if place < c.data.shape[0]:
        return wp.uint32(c.data[place])
    return wp.uint32(0)


@wp.func
def _put(c: Coder, value: wp.uint32):
    place = c.place[0]
    c.place[0] = place + 1
    if place < c.data.shape[0]:
        c.data[place] = wp.uint8(value)


@wp.func
def begin(c: Coder):
    c.range[0] = wp.uint32(0)
    c.range[1] = _WHOLE
    if c.encode == 0:
        code = wp.uint32(0)
        for _ in range(4):
            code = wp.lshift(code, wp.uint32(8)) | _next(c)
        c.range[2] = code


@wp.func
def finish(c: Coder):
    """One byte is enough: with zeros after it, it lies in the range, whose ends differ in their highest byte."""
    if c.encode == 1:
        _put(c, wp.rshift(c.range[0], wp.uint32(24)) + wp.uint32(1))


@wp.func
def ended(c: Coder) -> bool:
    """Whether a reader is past its stream: it is `AHEAD` of its numbers, with zeros at the end."""
    return c.encode == 0 and c.place[0] > c.data.shape[0] + AHEAD


@wp.func
def _bit(c: Coder, chance: int, bit: int) -> int:
    low = c.range[0]
    high = c.range[1]
    middle = low + wp.uint32(wp.rshift(wp.uint64(high - low) * wp.uint64(chance), wp.uint64(16)))
    result = bit
    if c.encode == 0:
        result = wp.where(c.range[2] <= middle, 1, 0)
    if result == 1:
        high = middle
    else:
        low = middle + wp.uint32(1)
    while wp.rshift(low ^ high, wp.uint32(24)) == wp.uint32(0):
        if c.encode == 1:
            _put(c, wp.rshift(high, wp.uint32(24)))
        else:
            c.range[2] = wp.lshift(c.range[2], wp.uint32(8)) | _next(c)
        low = wp.lshift(low, wp.uint32(8))
        high = wp.lshift(high, wp.uint32(8)) | wp.uint32(255)
    c.range[0] = low
    c.range[1] = high
    return result


@wp.func
def number(c: Coder, value: int, bits: int, count: int, predicted: Row, widths: Row, tree: int, mixture: int) -> int:
    """Codes a number.

    Args:
        c: The coder.
        value: The number, where it is written.
        bits: Of it, up to 10, and as many as `Coder.weights` and the nodes of a tree have room for.
        count: Predictions.
        predicted: In 16ths.
        widths: The row of `Coder.widths` of each.
        tree: The row of `Coder.chance`.
        mixture: The row of `Coder.weights`.

    Returns:
        The number.
    """
    least = int(0)
    most = wp.lshift(1, bits)
    node = int(1)
    below = Row()
    above = Row()
    inverse = Row()
    at = Row()
    x = Mixed()
    for k in range(count):
        above[k] = 65536
        inverse[k] = 16777216 // c.widths[widths[k], k]
    for b in range(bits):
        middle = wp.rshift(least + most, 1)
        met = c.chance[tree, node]
        x[PREDICTIONS] = c.logarithm[met] - c.logarithm[65536 - met]
        total = wp.int64(c.weights[mixture, b, PREDICTIONS]) * wp.int64(x[PREDICTIONS])
        for k in range(count):
            far = wp.rshift((16 * middle - 8 - predicted[k]) * inverse[k], 10)
            at[k] = c.sigmoid[wp.clamp(far, -HALF, HALF - 1) + HALF]
            ratio = c.logarithm[above[k] - at[k] + 1] - c.logarithm[at[k] - below[k] + 1]
            # What lies above the middle: the sigmoid falls from one to the other.
            x[k] = wp.clamp(ratio, 1 - HALF, HALF - 1)
            total += wp.int64(c.weights[mixture, b, k]) * wp.int64(x[k])
        mixed = int(wp.clamp(wp.rshift(total, wp.int64(16)), wp.int64(1 - HALF), wp.int64(HALF - 1)))
        chance = wp.clamp(c.sigmoid[mixed + HALF], _LEAST, _MOST)
        bit = _bit(c, chance, wp.where(value >= middle, 1, 0))
        error = 65536 * bit - chance
        for k in range(count):
            c.weights[mixture, b, k] = c.weights[mixture, b, k] + wp.rshift(5 * x[k] * error, 16)
        c.weights[mixture, b, PREDICTIONS] = c.weights[mixture, b, PREDICTIONS] + wp.rshift(
            5 * x[PREDICTIONS] * error, 16
        )
        seen = wp.min(c.met[tree, node] + 1, LIMIT)
        c.met[tree, node] = seen
        c.chance[tree, node] = met + wp.rshift((65535 * bit - met) * c.rate[seen], 16)
        node = 2 * node + bit
        if bit == 1:
            least = middle
        else:
            most = middle
        for k in range(count):
            if bit == 1:
                below[k] = at[k]
            else:
                above[k] = at[k]
    for k in range(count):
        width = c.widths[widths[k], k]
        wanted = 32 * wp.abs(16 * least - predicted[k]) + 410
        c.widths[widths[k], k] = width + wp.rshift((wanted - width) * 13, 8)
    return least
