"""Multiple scattering in smoke by diffusion on a coarse grid, and the scattered light that a camera sees.

In a cell of extinction s and albedo a the fluence f obeys -div(D grad f) + (1 - a) s f = a q. The source q is the
direct light that the cell absorbs or scatters, D = 1 / (3 s + |grad f| / f) limits the flux (Wilson's sum), and half of
the fluence leaves at the box's faces (Marshak's condition). The equation is solved by red-black successive
over-relaxation in rounds, each with D from the fluence of the previous round, on grids from coarse to fine. On the
coarsest grid light reaches all cells within a round; a finer grid starts from the coarser grid's interpolated result.

Lengths are in voxels; cell (0, 0, 0) begins at the grid's corner.
"""

import math
from typing import Any

import warp as wp

from wlm_kernels.smoke.depth_lattice import Lattice, depths_at
from wlm_kernels.smoke.march import (
    BRICK,
    OPTIONS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    begin,
    between_nodes,
    box_of,
    for_smoke,
    has_smoke,
    in_tiles,
    look,
    parameters,
    pass_step,
    pixel_of,
    sample,
    steps_along,
    voxel,
    way_to_solid,
)
from wlm_kernels.smoke.naf_block import lane_sum
from wlm_kernels.smoke.settings import March

wp.set_module_options(OPTIONS)
_TINY = 1e-12
_FEWEST = 4  # cells along the longest edge below which a grid is not coarsened
_ROUNDS, _SWEEPS = 2, 6
_BEYOND = 4  # cells added to the grid's size in the factor of over-relaxation
_FIRST = 3  # rounds on the coarsest grid
_RAYS = 4096  # rays from a point light
_LEAST = 1e-5  # share of a ray's light below which it ends
_TURN = wp.constant(2.399963229728653)  # the golden angle
_FLUENCES = wp.constant(4)  # fluences that share a ray
_PARTS = 4  # largest number of samples of a cell along an axis for direct light


@wp.kernel
def _reach(
    # in:
    extinction: wp.array3d[float],
    light: wp.array4d[float],
    cell: wp.vec3,
    # out:
    reach: wp.array4d[float],
):
    """Computes the diffusion coefficient D of a cell; beyond the box the fluence is that of the nearest cell."""
    n, i, j, k = wp.tid()
    nx = light.shape[1]
    ny = light.shape[2]
    nz = light.shape[3]
    x = light[n, wp.min(i + 1, nx - 1), j, k] - light[n, wp.max(i - 1, 0), j, k]
    y = light[n, i, wp.min(j + 1, ny - 1), k] - light[n, i, wp.max(j - 1, 0), k]
    z = light[n, i, j, wp.min(k + 1, nz - 1)] - light[n, i, j, wp.max(k - 1, 0)]
    steep = 0.5 * wp.length(wp.cw_div(wp.vec3(x, y, z), cell)) / wp.max(light[n, i, j, k], _TINY)
    # The gradient is at most what the grid resolves, and light travels at most through the box.
    steep = wp.min(steep, 2.0 / wp.min(cell))
    farthest = (cell[0] + cell[1] + cell[2]) * float(wp.max(wp.max(nx, ny), nz))
    reach[n, i, j, k] = 1.0 / wp.max(3.0 * extinction[i, j, k] + steep, 1.0 / farthest)


@wp.func
def _flow(one: float, other: float, size: float) -> float:
    """Computes the flow of light between two cells `size` voxels apart, whose diffusion coefficients D are `one` and
    `other`, per volume and per difference of their fluences."""
    return 2.0 * one * other / ((one + other) * size * size)


