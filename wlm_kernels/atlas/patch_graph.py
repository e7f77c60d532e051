"""The graph of similar patches (lightmap-uv-clustering-cascade, section 3.2). A patch stores the colours of a triangle.

Two patches are alike, which is an edge of the graph, if their distance is below a threshold, lambda. For most pairs the
ranges of their colours decide; the samples of the others are compared until their sum reaches the threshold.

Read `tests/reference/patches.py` first (`distances`, `adjacency`, `greedy`), which does the same with the distances of
all pairs.
"""

import math
from fractions import Fraction

import warp as wp

from wlm_kernels.atlas.patches import BINS, SIZES, Patch, channel, distance_sum, samples_of


@wp.struct
class Rule:
    """Thresholds below which two patches are alike. A level is 1 of 255 in an 8-bit colour.

    Attributes:
        colour: Largest squared distance of the two dominant colours, in bins of the colour histogram.
        level: The mean difference of the samples, summed over the channels, must be below this number of levels, which
            is rounded up to a whole one.
        same: [len(SIZES)], for two patches of this size: threshold of the sum of all samples' differences, in levels.
        mixed: [len(SIZES)], the same for patches of two sizes, by the larger size n, in 1 / (n - 1) of a level.
    """

    colour: int
    level: int
    same: wp.array1d[int]
    mixed: wp.array1d[int]


@wp.func
def _near(rule: Rule, a: int, b: int) -> bool:
    """Tests whether the distance of the dominant colours a and b is within the rule's threshold."""
    r = channel(a, 0) - channel(b, 0)
    g = channel(a, 1) - channel(b, 1)
    b_ = channel(a, 2) - channel(b, 2)
    return r * r + g * g + b_ * b_ <= rule.colour


@wp.func
def _alike(samples: wp.array1d[int], a: Patch, b: Patch, rule: Rule) -> bool:
    """Tests whether two patches are alike: Dist is below lambda in some order of the vertices (eq. 3 and 4)."""
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
    if most < rule.level:
        return True
    if least >= rule.level:
        return False
    large = a
    small = b
    if a.level < b.level:
        large = b
        small = a
    limit = rule.mixed[large.level]
    if a.level == b.level:
        limit = rule.same[large.level]
    for order in range(6):
        if distance_sum(samples, large, small, order, limit) < limit:
            return True
    return False


@wp.kernel(enable_backward=False)
def _edges(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    rule: Rule,
    offset: int,
    # out:
    edge: wp.array2d[wp.uint8],
):
    """Finds the edges between one patch per thread and all later patches, so that each pair is tested once."""
    a = offset + wp.tid()
    own = patches[a]
    for b in range(a + 1, patches.shape[0]):
        if _alike(samples, own, patches[b], rule):
            edge[a, b] = wp.uint8(1)
            edge[b, a] = wp.uint8(1)


@wp.kernel(enable_backward=False)
def _join(
    # in:
    samples: wp.array1d[int],
    patches: wp.array1d[Patch],
    rule: Rule,
    nodes: wp.array1d[int],
    offset: int,
    heads: wp.array1d[int],
    # out:
    joined: wp.array1d[int],
):
    i = offset + wp.tid()
    own = patches[nodes[i]]
    best = int(heads.shape[0])
    for k in range(heads.shape[0]):
        if _alike(samples, patches[heads[k]], own, rule):
            best = k
            break
    joined[i] = best


def rule(threshold: float, colour_threshold: float, device) -> Rule:
    """Makes the `Rule` on a device. Patches are alike if Dist is less than `threshold`, lambda (eq. 4), and their
    dominant colours are at most `colour_threshold`, lambda_h, apart (section 3.2.1). The two are taken as decimal
    fractions: 0.1 is exactly 1/10."""
    total = Fraction(str(threshold)) * 765  # three channels of 255 levels
    out = Rule()
    out.colour = math.floor((Fraction(str(colour_threshold)) * BINS) ** 2)
    out.level = math.ceil(total)
    same = [math.ceil(total * samples_of(size)) for size in SIZES]
    mixed = [math.ceil(total * samples_of(size) * (size - 1)) for size in SIZES]
    out.same = wp.array(same, dtype=int, device=device)
    out.mixed = wp.array(mixed, dtype=int, device=device)
    return out


def find_edges(samples, patches, rule: Rule, begin: int, end: int, edge) -> None:
    """Finds the edges between the patches `begin` to `end` - 1 and all later ones. For an edge between a and b it
    writes 1 to `edge`, uint8 [M, M], at (a, b) and at (b, a); all of `edge` must be 0 before."""
    inputs = [samples, patches, rule, begin]
    wp.launch(_edges, end - begin, inputs=inputs, outputs=[edge], device=edge.device)


def join(samples, patches, rule: Rule, nodes, begin: int, end: int, heads, joined) -> None:
    """Finds for each of the patches `nodes[begin:end]` the first of H representatives `heads`, int [H], that it is
    like, and writes its index in `heads` to `joined`, int [N], or H if there is none."""
    inputs = [samples, patches, rule, nodes, begin, heads]
    wp.launch(_join, end - begin, inputs=inputs, outputs=[joined], device=joined.device)
