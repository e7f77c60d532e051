"""Groups of triangles whose lighting is alike (lightmap-uv-clustering-cascade, sections 3.1 and 3.2).

The lightmap is sampled at a grid of points over each triangle, its patch (`wlm_kernels.atlas.patches`). Patches are the
nodes of a graph. An edge joins two patches if their distance Dist (eq. 2) is below lambda in one of the six orders of
the vertices. The node with most edges (on a tie the one with the lowest number) and its neighbours form a group, which
this node represents. The group is removed and the edges of the remaining nodes are counted anew, until none is left
(eq. 6).

The cost of this is quadratic. With more than `SAMPLE` triangles, groups are formed among a random sample of `SAMPLE`
triangles. Every other triangle joins the first representative within distance lambda of it, and triangles that joined
none are sampled again. Each triangle is still within lambda of its representative, and no two representatives are. Only
edges within a sample are stored, so that memory grows linearly with the triangles and the texels that they cover.

The following points are not specified by the paper or differ from it:

- A patch has 2 ** k + 1 samples along a side, the smallest such number not below R_s (eq. 1), and at most `patch_size`.
- R_s uses lengths in texels, which is also right where the lightmap isn't square.
- A triangle is excluded if it contains the centre of a texel above `max_radiance` in any channel, or if its patch reads
  one.
- Colours, lambda and lambda_h are fractions of `max_radiance`: a dark lightmap needs a lower `max_radiance`. Negative
  radiance counts as 0.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.system import Meter, OnProgress
from wlm_kernels.atlas import patch_graph as graphs
from wlm_kernels.atlas import patches as kernels
from wlm_kernels.atlas.patches import SIZES

SAMPLE = 8192
"""Triangles among which groups are formed at once."""

_PAIRS_AT_ONCE = 1 << 24  # pairs between two progress reports


@dataclass(frozen=True, eq=False)
class Clusters:
    """Groups of F triangles.

    Attributes:
        group: int32 [F], number of each triangle's group. Groups of several triangles come first, in the order in which
            they were formed, then groups of one triangle.
        representative: int32 [G], for each of G groups the triangle that represents it.
        order: int8 [F]: vertex k of the triangle goes to vertex p[k] of its representative, p = `ORDERS[order]` of
            `wlm_kernels.atlas.patches`. If several orders are equally good, it is the first one; 0 for representatives.
        distance: float64 [F], distance Dist (eq. 2) of the patch to its representative's in this order, below lambda.
        excluded: bool [F], true for triangles that are too bright or not active: each is a group of its own.
    """

    group: np.ndarray
    representative: np.ndarray
    order: np.ndarray
    distance: np.ndarray
    excluded: np.ndarray


def cluster(
    uv: np.ndarray,
    triangle: np.ndarray,
    lightmap: np.ndarray,
    *,
    threshold: float = 0.03,
    colour_threshold: float = 0.09,
    max_radiance: float = 2.0,
    active: np.ndarray | None = None,
    patch_size: int | None = None,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> Clusters:
    """Groups triangles over which the lightmap looks alike, so that one of them can stand for its whole group; the
    result is the same on all devices.

    Args:
        uv: [V, 2], lightmap UVs of the vertices, finite; v = 0 is the top of row 0. Beyond [0, 1], border texels are
            read.
        triangle, active: int [F, 3], vertex numbers; bool [F], which triangles take part, None for all.
        lightmap: [H, W, 3], linear RGB, finite.
        threshold, colour_threshold: lambda of eq. 4 and lambda_h of section 3.2.1, fractions of `max_radiance`.
        max_radiance: Above 0. A triangle with a brighter texel shares texels with no other (section 4.1.1). It stands
            for the paper's 8-bit colour 255.
        patch_size: Largest number of samples along a side of a patch, one of `wlm_kernels.atlas.patches.SIZES`; None:
            4097, the largest of these.
        progress: Called with the triangles done in the stages "compare patches" and "cluster", in turn.

    Raises:
        WlmError: All patches have 2^31 samples or more.
    """
    count = len(triangle)
    excluded = np.zeros(count, bool) if active is None else ~active
    corner = _corners(uv, triangle, lightmap.shape)
    level = _levels(corner, patch_size or SIZES[-1])
    total = int(kernels.samples_of(np.array(SIZES, np.int64))[level].sum())
    if total >= 2**31:
        raise WlmError(f"patch_size: expected fewer than 2^31 samples in all patches, found {total:,}: use 129 or less")
    samples, patches, bright = kernels.sample(_texels(lightmap, max_radiance), corner, level, device)
    kernels.dominant(samples, patches)
    excluded |= bright.numpy() != 0

    included = np.flatnonzero(~excluded)
    nodes = wp.array(patches.numpy()[included], dtype=kernels.Patch, device=device)
    levels = int(level.max(initial=0)) + 1
    bounds = graphs.bounds(samples, nodes, levels)
    graph, order = graphs.graph(samples, nodes, bounds, levels, graphs.rule(threshold, colour_threshold, device))
    number = included[order]  # the triangle of each node
    groups = _groups(graph, number, progress)
    head = np.arange(count, dtype=np.int32)  # the representative of each triangle
    heads = [number[node] for node, _ in groups]
    for node, members in groups:
        head[number[members]] = number[node]
    single = head == np.arange(count)
    single[heads] = False
    representative = np.concatenate([np.array(heads, np.int64), np.flatnonzero(single)]).astype(np.int32)
    group = np.empty(count, np.int32)
    group[representative] = np.arange(len(representative), dtype=np.int32)

    pairs = [wp.array(values, dtype=int, device=device) for values in (np.arange(count, dtype=np.int32), head)]
    order, distance = kernels.compare(samples, patches, *pairs)
    return Clusters(group[head], representative, order, distance, excluded)


def _texels(lightmap: np.ndarray, max_radiance: float) -> np.ndarray:
    """Converts light to 16 bits per channel, `max_radiance` to 65,535; a fourth channel is 1 where a texel is
    brighter."""
    texels = np.empty((*lightmap.shape[:2], 4), np.uint16)
    fraction = lightmap.astype(np.float64) / max_radiance
    texels[..., :3] = np.rint(np.clip(fraction, 0.0, 1.0) * 65535.0)
    texels[..., 3] = (lightmap > max_radiance).any(-1)
    return texels


def _corners(uv: np.ndarray, triangle: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the corners of F triangles, int64 [F, 3, 2], in 1/65536 of a texel from the first texel's centre."""
    place = (uv * [shape[1], shape[0]] - 0.5) * 65536.0
    return np.rint(place).astype(np.int64)[triangle.astype(np.int64)]


