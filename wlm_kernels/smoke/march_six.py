"""Six-way lightmaps without noise: single scattering in a grid of density (neural-six-way-lightmaps, eq. 1 to 4).

One bounce needs no random paths: it is an integral along the pixel's ray of the light that arrives there, itself an
integral. For an orthographic camera, whose axes the six lights follow, no sample has to march to its lights. The rays'
samples at one depth make a plane of pixels in which the light from the right comes along the rows and that from the
top along the columns, so that the optical depths of a whole row are one running sum. The light from the front and
the back comes along the ray itself, where it is integrated in closed form.

The planes are worked off in slabs of as many as the buffers hold. Units and sampling are those of `march`.
Read first: `six_way` of `tests/reference/marching.py`, the same samples with nothing shared.
"""

import functools
import math
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
    occupied,
    optical_depth,
    parameters,
    phase,
    point_on,
    ray,
    sample,
    size_of,
)
from wlm_kernels.smoke.settings import March

_OPTIONS = {"enable_backward": False}

TRANSPARENCY = 6
EMISSION = 7
"""Planes of the result behind the lights from the right, left, top, bottom, front and back."""

_SLAB_BYTES = 2**28  # of the four optical depths of a slab


@wp.struct
class _Slab:
    """Planes of samples across the view, `gap` apart; sample n lies at distance `start + (n + 1/2) gap`."""

    start: float
    gap: float
    planes: int


@wp.struct
class _Depths:
    """Optical depths of a slab's samples to each light, [planes, H, W], and of the rays before and behind the camera's
    plane, [H, W]."""

    right: wp.array3d[float]
    left: wp.array3d[float]
    top: wp.array3d[float]
    bottom: wp.array3d[float]
    behind: wp.array2d[float]
    ahead: wp.array2d[float]


@dataclass(frozen=True)
class _Kernels:
    """Of one type of density."""

    column: wp.Kernel
    sweep: wp.Kernel
    gather: wp.Kernel
    lit: wp.Kernel


