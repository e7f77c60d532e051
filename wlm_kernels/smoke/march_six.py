"""Six-way lightmaps without noise: single scattering in a density grid (neural-six-way-lightmaps, eq. 1 to 4).

Single scattering needs no random paths: it is an integral, along the pixel's ray, of the arriving light, itself an
integral. For an orthographic camera, whose axes the six lights follow, no sample has to march to its lights. The
samples of all rays at one distance form a plane of pixels in which the light from the right comes along the rows and
the light from the top along the columns, so that the optical depths of a whole row are one running sum. The light from
the front and the back comes along the ray itself, where it is integrated in closed form.

The planes are processed in slabs, which bounds the buffers. Units and sampling are those of `march`. Read `six_way` of
`tests/reference/marching.py` first: the same samples without shared work.
"""

import math
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import (
    OPTIONS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    box_of,
    clip,
    density_at,
    for_smoke,
    mean_transparency,
    parameters,
    phase,
    ray,
    require_orthographic,
    sample,
)
from wlm_kernels.smoke.settings import March

TRANSPARENCY = 6
EMISSION = 7
"""Planes of the result after the lights from the right, left, top, bottom, front and back."""

_SLAB_BYTES = 2**28  # memory of the four optical depths of a slab


@wp.struct
class _Slab:
    """A slab: `planes` planes of samples, parallel to the image; plane n is `start + (n + 1/2) gap` voxels away."""

    start: float
    gap: float
    planes: int


@wp.func
def _thickness(smoke: Any, span: wp.vec2, p: wp.vec3, direction: wp.vec3, s: float, h: float) -> float:
    """Computes the optical depth of a step of length h, sampled at distance s; 0 if s is outside the range `span`."""
    if s > span[0] and s < span[1]:
        return smoke.extinction * sample(smoke, p + s * direction) * h
    return 0.0


