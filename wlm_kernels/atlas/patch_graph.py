"""The graph of patches that are alike (lightmap-uv-clustering-cascade, section 3.2), of which no edge is stored.

Few pairs need all their samples. Most are settled by bounds from below and from above (``Fit``), which are in float32,
are made looser by more than that loses, and so never change a result.
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

__all__ = ["Fit", "Graph", "Rule", "count_neighbours", "fit", "graph", "lose_neighbours", "mark_neighbours", "rule"]

# More than float32 loses of a bound, in levels of which there are up to 765: 6e-8 of them a few dozen times.
_MARGIN = wp.constant(4.0e-3)


@wp.struct
class Fit:
    """What bounds Dist on one lattice, in levels.

    With weights w = (i, j, k) / (n - 1), which add up to 1, and the colours T of one patch and T' of the other:

    - From below: the sum over v of |mean of w_v (T - T')| is at most the mean of |T - T'|.
    - From above: with L = sum of w_v C_v, the mean of |T - T'| is at most those of |T - L|, of |T' - L'| and of
      w_v |C_v - C'_v|, summed over v; the mean of w_v is a third.

    Attributes:
        moment: Row v: the mean over the samples of w_v T.
        corner: Row v: C_v of the best L by least squares.
        rest: Mean over the samples of |T - L|, summed over the channels.
    """

    moment: wp.mat33
    corner: wp.mat33
    rest: float


@wp.struct
class Rule:
    """When patches are alike.

    Attributes:
        colour: Largest square of the distance between two dominant colours, in bins.
        level: Mean difference, summed over the channels, in levels, below which two are alike.
        whole: The same rounded up: a whole number is below ``level`` where it is below this one.
        same: [len(SIZES)], for two patches of one size: alike where the sum of the differences of all samples and
            channels, in levels, is less.
        mixed: [len(SIZES)], the same where the larger has this size, in 1 / (n - 1) of a level.
    """

    colour: int
    level: float
    whole: int
    same: wp.array1d[int]
    mixed: wp.array1d[int]


@wp.kernel(enable_backward=False)
def _fit(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    # out:
    fits: wp.array2d[Fit],
):
    """On the lattice of a patch and all larger ones; a smaller one is never asked for."""
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
    rest = wp.float64(0.0)
    for j in range(steps + 1):
        for i in range(steps + 1 - j):
            w = wp.vec3d(wp.float64(i), wp.float64(j), wp.float64(steps - i - j))
            d = wp.vec3d(spread(samples, p, i, j, level)) / scale - w * corner
            rest += wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2])
    f = Fit()
    f.moment = wp.mat33(moment / (scale * scale * count))
    f.corner = wp.mat33(corner * scale)
    f.rest = float(rest / count)
    fits[t, level] = f


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
    samples: wp.array1d[int], patches: wp.array1d[Patch], fits: wp.array2d[Fit], rule: Rule, x: int, y: int
) -> int:
    """Whether any order brings Dist below lambda (eq. 3 and 4): odd where one does, above 1 where samples say so."""
    a = patches[x]
    b = patches[y]
    if not _near(rule, a.colour, b.colour):
        return 0
    # No interpolation leaves the range of a patch: what two ranges say holds for every sample in every order.
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
    f = fits[large, level]
    g = fits[small, level]
    below = _row_differences(f.moment, g.moment)
    above = _row_differences(f.corner, g.corner)
    hopeful = int(0)
    first = int(0)
    closest = float(wp.inf)
    for order in range(6):
        bound = _along(above, order) / 3.0 + f.rest + g.rest
        if bound < rule.level - _MARGIN:
            return 1
        if bound < closest:
            closest = bound
            first = order
        if _along(below, order) < rule.level + _MARGIN:
            hopeful += 1 << order
    if hopeful == 0:
        return 0
    limit = rule.mixed[level]
    if a.level == b.level:
        limit = rule.same[level]
    for i in range(6):
        # The likeliest first: one that is alike spares the others.
        order = (first + i) % 6
        if ((hopeful >> order) & 1) == 1:
            if distance_sum(samples, patches[large], patches[small], order, limit) < limit:
                return 3
    return 2


@wp.kernel(enable_backward=False)
def _count(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    fits: wp.array2d[Fit],
    rule: Rule,
    cell: wp.array1d[int],
    first: wp.array1d[int],
    offset: int,
    # out:
    degree: wp.array1d[int],
    compared: wp.array1d[wp.int64],
):
    """Each pair once: the thread of the one that comes first counts for both."""
    a = offset + wp.tid()
    colour = patches[a].colour
    mine = int(0)
    count = wp.int64(0)
    for c in range(cell[a], first.shape[0] - 1):
        if not _near(rule, colour, patches[first[c]].colour):
            continue
        for b in range(wp.max(first[c], a + 1), first[c + 1]):
            said = _alike(samples, patches, fits, rule, a, b)
            if said > 1:
                count += wp.int64(1)
            if (said & 1) == 1:
                mine += 1
                wp.atomic_add(degree, b, 1)
    wp.atomic_add(degree, a, mine)
    compared[a] = count


@wp.kernel(enable_backward=False)
def _mark(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    fits: wp.array2d[Fit],
    rule: Rule,
    left: wp.array1d[int],
    chosen: int,
    # out:
    marked: wp.array1d[wp.uint8],
):
    i = wp.tid()
    a = left[i]
    said = int(1)  # its own neighbour
    if a != chosen:
        said = _alike(samples, patches, fits, rule, chosen, a)
    marked[i] = wp.uint8(said & 1)


@wp.kernel(enable_backward=False)
def _lose(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    fits: wp.array2d[Fit],
    rule: Rule,
    left: wp.array1d[int],
    gone: wp.array1d[int],
    # out:
    degree: wp.array1d[int],
):
    a = left[wp.tid()]
    lost = int(0)
    for i in range(gone.shape[0]):
        b = gone[i]
        if (_alike(samples, patches, fits, rule, a, b) & 1) == 1:
            lost += 1
    degree[a] -= lost


def rule(threshold: float, colour_threshold: float, device) -> Rule:
    """When two patches are alike, exact at the thresholds: these stand for the decimal fractions that they print as.

    Args:
        threshold: lambda (eq. 4); Dist must be less.
        colour_threshold: lambda_h (section 3.2.1); the distance of two dominant colours may be this, and not more.
        device: Where the arrays go.
    """
    total = Fraction(str(threshold)) * 765  # of three channels of 255 levels
    made = Rule()
    made.colour = math.floor((Fraction(str(colour_threshold)) * BINS) ** 2)
    made.level = float(total)
    made.whole = math.ceil(total)
    same = [math.ceil(total * samples_of(size)) for size in SIZES]
    mixed = [math.ceil(total * samples_of(size) * (size - 1)) for size in SIZES]
    made.same = wp.array(same, dtype=int, device=device)
    made.mixed = wp.array(mixed, dtype=int, device=device)
    return made


def fit(samples, patches, levels: int):
    """What bounds the distances of patches, Fit [F, levels].

    Args:
        samples, patches: As of ``sample``.
        levels: One more than the highest level of a patch.
    """
    fits = wp.empty((patches.shape[0], levels), dtype=Fit, device=samples.device)
    wp.launch(_fit, fits.shape, inputs=[samples, patches], outputs=[fits], device=samples.device)
    return fits


@dataclass(frozen=True)
class Graph:
    """The similarity graph (eq. 5), of which no edge is stored: each is told from the patches when it is asked for.

    Attributes:
        samples: int, of all patches.
        patches: Patch [M], by rising bin of the dominant colour.
        fits: Fit [M, levels].
        rule: Rule.
        cell: int [M], number of the bin among those that occur.
        first: int [cells + 1], the first patch of each bin.
    """

    samples: wp.array
    patches: wp.array
    fits: wp.array
    rule: Rule
    cell: wp.array
    first: wp.array

    def _inputs(self) -> list:
        return [self.samples, self.patches, self.fits, self.rule]


def graph(samples, patches, fits, rule: Rule) -> Graph:
    """Makes the graph of patches that are sorted by ``bin_numbers``."""
    bins = bin_numbers(patches.numpy()["colour"])
    _, first, cell = np.unique(bins, return_index=True, return_inverse=True)
    first = np.append(first, len(bins))
    device = samples.device
    cells = [wp.array(values.astype(np.int32), dtype=int, device=device) for values in (cell, first)]
    return Graph(samples, patches, fits, rule, *cells)


def count_neighbours(graph: Graph, begin: int, end: int, degree, compared) -> None:
    """Adds the edges between a patch from ``begin`` on, before ``end``, and any later one to the degrees of both.

    Args:
        graph: The graph.
        begin, end: The range.
        degree: int [M], added to.
        compared: int64 [M], written in the range: edges for which the bounds didn't do.
    """
    inputs = [*graph._inputs(), graph.cell, graph.first, begin]
    wp.launch(_count, end - begin, inputs=inputs, outputs=[degree, compared], device=degree.device)


def mark_neighbours(graph: Graph, left, chosen: int, marked) -> None:
    """Finds the neighbours of a patch among those that are left, and itself.

    Args:
        graph: The graph.
        left: int [L], patches.
        chosen: The patch.
        marked: uint8 [L], written: 1 for ``chosen`` and its neighbours, else 0.
    """
    inputs = [*graph._inputs(), left, chosen]
    wp.launch(_mark, left.shape, inputs=inputs, outputs=[marked], device=left.device)


def lose_neighbours(graph: Graph, left, gone, degree) -> None:
    """Takes the edges to patches that are gone from the degrees of those that are left.

    Args:
        graph: The graph.
        left: int [L], patches.
        gone: int [G], others.
        degree: int [M].
    """
    inputs = [*graph._inputs(), left, gone]
    wp.launch(_lose, left.shape, inputs=inputs, outputs=[degree], device=left.device)
