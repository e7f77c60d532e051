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

from wlm_kernels.native import native_source, on_cuda
from wlm_kernels.probe.volume_frame import DECODED, HALVES, PROBES, Index, Row, Work, cell_of, range_near

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


@wp.func
def _noise(total: int) -> float:
    return _NOISE * wp.clamp(float(total) / _PROBES, 1.0, _MOST_NOISE)


@wp.func
def _placed(index: Index, block: wp.vec4i, p: int) -> wp.vec4:
    """Returns the entry of `Work.places` for a probe in `index`."""
    ratio = index.ratios[block[3]]
    middle = ratio * (2 * wp.vec3i(block[0], block[1], block[2]) + wp.vec3i(1, 1, 1))
    cell = cell_of(index.key[p]) - middle
    place = index.place[p]
    x = wp.vec3(float(cell[0]) + place[0], float(cell[1]) + place[1], float(cell[2]) + place[2]) * (0.5 / float(ratio))
    behind = float(0.0)
    if index.normal.shape[0] > 0:
        behind = wp.max(wp.dot(index.normal[p], x), 0.0)
    return wp.vec4(x[0], x[1], x[2], _DOUBT * behind * behind)


@wp.func
def _hat(x: wp.vec4) -> float:
    """Returns the covariance of a probe with its block."""
    hat = (1.0 - wp.abs(x[0])) * (1.0 - wp.abs(x[1])) * (1.0 - wp.abs(x[2]))
    return hat + _SMOOTH * wp.exp(-wp.length(wp.vec3(x[0], x[1], x[2])) / _LENGTH)


@wp.func
def _covariance(x: wp.vec4, y: wp.vec4) -> float:
    d = wp.vec3(x[0] - y[0], x[1] - y[1], x[2] - y[2])
    s = _overlap(x[0], y[0]) * _overlap(x[1], y[1]) * _overlap(x[2], y[2])
    return s + _SMOOTH * wp.exp(-wp.length(d) / _LENGTH)


@wp.kernel(enable_backward=False)
def _search(index: Index, work: Work):
    k, j = wp.tid()
    near = range_near(index, work, k, j)
    work.begin[k, j] = near[0]
    work.count[k, j] = near[1]


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
        work.noise[k] = _noise(total)
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
        work.places[k, i] = _placed(index, work.blocks[k], p)
        number = index.number[p]
    work.numbers[k * most + i] = number


@wp.kernel(enable_backward=False)
def _relate(work: Work):
    k, i = wp.tid()
    if i < work.picked[k]:
        x = work.places[k, i]
        work.hats[k, i] = _hat(x)
        row = Row()
        for j in range(i + 1):
            s = _covariance(x, work.places[k, j])
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


@wp.func_native(on_cuda(native_source(__package__, "pick_of_warp"), "return wp::vec_t<3, int>();"))
def _pick_of_warp(a: wp.vec2i, b: wp.vec2i, most: int) -> wp.vec3i: ...


@wp.func_native(on_cuda("return __shfl_sync(~0u, x, lane);\n", "return x;"))
def _of_lane(x: float, lane: int) -> float: ...


@wp.func_native(on_cuda(native_source(__package__, "solve_of_warp", N=PROBES), "return hat;"))
def _solve_of_warp(row: Row, hat: float, count: int) -> float: ...


@wp.kernel(enable_backward=False)
def _weigh_by_warp(index: Index, work: Work):
    """Does all of this with a warp for each block, on CUDA."""
    k, lane = wp.tid()
    most = work.weights.shape[1]
    picked = _pick_of_warp(range_near(index, work, k, 2 * lane), range_near(index, work, k, 2 * lane + 1), most)
    count = picked[1]
    x = wp.vec4()
    number = int(-1)
    if lane < count:
        x = _placed(index, work.blocks[k], picked[0])
        number = index.number[picked[0]]
    row = Row()
    for j in range(count):
        s = _covariance(x, wp.vec4(_of_lane(x[0], j), _of_lane(x[1], j), _of_lane(x[2], j), 0.0))
        if lane == j:
            s += _noise(picked[2]) + x[3]
        row[j] = s
    weight = _solve_of_warp(row, _hat(x), count)
    if lane < most:
        work.numbers[k * most + lane] = number
        work.weights[k, lane] = weight
    if lane == 0:
        wp.atomic_add(work.counters, _DECODED, count)


def weigh(index: Index, work: Work) -> None:
    """Finds the probes near each chosen block, chooses at most 16 of them, and computes their weights."""
    device, blocks = work.clock.device, work.chosen.shape[0]
    if device.is_cuda:
        wp.launch(_weigh_by_warp, (blocks, 32), inputs=[index, work], block_dim=32, device=device)
        return
    wp.launch(_search, work.count.shape, inputs=[index, work], device=device)
    wp.launch(_pick, work.weights.shape, inputs=[index, work], device=device)
    wp.launch(_relate, work.weights.shape, inputs=[work], device=device)
    wp.launch(_weigh, blocks, inputs=[work], device=device)
