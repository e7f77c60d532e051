"""Fluence of light that smoke scatters on and on: diffusion on a grid of few cells, solved on coarser ones first.

In a cell of extinction s and albedo a the fluence f obeys -div(D grad f) + (1 - a) s f = a q, where q is the light that
comes straight from its source and ends there, D = 1 / (3 s + |grad f| / f) so that no more light flows than there is
(Wilson's sum), and at the box's faces half of the fluence leaves (Marshak's condition). Rounds of successive
over-relaxation, on the cells of one colour of a chequerboard and then on the others, solve it for the D of the f
before. The coarsest grid has a few cells, between which light goes everywhere in as many sweeps; each finer one begins
with what the one before found.
"""

import functools
import math
from typing import Any

import warp as wp

from wlm_kernels.smoke.march import Medium, View, absorbed, clip, marched_ray, size_of
from wlm_kernels.smoke.march_coarse import by_bricks
from wlm_kernels.smoke.march_lights import Lattice, depths_at

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


_OPTIONS = {"enable_backward": False}
wp.set_module_options(_OPTIONS)
_WAYS = 4096  # from a point light
_LEAST = 1e-5  # of a way's light, of which no more is followed
_TURN = wp.constant(2.399963229728653)  # the golden angle
_PARTS = 4  # of a cell along each axis at most, at whose middles light that comes straight from far is known


@wp.func
def _splat(place: wp.vec3, cell: wp.vec3, light: float, out: wp.array3d[float]):
    """Adds light to the eight cells around a place; beyond the outermost centres to these."""
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