@functools.cache
def six_kernels(dtype: Any) -> _Kernels:
    """Builds (once) the kernels for densities of a type, `wp.float32` or `wp.float16`."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def column(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        view: View,
        slab: _Slab,
        # out:
        tau: wp.array2d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        span = clip(size_of(density), r.origin, r.direction)
        total = float(0.0)
        for n in range(slab.planes):
            s = slab.start + (float(n) + 0.5) * slab.gap
            if s > span[0] and s < span[1]:
                total += extinction * sample(density, bricks, r.origin + s * r.direction) * slab.gap
        tau[row, col] = total

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def sweep(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        view: View,
        slab: _Slab,
        along: int,
        parts: int,
        # out:
        tau: wp.array3d[float],
    ):
        """Optical depths to a side: along 0 right, 1 left, 2 top, 3 bottom; one row or column of a plane per thread."""
        plane, line = wp.tid()
        s = slab.start + (float(plane) + 0.5) * slab.gap
        u = (float(line) + 0.5 - 0.5 * float(view.width)) * view.pitch
        v = (0.5 * float(view.height) - float(line) - 0.5) * view.pitch
        base = view.origin + s * view.forward
        toward = view.right
        count = view.width
        if along < 2:
            base += v * view.up
        else:
            base += u * view.right
            toward = view.up
            count = view.height
        if along == 1 or along == 3:
            toward = -toward
        # Distances towards the light, with the pixels at (k + 1/2 - count / 2) pitch, k falling.
        span = clip(size_of(density), base, toward)
        dt = view.pitch / float(parts)
        total = float(0.0)
        top = (0.5 * float(count) - 0.5) * view.pitch
        # From where the light enters to the first pixel.
        if span[1] > top and span[1] > span[0]:
            steps = int(wp.ceil((span[1] - top) / dt))
            inside = steps - int(wp.max(span[0] - top, 0.0) / dt)
            for n in range(inside):
                d = top + (float(steps - n) - 0.5) * dt
                if d > span[0] and d < span[1]:
                    total += extinction * sample(density, bricks, base + d * toward) * dt
        for k in range(count):
            if k > 0:
                middle = top - (float(k) - 0.5) * view.pitch
                if middle + 0.5 * view.pitch > span[0] and middle - 0.5 * view.pitch < span[1]:
                    for n in range(parts):
                        d = middle + (0.5 - (float(n) + 0.5) / float(parts)) * view.pitch
                        if d > span[0] and d < span[1]:
                            total += extinction * sample(density, bricks, base + d * toward) * dt
            if along == 0:
                tau[plane, line, count - 1 - k] = total
            elif along == 1:
                tau[plane, line, k] = total
            elif along == 2:
                tau[plane, k, line] = total
            else:
                tau[plane, count - 1 - k, line] = total

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def gather(
        # in:
        density: wp.array3d[dtype],
        temperature: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        emission: float,
        view: View,
        slab: _Slab,
        march: MarchParameters,
        depths: _Depths,
        # in and out:
        passed: wp.array2d[float],
        out: wp.array3d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        size = size_of(density)
        span = clip(size, r.origin, r.direction)
        side = phase(march.g, 0.0)
        front = phase(march.g, -1.0) * wp.exp(-depths.behind[row, col])
        back = phase(march.g, 1.0) * wp.exp(-depths.ahead[row, col])
        tau = passed[row, col]
        a = wp.vec4()
        b = wp.vec3()
        for n in range(slab.planes):
            s = slab.start + (float(n) + 0.5) * slab.gap
            if s > span[0] and s < span[1]:
                p = r.origin + s * r.direction
                x = extinction * sample(density, bricks, p) * slab.gap
                t = wp.exp(-tau)
                share = t * absorbed(x)
                if x > 0.0:
                    a += (
                        share
                        * side
                        * wp.vec4(
                            wp.exp(-depths.right[n, row, col]),
                            wp.exp(-depths.left[n, row, col]),
                            wp.exp(-depths.top[n, row, col]),
                            wp.exp(-depths.bottom[n, row, col]),
                        )
                    )
                    # The integral of sigma exp(-2 sigma s) over the step; for the back that of sigma alone, since the
                    # ways to the camera and to the light make up the whole ray.
                    b += wp.vec3(front * t * t * 0.5 * absorbed(2.0 * x), back * x, 0.0)
                if emission > 0.0:
                    hot = emission * density_at(temperature, p) * slab.gap
                    if x > 0.0:
                        b += wp.vec3(0.0, 0.0, hot * share / x)
                    else:
                        b += wp.vec3(0.0, 0.0, hot * t)
                tau += x
        passed[row, col] = tau
        for c in range(4):
            out[c, row, col] = out[c, row, col] + a[c]
        out[4, row, col] = out[4, row, col] + b[0]
        out[5, row, col] = out[5, row, col] + b[1]
        out[TRANSPARENCY, row, col] = wp.exp(-tau)
        out[EMISSION, row, col] = out[EMISSION, row, col] + b[2]

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def lit(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        view: View,
        toward: wp.vec3,
        march: MarchParameters,
        # out:
        out: wp.array2d[float],
    ):
        row, col = wp.tid()
        r = marched_ray(view, row, col, size_of(density), march.step)
        light = float(0.0)
        tau = float(0.0)
        for n in range(r.count):
            p = point_on(r, n, 0.5)
            x = extinction * sample(density, bricks, p) * r.length
            if x > 0.0:
                shadow = optical_depth(density, bricks, p, toward, extinction, march.step)
                light += wp.exp(-tau - shadow) * absorbed(x)
                tau += x
        out[row, col] = light * phase(march.g, wp.dot(toward, r.direction))

    return _Kernels(column, sweep, gather, lit)


def _extent(shape, origin, direction) -> tuple[float, float]:
    """Least and greatest distance of the smoke's corners along a direction."""
    start = sum(-0.5 * d - o * d for o, d in zip(origin, direction, strict=True))
    spans = [(n + 1) * d for n, d in zip(shape, direction, strict=True)]
    return start + sum(min(s, 0.0) for s in spans), start + sum(max(s, 0.0) for s in spans)


