"""Six-way lightmaps by a march in large steps, with the ways to the lights shared: what a guiding map costs.

An orthographic camera's lights follow its axes. The optical depths to the lights from the sides therefore lie on a
lattice of nodes along these axes, over the smoke's box as the camera sees it: the gap between each two neighbours is
marched once, and sums along the lattice's lines give a node's depths to the right and left, top and bottom. That takes
as many samples as there are nodes, where a march from each node would take a line of them. A ray runs along the
lattice's third axis, keeps its place in the other two, and interpolates depths between the nodes.

The other two lights need no march. The light from the front comes along the ray and goes back along it, which leaves
exp(-2 tau) of it: (1 - T^2) / 2 in all, where T is the ray's transparency. The light from the back passes all of the
ray's smoke wherever it is scattered: -T ln T. Both are exact, whatever the steps; only T has the error of its step.

Samples of neighbouring pixels are shifted by interleaved gradient noise (Jimenez 2014), whose sum over a few pixels
varies less than that of random numbers: what filters the image, a network say, is rid of more of it.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    BRICK,
    Empty,
    View,
    absorbed,
    density_at,
    occupied,
    phase,
    ray,
    size_of,
    skipping_at,
    steps_along,
    warp_memory,
)

__all__ = ["DEPTH", "PLANES", "coarse_kernels", "coarse_six_way"]

_OPTIONS = {"enable_backward": False}

PLANES = ("right", "left", "top", "bottom", "front", "back", "transparency", "emission", "depth")
"""Of the result."""

DEPTH = PLANES.index("depth")

_LEAST = 0.25  # voxels between nodes
_MOST = 2**28  # nodes; a long thin box seen along a diagonal has far more than it has voxels
_PATTERNS = 64  # of the noise
_ROUNDING = 1e-6  # by which parts may be longer than asked, rather than one more


@wp.struct
class _Lattice:
    """Where nodes are: along the camera's right, up and forward, from its origin, in voxels."""

    low: wp.vec3
    gap: wp.vec3


@wp.func
def _sample(density: wp.array3d[Any], bricks: wp.array3d[wp.uint8], p: wp.vec3) -> float:
    """The density, by bricks where there are any: the same number."""
    if bricks.shape[0] > 0:
        return skipping_at(density, bricks, p)
    return density_at(density, p)


@wp.func
def _noise(row: int, column: int, seed: int) -> float:
    """Interleaved gradient noise, at least 0 and below 1; ``seed`` below ``_PATTERNS``."""
    x = float(column) + 5.588238 * float(seed)
    y = float(row) + 5.588238 * float(seed)
    f = 0.06711056 * x + 0.00583715 * y
    f = 52.9829189 * (f - wp.floor(f))
    # A product that is rounded once for the floor and not for the difference may leave the range by an ulp.
    return wp.clamp(f - wp.floor(f), 0.0, 0.99999994)


@wp.func
def _beside(nodes: wp.array3d[wp.vec4], i: int, j: int, k: int, fx: float, fy: float) -> wp.vec4:
    """Bilinear within a plane of nodes."""
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
    """Depths to either end of a line: the first ``across`` lines run to the right, the others up."""
    line, k = wp.tid()
    if line < across:
        right = float(0.0)
        left = float(0.0)
        last = nodes.shape[0] - 1
        nodes[last, line, k][0] = 0.0
        nodes[0, line, k][1] = 0.0
        for n in range(last):
            # From both ends at a time: a walk's length is what it costs.
            left += gaps[n, line, k][0]
            right += gaps[last - 1 - n, line, k][0]
            nodes[n + 1, line, k][1] = left
            nodes[last - 1 - n, line, k][0] = right
    else:
        i = line - across
        top = float(0.0)
        bottom = float(0.0)
        last = nodes.shape[1] - 1
        nodes[i, last, k][2] = 0.0
        nodes[i, 0, k][3] = 0.0
        for n in range(last):
            bottom += gaps[i, n, k][1]
            top += gaps[i, last - 1 - n, k][1]
            nodes[i, n + 1, k][3] = bottom
            nodes[i, last - 1 - n, k][2] = top


