"""The graph of similar patches (lightmap-uv-clustering-cascade, section 3.2). A patch stores the colours of a triangle.

Two patches are alike if their distance is below a threshold, lambda. For most pairs, lower and upper bounds of the
distance (`Bounds`) decide, so that all samples are compared for few pairs only. The bounds are float32 with a margin
above their rounding errors, and so never change a result. Lattices of more than 65 samples along a side have no bounds,
since computing them would take longer than the few comparisons of such patches. Patches are sorted by mean colour: if
two means differ by lambda or more, the patches can't be alike and are not compared.

Read `tests/reference/patches.py` first (`distances`, `adjacency`, `greedy`), which does the same with the distances of
all pairs.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import warp as wp

from wlm_kernels.atlas.patches import BINS, SIZES, Patch, channel, distance_sum, samples_of, spread, turned

# The margin exceeds the rounding of a bound in float32: 6e-8 of up to 765 levels, a few dozen times.
_MARGIN = wp.constant(4.0e-3)

_BOUNDED = 7  # sizes with `Bounds`: up to 65


@wp.struct
class Bounds:
    """Quantities of one patch that bound the distance Dist between two patches on one lattice, in 8-bit colour levels.

    A sample (i, j, k) of a lattice of size n has the weights w = (i, j, k) / (n - 1) of the vertices v, and the colours
    T in one patch and T' in the other. L = sum of w_v C_v is the linear function that fits T best by least squares.

    - From below: the sum over v of |mean of w_v (T - T')| is at most the mean of |T - T'|.
    - From above: the mean of |T - T'| is at most the sum of the means of |T - L|, of |T' - L'| and, for each vertex v,
      of w_v |C_v - C'_v|. The mean of w_v is 1/3.

    Attributes:
        moment: Row v: the mean over the samples of w_v T.
        corner: Row v: C_v, the colour of L at vertex v.
        residual: Mean over the samples of |T - L|, summed over the channels.
    """

    moment: wp.mat33
    corner: wp.mat33
    residual: float


@wp.struct
class Rule:
    """Thresholds below which two patches are alike. A level is 1 of 255 in an 8-bit colour.

    Attributes:
        colour: Largest squared distance of the two dominant colours, in bins of the colour histogram.
        level: The mean difference of the samples, summed over the channels, must be below this number of levels.
        whole: `level` rounded up to a whole number.
        same: [len(SIZES)], for two patches of this size: threshold of the sum of all samples' differences, in levels.
        mixed: [len(SIZES)], the same for patches of two sizes, by the larger size n, in 1 / (n - 1) of a level.
    """

    colour: int
    level: float
    whole: int
    same: wp.array1d[wp.int64]
    mixed: wp.array1d[wp.int64]


@wp.struct
class Nodes:
    """The input of comparisons of M patches: the samples of all patches; the patches; their `Bounds`, [M, L]; the rule;
    and the least and greatest mean colour of each, see `Graph`."""

    samples: wp.array1d[int]
    patches: wp.array1d[Patch]
    bounds: wp.array2d[Bounds]
    rule: Rule
    low: wp.array1d[float]
    high: wp.array1d[float]


@wp.kernel(enable_backward=False)
def _bounds(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    # out:
    bounds: wp.array2d[Bounds],
):
    """Computes the `Bounds` of one patch on one lattice per thread; none for lattices smaller than the patch's own."""
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
def _row_differences(a: wp.mat33, b: wp.mat33) -> wp.mat33:
    """Returns the matrix of the differences |a_v - b_u| of rows v of a and rows u of b, summed over the channels."""
    out = wp.mat33()
    for v in range(3):
        for u in range(3):
            out[v, u] = wp.abs(a[v, 0] - b[u, 0]) + wp.abs(a[v, 1] - b[u, 1]) + wp.abs(a[v, 2] - b[u, 2])
    return out


@wp.func
def _along(m: wp.mat33, order: int) -> float:
    """Returns the sum of m[p[k], k] over k, where p is the permutation `ORDERS[order]`."""
    p = turned(wp.vec3i(0, 1, 2), order)
    return m[p[0], 0] + m[p[1], 1] + m[p[2], 2]


@wp.func
def _near(rule: Rule, a: int, b: int) -> bool:
    """Tests whether the distance of the dominant colours a and b is within the rule's threshold."""
    r = channel(a, 0) - channel(b, 0)
    g = channel(a, 1) - channel(b, 1)
    b_ = channel(a, 2) - channel(b, 2)
    return r * r + g * g + b_ * b_ <= rule.colour


@wp.func
def _has_bounds(nodes: Nodes, x: int) -> bool:
    return nodes.patches[x].level < nodes.bounds.shape[1]


@wp.func
def _alike(nodes: Nodes, x: int, y: int) -> bool:
    """Tests whether patches x and y are alike: Dist is below lambda in some order of the vertices (eq. 3 and 4)."""
    rule = nodes.rule
    a = nodes.patches[x]
    b = nodes.patches[y]
    if not _near(rule, a.colour, b.colour):
        return False
    # Interpolation stays within a patch's range, so bounds from two ranges are valid for all samples and orders.
    most = int(0)
    least = int(0)
    for c in range(3):
        up = channel(a.high, c) - channel(b.low, c)
        down = channel(b.high, c) - channel(a.low, c)
        most += wp.max(up, down)
        least += wp.max(0, wp.max(-up, -down))
    if most < rule.whole:
        return True
    if least >= rule.whole:
        return False
    large = x
    small = y
    if a.level < b.level:
        large = y
        small = x
    level = wp.max(a.level, b.level)
    undecided = int(63)
    first = int(0)
    if level < nodes.bounds.shape[1]:
        f = nodes.bounds[large, level]
        g = nodes.bounds[small, level]
        below = _row_differences(f.moment, g.moment)
        above = _row_differences(f.corner, g.corner)
        undecided = 0
        closest = float(wp.inf)
        for order in range(6):
            bound = _along(above, order) / 3.0 + f.residual + g.residual
            if bound < rule.level - _MARGIN:
                return True
            if bound < closest:
                closest = bound
                first = order
            if _along(below, order) < rule.level + _MARGIN:
                undecided += 1 << order
        if undecided == 0:
            return False
    limit = rule.mixed[level]
    if a.level == b.level:
        limit = rule.same[level]
    for i in range(6):
        # The likeliest order comes first: if the patches are alike in it, the others need no comparison.
        order = (first + i) % 6
        if ((undecided >> order) & 1) == 1:
            if distance_sum(nodes.samples, nodes.patches[large], nodes.patches[small], order, limit) < limit:
                return True
    return False


@wp.func
def _far(nodes: Nodes, x: int, y: int) -> bool:
    """Tests whether the means of patches x and y are so different that the patches cannot be alike."""
    margin = nodes.rule.level + _MARGIN
    return nodes.low[y] > nodes.high[x] + margin or nodes.low[x] > nodes.high[y] + margin


@wp.func
def _connect(nodes: Nodes, x: int, y: int, edge: wp.array2d[wp.uint8]):
    if _alike(nodes, x, y):
        edge[x, y] = wp.uint8(1)
        edge[y, x] = wp.uint8(1)


@wp.kernel(enable_backward=False)
def _spans(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    levels: int,
    # out:
    low: wp.array1d[float],
    high: wp.array1d[float],
):
    """Writes a patch's least and greatest mean colour (sum of the channels) on its own lattice and all larger ones.

    A larger lattice has s steps in each step of the patch's own. In the sum of the interpolated colours a sample within
    the patch then has the weight s^2, one on an edge s (s + 1) / 2 and one at a corner (s + 1) (s + 2) / 6.
    """
    t = wp.tid()
    p = patches[t]
    steps = 1 << p.level
    sums = wp.vec3d()  # within, on edges, at corners
    at = p.start
    for j in range(steps + 1):
        for i in range(steps + 1 - j):
            k = steps - i - j
            zeros = wp.where(i == 0, 1, 0) + wp.where(j == 0, 1, 0) + wp.where(k == 0, 1, 0)
            a = samples[at]
            sums[zeros] += wp.float64(channel(a, 0) + channel(a, 1) + channel(a, 2))
            at += 1
    least = wp.float64(wp.inf)
    most = wp.float64(-wp.inf)
    for level in range(p.level, levels):
        s = wp.float64(1 << (level - p.level))
        n = wp.float64((1 << level) + 1)
        one = wp.float64(1.0)
        two = wp.float64(2.0)
        six = wp.float64(6.0)
        sum = s * s * sums[0] + s * (s + one) / two * sums[1] + (s + one) * (s + two) / six * sums[2]
        mean = sum / (n * (n + one) / two)
        least = wp.min(least, mean)
        most = wp.max(most, mean)
    low[t] = float(least)
    high[t] = float(most)


@wp.kernel(enable_backward=False)
def _edges(
    # in:
    nodes: Nodes,
    offset: int,
    # out:
    edge: wp.array2d[wp.uint8],
):
    """Finds the edges between one patch per thread and all later patches, so that each pair is tested once."""
    a = offset + wp.tid()
    if not _has_bounds(nodes, a):
        return
    last = nodes.high[a] + nodes.rule.level + _MARGIN
    for b in range(a + 1, nodes.low.shape[0]):
        if nodes.low[b] > last:
            break
        if _has_bounds(nodes, b):
            _connect(nodes, a, b, edge)


@wp.kernel(enable_backward=False)
def _large_edges(
    # in:
    nodes: Nodes,
    large: wp.array1d[int],
    # out:
    edge: wp.array2d[wp.uint8],
):
    """Finds the edges of patches that have no bounds, with a thread for each pair, since a comparison takes long."""
    k, b = wp.tid()
    a = large[k]
    if b == a or (b < a and not _has_bounds(nodes, b)) or _far(nodes, a, b):
        return
    _connect(nodes, a, b, edge)


@wp.kernel(enable_backward=False)
def _join(
    # in:
    nodes: Nodes,
    reach: float,
    each: wp.array1d[int],
    offset: int,
    heads: wp.array1d[int],
    head_low: wp.array1d[float],
    rank: wp.array1d[int],
    # out:
    joined: wp.array1d[int],
):
    """Finds for one node per thread the least rank of a group whose representative is alike; H if none of H is."""
    i = offset + wp.tid()
    a = each[i]
    margin = nodes.rule.level + _MARGIN
    best = int(rank.shape[0])
    if not _has_bounds(nodes, a):
        joined[i] = best
        return
    for k in range(wp.lower_bound(head_low, nodes.low[a] - margin - reach), heads.shape[0]):
        if head_low[k] > nodes.high[a] + margin:
            break
        if rank[k] < best:
            if _alike(nodes, heads[k], a):
                best = rank[k]
    joined[i] = best


@wp.kernel(enable_backward=False)
def _join_large(
    # in:
    nodes: Nodes,
    each: wp.array1d[int],
    large: wp.array1d[int],
    heads: wp.array1d[int],
    rank: wp.array1d[int],
    # out:
    joined: wp.array1d[int],
):
    """Does the same for nodes whose patches have no bounds, with a thread for each pair of a node and a group."""
    j, k = wp.tid()
    i = large[j]
    if _far(nodes, each[i], heads[k]) or rank[k] >= joined[i]:
        return
    if _alike(nodes, heads[k], each[i]):
        wp.atomic_min(joined, i, rank[k])


def rule(threshold: float, colour_threshold: float, device) -> Rule:
    """Makes the `Rule` on a device. Patches are alike if Dist is less than `threshold`, lambda (eq. 4), and their
    dominant colours are at most `colour_threshold`, lambda_h, apart (section 3.2.1). The two are taken as decimal
    fractions: 0.1 is exactly 1/10."""
    total = Fraction(str(threshold)) * 765  # three channels of 255 levels
    out = Rule()
    out.colour = math.floor((Fraction(str(colour_threshold)) * BINS) ** 2)
    out.level = float(total)
    out.whole = math.ceil(total)
    same = [math.ceil(total * samples_of(size)) for size in SIZES]
    mixed = [math.ceil(total * samples_of(size) * (size - 1)) for size in SIZES]
    out.same = wp.array(same, dtype=wp.int64, device=device)
    out.mixed = wp.array(mixed, dtype=wp.int64, device=device)
    return out


def bounds(samples, patches, levels: int):
    """Returns the `Bounds` [F, L] of F patches on the lattices of the sizes `SIZES[:L]`, L = `levels`, at most 7."""
    out = wp.empty((patches.shape[0], min(levels, _BOUNDED)), dtype=Bounds, device=samples.device)
    wp.launch(_bounds, out.shape, inputs=[samples, patches], outputs=[out], device=samples.device)
    return out


@dataclass(frozen=True)
class Graph:
    """The similarity graph of M patches (eq. 5), sorted by `low`. Its edges are computed when they are needed.

    Attributes:
        nodes: The M patches, sorted, and what is compared. `low` and `high` are the least and greatest mean of a patch
            on any lattice, in levels: if two patches are alike, their means on the larger one's lattice differ by less
            than `rule.level`.
        means: float32 [M], copy of `low` in the CPU's memory.
        large: bool [M], on the CPU: whether a patch has no bounds.
        reach: The largest difference of `high` and `low` in any patch.
    """

    nodes: Nodes
    means: np.ndarray
    large: np.ndarray
    reach: float


def graph(samples, patches, bounds, levels: int, rule: Rule) -> tuple[Graph, np.ndarray]:
    """Makes the graph of M patches of the sizes `SIZES[:levels]`. Also returns the index in `patches` of each of its
    nodes, int64 [M]."""
    count, device = patches.shape[0], samples.device
    nodes = Nodes()
    nodes.samples, nodes.patches, nodes.bounds, nodes.rule = samples, patches, bounds, rule
    nodes.low, nodes.high = (wp.empty(count, dtype=float, device=device) for _ in range(2))
    wp.launch(_spans, count, inputs=[samples, patches, levels], outputs=[nodes.low, nodes.high], device=device)
    least, most = nodes.low.numpy(), nodes.high.numpy()
    order = np.argsort(least, kind="stable")
    large = patches.numpy()["level"] >= bounds.shape[1]
    return part(Graph(nodes, least, large, float((most - least).max(initial=0.0))), order), order


def part(whole: Graph, nodes: np.ndarray) -> Graph:
    """Makes the subgraph of N nodes, whose numbers are `nodes`, int [N], with `low` rising."""
    out = Nodes()
    out.samples, out.rule = whole.nodes.samples, whole.nodes.rule
    for name, kind in (("patches", Patch), ("bounds", Bounds), ("low", float), ("high", float)):
        values = getattr(whole.nodes, name)
        setattr(out, name, wp.array(values.numpy()[nodes], dtype=kind, device=values.device))
    return Graph(out, whole.means[nodes], whole.large[nodes], whole.reach)


def find_edges(graph: Graph, begin: int, end: int, edge) -> None:
    """Finds the edges between the nodes `begin` to `end` - 1 and all later ones. For an edge between a and b it writes
    1 to `edge`, uint8 [M, M], at (a, b) and at (b, a); all of `edge` must be 0 before."""
    wp.launch(_edges, end - begin, inputs=[graph.nodes, begin], outputs=[edge], device=edge.device)
    large = begin + np.flatnonzero(graph.large[begin:end])
    if len(large):
        inputs = [graph.nodes, wp.array(large, dtype=int, device=edge.device)]
        wp.launch(_large_edges, (len(large), len(graph.means)), inputs=inputs, outputs=[edge], device=edge.device)


def join(graph: Graph, nodes, begin: int, end: int, heads, head_low, rank, joined) -> None:
    """Finds for each of the nodes `nodes[begin:end]` the first of H groups whose representative it is like, and writes
    the group's rank to `joined`, int [N], or H if there is none. `heads`, int [H], are the representatives in ascending
    order; `head_low` is the `low` of each, and `rank` its place in the order in which groups are tried."""
    device = joined.device
    inputs = [graph.nodes, graph.reach, nodes, begin, heads, head_low, rank]
    wp.launch(_join, end - begin, inputs=inputs, outputs=[joined], device=device)
    large = begin + np.flatnonzero(graph.large[nodes.numpy()[begin:end]])
    if len(large):
        inputs = [graph.nodes, nodes, wp.array(large, dtype=int, device=device), heads, rank]
        wp.launch(_join_large, (len(large), heads.shape[0]), inputs=inputs, outputs=[joined], device=device)
