"""Six-way lightmaps by a march in large steps, with the optical depths to the lights shared between pixels.

An orthographic camera's lights follow its axes. The optical depths to the lights from the sides therefore lie on a
lattice of nodes along these axes, over the smoke's box as the camera sees it: the gap between each two neighbours is
marched once, and sums along the lattice's lines give a node's depths to the right and left, top and bottom. That takes
as many samples as there are nodes, where a march from each node would take a line of them. A ray runs along the
lattice's third axis, keeps its place in the other two, and interpolates depths between the nodes.

The other two lights need no march. The light from the front comes along the ray and goes back along it, which leaves
exp(-2 tau) of it: (1 - T^2) / 2 in all, where T is the ray's transparency. The light from the back passes all of the
ray's smoke wherever it is scattered: -T ln T. Both are exact, whatever the steps; only T has the error of its step.

Samples of neighbouring pixels are shifted by interleaved gradient noise (Jimenez 2014), whose sum over a few pixels
varies less than that of random numbers: a filter over the image, a network for one, leaves less of it.
Read first: `lit` of `tests/reference/marching.py`, one such light with nothing shared.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    BRICK,
    MarchParameters,
    Medium,
    View,
    absorbed,
    density_at,
    marched_ray,
    occupied,
    parameters,
    phase,
    sample,
    size_of,
)
from wlm_kernels.smoke.settings import March

_OPTIONS = {"enable_backward": False}

PLANES = ("right", "left", "top", "bottom", "front", "back", "transparency", "emission", "depth")
"""Planes of the result."""

DEPTH = PLANES.index("depth")

MOST_NODES = 2**28
"""Of a lattice: a long thin box seen along a diagonal has far more than it has voxels."""

AT_ONCE = wp.constant(8)
"""Nodes of a line that a thread adds up at a time."""

Several = wp.types.vector(length=int(AT_ONCE), dtype=float)

_LEAST_SPACING = 0.25  # voxels between nodes
_PATTERNS = wp.constant(64)  # of the noise, a power of 2
_ROUNDING = 1e-6  # by which parts may be longer than asked, rather than one more


@wp.struct
class _Lattice:
    """Where nodes are: along the camera's right, up and forward, from its origin, in voxels."""

    low: wp.vec3
    gap: wp.vec3


@wp.func
def by_bricks(density: wp.array3d[Any], bricks: wp.array3d[wp.uint8], p: wp.vec3) -> float:
    """The density, by bricks where there are any: the same number."""
    if bricks.shape[0] > 0:
        return sample(density, bricks, p)
    return density_at(density, p)


@wp.func
def noise(row: int, column: int, seed: int) -> float:
    """Interleaved gradient noise, at least 0 and below 1."""
    pattern = float(seed & (_PATTERNS - 1))
    x = float(column) + 5.588238 * pattern
    y = float(row) + 5.588238 * pattern
    f = 0.06711056 * x + 0.00583715 * y
    f = 52.9829189 * (f - wp.floor(f))
    # A product that is rounded once for the floor and not for the difference may leave the range by an ulp.
    return wp.clamp(f - wp.floor(f), 0.0, 0.99999994)


@wp.func
def _in_plane(nodes: wp.array3d[wp.vec4], i: int, j: int, k: int, fx: float, fy: float) -> wp.vec4:
    """Bilinear between the nodes of plane `k`."""
    a = wp.lerp(nodes[i, j, k], nodes[i, j + 1, k], fy)
    b = wp.lerp(nodes[i + 1, j, k], nodes[i + 1, j + 1, k], fy)
    return wp.lerp(a, b, fx)


@wp.kernel(module="unique", module_options=_OPTIONS)
def _add_up(
    # in:
    gaps: wp.array3d[wp.vec2],
    across: int,
    # out:
    nodes: wp.array3d[wp.vec4],
):
    """Depths from each node to either end of its line: the first `across` lines run to the right, the others up."""
    line, k = wp.tid()
    if line < across:
        right = float(0.0)
        left = float(0.0)
        last = nodes.shape[0] - 1
        nodes[last, line, k][0] = 0.0
        nodes[0, line, k][1] = 0.0
        # From both ends at once, and several nodes at a time: loads wait for stores before them.
        for first in range(0, last, AT_ONCE):
            forth = Several()
            back = Several()
            for m in range(AT_ONCE):
                n = wp.min(first + m, last - 1)
                forth[m] = gaps[n, line, k][0]
                back[m] = gaps[last - 1 - n, line, k][0]
            for m in range(AT_ONCE):
                n = first + m
                if n < last:
                    left += forth[m]
                    right += back[m]
                    nodes[n + 1, line, k][1] = left
                    nodes[last - 1 - n, line, k][0] = right
    else:
        i = line - across
        top = float(0.0)
        bottom = float(0.0)
        last = nodes.shape[1] - 1
        nodes[i, last, k][2] = 0.0
        nodes[i, 0, k][3] = 0.0
        for first in range(0, last, AT_ONCE):
            forth = Several()
            back = Several()
            for m in range(AT_ONCE):
                n = wp.min(first + m, last - 1)
                forth[m] = gaps[i, n, k][1]
                back[m] = gaps[i, last - 1 - n, k][1]
            for m in range(AT_ONCE):
                n = first + m
                if n < last:
                    bottom += forth[m]
                    top += back[m]
                    nodes[i, n + 1, k][3] = bottom
                    nodes[i, last - 1 - n, k][2] = top


