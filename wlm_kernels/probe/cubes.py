"""Lists of the Gaussians that may reach each cube of a grid (gaussian-probe-compression, section 3.2).

Count the cubes of each Gaussian, add the counts up, write the pairs (cube, Gaussian), sort them by cube, and find where
each cube's begin. The sort keeps equal keys in order, so a cube lists its Gaussians by rising number and a sum over a
list adds in the same order every time, the order of a sum over all Gaussians.

Whether a cube lists a Gaussian is one of three tests:

    sphere  it meets the sphere round the centre as wide as the longest axis reaches (eq. 6);
    box     it meets the box round the ellipsoid;
    exact   it meets the ellipsoid itself, and so passes the other two.

All are made looser by more than what float32 loses, so no list lacks a Gaussian that reaches a point of its cube.
Cubes at the border of the grid have no outer faces but go on for ever: a point outside takes the nearest cube's list,
and that list is right for it too.

The twin to read first: `reach` and `nearest` in `tests/reference/gaussians.py`.
"""

import math

import numpy as np
import warp as wp

from wlm_kernels.probe.gaussians import Shape

TESTS = ("box", "sphere", "exact")

# Sorting takes twice as many entries, and Warp counts an array's entries in 31 bits.
MOST_PAIRS = 2**30 - 1

# A size that we choose. Finer cubes make shorter sums (a quarter of the reach against all of it: 1.2 to 1.6 times as
# quick, measured) and more and longer work to make the lists.
_FIRST_SIZE = 0.25  # of the median reach
_CUBES_EACH = 8  # cubes a Gaussian
_PAIRS_EACH = 256  # pairs a Gaussian
_FEW = 4096  # cubes and pairs that are always allowed

# What a reach may lack by rounding, as a share of it: a Gaussian 100 times as long as wide, the most that u is computed
# in float32 for, is off by about 1e-5.
REACH_MARGIN = wp.constant(1.0e-4)
# And where a point or a face of a cube may be, as a share of the grid's largest coordinate: a few float32 roundings.
_PLACE_MARGIN = wp.constant(1.0e-6)

_BOX, _SPHERE, _EXACT = (wp.constant(TESTS.index(test)) for test in ("box", "sphere", "exact"))


@wp.struct
class Cubes:
    """A grid of cubes with lists of Gaussians; cube (i, j, k) has the index `(i * counts[1] + j) * counts[2] + k`.

    Attributes:
        low: Lowest corner of the grid.
        size: Side of a cube.
        counts: Cubes along each axis; C in all.
        start: [C + 1], where each cube's list begins in `item`; the last is the number of pairs.
        item: [pairs], numbers of Gaussians, rising within a list.
    """

    low: wp.vec3
    size: float
    counts: wp.vec3i
    start: wp.array1d[int]
    item: wp.array1d[int]


@wp.func
def _place(x: float, low: float, size: float, count: int) -> int:
    t = (x - low) / size
    if t > 0.0:  # not where x is NaN, which no int could hold
        if t < float(count - 1):
            return int(t)
        return count - 1
    return 0


@wp.func
def _cell(cubes: Cubes, x: wp.vec3) -> wp.vec3i:
    return wp.vec3i(
        _place(x[0], cubes.low[0], cubes.size, cubes.counts[0]),
        _place(x[1], cubes.low[1], cubes.size, cubes.counts[1]),
        _place(x[2], cubes.low[2], cubes.size, cubes.counts[2]),
    )


@wp.func
def _number(cubes: Cubes, cell: wp.vec3i) -> int:
    return (cell[0] * cubes.counts[1] + cell[1]) * cubes.counts[2] + cell[2]


@wp.func
def cube_of(cubes: Cubes, x: wp.vec3) -> int:
    """Returns the cube that contains a point, or the nearest one; any cube for NaN, which no Gaussian reaches."""
    return _number(cubes, _cell(cubes, x))


@wp.func
def _place_margin(cubes: Cubes) -> float:
    return _PLACE_MARGIN * (wp.max(wp.abs(cubes.low)) + cubes.size * float(wp.max(cubes.counts)))


