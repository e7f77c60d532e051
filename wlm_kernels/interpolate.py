"""Planes and volumes of features, sampled linearly, with a time axis that is clamped or periodic.

A plane is ``[S, T, W, C]``: row = time, column = u or v. A volume is ``[S, T, H, W, C]``. Space is clamped to the
border; time is clamped, or wraps round when ``periodic`` (the last slice is the first's neighbour). Coordinates are
in [0, 1], cell centres at (i + 1/2) / size. Any number of channels C; the adjoint is the tape's.
"""

import warp as wp

__all__ = ["sample_plane", "sample_volume"]


@wp.func
def cell(coordinate: float, size: int) -> int:
    """The lower neighbour of a coordinate in [0, 1] on an axis of ``size`` cells; may be -1."""
    return int(wp.floor(coordinate * float(size) - 0.5))


@wp.func
def fraction(coordinate: float, size: int) -> float:
    p = coordinate * float(size) - 0.5
    return p - wp.floor(p)


@wp.func
def axis_index(i: int, size: int, periodic: int) -> int:
    """Clamps to the border, or wraps (i is at most one period out)."""
    if periodic != 0:
        return (i + size) % size
    return wp.clamp(i, 0, size - 1)


@wp.kernel
def _sample_plane(
    # in:
    plane: wp.array4d[float],
    slices: wp.array1d[int],
    points: wp.array1d[wp.vec2],
    periodic: int,
    # out:
    out: wp.array2d[float],
):
    i, c = wp.tid()
    s = slices[i]
    p = points[i]
    rows = plane.shape[1]
    columns = plane.shape[2]
    x = cell(p[0], columns)
    t = cell(p[1], rows)
    fx = fraction(p[0], columns)
    ft = fraction(p[1], rows)
    xa = axis_index(x, columns, 0)
    xb = axis_index(x + 1, columns, 0)
    ta = axis_index(t, rows, periodic)
    tb = axis_index(t + 1, rows, periodic)
    out[i, c] = (1.0 - ft) * ((1.0 - fx) * plane[s, ta, xa, c] + fx * plane[s, ta, xb, c]) + ft * (
        (1.0 - fx) * plane[s, tb, xa, c] + fx * plane[s, tb, xb, c]
    )


@wp.func
def _bilinear(
    volume: wp.array4d[float], row: int, y: int, yb: int, x: int, xb: int, fy: float, fx: float, c: int
) -> float:
    return (1.0 - fy) * ((1.0 - fx) * volume[row, y, x, c] + fx * volume[row, y, xb, c]) + fy * (
        (1.0 - fx) * volume[row, yb, x, c] + fx * volume[row, yb, xb, c]
    )


@wp.kernel
def _sample_volume(
    # in:
    volume: wp.array4d[float],
    times: int,
    slices: wp.array1d[int],
    points: wp.array1d[wp.vec3],
    periodic: int,
    # out:
    out: wp.array2d[float],
):
    i, c = wp.tid()
    base = slices[i] * times
    p = points[i]
    height = volume.shape[1]
    width = volume.shape[2]
    x = cell(p[0], width)
    y = cell(p[1], height)
    t = cell(p[2], times)
    fx = fraction(p[0], width)
    fy = fraction(p[1], height)
    ft = fraction(p[2], times)
    xa = axis_index(x, width, 0)
    xb = axis_index(x + 1, width, 0)
    ya = axis_index(y, height, 0)
    yb = axis_index(y + 1, height, 0)
    ta = base + axis_index(t, times, periodic)
    tb = base + axis_index(t + 1, times, periodic)
    out[i, c] = (1.0 - ft) * _bilinear(volume, ta, ya, yb, xa, xb, fy, fx, c) + ft * _bilinear(
        volume, tb, ya, yb, xa, xb, fy, fx, c
    )


def sample_plane(plane, slices, points, out, periodic: bool = False) -> None:
    """Samples planes bilinearly; recorded by an open ``wp.Tape``.

    Args:
        plane: float [S, T, W, C].
        slices: int [N], the plane of each point.
        points: vec2 [N], (u, t) in [0, 1].
        out: float [N, C].
        periodic: Whether the time axis wraps.
    """
    wp.launch(
        _sample_plane,
        out.shape,
        inputs=[plane, slices, points, int(periodic)],
        outputs=[out],
        device=plane.device,
    )


def sample_volume(volume, times: int, slices, points, out, periodic: bool = False) -> None:
    """Samples volumes trilinearly; recorded by an open ``wp.Tape``.

    Args:
        volume: float [S * T, H, W, C] (Warp arrays end at four dimensions).
        times: T, slices of time in each volume.
        slices: int [N], the volume of each point.
        points: vec3 [N], (u, v, t) in [0, 1].
        out: float [N, C].
        periodic: Whether the time axis wraps.
    """
    wp.launch(
        _sample_volume,
        out.shape,
        inputs=[volume, times, slices, points, int(periodic)],
        outputs=[out],
        device=volume.device,
    )
