"""Six-way lightmaps without noise: single scattering in a density grid (neural-six-way-lightmaps, eq. 1 to 4).

Single scattering needs no random paths: it is an integral, along the pixel's ray, of the arriving light, itself an
integral. For an orthographic camera, whose axes the six lights follow, no sample has to march to its lights. The
samples of all rays at one distance form a plane of pixels in which the light from the right comes along the rows and
the light from the top along the columns, so that the optical depths of a whole row are two running sums. The light from
the front and the back comes along the ray itself, where it is integrated in closed form.

The density is smooth but for bends where a line passes the centres of voxels, and there the error of a step grows with
its square. A first march along the rays therefore finds, for each section of the way, how many planes it needs, from
the optical depths and bends that the camera sees; and the sums along rows and columns divide a step where it bends.

The planes are processed in slabs, which bounds the buffers. Units and sampling are those of `march`. Read `six_way` of
`tests/reference/marching.py` first: the same integral in short equal steps.
"""

import math
from typing import Any

import numpy as np
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
# Constants measured for 60 dB with steps of half a voxel, at any extinction.
_DARK = wp.constant(16.0)  # optical depth behind which no light is left: exp(-16) is 1e-7
_PER_DEPTH = wp.constant(2.0)  # squared planes in a section for an extinction of 1 per voxel
_PER_BEND = wp.constant(26.0)  # and for a second difference of it between the section's ends and middle of 1
_PLANES = wp.constant(64.0)  # most planes in a section
_BENT = 0.08  # second difference of the optical depths of steps from which on one is divided, for steps of a voxel
_PARTS = wp.constant(16.0)  # most parts of a step


@wp.struct
class _Sections:
    """Sections of the way through the smoke: `count` of length `length` from distance `start` on, in voxels."""

    start: float
    length: float
    count: int


@wp.func
def _thickness(smoke: Any, span: wp.vec2, p: wp.vec3, direction: wp.vec3, s: float, h: float) -> float:
    """Computes the optical depth of a step of length h, sampled at distance s; 0 if s is outside the range `span`."""
    if s > span[0] and s < span[1]:
        return smoke.extinction * sample(smoke, p + s * direction) * h
    return 0.0


@wp.func
def _pass_step(
    smoke: Any, limit: float, span: wp.vec2, p: wp.vec3, direction: wp.vec3, s: float, h: float, state: wp.vec3
) -> wp.vec3:
    """Adds the step from distance s to s + h to `state`: the optical depth so far, and those of the step before and of
    this step by the sample in its middle. A step that bends by more than `limit` is divided, unless it is opaque."""
    x = state[2]
    after = _thickness(smoke, span, p, direction, s + 1.5 * h, h)
    bent = wp.abs(state[1] - 2.0 * x + after)
    depth = x
    if bent > limit and x < 2.0 * _DARK:
        parts = wp.ceil(wp.min(wp.sqrt(bent / limit), _PARTS))
        depth = float(0.0)
        for n in range(int(parts)):
            part = h / parts
            depth += _thickness(smoke, span, p, direction, s + (float(n) + 0.5) * part, part)
    return wp.vec3(state[0] + depth, x, after)


@for_smoke
def _plan(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        sections: _Sections,
        # in and out:
        needs: wp.array[int],
        rows: wp.array2d[wp.uint8],
        columns: wp.array2d[wp.uint8],
        # out:
        depth: wp.array2d[float],
    ):
        """Finds the number of planes in each section, and the rows and columns in which a section is visible; sums the
        optical depths of rays."""
        row, col = wp.tid()
        r = ray(view, row, col)
        span = clip(box_of(smoke), r.origin, r.direction)
        h = sections.length
        tau = float(0.0)
        middle = _thickness(smoke, span, r.origin, r.direction, sections.start - 0.5 * h, h)
        end = _thickness(smoke, span, r.origin, r.direction, sections.start, h)
        next = _thickness(smoke, span, r.origin, r.direction, sections.start + 0.5 * h, h)
        for n in range(sections.count):
            s = sections.start + float(n) * h
            near = middle
            start = end
            middle = next
            end = _thickness(smoke, span, r.origin, r.direction, s + h, h)
            next = _thickness(smoke, span, r.origin, r.direction, s + 1.5 * h, h)
            if s + h > span[0] and s < span[1] and tau < _DARK:
                bent = wp.abs(start - 2.0 * middle + end)
                bent = wp.max(bent, wp.max(wp.abs(near - 2.0 * start + middle), wp.abs(middle - 2.0 * end + next)))
                thick = wp.max(wp.max(start, middle), end)
                need = wp.sqrt((_PER_DEPTH * thick + _PER_BEND * bent / h) / h * wp.exp(-tau))
                count = int(wp.ceil(wp.min(need, _PLANES)))
                tau += (start + 4.0 * middle + end) / 6.0
                if smoke.emission > 0.0:
                    count = wp.max(count, 1)
                # Reading first spares nearly all of the atomic operations.
                if count > needs[n]:
                    wp.atomic_max(needs, n, count)
                rows[n, row] = wp.uint8(1)
                columns[n, col] = wp.uint8(1)
        depth[row, col] = tau

    return kernel


