"""Lists the Gaussians that may reach each cube of a grid (gaussian-probe-compression, section 3.2).

`build` counts the cubes of each Gaussian, adds the counts up, writes the pairs (cube, Gaussian), sorts them by cube,
and finds where each cube's pairs begin. The sort is stable: a cube lists its Gaussians by rising number, so that a sum
over a list always adds in the order of a sum over all Gaussians.

A cube lists a Gaussian if it meets the Gaussian's support, an ellipsoid or a sphere (eq. 6). Supports are enlarged by
more than the rounding error of float32, so that no list lacks a Gaussian that reaches a point of its cube. Cubes at the
border of the grid extend to infinity, since a point outside uses the list of the nearest cube. The reference is `reach`
and `nearest` in `tests/reference/gaussians.py`.
"""

import math

import numpy as np
import warp as wp

from wlm_kernels.probe.gaussians import Shape

# Sorting takes twice the entries, and Warp counts an array's entries in 31 bits.
MOST_PAIRS = 2**30 - 1

# Finer cubes make shorter sums, and lists that take longer to build. Cubes of a quarter of the reach sum 1.2 to 1.6
# times as fast as cubes of the whole reach.
_FIRST_SIZE = 0.25  # of the median reach
_COARSER = 1.25  # factor of the size until there are few enough cubes and pairs
_CUBES_EACH = 8  # cubes per Gaussian
_PAIRS_EACH = 256  # pairs per Gaussian
_FEW = 4096  # cubes and pairs that are always allowed

# Enlargement of a reach against rounding, as a share of it: u is computed in float32 for Gaussians up to 100 times as
# long as wide, whose error is about 1e-5.
REACH_MARGIN = wp.constant(1.0e-4)
# Enlargement of a cube, as a share of the grid's largest coordinate: a few float32 roundings.
_PLACE_MARGIN = wp.constant(1.0e-6)


@wp.struct
class Cubes:
    """A grid of cubes with the list of the Gaussians that may reach each cube.

    Cube (i, j, k) has the index `(i * counts[1] + j) * counts[2] + k`. Lengths are in the unit of the points.

    Attributes:
        low: Lowest corner of the grid.
        size: Edge of a cube.
        counts: Number of cubes along each axis; C in all.
        start: int [C + 1], index in `item` at which each cube's list begins; the last entry is the length of `item`.
        item: int [pairs], the lists one after another: indices of Gaussians, rising within a list.
    """

    low: wp.vec3
    size: float
    counts: wp.vec3i
    start: wp.array1d[int]
    item: wp.array1d[int]


@wp.func
def _place(x: float, low: float, size: float, count: int) -> int:
    t = (x - low) / size
    if t > 0.0:  # false for NaN, which cannot be cast to int
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
    """Returns the cube that contains a point or is nearest to it; any cube for NaN, which no Gaussian reaches."""
    return _number(cubes, _cell(cubes, x))


@wp.func
def _place_margin(cubes: Cubes) -> float:
    return _PLACE_MARGIN * (wp.max(wp.abs(cubes.low)) + cubes.size * float(wp.max(cubes.counts)))


@wp.func
def span(cubes: Cubes, centre: wp.vec3, reach: wp.vec3):
    """Returns the first and the last cube along each axis that meet a box: its centre is `centre`, and `reach` is half
    its size. For a box that is NaN or infinite it returns the whole grid, since each point is tested again anyway."""
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
    """Returns the minimum of |p + t q|^2 for low <= t <= high."""
    t = wp.clamp(-wp.dot(p, q) / wp.dot(q, q), low, high)
    return wp.length_sq(p + t * q)