@wp.func
def span(cubes: Cubes, centre: wp.vec3, reach: wp.vec3):
    """Returns the first and last cube along each axis that meet the box of half side `reach` around `centre`.

    All cells where these aren't numbers: what can't be told here is tested again at each point.
    """
    pad = _place_margin(cubes)
    wide = (1.0 + REACH_MARGIN) * reach + wp.vec3(pad, pad, pad)
    low = centre - wide
    high = centre + wide
    first = wp.vec3i()
    last = cubes.counts - wp.vec3i(1, 1, 1)
    if low[0] <= high[0] and low[1] <= high[1] and low[2] <= high[2]:
        first = _cell(cubes, low)
        last = _cell(cubes, high)
    return first, last


@wp.func
def _on_edge(p: wp.vec3d, q: wp.vec3d, low: wp.float64, high: wp.float64) -> wp.float64:
    """Returns the least |p + t q|^2 for low <= t <= high."""
    t = wp.clamp(-wp.dot(p, q) / wp.dot(q, q), low, high)
    return wp.length_sq(p + t * q)


@wp.func
def _on_face(
    p: wp.vec3d,
    q: wp.vec3d,
    r: wp.vec3d,
    q_low: wp.float64,
    q_high: wp.float64,
    r_low: wp.float64,
    r_high: wp.float64,
) -> wp.float64:
    """Returns the least |p + s q + t r|^2 for s between q_low and q_high, and t likewise."""
    across = r - (wp.dot(q, r) / wp.dot(q, q)) * q
    t = -wp.dot(p, across) / wp.dot(across, across)
    s = -wp.dot(p + t * r, q) / wp.dot(q, q)
    s_in = wp.clamp(s, q_low, q_high)
    t_in = wp.clamp(t, r_low, r_high)
    if s_in == s and t_in == t:
        return wp.length_sq(p + s * q + t * r)
    best = wp.float64(wp.inf)
    if s_in != s:
        best = _on_edge(p + s_in * q, r, r_low, r_high)
    if t_in != t:
        best = wp.min(best, _on_edge(p + t_in * r, q, q_low, q_high))
    return best


@wp.func
def _nearest(whiten: wp.mat33d, low: wp.vec3d, high: wp.vec3d) -> wp.float64:
    """Returns the least |W d|^2 for d in a box, exact except for rounding.

    A convex function's least point in a convex set, where its least point of all lies outside, is on the set's border,
    and there on a face that has the two on different sides: were it not, a step towards the least point of all would
    stay in the set and go down. So the faces of the box that are seen from d = 0 hold it, three at most, and on a face
    where the least point of its plane lies outside, an edge that is seen from there, two at most, does. A face or an
    edge at infinity is never seen.
    """
    zero = wp.float64(0.0)
    best = wp.float64(wp.inf)
    outside = int(0)
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        offset = wp.max(low[a], zero) + wp.min(high[a], zero)
        if offset != zero:
            outside = 1
            face = _on_face(
                offset * wp.vec3d(whiten[0, a], whiten[1, a], whiten[2, a]),
                wp.vec3d(whiten[0, b], whiten[1, b], whiten[2, b]),
                wp.vec3d(whiten[0, c], whiten[1, c], whiten[2, c]),
                low[b],
                high[b],
                low[c],
                high[c],
            )
            best = wp.min(best, face)
    if outside == 0:
        return zero
    return best


@wp.func
def _limit(shape: Shape, test: int) -> float:
    """Returns the bound of a test: the squared radius of a sphere, or the squared cut of an ellipsoid."""
    if shape.radius > 0.0:
        return shape.radius
    w = shape.whiten
    scale = wp.vec3(1.0 / wp.length(w[0]), 1.0 / wp.length(w[1]), 1.0 / wp.length(w[2]))
    # The box round an ellipsoid is as long across its corners as the box along its own axes.
    cut = wp.length_sq(shape.reach) / wp.length_sq(scale)
    if test == _SPHERE:
        longest = wp.max(scale)
        return cut * longest * longest
    return cut


@wp.func
def _span_of(cubes: Cubes, shape: Shape, limit: float, test: int):
    reach = shape.reach
    if test == _SPHERE:
        radius = wp.sqrt(limit)
        reach = wp.vec3(radius, radius, radius)
    return span(cubes, shape.centre, reach)