@for_smoke
def _sweep(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        planes: wp.array[wp.vec3],
        first: int,
        upright: int,
        parts: int,
        limit: float,
        visible: wp.array2d[wp.uint8],
        # out:
        near: wp.array3d[float],
        far: wp.array3d[float],
    ):
        """Sums optical depths along a visible row from the left (`near`) and from the right (`far`), or, if `upright`,
        along a column from the top and from the bottom. A thread computes one line of one plane."""
        n, line = wp.tid()
        plane = planes[first + n]
        if visible[int(plane[2]), line] == wp.uint8(0):
            return
        base = view.origin + plane[0] * view.forward
        ahead = view.right
        count = view.width
        if upright == 0:
            base += (0.5 * float(view.height) - float(line) - 0.5) * view.pitch * view.up
        else:
            base += (float(line) + 0.5 - 0.5 * float(view.width)) * view.pitch * view.right
            ahead = -view.up
            count = view.height
        # Pixel k is at distance `origin` + k pitch; there are whole steps between pixels.
        span = clip(box_of(smoke), base, ahead)
        h = view.pitch / float(parts)
        origin = (0.5 - 0.5 * float(count)) * view.pitch
        begin = origin
        if span[0] < span[1]:
            begin = origin - wp.max(wp.ceil((origin - span[0]) / h), 0.0) * h
        state = wp.vec3(0.0, 0.0, _thickness(smoke, span, base, ahead, begin + 0.5 * h, h))
        for j in range(int(wp.round((origin - begin) / h))):
            state = _pass_step(smoke, limit, span, base, ahead, begin + float(j) * h, h, state)
        for k in range(count):
            passed = state[0]
            if upright == 0:
                near[n, line, k] = passed
            else:
                near[n, k, line] = passed
            # Behind the last pixel there may be many steps.
            steps = parts
            if k == count - 1:
                steps = int(wp.max(wp.ceil((span[1] - origin) / h), 0.0)) - k * parts
            # The step's own sum has no rounding of the way before it.
            state[0] = 0.0
            for j in range(steps):
                state = _pass_step(smoke, limit, span, base, ahead, origin + float(k * parts + j) * h, h, state)
            if upright == 0:
                far[n, line, k] = state[0]
            else:
                far[n, k, line] = state[0]
            state[0] += passed
        total = float(0.0)
        for j in range(count):
            k = count - 1 - j
            if upright == 0:
                total += far[n, line, k]
                far[n, line, k] = total
            else:
                total += far[n, k, line]
                far[n, k, line] = total

    return kernel


