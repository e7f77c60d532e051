"""Optical depths towards lights at the nodes of a lattice, which all pixels share.

For a light at infinity the lattice has lines that run towards the light. The optical depth between two neighbouring
nodes of a line is marched once; sums along the line from both of its ends are the depths to the light and to the
opposite light. This takes as many samples as there are nodes, where a march from each node would take a line of
samples per node. A lattice has one pair of opposite lights along its first axis, or two pairs along its first and
second axes. The lattice of a point light follows the grid's axes, and each node marches to the light separately, since
no two of its rays are parallel.

Units and sampling are those of `march`.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    OPTIONS,
    Medium,
    Solid,
    between_nodes,
    box_of,
    clip,
    for_smoke,
    sample,
    store_node,
    way_to_solid,
)
from wlm_kernels.smoke.settings import March

MOST_NODES = 2**28
"""Largest number of nodes: the lattice of a long thin box seen along a diagonal has far more nodes than the box has
voxels."""

_MOST_MARCHING = 2**24  # largest number of nodes of a point light, each of which marches separately
_AT_ONCE = wp.constant(8)  # nodes of a line that a thread sums at a time
_PARTS = 4  # parts of a line, which as many threads sum
_LEAST_SPACING = 0.25  # voxels between nodes
_DEEPEST = wp.constant(60000.0)  # largest optical depth between nodes, within the range of half floats
_NEVER = wp.constant(1.0e30)
_DARK = wp.constant(6.0)  # optical depth of an obstacle: a larger one would widen shadows between nodes
_ROUNDING = 1e-6  # relative excess of a part over the step that is tolerated, so that rounding adds no part

_Several = wp.types.vector(length=int(_AT_ONCE), dtype=float)


@wp.struct
class Lattice:
    """A lattice of points, in voxels: node (0, 0, 0) is at `origin` plus `low`, and neighbouring nodes are `gap` apart;
    `low` and `gap` are measured along the rows of `axes`.

    The lattice of a point light has `point` = 1, the light's position `place`, and the `radius` within which its
    irradiance is constant.
    """

    axes: wp.mat33
    origin: wp.vec3
    low: wp.vec3
    gap: wp.vec3
    place: wp.vec3
    point: int
    radius: float


@wp.func
def axis(lattice: Lattice, n: int) -> wp.vec3:
    return wp.vec3(lattice.axes[n, 0], lattice.axes[n, 1], lattice.axes[n, 2])


@wp.func
def depths_at(nodes: wp.array3d[wp.vec2], lattice: Lattice, p: wp.vec3) -> wp.vec2:
    """Interpolates optical depths to the light and to the opposite light trilinearly between nodes."""
    inverse = wp.vec3(1.0 / lattice.gap[0], 1.0 / lattice.gap[1], 1.0 / lattice.gap[2])
    return between_nodes(nodes, wp.cw_mul(lattice.axes * (p - lattice.origin) - lattice.low, inverse))


@wp.func
def _node(lattice: Lattice, i: int, j: int, k: int) -> wp.vec3:
    at = lattice.low + wp.cw_mul(wp.vec3(float(i), float(j), float(k)), lattice.gap)
    return lattice.origin + wp.transpose(lattice.axes) * at


@wp.func
def _lit_way(solid: Solid, end: wp.vec4i, lattice: Lattice, toward: wp.vec3) -> float:
    """Computes how far from the end of a line its nodes are lit by a light beyond the end; negative: nowhere."""
    p = _node(lattice, end[1], end[2], end[3])
    if way_to_solid(solid, p, toward) < _NEVER:
        return -1.0
    # A gap more, since light is interpolated between nodes: else the lit side of an obstacle would be dark.
    return way_to_solid(solid, p, -toward) + wp.length(wp.cw_mul(lattice.axes * toward, lattice.gap))


@wp.func
def _on_line(pair: int, line: int, n: int, k: int) -> wp.vec4i:
    """Returns the indices of the n-th node of a line along the first axis (pair 0) or along the second one."""
    return wp.vec4i(pair, wp.where(pair == 0, n, line), wp.where(pair == 0, line, n), k)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, value, lane);
#else
    return value;
#endif
""")
def _of_lane(value: wp.float64, lane: int) -> wp.float64: ...


@wp.func_native("return (float)gaps.data[n];")
def _gap(gaps: wp.array4d[wp.float16], n: int) -> float: ...


@wp.func
def _gaps(gaps: wp.array4d[wp.float16], start: int, step: int, n: int, end: int) -> _Several:
    """Returns several gaps of a line from its n-th on, 0 from `end` on."""
    several = _Several()
    for m in range(_AT_ONCE):
        # The load has no branch, so that all loads are issued at once.
        gap = _gap(gaps, start + step * wp.max(wp.min(n + m, end - 1), 0))
        several[m] = wp.where(n + m < end, gap, 0.0)
    return several


