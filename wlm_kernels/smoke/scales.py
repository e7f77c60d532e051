"""Planes of an image at several scales, blurred and shifted: what light of all orders is predicted from.

A wide blur is made at a lower resolution: planes are halved as often as leaves the blur a few of its pixels wide, are
blurred there along rows and columns, and are interpolated where they are read. Outside the image they are 0.
"""

import math
from collections.abc import Sequence

import warp as wp

from wlm_kernels.smoke.march import Empty

wp.set_module_options({"enable_backward": False})
_BASES = wp.constant(9)
_SHARED = wp.constant(4)  # bases that all lights have: from all around, opacity, its square, optical depth
_OWN = wp.constant(5)  # and those of each light: itself, the opposite one, its square, by opacity, its root
_FINEST = 0.3  # pixels: a blur of less is none


@wp.struct
class Scale:
    """Planes blurred by a Gaussian of `sigma` pixels, halved to pixels that are `factor` times as wide."""

    planes: wp.array3d[float]
    factor: int
    sigma: float


@wp.kernel
def _bases(
    # in:
    single: wp.array3d[float],
    opposite: wp.array3d[float],
    around: wp.array2d[float],
    transparency: wp.array2d[float],
    thinnest: float,
    # out:
    out: wp.array3d[float],
):
    row, column = wp.tid()
    t = transparency[row, column]
    opacity = 1.0 - t
    out[0, row, column] = around[row, column]
    out[1, row, column] = opacity
    out[2, row, column] = opacity * opacity
    out[3, row, column] = -wp.log(wp.max(t, thinnest)) / 9.0
    for n in range(single.shape[0]):
        light = single[n, row, column]
        first = _SHARED + n * _OWN
        out[first, row, column] = light
        out[first + 1, row, column] = opposite[n, row, column]
        out[first + 2, row, column] = light * light
        out[first + 3, row, column] = light * opacity
        out[first + 4, row, column] = wp.sqrt(light)


@wp.kernel
def _halve(
    # in:
    planes: wp.array3d[float],
    # out:
    out: wp.array3d[float],
):
    plane, row, column = wp.tid()
    total = float(0.0)
    for y in range(2 * row, wp.min(2 * row + 2, planes.shape[1])):
        for x in range(2 * column, wp.min(2 * column + 2, planes.shape[2])):
            total += planes[plane, y, x]
    out[plane, row, column] = 0.25 * total


@wp.kernel
def _blur_across(
    # in:
    planes: wp.array3d[float],
    sigma: float,
    reach: int,
    # out:
    out: wp.array3d[float],
):
    plane, row, column = wp.tid()
    total = float(0.0)
    for n in range(wp.max(-reach, -column), wp.min(reach, planes.shape[2] - 1 - column) + 1):
        away = float(n) / sigma
        total += wp.exp(-0.5 * away * away) * planes[plane, row, column + n]
    out[plane, row, column] = total


@wp.kernel
def _blur_down(
    # in:
    planes: wp.array3d[float],
    sigma: float,
    reach: int,
    factor: float,
    # out:
    out: wp.array3d[float],
):
    plane, row, column = wp.tid()
    total = float(0.0)
    for n in range(wp.max(-reach, -row), wp.min(reach, planes.shape[1] - 1 - row) + 1):
        away = float(n) / sigma
        total += wp.exp(-0.5 * away * away) * planes[plane, row + n, column]
    out[plane, row, column] = factor * total


@wp.struct
class _Corners:
    """Where a place lies between four pixels."""

    row: int
    column: int
    below: int
    beside: int
    down: float
    right: float


@wp.func
def _corners(rows: int, columns: int, factor: int, row: float, column: float) -> _Corners:
    """Of pixels of a lower resolution, around a pixel of the full one."""
    y = wp.max((row + 0.5) / float(factor) - 0.5, 0.0)
    x = wp.max((column + 0.5) / float(factor) - 0.5, 0.0)
    at = _Corners()
    at.row = wp.min(int(y), rows - 1)
    at.column = wp.min(int(x), columns - 1)
    at.below = wp.min(at.row + 1, rows - 1)
    at.beside = wp.min(at.column + 1, columns - 1)
    at.down = y - float(at.row)
    at.right = x - float(at.column)
    return at


@wp.func
def _between(planes: wp.array3d[float], plane: int, at: _Corners) -> float:
    above = wp.lerp(planes[plane, at.row, at.column], planes[plane, at.row, at.beside], at.right)
    below = wp.lerp(planes[plane, at.below, at.column], planes[plane, at.below, at.beside], at.right)
    return wp.lerp(above, below, at.down)


@wp.func
def _plane(base: int, light: int) -> int:
    """Where a base lies among the planes: single, opposite, around, opacity, its square, depth, and three of single."""
    first = _SHARED + light * _OWN
    if base < 2:
        return first + base
    if base < 6:
        return base - 2
    return first + base - 4


@wp.func
def _inside(at: float, size: int) -> float:
    """The share of a pixel at a place that is in the image."""
    return wp.clamp(at + 1.0, 0.0, 1.0) * wp.clamp(float(size) - at, 0.0, 1.0)