@wp.func
def _meets(cubes: Cubes, shape: Shape, limit: float, cell: wp.vec3i, test: int) -> bool:
    """Returns whether a cube of the span also passes the test."""
    if test == _BOX or not wp.isfinite(shape.reach):
        return True
    pad = _place_margin(cubes)
    low = wp.vec3()
    high = wp.vec3()
    for a in range(3):
        below = cubes.low[a] + cubes.size * float(cell[a]) - pad - shape.centre[a]
        above = cubes.low[a] + cubes.size * float(cell[a] + 1) + pad - shape.centre[a]
        low[a] = wp.where(cell[a] == 0, -wp.inf, below)
        high[a] = wp.where(cell[a] == cubes.counts[a] - 1, wp.inf, above)
    loose = limit * (1.0 + REACH_MARGIN) * (1.0 + REACH_MARGIN)
    if test == _SPHERE or shape.radius > 0.0:
        return not wp.length_sq(wp.max(low, wp.vec3()) + wp.min(high, wp.vec3())) > loose
    whiten = wp.mat33d(shape.whiten) + wp.mat33d(shape.rest)
    return not _nearest(whiten, wp.vec3d(low), wp.vec3d(high)) > wp.float64(loose)


@wp.kernel(enable_backward=False)
def _candidates(
    # in:
    shapes: wp.array1d[Shape],
    cubes: Cubes,
    test: int,
    # out:
    counts: wp.array1d[wp.int64],
):
    k = wp.tid()
    first, last = _span_of(cubes, shapes[k], _limit(shapes[k], test), test)
    size = last - first + wp.vec3i(1, 1, 1)
    counts[k] = wp.int64(size[0]) * wp.int64(size[1]) * wp.int64(size[2])


@wp.kernel(enable_backward=False)
def _count(
    # in:
    shapes: wp.array1d[Shape],
    cubes: Cubes,
    test: int,
    # out:
    counts: wp.array1d[int],
):
    k = wp.tid()
    shape = shapes[k]
    limit = _limit(shape, test)
    first, last = _span_of(cubes, shape, limit, test)
    count = int(0)
    for x in range(first[0], last[0] + 1):
        for y in range(first[1], last[1] + 1):
            for z in range(first[2], last[2] + 1):
                if _meets(cubes, shape, limit, wp.vec3i(x, y, z), test):
                    count += 1
    counts[k] = count


@wp.kernel(enable_backward=False)
def _emit(
    # in:
    shapes: wp.array1d[Shape],
    cubes: Cubes,
    test: int,
    offsets: wp.array1d[int],
    # out:
    keys: wp.array1d[int],
    items: wp.array1d[int],
):
    k = wp.tid()
    shape = shapes[k]
    limit = _limit(shape, test)
    first, last = _span_of(cubes, shape, limit, test)
    place = offsets[k]
    for x in range(first[0], last[0] + 1):
        for y in range(first[1], last[1] + 1):
            for z in range(first[2], last[2] + 1):
                cell = wp.vec3i(x, y, z)
                if _meets(cubes, shape, limit, cell, test):
                    keys[place] = _number(cubes, cell)
                    items[place] = k
                    place += 1


@wp.kernel(enable_backward=False)
def _find_starts(
    # in:
    keys: wp.array1d[int],
    count: int,
    # out:
    start: wp.array1d[int],
):
    key = wp.tid()
    # It never answers the end that it is given; given one more it can answer `count`, and still reads no further.
    start[key] = wp.lower_bound(keys, 0, count + 1, key)


def sort_by_cube(keys, items, count: int, cubes: int, start) -> None:
    """Sorts pairs by their first number, in a stable order.

    Args:
        keys: int [2 * count], numbers of cubes; the second half is room to work in.
        items: int [2 * count], what goes with them.
        count: Pairs.
        cubes: C.
        start: int [C + 1], written: where each cube's pairs begin.
    """
    wp.utils.radix_sort_pairs(keys, items, count, end_bit=max(1, (cubes - 1).bit_length()))
    wp.launch(_find_starts, cubes + 1, inputs=[keys, count], outputs=[start], device=keys.device)


