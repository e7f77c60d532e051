"""Light that smoke scatters on and on, on a grid of few cells: what cells stop of a light, and what is seen of it.

How light goes from cell to cell between the two is in `fluence`. Lengths are in voxels; cell (0, 0, 0) begins at the
grid's corner.
"""

import functools
import math
from typing import Any

import warp as wp

from wlm_kernels.smoke.fluence import between_cells
from wlm_kernels.smoke.march import Medium, View, absorbed, clip, marched_ray, size_of
from wlm_kernels.smoke.march_coarse import by_bricks
from wlm_kernels.smoke.march_lights import Lattice, depths_at

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
