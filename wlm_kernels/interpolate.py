"""Linear sampling of feature planes and volumes whose first axis is clamped or periodic.

A plane is `[T, W, C]`: rows are times (or v), columns are u. A volume is `[T, H, W, C]`. Space is clamped to the
border; the first axis is clamped, or wraps round when `periodic`, so that the first slice follows the last. Coordinates
are in [0, 1], cell centres at (i + 1/2) / size. C is arbitrary. `benchmarks.plain` computes the same in torch.
"""

import warp as wp

from wlm_kernels.raster.texture import BOUNDARIES, Axis, axis_at

wp.set_module_options({"enable_backward": False})

_LINEAR = wp.constant(0)
_CLAMP, _WRAP = (wp.constant(BOUNDARIES.index(name)) for name in ("clamp", "wrap"))


@wp.func
def cell(coordinate: float, size: int) -> int:
    """Returns the index of the last cell centre at or before a coordinate in [0, 1] among `size` cells; -1 for none."""
    return int(wp.floor(coordinate * float(size) - 0.5))


@wp.func
def fraction(coordinate: float, size: int) -> float:
    p = coordinate * float(size) - 0.5
    return p - wp.floor(p)


@wp.func
def axis_index(i: int, size: int, periodic: int) -> int:
    """Clamps an index to the border, or wraps it (i is at most one period outside)."""
    if periodic != 0:
        return wp.where(i < 0, i + size, wp.where(i < size, i, i - size))
    return wp.clamp(i, 0, size - 1)


@wp.struct
class _Cell:
    """The cells around a point and their weights along width (x), height (y) and first axis (t). `base` is the first
    slice of the plane or volume; `corners` is the number of cells, 4 in a plane or 8 in a volume."""

    x: Axis
    y: Axis
    t: Axis
    base: int
    corners: int


@wp.func
def _cell_of(
    values: wp.array4d[float], times: int, layers: wp.array1d[int], points: wp.array2d[float], periodic: int, i: int
) -> _Cell:
    out = _Cell()
    out.x = axis_at(points[i, 0], values.shape[2], _LINEAR, _CLAMP)
    out.corners = 4
    if points.shape[1] == 3:
        out.corners = 8
        out.y = axis_at(points[i, 1], values.shape[1], _LINEAR, _CLAMP)
    out.t = axis_at(points[i, points.shape[1] - 1], times, _LINEAR, wp.where(periodic != 0, _WRAP, _CLAMP))
    if layers.shape[0] > 0:
        out.base = layers[i] * times
    return out


@wp.func
def _weight(axis: Axis, side: int) -> float:
    return wp.where(side == 0, 1.0 - axis.weight, axis.weight)


@wp.func
def _index(axis: Axis, side: int) -> int:
    return wp.where(side == 0, axis.low, axis.high)


@wp.kernel
def _sample(
    # in:
    values: wp.array4d[float],
    times: int,
    layers: wp.array1d[int],
    points: wp.array2d[float],
    periodic: int,
    # out:
    out: wp.array2d[float],
):
    i = wp.tid()
    at = _cell_of(values, times, layers, points, periodic, i)
    for c in range(out.shape[1]):
        out[i, c] = 0.0
    for corner in range(at.corners):
        a = corner & 1
        b = corner >> 2
        d = (corner >> 1) & 1
        w = _weight(at.x, a) * _weight(at.y, b) * _weight(at.t, d)
        if w != 0.0:
            for c in range(out.shape[1]):
                out[i, c] += w * values[at.base + _index(at.t, d), _index(at.y, b), _index(at.x, a), c]


@wp.kernel
def _sample_backward(
    # in:
    values: wp.array4d[float],
    times: int,
    layers: wp.array1d[int],
    points: wp.array2d[float],
    periodic: int,
    grad_out: wp.array2d[float],
    # out:
    grad_values: wp.array4d[float],
    grad_points: wp.array2d[float],
):
    i = wp.tid()
    at = _cell_of(values, times, layers, points, periodic, i)
    on_x = float(0.0)
    on_y = float(0.0)
    on_t = float(0.0)
    for corner in range(at.corners):
        a = corner & 1
        b = corner >> 2
        d = (corner >> 1) & 1
        wx = _weight(at.x, a)
        wy = _weight(at.y, b)
        wt = _weight(at.t, d)
        row = at.base + _index(at.t, d)
        y = _index(at.y, b)
        x = _index(at.x, a)
        if grad_values.shape[0] > 0 and wx * wy * wt != 0.0:
            for c in range(grad_out.shape[1]):
                wp.atomic_add(grad_values, row, y, x, c, wx * wy * wt * grad_out[i, c])
        if grad_points.shape[0] > 0:
            along = float(0.0)
            for c in range(grad_out.shape[1]):
                along += grad_out[i, c] * values[row, y, x, c]
            on_x += (2.0 * float(a) - 1.0) * wy * wt * along
            on_y += (2.0 * float(b) - 1.0) * wx * wt * along
            on_t += (2.0 * float(d) - 1.0) * wx * wy * along
    if grad_points.shape[0] > 0:
        grad_points[i, 0] = at.x.slope * on_x
        if points.shape[1] == 3:
            grad_points[i, 1] = at.y.slope * on_y
        grad_points[i, points.shape[1] - 1] = at.t.slope * on_t


def sample(values, times: int, layers, points, out, periodic: bool = False) -> None:
    """Samples planes bilinearly, or volumes trilinearly; coordinates outside [0, 1] are clamped or wrapped.

    Args:
        values: float [L * T, H, W, C], L planes (H = 1) or volumes, concatenated because Warp arrays have at most four
            dimensions.
        times: T, number of slices of each plane or volume.
        layers: int [N], number of the plane or volume of each point, 0 to L - 1; of shape [0] if L is 1.
        points: float [N, 2] (u, t) or [N, 3] (u, v, t).
        out: float [N, C], written.
        periodic: Whether the first axis, of length T, wraps round.
    """
    inputs = [values, times, layers, points, int(periodic)]
    wp.launch(_sample, points.shape[0], inputs=inputs, outputs=[out], device=values.device)


def sample_backward(
    values, times: int, layers, points, grad_out, grad_values, grad_points, periodic: bool = False
) -> None:
    """Computes gradients from the gradient of a result of `sample`. A coordinate's gradient is the slope between two
    cell centres, 0 where it is clamped.

    On CUDA points are added to `grad_values` in any order, so that the last bits change from run to run.

    Args:
        values, times, layers, points, periodic: Arguments of `sample`.
        grad_out: float [N, C], gradient of the result.
        grad_values: float [L * T, H, W, C], to which the gradient is added; of shape [0, 0, 0, 0] if it is not wanted.
        grad_points: float, like `points`, written; of shape [0, 0] if it is not wanted.
    """
    inputs = [values, times, layers, points, int(periodic), grad_out]
    outputs = [grad_values, grad_points]
    wp.launch(_sample_backward, points.shape[0], inputs=inputs, outputs=outputs, device=values.device)