def _levels(corner: np.ndarray, patch_size: int) -> np.ndarray:
    """Returns for each triangle the index in `SIZES` of its patch's size, int32 [F]: the smallest not below its longest
    edge in texels (eq. 1), at most `patch_size`."""
    edge = (corner - np.roll(corner, 1, 1)) / 65536.0
    longest = np.hypot(edge[..., 0], edge[..., 1]).max(1, initial=0.0)
    return np.searchsorted(SIZES, np.minimum(np.ceil(longest), patch_size)).astype(np.int32)


def _groups(graph: graphs.Graph, number: np.ndarray, progress: OnProgress | None) -> list[tuple[int, np.ndarray]]:
    """Forms groups of alike triangles; returns the node of the representative and all members of each group of several.
    The node with the most edges becomes representative; of equals, that with the least `number`, int [M]."""
    count = len(number)
    left = np.arange(count)
    drawn = np.random.default_rng(0).permutation(count)  # the order in which nodes get into samples
    groups: list[tuple[int, np.ndarray]] = []
    comparing, clustering = Meter(progress, "compare patches", count), Meter(progress, "cluster", count)
    while True:
        sample = left if len(left) <= SAMPLE else np.sort(left[np.argsort(drawn[left])[:SAMPLE]])
        part = graph if len(sample) == count else graphs.part(graph, sample)
        edge = _edges(part, comparing, count - len(left))
        formed = [(int(sample[node]), sample[members]) for node, members in _greedy(edge, number[sample])]
        if len(sample) == len(left):
            groups += formed
            clustering.report(count)
            return groups
        # Nodes that are like no other in the sample may be like one outside it.
        alone = np.setdiff1d(sample, np.concatenate([np.empty(0, np.int64), *(members for _, members in formed)]))
        heads = np.concatenate([np.array([node for node, _ in formed], np.int64), alone])
        rest = np.setdiff1d(left, sample, assume_unique=True)
        joined = _joined(graph, rest, heads, clustering, count - len(left))
        order = np.argsort(joined, kind="stable")
        ends = np.searchsorted(joined[order], np.arange(len(heads) + 1))
        members = [members for _, members in formed] + [np.array([node]) for node in alone]
        for rank, node in enumerate(heads.tolist()):
            found = rest[order[ends[rank] : ends[rank + 1]]]
            if len(found) or rank < len(formed):
                groups.append((node, np.concatenate([members[rank], found])))
        left = rest[joined == len(heads)]


def _joined(graph: graphs.Graph, nodes: np.ndarray, heads: np.ndarray, meter: Meter, done: int) -> np.ndarray:
    """Finds for each of N triangles the index in `heads` of the first representative whose light is alike, int [N];
    `len(heads)` where none is."""
    device, by_mean = graph.nodes.samples.device, np.argsort(heads, kind="stable")

    def on_device(values: np.ndarray) -> wp.array:
        return wp.array(values.astype(np.int32), dtype=int, device=device)

    low = wp.array(graph.means[heads[by_mean]], dtype=float, device=device)
    inputs = on_device(heads[by_mean]), low, on_device(by_mean)
    each, joined = on_device(nodes), wp.empty(len(nodes), dtype=int, device=device)
    piece = max(_PAIRS_AT_ONCE // len(heads), 1)
    for begin in range(0, len(nodes), piece):
        graphs.join(graph, each, begin, min(begin + piece, len(nodes)), *inputs, joined)
        wp.synchronize_device(device)
        if meter.due(done):
            meter.report(done)
    return joined.numpy()


def _edges(graph: graphs.Graph, meter: Meter, done: int) -> np.ndarray:
    """Compares the light of all pairs of M triangles: uint8 [M, M], 1 where two are alike, which is an edge."""
    count, device = len(graph.means), graph.nodes.samples.device
    edge = wp.zeros((count, count), dtype=wp.uint8, device=device)
    piece = max(_PAIRS_AT_ONCE // max(count, 1), 1)
    for begin in range(0, count, piece):
        end = min(begin + piece, count)
        graphs.find_edges(graph, begin, end, edge)
        wp.synchronize_device(device)
        if meter.due(done + end):
            meter.report(done + end)
    return edge.numpy()


def _greedy(edge: np.ndarray, number: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yields the representative (the triangle with most edges) and the sorted members of each group of several."""
    degree = edge.sum(1, dtype=np.int64)
    remains = np.ones(len(number), bool)
    # Among equals the lowest number comes first.
    order = np.argsort(number, kind="stable")
    while len(order) and degree[node := order[degree[order].argmax()]] > 0:
        members = np.flatnonzero(remains & (edge[node] != 0))
        members = np.sort(np.append(members, node))
        yield int(node), members
        remains[members] = False
        degree -= edge[members].sum(0, dtype=np.int64)
        degree[members] = 0