def build(shapes, low, high, size: float | None = None, *, test: str = "box") -> Cubes:
    """Builds the lists of a grid over a box.

    Without a size the cubes begin a quarter as wide as the median Gaussian reaches along its widest axis, and double
    until there are no more than 8 cubes and 256 pairs to test a Gaussian (4,096 more of either are always allowed).

    Args:
        shapes: Shape [K], made for the cut and support that the sums will have.
        low, high: Three numbers each, lowest and highest corner of the points' box; it may be flat along any axis.
        size: Side of a cube, positive, in the frame of the points; None: chosen.
        test: "box", "sphere" or "exact", see the module. Where the Gaussians reach spheres, "exact" is "sphere".

    Returns:
        The lists, on the shapes' device.

    Raises:
        ValueError: A wrong argument, or more than `MOST_PAIRS` cubes, or pairs to test; nothing of that size is
            allocated before.
    """
    if test not in TESTS:
        raise ValueError(f"test: expected one of {', '.join(TESTS)}, got {test!r}")
    corners = np.array([low, high], np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or (corners[0] > corners[1]).any():
        raise ValueError(f"low, high: expected two corners of a box, got {low} and {high}")
    kind = TESTS.index(test)
    if size is None:
        cubes = _chosen_grid(shapes, corners, kind)
    elif math.isfinite(size) and size > 0:
        cubes = _grid(corners, size)
    else:
        raise ValueError(f"size: expected a positive number, got {size}")
    total = math.prod(cubes.counts)
    if total > MOST_PAIRS:
        raise ValueError(f"size: {cubes.size:g} makes {total} cubes, expected at most {MOST_PAIRS}")
    tested = _tested(shapes, cubes, kind)
    if tested > MOST_PAIRS:
        raise ValueError(f"size: {cubes.size:g} makes {tested} pairs to test, expected at most {MOST_PAIRS}")

    device, gaussians = shapes.device, shapes.shape[0]
    counts = wp.empty(gaussians, dtype=int, device=device)
    wp.launch(_count, gaussians, inputs=[shapes, cubes, kind], outputs=[counts], device=device)
    pairs = int(counts.numpy().sum(dtype=np.int64))
    offsets = wp.empty_like(counts)
    wp.utils.array_scan(counts, offsets, inclusive=False)
    keys, items = (wp.empty(2 * pairs, dtype=int, device=device) for _ in range(2))
    wp.launch(_emit, gaussians, inputs=[shapes, cubes, kind, offsets], outputs=[keys, items], device=device)
    cubes.start = wp.empty(total + 1, dtype=int, device=device)
    sort_by_cube(keys, items, pairs, total, cubes.start)
    cubes.item = wp.empty(pairs, dtype=int, device=device)
    if pairs:  # to `copy` a count of 0 is all
        wp.copy(cubes.item, items, count=pairs)
    return cubes


def everything(count: int, device) -> Cubes:
    """Returns one cube that lists all Gaussians, for sums without lists.

    Args:
        count: K.
        device: Where the list goes.
    """
    cubes = _grid(np.zeros((2, 3)), 1.0)
    cubes.start = wp.array([0, count], dtype=int, device=device)
    cubes.item = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    return cubes


def _grid(corners: np.ndarray, size: float) -> Cubes:
    cubes = Cubes()
    cubes.low = wp.vec3(*corners[0])
    cubes.size = size
    # One too many for a kernel's ints is refused by the caller, whatever it is.
    counts = np.clip(np.ceil((corners[1] - corners[0]) / size), 1, MOST_PAIRS + 1)
    cubes.counts = wp.vec3i(*(int(count) for count in counts))
    return cubes


def _tested(shapes, cubes: Cubes, kind: int) -> int:
    """Returns the pairs of cubes and Gaussians to test."""
    counts = wp.empty(shapes.shape[0], dtype=wp.int64, device=shapes.device)
    wp.launch(_candidates, counts.shape, inputs=[shapes, cubes, kind], outputs=[counts], device=shapes.device)
    return int(counts.numpy().sum())


def _chosen_grid(shapes, corners: np.ndarray, kind: int) -> Cubes:
    reach = shapes.numpy()["reach"].max(1, initial=0.0)
    reach = reach[np.isfinite(reach) & (reach > 0)]
    extent = float((corners[1] - corners[0]).max())
    # Without a Gaussian that reaches, or a box to divide: one cube.
    size = _FIRST_SIZE * float(np.median(reach)) if len(reach) and extent > 0 else max(extent, 1.0)
    count = shapes.shape[0]
    cubes = _grid(corners, size)
    while math.prod(cubes.counts) > 1 and (
        math.prod(cubes.counts) > _FEW + _CUBES_EACH * count
        or _tested(shapes, cubes, kind) > _FEW + _PAIRS_EACH * count
    ):
        size *= 2.0
        cubes = _grid(corners, size)
    return cubes
