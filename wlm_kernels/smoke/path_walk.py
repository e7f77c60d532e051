"""A ray's walk through bricks, each with the greatest extinction in it, and the density of a voxel drawn at a place."""

from typing import Any

import warp as wp

from wlm_kernels.smoke.march import clip
from wlm_kernels.smoke.path_ways import bits

_NEVER = wp.constant(1.0e30)
_TENTH_BIT = wp.constant(1.0 / 1024.0)


@wp.struct
class Walk:
    """A ray's walk through bricks: the one that it is in, from `t` to `border` along the ray, which ends at `end`.

    `leave` has the distances at which it leaves the brick along each axis, `across` those that it takes through one.
    """

    cell: wp.vec3i
    leave: wp.vec3
    across: wp.vec3
    t: float
    border: float
    end: float
    most: float


@wp.func
def _border(cell: int, count: int, edge: float, p: float, d: float) -> float:
    """Distance at which a ray leaves a brick along one axis; the outermost bricks have no outer border."""
    if d > 1.0e-9 and cell < count - 1:
        return (float(cell + 1) * edge - p) / d
    if d < -1.0e-9 and cell > 0:
        return (float(cell) * edge - p) / d
    return _NEVER


@wp.func
def enter(bounds: wp.array3d[float], edge: float, size: wp.vec3, p: wp.vec3, d: wp.vec3, limit: float) -> Walk:
    """The brick in which a ray begins; none where it misses the smoke, or up to its limit."""
    w = Walk()
    span = clip(size, p, d)
    w.t = wp.max(span[0], 0.0)
    w.end = wp.min(span[1], limit)
    for axis in range(3):
        at = int(wp.floor((p[axis] + w.t * d[axis]) / edge))
        w.cell[axis] = wp.clamp(at, 0, bounds.shape[axis] - 1)
        w.leave[axis] = _border(w.cell[axis], bounds.shape[axis], edge, p[axis], d[axis])
        w.across[axis] = edge / wp.max(wp.abs(d[axis]), 1.0e-9)
    w.border = wp.min(wp.min(w.leave[0], wp.min(w.leave[1], w.leave[2])), w.end)
    w.most = bounds[w.cell[0], w.cell[1], w.cell[2]]
    return w


@wp.func
def _further(cell: int, count: int, leave: float, across: float) -> float:
    """Distance at which a ray leaves the brick that it has come to along an axis."""
    return wp.where(cell > 0 and cell < count - 1, leave + across, _NEVER)


@wp.func
def onward(w: Walk, bounds: wp.array3d[float], d: wp.vec3) -> Walk:
    """The walk in the next brick, or at its end."""
    w.t = w.border
    if w.t < w.end:
        if w.leave[0] <= w.leave[1] and w.leave[0] <= w.leave[2]:
            w.cell[0] += wp.where(d[0] > 0.0, 1, -1)
            w.leave[0] = _further(w.cell[0], bounds.shape[0], w.leave[0], w.across[0])
        elif w.leave[1] <= w.leave[2]:
            w.cell[1] += wp.where(d[1] > 0.0, 1, -1)
            w.leave[1] = _further(w.cell[1], bounds.shape[1], w.leave[1], w.across[1])
        else:
            w.cell[2] += wp.where(d[2] > 0.0, 1, -1)
            w.leave[2] = _further(w.cell[2], bounds.shape[2], w.leave[2], w.across[2])
        w.border = wp.min(wp.min(w.leave[0], wp.min(w.leave[1], w.leave[2])), w.end)
        w.most = bounds[w.cell[0], w.cell[1], w.cell[2]]
    return w


@wp.func
def drawn(density: wp.array3d[Any], p: wp.vec3, random: wp.uint64) -> float:
    """The density of one of the voxels around a place, whose mean is that of `density_at`."""
    x = bits(random)
    i = int(wp.floor(p[0] + (float(x & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    j = int(wp.floor(p[1] + (float((x >> wp.uint32(10)) & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    k = int(wp.floor(p[2] + (float((x >> wp.uint32(20)) & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    if i < 0 or j < 0 or k < 0 or i >= density.shape[0] or j >= density.shape[1] or k >= density.shape[2]:
        return 0.0
    return float(density[i, j, k])