# With obstacles in the way the kernel has far more registers.
@functools.cache
def _add_up(with_solid: bool, parts: int) -> wp.Kernel:
    beside = 32 // parts if parts > 1 else 1

    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        gaps: wp.array4d[wp.float16],
        lattice: Lattice,
        solid: Solid,
        # out:
        nodes: wp.array4d[wp.vec2],
    ):
        """Sums optical depths from each node of a line to both of its ends; the light is beyond the last node. A warp
        has all parts of some lines that are beside each other, and a thread one part."""
        pair, line, group, lane = wp.tid()
        last = wp.where(pair == 0, nodes.shape[1], nodes.shape[2]) - 1
        if line >= wp.where(pair == 0, nodes.shape[2], nodes.shape[1]):
            return
        part = lane // wp.static(beside)
        first = lane % wp.static(beside)
        k = wp.min(group * wp.static(beside) + first, nodes.shape[3] - 1)
        # Nodes farther from the last node, and from the first one, are in the shadow of obstacles.
        lit = float(_NEVER)
        opposite = float(_NEVER)
        if wp.static(with_solid):
            if part == 0:
                gap = wp.where(pair == 0, lattice.gap[0], lattice.gap[1])
                lit = _lit_way(solid, _on_line(pair, line, last, k), lattice, axis(lattice, pair)) / gap
                opposite = _lit_way(solid, _on_line(pair, line, 0, k), lattice, -axis(lattice, pair)) / gap
            lit = float(_of_lane(wp.float64(lit), first))
            opposite = float(_of_lane(wp.float64(opposite), first))
        q = _on_line(pair, line, 0, k)
        start = ((pair * nodes.shape[1] + q[1]) * nodes.shape[2] + q[2]) * nodes.shape[3] + k
        step = nodes.shape[3] * wp.where(pair == 0, nodes.shape[2], 1)
        length = last // wp.static(parts) + 1
        begin = part * length
        end = wp.min(begin + length, last + 1)
        # In double precision, since the depth ahead is a difference.
        own = wp.float64(0.0)
        for n in range(begin, end, _AT_ONCE):
            several = _gaps(gaps, start, step, n, wp.min(end, last))
            for m in range(_AT_ONCE):
                own += wp.float64(several[m])
        ahead = own
        behind = wp.float64(0.0)
        for n in range(1, wp.static(parts)):
            later = _of_lane(own, (lane + n * wp.static(beside)) % 32)
            ahead += wp.where(part + n < wp.static(parts), later, wp.float64(0.0))
            behind += wp.where(part + n < wp.static(parts), wp.float64(0.0), later)
        for n in range(begin, end, _AT_ONCE):
            several = _gaps(gaps, start, step, n, wp.min(end, last))
            for m in range(_AT_ONCE):
                if n + m < end:
                    a = float(ahead) + wp.where(float(last - n - m) > lit, _DARK, 0.0)
                    b = float(behind) + wp.where(float(n + m) > opposite, _DARK, 0.0)
                    store_node(nodes, start + step * (n + m), wp.vec2(a, b))
                    ahead -= wp.float64(several[m])
                    behind += wp.float64(several[m])

    return kernel


@for_smoke
def _measure(smoke_type: Any, pairs: int) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        lattice: Lattice,
        parts: wp.vec2i,
        # out:
        gaps: wp.array4d[wp.float16],
    ):
        """Computes the optical depth from a node to the next node along the axis of each pair of opposite lights."""
        i, j, k = wp.tid()
        begin = _node(lattice, i, j, k)
        size = box_of(smoke)
        for pair in range(wp.static(pairs)):
            tau = float(0.0)
            if wp.where(pair == 0, i, j) < wp.where(pair == 0, gaps.shape[1], gaps.shape[2]) - 1:
                along = axis(lattice, pair)
                d = lattice.gap[pair] / float(parts[pair])
                for n in range(parts[pair]):
                    p = begin + (float(n) + 0.5) * d * along
                    # Nodes of a rotated lattice may lie far outside the grid.
                    low = wp.min(p) >= -0.5
                    if low and p[0] <= size[0] + 0.5 and p[1] <= size[1] + 0.5 and p[2] <= size[2] + 0.5:
                        tau += d * sample(smoke, p)
            gaps[pair, i, j, k] = wp.float16(wp.min(smoke.extinction * tau, _DEEPEST))

    return kernel


