"""Computes the weights with which light probes contribute to a block of the nested grids of light (`volume`).

Light is read trilinearly from blocks: at x it is A(x) g, where A(x) are the trilinear weights of all blocks of a level
and g is the blocks' light. The light of a block follows from up to 16 probes as the best linear unbiased estimate
(ordinary kriging), under the assumption that g is white noise plus a smooth part, so that the covariance of the light
at x and y is

    k(x, y) = A(x) A(y)^T + 0.3 exp(-|x - y| / (3 s)),

where s is the edge of a block, and each probe has noise of variance 0.03, or up to 0.3 where 16 probes represent many
more. Because of the white noise, the light that is read at a probe's position is nearly the light of the probe, which a
weighted mean would blur.

If normals are known and the block's centre is d edges behind a probe's surface, 3 d^2 is added to the variance of this
probe's noise. A block thus takes its light from probes on its own side of a wall, if there are any.
"""

import warp as wp

from wlm_kernels.probe.volume_frame import DECODED, HALVES, PROBES, Index, Row, Work, cell_of

wp.set_module_options({"max_unroll": 1})  # a system of 16 unrolled would take minutes to compile

_PROBES = wp.constant(float(PROBES))
_HALVES = wp.constant(HALVES)
_DECODED = wp.constant(DECODED)
_DOUBT = wp.constant(3.0)
_SMOOTH = wp.constant(0.3)
_LENGTH = wp.constant(3.0)
_NOISE = wp.constant(0.03)
_MOST_NOISE = wp.constant(10.0)  # largest factor of the noise

_Square = wp.types.matrix(shape=(PROBES, PROBES), dtype=float)


@wp.func
def _overlap(x: float, y: float) -> float:
    """Returns A(x) A(y)^T along one axis; x and y are in units of a block's edge, with block centres at integers."""
    low = wp.floor(x)
    other = wp.floor(y)
    a = x - low
    b = y - other
    if low == other:
        return (1.0 - a) * (1.0 - b) + a * b
    if low == other + 1.0:
        return (1.0 - a) * b
    if low == other - 1.0:
        return a * (1.0 - b)
    return 0.0


@wp.kernel(enable_backward=False)
def _pick(index: Index, work: Work):
    k, i = wp.tid()
    most = work.weights.shape[1]
    total = int(0)
    for j in range(_HALVES):
        total += work.count[k, j]
    count = wp.min(total, most)
    if i == 0:
        wp.atomic_add(work.counters, _DECODED, count)
        work.picked[k] = count
        work.noise[k] = _NOISE * wp.clamp(float(total) / _PROBES, 1.0, _MOST_NOISE)
    number = int(-1)
    if i < count:
        # Every n-th probe is taken, so that they are spread over the whole block.
        at = int(wp.int64(i) * wp.int64(total) / wp.int64(count))
        p = int(-1)
        passed = int(0)
        for j in range(_HALVES):
            here = work.count[k, j]
            if p < 0 and at < passed + here:
                p = work.begin[k, j] + at - passed
            passed += here
        block = work.blocks[k]
        ratio = index.ratios[block[3]]
        middle = ratio * (2 * wp.vec3i(block[0], block[1], block[2]) + wp.vec3i(1, 1, 1))
        cell = cell_of(index.key[p]) - middle
        place = index.place[p]
        x = wp.vec3(float(cell[0]) + place[0], float(cell[1]) + place[1], float(cell[2]) + place[2]) * (
            0.5 / float(ratio)
        )
        behind = float(0.0)
        if index.normal.shape[0] > 0:
            behind = wp.max(wp.dot(index.normal[p], x), 0.0)
        work.places[k, i] = wp.vec4(x[0], x[1], x[2], _DOUBT * behind * behind)
        number = index.number[p]
    work.numbers[k * most + i] = number


@wp.kernel(enable_backward=False)
def _relate(work: Work):
    k, i = wp.tid()
    if i < work.picked[k]:
        x = work.places[k, i]
        hat = (1.0 - wp.abs(x[0])) * (1.0 - wp.abs(x[1])) * (1.0 - wp.abs(x[2]))
        work.hats[k, i] = hat + _SMOOTH * wp.exp(-wp.length(wp.vec3(x[0], x[1], x[2])) / _LENGTH)
        row = Row()
        for j in range(i + 1):
            y = work.places[k, j]
            d = wp.vec3(x[0] - y[0], x[1] - y[1], x[2] - y[2])
            s = _overlap(x[0], y[0]) * _overlap(x[1], y[1]) * _overlap(x[2], y[2])
            s += _SMOOTH * wp.exp(-wp.length(d) / _LENGTH)
            if i == j:
                s += work.noise[k] + x[3]
            row[j] = s
        work.rows[k, i] = row


@wp.kernel(enable_backward=False)
def _weigh(work: Work):
    """Computes the weights of a block's probes by Cholesky decomposition, one block per thread; the rest is 0."""
    k = wp.tid()
    count = work.picked[k]
    lower = _Square()
    # Two systems: for the covariance with the block, and for ones.
    u = Row()
    v = Row()
    for i in range(count):
        related = work.rows[k, i]
        row = Row()
        for j in range(i):
            before = lower[j]
            row[j] = (related[j] - wp.dot(before, row)) / before[j]
        diagonal = wp.sqrt(related[i] - wp.dot(row, row))
        u[i] = (work.hats[k, i] - wp.dot(row, u)) / diagonal
        v[i] = (1.0 - wp.dot(row, v)) / diagonal
        row[i] = diagonal
        lower[i] = row
    sum_u = float(0.0)
    sum_v = float(0.0)
    for r in range(count):
        i = count - 1 - r
        row = lower[i]
        a = u[i] / row[i]
        b = v[i] / row[i]
        u -= a * row
        v -= b * row
        u[i] = a
        v[i] = b
        sum_u += a
        sum_v += b
    for i in range(work.weights.shape[1]):
        weight = float(0.0)
        if i < count:
            weight = u[i] + (1.0 - sum_u) / sum_v * v[i]
        work.weights[k, i] = weight


def weigh(index: Index, work: Work) -> None:
    """Chooses, for each block, at most 16 of the probes that `volume_frame.search` found, and computes their weights.
    There are three launches, since only the last one, the longest, is limited to one thread per block."""
    device = work.clock.device
    wp.launch(_pick, work.weights.shape, inputs=[index, work], block_dim=32, device=device)
    wp.launch(_relate, work.weights.shape, inputs=[work], block_dim=32, device=device)
    wp.launch(_weigh, work.chosen.shape, inputs=[work], block_dim=32, device=device)