@functools.cache
def light_kernels(dtype: Any) -> tuple[wp.Kernel, wp.Kernel, wp.Kernel]:
    """Builds (once) the kernels `shoot`, `leave` and `gather` for densities of `wp.float32` or `wp.float16`."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def shoot(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        place: wp.vec3,
        radius: float,
        step: float,
        cell: wp.vec3,
        power: float,
        # out:
        out: wp.array3d[float],
    ):
        """One way from a point light: all light that ends on it is left to cells, those that it ends in."""
        n = wp.tid()
        height = 1.0 - (2.0 * float(n) + 1.0) / float(_WAYS)
        around = float(n) * _TURN
        across = wp.sqrt(1.0 - height * height)
        way = wp.vec3(across * wp.cos(around), height, across * wp.sin(around))
        span = clip(size_of(density), place, way)
        first = wp.max(span[0], 0.0)
        if span[1] <= first:
            return
        count = int(wp.ceil((span[1] - first) / step))
        d = (span[1] - first) / float(count)
        left = float(power)
        held = float(0.0)
        moment = wp.vec3()
        before = wp.vec3()
        for m in range(count):
            s = first + (float(m) + 0.5) * d
            p = place + s * way
            ended = left * absorbed(extinction * by_bricks(density, bricks, p) * d)
            left -= ended
            # Within its radius a light is as bright as there.
            if s < radius:
                ended *= s * s / (radius * radius)
            # Light between the same eight centres is left to them at once.
            q = wp.cw_div(p, cell) - wp.vec3(0.5, 0.5, 0.5)
            now = wp.vec3(wp.floor(q[0]), wp.floor(q[1]), wp.floor(q[2]))
            if held > 0.0 and wp.length_sq(now - before) > 0.5:
                _splat(moment / held, cell, held, out)
                held = float(0.0)
                moment = wp.vec3()
            before = now
            held += ended
            moment += ended * p
            if left < _LEAST * power:
                break
        if held > 0.0:
            _splat(moment / held, cell, held, out)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def leave(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        nodes: wp.array3d[wp.vec2],
        extinction: float,
        lattice: Lattice,
        cell: wp.vec3,
        parts: wp.vec3i,
        # out:
        out: wp.array3d[float],
    ):
        """What a cell stops of the light that comes straight from far off, per volume."""
        i, j, k = wp.tid()
        total = float(0.0)
        for x in range(parts[0]):
            for y in range(parts[1]):
                for z in range(parts[2]):
                    a = float(i) + (float(x) + 0.5) / float(parts[0])
                    b = float(j) + (float(y) + 0.5) / float(parts[1])
                    c = float(k) + (float(z) + 0.5) / float(parts[2])
                    p = wp.cw_mul(cell, wp.vec3(a, b, c))
                    sigma = extinction * by_bricks(density, bricks, p)
                    if sigma > 0.0:
                        total += sigma * wp.exp(-depths_at(nodes, lattice, p)[0])
        out[i, j, k] = 4.0 * wp.pi * total / float(parts[0] * parts[1] * parts[2])

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def gather(
        # in:
        density: wp.array3d[dtype],
        bricks: wp.array3d[wp.uint8],
        extinction: float,
        view: View,
        step: float,
        cutoff: float,
        cell: wp.vec3,
        light: wp.array4d[float],
        # out:
        out: wp.array4d[float],
        thin: wp.array2d[float],
    ):
        """What smoke of albedo 1 in that light sends to a pixel, and of that what smoke of thin cells sends."""
        n, row, column = wp.tid()
        r = marched_ray(view, row, column, size_of(density), step)
        total = float(0.0)
        from_thin = float(0.0)
        seen = float(0.0)
        tau = float(0.0)
        for m in range(r.count):
            p = r.origin + (r.first + (float(m) + 0.5) * r.length) * r.direction
            x = extinction * by_bricks(density, bricks, p) * r.length
            if x > 0.0:
                here = between_cells(light, n, wp.cw_div(p, cell) - wp.vec3(0.5, 0.5, 0.5))
                share = wp.exp(-tau) * absorbed(x)
                clear = share * wp.exp(-x / r.length * wp.min(cell))
                total += share * here
                from_thin += clear * here
                seen += clear
                tau += x
                if wp.exp(-tau) < cutoff:
                    break
        out[0, n, row, column] = total / (4.0 * wp.pi)
        out[1, n, row, column] = from_thin / (4.0 * wp.pi)
        if n == 0:
            thin[row, column] = seen

    return shoot, leave, gather


def shoot(
    medium: Medium,
    place: wp.vec3,
    radius: float,
    step: float,
    cell: wp.vec3,
    power: float,
    out: wp.array,
    bricks: wp.array,
) -> None:
    """Adds to cells what they stop of the light that comes straight from a point.

    Args:
        medium: The smoke.
        place: Of the light.
        radius: At smaller distances the irradiance is as at this one.
        step: The longest step on the way.
        cell: Edges of a cell.
        power: Of the light.
        out: float [X, Y, Z], cells.
        bricks: Of `occupied`.
    """
    density = medium.density
    inputs = [density, bricks, medium.extinction, place, radius, step, cell, power / _WAYS]
    wp.launch(light_kernels(density.dtype)[0], _WAYS, inputs=inputs, outputs=[out], device=density.device)


def leave(
    medium: Medium, depths: tuple[Lattice, wp.array], cell: wp.vec3, step: float, out: wp.array, bricks: wp.array
) -> None:
    """What cells stop of the light that comes straight from infinitely far off, of an irradiance of 4 pi.

    Args:
        medium, bricks: As for `shoot`.
        depths: Of `march_lights.reach`.
        cell: Edges of a cell.
        step: Between places of a cell at which light is known; but there are no more than four of them along an axis.
        out: float [X, Y, Z], written: per volume.
    """
    density, (lattice, nodes) = medium.density, depths
    parts = wp.vec3i(*(max(1, min(_PARTS, math.ceil(edge / step))) for edge in cell))
    inputs = [density, bricks, nodes, medium.extinction, lattice, cell, parts]
    wp.launch(light_kernels(density.dtype)[1], out.shape, inputs=inputs, outputs=[out], device=density.device)


def gather(
    medium: Medium,
    view: View,
    step: float,
    cutoff: float,
    cell: wp.vec3,
    light: wp.array,
    out: wp.array,
    thin: wp.array,
    bricks: wp.array,
) -> None:
    """What smoke of albedo 1 in a fluence sends to a camera.

    Args:
        medium, view, bricks: As for `shoot` and the other marches.
        step: The longest step along a ray.
        cutoff: A ray ends where less than this is left of its transparency.
        cell: Edges of a cell.
        light: float [N, X, Y, Z], fluences; at least one.
        out: float [2, N, H, W], written: all of it, and what thin smoke sends, where each place counts by the
            transparency of a cell of smoke as dense as there.
        thin: float [H, W], written: likewise of opacity.
    """
    density, size = medium.density, out.shape[1:]
    inputs = [density, bricks, medium.extinction, view, step, cutoff, cell, light]
    wp.launch(light_kernels(density.dtype)[2], size, inputs=inputs, outputs=[out, thin], device=density.device)
