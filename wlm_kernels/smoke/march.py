"""Marching through a grid of density: guiding maps and transmittance (neural-six-way-lightmaps, eq. 3, 6, algorithm 1).

All is in voxels: the grid ``[X, Y, Z]`` fills the box from 0 to (X, Y, Z), the centre of voxel i is at i + 1/2, and
between centres the density is trilinear, with zero outside the grid; so there is smoke up to half a voxel beyond the
box. Extinction is ``extinction * density`` per voxel. A step is taken as of one density, that at its sample, and is
integrated exactly: 1 - exp(-sigma h), not sigma h. A density below zero or NaN isn't looked for; the caller keeps them
out.

A light is a direction towards it, of irradiance 4 pi, so that an isotropic phase function is 1 and not 1 / (4 pi).
``marching_six`` has the six-way lightmaps. None of it has a gradient.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

__all__ = [
    "BRICK",
    "View",
    "absorbed",
    "clip",
    "density_at",
    "guide",
    "guide_kernels",
    "lattice",
    "node_at",
    "node_position",
    "nodes_along",
    "occupied",
    "optical_depth",
    "phase",
    "ray",
    "skipping_at",
    "steps_along",
    "transmittance",
    "view",
    "warp_memory",
]

Empty = Callable[[tuple[int, ...], Any], wp.array]
"""Makes a buffer, not set, of a shape and a type."""

_OPTIONS = {"enable_backward": False}

BRICK = 8
"""Voxels along an edge of a brick, the unit in which empty space is left out."""

_NEVER = 1.0e30


@wp.struct
class View:
    """A camera, in voxels. Row 0 is the top row; a pixel is seen at its centre.

    ``pitch`` is a pixel's size: in voxels where the view is orthographic, at distance 1 where it is in perspective.
    ``origin`` is the image's centre in the camera's plane, or the eye; nothing behind it is seen.
    """

    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    pitch: float
    width: int
    height: int
    perspective: int


@wp.struct
class _Ray:
    origin: wp.vec3
    direction: wp.vec3


@wp.func
def ray(view: View, row: int, column: int) -> _Ray:
    """What a pixel sees along."""
    u = (float(column) + 0.5 - 0.5 * float(view.width)) * view.pitch
    v = (0.5 * float(view.height) - float(row) - 0.5) * view.pitch
    r = _Ray()
    if view.perspective != 0:
        r.origin = view.origin
        r.direction = wp.normalize(view.forward + u * view.right + v * view.up)
    else:
        r.origin = view.origin + u * view.right + v * view.up
        r.direction = view.forward
    return r


@wp.func
def clip(size: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> wp.vec2:
    """First and last distance along a ray where a density may be; first > last: it misses the smoke."""
    first = float(-_NEVER)
    last = float(_NEVER)
    for axis in range(3):
        low = -0.5 - origin[axis]
        high = size[axis] + 0.5 - origin[axis]
        d = direction[axis]
        if wp.abs(d) > 1.0e-9:
            first = wp.max(first, wp.min(low / d, high / d))
            last = wp.min(last, wp.max(low / d, high / d))
        elif low > 0.0 or high < 0.0:
            last = -_NEVER
    return wp.vec2(first, last)


@wp.func
def size_of(density: wp.array3d[Any]) -> wp.vec3:
    return wp.vec3(float(density.shape[0]), float(density.shape[1]), float(density.shape[2]))


@wp.struct
class _Steps:
    """Equal steps along a ray, of which the first begins ``first`` from its origin."""

    first: float
    length: float
    count: int


@wp.func
def steps_along(size: wp.vec3, origin: wp.vec3, direction: wp.vec3, h: float) -> _Steps:
    """Steps no longer than h through all of the smoke before the origin; none where it is missed."""
    span = clip(size, origin, direction)
    steps = _Steps()
    steps.first = wp.max(span[0], 0.0)
    if span[1] > steps.first:
        steps.count = int(wp.ceil((span[1] - steps.first) / h))
        steps.length = (span[1] - steps.first) / float(steps.count)
    return steps


@wp.func
def density_at(density: wp.array3d[Any], p: wp.vec3) -> float:
    """Trilinear, zero outside; ``p`` is no farther out than half a voxel and rounding."""
    x = p[0] - 0.5
    y = p[1] - 0.5
    z = p[2] - 0.5
    i = int(wp.floor(x))
    j = int(wp.floor(y))
    k = int(wp.floor(z))
    fx = x - float(i)
    fy = y - float(j)
    fz = z - float(k)
    # What lies outside has no weight, and its index is moved to one that can be read.
    nx = density.shape[0]
    ny = density.shape[1]
    nz = density.shape[2]
    wx0 = wp.where(i >= 0 and i < nx, 1.0 - fx, 0.0)
    wx1 = wp.where(i >= -1 and i < nx - 1, fx, 0.0)
    wy0 = wp.where(j >= 0 and j < ny, 1.0 - fy, 0.0)
    wy1 = wp.where(j >= -1 and j < ny - 1, fy, 0.0)
    wz0 = wp.where(k >= 0 and k < nz, 1.0 - fz, 0.0)
    wz1 = wp.where(k >= -1 and k < nz - 1, fz, 0.0)
    i0 = wp.clamp(i, 0, nx - 1)
    i1 = wp.clamp(i + 1, 0, nx - 1)
    j0 = wp.clamp(j, 0, ny - 1)
    j1 = wp.clamp(j + 1, 0, ny - 1)
    k0 = wp.clamp(k, 0, nz - 1)
    k1 = wp.clamp(k + 1, 0, nz - 1)
    a = wy0 * (wz0 * float(density[i0, j0, k0]) + wz1 * float(density[i0, j0, k1]))
    a += wy1 * (wz0 * float(density[i0, j1, k0]) + wz1 * float(density[i0, j1, k1]))
    b = wy0 * (wz0 * float(density[i1, j0, k0]) + wz1 * float(density[i1, j0, k1]))
    b += wy1 * (wz0 * float(density[i1, j1, k0]) + wz1 * float(density[i1, j1, k1]))
    return wx0 * a + wx1 * b


@wp.func
def skipping_at(density: wp.array3d[Any], bricks: wp.array3d[wp.uint8], p: wp.vec3) -> float:
    """``density_at``, which looks no further where the brick is empty: the same number."""
    i = wp.clamp(int(p[0]) // BRICK, 0, bricks.shape[0] - 1)
    j = wp.clamp(int(p[1]) // BRICK, 0, bricks.shape[1] - 1)
    k = wp.clamp(int(p[2]) // BRICK, 0, bricks.shape[2] - 1)
    if bricks[i, j, k] == wp.uint8(0):
        return 0.0
    return density_at(density, p)


@wp.func
def absorbed(x: float) -> float:
    """1 - exp(-x), without cancellation where x is small."""
    if x < 0.05:
        return x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x / 120.0))))
    return 1.0 - wp.exp(-x)


@wp.func
def phase(g: float, cosine: float) -> float:
    """Henyey and Greenstein's, times 4 pi; ``cosine`` is 1 where the light goes straight on."""
    d = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) / (d * wp.sqrt(d))


