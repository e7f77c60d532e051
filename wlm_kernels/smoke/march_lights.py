"""Single scattering under lights from any direction and of points, with the ways to each light shared between pixels.

The optical depths to a light lie on a lattice of nodes. A light infinitely far off has one whose lines run towards it,
turned as its rays are: the gap between two neighbours of a line is marched once, and sums along the lines from either
end give depths to the light and to the opposite one. That takes as many samples as there are nodes, as for a pair of
axes in `march_coarse`, whose lights are six such. A point light has a lattice along the grid's axes, and each node
marches to it by itself, since no two of its rays are parallel.

A camera's ray, orthographic or in perspective, then finds its samples' places in the lattice and interpolates depths.
Units and sampling are those of `march`.
Read first: `lit` of `tests/reference/marching.py`, one such light with nothing shared.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    MarchParameters,
    Medium,
    View,
    absorbed,
    clip,
    density_at,
    marched_ray,
    parameters,
    phase,
    size_of,
)
from wlm_kernels.smoke.march_coarse import AT_ONCE, MOST_NODES, Several, by_bricks, gaps_along, noise, parts_of
from wlm_kernels.smoke.settings import March

_OPTIONS = {"enable_backward": False}

PLANES = ("transparency", "emission", "depth")
"""Planes of `seen`."""

_MOST_MARCHING = 2**24  # of a point light, each of which marches by itself


@wp.struct
class Lattice:
    """Where nodes are: `low` and on along the rows of `axes`, `gap` apart, in voxels. A point light has its place."""

    axes: wp.mat33
    low: wp.vec3
    gap: wp.vec3
    place: wp.vec3
    point: int
    radius: float


@wp.func
def _look(density: wp.array3d[Any], bricks: wp.array3d[wp.uint8], p: wp.vec3) -> float:
    """`by_bricks`, and 0 far outside the grid."""
    for axis in range(3):
        if p[axis] < -0.5 or p[axis] > float(density.shape[axis]) + 0.5:
            return 0.0
    return by_bricks(density, bricks, p)


@wp.func
def _node(lattice: Lattice, i: int, j: int, k: int) -> wp.vec3:
    at = lattice.low + wp.cw_mul(wp.vec3(float(i), float(j), float(k)), lattice.gap)
    return wp.transpose(lattice.axes) * at


@wp.func
def depths_at(nodes: wp.array3d[wp.vec2], lattice: Lattice, p: wp.vec3) -> wp.vec2:
    """Optical depths to the light and to the opposite one, trilinear between nodes."""
    inverse = wp.vec3(1.0 / lattice.gap[0], 1.0 / lattice.gap[1], 1.0 / lattice.gap[2])
    q = wp.cw_mul(lattice.axes * p - lattice.low, inverse)
    i = wp.clamp(int(q[0]), 0, nodes.shape[0] - 2)
    j = wp.clamp(int(q[1]), 0, nodes.shape[1] - 2)
    k = wp.clamp(int(q[2]), 0, nodes.shape[2] - 2)
    fx = wp.clamp(q[0] - float(i), 0.0, 1.0)
    fy = wp.clamp(q[1] - float(j), 0.0, 1.0)
    fz = wp.clamp(q[2] - float(k), 0.0, 1.0)
    a = wp.lerp(
        wp.lerp(nodes[i, j, k], nodes[i, j, k + 1], fz), wp.lerp(nodes[i, j + 1, k], nodes[i, j + 1, k + 1], fz), fy
    )
    b = wp.lerp(
        wp.lerp(nodes[i + 1, j, k], nodes[i + 1, j, k + 1], fz),
        wp.lerp(nodes[i + 1, j + 1, k], nodes[i + 1, j + 1, k + 1], fz),
        fy,
    )
    return wp.lerp(a, b, fx)


@wp.kernel(module="unique", module_options=_OPTIONS)
def _add_up(
    # in:
    gaps: wp.array3d[float],
    # out:
    nodes: wp.array3d[wp.vec2],
):
    """Depths from each node to either end of its line, which runs along the first axis; the light is at its end."""
    j, k = wp.tid()
    last = nodes.shape[0] - 1
    ahead = float(0.0)
    behind = float(0.0)
    nodes[last, j, k][0] = 0.0
    nodes[0, j, k][1] = 0.0
    # Some at a time: the loads of one wait for the stores of those before, and not for each other.
    for first in range(0, last, AT_ONCE):
        forth = Several()
        back = Several()
        for m in range(AT_ONCE):
            n = wp.min(first + m, last - 1)
            forth[m] = gaps[n, j, k]
            back[m] = gaps[last - 1 - n, j, k]
        for m in range(AT_ONCE):
            n = first + m
            if n < last:
                behind += forth[m]
                ahead += back[m]
                nodes[n + 1, j, k][1] = behind
                nodes[last - 1 - n, j, k][0] = ahead


@dataclass(frozen=True)
class _Kernels:
    """Of one type of density."""

    measure: wp.Kernel
    reach: wp.Kernel
    gather: wp.Kernel
    seen: wp.Kernel


@functools.cache
def light_kernels(dtype: Any) -> _Kernels:
    """Builds (once) the kernels for densities of a type, `wp.float32` or `wp.float16`."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def measure(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        lattice: Lattice,
        parts: int,
        # out:
        gaps: wp.array3d[float],
    ):
        """Optical depth of the gap from a node to the next one of its line."""
        i, j, k = wp.tid()
        tau = float(0.0)
        if i < gaps.shape[0] - 1:
            p = _node(lattice, i, j, k)
            along = wp.vec3(lattice.axes[0, 0], lattice.axes[0, 1], lattice.axes[0, 2])
            d = lattice.gap[0] / float(parts)
            for n in range(parts):
                tau += d * _look(density, bricks, p + (float(n) + 0.5) * d * along)
        gaps[i, j, k] = extinction * tau

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def reach(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        lattice: Lattice,
        step: float,
        # out:
        nodes: wp.array3d[wp.vec2],
    ):
        """Optical depth from a node to a point light."""
        i, j, k = wp.tid()
        p = _node(lattice, i, j, k)
        way = lattice.place - p
        away = wp.length(way)
        way = wp.normalize(way)
        span = clip(size_of(density), p, way)
        first = wp.max(span[0], 0.0)
        last = wp.min(span[1], away)
        tau = float(0.0)
        if last > first:
            count = int(wp.ceil((last - first) / step))
            d = (last - first) / float(count)
            for n in range(count):
                tau += d * _look(density, bricks, p + (first + (float(n) + 0.5) * d) * way)
        nodes[i, j, k] = wp.vec2(extinction * tau, 0.0)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def gather(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        nodes: wp.array3d[wp.vec2],
        extinction: float,
        view: View,
        lattice: Lattice,
        march: MarchParameters,
        shadow: float,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = marched_ray(view, row, column, size_of(density), march.step)
        light = wp.vec2()
        tau = float(0.0)
        if r.count > 0:
            offset = 0.5 + march.jitter * (noise(row, column, march.seed) - 0.5)
            along = wp.vec3(lattice.axes[0, 0], lattice.axes[0, 1], lattice.axes[0, 2])
            cosine = wp.dot(along, r.direction)
            forth = phase(march.g, cosine)
            back = phase(march.g, -cosine)
            for n in range(r.count):
                p = r.origin + (r.first + (float(n) + offset) * r.length) * r.direction
                x = extinction * _look(density, bricks, p) * r.length
                if x > 0.0:
                    depths = shadow * depths_at(nodes, lattice, p)
                    share = wp.exp(-tau) * absorbed(x)
                    if lattice.point == 0:
                        light += share * wp.vec2(forth * wp.exp(-depths[0]), back * wp.exp(-depths[1]))
                    else:
                        way = lattice.place - p
                        # Closer than half a step the sample would stand for far more light than its step has.
                        away = wp.max(wp.length(way), wp.max(lattice.radius, 0.5 * r.length))
                        share = share * phase(march.g, wp.dot(wp.normalize(way), r.direction))
                        light += wp.vec2(share * wp.exp(-depths[0]) / (away * away), 0.0)
                    tau += x
                    if wp.exp(-tau) < march.cutoff:
                        break
        out[0, row, column] = light[0]
        if lattice.point == 0:
            out[1, row, column] = light[1]

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def seen(
        # in:
        density: wp.array3d[dtype],
        temperature: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        emission: float,
        view: View,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = marched_ray(view, row, column, size_of(density), march.step)
        tau = float(0.0)
        glow = float(0.0)
        depth = float(0.0)
        if r.count > 0:
            offset = 0.5 + march.jitter * (noise(row, column, march.seed) - 0.5)
            for n in range(r.count):
                s = r.first + (float(n) + offset) * r.length
                p = r.origin + s * r.direction
                sigma = extinction * _look(density, bricks, p)
                x = sigma * r.length
                if emission > 0.0:
                    # The mean transparency along the step: fire without smoke shines too.
                    share = wp.where(x > 1.0e-6, absorbed(x) / wp.max(x, 1.0e-6), 1.0)
                    glow += wp.exp(-tau) * share * emission * r.length * density_at(temperature, p)
                if depth == 0.0 and sigma > march.threshold:
                    depth = (s + view.moved) * view.voxel
                tau += x
                if wp.exp(-tau) < march.cutoff:
                    break
        out[0, row, column] = wp.exp(-tau)
        out[1, row, column] = glow
        out[2, row, column] = depth

    return _Kernels(measure, reach, gather, seen)


def _axes(toward: Sequence[float]) -> list[tuple[float, float, float]]:
    """A light's direction, and two across it."""
    x, y, z = toward
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return [(x, y, z), (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)]


def _lattice(shape: Sequence[int], place: Sequence[float], radius: float | None, spacing: float) -> tuple[Lattice, Any]:
    """A lattice over the grid's box, half a voxel beyond it on all sides, and its nodes."""
    axes = _axes(place) if radius is None else [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    low = [sum(min(-0.5 * a, (n + 0.5) * a) for n, a in zip(shape, axis, strict=True)) for axis in axes]
    extents = [sum((n + 1) * abs(a) for n, a in zip(shape, axis, strict=True)) for axis in axes]
    gaps = gaps_along(extents, spacing, MOST_NODES if radius is None else _MOST_MARCHING)
    lattice = Lattice()
    lattice.axes = wp.mat33(*(value for axis in axes for value in axis))
    lattice.low = wp.vec3(*low)
    lattice.gap = wp.vec3(*(extent / n for extent, n in zip(extents, gaps, strict=True)))
    lattice.place, lattice.point, lattice.radius = wp.vec3(*place), int(radius is not None), float(radius or 0.0)
    return lattice, tuple(n + 1 for n in gaps)


def reach(
    medium: Medium, place: Sequence[float], radius: float | None, march: March, *, bricks: wp.array
) -> tuple[Lattice, wp.array]:
    """Optical depths from places in the smoke to a light.

    Args:
        medium: The smoke.
        place: The direction to a light infinitely far off, of length 1, or the position of a point light, in voxels.
        radius: Of a point light, in voxels: at smaller distances its irradiance is as at this one. None: infinitely
            far off.
        march: As for `march_coarse`; nodes of a point light are 2^24 at most.
        bricks: Of `occupied`.

    Returns:
        A lattice, and vec2 of its nodes: depths to the light and to the opposite one, which a point light has none of.
    """
    spacing = march.step if march.spacing is None else march.spacing
    step = spacing if march.light_step is None else march.light_step
    density, extinction = medium.density, medium.extinction
    device = density.device
    kernels = light_kernels(density.dtype)
    lattice, counts = _lattice(density.shape, place, radius, spacing)
    nodes = medium.buffer(counts, wp.vec2)
    if radius is None:
        gaps = medium.buffer(counts, float)
        parts = parts_of(lattice.gap[0], step)
        wp.launch(kernels.measure, counts, [density, bricks, extinction, lattice, parts], [gaps], device=device)
        wp.launch(_add_up, counts[1:], [gaps], [nodes], device=device)
    else:
        wp.launch(kernels.reach, counts, [density, bricks, extinction, lattice, step], [nodes], device=device)
    return lattice, nodes


def light(
    medium: Medium,
    view: View,
    depths: tuple[Lattice, wp.array],
    march: March,
    shadow: float,
    out: wp.array,
    *,
    bricks: wp.array,
) -> None:
    """Smoke of albedo 1 under a light and under the opposite one, or under a point light.

    Args:
        medium, march, bricks: As for `reach`.
        view: The camera, [H, W] pixels.
        depths: Of `reach`.
        shadow: Extinction on the ways to the lights over that along the camera's rays; 1 is smoke as it is.
        out: float [2, H, W], written: light scattered once, of irradiance 4 pi from the place and from the opposite
            one. Of a point light [1, H, W]: its irradiance is 4 pi at a distance of one voxel.
    """
    density, (lattice, nodes) = medium.density, depths
    inputs = [density, bricks, nodes, medium.extinction, view, lattice, parameters(march), shadow]
    kernel = light_kernels(density.dtype).gather
    wp.launch(kernel, out.shape[1:], inputs=inputs, outputs=[out], device=density.device)


def seen(medium: Medium, view: View, march: March, out: wp.array, *, bricks: wp.array) -> None:
    """What a camera sees of smoke without light: `PLANES`, [3, H, W], written; arguments as for `light`."""
    density, (temperature, emission) = medium.density, medium.glow
    inputs = [density, temperature, bricks, medium.extinction, emission, view, parameters(march)]
    kernel = light_kernels(density.dtype).seen
    wp.launch(kernel, out.shape[1:], inputs=inputs, outputs=[out], device=density.device)
