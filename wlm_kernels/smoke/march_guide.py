"""Guiding maps by a march in large steps (neural-six-way-lightmaps, algorithm 1).

Units and sampling are those of `march`. The lights from the top and the bottom are marched to from each sample, or,
far sooner, from the nodes of a lattice over the grid's box, between which their optical depths are trilinear.
Read first: `guide` of `tests/reference/marching.py`, which is algorithm 1 in 20 lines.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    NO_BRICKS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    density_at,
    marched_ray,
    node_position,
    nodes_along,
    optical_depth,
    parameters,
    phase,
    size_of,
)
from wlm_kernels.smoke.settings import March

_OPTIONS = {"enable_backward": False}


@wp.func
def _face_at(nodes: wp.array3d[Any], i: int, j: int, k: int, fy: float, fz: float):
    a = wp.lerp(nodes[i, j, k], nodes[i, j, k + 1], fz)
    b = wp.lerp(nodes[i, j + 1, k], nodes[i, j + 1, k + 1], fz)
    return wp.lerp(a, b, fy)


@wp.func
def _node_at(nodes: wp.array3d[Any], p: wp.vec3, size: wp.vec3):
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


@wp.func
def _both_depths(density: wp.array3d[Any], p: wp.vec3, up: wp.vec3, extinction: float, step: float) -> wp.vec2:
    """Optical depths to the top and to the bottom."""
    return wp.vec2(
        optical_depth(density, NO_BRICKS, p, up, extinction, step),
        optical_depth(density, NO_BRICKS, p, -up, extinction, step),
    )


@dataclass(frozen=True)
class _Kernels:
    """Of one type of density."""

    lattice: wp.Kernel
    guide: wp.Kernel
    guide_marching: wp.Kernel


@functools.cache
def guide_kernels(dtype: Any) -> _Kernels:
    """Builds (once) the kernels for densities of a type, `wp.float32` or `wp.float16`."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def lattice(
        # in:
        density: wp.array3d[dtype],
        extinction: float,
        up: wp.vec3,
        step: float,
        # out:
        nodes: wp.array3d[wp.vec2],
    ):
        a, b, c = wp.tid()
        p = node_position(nodes, size_of(density), a, b, c)
        nodes[a, b, c] = _both_depths(density, p, up, extinction, step)

    def make_guide(from_lattice: bool) -> wp.Kernel:
        @wp.kernel(module="unique", module_options=_OPTIONS)
        def guide(
            # in:
            density: wp.array3d[dtype],
            nodes: wp.array3d[wp.vec2],
            extinction: float,
            view: View,
            march: MarchParameters,
            # out:
            out: wp.array3d[float],
        ):
            row, column = wp.tid()
            r = marched_ray(view, row, column, size_of(density), march.step)
            light = float(0.0)
            t = float(1.0)
            depth = float(0.0)
            if r.count > 0:
                random = wp.rand_init(march.seed, row * view.width + column)
                offset = 0.5 + march.jitter * (wp.randf(random) - 0.5)
                rise = wp.dot(view.up, r.direction)
                front = phase(march.g, -1.0)
                above = phase(march.g, rise)
                below = phase(march.g, -rise)
                for n in range(r.count):
                    s = r.first + (float(n) + offset) * r.length
                    p = r.origin + s * r.direction
                    sigma = extinction * density_at(density, p)
                    if sigma > 0.0:
                        if depth == 0.0 and sigma > march.threshold:
                            depth = (s + view.moved) * view.voxel
                        tau = wp.vec2()
                        if wp.static(from_lattice):
                            tau = _node_at(nodes, p, size_of(density))
                        else:
                            tau = _both_depths(density, p, view.up, extinction, march.step)
                        x = sigma * r.length
                        # The light from the front comes along the ray, through the smoke that the ray has passed.
                        light += 0.5 * front * t * t * absorbed(2.0 * x)
                        light += t * absorbed(x) * (above * wp.exp(-tau[0]) + below * wp.exp(-tau[1]))
                        t *= wp.exp(-x)
                        if t < march.cutoff:
                            break
            out[0, row, column] = light
            out[1, row, column] = t
            out[2, row, column] = depth

        return guide

    return _Kernels(lattice, make_guide(True), make_guide(False))


def lattice(medium: Medium, up: Sequence[float], step: float) -> wp.array:
    """Optical depths towards the top and the bottom on a lattice of nodes no farther apart than a step, or a voxel.

    Args:
        medium: The smoke.
        up: The direction to the top, of length 1.
        step: In voxels, of the nodes, which are a voxel apart at least, and of the march from each.

    Returns:
        vec2 [A, B, C], to the top and to the bottom; the first and the last nodes lie half a voxel out of the grid.
    """
    density = medium.density
    nodes = medium.buffer(nodes_along(density.shape, step), wp.vec2)
    inputs = [density, medium.extinction, wp.vec3(*map(float, up)), step]
    wp.launch(guide_kernels(density.dtype).lattice, nodes.shape, inputs, [nodes], device=density.device)
    return nodes


def guide(medium: Medium, view: View, march: March, out: wp.array, *, shared: bool = True) -> None:
    """A guiding map (algorithm 1): smoke lit from the front, the top and the bottom, its transparency and its depth.

    The paper's algorithm lacks the step h in a step's share of the light (line 9); here each step is integrated
    exactly. Steps are shortened so that a whole number of them fills a ray's way through the grid. The
    paper's side lights, along the cross product of the view and the world's z, would be to the left and right where z
    points up; ours are along the camera's own up and down.

    Args:
        medium: The smoke, of albedo 1.
        view: The camera, [H, W] pixels.
        march: Its steps are those to the lights too. The cutoff's error is less than it in transparency and 2.5
            times it (for g = 0) in light.
        out: float [3, H, W], written: scattered light under lights of irradiance 4 pi, transparency, and the distance
            from the camera to the first sample denser than the threshold, 0: none.
        shared: Whether the lights from the top and bottom are marched to from a lattice with a node each step (each
            voxel, of smaller steps), and interpolated, instead of from each sample.
    """
    density = medium.density
    kernels = guide_kernels(density.dtype)
    if shared:
        nodes, kernel = lattice(medium, view.up, march.step), kernels.guide
    else:
        nodes, kernel = medium.buffer((0, 0, 0), wp.vec2), kernels.guide_marching
    inputs = [density, nodes, medium.extinction, view, parameters(march)]
    wp.launch(kernel, out.shape[1:], inputs=inputs, outputs=[out], device=density.device)