@wp.func
def optical_depth(
    density: wp.array3d[Any], bricks: wp.array3d[wp.uint8], p: wp.vec3, toward: wp.vec3, extinction: float, h: float
) -> float:
    """From p out of the smoke, in equal steps no longer than h, each sampled at its middle."""
    steps = steps_along(size_of(density), p, toward, h)
    tau = float(0.0)
    for n in range(steps.count):
        tau += skipping_at(density, bricks, p + (steps.first + (float(n) + 0.5) * steps.length) * toward)
    return tau * steps.length * extinction


@dataclass(frozen=True)
class _Kernels:
    """Of one type of density."""

    occupied: Any
    lattice: Any
    transmittance: Any
    guide: Any
    guide_marching: Any


@functools.cache
def guide_kernels(dtype: Any) -> _Kernels:
    """Builds (once) the kernels for densities of a type, ``wp.float32`` or ``wp.float16``."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def occupied(
        # in:
        density: wp.array3d[dtype],
        # out:
        bricks: wp.array3d[wp.uint8],
    ):
        a, b, c = wp.tid()
        found = wp.uint8(0)
        # A point in a brick reads half a voxel beyond it too.
        for i in range(wp.max(a * BRICK - 1, 0), wp.min((a + 1) * BRICK + 1, density.shape[0])):
            for j in range(wp.max(b * BRICK - 1, 0), wp.min((b + 1) * BRICK + 1, density.shape[1])):
                for k in range(wp.max(c * BRICK - 1, 0), wp.min((c + 1) * BRICK + 1, density.shape[2])):
                    if float(density[i, j, k]) > 0.0:
                        found = wp.uint8(1)
        bricks[a, b, c] = found

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def lattice(
        # in:
        density: wp.array3d[dtype],
        extinction: float,
        up: wp.vec3,
        h: float,
        # out:
        nodes: wp.array3d[wp.vec2],
    ):
        a, b, c = wp.tid()
        p = node_position(nodes, size_of(density), a, b, c)
        nodes[a, b, c] = _both_depths(density, p, up, extinction, h)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def transmittance(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        points: wp.array1d[wp.vec3],
        toward: wp.vec3,
        h: float,
        # out:
        out: wp.array1d[float],
    ):
        i = wp.tid()
        out[i] = wp.exp(-optical_depth(density, bricks, points[i], toward, extinction, h))

    def make_guide(from_lattice: bool):
        @wp.kernel(module="unique", module_options=_OPTIONS)
        def guide(
            # in:
            density: wp.array3d[dtype],
            nodes: wp.array3d[wp.vec2],
            extinction: float,
            view: View,
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
            light = float(0.0)
            t = float(1.0)
            depth = float(0.0)
            if steps.count > 0:
                random = wp.rand_init(seed, row * view.width + column)
                offset = 0.5 + jitter * (wp.randf(random) - 0.5)
                rise = wp.dot(view.up, r.direction)
                front = phase(g, -1.0)
                above = phase(g, rise)
                below = phase(g, -rise)
                for n in range(steps.count):
                    s = steps.first + (float(n) + offset) * steps.length
                    p = r.origin + s * r.direction
                    sigma = extinction * density_at(density, p)
                    if sigma > 0.0:
                        if depth == 0.0 and sigma > threshold:
                            depth = (s + lead) * unit
                        tau = wp.vec2()
                        if wp.static(from_lattice):
                            tau = node_at(nodes, p, size_of(density))
                        else:
                            tau = _both_depths(density, p, view.up, extinction, h)
                        x = sigma * steps.length
                        # The light from the front comes along the ray, through what the ray has come through.
                        light += 0.5 * front * t * t * absorbed(2.0 * x)
                        light += t * absorbed(x) * (above * wp.exp(-tau[0]) + below * wp.exp(-tau[1]))
                        t *= wp.exp(-x)
                        if t < cutoff:
                            break
            out[0, row, column] = light
            out[1, row, column] = t
            out[2, row, column] = depth

        return guide

    return _Kernels(occupied, lattice, transmittance, make_guide(True), make_guide(False))


@wp.func
def _plain_depth(density: wp.array3d[Any], p: wp.vec3, toward: wp.vec3, extinction: float, h: float) -> float:
    """``optical_depth`` without bricks: too few samples to be worth the making of them."""
    steps = steps_along(size_of(density), p, toward, h)
    tau = float(0.0)
    for n in range(steps.count):
        tau += density_at(density, p + (steps.first + (float(n) + 0.5) * steps.length) * toward)
    return tau * steps.length * extinction


@wp.func
def _both_depths(density: wp.array3d[Any], p: wp.vec3, up: wp.vec3, extinction: float, h: float) -> wp.vec2:
    return wp.vec2(_plain_depth(density, p, up, extinction, h), _plain_depth(density, p, -up, extinction, h))


@wp.func
def node_position(nodes: wp.array3d[Any], size: wp.vec3, i: int, j: int, k: int) -> wp.vec3:
    """Where a lattice's node lies: the first and the last along an axis on the borders of the smoke."""
    return wp.vec3(
        float(i) * (size[0] + 1.0) / float(nodes.shape[0] - 1) - 0.5,
        float(j) * (size[1] + 1.0) / float(nodes.shape[1] - 1) - 0.5,
        float(k) * (size[2] + 1.0) / float(nodes.shape[2] - 1) - 0.5,
    )