@for_smoke
def _gather(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        planes: wp.array[wp.vec3],
        first: int,
        count: int,
        march: MarchParameters,
        rows: wp.array2d[wp.uint8],
        columns: wp.array2d[wp.uint8],
        sides: wp.array4d[float],
        behind: wp.array2d[float],
        # in and out:
        passed: wp.array2d[float],
        out: wp.array3d[float],
    ):
        row, col = wp.tid()
        r = ray(view, row, col)
        span = clip(box_of(smoke), r.origin, r.direction)
        tau = passed[row, col]
        light = wp.vec4()
        hot = float(0.0)
        for n in range(count):
            plane = planes[first + n]
            s = plane[0]
            section = int(plane[2])
            # Light behind `_DARK` is not visible.
            if s > span[0] and s < span[1] and tau < _DARK:
                p = r.origin + s * r.direction
                x = smoke.extinction * sample(smoke, p) * plane[1]
                t = wp.exp(-tau)
                if x > 0.0 and rows[section, row] != wp.uint8(0) and columns[section, col] != wp.uint8(0):
                    left = wp.vec4(
                        wp.exp(-sides[0, n, row, col]),
                        wp.exp(-sides[1, n, row, col]),
                        wp.exp(-sides[2, n, row, col]),
                        wp.exp(-sides[3, n, row, col]),
                    )
                    light += t * absorbed(x) * phase(march.g, 0.0) * left
                if smoke.emission > 0.0:
                    glow = smoke.emission * density_at(smoke.temperature, smoke, p)
                    hot += glow * plane[1] * t * mean_transparency(x)
                tau += x
        passed[row, col] = tau
        for c in range(4):
            out[c, row, col] = out[c, row, col] + light[c]
        # The integral of sigma exp(-2 sigma s) along the ray; for the back that of sigma alone, since the ways to the
        # camera and to the light add up to the whole ray.
        out[4, row, col] = phase(march.g, -1.0) * wp.exp(-behind[row, col]) * 0.5 * absorbed(2.0 * tau)
        out[5, row, col] = phase(march.g, 1.0) * tau * wp.exp(-tau)
        out[TRANSPARENCY, row, col] = wp.exp(-tau)
        out[EMISSION, row, col] = out[EMISSION, row, col] + hot

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
        march: Only its g and its step are used, the longest step both along rays and towards the lights. Samples lie in
            the middles of steps, which are shorter in dense smoke; all are about half as long for half of the step.
        out: float [8, H, W], written: light that reaches the camera from smoke lit from the right, left, top, bottom,
            front and back, each light of irradiance 4 pi; the transparency; the emission.
    """
    require_orthographic(view, "six-way lightmaps")
    medium = medium.in_bricks()
    height, width = view.height, view.width
    out.zero_()
    near, far = _extent(medium.shape, view.origin, view.forward)
    start = max(near, 0.0)
    passed, behind = (medium.buffer((height, width), float) for _ in range(2))

    def plan(first: float, last: float, tau: wp.array) -> tuple[np.ndarray, wp.array, wp.array]:
        sections = _Sections()
        sections.start, sections.count = first, max(math.ceil((last - first) / march.step), 0)
        sections.length = (last - first) / max(sections.count, 1)
        most = max(sections.count, 1)
        needs = medium.buffer((most,), int)
        lines = [medium.buffer((most, n), wp.uint8) for n in (height, width)]
        for array in (needs, *lines):
            array.zero_()
        _plan(medium, (height, width), [view, sections, needs, *lines], [tau])
        # Section n has needs[n] planes, each in the middle of a step.
        counts = needs.numpy()
        of = np.repeat(np.arange(most), counts)
        gaps = sections.length / counts[of]
        inside = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
        return np.stack([first + of * sections.length + (inside + 0.5) * gaps, gaps, of], 1), *lines

    plan(near, min(far, 0.0), behind)
    planes, rows, columns = plan(start, far, passed)
    passed.zero_()
    parts, limit = max(1, math.ceil(view.pitch / march.step)), _BENT * march.step**2
    capacity = max(1, min(len(planes), _SLAB_BYTES // (16 * height * width)))
    sides = medium.buffer((4, capacity, height, width), float)
    places = wp.array(planes, dtype=wp.vec3, device=medium.device)
    # The loop runs once even if there is no plane, to write the transparency.
    for first in range(0, max(len(planes), 1), capacity):
        count = min(capacity, len(planes) - first)
        for upright, (lines, visible) in enumerate(((height, rows), (width, columns))):
            two = [sides[2], sides[3]] if upright else [sides[1], sides[0]]
            _sweep(medium, (count, lines), [view, places, first, upright, parts, limit, visible], two)
        inputs = [view, places, first, count, parameters(march), rows, columns, sides, behind]
        _gather(medium, (height, width), inputs, [passed, out])