@functools.cache
def coarse_kernels(dtype: Any, hot: bool):
    """Builds (once) the kernels for densities of a type; ``hot``: with a temperature of the same type."""

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
                right += d * _sample(density, bricks, p + (float(n) + 0.5) * d * view.right)
        d = lattice.gap[1] / float(parts[1])
        if j < gaps.shape[1] - 1:
            for n in range(parts[1]):
                up += d * _sample(density, bricks, p + (float(n) + 0.5) * d * view.up)
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
        h: float,
        jitter: float,
        seed: int,
        threshold: float,
        g: float,
        cutoff: float,
        unit: float,
        lead: float,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = ray(view, row, column)
        steps = steps_along(size_of(density), r.origin, r.direction, h)
        sides = wp.vec4()
        glow = float(0.0)
        through = float(0.0)
        t = float(1.0)
        depth = float(0.0)
        if steps.count > 0:
            dt = steps.length
            offset = 0.5 + jitter * (_noise(row, column, seed) - 0.5)
            # The ray's place in the lattice, which all of its samples share.
            x = (wp.dot(r.origin - view.origin, view.right) - lattice.low[0]) / lattice.gap[0]
            y = (wp.dot(r.origin - view.origin, view.up) - lattice.low[1]) / lattice.gap[1]
            i = wp.clamp(int(x), 0, nodes.shape[0] - 2)
            j = wp.clamp(int(y), 0, nodes.shape[1] - 2)
            fx = wp.clamp(x - float(i), 0.0, 1.0)
            fy = wp.clamp(y - float(j), 0.0, 1.0)
            held = int(-1)
            near = wp.vec4()
            far = wp.vec4()
            for n in range(steps.count):
                s = steps.first + (float(n) + offset) * dt
                p = r.origin + s * r.direction
                sigma = extinction * _sample(density, bricks, p)
                if wp.static(hot):
                    # The mean of what is left along the step: fire without smoke shines too.
                    x = sigma * dt
                    share = wp.where(x > 1.0e-6, absorbed(x) / wp.max(x, 1.0e-6), 1.0)
                    glow += t * share * emission * dt * density_at(temperature, p)
                if sigma > 0.0:
                    if depth == 0.0 and sigma > threshold:
                        depth = (s + lead) * unit
                    z = (s - lattice.low[2]) / lattice.gap[2]
                    k = wp.clamp(int(z), 0, nodes.shape[2] - 2)
                    if k != held:
                        near = _beside(nodes, i, j, k, fx, fy)
                        far = _beside(nodes, i, j, k + 1, fx, fy)
                        held = k
                    tau = wp.lerp(near, far, wp.clamp(z - float(k), 0.0, 1.0))
                    x = sigma * dt
                    left = wp.vec4(wp.exp(-tau[0]), wp.exp(-tau[1]), wp.exp(-tau[2]), wp.exp(-tau[3]))
                    sides += t * absorbed(x) * left
                    through += x
                    t = wp.exp(-through)
                    if t < cutoff:
                        break
        across = wp.dot(view.right, r.direction)
        rise = wp.dot(view.up, r.direction)
        out[0, row, column] = phase(g, across) * sides[0]
        out[1, row, column] = phase(g, -across) * sides[1]
        out[2, row, column] = phase(g, rise) * sides[2]
        out[3, row, column] = phase(g, -rise) * sides[3]
        out[4, row, column] = 0.5 * phase(g, -1.0) * absorbed(2.0 * through)
        out[5, row, column] = phase(g, 1.0) * t * through
        out[6, row, column] = t
        out[7, row, column] = glow
        out[8, row, column] = depth

    return measure, _add_up, gather


