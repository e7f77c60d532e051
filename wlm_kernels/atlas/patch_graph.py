"""The graph of patches that are alike (lightmap-uv-clustering-cascade, section 3.2), without storing its edges.

Few pairs need all their samples compared. Bounds of the distance from below and from above (`Bounds`) settle most;
they are in float32, with a margin larger than its rounding, and so never change a result.

Read `tests/reference/patches.py` first (`distances`, `adjacency`, `greedy`): the same with the whole matrix.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import warp as wp

from wlm_kernels.atlas.patches import (
    BINS,
    SIZES,
    Patch,
    bin_numbers,
    channel,
    distance_sum,
    samples_of,
    spread,
    turned,
)

# More than the rounding of a bound in float32: 6e-8 of up to 765 levels, a few dozen times.
_MARGIN = wp.constant(4.0e-3)


@wp.struct
class Bounds:
    """Quantities of one patch that bound Dist on one lattice, in levels.

    With weights w = (i, j, k) / (n - 1), which add up to 1, and the colours T of one patch and T' of the other:

    - From below: the sum over v of |mean of w_v (T - T')| is at most the mean of |T - T'|.
    - From above: with L = sum of w_v C_v, the mean of |T - T'| is at most those of |T - L|, of |T' - L'| and of
      w_v |C_v - C'_v|, summed over v; the mean of w_v is a third.

    Attributes:
        moment: Row v: the mean over the samples of w_v T.
        corner: Row v: C_v of the best L by least squares.
        residual: Mean over the samples of |T - L|, summed over the channels.
    """

    moment: wp.mat33
    corner: wp.mat33
    residual: float


@wp.struct
class Rule:
    """Thresholds below which patches are alike.

    Attributes:
        colour: Largest squared distance of two dominant colours, in bins.
        level: Mean difference, summed over the channels, in levels.
        whole: The same rounded up: a whole number is below `level` where it is below this one.
        same: [len(SIZES)], for two patches of one size: sum of the differences of all samples and channels, in levels.
        mixed: [len(SIZES)], the same where the larger has this size, in 1 / (n - 1) of a level.
    """

    colour: int
    level: float
    whole: int
    same: wp.array1d[int]
    mixed: wp.array1d[int]


@wp.kernel(enable_backward=False)
def _bounds(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    # out:
    bounds: wp.array2d[Bounds],
):
    """One patch and lattice per thread. Lattices smaller than the patch's own are never used and stay unset."""
    t, level = wp.tid()
    p = patches[t]
    if level < p.level:
        return
    steps = 1 << level
    moment = wp.mat33d()
    across = wp.float64(0.0)
    count = wp.float64(0.0)
    for j in range(steps + 1):
        for i in range(steps + 1 - j):
            w = wp.vec3d(wp.float64(i), wp.float64(j), wp.float64(steps - i - j))
            moment += wp.outer(w, wp.vec3d(spread(samples, p, i, j, level)))
            across += w[0] * w[1]
            count += wp.float64(1.0)
    # The matrix of the normal equations has one number on its diagonal and one everywhere else.
    scale = wp.float64(steps)
    all = scale * scale * count / wp.float64(3.0)
    mean = (moment[0] + moment[1] + moment[2]) * (across / all)
    corner = wp.matrix_from_rows(moment[0] - mean, moment[1] - mean, moment[2] - mean) / (
        all - wp.float64(3.0) * across
    )
    residual = wp.float64(0.0)
    for j in range(steps + 1):
        for i in range(steps + 1 - j):
            w = wp.vec3d(wp.float64(i), wp.float64(j), wp.float64(steps - i - j))
            d = wp.vec3d(spread(samples, p, i, j, level)) / scale - w * corner
            residual += wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2])
    f = Bounds()
    f.moment = wp.mat33(moment / (scale * scale * count))
    f.corner = wp.mat33(corner * scale)
    f.residual = float(residual / count)
    bounds[t, level] = f


@wp.func
def _row_difference(a: wp.mat33, v: int, b: wp.mat33, u: int) -> float:
    return wp.abs(a[v, 0] - b[u, 0]) + wp.abs(a[v, 1] - b[u, 1]) + wp.abs(a[v, 2] - b[u, 2])


