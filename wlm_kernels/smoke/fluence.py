"""Fluence of light that smoke scatters on and on: diffusion on a grid of few cells, solved on coarser ones first.

In a cell of extinction s and albedo a the fluence f obeys -div(D grad f) + (1 - a) s f = a q, where q is the light that
comes straight from its source and ends there, D = 1 / (3 s + |grad f| / f) so that no more light flows than there is
(Wilson's sum), and at the box's faces half of the fluence leaves (Marshak's condition). Rounds of successive
over-relaxation, on the cells of one colour of a chequerboard and then on the others, solve it for the D of the f
before. The coarsest grid has a few cells, between which light goes everywhere in as many sweeps; each finer one begins
with what the one before found.
"""

import math

import warp as wp

from wlm_kernels.smoke.march import Medium

wp.set_module_options({"enable_backward": False})
_TINY = 1e-12
_FEWEST = 4  # cells along the longest edge, below which a grid isn't made coarser
_ROUNDS, _SWEEPS = 2, 6
_BEYOND = 4  # cells more than there are, for the factor of over-relaxation
_FIRST = 3  # rounds on the coarsest grid


@wp.kernel
def _reach(
    # in:
    extinction: wp.array3d[float],
    light: wp.array4d[float],
    cell: wp.vec3,
    # out:
    reach: wp.array4d[float],
):
    """D, by central differences of a grid that goes on alike outside."""
    n, i, j, k = wp.tid()
    nx = light.shape[1]
    ny = light.shape[2]
    nz = light.shape[3]
    x = light[n, wp.min(i + 1, nx - 1), j, k] - light[n, wp.max(i - 1, 0), j, k]
    y = light[n, i, wp.min(j + 1, ny - 1), k] - light[n, i, wp.max(j - 1, 0), k]
    z = light[n, i, j, wp.min(k + 1, nz - 1)] - light[n, i, j, wp.max(k - 1, 0)]
    steep = 0.5 * wp.length(wp.cw_div(wp.vec3(x, y, z), cell)) / wp.max(light[n, i, j, k], _TINY)
    # No steeper than a grid can tell, and light goes no farther than through the box.
    steep = wp.min(steep, 2.0 / wp.min(cell))
    farthest = (cell[0] + cell[1] + cell[2]) * float(wp.max(wp.max(nx, ny), nz))
    reach[n, i, j, k] = 1.0 / wp.max(3.0 * extinction[i, j, k] + steep, 1.0 / farthest)


@wp.func
def _flow(one: float, other: float, size: float) -> float:
    """Between neighbours of a D each, per volume and difference of fluence."""
    return 2.0 * one * other / ((one + other) * size * size)


@wp.func
def _lost_outside(own: float, size: float) -> float:
    return 1.0 / (size * (2.0 + 0.5 * size / own))


@wp.kernel
def _couple(
    # in:
    extinction: wp.array3d[float],
    reach: wp.array4d[float],
    cell: wp.vec3,
    albedos: wp.vec3,
    each: int,
    # out:
    flows: wp.array4d[wp.vec4],
):
    """What flows to the next cells along the axes, 0 at the box's faces, and over all that a cell loses 1."""
    n, i, j, k = wp.tid()
    nx = reach.shape[1]
    ny = reach.shape[2]
    nz = reach.shape[3]
    own = reach[n, i, j, k]
    lost = (1.0 - albedos[n % each]) * extinction[i, j, k]
    x = float(0.0)
    y = float(0.0)
    z = float(0.0)
    if i + 1 < nx:
        x = _flow(own, reach[n, i + 1, j, k], cell[0])
        lost += x
    else:
        lost += _lost_outside(own, cell[0])
    if j + 1 < ny:
        y = _flow(own, reach[n, i, j + 1, k], cell[1])
        lost += y
    else:
        lost += _lost_outside(own, cell[1])
    if k + 1 < nz:
        z = _flow(own, reach[n, i, j, k + 1], cell[2])
        lost += z
    else:
        lost += _lost_outside(own, cell[2])
    if i > 0:
        lost += _flow(own, reach[n, i - 1, j, k], cell[0])
    else:
        lost += _lost_outside(own, cell[0])
    if j > 0:
        lost += _flow(own, reach[n, i, j - 1, k], cell[1])
    else:
        lost += _lost_outside(own, cell[1])
    if k > 0:
        lost += _flow(own, reach[n, i, j, k - 1], cell[2])
    else:
        lost += _lost_outside(own, cell[2])
    flows[n, i, j, k] = wp.vec4(x, y, z, 1.0 / lost)


