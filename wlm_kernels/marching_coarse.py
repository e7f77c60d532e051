"""Six-way lightmaps by a march in large steps, with the ways to the lights shared: what a guiding map costs.

As in ``marching.guide``, the optical depths to the lights from the sides lie on a lattice with a node each step, and a
ray reads them between the nodes. The other two lights need no march. The light from the front comes along the ray and
goes back along it, which leaves exp(-2 tau) of it: (1 - T^2) / 2 in all, where T is the ray's transparency. The light
from the back passes all of the ray's smoke wherever it is scattered: -T ln T. Both are exact, whatever the steps.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.marching import (
    Empty,
    View,
    absorbed,
    clip,
    density_at,
    node_at,
    node_position,
    nodes_along,
    phase,
    plain_depth,
    ray,
    size_of,
    warp_memory,
)

__all__ = ["DEPTH", "PLANES", "coarse_kernels", "coarse_six_way"]

_OPTIONS = {"enable_backward": False}

PLANES = ("right", "left", "top", "bottom", "front", "back", "transparency", "emission", "depth")
"""Of the result."""

DEPTH = PLANES.index("depth")


@functools.cache
def coarse_kernels(dtype: Any, hot: bool):
    """Builds (once) the kernels for densities of a type; ``hot``: with a temperature of the same type."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def lattice(
        # in:
        density: wp.array3d[dtype],
        extinction: float,
        view: View,
        h: float,
        # out:
        nodes: wp.array3d[wp.vec4],
    ):
        a, b, c = wp.tid()
        p = node_position(nodes, size_of(density), a, b, c)
        nodes[a, b, c] = wp.vec4(
            plain_depth(density, p, view.right, extinction, h),
            plain_depth(density, p, -view.right, extinction, h),
            plain_depth(density, p, view.up, extinction, h),
            plain_depth(density, p, -view.up, extinction, h),
        )

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def gather(
        # in:
        density: wp.array3d[dtype],
        temperature: wp.array3d[dtype],
        nodes: wp.array3d[wp.vec4],
        extinction: float,
        emission: float,
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
        span = clip(size_of(density), r.origin, r.direction)
        first = wp.max(span[0], 0.0)
        sides = wp.vec4()
        glow = float(0.0)
        through = float(0.0)
        t = float(1.0)
        depth = float(0.0)
        if span[1] > first:
            steps = int(wp.ceil((span[1] - first) / h))
            dt = (span[1] - first) / float(steps)
            random = wp.rand_init(seed, row * view.width + column)
            offset = 0.5 + jitter * (wp.randf(random) - 0.5)
            for n in range(steps):
                s = first + (float(n) + offset) * dt
                p = r.origin + s * r.direction
                sigma = extinction * density_at(density, p)
                if wp.static(hot):
                    # The mean of what is left along the step: fire without smoke shines too.
                    x = sigma * dt
                    share = wp.where(x > 1.0e-6, absorbed(x) / wp.max(x, 1.0e-6), 1.0)
                    glow += t * share * emission * dt * density_at(temperature, p)
                if sigma > 0.0:
                    if depth == 0.0 and sigma > threshold:
                        depth = (s + lead) * unit
                    tau = node_at(nodes, p, size_of(density))
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

    return lattice, gather


def coarse_six_way(
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
    temperature=None,
    emission: float = 0.0,
    cutoff: float = 1e-4,
    unit: float = 1.0,
    lead: float = 0.0,
    empty: Empty | None = None,
) -> None:
    """Six-way lightmaps, transparency, emission and depth by one march in large steps.

    Args:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        seen: The camera, [H, W] pixels, orthographic.
        out: float [9, H, W], written: ``PLANES``, each light of irradiance 4 pi, an albedo of 1.
        step: The longest step, in voxels, along rays and to the lights; nodes are as far apart, and a voxel at least.
        jitter, seed, threshold, cutoff, unit, lead: As for ``marching.guide``. What a ray that ends at the cutoff would
            have found behind it is less than 1e-3 in every plane.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        temperature: As the density, of its shape; None: nothing emits.
        emission: Light given off per voxel of way where the temperature is 1.
        empty: As for ``marching.occupied``.

    Raises:
        ValueError: The camera is in perspective.
    """
    if seen.perspective:
        raise ValueError("six-way lightmaps need an orthographic camera: their lights follow its axes")
    lattice, gather = coarse_kernels(density.dtype, temperature is not None)
    nodes = (empty or warp_memory(density.device))(nodes_along(density.shape, step), wp.vec4)
    inputs = [density, extinction, seen, step]
    wp.launch(lattice, nodes.shape, inputs=inputs, outputs=[nodes], device=density.device)
    hot = density if temperature is None else temperature
    inputs = [density, hot, nodes, extinction, emission, seen, step, jitter, seed, threshold, g, cutoff, unit, lead]
    wp.launch(gather, out.shape[1:], inputs=inputs, outputs=[out], device=density.device)
