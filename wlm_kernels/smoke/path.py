"""Random numbers and directions of paths: a phase function's, and a sky's by its brightness."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wlm_kernels.smoke.march import BRICK, Medium, View, clip, density_at, phase, ray

_TWO_PI = wp.constant(2.0 * math.pi)


@wp.struct
class Sky:
    """Light from infinitely far off, a map of texels of one radiance each.

    Row 0 is around +y; column 0 begins at +x and columns go on towards +z. `rows` and `columns` are running sums of the
    chances of a row, and of a column within its row. `total` is the integral of the mean radiance over the sphere.
    """

    radiance: wp.array2d[wp.vec3]
    rows: wp.array1d[float]
    columns: wp.array2d[float]
    total: float


@wp.struct
class Way:
    """A direction, its chance per solid angle, and the random state after it."""

    direction: wp.vec3
    chance: float
    random: wp.uint64


@wp.func
def stir(x: wp.uint64) -> wp.uint64:
    x = x ^ (x >> wp.uint64(31))
    x = x * wp.uint64(6364136223846793005)
    x = x ^ (x >> wp.uint64(29))
    x = x * wp.uint64(3935559000370003845)
    return x ^ (x >> wp.uint64(32))


@wp.func
def following(random: wp.uint64) -> wp.uint64:
    return random * wp.uint64(6364136223846793005) + wp.uint64(1442695040888963407)


@wp.func
def bits(random: wp.uint64) -> wp.uint32:
    """32 random bits (PCG-XSH-RR, O'Neill 2014)."""
    x = wp.uint32(((random >> wp.uint64(18)) ^ random) >> wp.uint64(27))
    turn = wp.uint32(random >> wp.uint64(59))
    return (x >> turn) | (x << ((wp.uint32(32) - turn) & wp.uint32(31)))


@wp.func
def uniform(random: wp.uint64) -> float:
    """A number of at least 0 and below 1, of 24 bits."""
    return float(bits(random) >> wp.uint32(8)) * (1.0 / 16777216.0)


@wp.func
def scatter(g: float, d: wp.vec3, u: float, v: float) -> wp.vec3:
    """A direction by the Henyey-Greenstein phase function of a path that goes along d."""
    cosine = 1.0 - 2.0 * u
    if wp.abs(g) > 1.0e-3:
        share = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
        cosine = (1.0 + g * g - share * share) / (2.0 * g)
    cosine = wp.clamp(cosine, -1.0, 1.0)
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    # Two directions across d without a division by nearly 0 (Duff et al. 2017).
    sign = wp.where(d[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + d[2])
    b = d[0] * d[1] * a
    across = wp.vec3(1.0 + sign * d[0] * d[0] * a, sign * b, -sign * d[0])
    beside = wp.vec3(b, sign + d[1] * d[1] * a, -d[1])
    angle = _TWO_PI * v
    return wp.normalize(cosine * d + sine * (wp.cos(angle) * across + wp.sin(angle) * beside))


@wp.func
def texel(sky: Sky, d: wp.vec3) -> wp.vec3:
    """The sky's radiance in a direction."""
    rows = sky.radiance.shape[0]
    columns = sky.radiance.shape[1]
    row = int(wp.acos(wp.clamp(d[1], -1.0, 1.0)) / (0.5 * _TWO_PI) * float(rows))
    turn = wp.atan2(d[2], d[0])
    if turn < 0.0:
        turn += _TWO_PI
    column = int(turn / _TWO_PI * float(columns))
    return sky.radiance[wp.clamp(row, 0, rows - 1), wp.clamp(column, 0, columns - 1)]


@wp.func
def chance_of(sky: Sky, radiance: wp.vec3) -> float:
    """Chance per solid angle of a direction in a texel."""
    return (radiance[0] + radiance[1] + radiance[2]) / (3.0 * sky.total)


@wp.func
def toward_sky(sky: Sky, random: wp.uint64) -> Way:
    """A direction by the sky's brightness."""
    way = Way()
    rows = sky.radiance.shape[0]
    columns = sky.radiance.shape[1]
    random = following(random)
    u = uniform(random)
    row = int(0)
    past = rows - 1
    while row < past:
        middle = (row + past) // 2
        if sky.rows[middle] > u:
            past = middle
        else:
            row = middle + 1
    random = following(random)
    u = uniform(random)
    column = int(0)
    past = columns - 1
    while column < past:
        middle = (column + past) // 2
        if sky.columns[row, middle] > u:
            past = middle
        else:
            column = middle + 1
    top = wp.cos(0.5 * _TWO_PI * float(row) / float(rows))
    bottom = wp.cos(0.5 * _TWO_PI * float(row + 1) / float(rows))
    random = following(random)
    height = wp.lerp(top, bottom, uniform(random))
    random = following(random)
    turn = _TWO_PI * (float(column) + uniform(random)) / float(columns)
    across = wp.sqrt(wp.max(1.0 - height * height, 0.0))
    way.direction = wp.vec3(across * wp.cos(turn), height, across * wp.sin(turn))
    way.chance = chance_of(sky, sky.radiance[row, column])
    way.random = random
    return way


_NEVER = wp.constant(1.0e30)
_TENTH_BIT = wp.constant(1.0 / 1024.0)


@wp.struct
class Walk:
    """A ray's walk through bricks: the one that it is in, from `t` to `border` along the ray, which ends at `end`.

    `leave` has the distances at which it leaves the brick along each axis, `across` those that it takes through one.
    """

    cell: wp.vec3i
    leave: wp.vec3
    across: wp.vec3
    t: float
    border: float
    end: float
    most: float


@wp.func
def _border(cell: int, count: int, edge: float, p: float, d: float) -> float:
    """Distance at which a ray leaves a brick along one axis; the outermost bricks have no outer border."""
    if d > 1.0e-9 and cell < count - 1:
        return (float(cell + 1) * edge - p) / d
    if d < -1.0e-9 and cell > 0:
        return (float(cell) * edge - p) / d
    return _NEVER


@wp.func
def enter(bounds: wp.array3d[float], edge: float, size: wp.vec3, p: wp.vec3, d: wp.vec3, limit: float) -> Walk:
    """The brick in which a ray begins; none where it misses the smoke, or up to its limit."""
    w = Walk()
    span = clip(size, p, d)
    w.t = wp.max(span[0], 0.0)
    w.end = wp.min(span[1], limit)
    for axis in range(3):
        at = int(wp.floor((p[axis] + w.t * d[axis]) / edge))
        w.cell[axis] = wp.clamp(at, 0, bounds.shape[axis] - 1)
        w.leave[axis] = _border(w.cell[axis], bounds.shape[axis], edge, p[axis], d[axis])
        w.across[axis] = edge / wp.max(wp.abs(d[axis]), 1.0e-9)
    w.border = wp.min(wp.min(w.leave[0], wp.min(w.leave[1], w.leave[2])), w.end)
    w.most = bounds[w.cell[0], w.cell[1], w.cell[2]]
    return w


@wp.func
def _further(cell: int, count: int, leave: float, across: float) -> float:
    """Distance at which a ray leaves the brick that it has come to along an axis."""
    return wp.where(cell > 0 and cell < count - 1, leave + across, _NEVER)


@wp.func
def onward(w: Walk, bounds: wp.array3d[float], d: wp.vec3) -> Walk:
    """The walk in the next brick, or at its end."""
    w.t = w.border
    if w.t < w.end:
        if w.leave[0] <= w.leave[1] and w.leave[0] <= w.leave[2]:
            w.cell[0] += wp.where(d[0] > 0.0, 1, -1)
            w.leave[0] = _further(w.cell[0], bounds.shape[0], w.leave[0], w.across[0])
        elif w.leave[1] <= w.leave[2]:
            w.cell[1] += wp.where(d[1] > 0.0, 1, -1)
            w.leave[1] = _further(w.cell[1], bounds.shape[1], w.leave[1], w.across[1])
        else:
            w.cell[2] += wp.where(d[2] > 0.0, 1, -1)
            w.leave[2] = _further(w.cell[2], bounds.shape[2], w.leave[2], w.across[2])
        w.border = wp.min(wp.min(w.leave[0], wp.min(w.leave[1], w.leave[2])), w.end)
        w.most = bounds[w.cell[0], w.cell[1], w.cell[2]]
    return w


@wp.func
def drawn(density: wp.array3d[Any], p: wp.vec3, random: wp.uint64) -> float:
    """The density of one of the voxels around a place, whose mean is that of `density_at`."""
    x = bits(random)
    i = int(wp.floor(p[0] + (float(x & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    j = int(wp.floor(p[1] + (float((x >> wp.uint32(10)) & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    k = int(wp.floor(p[2] + (float((x >> wp.uint32(20)) & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    if i < 0 or j < 0 or k < 0 or i >= density.shape[0] or j >= density.shape[1] or k >= density.shape[2]:
        return 0.0
    return float(density[i, j, k])


_OPTIONS = {"enable_backward": False}
_NEVER = wp.constant(1.0e30)
_GLOW = 1.0 / BRICK  # least majorant where smoke glows: about one place a brick at which its light is gathered
_SLACK = 1.0001  # of a majorant over rounding of interpolated densities
_DEEP = 2.0  # optical depth through a brick, of the densest smoke, that bricks may have
_THREADS = 2**20  # on a GPU, of which each traces several parts one after another
_FAINT = wp.constant(0.1)  # what is below this is carried on by fewer paths
_FOUR_PI = wp.constant(4.0 * math.pi)


@wp.struct
class PathLight:
    """A light, in voxels.

    `place` is the direction to a light infinitely far off, of length 1, or a point light's position. `colour` is the
    irradiance over 4 pi, of a point light that at a distance of one voxel. Within `radius` of a point light its
    irradiance no longer grows.
    """

    place: wp.vec3
    colour: wp.vec3
    point: int
    radius: float


@wp.struct
class PathSettings:
    """`albedo` by colour; paths end after `highest` scatterings; `kept` of them have planes of their own."""

    albedo: wp.vec3
    g: float
    highest: int
    kept: int
    samples: int
    key: wp.uint64


@wp.struct
class _Flight:
    """Where a free path ends, the light gathered on its way, and the random state after it."""

    t: float
    hit: int
    glow: float
    random: wp.uint64


@wp.struct
class _Passed:
    """The share of light that passes, and the random state after it."""

    share: float
    random: wp.uint64


@wp.func
def _fly(
    density: wp.array3d[Any],
    temperature: wp.array3d[Any],
    bounds: wp.array3d[float],
    edge: float,
    low: wp.vec3,
    size: wp.vec3,
    extinction: float,
    emission: float,
    p: wp.vec3,
    d: wp.vec3,
    limit: float,
    random: wp.uint64,
) -> _Flight:
    """A free path by delta tracking, up to a limit."""
    f = _Flight()
    glow = float(0.0)
    random = following(random)
    left = -wp.log(1.0 - uniform(random))  # optical depth, of the majorants, to the next place that is looked at
    w = enter(bounds, edge, size, p - low, d, limit)
    while w.t < w.end:
        through = w.most * (w.border - w.t)
        if left >= through:
            left -= through
            w = onward(w, bounds, d)
        else:
            w.t += left / w.most
            at = p + w.t * d
            if emission > 0.0:
                glow += emission * density_at(temperature, at) / w.most
            random = following(random)
            found = extinction * drawn(density, at, random)
            random = following(random)
            if uniform(random) * w.most < found:
                f.hit = 1
                f.t = w.t
                w.end = -1.0
            random = following(random)
            left = -wp.log(1.0 - uniform(random))
    f.glow = glow
    f.random = random
    return f


@wp.func
def _passed(
    density: wp.array3d[Any],
    bounds: wp.array3d[float],
    edge: float,
    low: wp.vec3,
    size: wp.vec3,
    extinction: float,
    p: wp.vec3,
    d: wp.vec3,
    limit: float,
    random: wp.uint64,
) -> _Passed:
    """The share of light that passes along a ray up to a limit, by ratio tracking."""
    f = _Passed()
    share = float(1.0)
    random = following(random)
    left = -wp.log(1.0 - uniform(random))
    w = enter(bounds, edge, size, p - low, d, limit)
    while w.t < w.end:
        through = w.most * (w.border - w.t)
        if left >= through:
            left -= through
            w = onward(w, bounds, d)
        else:
            w.t += left / w.most
            random = following(random)
            share = share * (1.0 - extinction * drawn(density, p + w.t * d, random) / w.most)
            if share < _FAINT:
                random = following(random)
                if uniform(random) * _FAINT < share:
                    share = _FAINT
                else:
                    share = 0.0
                    w.end = -1.0
            random = following(random)
            left = -wp.log(1.0 - uniform(random))
    f.share = share
    f.random = random
    return f


@dataclass(frozen=True)
class _Kernels:
    """Of one type of density."""

    majorants: wp.Kernel
    window: wp.Kernel
    coarser: wp.Kernel
    trace: wp.Kernel


@functools.cache
def path_kernels(dtype: Any, solid: bool) -> _Kernels:
    """Builds (once) the kernels for densities of a type, `wp.float32` or `wp.float16`; `solid`: with obstacles."""

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def majorants(
        # in:
        density: wp.array3d[dtype],
        temperature: wp.array3d[dtype],
        extinction: float,
        emission: float,
        least: float,
        slack: float,
        # out:
        out: wp.array3d[float],
    ):
        a, b, c = wp.tid()
        most = float(0.0)
        hot = float(0.0)
        # A point in a brick reads half a voxel beyond it too.
        for i in range(wp.max(a * BRICK - 1, 0), wp.min((a + 1) * BRICK + 1, density.shape[0])):
            for j in range(wp.max(b * BRICK - 1, 0), wp.min((b + 1) * BRICK + 1, density.shape[1])):
                for k in range(wp.max(c * BRICK - 1, 0), wp.min((c + 1) * BRICK + 1, density.shape[2])):
                    most = wp.max(most, float(density[i, j, k]))
                    hot = wp.max(hot, float(temperature[i, j, k]))
        most = most * extinction * slack
        if emission > 0.0 and hot > 0.0:
            most = wp.max(most, least)
        out[a, b, c] = most

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def window(
        # in:
        bounds: wp.array3d[float],
        begin: wp.vec3i,
        # out:
        out: wp.array3d[float],
    ):
        a, b, c = wp.tid()
        out[a, b, c] = bounds[begin[0] + a, begin[1] + b, begin[2] + c]

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def coarser(
        # in:
        bounds: wp.array3d[float],
        # out:
        out: wp.array3d[float],
    ):
        a, b, c = wp.tid()
        most = float(0.0)
        for i in range(2 * a, wp.min(2 * a + 2, bounds.shape[0])):
            for j in range(2 * b, wp.min(2 * b + 2, bounds.shape[1])):
                for k in range(2 * c, wp.min(2 * c + 2, bounds.shape[2])):
                    most = wp.max(most, bounds[i, j, k])
        out[a, b, c] = most

    @wp.func
    def free(mesh: wp.uint64, p: wp.vec3, d: wp.vec3) -> float:
        """Distance to the first obstacle along a ray, or never."""
        if wp.static(solid):
            found = wp.mesh_query_ray(mesh, p, d, _NEVER)
            return wp.where(found.result, found.t, _NEVER)
        return _NEVER

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def trace(
        # in:
        density: wp.array3d[dtype],
        temperature: wp.array3d[dtype],
        bounds: wp.array3d[float],
        edge: float,
        low: wp.vec3,
        size: wp.vec3,
        extinction: float,
        emission: float,
        view: View,
        lights: wp.array1d[PathLight],
        sky: Sky,
        mesh: wp.uint64,
        settings: PathSettings,
        first: int,
        last: int,
        parts: int,
        together: int,
        # out:
        out: wp.array3d[wp.vec3],
    ):
        group, row, column = wp.tid()
        count = lights.shape[0]
        planes = settings.kept + 2
        sources = count + 2
        weight = 1.0 / float(settings.samples)
        pixel = wp.uint64(row) * wp.uint64(view.width) + wp.uint64(column)
        start = ray(view, row, column)
        part = first + group * together - 1
        past = wp.min(first + (group + 1) * together, last)
        samples = int(0)
        random = wp.uint64(0)
        p = wp.vec3()
        d = wp.vec3()
        chance = float(0.0)  # of the direction per solid angle; 0: the camera's, which no light was tried for
        through = wp.vec3()
        order = int(0)
        alive = int(0)
        # One loop for all paths: a thread whose path has ended begins its next while its neighbours go on.
        while part < past:
            if alive == 0:
                if samples == 0:
                    part += 1
                    # Some parts have one sample more than others.
                    samples = settings.samples // parts + wp.where(part < settings.samples % parts, 1, 0)
                    random = stir(settings.key + stir(pixel * wp.uint64(1048576) + wp.uint64(part)))
                samples -= 1
                p = start.origin
                d = start.direction
                chance = 0.0
                through = wp.vec3(weight)
                order = 0
                alive = 1
            if part < past:
                base = (part - first) * sources
                limit = float(0.0)
                if order == 0:
                    # An orthographic ray starts where the smoke does; what lies before that blocks as well.
                    limit = free(mesh, p - view.moved * d, d) - view.moved
                else:
                    limit = free(mesh, p, d)
                flight = _fly(density, temperature, bounds, edge, low, size, extinction, emission, p, d, limit, random)
                random = flight.random
                plane = wp.min(order, planes - 1)
                if flight.glow > 0.0:
                    at = (base + count + 1) * planes + plane
                    out[at, row, column] = out[at, row, column] + flight.glow * through
                if flight.hit == 0:
                    if sky.total > 0.0 and limit >= 0.5 * _NEVER:
                        light = texel(sky, d)
                        share = float(1.0)
                        if chance > 0.0:
                            share = chance / (chance + chance_of(sky, light))
                        at = (base + count) * planes + plane
                        out[at, row, column] = out[at, row, column] + share * wp.cw_mul(through, light)
                    alive = 0
                else:
                    p = p + flight.t * d
                    order += 1
                    through = wp.cw_mul(through, settings.albedo)
                    most = wp.max(through[0], wp.max(through[1], through[2])) / weight
                    if most < _FAINT:
                        random = following(random)
                        if uniform(random) * _FAINT < most:
                            through = through * (_FAINT / most)
                        else:
                            alive = 0
                    if order > settings.highest:
                        alive = 0
                if alive == 1:
                    plane = wp.min(order, planes - 1)
                    for n in range(count):
                        way = lights[n].place
                        reach = float(_NEVER)
                        strength = float(1.0)
                        if lights[n].point != 0:
                            way = way - p
                            reach = wp.length(way)
                            away = wp.max(reach, lights[n].radius)
                            strength = 1.0 / wp.max(away * away, 1.0e-12)
                            way = wp.normalize(way)
                        if free(mesh, p, way) >= reach:
                            got = _passed(density, bounds, edge, low, size, extinction, p, way, reach, random)
                            random = got.random
                            strength = strength * got.share * phase(settings.g, wp.dot(d, way))
                            at = (base + n) * planes + plane
                            light = strength * wp.cw_mul(through, lights[n].colour)
                            out[at, row, column] = out[at, row, column] + light
                    if sky.total > 0.0:
                        far = toward_sky(sky, random)
                        random = far.random
                        if free(mesh, p, far.direction) >= _NEVER:
                            toward = far.direction
                            got = _passed(density, bounds, edge, low, size, extinction, p, toward, _NEVER, random)
                            random = got.random
                            own = phase(settings.g, wp.dot(d, far.direction)) / _FOUR_PI
                            strength = got.share * own / (own + far.chance)
                            at = (base + count) * planes + plane
                            light = strength * wp.cw_mul(through, texel(sky, far.direction))
                            out[at, row, column] = out[at, row, column] + light
                    # After its last order a path goes on to the sky and to what glows alone.
                    if order == settings.highest and sky.total == 0.0 and emission == 0.0:
                        alive = 0
                    random = following(random)
                    u = uniform(random)
                    random = following(random)
                    before = d
                    d = scatter(settings.g, d, u, uniform(random))
                    chance = phase(settings.g, wp.dot(before, d)) / _FOUR_PI

    return _Kernels(majorants, window, coarser, trace)


def make_lights(lights: Sequence[tuple[Sequence[float], Sequence[float], float | None]]) -> list[PathLight]:
    """Makes lights for `trace`.

    Args:
        lights: Of each a direction of length 1 or a position, the colour, and the radius of a point light, or None: it
            is infinitely far off. All in voxels, as `PathLight` has them.
    """
    made = []
    for place, colour, radius in lights:
        light = PathLight()
        light.place, light.colour = wp.vec3(*map(float, place)), wp.vec3(*map(float, colour))
        light.point, light.radius = int(radius is not None), float(radius or 0.0)
        made.append(light)
    return made


@dataclass(frozen=True)
class Majorants:
    """The greatest extinction per voxel that a sample in each brick can find, of the part of the grid with smoke.

    `most` is float [X, Y, Z] of bricks of an edge of so many voxels, the first of which begins at `low`; they reach up
    to `size` voxels from there. Beyond them there is nothing.
    """

    most: wp.array
    edge: int
    low: tuple[int, int, int]
    size: tuple[int, int, int]


def bounds(medium: Medium, densest: float) -> Majorants:
    """Finds majorants, of bricks through which the optical depth is about one where smoke is densest.

    Args:
        medium: The smoke.
        densest: Its greatest extinction per voxel.
    """
    density, (temperature, emission) = medium.density, medium.glow
    kernels = path_kernels(density.dtype, False)
    edge, device = BRICK, density.device
    most = medium.buffer(tuple(-(-n // edge) for n in density.shape), float)
    inputs = [density, temperature, medium.extinction, emission, _GLOW, _SLACK]
    wp.launch(kernels.majorants, most.shape, inputs=inputs, outputs=[most], device=device)
    begin, end = _filled(most.numpy() > 0.0)
    low = tuple(edge * n for n in begin)
    size = tuple(min(edge * n, most) - least for n, most, least in zip(end, density.shape, low, strict=True))
    inner = medium.buffer(tuple(b - a for a, b in zip(begin, end, strict=True)), float)
    wp.launch(kernels.window, inner.shape, inputs=[most, wp.vec3i(*begin)], outputs=[inner], device=device)
    while 2 * edge * densest <= _DEEP and max(inner.shape) > 1:
        edge *= 2
        wider = medium.buffer(tuple(-(-n // 2) for n in inner.shape), float)
        wp.launch(kernels.coarser, wider.shape, inputs=[inner], outputs=[wider], device=device)
        inner = wider
    return Majorants(inner, edge, low, size)


def _filled(there: np.ndarray) -> tuple[list[int], list[int]]:
    """The least box around what is there, first and past the last along each axis; one cell where there is nothing."""
    begin, end = [], []
    for axis in range(3):
        found = np.flatnonzero(there.any(tuple(other for other in range(3) if other != axis)))
        begin.append(int(found[0]) if len(found) else 0)
        end.append(int(found[-1]) + 1 if len(found) else 1)
    return begin, end


def trace(
    medium: Medium,
    view: View,
    majorants: Majorants,
    lights: wp.array,
    sky: Sky,
    mesh: wp.uint64,
    settings: PathSettings,
    first: int,
    parts: int,
    out: wp.array,
) -> None:
    """Traces some of the parts that the samples are divided into.

    Args:
        medium: The smoke.
        view: The camera, [H, W] pixels; paths go through pixel centres.
        majorants: From `bounds`.
        lights: `PathLight` [L]; L may be 0.
        sky: Of total 0: none.
        mesh: Of obstacles, in voxels, which absorb all light; 0: none.
        settings: The paths.
        first: The first part to trace.
        parts: Parts in all.
        out: vec3 [P * (L + 2) * (settings.kept + 2), H, W], added to: of P parts each light, the sky and the emission;
            of each of these the light of order 0, 1 and so on, and last that of all orders above `settings.kept`. The
            parts add up to the mean over all samples.
    """
    density, (temperature, emission) = medium.density, medium.glow
    traced = out.shape[0] // ((lights.shape[0] + 2) * (settings.kept + 2))
    # Fewer threads than keep a GPU busy wouldn't be faster for more paths each.
    together = max(1, traced * view.height * view.width // _THREADS) if density.device.is_cuda else 1
    size = (-(-traced // together), view.height, view.width)
    inputs = [density, temperature, majorants.most, float(majorants.edge), wp.vec3(*map(float, majorants.low))]
    inputs += [wp.vec3(*map(float, majorants.size)), medium.extinction, emission, view, lights]
    inputs += [sky, mesh, settings, first, first + traced, parts, together]
    kernel = path_kernels(density.dtype, mesh != 0).trace
    wp.launch(kernel, size, inputs=inputs, outputs=[out], device=density.device)