@wp.func
def _face_at(nodes: wp.array3d[Any], i: int, j: int, k: int, fy: float, fz: float):
    a = wp.lerp(nodes[i, j, k], nodes[i, j, k + 1], fz)
    b = wp.lerp(nodes[i, j + 1, k], nodes[i, j + 1, k + 1], fz)
    return wp.lerp(a, b, fy)


@wp.func
def node_at(nodes: wp.array3d[Any], p: wp.vec3, size: wp.vec3):
    """Trilinear between a lattice's nodes."""
    x = (p[0] + 0.5) * float(nodes.shape[0] - 1) / (size[0] + 1.0)
    y = (p[1] + 0.5) * float(nodes.shape[1] - 1) / (size[1] + 1.0)
    z = (p[2] + 0.5) * float(nodes.shape[2] - 1) / (size[2] + 1.0)
    i = wp.clamp(int(x), 0, nodes.shape[0] - 2)
    j = wp.clamp(int(y), 0, nodes.shape[1] - 2)
    k = wp.clamp(int(z), 0, nodes.shape[2] - 2)
    fx = wp.clamp(x - float(i), 0.0, 1.0)
    fy = wp.clamp(y - float(j), 0.0, 1.0)
    fz = wp.clamp(z - float(k), 0.0, 1.0)
    a = _face_at(nodes, i, j, k, fy, fz)
    b = _face_at(nodes, i + 1, j, k, fy, fz)
    return wp.lerp(a, b, fx)