@for_smoke
def _reach(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        lattice: Lattice,
        step: float,
        # out:
        nodes: wp.array3d[wp.vec2],
    ):
        i, j, k = wp.tid()
        p = _node(lattice, i, j, k)
        away = wp.length(lattice.place - p)
        toward = wp.normalize(lattice.place - p)
        span = clip(box_of(smoke), p, toward)
        first = wp.max(span[0], 0.0)
        last = wp.min(span[1], away)
        tau = float(0.0)
        if last > first:
            count = int(wp.ceil((last - first) / step))
            d = (last - first) / float(count)
            for n in range(count):
                tau += d * sample(smoke, p + (first + (float(n) + 0.5) * d) * toward)
        tau = smoke.extinction * tau
        if smoke.solid.mesh != wp.uint64(0):
            # As far from the lit side of an obstacle as a gap, light still falls: see `_lit_way`.
            skipped = wp.max(lattice.gap)
            if skipped + way_to_solid(smoke.solid, p + skipped * toward, toward) < away:
                tau += _DARK
        nodes[i, j, k] = wp.vec2(tau, 0.0)

    return kernel


def parts_of(length: float, step: float) -> int:
    """Returns the smallest number of equal parts of a length that are no longer than `step`; at least 1."""
    return max(math.ceil(length / step - _ROUNDING), 1)


def make_lattice(
    shape: Sequence[int],
    axes: Sequence[Sequence[float]],
    spacing: float,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    most: int = MOST_NODES,
) -> tuple[Lattice, tuple[int, ...]]:
    """Makes a lattice over the grid's box and half a voxel around it, along three orthogonal axes of length 1.

    `spacing` is the largest distance between nodes in voxels; at least a quarter of a voxel is used, and more for more
    than `most` cells. `origin` is that of the lattice's coordinates, in voxels. Returns the lattice, and the number of
    nodes along each axis.
    """
    extents = [sum((n + 1) * abs(a) for n, a in zip(shape, row, strict=True)) for row in axes]
    spacing = max(spacing, _LEAST_SPACING)
    while math.prod(gaps := [parts_of(extent, spacing) for extent in extents]) > most:
        spacing *= 1.1
    lattice = Lattice()
    lattice.axes = wp.mat33(*(value for row in axes for value in row))
    lattice.origin = wp.vec3(*origin)
    lows = (
        sum(min(-0.5 * a, (n + 0.5) * a) - o * a for n, o, a in zip(shape, origin, row, strict=True)) for row in axes
    )
    lattice.low = wp.vec3(*lows)
    lattice.gap = wp.vec3(*(extent / n for extent, n in zip(extents, gaps, strict=True)))
    return lattice, tuple(n + 1 for n in gaps)


def add_up(medium: Medium, lattice: Lattice, counts: Sequence[int], pairs: int, step: float) -> wp.array:
    """Computes the optical depths from the nodes of a lattice of `make_lattice` to one or two `pairs` of opposite
    lights at infinity: at both ends of the lattice's first axis, and of its second.

    `step` is the longest step between two nodes, in voxels. Returns vec2 [pairs, X, Y, Z] for each node: depths
    to the light at the axis's end and to the light at its start.
    """
    parts = wp.vec2i(*(parts_of(lattice.gap[n], step) for n in range(2)))
    gaps, nodes = (medium.buffer((pairs, *counts), dtype) for dtype in (wp.float16, wp.vec2))
    _measure(medium, tuple(counts), [lattice, parts], [gaps], pairs)
    lines = max(counts[:2]) if pairs == 2 else counts[1]
    # A GPU needs more threads than there are lines.
    parts, lanes = (_PARTS, 32) if medium.device.is_cuda else (1, 1)
    inputs, size = [gaps, lattice, medium.solid or Solid()], (pairs, lines, -(-counts[2] * parts // lanes), lanes)
    wp.launch(_add_up(medium.solid is not None, parts), size, inputs, [nodes], device=medium.device)
    return nodes


def reach(medium: Medium, place: Sequence[float], radius: float | None, march: March) -> tuple[Lattice, wp.array]:
    """Computes optical depths from the smoke to a light at `place`: the direction to a light at infinity, of length 1,
    or the position of a point light in voxels with a radius in voxels, within which its irradiance is constant.

    Of `march` only the spacing is used, or the step; the lattice of a point light has at most 2^24 nodes. Returns a
    lattice, and vec2 [X, Y, Z] at its nodes: depths to the light and to the opposite light, for a point light 0.
    """
    spacing, shape = march.spacing or march.step, medium.shape
    if radius is None:
        lattice, counts = make_lattice(shape, _axes(place), spacing)
        return lattice, add_up(medium, lattice, counts, 1, spacing).reshape(counts)
    lattice, counts = make_lattice(shape, ((1, 0, 0), (0, 1, 0), (0, 0, 1)), spacing, most=_MOST_MARCHING)
    lattice.place, lattice.point, lattice.radius = wp.vec3(*place), 1, float(radius)
    nodes = medium.buffer(counts, wp.vec2)
    _reach(medium, counts, [lattice, spacing], [nodes])
    return lattice, nodes


def _axes(toward: Sequence[float]) -> list[tuple[float, float, float]]:
    """Returns the direction to a light, and two directions orthogonal to it (Duff et al. 2017)."""
    x, y, z = toward
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return [(x, y, z), (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)]