@wp.func
def _exchange(own: float, reach: wp.array4d[float], n: int, i: int, j: int, k: int, size: float) -> float:
    """Computes the flow of light to cell (i, j, k), or the loss if this is beyond the box, per volume and fluence."""
    if i < 0 or i >= reach.shape[1] or j < 0 or j >= reach.shape[2] or k < 0 or k >= reach.shape[3]:
        return 1.0 / (size * (2.0 + 0.5 * size / own))
    return _flow(own, reach[n, i, j, k], size)


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
    """Computes a cell's flows to the next cells along x, y and z, and 1 over its loss by absorption and all flows."""
    n, i, j, k = wp.tid()
    own = reach[n, i, j, k]
    x = _exchange(own, reach, n, i + 1, j, k, cell[0])
    y = _exchange(own, reach, n, i, j + 1, k, cell[1])
    z = _exchange(own, reach, n, i, j, k + 1, cell[2])
    lost = (1.0 - albedos[n % each]) * extinction[i, j, k] + x + y + z
    lost += _exchange(own, reach, n, i - 1, j, k, cell[0])
    lost += _exchange(own, reach, n, i, j - 1, k, cell[1])
    lost += _exchange(own, reach, n, i, j, k - 1, cell[2])
    x = wp.where(i + 1 < reach.shape[1], x, 0.0)
    y = wp.where(j + 1 < reach.shape[2], y, 0.0)
    z = wp.where(k + 1 < reach.shape[3], z, 0.0)
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
    """Relaxes the red or the black cells (`colour` 0 or 1); `light` has an entry for each source and each albedo."""
    n, i, j, half = wp.tid()
    k = 2 * half + ((i + j + colour) & 1)
    if k >= light.shape[3]:
        return
    own = flows[n, i, j, k]
    got = albedos[n % each] * source[n / each, i, j, k]
    # Flows beyond the box's faces are 0: the clamped index reads a value that does not count.
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
def _covered(low: float, high: float, i: int) -> float:
    return wp.max(wp.min(high, float(i) + 1.0) - wp.max(low, float(i)), 0.0)