@wp.func
def _row_differences(a: wp.mat33, b: wp.mat33) -> wp.mat33:
    return wp.mat33(
        _row_difference(a, 0, b, 0),
        _row_difference(a, 0, b, 1),
        _row_difference(a, 0, b, 2),
        _row_difference(a, 1, b, 0),
        _row_difference(a, 1, b, 1),
        _row_difference(a, 1, b, 2),
        _row_difference(a, 2, b, 0),
        _row_difference(a, 2, b, 1),
        _row_difference(a, 2, b, 2),
    )


@wp.func
def _along(m: wp.mat33, order: int) -> float:
    """The sum of m[p[k], k]."""
    p = turned(wp.vec3i(0, 1, 2), order)
    return m[p[0], 0] + m[p[1], 1] + m[p[2], 2]


@wp.func
def _near(rule: Rule, a: int, b: int) -> bool:
    """Whether two dominant colours are within lambda_h of each other."""
    r = channel(a, 0) - channel(b, 0)
    g = channel(a, 1) - channel(b, 1)
    b_ = channel(a, 2) - channel(b, 2)
    return r * r + g * g + b_ * b_ <= rule.colour


@wp.func
def _alike(
    samples: wp.array1d[int], patches: wp.array1d[Patch], bounds: wp.array2d[Bounds], rule: Rule, x: int, y: int
) -> int:
    """Whether Dist is below lambda in any order (eq. 3 and 4): odd if it is, above 1 if samples had to be compared."""
    a = patches[x]
    b = patches[y]
    if not _near(rule, a.colour, b.colour):
        return 0
    # No interpolation leaves the range of a patch: bounds by two ranges hold for every sample in every order.
    most = int(0)
    least = int(0)
    for c in range(3):
        up = channel(a.high, c) - channel(b.low, c)
        down = channel(b.high, c) - channel(a.low, c)
        most += wp.max(up, down)
        least += wp.max(0, wp.max(-up, -down))
    if most < rule.whole:
        return 1
    if least >= rule.whole:
        return 0
    large = x
    small = y
    if a.level < b.level:
        large = y
        small = x
    level = wp.max(a.level, b.level)
    f = bounds[large, level]
    g = bounds[small, level]
    below = _row_differences(f.moment, g.moment)
    above = _row_differences(f.corner, g.corner)
    undecided = int(0)
    first = int(0)
    closest = float(wp.inf)
    for order in range(6):
        bound = _along(above, order) / 3.0 + f.residual + g.residual
        if bound < rule.level - _MARGIN:
            return 1
        if bound < closest:
            closest = bound
            first = order
        if _along(below, order) < rule.level + _MARGIN:
            undecided += 1 << order
    if undecided == 0:
        return 0
    limit = rule.mixed[level]
    if a.level == b.level:
        limit = rule.same[level]
    for i in range(6):
        # The likeliest first: if it is alike the others need no comparison.
        order = (first + i) % 6
        if ((undecided >> order) & 1) == 1:
            if distance_sum(samples, patches[large], patches[small], order, limit) < limit:
                return 3
    return 2


@wp.kernel(enable_backward=False)
def _count(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    bounds: wp.array2d[Bounds],
    rule: Rule,
    cell: wp.array1d[int],
    first: wp.array1d[int],
    offset: int,
    # out:
    degree: wp.array1d[int],
    compared: wp.array1d[wp.int64],
):
    """One patch per thread; each pair once, counted for both by the thread of the first."""
    a = offset + wp.tid()
    colour = patches[a].colour
    neighbours = int(0)
    count = wp.int64(0)
    for c in range(cell[a], first.shape[0] - 1):
        if not _near(rule, colour, patches[first[c]].colour):
            continue
        for b in range(wp.max(first[c], a + 1), first[c + 1]):
            alike = _alike(samples, patches, bounds, rule, a, b)
            if alike > 1:
                count += wp.int64(1)
            if (alike & 1) == 1:
                neighbours += 1
                wp.atomic_add(degree, b, 1)
    wp.atomic_add(degree, a, neighbours)
    compared[a] = count


@wp.kernel(enable_backward=False)
def _mark(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    bounds: wp.array2d[Bounds],
    rule: Rule,
    nodes: wp.array1d[int],
    node: int,
    # out:
    marked: wp.array1d[wp.uint8],
):
    """One node per thread."""
    i = wp.tid()
    a = nodes[i]
    alike = int(1)  # the node itself is marked too
    if a != node:
        alike = _alike(samples, patches, bounds, rule, node, a)
    marked[i] = wp.uint8(alike & 1)