def _lattice(shape: Sequence[int], seen: View, spacing: float) -> tuple[_Lattice, tuple[int, ...]]:
    """A lattice over all that the camera sees of the smoke's box, or would in a larger image, and its nodes."""
    axes = (seen.right, seen.up, seen.forward)
    extents = [sum((n + 1) * abs(a) for n, a in zip(shape, axis, strict=True)) for axis in axes]
    spacing = max(spacing, _LEAST)
    while math.prod(parts := [max(math.ceil(e / spacing - _ROUNDING), 1) for e in extents]) > _MOST:
        spacing *= 1.1
    lattice = _Lattice()
    lattice.low = wp.vec3(
        *(
            sum(min(-0.5 * a, (n + 0.5) * a) - o * a for n, o, a in zip(shape, seen.origin, axis, strict=True))
            for axis in axes
        )
    )
    lattice.gap = wp.vec3(*(extent / n for extent, n in zip(extents, parts, strict=True)))
    return lattice, tuple(n + 1 for n in parts)


def coarse_six_way(
    density,
    extinction: float,
    seen: View,
    out,
    *,
    step: float = 10.0,
    spacing: float | None = None,
    light_step: float | None = None,
    jitter: float = 1.0,
    seed: int = 0,
    threshold: float = 0.01,
    g: float = 0.0,
    temperature=None,
    emission: float = 0.0,
    cutoff: float = 1e-4,
    unit: float = 1.0,
    lead: float = 0.0,
    empty: Empty | None = None,
) -> None:
    """Six-way lightmaps, transparency, emission and depth by one march in large steps.

    Below a brick's edge, ``step`` makes both rays and ways to the lights look no further in bricks without smoke. It
    changes no result.

    Args:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        seen: The camera, [H, W] pixels, orthographic.
        out: float [9, H, W], written: ``PLANES``, each light of irradiance 4 pi, an albedo of 1.
        step: The longest step along rays, in voxels.
        spacing: The largest distance of neighbouring nodes, in voxels; None: as ``step``. It is a quarter of one at
            least, and as much more as makes the nodes about 2^28 at most. A node takes 24 bytes.
        light_step: The longest step between nodes, in voxels; None: as ``spacing``.
        jitter: How much of a step the samples of a pixel are shifted, 0 (each in its step's middle) to 1.
        seed: Of the jitter, any whole number; 64 of them differ.
        threshold, cutoff, unit, lead: As for ``marching.guide``. What a ray that ends at the cutoff would have found
            behind it is less than 1e-3 in every plane.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        temperature: As the density, of its shape; None: nothing emits.
        emission: Light given off per voxel of way where the temperature is 1.
        empty: As for ``marching.occupied``.

    Raises:
        ValueError: The camera is in perspective.
    """
    if seen.perspective:
        raise ValueError("six-way lightmaps need an orthographic camera: their lights follow its axes")
    spacing = step if spacing is None else spacing
    light_step = spacing if light_step is None else light_step
    device = density.device
    empty = empty or warp_memory(device)
    measure, add_up, gather = coarse_kernels(density.dtype, temperature is not None)
    bricks = occupied(density, empty) if step < BRICK else empty((0, 0, 0), wp.uint8)
    lattice, counts = _lattice(density.shape, seen, spacing)
    gaps, nodes = empty(counts, wp.vec2), empty(counts, wp.vec4)
    parts = wp.vec2i(*(max(math.ceil(lattice.gap[axis] / light_step - _ROUNDING), 1) for axis in range(2)))
    inputs = [density, bricks, extinction, seen, lattice, parts]
    wp.launch(measure, counts, inputs=inputs, outputs=[gaps], device=device)
    lines = (counts[1] + counts[0], counts[2])
    wp.launch(add_up, lines, inputs=[gaps, counts[1]], outputs=[nodes], device=device)
    hot = density if temperature is None else temperature
    inputs = [density, hot, bricks, nodes, extinction, emission, seen, lattice, step, jitter, seed % _PATTERNS]
    inputs += [threshold, g, cutoff, unit, lead]
    wp.launch(gather, out.shape[1:], inputs=inputs, outputs=[out], device=device)
