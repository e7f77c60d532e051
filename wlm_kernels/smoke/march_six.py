"""Six-way lightmaps without noise: single scattering in a grid of density (neural-six-way-lightmaps, eq. 1 to 4).

One bounce needs no random paths: it is an integral along the pixel's ray of what the light leaves there, itself an
integral. For an orthographic camera, whose axes the six lights follow, neither is marched for each other. The rays'
samples at one depth make a plane of pixels in which the light from the right comes along the rows and that from the
top along the columns, so that the optical depths of a whole row are one running sum. The light from the front and
the back comes along the ray itself, where it is integrated in closed form.

The planes are worked off in slabs of as many as the buffers hold. Units and sampling are those of ``marching``.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    Empty,
    View,
    absorbed,
    clip,
    density_at,
    occupied,
    optical_depth,
    phase,
    ray,
    size_of,
    skipping_at,
    steps_along,
    warp_memory,
)

__all__ = ["EMISSION", "TRANSPARENCY", "lit", "six_kernels", "six_way"]

_OPTIONS = {"enable_backward": False}

TRANSPARENCY = 6
EMISSION = 7
"""Planes of the result behind the lights from the right, left, top, bottom, front and back."""

_SLAB_BYTES = 2**28  # of the four optical depths of a slab


@dataclass(frozen=True)
class _Kernels:
    """Of one type of density."""

    column: Any
    sweep: Any
    gather: Any
    lit: Any


@functools.cache
def six_kernels(dtype: Any) -> _Kernels:
    """Builds (once) the kernels for densities of a type, ``wp.float32`` or ``wp.float16``."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def column(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        view: View,
        start: float,
        dz: float,
        planes: int,
        # out:
        tau: wp.array2d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        span = clip(size_of(density), r.origin, r.direction)
        total = float(0.0)
        for n in range(planes):
            s = start + (float(n) + 0.5) * dz
            if s > span[0] and s < span[1]:
                total += extinction * skipping_at(density, bricks, r.origin + s * r.direction) * dz
        tau[row, col] = total

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def sweep(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        view: View,
        start: float,
        dz: float,
        along: int,
        parts: int,
        # out:
        tau: wp.array3d[float],
    ):
        """Optical depths to a side: along 0 right, 1 left, 2 top, 3 bottom; a thread a row or column of a plane."""
        plane, line = wp.tid()
        s = start + (float(plane) + 0.5) * dz
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
                    total += extinction * skipping_at(density, bricks, base + d * toward) * dt
        for k in range(count):
            if k > 0:
                middle = top - (float(k) - 0.5) * view.pitch
                if middle + 0.5 * view.pitch > span[0] and middle - 0.5 * view.pitch < span[1]:
                    for n in range(parts):
                        d = middle + (0.5 - (float(n) + 0.5) / float(parts)) * view.pitch
                        if d > span[0] and d < span[1]:
                            total += extinction * skipping_at(density, bricks, base + d * toward) * dt
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
        start: float,
        dz: float,
        planes: int,
        g: float,
        right: wp.array3d[float],
        left: wp.array3d[float],
        top: wp.array3d[float],
        bottom: wp.array3d[float],
        behind: wp.array2d[float],
        ahead: wp.array2d[float],
        # in and out:
        passed: wp.array2d[float],
        out: wp.array3d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        size = size_of(density)
        span = clip(size, r.origin, r.direction)
        side = phase(g, 0.0)
        front = phase(g, -1.0) * wp.exp(-behind[row, col])
        back = phase(g, 1.0) * wp.exp(-ahead[row, col])
        tau = passed[row, col]
        a = wp.vec4()
        b = wp.vec3()
        for n in range(planes):
            s = start + (float(n) + 0.5) * dz
            if s > span[0] and s < span[1]:
                p = r.origin + s * r.direction
                x = extinction * skipping_at(density, bricks, p) * dz
                t = wp.exp(-tau)
                share = t * absorbed(x)
                if x > 0.0:
                    a += (
                        share
                        * side
                        * wp.vec4(
                            wp.exp(-right[n, row, col]),
                            wp.exp(-left[n, row, col]),
                            wp.exp(-top[n, row, col]),
                            wp.exp(-bottom[n, row, col]),
                        )
                    )
                    # sigma exp(-2 sigma s) over the step; and to the back, where T and the light's even out, sigma.
                    b += wp.vec3(front * t * t * 0.5 * absorbed(2.0 * x), back * x, 0.0)
                if emission > 0.0:
                    hot = emission * density_at(temperature, p) * dz
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
        h: float,
        g: float,
        # out:
        out: wp.array2d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        steps = steps_along(size_of(density), r.origin, r.direction, h)
        light = float(0.0)
        tau = float(0.0)
        for n in range(steps.count):
            p = r.origin + (steps.first + (float(n) + 0.5) * steps.length) * r.direction
            x = extinction * skipping_at(density, bricks, p) * steps.length
            if x > 0.0:
                other = optical_depth(density, bricks, p, toward, extinction, h)
                light += wp.exp(-tau - other) * absorbed(x)
                tau += x
        out[row, col] = light * phase(g, wp.dot(toward, r.direction))

    return _Kernels(column, sweep, gather, lit)