@for_smoke
def _mean(smoke_type: Any, rows: int, length: int) -> wp.Kernel:
    field_type = smoke_type.vars["density"].type

    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        field: field_type,
        cell: wp.vec3,
        # out:
        out: wp.array3d[float],
    ):
        """Averages a field over each cell. A warp has a cell; of each brick its threads have rows along z."""
        i, j, k, lane = wp.tid()
        low = wp.cw_mul(wp.vec3(float(i), float(j), float(k)), cell)
        high = low + cell
        first = wp.vec3i(int(low[0]), int(low[1]), int(low[2]))
        end = wp.vec3i()
        for a in range(3):
            end[a] = wp.min(int(wp.ceil(high[a])), smoke.cells[a])
        total = float(0.0)
        for a in range(first[0] // BRICK, (end[0] - 1) // BRICK + 1):
            for b in range(first[1] // BRICK, (end[1] - 1) // BRICK + 1):
                for c in range(first[2] // BRICK, (end[2] - 1) // BRICK + 1):
                    if has_smoke(smoke, float(BRICK) * wp.vec3(float(a), float(b), float(c))):
                        x0 = wp.max(BRICK * a, first[0])
                        y0 = wp.max(BRICK * b, first[1]) + lane // wp.static(length)
                        z0 = wp.max(BRICK * c, first[2]) + lane % wp.static(length)
                        for z in range(z0, wp.min(BRICK * (c + 1), end[2]), wp.static(length)):
                            for y in range(y0, wp.min(BRICK * (b + 1), end[1]), wp.static(rows)):
                                row = float(0.0)
                                for x in range(x0, wp.min(BRICK * (a + 1), end[0])):
                                    row += _covered(low[0], high[0], x) * voxel(field, smoke, x, y, z)
                                total += _covered(low[1], high[1], y) * _covered(low[2], high[2], z) * row
        total = lane_sum(total, wp.static(rows * length))
        if lane == 0:
            out[i, j, k] = total / (cell[0] * cell[1] * cell[2])

    return kernel


def mean(medium: Medium, field: wp.array, cell: wp.vec3, out: wp.array) -> None:
    """Computes the mean of the smoke's density or temperature, `field`, over each cell of a coarse grid, `out`, float
    [X, Y, Z], whose cells have the edges `cell` in voxels. Bricks that `medium` knows as empty count as 0."""
    rows, length = (4, 8) if medium.device.is_cuda else (1, 1)
    _mean(medium, (*out.shape, rows * length), [field, cell], [out], rows, length)


@wp.kernel
def _coarsen(
    # in:
    fine: wp.array4d[float],
    edges: wp.vec3,
    # out:
    out: wp.array4d[float],
):
    """Averages over cells whose edges are 1 to 2 cells of the finer grid."""
    n, i, j, k = wp.tid()
    low = wp.cw_mul(wp.vec3(float(i), float(j), float(k)), edges)
    high = low + edges
    total = float(0.0)
    for x in range(int(low[0]), wp.min(int(wp.ceil(high[0])), fine.shape[1])):
        for y in range(int(low[1]), wp.min(int(wp.ceil(high[1])), fine.shape[2])):
            share = _covered(low[0], high[0], x) * _covered(low[1], high[1], y)
            for z in range(int(low[2]), wp.min(int(wp.ceil(high[2])), fine.shape[3])):
                total += share * _covered(low[2], high[2], z) * fine[n, x, y, z]
    out[n, i, j, k] = total / (edges[0] * edges[1] * edges[2])


@wp.func
def _place(cell: int, cells: int, coarse: int) -> float:
    """Converts the centre of a cell of a fine grid to the index of a cell of a coarse grid, with a fraction."""
    return (float(cell) + 0.5) * float(coarse) / float(cells) - 0.5


@wp.kernel
def _refine(
    # in:
    coarse: wp.array4d[float],
    # out:
    out: wp.array4d[float],
):
    n, i, j, k = wp.tid()
    x = _place(i, out.shape[1], coarse.shape[1])
    y = _place(j, out.shape[2], coarse.shape[2])
    z = _place(k, out.shape[3], coarse.shape[3])
    out[n, i, j, k] = between_nodes(coarse[n], wp.vec3(x, y, z))


def spread(
    medium: Medium, extinction: wp.array, source: wp.array, cell: wp.vec3, albedos: wp.vec3, each: int, light: wp.array
) -> None:
    """Solves for the fluence f of light that was scattered at least once, of L lights, for the first `each` of three
    albedos: `light`, float [L * each, X, Y, Z], is written.

    `extinction`, float [X, Y, Z], is that per voxel of each cell of the coarse grid, with edges `cell` in voxels, and
    `source`, float [L, X, Y, Z], the source q of each light.
    """
    device = light.device
    grids = [(extinction.reshape((1, *extinction.shape)), source, cell)]
    while max(grids[-1][1].shape[1:]) > _FEWEST:
        counts, edges = grids[-1][1].shape[1:], grids[-1][2]
        fewer = tuple((n + 1) // 2 for n in counts)
        made = [medium.buffer((count, *fewer), float) for count in (1, source.shape[0])]
        times = wp.vec3(*(n / m for n, m in zip(counts, fewer, strict=True)))
        for fine, coarse in zip(grids[-1], made, strict=False):
            wp.launch(_coarsen, coarse.shape, [fine, times], [coarse], device=device)
        grids.append((*made, wp.cw_mul(edges, times)))
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


@wp.func
def _splat(place: wp.vec3, cell: wp.vec3, light: float, out: wp.array3d[float]):
    q = wp.cw_div(place, cell) - wp.vec3(0.5, 0.5, 0.5)
    i = int(wp.floor(q[0]))
    j = int(wp.floor(q[1]))
    k = int(wp.floor(q[2]))
    f = q - wp.vec3(float(i), float(j), float(k))
    for corner in range(8):
        x = corner & 1
        y = (corner >> 1) & 1
        z = corner >> 2
        share = wp.where(x == 1, f[0], 1.0 - f[0]) * wp.where(y == 1, f[1], 1.0 - f[1])
        share *= wp.where(z == 1, f[2], 1.0 - f[2])
        a = wp.clamp(i + x, 0, out.shape[0] - 1)
        b = wp.clamp(j + y, 0, out.shape[1] - 1)
        c = wp.clamp(k + z, 0, out.shape[2] - 1)
        wp.atomic_add(out, a, b, c, share * light)


@for_smoke
def _shoot(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        place: wp.vec3,
        radius: float,
        step: float,
        cell: wp.vec3,
        power: float,
        # out:
        out: wp.array3d[float],
    ):
        n = wp.tid()
        height = 1.0 - (2.0 * float(n) + 1.0) / float(_RAYS)
        around = float(n) * _TURN
        across = wp.sqrt(1.0 - height * height)
        way = wp.vec3(across * wp.cos(around), height, across * wp.sin(around))
        r = steps_along(box_of(smoke), place, way, step)
        if smoke.solid.mesh != wp.uint64(0) and r.count > 0:
            ahead = (way_to_solid(smoke.solid, place, way) - r.first) / r.length
            r.count = int(wp.clamp(ahead, 0.0, float(r.count)))
        r.offset = 0.5
        left = float(power)
        pending = float(0.0)
        moment = wp.vec3()
        before = wp.vec3()
        while r.done < r.count:
            r = look(r, smoke)
            r.done += 1
            stopped = left * absorbed(r.x)
            left -= stopped
            # Within the light's radius its irradiance is constant.
            if r.distance < radius:
                stopped *= r.distance * r.distance / (radius * radius)
            # Light between the same eight centres is added to them at once.
            q = wp.cw_div(r.place, cell) - wp.vec3(0.5, 0.5, 0.5)
            now = wp.vec3(wp.floor(q[0]), wp.floor(q[1]), wp.floor(q[2]))
            if pending > 0.0 and wp.length_sq(now - before) > 0.5:
                _splat(moment / pending, cell, pending, out)
                pending = float(0.0)
                moment = wp.vec3()
            before = now
            pending += stopped
            moment += stopped * r.place
            if left < _LEAST * power:
                r.done = r.count
        if pending > 0.0:
            _splat(moment / pending, cell, pending, out)

    return kernel


@for_smoke
def _stop(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        nodes: wp.array3d[wp.vec2],
        lattice: Lattice,
        cell: wp.vec3,
        parts: wp.vec3i,
        # out:
        out: wp.array3d[float],
    ):
        i, j, k = wp.tid()
        total = float(0.0)
        for x in range(parts[0]):
            for y in range(parts[1]):
                for z in range(parts[2]):
                    a = float(i) + (float(x) + 0.5) / float(parts[0])
                    b = float(j) + (float(y) + 0.5) / float(parts[1])
                    c = float(k) + (float(z) + 0.5) / float(parts[2])
                    p = wp.cw_mul(cell, wp.vec3(a, b, c))
                    sigma = smoke.extinction * sample(smoke, p)
                    if sigma > 0.0:
                        total += sigma * wp.exp(-depths_at(nodes, lattice, p)[0])
        out[i, j, k] = 4.0 * wp.pi * total / float(parts[0] * parts[1] * parts[2])

    return kernel


@for_smoke
def _gather(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        march: MarchParameters,
        cell: wp.vec3,
        light: wp.array4d[float],
        # out:
        out: wp.array4d[float],
        thin: wp.array2d[float],
    ):
        several, a, b, lane = wp.tid()
        row, column = pixel_of(a, b, lane)
        if row >= view.height or column >= view.width:
            return
        first = several * _FLUENCES
        r = begin(view, row, column, smoke, march.step, 0.5)
        total = wp.vec4()
        from_thin = wp.vec4()
        opacity = float(0.0)
        while r.done < r.count:
            r = look(r, smoke)
            if r.x > 0.0:
                q = wp.cw_div(r.place, cell) - wp.vec3(0.5, 0.5, 0.5)
                share = r.t * absorbed(r.x)
                clear = share * wp.exp(-r.sigma * wp.min(cell))
                for n in range(_FLUENCES):
                    if first + n < light.shape[0]:
                        here = between_nodes(light[first + n], q)
                        total[n] += share * here
                        from_thin[n] += clear * here
                opacity += clear
            r = pass_step(r, march.cutoff)
        for n in range(_FLUENCES):
            if first + n < light.shape[0]:
                out[0, first + n, row, column] = total[n] / (4.0 * wp.pi)
                out[1, first + n, row, column] = from_thin[n] / (4.0 * wp.pi)
        if several == 0:
            thin[row, column] = opacity

    return kernel


def shoot(
    medium: Medium, place: wp.vec3, radius: float, step: float, cell: wp.vec3, power: float, out: wp.array
) -> None:
    """Adds to each cell of `out`, float [X, Y, Z], the direct light that it extinguishes from a point light of some
    `power`, which all its rays together carry at their start.

    All lengths are in voxels: the light's place, the `radius` within which its irradiance is constant, the longest step
    along its rays, and the edges of a cell.
    """
    _shoot(medium, _RAYS, [place, radius, step, cell, power / _RAYS], [out])


def stop(medium: Medium, depths: tuple[Lattice, wp.array], cell: wp.vec3, step: float, out: wp.array) -> None:
    """Computes the direct light that each cell extinguishes, `out`, float [X, Y, Z], per volume, from a light at
    infinity of irradiance 4 pi.

    `depths` is the result of `depth_lattice.reach`; `cell` are the edges of a cell in voxels. `step` is the largest
    distance in voxels between samples in a cell, unless this needs more than four along an axis.
    """
    lattice, nodes = depths
    parts = wp.vec3i(*(max(1, min(_PARTS, math.ceil(edge / step))) for edge in cell))
    _stop(medium, out.shape, [nodes, lattice, cell, parts], [out])


def gather(
    medium: Medium, view: View, march: March, cell: wp.vec3, light: wp.array, out: wp.array, thin: wp.array
) -> None:
    """Computes the light that smoke of albedo 1 scatters to a camera from a given fluence.

    Args:
        medium: The smoke.
        view: The camera, [H, W] pixels.
        march: Only its step and cutoff are used.
        cell: Edges of a cell in voxels.
        light: float [N, X, Y, Z], N fluences, at least one.
        out: float [2, N, H, W], written: all light, and the light from thin smoke, where each sample is weighted by the
            transparency that a cell of its density has.
        thin: float [H, W], written: the opacity of thin smoke, weighted in the same way.
    """
    size = (-(-light.shape[0] // int(_FLUENCES)), *in_tiles(*thin.shape))
    _gather(medium, size, [view, parameters(march), cell, light], [out, thin])