@wp.func
def _on_face(
    p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, q_low: wp.float64, q_high: wp.float64, r_low: wp.float64, r_high: wp.float64
) -> wp.float64:
    """Returns the minimum of |p + s q + t r|^2 for s between q_low and q_high, and t between r_low and r_high."""
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
    """Returns the minimum of |W d|^2 over all d in a box, W = `whiten`, exact except for rounding. The minimum of a
    convex function over a box that does not contain its global minimum d = 0 is on a face whose plane separates the box
    from d = 0, of which there are at most three: otherwise a step towards d = 0 would stay in the box and reduce the
    value. Likewise, if the minimum over the plane of that face is outside the face, the minimum over the face is on one
    of at most two edges. A face or an edge at infinity separates nothing."""
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
def _limit(shape: Shape) -> float:
    """Returns the limit for squared distances from a Gaussian: the squared radius of a sphere, or the squared cut of an
    ellipsoid."""
    if shape.radius > 0.0:
        return shape.radius
    w = shape.whiten
    scale = wp.vec3(1.0 / wp.length(w[0]), 1.0 / wp.length(w[1]), 1.0 / wp.length(w[2]))
    # The diagonal of an ellipsoid's bounding box does not depend on its rotation.
    return wp.length_sq(shape.reach) / wp.length_sq(scale)


@wp.func
def _meets(cubes: Cubes, shape: Shape, limit: float, cell: wp.vec3i) -> bool:
    if not wp.isfinite(shape.reach):
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
    if shape.radius > 0.0:
        return not wp.length_sq(wp.max(low, wp.vec3()) + wp.min(high, wp.vec3())) > loose
    whiten = wp.mat33d(shape.whiten) + wp.mat33d(shape.rest)
    return not _nearest(whiten, wp.vec3d(low), wp.vec3d(high)) > wp.float64(loose)


@wp.kernel(enable_backward=False)
def _candidates(
    # in:
    shapes: wp.array1d[Shape],
    cubes: Cubes,
    # out:
    counts: wp.array1d[wp.int64],
):
    k = wp.tid()
    first, last = span(cubes, shapes[k].centre, shapes[k].reach)
    size = last - first + wp.vec3i(1, 1, 1)
    counts[k] = wp.int64(size[0]) * wp.int64(size[1]) * wp.int64(size[2])


@wp.kernel(enable_backward=False)
def _list(
    # in:
    shapes: wp.array1d[Shape],
    cubes: Cubes,
    offsets: wp.array1d[int],
    # out:
    counts: wp.array1d[int],
    keys: wp.array1d[int],
    items: wp.array1d[int],
):
    """Counts the cubes of each Gaussian and, unless `keys` is empty, writes its pairs from its offset on."""
    k = wp.tid()
    shape = shapes[k]
    limit = _limit(shape)
    first, last = span(cubes, shape.centre, shape.reach)
    count = int(0)
    for x in range(first[0], last[0] + 1):
        for y in range(first[1], last[1] + 1):
            for z in range(first[2], last[2] + 1):
                cell = wp.vec3i(x, y, z)
                if _meets(cubes, shape, limit, cell):
                    if keys.shape[0] > 0:
                        keys[offsets[k] + count] = _number(cubes, cell)
                        items[offsets[k] + count] = k
                    count += 1
    counts[k] = count


@wp.kernel(enable_backward=False)
def _find_starts(
    # in:
    keys: wp.array1d[int],
    count: int,
    # out:
    start: wp.array1d[int],
):
    key = wp.tid()
    # `lower_bound` never returns its end; with an end of count + 1 it can return `count`, and reads no entry beyond.
    start[key] = wp.lower_bound(keys, 0, count + 1, key)


def sort_by_cube(keys, items, count: int, cubes: int, start) -> None:
    """Sorts pairs of a cube and a Gaussian by the cube, in a stable order.

    Args:
        keys: int [2 * count], indices of cubes; the second half is scratch memory.
        items: int [2 * count], indices of Gaussians; the second half is scratch memory.
        count: Number of pairs.
        cubes: Number of cubes, C.
        start: int [C + 1], written: index of the sorted pairs at which each cube's pairs begin.
    """
    wp.utils.radix_sort_pairs(keys, items, count, end_bit=max(1, (cubes - 1).bit_length()))
    wp.launch(_find_starts, cubes + 1, inputs=[keys, count], outputs=[start], device=keys.device)


