"""Solves for the samples of tiles by weighted least squares, with one thread per tile or per channel of a tile.

The light at m x m points of a tile is interpolated bilinearly from nx x ny samples. The normal equations couple a
sample only with its eight neighbours, so they are computed from the points once, and conjugate gradients then iterate
over samples.

Arrays may have any strides; on CUDA the stride along the tiles, which neighbouring threads have, should be 1.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST = 16  # largest number of samples along an axis
_BLOCK = 64  # threads: small blocks let few tiles occupy a whole GPU

_Row = wp.types.vector(length=MOST, dtype=float)
_TINY = wp.constant(1e-30)


@wp.struct
class Grid:
    """The grids of a tile: m points along an axis, and nx x ny samples, at most `MOST` along each.

    `first_x` and `first_y`, int [m], have the index of the sample before each point along the axis, `share_x` and
    `share_y`, float [m], the weight of the next sample there; both are 0 if there is only one sample.
    """

    points: int
    nx: int
    ny: int
    first_x: wp.array1d[int]
    share_x: wp.array1d[float]
    first_y: wp.array1d[int]
    share_y: wp.array1d[float]


@wp.struct
class System:
    """The normal equations of T tiles, [T, S] each; the S = nx * ny samples of a tile are stored row by row.

    They are coefficients of a sample with itself and with its neighbours to the right, below and to the lower right, 0
    beyond the last sample; the right and the lower neighbour have the last of these with each other. `diagonal` is the
    sum of a sample's coefficients with itself and all neighbours: the preconditioner.
    """

    own: wp.array2d[float]
    right: wp.array2d[float]
    down: wp.array2d[float]
    cross: wp.array2d[float]
    diagonal: wp.array2d[float]


@wp.kernel
def _system(weight: wp.array2d[float], scale: wp.array1d[float], grid: Grid, system: System):
    t = wp.tid()
    for s in range(grid.nx * grid.ny):
        system.own[t, s] = 0.0
        system.right[t, s] = 0.0
        system.down[t, s] = 0.0
        system.cross[t, s] = 0.0
        system.diagonal[t, s] = 0.0
    for r in range(grid.points):
        squares = _Row()
        products = _Row()
        sums = _Row()
        for c in range(grid.points):
            w = scale[t] * weight[t, r * grid.points + c]
            j = grid.first_x[c]
            k = wp.min(j + 1, grid.nx - 1)
            a = grid.share_x[c]
            b = 1.0 - a
            squares[j] += w * b * b
            squares[k] += w * a * a
            products[j] += w * a * b
            sums[j] += w * b
            sums[k] += w * a
        i = grid.first_y[r] * grid.nx
        k = wp.min(grid.first_y[r] + 1, grid.ny - 1) * grid.nx
        a = grid.share_y[r]
        b = 1.0 - a
        for j in range(grid.nx):
            system.own[t, i + j] += b * b * squares[j]
            system.own[t, k + j] += a * a * squares[j]
            system.right[t, i + j] += b * b * products[j]
            system.right[t, k + j] += a * a * products[j]
            system.down[t, i + j] += a * b * squares[j]
            system.cross[t, i + j] += a * b * products[j]
            system.diagonal[t, i + j] += b * sums[j]
            system.diagonal[t, k + j] += a * sums[j]


@wp.kernel
def _solve(
    light: wp.array3d[float],
    weight: wp.array2d[float],
    scale: wp.array1d[float],
    grid: Grid,
    system: System,
    ridge: float,
    rounds: int,
    start: wp.array3d[float],
    residual: wp.array3d[float],
    direction: wp.array3d[float],
    image: wp.array3d[float],
    out: wp.array3d[float],
):
    channel, t = wp.tid()
    count = grid.nx * grid.ny
    # The residual of the start is transposed to the samples; differences are formed at the points, since
    # differences of large sums would lose precision.
    for s in range(count):
        residual[t, channel, s] = 0.0
        out[t, channel, s] = start[t, channel, s]
    for r in range(grid.points):
        i = grid.first_y[r] * grid.nx
        below = wp.min(grid.first_y[r] + 1, grid.ny - 1) * grid.nx
        share = grid.share_y[r]
        row = _Row()
        sums = _Row()
        for j in range(grid.nx):
            row[j] = (1.0 - share) * start[t, channel, i + j] + share * start[t, channel, below + j]
        for c in range(grid.points):
            j = grid.first_x[c]
            after = wp.min(j + 1, grid.nx - 1)
            a = grid.share_x[c]
            b = 1.0 - a
            p = r * grid.points + c
            rest = scale[t] * weight[t, p] * (light[t, channel, p] - (b * row[j] + a * row[after]))
            sums[j] += b * rest
            sums[after] += a * rest
        for j in range(grid.nx):
            residual[t, channel, i + j] += (1.0 - share) * sums[j]
            residual[t, channel, below + j] += share * sums[j]
    # The unknown is the difference to the start, towards which the ridge term regularises.
    energy = float(0.0)
    for s in range(count):
        value = residual[t, channel, s]
        step = value / (system.diagonal[t, s] + ridge)
        direction[t, channel, s] = step
        energy += value * step
    for _round in range(rounds):
        power = float(0.0)
        for i in range(grid.ny):
            for j in range(grid.nx):
                s = i * grid.nx + j
                here = direction[t, channel, s]
                value = (system.own[t, s] + ridge) * here
                if j + 1 < grid.nx:
                    value += system.right[t, s] * direction[t, channel, s + 1]
                if j > 0:
                    value += system.right[t, s - 1] * direction[t, channel, s - 1]
                if i + 1 < grid.ny:
                    value += system.down[t, s] * direction[t, channel, s + grid.nx]
                    if j + 1 < grid.nx:
                        value += system.cross[t, s] * direction[t, channel, s + grid.nx + 1]
                    if j > 0:
                        value += system.cross[t, s - 1] * direction[t, channel, s + grid.nx - 1]
                if i > 0:
                    value += system.down[t, s - grid.nx] * direction[t, channel, s - grid.nx]
                    if j + 1 < grid.nx:
                        value += system.cross[t, s - grid.nx] * direction[t, channel, s - grid.nx + 1]
                    if j > 0:
                        value += system.cross[t, s - grid.nx - 1] * direction[t, channel, s - grid.nx - 1]
                image[t, channel, s] = value
                power += here * value
        length = energy / wp.max(power, _TINY)
        before = energy
        energy = float(0.0)
        for s in range(count):
            out[t, channel, s] += length * direction[t, channel, s]
            value = residual[t, channel, s] - length * image[t, channel, s]
            residual[t, channel, s] = value
            energy += value * value / (system.diagonal[t, s] + ridge)
        onward = energy / wp.max(before, _TINY)
        for s in range(count):
            direction[t, channel, s] = (
                residual[t, channel, s] / (system.diagonal[t, s] + ridge) + onward * direction[t, channel, s]
            )


@wp.kernel
def _errors(
    light: wp.array3d[float],
    weight: wp.array2d[float],
    grid: Grid,
    samples: wp.array3d[float],
    out: wp.array2d[wp.float64],
):
    channel, t = wp.tid()
    total = wp.float64(0.0)
    for r in range(grid.points):
        i = grid.first_y[r] * grid.nx
        k = wp.min(grid.first_y[r] + 1, grid.ny - 1) * grid.nx
        share = grid.share_y[r]
        row = _Row()
        for j in range(grid.nx):
            row[j] = (1.0 - share) * samples[t, channel, i + j] + share * samples[t, channel, k + j]
        sums = float(0.0)
        for c in range(grid.points):
            j = grid.first_x[c]
            a = grid.share_x[c]
            p = r * grid.points + c
            rest = (1.0 - a) * row[j] + a * row[wp.min(j + 1, grid.nx - 1)] - light[t, channel, p]
            sums += weight[t, p] * rest * rest
        total += wp.float64(sums)
    out[t, channel] = total


def gather_system(weight: wp.array, scale: wp.array, grid: Grid, system: System) -> None:
    """Writes the normal equations of T tiles to `system`. The squared error at a point has the weight `weight`, float
    [T, m * m], times its tile's factor `scale`, float [T]."""
    wp.launch(_system, weight.shape[0], inputs=[weight, scale, grid, system], device=weight.device, block_dim=_BLOCK)