def six_way(medium: Medium, view: View, march: March, out: wp.array) -> None:
    """The six lightmaps, the transparency and the emission (eq. 4).

    Smoke behind the camera's plane isn't seen, yet takes light from the front; so does smoke outside the image.

    Args:
        medium: The smoke, of albedo 1.
        view: An orthographic camera, [H, W] pixels. Rays go through pixel centres.
        march: Its step, along rays and to the lights, and g; samples lie in their steps' middles. The error falls with
            the step's square where the density is smooth.
        out: float [8, H, W], written: the light that reaches the camera from smoke lit from the right, left, top,
            bottom, front and back, each light of irradiance 4 pi; the transparency; the emission.

    Raises:
        ValueError: The camera is in perspective.
    """
    if view.perspective:
        raise ValueError("six-way lightmaps need an orthographic camera: their lights follow its axes")
    density, extinction = medium.density, medium.extinction
    device = density.device
    height, width = view.height, view.width
    kernels = six_kernels(density.dtype)
    bricks = occupied(medium)
    out.zero_()
    near, far = _extent(density.shape, view.origin, view.forward)
    start = max(near, 0.0)
    depths = _Depths()
    passed, depths.behind, depths.ahead = (medium.buffer((height, width), float) for _ in range(3))
    for plane in (passed, depths.behind, depths.ahead):
        plane.zero_()
    common = [density, bricks, extinction, view]

    def column(first: float, last: float, tau: wp.array) -> tuple[float, int]:
        planes = max(math.ceil((last - first) / march.step), 0)
        gap = (last - first) / max(planes, 1)
        inputs = [*common, _slab(first, gap, planes)]
        wp.launch(kernels.column, (height, width), inputs=inputs, outputs=[tau], device=device)
        return gap, planes

    column(near, min(far, 0.0), depths.behind)
    gap, planes = column(start, far, depths.ahead)
    parts = max(1, math.ceil(view.pitch / march.step))
    capacity = max(1, min(planes, _SLAB_BYTES // (16 * height * width)))
    sides = [medium.buffer((capacity, height, width), float) for _ in range(4)]
    depths.right, depths.left, depths.top, depths.bottom = sides
    temperature, emission = medium.glow
    # Once even without a plane, for the transparency.
    for first in range(0, max(planes, 1), capacity):
        count = min(capacity, planes - first)
        slab = _slab(start + first * gap, gap, count)
        for along, tau in enumerate(sides):
            lines = height if along < 2 else width
            inputs = [*common, slab, along, parts]
            wp.launch(kernels.sweep, (count, lines), inputs=inputs, outputs=[tau], device=device)
        inputs = [density, temperature, bricks, extinction, emission, view, slab, parameters(march), depths]
        wp.launch(kernels.gather, (height, width), inputs=inputs, outputs=[passed, out], device=device)


def _slab(start: float, gap: float, planes: int) -> _Slab:
    slab = _Slab()
    slab.start, slab.gap, slab.planes = start, gap, planes
    return slab


def lit(medium: Medium, view: View, toward: Sequence[float], march: March, out: wp.array) -> None:
    """Smoke under one light from any direction: every sample of a ray marches to it, with nothing shared.

    The six lightmaps approximate it for a light between their axes (eq. 5); along these it is a check of them.

    Args:
        medium: The smoke, of albedo 1.
        view: The camera, [H, W] pixels.
        toward: The direction to the light, of length 1; its irradiance is 4 pi.
        march: Its step, along rays and to the light, and g; samples lie in their steps' middles.
        out: float [H, W], written.
    """
    density, direction = medium.density, wp.vec3(*map(float, toward))
    inputs = [density, occupied(medium), medium.extinction, view, direction, parameters(march)]
    wp.launch(six_kernels(density.dtype).lit, out.shape, inputs=inputs, outputs=[out], device=density.device)