@functools.cache
def coarse_kernels(dtype: Any, hot: bool):
    """Builds (once) the kernels for densities of a type; `hot`: with a temperature of the same type."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def measure(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        view: View,
        lattice: _Lattice,
        parts: wp.vec2i,
        # out:
        gaps: wp.array3d[wp.vec2],
    ):
        """Optical depth of the gap from a node to its neighbour to the right and to that above."""
        i, j, k = wp.tid()
        p = view.origin + (lattice.low[0] + float(i) * lattice.gap[0]) * view.right
        p += (lattice.low[1] + float(j) * lattice.gap[1]) * view.up
        p += (lattice.low[2] + float(k) * lattice.gap[2]) * view.forward
        right = float(0.0)
        up = float(0.0)
        d = lattice.gap[0] / float(parts[0])
        if i < gaps.shape[0] - 1:
            for n in range(parts[0]):
                right += d * by_bricks(density, bricks, p + (float(n) + 0.5) * d * view.right)
        d = lattice.gap[1] / float(parts[1])
        if j < gaps.shape[1] - 1:
            for n in range(parts[1]):
                up += d * by_bricks(density, bricks, p + (float(n) + 0.5) * d * view.up)
        gaps[i, j, k] = extinction * wp.vec2(right, up)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def gather(
        # in:
        density: wp.array3d[dtype],
        temperature: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        nodes: wp.array3d[wp.vec4],
        extinction: float,
        emission: float,
        view: View,
        lattice: _Lattice,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = marched_ray(view, row, column, size_of(density), march.step)
        sides = wp.vec4()
        glow = float(0.0)
        through = float(0.0)
        t = float(1.0)
        depth = float(0.0)
        if r.count > 0:
            dt = r.length
            offset = 0.5 + march.jitter * (noise(row, column, march.seed) - 0.5)
            # The ray's place in the lattice, which all of its samples share.
            x = (wp.dot(r.origin - view.origin, view.right) - lattice.low[0]) / lattice.gap[0]
            y = (wp.dot(r.origin - view.origin, view.up) - lattice.low[1]) / lattice.gap[1]
            i = wp.clamp(int(x), 0, nodes.shape[0] - 2)
            j = wp.clamp(int(y), 0, nodes.shape[1] - 2)
            fx = wp.clamp(x - float(i), 0.0, 1.0)
            fy = wp.clamp(y - float(j), 0.0, 1.0)
            loaded = int(-1)  # the plane of nodes that `near` holds
            near = wp.vec4()
            far = wp.vec4()
            for n in range(r.count):
                s = r.first + (float(n) + offset) * dt
                p = r.origin + s * r.direction
                sigma = extinction * by_bricks(density, bricks, p)
                if wp.static(hot):
                    # The mean transparency along the step: fire without smoke shines too.
                    x = sigma * dt
                    share = wp.where(x > 1.0e-6, absorbed(x) / wp.max(x, 1.0e-6), 1.0)
                    glow += t * share * emission * dt * density_at(temperature, p)
                if sigma > 0.0:
                    if depth == 0.0 and sigma > march.threshold:
                        depth = (s + view.moved) * view.voxel
                    z = (s - lattice.low[2]) / lattice.gap[2]
                    k = wp.clamp(int(z), 0, nodes.shape[2] - 2)
                    if k != loaded:
                        near = _in_plane(nodes, i, j, k, fx, fy)
                        far = _in_plane(nodes, i, j, k + 1, fx, fy)
                        loaded = k
                    tau = wp.lerp(near, far, wp.clamp(z - float(k), 0.0, 1.0))
                    x = sigma * dt
                    left = wp.vec4(wp.exp(-tau[0]), wp.exp(-tau[1]), wp.exp(-tau[2]), wp.exp(-tau[3]))
                    sides += t * absorbed(x) * left
                    through += x
                    t = wp.exp(-through)
                    if t < march.cutoff:
                        break
        across = wp.dot(view.right, r.direction)
        rise = wp.dot(view.up, r.direction)
        out[0, row, column] = phase(march.g, across) * sides[0]
        out[1, row, column] = phase(march.g, -across) * sides[1]
        out[2, row, column] = phase(march.g, rise) * sides[2]
        out[3, row, column] = phase(march.g, -rise) * sides[3]
        out[4, row, column] = 0.5 * phase(march.g, -1.0) * absorbed(2.0 * through)
        out[5, row, column] = phase(march.g, 1.0) * t * through
        out[6, row, column] = t
        out[7, row, column] = glow
        out[8, row, column] = depth

    return measure, _add_up, gather


def gaps_along(extents: Sequence[float], spacing: float, most: int) -> tuple[int, ...]:
    """Gaps of a lattice along each axis, no longer than a spacing, or than makes them more than so many in all."""
    spacing = max(spacing, _LEAST_SPACING)
    while math.prod(gaps := [parts_of(extent, spacing) for extent in extents]) > most:
        spacing *= 1.1
    return tuple(gaps)


def parts_of(length: float, step: float) -> int:
    """Equal parts of a length, no longer than a step, at least one."""
    return max(math.ceil(length / step - _ROUNDING), 1)


def _lattice(shape: Sequence[int], view: View, spacing: float) -> tuple[_Lattice, tuple[int, ...]]:
    """A lattice over all that the camera sees of the smoke's box, or would in a larger image, and its nodes."""
    axes = (view.right, view.up, view.forward)
    extents = [sum((n + 1) * abs(a) for n, a in zip(shape, axis, strict=True)) for axis in axes]
    gaps = gaps_along(extents, spacing, MOST_NODES)
    lattice = _Lattice()
    lattice.low = wp.vec3(
        *(
            sum(min(-0.5 * a, (n + 0.5) * a) - o * a for n, o, a in zip(shape, view.origin, axis, strict=True))
            for axis in axes
        )
    )
    lattice.gap = wp.vec3(*(extent / n for extent, n in zip(extents, gaps, strict=True)))
    return lattice, tuple(n + 1 for n in gaps)