@wp.kernel
def _relax(
    # in:
    source: wp.array4d[float],
    flows: wp.array4d[wp.vec4],
    albedos: wp.vec3,
    each: int,
    over: float,
    colour: int,
    # out:
    light: wp.array4d[float],
):
    """Cells of one colour; `each` albedos of a source follow one another in the light."""
    n, i, j, half = wp.tid()
    k = 2 * half + ((i + j + colour) & 1)
    if k >= light.shape[3]:
        return
    own = flows[n, i, j, k]
    got = albedos[n % each] * source[n / each, i, j, k]
    # Beyond the box's faces nothing flows: what is read in its place doesn't count.
    got += own[0] * light[n, wp.min(i + 1, light.shape[1] - 1), j, k]
    got += own[1] * light[n, i, wp.min(j + 1, light.shape[2] - 1), k]
    got += own[2] * light[n, i, j, wp.min(k + 1, light.shape[3] - 1)]
    if i > 0:
        got += flows[n, i - 1, j, k][0] * light[n, i - 1, j, k]
    if j > 0:
        got += flows[n, i, j - 1, k][1] * light[n, i, j - 1, k]
    if k > 0:
        got += flows[n, i, j, k - 1][2] * light[n, i, j, k - 1]
    now = light[n, i, j, k]
    light[n, i, j, k] = wp.max(now + over * (got * own[3] - now), 0.0)


@wp.func
def _overlap(cell: int, cells: int, fine: int, fines: int) -> float:
    """Share of a cell along an axis that one of the finer cells has."""
    each = float(fines) / float(cells)
    low = wp.max(float(cell) * each, float(fine))
    high = wp.min(float(cell + 1) * each, float(fine + 1))
    return wp.max(high - low, 0.0) / each


@wp.kernel
def _coarsen(
    # in:
    fine: wp.array4d[float],
    # out:
    out: wp.array4d[float],
):
    """Means over larger cells."""
    n, i, j, k = wp.tid()
    nx = fine.shape[1]
    ny = fine.shape[2]
    nz = fine.shape[3]
    total = float(0.0)
    for x in range((i * nx) / out.shape[1], wp.min(((i + 1) * nx - 1) / out.shape[1] + 1, nx)):
        a = _overlap(i, out.shape[1], x, nx)
        for y in range((j * ny) / out.shape[2], wp.min(((j + 1) * ny - 1) / out.shape[2] + 1, ny)):
            b = a * _overlap(j, out.shape[2], y, ny)
            for z in range((k * nz) / out.shape[3], wp.min(((k + 1) * nz - 1) / out.shape[3] + 1, nz)):
                total += b * _overlap(k, out.shape[3], z, nz) * fine[n, x, y, z]
    out[n, i, j, k] = total


@wp.func
def between_cells(light: wp.array4d[float], n: int, q: wp.vec3) -> float:
    """Trilinear between the centres of cells, which are at whole numbers of `q`; outside of them as at the nearest."""
    x = wp.clamp(q[0], 0.0, float(light.shape[1] - 1))
    y = wp.clamp(q[1], 0.0, float(light.shape[2] - 1))
    z = wp.clamp(q[2], 0.0, float(light.shape[3] - 1))
    i = int(x)
    j = int(y)
    k = int(z)
    a = wp.min(i + 1, light.shape[1] - 1)
    b = wp.min(j + 1, light.shape[2] - 1)
    c = wp.min(k + 1, light.shape[3] - 1)
    fy = y - float(j)
    fz = z - float(k)
    near = wp.lerp(
        wp.lerp(light[n, i, j, k], light[n, i, j, c], fz), wp.lerp(light[n, i, b, k], light[n, i, b, c], fz), fy
    )
    far = wp.lerp(
        wp.lerp(light[n, a, j, k], light[n, a, j, c], fz), wp.lerp(light[n, a, b, k], light[n, a, b, c], fz), fy
    )
    return wp.lerp(near, far, x - float(i))


