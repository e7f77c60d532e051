"""Six-way lightmaps by one march in large steps; pixels share the optical depths to the lights.

The lights of an orthographic camera follow its axes. The depths to the four lights from the sides are known at the
nodes of one lattice along these axes (`depth_lattice`). A camera ray runs along the lattice's third axis, keeps its
place in the other two, and interpolates between the nodes.

The other two lights need no march. The light from the front comes and returns along the ray, through exp(-2 tau):
(1 - T^2) / 2 in total, where T is the ray's transparency. The light from the back passes all smoke of the ray wherever
it is scattered: -T ln T. Both are exact for any step; only T has the error of its step.

Samples are shifted by interleaved gradient noise, so that a filter over the image, such as a network, removes most of
the noise. Read `lit` of `tests/reference/marching.py` first: one such light without shared work.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.smoke.depth_lattice import Lattice, add_up, make_lattice, spacing_of
from wlm_kernels.smoke.march import (
    BRICK,
    OPTIONS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    begin_jittered,
    emitted,
    look,
    parameters,
    pass_step,
    phase,
    require_orthographic,
    surface,
)
from wlm_kernels.smoke.settings import March

PLANES = ("right", "left", "top", "bottom", "front", "back", "transparency", "emission", "depth")
"""Planes of the result."""

DEPTH = PLANES.index("depth")


@wp.func
def _in_plane(nodes: wp.array4d[wp.vec2], i: int, j: int, k: int, fx: float, fy: float) -> wp.vec4:
    """Interpolates depths to the right, left, top and bottom bilinearly between the nodes of plane k."""
    sides = wp.vec4()
    for pair in range(2):
        a = wp.lerp(nodes[i, j, k, pair], nodes[i, j + 1, k, pair], fy)
        b = wp.lerp(nodes[i + 1, j, k, pair], nodes[i + 1, j + 1, k, pair], fy)
        c = wp.lerp(a, b, fx)
        sides[2 * pair] = c[0]
        sides[2 * pair + 1] = c[1]
    return sides


@functools.cache
def coarse_kernel(smoke_type: Any, hot: bool) -> wp.Kernel:
    """Builds (once) the kernel for densities of a type; `hot`: for smoke with a temperature."""

    @wp.kernel(module="unique", module_options=OPTIONS)
    def gather(
        # in:
        smoke: smoke_type,
        nodes: wp.array4d[wp.vec2],
        view: View,
        lattice: Lattice,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = begin_jittered(view, row, column, smoke, march)
        sides = wp.vec4()
        glow = float(0.0)
        depth = float(0.0)
        # All samples of the ray share its place in the lattice's first two axes.
        x = (wp.dot(r.origin - view.origin, view.right) - lattice.low[0]) / lattice.gap[0]
        y = (wp.dot(r.origin - view.origin, view.up) - lattice.low[1]) / lattice.gap[1]
        i = wp.clamp(int(x), 0, nodes.shape[0] - 2)
        j = wp.clamp(int(y), 0, nodes.shape[1] - 2)
        fx = wp.clamp(x - float(i), 0.0, 1.0)
        fy = wp.clamp(y - float(j), 0.0, 1.0)
        loaded = int(-1)  # the plane of nodes whose depths are in `near`
        near = wp.vec4()
        far = wp.vec4()
        while r.done < r.count:
            r = look(r, smoke)
            if wp.static(hot):
                glow += emitted(r, smoke)
            if r.x > 0.0:
                depth = surface(depth, r, view, march.threshold)
                z = (r.distance - lattice.low[2]) / lattice.gap[2]
                k = wp.clamp(int(z), 0, nodes.shape[2] - 2)
                if k != loaded:
                    near = _in_plane(nodes, i, j, k, fx, fy)
                    far = _in_plane(nodes, i, j, k + 1, fx, fy)
                    loaded = k
                tau = wp.lerp(near, far, wp.clamp(z - float(k), 0.0, 1.0))
                left = wp.vec4(wp.exp(-tau[0]), wp.exp(-tau[1]), wp.exp(-tau[2]), wp.exp(-tau[3]))
                sides += r.t * absorbed(r.x) * left
            r = pass_step(r, march.cutoff)
        across = wp.dot(view.right, r.direction)
        rise = wp.dot(view.up, r.direction)
        out[0, row, column] = phase(march.g, across) * sides[0]
        out[1, row, column] = phase(march.g, -across) * sides[1]
        out[2, row, column] = phase(march.g, rise) * sides[2]
        out[3, row, column] = phase(march.g, -rise) * sides[3]
        out[4, row, column] = 0.5 * phase(march.g, -1.0) * absorbed(2.0 * r.tau)
        out[5, row, column] = phase(march.g, 1.0) * r.t * r.tau
        out[6, row, column] = r.t
        out[7, row, column] = glow
        out[8, row, column] = depth

    return gather


def coarse_six_way(medium: Medium, view: View, march: March, out: wp.array) -> None:
    """Computes six-way lightmaps, transparency, emission and depth by one march in large steps.

    For steps shorter than a brick's edge, rays and marches to the lights skip empty bricks, which changes no result.

    Args:
        medium: The smoke, of albedo 1.
        view: An orthographic camera, [H, W] pixels.
        march: Settings. Nodes are at least a quarter of a voxel apart, and farther where there would be more than 2^28
            of them; a node takes 24 bytes. The jitter has 64 different seeds. The cutoff's error is below 1e-3 in every
            plane for the default cutoff.
        out: float [9, H, W], written: `PLANES`, each light of irradiance 4 pi.

    Raises:
        ValueError: The camera is in perspective.
    """
    require_orthographic(view, "six-way lightmaps")
    if march.step < BRICK:
        medium = medium.in_bricks()
    spacing, light_step = spacing_of(march)
    lattice, counts = make_lattice(medium.density.shape, (view.right, view.up, view.forward), spacing, view.origin)
    nodes = add_up(medium, lattice, counts, 2, light_step)
    kernel = coarse_kernel(medium.smoke_type, medium.temperature is not None)
    inputs = [medium.smoke, nodes, view, lattice, parameters(march)]
    wp.launch(kernel, out.shape[1:], inputs, [out], device=medium.device)