@wp.func
def _put(out: wp.array3d[float], feature: int, row: int, column: int, value: float, opacity: float):
    out[feature, row, column] = value
    out[feature + out.shape[0] // 2, row, column] = value * opacity


@wp.func
def _read_scale(
    s: Scale, light: int, across: float, rise: float, first: int, row: int, column: int, opacity: float,
    out: wp.array3d[float],
):  # fmt: skip
    rows = s.planes.shape[1]
    columns = s.planes.shape[2]
    at = _corners(rows, columns, s.factor, float(row), float(column))
    for base in range(_BASES):
        _put(out, first + base, row, column, _between(s.planes, _plane(base, light), at), opacity)
    y = float(row) + s.sigma * rise
    x = float(column) - s.sigma * across
    share = _inside(y, out.shape[1]) * _inside(x, out.shape[2])
    y = wp.clamp(y, 0.0, float(out.shape[1] - 1))
    x = wp.clamp(x, 0.0, float(out.shape[2] - 1))
    at = _corners(rows, columns, s.factor, y, x)
    for n in range(3):
        base = wp.where(n == 0, 0, 2 * n + 1)  # light, opacity, optical depth
        _put(out, first + _BASES + n, row, column, share * _between(s.planes, _plane(base, light), at), opacity)


@wp.kernel
def _features(
    # in:
    bases: wp.array3d[float],
    a: Scale,
    b: Scale,
    c: Scale,
    d: Scale,
    light: int,
    across: float,
    rise: float,
    # out:
    out: wp.array3d[float],
):
    row, column = wp.tid()
    opacity = bases[1, row, column]
    for base in range(_BASES):
        _put(out, base, row, column, bases[_plane(base, light), row, column], opacity)
    _read_scale(a, light, across, rise, 9, row, column, opacity, out)
    _read_scale(b, light, across, rise, 21, row, column, opacity, out)
    _read_scale(c, light, across, rise, 33, row, column, opacity, out)
    _read_scale(d, light, across, rise, 45, row, column, opacity, out)


def make_bases(
    single: wp.array, opposite: wp.array, around: wp.array, transparency: wp.array, thinnest: float, empty: Empty
) -> wp.array:
    """What is blurred.

    Args:
        single, opposite: float [L, H, W], light scattered once of each light and of the opposite ones.
        around: float [H, W], of light from all around.
        transparency: float [H, W].
        thinnest: Transparency below which optical depths count the same.
        empty: Makes buffers.

    Returns:
        float [4 + 5 L, H, W].
    """
    lights, height, width = single.shape
    out = empty((int(_SHARED) + int(_OWN) * lights, height, width), float)
    inputs = [single, opposite, around, transparency, thinnest]
    wp.launch(_bases, (height, width), inputs, [out], device=out.device)
    return out


def make_scales(planes: wp.array, sigmas: Sequence[float], empty: Empty) -> list[Scale]:
    """Blurs planes.

    Args:
        planes: float [P, H, W].
        sigmas: Standard deviations in pixels, rising.
        empty: Makes buffers.
    """
    device, factor = planes.device, 1
    made = []
    for sigma in sigmas:
        wanted = _factor(sigma, max(planes.shape[1:]))
        scale = Scale()
        scale.sigma = sigma
        if not made:
            small = planes
        while factor < wanted:
            size = (planes.shape[0], -(-small.shape[1] // 2), -(-small.shape[2] // 2))
            halved = empty(size, float)
            wp.launch(_halve, size, [small], [halved], device=device)
            small, factor = halved, 2 * factor
        scale.planes, scale.factor = small, factor
        if sigma >= _FINEST:
            spread = math.sqrt(max(sigma**2 - (factor**2 - 1) / 12.0, 0.0)) / factor
            reach, widest = max(math.ceil(3.0 * spread), 1), max(small.shape[1:])
            total = spread * math.sqrt(2.0 * math.pi)
            if reach <= widest:
                total = sum(math.exp(-0.5 * (n / spread) ** 2) for n in range(-reach, reach + 1))
            reach = min(reach, widest)
            across, down = empty(small.shape, float), empty(small.shape, float)
            wp.launch(_blur_across, small.shape, [small, spread, reach], [across], device=device)
            wp.launch(_blur_down, small.shape, [across, spread, reach, 1.0 / total**2], [down], device=device)
            scale.planes = down
        made.append(scale)
    return made


def _factor(sigma: float, most: int) -> int:
    """By how much planes are made smaller, a power of 2."""
    return 1 if sigma < 4.0 else 1 << min(int(math.log2(sigma)) - 1, most.bit_length())


def features(bases: wp.array, scales: Sequence[Scale], light: int, across: float, rise: float, out: wp.array) -> None:
    """The planes of one light at all scales, as they are and times the opacity.

    Args:
        bases: From `make_bases`.
        scales: Four, from `make_scales`.
        light: Which of the lights.
        across, rise: Of the direction to the light, along the image's rows and up.
        out: float [114, H, W], written: the bases, then of each scale the bases and three of them shifted away from the
            light by its sigma; all of these again, times the opacity.
    """
    inputs = [bases, *scales, light, float(across), float(rise)]
    wp.launch(_features, out.shape[1:], inputs, [out], device=out.device)