def solve(
    light: wp.array,
    weight: wp.array,
    scale: wp.array,
    grid: Grid,
    system: System,
    ridge: float,
    rounds: int,
    start: wp.array,
    work: list[wp.array],
    out: wp.array,
) -> None:
    """Solves the normal equations of T tiles, which `gather_system` has written, by conjugate gradients.

    `light`, float [T, 3, m * m], is what the samples `out`, float [T, 3, S], written, should reproduce at the points.
    The iterations, `rounds` of them, begin at `start`, from which the squared difference of a sample has the weight
    `ridge`. `work` are three arrays of the same shape, scratch memory.
    """
    inputs = [light, weight, scale, grid, system, ridge, rounds, start, *work, out]
    wp.launch(_solve, light.shape[1::-1], inputs=inputs, device=light.device, block_dim=_BLOCK)


def errors(light: wp.array, weight: wp.array, grid: Grid, samples: wp.array, out: wp.array) -> None:
    """Writes the weighted squared errors of samples, float [T, 3, S], summed over each tile's points, to `out`, float64
    [T, 3]; `light` and `weight` are as for `solve`."""
    inputs = [light, weight, grid, samples, out]
    wp.launch(_errors, light.shape[1::-1], inputs=inputs, device=light.device, block_dim=_BLOCK)