@wp.kernel(enable_backward=False)
def _remove(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    bounds: wp.array2d[Bounds],
    rule: Rule,
    nodes: wp.array1d[int],
    removed: wp.array1d[int],
    # out:
    degree: wp.array1d[int],
):
    """One remaining node per thread."""
    a = nodes[wp.tid()]
    count = int(0)
    for i in range(removed.shape[0]):
        b = removed[i]
        if (_alike(samples, patches, bounds, rule, a, b) & 1) == 1:
            count += 1
    degree[a] -= count


def rule(threshold: float, colour_threshold: float, device) -> Rule:
    """Makes the thresholds, exact as the decimal fractions that they print as.

    Args:
        threshold: lambda (eq. 4); Dist must be less.
        colour_threshold: lambda_h (section 3.2.1), the largest distance of two dominant colours.
        device: Where the arrays go.
    """
    total = Fraction(str(threshold)) * 765  # of three channels of 255 levels
    out = Rule()
    out.colour = math.floor((Fraction(str(colour_threshold)) * BINS) ** 2)
    out.level = float(total)
    out.whole = math.ceil(total)
    same = [math.ceil(total * samples_of(size)) for size in SIZES]
    mixed = [math.ceil(total * samples_of(size) * (size - 1)) for size in SIZES]
    out.same = wp.array(same, dtype=int, device=device)
    out.mixed = wp.array(mixed, dtype=int, device=device)
    return out


def bounds(samples, patches, levels: int):
    """Computes `Bounds` [F, levels] of patches.

    Args:
        samples, patches: As of `sample`.
        levels: One more than the highest level of a patch.
    """
    out = wp.empty((patches.shape[0], levels), dtype=Bounds, device=samples.device)
    wp.launch(_bounds, out.shape, inputs=[samples, patches], outputs=[out], device=samples.device)
    return out


@dataclass(frozen=True)
class Graph:
    """The similarity graph (eq. 5). No edge is stored: each is computed from the patches when it is needed.

    Attributes:
        samples: int, samples of all patches.
        patches: Patch [M], by rising bin of the dominant colour.
        bounds: Bounds [M, levels].
        rule: Rule.
        cell: int [M], number of the bin among those that occur.
        first: int [cells + 1], the first patch of each bin.
    """

    samples: wp.array
    patches: wp.array
    bounds: wp.array
    rule: Rule
    cell: wp.array
    first: wp.array

    def _inputs(self) -> list:
        return [self.samples, self.patches, self.bounds, self.rule]


def graph(samples, patches, bounds, rule: Rule) -> Graph:
    """Makes the graph of patches that are sorted by `bin_numbers`."""
    bins = bin_numbers(patches.numpy()["colour"])
    _, first, cell = np.unique(bins, return_index=True, return_inverse=True)
    first = np.append(first, len(bins))
    device = samples.device
    cells = [wp.array(values.astype(np.int32), dtype=int, device=device) for values in (cell, first)]
    return Graph(samples, patches, bounds, rule, *cells)


def count_neighbours(graph: Graph, begin: int, end: int, degree, compared) -> None:
    """Adds the edges between patches `begin` to `end` - 1 and any later one to the degrees of both.

    Args:
        graph: The graph.
        begin, end: The range.
        degree: int [M], added to.
        compared: int64 [M], written in the range: pairs that the bounds did not settle.
    """
    inputs = [*graph._inputs(), graph.cell, graph.first, begin]
    wp.launch(_count, end - begin, inputs=inputs, outputs=[degree, compared], device=degree.device)


def mark_neighbours(graph: Graph, nodes, node: int, marked) -> None:
    """Marks a patch and its neighbours.

    Args:
        graph: The graph.
        nodes: int [L], the patches to look at.
        node: The patch.
        marked: uint8 [L], written: 1 for `node` and its neighbours, else 0.
    """
    inputs = [*graph._inputs(), nodes, node]
    wp.launch(_mark, nodes.shape, inputs=inputs, outputs=[marked], device=nodes.device)


def remove_neighbours(graph: Graph, nodes, removed, degree) -> None:
    """Subtracts the edges to removed patches from the degrees of the remaining ones.

    Args:
        graph: The graph.
        nodes: int [L], the remaining patches.
        removed: int [G], the removed ones.
        degree: int [M], subtracted from.
    """
    inputs = [*graph._inputs(), nodes, removed]
    wp.launch(_remove, nodes.shape, inputs=inputs, outputs=[degree], device=nodes.device)