def build(shapes, low, high, size: float | None = None) -> Cubes:
    """Builds a grid of cubes over a box, with the list of each cube.

    Args:
        shapes: Shape [K] of the K Gaussians, made with the cut and the kind of support that later sums use.
        low, high: Lowest and highest corner of the box that contains the points, three numbers each; the box may be
            flat along any axis.
        size: Edge of a cube, positive, in the unit of the points. None: a quarter of the median reach of the Gaussians
            along their widest axis, times 1.25 until there are at most 8 K + 4,096 cubes and 256 K + 4,096 pairs of
            a cube and a Gaussian to test.

    Returns:
        The grid with its lists, on the shapes' device.

    Raises:
        ValueError: An argument is wrong, or there would be more than `MOST_PAIRS` cubes or pairs to test; this is
            checked before memory is allocated.
    """
    corners = np.array([low, high], np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or (corners[0] > corners[1]).any():
        raise ValueError(f"low, high: expected the lowest and the highest corner of a box, got {low} and {high}")
    if size is None:
        cubes = _chosen_grid(shapes, corners)
    elif math.isfinite(size) and size > 0:
        cubes = _grid(corners, size)
    else:
        raise ValueError(f"size: expected a positive number, got {size}")
    total = math.prod(cubes.counts)
    if total > MOST_PAIRS:
        raise ValueError(
            f"size: an edge of {cubes.size:g} makes {total} cubes, expected at most {MOST_PAIRS}: use a larger edge"
        )
    tested = _tested(shapes, cubes)
    if tested > MOST_PAIRS:
        raise ValueError(f"size: {cubes.size:g} makes {tested} pairs (cube, Gaussian), expected at most {MOST_PAIRS}")

    device, gaussians = shapes.device, shapes.shape[0]
    counts, offsets, none = (wp.empty(size, dtype=int, device=device) for size in (gaussians, gaussians, 0))
    wp.launch(_list, gaussians, inputs=[shapes, cubes, offsets], outputs=[counts, none, none], device=device)
    pairs = int(counts.numpy().sum(dtype=np.int64))
    wp.utils.array_scan(counts, offsets, inclusive=False)
    keys, items = (wp.empty(2 * pairs, dtype=int, device=device) for _ in range(2))
    wp.launch(_list, gaussians, inputs=[shapes, cubes, offsets], outputs=[counts, keys, items], device=device)
    cubes.start = wp.empty(total + 1, dtype=int, device=device)
    sort_by_cube(keys, items, pairs, total, cubes.start)
    cubes.item = wp.empty(pairs, dtype=int, device=device)
    if pairs:  # `copy` takes a count of 0 for the whole array
        wp.copy(cubes.item, items, count=pairs)
    return cubes


def everything(count: int, device) -> Cubes:
    """Returns a grid of one cube that lists all Gaussians, for sums without lists. `count` is K, the number of
    Gaussians."""
    cubes = _grid(np.zeros((2, 3)), 1.0)
    cubes.start = wp.array([0, count], dtype=int, device=device)
    cubes.item = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    return cubes


def _grid(corners: np.ndarray, size: float) -> Cubes:
    cubes = Cubes()
    cubes.low = wp.vec3(*corners[0])
    cubes.size = size
    # The caller refuses counts above MOST_PAIRS; the clip keeps them within a kernel's ints.
    counts = np.clip(np.ceil((corners[1] - corners[0]) / size), 1, MOST_PAIRS + 1)
    cubes.counts = wp.vec3i(*(int(count) for count in counts))
    return cubes


def _tested(shapes, cubes: Cubes) -> int:
    counts = wp.empty(shapes.shape[0], dtype=wp.int64, device=shapes.device)
    wp.launch(_candidates, counts.shape, inputs=[shapes, cubes], outputs=[counts], device=shapes.device)
    return int(counts.numpy().sum())


def _chosen_grid(shapes, corners: np.ndarray) -> Cubes:
    reach = shapes.numpy()["reach"].max(1, initial=0.0)
    reach = reach[np.isfinite(reach) & (reach > 0)]
    extent = float((corners[1] - corners[0]).max())
    # One cube if no Gaussian has a reach, or if the box is a point.
    size = _FIRST_SIZE * float(np.median(reach)) if len(reach) and extent > 0 else max(extent, 1.0)
    count = shapes.shape[0]
    cubes = _grid(corners, size)
    while math.prod(cubes.counts) > 1 and (
        math.prod(cubes.counts) > _FEW + _CUBES_EACH * count or _tested(shapes, cubes) > _FEW + _PAIRS_EACH * count
    ):
        size *= _COARSER
        cubes = _grid(corners, size)
    return cubes