@wp.func
def _place(cell: int, cells: int, coarse: int) -> float:
    """Of a cell's centre among the centres of coarser cells."""
    return (float(cell) + 0.5) * float(coarse) / float(cells) - 0.5


@wp.kernel
def _refine(
    # in:
    coarse: wp.array4d[float],
    # out:
    out: wp.array4d[float],
):
    """Trilinear between the centres of larger cells."""
    n, i, j, k = wp.tid()
    x = _place(i, out.shape[1], coarse.shape[1])
    y = _place(j, out.shape[2], coarse.shape[2])
    z = _place(k, out.shape[3], coarse.shape[3])
    out[n, i, j, k] = between_cells(coarse, n, wp.vec3(x, y, z))


def spread(
    medium: Medium, extinction: wp.array, source: wp.array, cell: wp.vec3, albedos: wp.vec3, each: int, light: wp.array
) -> None:
    """Solves for the fluence.

    Args:
        medium: The smoke, for its buffers.
        extinction: float [X, Y, Z], per voxel.
        source: float [L, X, Y, Z], q.
        cell: Edges of a cell.
        albedos, each: The first so many of the albedos are those of each source.
        light: float [L * each, X, Y, Z], written: f.
    """
    device = light.device
    grids = [(extinction.reshape((1, *extinction.shape)), source, cell)]
    while max(grids[-1][1].shape[1:]) > _FEWEST:
        counts, edges = grids[-1][1].shape[1:], grids[-1][2]
        fewer = tuple((n + 1) // 2 for n in counts)
        made = [medium.buffer((count, *fewer), float) for count in (1, source.shape[0])]
        for fine, coarse in zip(grids[-1], made, strict=False):
            wp.launch(_coarsen, coarse.shape, [fine], [coarse], device=device)
        grids.append((*made, wp.vec3(*(edge * n / m for edge, n, m in zip(edges, counts, fewer, strict=True)))))
    before = None
    for number, (thickness, stopped, edges) in reversed(list(enumerate(grids))):
        found = medium.buffer((light.shape[0], *stopped.shape[1:]), float) if number else light
        if before is None:
            found.zero_()
        else:
            wp.launch(_refine, found.shape, [before], [found], device=device)
        rounds = _FIRST if before is None else _ROUNDS
        _relax_rounds(medium, thickness, stopped, edges, albedos, each, found, rounds)
        before = found


def _relax_rounds(
    medium: Medium,
    thickness: wp.array,
    source: wp.array,
    cell: wp.vec3,
    albedos: wp.vec3,
    each: int,
    light: wp.array,
    rounds: int,
) -> None:
    """Rounds on one grid, beginning with `light`."""
    reach, flows = medium.buffer(light.shape, float), medium.buffer(light.shape, wp.vec4)
    halves = (*light.shape[:3], (light.shape[3] + 1) // 2)
    extinction = thickness.reshape(thickness.shape[1:])
    over = 2.0 / (1.0 + math.sin(math.pi / (max(light.shape[1:]) + _BEYOND)))
    for _ in range(rounds):
        wp.launch(_reach, light.shape, [extinction, light, cell], [reach], device=light.device)
        wp.launch(_couple, light.shape, [extinction, reach, cell, albedos, each], [flows], device=light.device)
        for sweep in range(2 * _SWEEPS):
            inputs = [source, flows, albedos, each, over, sweep & 1]
            wp.launch(_relax, halves, inputs, [light], device=light.device)
