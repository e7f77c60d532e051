"""Single scattering under lights from any direction and under point lights.

Each light has a lattice of optical depths (`depth_lattice`), which all pixels share. A camera ray, orthographic or in
perspective, interpolates depths at its samples. Read `lit` of `tests/reference/marching.py` first: one such light
without shared work.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.smoke.depth_lattice import Lattice, axis, depths_at
from wlm_kernels.smoke.march import (
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
    surface,
)
from wlm_kernels.smoke.settings import March

PLANES = ("transparency", "emission", "depth")
"""Planes that `unlit` writes."""


@dataclass(frozen=True)
class _Kernels:
    gather: wp.Kernel
    unlit: wp.Kernel


@functools.cache
def light_kernels(smoke_type: Any) -> _Kernels:
    """Builds (once) the kernels for a type of smoke, `Medium.smoke_type`."""

    @wp.kernel(module="unique", module_options=OPTIONS)
    def gather(
        # in:
        smoke: smoke_type,
        nodes: wp.array3d[wp.vec2],
        view: View,
        lattice: Lattice,
        march: MarchParameters,
        shadow: float,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = begin_jittered(view, row, column, smoke, march)
        light = wp.vec2()
        cosine = wp.dot(axis(lattice, 0), r.direction)
        forth = phase(march.g, cosine)
        back = phase(march.g, -cosine)
        while r.done < r.count:
            r = look(r, smoke)
            if r.x > 0.0:
                depths = shadow * depths_at(nodes, lattice, r.place)
                share = r.t * absorbed(r.x)
                if lattice.point == 0:
                    light += share * wp.vec2(forth * wp.exp(-depths[0]), back * wp.exp(-depths[1]))
                else:
                    way = lattice.place - r.place
                    # Closer than half a step a sample would represent far more light than its step receives.
                    away = wp.max(wp.length(way), wp.max(lattice.radius, 0.5 * r.length))
                    share = share * phase(march.g, wp.dot(wp.normalize(way), r.direction))
                    light += wp.vec2(share * wp.exp(-depths[0]) / (away * away), 0.0)
            r = pass_step(r, march.cutoff)
        out[0, row, column] = light[0]
        if lattice.point == 0:
            out[1, row, column] = light[1]

    @wp.kernel(module="unique", module_options=OPTIONS)
    def unlit(
        # in:
        smoke: smoke_type,
        view: View,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        row, column = wp.tid()
        r = begin_jittered(view, row, column, smoke, march)
        glow = float(0.0)
        depth = float(0.0)
        while r.done < r.count:
            r = look(r, smoke)
            if smoke.emission > 0.0:
                glow += emitted(r, smoke)
            depth = surface(depth, r, view, march.threshold)
            r = pass_step(r, march.cutoff)
        out[0, row, column] = r.t
        out[1, row, column] = glow
        out[2, row, column] = depth

    return _Kernels(gather, unlit)


def light(
    medium: Medium, view: View, depths: tuple[Lattice, wp.array], march: March, shadow: float, out: wp.array
) -> None:
    """Computes smoke of albedo 1 under a light and under the opposite light, or under a point light.

    Args:
        medium: The smoke.
        view: The camera, [H, W] pixels.
        depths: Result of `depth_lattice.reach`.
        march: Settings.
        shadow: Ratio of extinction towards the light to extinction along the camera's rays; 1 is physical.
        out: float [2, H, W], written: light scattered once, of irradiance 4 pi, from the light and from the opposite
            light. For a point light [1, H, W]: its irradiance is 4 pi at a distance of one voxel.
    """
    lattice, nodes = depths
    inputs = [medium.smoke, nodes, view, lattice, parameters(march), shadow]
    wp.launch(light_kernels(medium.smoke_type).gather, out.shape[1:], inputs, [out], device=medium.device)


def unlit(medium: Medium, view: View, march: March, out: wp.array) -> None:
    """Computes a camera's view of unlit smoke: `PLANES`, float [3, H, W], written; arguments as `light`."""
    inputs = [medium.smoke, view, parameters(march)]
    wp.launch(light_kernels(medium.smoke_type).unlit, out.shape[1:], inputs, [out], device=medium.device)