def view(origin, right, up, forward, pitch: float, width: int, height: int, perspective: bool = False) -> View:
    """Makes a ``View``; the three directions are orthogonal and of length 1."""
    made = View()
    made.origin, made.right, made.up, made.forward = (wp.vec3(*map(float, v)) for v in (origin, right, up, forward))
    made.pitch, made.width, made.height, made.perspective = float(pitch), width, height, int(perspective)
    return made


def warp_memory(device: wp.Device) -> Empty:
    """Makes buffers in Warp's own memory: what calls use that are given no other."""
    return lambda shape, dtype: wp.empty(shape, dtype=dtype, device=device)


def occupied(density, empty: Empty | None = None):
    """Which bricks have smoke within reach of a sample in them.

    Args:
        density: float or half [X, Y, Z].
        empty: Makes a buffer, ``empty(shape, dtype)`` on the density's device; default Warp's.

    Returns:
        uint8 [X / 8, Y / 8, Z / 8], rounded up, 1 where there is any.
    """
    shape = tuple(-(-n // BRICK) for n in density.shape)
    bricks = (empty or warp_memory(density.device))(shape, wp.uint8)
    wp.launch(guide_kernels(density.dtype).occupied, shape, [density], [bricks], device=density.device)
    return bricks


def transmittance(density, extinction: float, points, toward, step: float, out, empty: Empty | None = None) -> None:
    """What is left of light that comes to points from a direction (eq. 3).

    Args:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        points: vec3 [N], in voxels.
        toward: Three numbers, the direction to the light, of length 1.
        step: The longest step, in voxels; the error falls with its square where the density is smooth.
        out: float [N], written.
        empty: As for ``occupied``.
    """
    inputs = [density, occupied(density, empty), extinction, points, wp.vec3(*map(float, toward)), step]
    kernel = guide_kernels(density.dtype).transmittance
    wp.launch(kernel, points.shape, inputs=inputs, outputs=[out], device=density.device)


def nodes_along(shape: Sequence[int], step: float) -> tuple[int, ...]:
    """Nodes of a lattice no farther apart than a step, or a voxel, from half a voxel out of the grid to half beyond."""
    # Each marches to its lights by itself: of closer ones the time would grow with the fourth power.
    return tuple(math.ceil((n + 1) / max(step, 1.0)) + 1 for n in shape)


def lattice(density, extinction: float, up, step: float, empty: Empty | None = None):
    """Optical depths towards the top and the bottom on a lattice of nodes no farther apart than a step, or a voxel.

    Args:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        up: Three numbers, the direction to the top, of length 1.
        step: In voxels, of the nodes, which are a voxel apart at least, and of the march from each.
        empty: As for ``occupied``.

    Returns:
        vec2 [A, B, C], to the top and to the bottom; the first and the last nodes lie half a voxel out of the grid.
    """
    nodes = (empty or warp_memory(density.device))(nodes_along(density.shape, step), wp.vec2)
    inputs = [density, extinction, wp.vec3(*map(float, up)), step]
    wp.launch(guide_kernels(density.dtype).lattice, nodes.shape, inputs, [nodes], device=density.device)
    return nodes


def guide(
    density,
    extinction: float,
    seen: View,
    out,
    *,
    step: float = 10.0,
    jitter: float = 1.0,
    seed: int = 0,
    threshold: float = 0.01,
    g: float = 0.0,
    cutoff: float = 1e-4,
    unit: float = 1.0,
    lead: float = 0.0,
    shared: bool = True,
    empty: Empty | None = None,
) -> None:
    """A guiding map (algorithm 1): smoke lit from the front, the top and the bottom, its transparency and its depth.

    Where the paper's algorithm leaves h out of a step's share of the light, and takes what it can for sigma h, it is
    integrated exactly here. Steps are shortened so that a whole number of them fills a ray's way through the grid. The
    paper's side lights, along the cross product of the view and the world's z, would be to the left and right where z
    points up; ours are along the camera's own up and down.

    Args:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        seen: The camera, [H, W] pixels.
        out: float [3, H, W], written: scattered light under lights of irradiance 4 pi and an albedo of 1,
            transparency, and the distance from the camera to the first sample denser than the threshold, 0: none.
        step: h, the longest step, in voxels, to the lights too.
        jitter: How much of a step the samples of a pixel are shifted at random, 0 (each in its step's middle) to 1.
        seed: Of the jitter.
        threshold: tau, in extinction per voxel.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        cutoff: A ray ends where less than this is left of its transparency; the error is less than it in transparency
            and 2.5 times it (for g = 0) in light.
        unit: What a voxel's edge is in the depth's unit.
        lead: Added to depths that were found, in voxels: how far in front of the true camera this one is.
        shared: Whether the lights from the top and bottom are marched to from a lattice with a node each step (each
            voxel, of smaller steps), and interpolated, instead of from each sample.
        empty: As for ``occupied``.
    """
    kernels = guide_kernels(density.dtype)
    if shared:
        nodes, kernel = lattice(density, extinction, seen.up, step, empty), kernels.guide
    else:
        nodes, kernel = warp_memory(density.device)((0, 0, 0), wp.vec2), kernels.guide_marching
    inputs = [density, nodes, extinction, seen, step, jitter, seed, threshold, g, cutoff, unit, lead]
    wp.launch(kernel, out.shape[1:], inputs=inputs, outputs=[out], device=density.device)