def coarse_six_way(medium: Medium, view: View, march: March, out: wp.array) -> None:
    """Six-way lightmaps, transparency, emission and depth by one march in large steps.

    Below a brick's edge, `march.step` makes both rays and ways to the lights look no further in bricks without smoke.
    It changes no result.

    Args:
        medium: The smoke, of albedo 1.
        view: The camera, [H, W] pixels, orthographic.
        march: Its spacing is a quarter of a voxel at least, and as much more as makes the nodes about 2^28 at most. A
            node takes 24 bytes. 64 seeds differ. What the cutoff leaves out is less than 1e-3 in every plane.
        out: float [9, H, W], written: `PLANES`, each light of irradiance 4 pi.

    Raises:
        ValueError: The camera is in perspective.
    """
    if view.perspective:
        raise ValueError("six-way lightmaps need an orthographic camera: their lights follow its axes")
    spacing = march.step if march.spacing is None else march.spacing
    light_step = spacing if march.light_step is None else march.light_step
    density, extinction = medium.density, medium.extinction
    device = density.device
    measure, add_up, gather = coarse_kernels(density.dtype, medium.temperature is not None)
    bricks = occupied(medium) if march.step < BRICK else medium.buffer((0, 0, 0), wp.uint8)
    lattice, counts = _lattice(density.shape, view, spacing)
    gaps, nodes = medium.buffer(counts, wp.vec2), medium.buffer(counts, wp.vec4)
    parts = wp.vec2i(*(parts_of(lattice.gap[axis], light_step) for axis in range(2)))
    inputs = [density, bricks, extinction, view, lattice, parts]
    wp.launch(measure, counts, inputs=inputs, outputs=[gaps], device=device)
    lines = (counts[1] + counts[0], counts[2])
    wp.launch(add_up, lines, inputs=[gaps, counts[1]], outputs=[nodes], device=device)
    temperature, emission = medium.glow
    inputs = [density, temperature, bricks, nodes, extinction, emission, view, lattice, parameters(march)]
    wp.launch(gather, out.shape[1:], inputs=inputs, outputs=[out], device=device)
