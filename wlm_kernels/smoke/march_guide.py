"""Guiding maps by a march in large steps (neural-six-way-lightmaps, algorithm 1).

Optical depths to the lights from the top and the bottom are marched from each sample or, much faster, from the nodes of
a lattice over the grid's box and interpolated between them. Units and sampling are those of `march`, except
that the jitter is a random number per pixel, as in the paper. Read `guide` of `tests/reference/marching.py` first: it
is algorithm 1 in 20 lines.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    OPTIONS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    begin,
    between_nodes,
    look,
    node_position,
    nodes_along,
    optical_depth,
    parameters,
    pass_step,
    phase,
    size_of,
    surface,
)
from wlm_kernels.smoke.settings import March


@wp.func
def _both_depths(smoke: Any, p: wp.vec3, up: wp.vec3, step: float) -> wp.vec2:
    """Interpolates optical depths to the top and to the bottom."""
    return wp.vec2(optical_depth(smoke, p, up, step), optical_depth(smoke, p, -up, step))


@dataclass(frozen=True)
class _Kernels:
    lattice: wp.Kernel
    guide: wp.Kernel
    guide_marching: wp.Kernel


@functools.cache
def guide_kernels(smoke_type: Any) -> _Kernels:
    """Builds (once) the kernels for a type of smoke, `Medium.smoke_type`."""

    @wp.kernel(module="unique", module_options=OPTIONS)
    def lattice(
        # in:
        smoke: smoke_type,
        up: wp.vec3,
        step: float,
        # out:
        nodes: wp.array3d[wp.vec2],
    ):
        a, b, c = wp.tid()
        nodes[a, b, c] = _both_depths(smoke, node_position(nodes, size_of(smoke.density), a, b, c), up, step)

    def make_guide(from_lattice: bool) -> wp.Kernel:
        @wp.kernel(module="unique", module_options=OPTIONS)
        def guide(
            # in:
            smoke: smoke_type,
            nodes: wp.array3d[wp.vec2],
            view: View,
            march: MarchParameters,
            # out:
            out: wp.array3d[float],
        ):
            row, column = wp.tid()
            random = wp.rand_init(march.seed, row * view.width + column)
            r = begin(view, row, column, smoke, march.step, 0.5 + march.jitter * (wp.randf(random) - 0.5))
            size = size_of(smoke.density)
            light = float(0.0)
            depth = float(0.0)
            rise = wp.dot(view.up, r.direction)
            front = phase(march.g, -1.0)
            above = phase(march.g, rise)
            below = phase(march.g, -rise)
            while r.done < r.count:
                r = look(r, smoke)
                if r.x > 0.0:
                    depth = surface(depth, r, view, march.threshold)
                    tau = wp.vec2()
                    if wp.static(from_lattice):
                        last = wp.vec3(float(nodes.shape[0] - 1), float(nodes.shape[1] - 1), float(nodes.shape[2] - 1))
                        one = wp.vec3(1.0, 1.0, 1.0)
                        tau = between_nodes(nodes, wp.cw_div(wp.cw_mul(r.place + 0.5 * one, last), size + one))
                    else:
                        tau = _both_depths(smoke, r.place, view.up, march.step)
                    # The light from the front comes along the ray, through the smoke that the ray has passed.
                    light += 0.5 * front * r.t * r.t * absorbed(2.0 * r.x)
                    light += r.t * absorbed(r.x) * (above * wp.exp(-tau[0]) + below * wp.exp(-tau[1]))
                r = pass_step(r, march.cutoff)
            out[0, row, column] = light
            out[1, row, column] = r.t
            out[2, row, column] = depth

        return guide

    return _Kernels(lattice, make_guide(True), make_guide(False))


def lattice(medium: Medium, up: Sequence[float], step: float) -> wp.array:
    """Computes optical depths towards the top and the bottom at the nodes of a lattice.

    Args:
        medium: The smoke.
        up: Direction to the top, of length 1.
        step: Largest distance between nodes (at least a voxel is used) and longest step of their marches, in voxels.

    Returns:
        vec2 [A, B, C], to the top and to the bottom; the outermost nodes lie half a voxel outside the grid.
    """
    nodes = medium.buffer(nodes_along(medium.density.shape, step), wp.vec2)
    inputs = [medium.smoke, wp.vec3(*map(float, up)), step]
    wp.launch(guide_kernels(medium.smoke_type).lattice, nodes.shape, inputs, [nodes], device=medium.device)
    return nodes


def guide(medium: Medium, view: View, march: March, out: wp.array, *, shared: bool = True) -> None:
    """Computes a guiding map (algorithm 1): smoke lit from the front, top and bottom, its transparency and its depth.

    The paper's algorithm lacks the step h in a step's share of the light (line 9); here each step is integrated
    exactly. Steps are shortened so that a whole number of them fills a ray's way through the grid. The paper's side
    lights, along the cross product of the view and the world's z, would be to the left and right where z points up;
    ours are along the camera's own up and down.

    Args:
        medium: The smoke, of albedo 1.
        view: The camera, [H, W] pixels.
        march: Settings; its step is also that of the marches to the lights. The cutoff's error is at most the cutoff in
            transparency and 2.5 times the cutoff in light (for g = 0).
        out: float [3, H, W], written: scattered light under lights of irradiance 4 pi; transparency; distance from the
            camera to the first sample denser than the threshold, 0 if there is none.
        shared: Whether pixels share the marches to the top and the bottom, on a lattice with a node per step (per
            voxel for smaller steps); otherwise each sample marches to them.
    """
    kernels = guide_kernels(medium.smoke_type)
    if shared:
        nodes, kernel = lattice(medium, view.up, march.step), kernels.guide
    else:
        nodes, kernel = medium.buffer((0, 0, 0), wp.vec2), kernels.guide_marching
    wp.launch(kernel, out.shape[1:], [medium.smoke, nodes, view, parameters(march)], [out], device=medium.device)