def _extent(shape, origin, direction) -> tuple[float, float]:
    """Least and greatest distance of the smoke's corners along a direction."""
    start = sum(-0.5 * d - o * d for o, d in zip(origin, direction, strict=True))
    spans = [(n + 1) * d for n, d in zip(shape, direction, strict=True)]
    return start + sum(min(s, 0.0) for s in spans), start + sum(max(s, 0.0) for s in spans)


def six_way(
    density,
    extinction: float,
    seen: View,
    out,
    *,
    step: float = 0.5,
    g: float = 0.0,
    temperature=None,
    emission: float = 0.0,
    empty: Empty | None = None,
) -> None:
    """The six lightmaps, the transparency and the emission of smoke of albedo 1 (eq. 4).

    The camera's plane cuts off what lies behind it: that isn't seen, yet keeps light from the front away. Smoke outside
    the image, to the sides, does so too.

    Args:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        seen: An orthographic camera, [H, W] pixels. Pixel centres alone are looked at.
        out: float [8, H, W], written: the light that reaches the camera from smoke lit from the right, left, top,
            bottom, front and back, each light of irradiance 4 pi; the transparency; the emission.
        step: The longest step, in voxels, along rays and to the lights. The error falls with its square where the
            density is smooth.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        temperature: As the density, of its shape; None: nothing emits.
        emission: Light given off per voxel of way where the temperature is 1.
        empty: As for ``marching.occupied``.

    Raises:
        ValueError: The camera is in perspective.
    """
    if seen.perspective:
        raise ValueError("six-way lightmaps need an orthographic camera: their lights follow its axes")
    device = density.device
    height, width = seen.height, seen.width
    kernels = six_kernels(density.dtype)
    empty = empty or warp_memory(device)
    bricks = occupied(density, empty)
    out.zero_()
    near, far = _extent(density.shape, seen.origin, seen.forward)
    start = max(near, 0.0)
    behind, ahead, passed = (empty((height, width), float) for _ in range(3))
    for plane in (behind, ahead, passed):
        plane.zero_()
    common = [density, bricks, extinction, seen]

    def columns(first: float, last: float, tau) -> tuple[float, int]:
        planes = max(math.ceil((last - first) / step), 0)
        dz = (last - first) / max(planes, 1)
        inputs = [*common, first, dz, planes]
        wp.launch(kernels.column, (height, width), inputs=inputs, outputs=[tau], device=device)
        return dz, planes

    columns(near, min(far, 0.0), behind)
    dz, planes = columns(start, far, ahead)
    parts = max(1, math.ceil(seen.pitch / step))
    slab = max(1, min(planes, _SLAB_BYTES // (16 * height * width)))
    sides = [empty((slab, height, width), float) for _ in range(4)]
    hot = density if temperature is None else temperature
    given = 0.0 if temperature is None else emission
    # Once even without a plane, for the transparency.
    for first in range(0, max(planes, 1), slab):
        count = min(slab, planes - first)
        at = start + first * dz
        for along, tau in enumerate(sides):
            lines = height if along < 2 else width
            inputs = [*common, at, dz, along, parts]
            wp.launch(kernels.sweep, (count, lines), inputs=inputs, outputs=[tau], device=device)
        inputs = [density, hot, bricks, extinction, given, seen, at, dz, count, g, *sides, behind, ahead]
        wp.launch(kernels.gather, (height, width), inputs=inputs, outputs=[passed, out], device=device)


def lit(
    density,
    extinction: float,
    seen: View,
    toward,
    out,
    *,
    step: float = 0.5,
    g: float = 0.0,
    empty: Empty | None = None,
) -> None:
    """Smoke under one light from any direction: every sample of a ray marches to it, with nothing shared.

    What the six lightmaps approximate for a light between their axes (eq. 5), and a check of them along these.

    Args:
        density: float or half [X, Y, Z].
        extinction: Per voxel, of density 1.
        seen: The camera, [H, W] pixels.
        toward: Three numbers, the direction to the light, of length 1; its irradiance is 4 pi.
        out: float [H, W], written.
        step: The longest step, in voxels, along rays and to the light.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        empty: As for ``marching.occupied``.
    """
    inputs = [density, occupied(density, empty), extinction, seen, wp.vec3(*map(float, toward)), step, g]
    wp.launch(six_kernels(density.dtype).lit, out.shape, inputs=inputs, outputs=[out], device=density.device)
