"""The weights of a block's probes in a frame of the cascaded volume.

Reading is trilinear: at x it is A(x) g, the hats of the lattice of blocks times their light. What 16 probes
say of a block at c is taken as the best linear unbiased guess (ordinary kriging) if the blocks' light were white noise
on the lattice over a smooth part, so that the covariance of the light at x and y is

    k(x, y) = A(x) A(y)^T + 0.3 exp(-|x - y| / (3 s)),

and each probe has noise of variance 0.03, or up to 0.3 where 16 stand for many more. The first part is what makes the
light that is read at a probe that probe's own light, where a weighted mean would blur it: the volume as a whole nearly
interpolates its probes.

Where normals are known, a probe whose surface has the block's centre behind it, by d sides, says less of that block:
its noise is 3 d^2 more. So a block takes the probes on its own side of a wall, where there are any.
"""

import warp as wp

from wlm_kernels.probe.volume_frame import DECODED, HALVES, PROBES, Index, Windows, Work

wp.set_module_options({"max_unroll": 1})  # a system of 16 unrolled would take minutes to compile

_PROBES = wp.constant(PROBES)
_HALVES = wp.constant(HALVES)
_DECODED = wp.constant(DECODED)
_DOUBT = wp.constant(3.0)
_SMOOTH = wp.constant(0.3)
_LENGTH = wp.constant(3.0)
_NOISE = wp.constant(0.03)
_MOST_NOISE = wp.constant(10.0)  # times as much

_Square = wp.types.matrix(shape=(PROBES, PROBES), dtype=float)
_Places = wp.types.matrix(shape=(PROBES, 3), dtype=float)
_Vector = wp.types.vector(length=PROBES, dtype=float)


@wp.func
def _overlap(x: float, y: float) -> float:
    """A(x) A(y)^T along one axis, in sides, with blocks at whole numbers."""
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
def _weigh(index: Index, windows: Windows, side: int, work: Work):
    k = wp.tid()
    total = int(0)
    for j in range(_HALVES):
        total += work.count[k, j]
    count = wp.min(total, _PROBES)
    wp.atomic_add(work.counters, _DECODED, count)
    x = _Places()
    doubt = _Vector()
    if count > 0:
        slot = work.chosen[k]
        ratio = index.ratios[slot // (side * side * side)]
        middle = ratio * (2 * windows.held[slot] + wp.vec3i(1, 1, 1))
        scale = 0.5 / float(ratio)
        i = int(0)
        passed = int(0)
        at = int(0)
        for j in range(_HALVES):
            here = work.count[k, j]
            # Every n-th of all, so that a block with many is decided by some from all over it.
            at = int(wp.int64(i) * wp.int64(total) / wp.int64(count))
            while i < count and at < passed + here:
                p = work.begin[k, j] + at - passed
                cell = index.cell[p] - middle
                place = index.place[p]
                behind = float(0.0)
                for a in range(3):
                    x[i, a] = scale * (float(cell[a]) + place[a])
                    behind += index.normal[p][a] * x[i, a]
                doubt[i] = _DOUBT * wp.max(behind, 0.0) * wp.max(behind, 0.0)
                work.numbers[k * _PROBES + i] = index.number[p]
                i += 1
                at = int(wp.int64(i) * wp.int64(total) / wp.int64(count))
            passed += here
    # Two systems: for the covariance with the block, and for ones.
    noise = _NOISE * wp.clamp(float(total) / float(_PROBES), 1.0, _MOST_NOISE)
    lower = _Square()
    u = _Vector()
    v = _Vector()
    for i in range(count):
        u[i] = (1.0 - wp.abs(x[i, 0])) * (1.0 - wp.abs(x[i, 1])) * (1.0 - wp.abs(x[i, 2]))
        distance = wp.sqrt(x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1] + x[i, 2] * x[i, 2])
        u[i] = u[i] + _SMOOTH * wp.exp(-distance / _LENGTH)
        v[i] = 1.0
        for j in range(i + 1):
            d = wp.vec3(x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2])
            s = _overlap(x[i, 0], x[j, 0]) * _overlap(x[i, 1], x[j, 1]) * _overlap(x[i, 2], x[j, 2])
            s += _SMOOTH * wp.exp(-wp.length(d) / _LENGTH)
            if i == j:
                s += noise + doubt[i]
            for m in range(j):
                s -= lower[i, m] * lower[j, m]
            if i == j:
                lower[i, i] = wp.sqrt(s)
            else:
                lower[i, j] = s / lower[j, j]
        for m in range(i):
            u[i] = u[i] - lower[i, m] * u[m]
            v[i] = v[i] - lower[i, m] * v[m]
        u[i] = u[i] / lower[i, i]
        v[i] = v[i] / lower[i, i]
    sum_u = float(0.0)
    sum_v = float(0.0)
    for r in range(count):
        i = count - 1 - r
        for m in range(i + 1, count):
            u[i] = u[i] - lower[m, i] * u[m]
            v[i] = v[i] - lower[m, i] * v[m]
        u[i] = u[i] / lower[i, i]
        v[i] = v[i] / lower[i, i]
        sum_u += u[i]
        sum_v += v[i]
    for i in range(_PROBES):
        if i < count:
            work.weights[k, i] = u[i] + (1.0 - sum_u) / sum_v * v[i]
        else:
            work.weights[k, i] = 0.0
            work.numbers[k * _PROBES + i] = 0


def weigh(index: Index, windows: Windows, side: int, work: Work) -> None:
    """Chooses and weighs the probes of the blocks whose ranges `volume_frame.search` found."""
    inputs = [index, windows, side, work]
    wp.launch(_weigh, work.chosen.shape, inputs=inputs, block_dim=32, device=work.clock.device)