@for_smoke
def _column(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        slab: _Slab,
        # out:
        tau: wp.array2d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        span = clip(box_of(smoke), r.origin, r.direction)
        total = float(0.0)
        for n in range(slab.planes):
            s = slab.start + (float(n) + 0.5) * slab.gap
            total += _thickness(smoke, span, r.origin, r.direction, s, slab.gap)
        tau[row, col] = total

    return kernel


@for_smoke
def _sweep(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        slab: _Slab,
        along: int,
        parts: int,
        # out:
        tau: wp.array3d[float],
    ):
        """Sums optical depths towards a side (0 right, 1 left, 2 top, 3 bottom), in one row or column per thread."""
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
        # Distances towards the light; the pixels lie at (k + 1/2 - count / 2) pitch, k falling.
        span = clip(box_of(smoke), base, toward)
        dt = view.pitch / float(parts)
        total = float(0.0)
        top = (0.5 * float(count) - 0.5) * view.pitch
        # The first part runs from the border of the smoke to the first pixel.
        if span[1] > top and span[1] > span[0]:
            steps = int(wp.ceil((span[1] - top) / dt))
            inside = steps - int(wp.max(span[0] - top, 0.0) / dt)
            for n in range(inside):
                total += _thickness(smoke, span, base, toward, top + (float(steps - n) - 0.5) * dt, dt)
        for k in range(count):
            if k > 0:
                middle = top - (float(k) - 0.5) * view.pitch
                if middle + 0.5 * view.pitch > span[0] and middle - 0.5 * view.pitch < span[1]:
                    for n in range(parts):
                        d = middle + (0.5 - (float(n) + 0.5) / float(parts)) * view.pitch
                        total += _thickness(smoke, span, base, toward, d, dt)
            if along == 0:
                tau[plane, line, count - 1 - k] = total
            elif along == 1:
                tau[plane, line, k] = total
            elif along == 2:
                tau[plane, k, line] = total
            else:
                tau[plane, count - 1 - k, line] = total

    return kernel


@for_smoke
def _gather(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        slab: _Slab,
        march: MarchParameters,
        sides: wp.array4d[float],
        behind: wp.array2d[float],
        ahead: wp.array2d[float],
        # in and out:
        passed: wp.array2d[float],
        out: wp.array3d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        span = clip(box_of(smoke), r.origin, r.direction)
        side = phase(march.g, 0.0)
        front = phase(march.g, -1.0) * wp.exp(-behind[row, col])
        back = phase(march.g, 1.0) * wp.exp(-ahead[row, col])
        tau = passed[row, col]
        a = wp.vec4()
        b = wp.vec3()
        for n in range(slab.planes):
            s = slab.start + (float(n) + 0.5) * slab.gap
            if s > span[0] and s < span[1]:
                p = r.origin + s * r.direction
                x = smoke.extinction * sample(smoke, p) * slab.gap
                t = wp.exp(-tau)
                if x > 0.0:
                    left = wp.vec4(
                        wp.exp(-sides[0, n, row, col]),
                        wp.exp(-sides[1, n, row, col]),
                        wp.exp(-sides[2, n, row, col]),
                        wp.exp(-sides[3, n, row, col]),
                    )
                    a += t * absorbed(x) * side * left
                    # The integral of sigma exp(-2 sigma s) over the step; for the back that of sigma alone, since the
                    # ways to the camera and to the light add up to the whole ray.
                    b += wp.vec3(front * t * t * 0.5 * absorbed(2.0 * x), back * x, 0.0)
                if smoke.emission > 0.0:
                    hot = smoke.emission * density_at(smoke.temperature, smoke, p) * slab.gap
                    b += wp.vec3(0.0, 0.0, hot * t * mean_transparency(x))
                tau += x
        passed[row, col] = tau
        for c in range(4):
            out[c, row, col] = out[c, row, col] + a[c]
        out[4, row, col] = out[4, row, col] + b[0]
        out[5, row, col] = out[5, row, col] + b[1]
        out[TRANSPARENCY, row, col] = wp.exp(-tau)
        out[EMISSION, row, col] = out[EMISSION, row, col] + b[2]

    return kernel


def _extent(shape, origin, direction) -> tuple[float, float]:
    """Returns the least and the greatest distance of the grid's corners from `origin` along a direction, in voxels."""
    start = sum(-0.5 * d - o * d for o, d in zip(origin, direction, strict=True))
    spans = [(n + 1) * d for n, d in zip(shape, direction, strict=True)]
    return start + sum(min(s, 0.0) for s in spans), start + sum(max(s, 0.0) for s in spans)


def six_way(medium: Medium, view: View, march: March, out: wp.array) -> None:
    """Computes the six lightmaps, the transparency and the emission (eq. 4).

    Smoke behind the camera's plane is not visible but shadows the light from the front; so does smoke outside the
    image.

    Args:
        medium: The smoke, of albedo 1.
        view: An orthographic camera, [H, W] pixels.
        march: Only its g and its step are used, the step both along rays and towards the lights; samples lie in the
            middles of the steps. The error falls with the square of the step where the density is smooth.
        out: float [8, H, W], written: light that reaches the camera from smoke lit from the right, left, top, bottom,
            front and back, each light of irradiance 4 pi; the transparency; the emission.
    """
    require_orthographic(view, "six-way lightmaps")
    medium = medium.in_bricks()
    height, width = view.height, view.width
    out.zero_()
    near, far = _extent(medium.shape, view.origin, view.forward)
    start = max(near, 0.0)
    passed, behind, ahead = (medium.buffer((height, width), float) for _ in range(3))
    passed.zero_()

    def column(first: float, last: float, tau: wp.array) -> tuple[float, int]:
        planes = max(math.ceil((last - first) / march.step), 0)
        gap = (last - first) / max(planes, 1)
        _column(medium, (height, width), [view, _slab(first, gap, planes)], [tau])
        return gap, planes

    column(near, min(far, 0.0), behind)
    gap, planes = column(start, far, ahead)
    parts = max(1, math.ceil(view.pitch / march.step))
    capacity = max(1, min(planes, _SLAB_BYTES // (16 * height * width)))
    sides = medium.buffer((4, capacity, height, width), float)
    # The loop runs once even if there is no plane, to write the transparency.
    for first in range(0, max(planes, 1), capacity):
        count = min(capacity, planes - first)
        slab = _slab(start + first * gap, gap, count)
        for along, lines in enumerate((height, height, width, width)):
            _sweep(medium, (count, lines), [view, slab, along, parts], [sides[along]])
        inputs = [view, slab, parameters(march), sides, behind, ahead]
        _gather(medium, (height, width), inputs, [passed, out])


def _slab(start: float, gap: float, planes: int) -> _Slab:
    slab = _Slab()
    slab.start, slab.gap, slab.planes = start, gap, planes
    return slab
