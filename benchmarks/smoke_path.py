"""A path tracer of volumes: light of every order of scattering in a density grid, without bias.

Free paths are sampled by delta tracking, transmittances by ratio tracking (Novak et al. 2018, "Monte Carlo methods for
volumetric light transport simulation", sections 5.1 and 5.2). Both use a majorant per brick, an upper bound of the
extinction; a ray draws an optical depth once and uses it up brick by brick. Where a density is needed, one of the eight
voxels around the position is drawn with the probability of its trilinear weight: both kinds of tracking only need the
mean to be the interpolated density. At each scattering every light is sampled (next event estimation), and so is the
sky. The sky is also reached by paths that leave the smoke; the balance heuristic weights its two estimates. Emission is
gathered along free paths: at each tentative collision the emission there, divided by the majorant, is added.

Units are those of `march`. Random numbers belong to a pixel, so that the result depends on the seed alone. Read
`scattered_twice` of `tests/reference/transport.py` first: the second order by quadrature.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wlm_kernels.smoke.march import BRICK, OPTIONS, Medium, View, clip, density_at, for_smoke, phase, ray

_NEVER = wp.constant(1.0e30)
_GLOW = 1.0 / BRICK  # least majorant of hot smoke, which gives about one sample of its emission per brick
_SLACK = 1.0001  # factor of a majorant that covers the rounding of interpolated densities
_DEEP = 2.0  # largest optical depth through a brick of the densest smoke, up to which bricks are made larger
_THREADS = 2**20  # threads on a GPU, each of which traces several parts in turn
_FAINT = wp.constant(0.1)  # weight below which paths end by Russian roulette
_TWO_PI = wp.constant(2.0 * math.pi)
_FOUR_PI = wp.constant(4.0 * math.pi)
_TENTH_BIT = wp.constant(1.0 / 1024.0)


@wp.struct
class PathLight:
    """A light at infinity (`point` = 0) or a point light (1); lengths are in voxels.

    `place` is the direction to a light at infinity, of length 1, or the position of a point light. `colour` is the
    irradiance divided by 4 pi, for a point light the irradiance at a distance of one voxel. Within the distance
    `radius` of a point light the irradiance is constant.
    """

    place: wp.vec3
    colour: wp.vec3
    point: int
    radius: float


@wp.struct
class PathSettings:
    """Settings of the paths: `albedo` R, G, B; radiance of the `sky`, the same from all directions; g of the phase
    function; number of `samples` of a pixel; `key` of the random numbers. Paths end after `highest` scatterings. Light
    of the orders 0 to `kept` is written to separate images."""

    albedo: wp.vec3
    sky: wp.vec3
    g: float
    highest: int
    kept: int
    samples: int
    key: wp.uint64


@wp.struct
class _Grid:
    bounds: wp.array3d[float]
    edge: float
    low: wp.vec3
    size: wp.vec3


@wp.struct
class _Flight:
    """A free path: the distance t of its end, whether it hit smoke there, and the emission that it gathered."""

    t: float
    hit: int
    glow: float
    random: wp.uint64


@wp.struct
class _Passed:
    """The share of the light that passes along a ray, 0 to 1, and the next random state."""

    share: float
    random: wp.uint64


@wp.struct
class _Path:
    """A path: position p in voxels, direction d, weight `through` (R, G, B), order of scattering, next random state.

    `chance` is the probability per solid angle with which the direction was sampled; 0 for the ray from the camera,
    before whose start no light was sampled.
    """

    p: wp.vec3
    d: wp.vec3
    through: wp.vec3
    chance: float
    order: int
    alive: int
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
    """Generates 32 random bits (PCG-XSH-RR, O'Neill 2014)."""
    x = wp.uint32(((random >> wp.uint64(18)) ^ random) >> wp.uint64(27))
    turn = wp.uint32(random >> wp.uint64(59))
    return (x >> turn) | (x << ((wp.uint32(32) - turn) & wp.uint32(31)))


@wp.func
def uniform(random: wp.uint64) -> float:
    """Returns the random number in [0, 1), with 24 bits, of a random state."""
    return float(bits(random) >> wp.uint32(8)) * (1.0 / 16777216.0)


@wp.func
def scatter(g: float, d: wp.vec3, u: float, v: float) -> wp.vec3:
    """Samples the new direction of a path along d by the Henyey-Greenstein phase function; u and v are in [0, 1)."""
    cosine = 1.0 - 2.0 * u
    if wp.abs(g) > 1.0e-3:
        share = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
        cosine = (1.0 + g * g - share * share) / (2.0 * g)
    cosine = wp.clamp(cosine, -1.0, 1.0)
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    # Two directions orthogonal to d are computed without division by a number near 0 (Duff et al. 2017).
    sign = wp.where(d[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + d[2])
    b = d[0] * d[1] * a
    across = wp.vec3(1.0 + sign * d[0] * d[0] * a, sign * b, -sign * d[0])
    beside = wp.vec3(b, sign + d[1] * d[1] * a, -d[1])
    angle = _TWO_PI * v
    return wp.normalize(cosine * d + sine * (wp.cos(angle) * across + wp.sin(angle) * beside))


@wp.struct
class _Walk:
    """Where a ray is on its way through bricks: it crosses brick `cell` from distance `t` to distance `border`.

    It ends at distance `end`. `leave` has the distance at which the ray leaves the brick along each axis, `across` the
    length of its way through a whole brick along each axis, and `most` is the majorant of the brick.
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
    if d > 1.0e-9 and cell < count - 1:
        return (float(cell + 1) * edge - p) / d
    if d < -1.0e-9 and cell > 0:
        return (float(cell) * edge - p) / d
    return _NEVER


@wp.func
def _enter(grid: _Grid, p: wp.vec3, d: wp.vec3, limit: float) -> _Walk:
    w = _Walk()
    q = p - grid.low
    span = clip(grid.size, q, d)
    w.t = wp.max(span[0], 0.0)
    w.end = wp.min(span[1], limit)
    for axis in range(3):
        at = int(wp.floor((q[axis] + w.t * d[axis]) / grid.edge))
        w.cell[axis] = wp.clamp(at, 0, grid.bounds.shape[axis] - 1)
        w.leave[axis] = _border(w.cell[axis], grid.bounds.shape[axis], grid.edge, q[axis], d[axis])
        w.across[axis] = grid.edge / wp.max(wp.abs(d[axis]), 1.0e-9)
    w.border = wp.min(wp.min(w.leave[0], wp.min(w.leave[1], w.leave[2])), w.end)
    w.most = grid.bounds[w.cell[0], w.cell[1], w.cell[2]]
    return w


@wp.func
def _further(cell: int, count: int, leave: float, across: float) -> float:
    return wp.where(cell > 0 and cell < count - 1, leave + across, _NEVER)


@wp.func
def _onward(w: _Walk, bounds: wp.array3d[float], d: wp.vec3) -> _Walk:
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
    """Returns the density of a random one of the eight voxels around p; the mean is the interpolated density."""
    x = bits(random)
    i = int(wp.floor(p[0] + (float(x & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    j = int(wp.floor(p[1] + (float((x >> wp.uint32(10)) & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    k = int(wp.floor(p[2] + (float((x >> wp.uint32(20)) & wp.uint32(1023)) - 511.5) * _TENTH_BIT))
    if i < 0 or j < 0 or k < 0 or i >= density.shape[0] or j >= density.shape[1] or k >= density.shape[2]:
        return 0.0
    return float(density[i, j, k])


@wp.func
def _fly(smoke: Any, grid: _Grid, p: wp.vec3, d: wp.vec3, limit: float, random: wp.uint64) -> _Flight:
    """Samples a free path from p along d by delta tracking, up to a distance of `limit` voxels."""
    f = _Flight()
    glow = float(0.0)
    random = following(random)
    left = -wp.log(1.0 - uniform(random))  # optical depth of the majorants up to the next tentative collision
    w = _enter(grid, p, d, limit)
    while w.t < w.end:
        through = w.most * (w.border - w.t)
        if left >= through:
            left -= through
            w = _onward(w, grid.bounds, d)
        else:
            w.t += left / w.most
            at = p + w.t * d
            if smoke.emission > 0.0:
                glow += smoke.emission * density_at(smoke.temperature, smoke, at) / w.most
            random = following(random)
            found = smoke.extinction * drawn(smoke.density, at, random)
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
def _passed(smoke: Any, grid: _Grid, p: wp.vec3, d: wp.vec3, limit: float, random: wp.uint64) -> _Passed:
    """Estimates the share of light that passes from p along d, by ratio tracking, up to `limit` voxels."""
    f = _Passed()
    share = float(1.0)
    random = following(random)
    left = -wp.log(1.0 - uniform(random))
    w = _enter(grid, p, d, limit)
    while w.t < w.end:
        through = w.most * (w.border - w.t)
        if left >= through:
            left -= through
            w = _onward(w, grid.bounds, d)
        else:
            w.t += left / w.most
            random = following(random)
            share = share * (1.0 - smoke.extinction * drawn(smoke.density, p + w.t * d, random) / w.most)
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


@wp.func
def _add(out: wp.array3d[wp.vec3], plane: int, row: int, column: int, light: wp.vec3):
    # A thread is the only one that writes its pixel of a part.
    out[plane, row, column] = out[plane, row, column] + light


@wp.struct
class _Scene:
    grid: _Grid
    view: View
    lights: wp.array1d[PathLight]
    mesh: wp.uint64
    settings: PathSettings


@for_smoke
def _majorants(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        least: float,
        slack: float,
        # out:
        out: wp.array3d[float],
    ):
        a, b, c = wp.tid()
        most = float(0.0)
        hot = float(0.0)
        # A sample in a brick reads up to half a voxel beyond the brick.
        for i in range(wp.max(a * BRICK - 1, 0), wp.min((a + 1) * BRICK + 1, smoke.density.shape[0])):
            for j in range(wp.max(b * BRICK - 1, 0), wp.min((b + 1) * BRICK + 1, smoke.density.shape[1])):
                for k in range(wp.max(c * BRICK - 1, 0), wp.min((c + 1) * BRICK + 1, smoke.density.shape[2])):
                    most = wp.max(most, float(smoke.density[i, j, k]))
                    hot = wp.max(hot, float(smoke.temperature[i, j, k]))
        most = most * smoke.extinction * slack
        if smoke.emission > 0.0 and hot > 0.0:
            most = wp.max(most, least)
        out[a, b, c] = most

    return kernel


@wp.kernel(module="unique", module_options=OPTIONS)
def _coarser(
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


@for_smoke
def _trace(smoke_type: Any, solid: bool) -> wp.Kernel:

    @wp.func
    def free(mesh: wp.uint64, p: wp.vec3, d: wp.vec3) -> float:
        if wp.static(solid):
            found = wp.mesh_query_ray(mesh, p, d, _NEVER)
            return wp.where(found.result, found.t, _NEVER)
        return _NEVER

    @wp.func
    def extend(
        smoke: smoke_type, s: _Scene, path: _Path, base: int, row: int, column: int, out: wp.array3d[wp.vec3]
    ) -> _Path:
        """Follows a path to its next scattering, or out of the smoke to the sky, where it ends."""
        planes = s.settings.kept + 2
        count = s.lights.shape[0]
        limit = float(0.0)
        if path.order == 0:
            # An orthographic ray starts at the border of the smoke; obstacles in front of that block it too.
            limit = free(s.mesh, path.p - s.view.moved * path.d, path.d) - s.view.moved
        else:
            limit = free(s.mesh, path.p, path.d)
        flight = _fly(smoke, s.grid, path.p, path.d, limit, path.random)
        path.random = flight.random
        plane = wp.min(path.order, planes - 1)
        if flight.glow > 0.0:
            _add(out, (base + count + 1) * planes + plane, row, column, flight.glow * path.through)
        if flight.hit == 0:
            if wp.max(s.settings.sky) > 0.0 and limit >= 0.5 * _NEVER:
                share = float(1.0)
                if path.chance > 0.0:
                    share = path.chance / (path.chance + 1.0 / _FOUR_PI)
                _add(out, (base + count) * planes + plane, row, column, share * wp.cw_mul(path.through, s.settings.sky))
            path.alive = 0
            return path
        path.p = path.p + flight.t * path.d
        path.order += 1
        path.through = wp.cw_mul(path.through, s.settings.albedo)
        weight = 1.0 / float(s.settings.samples)
        most = wp.max(path.through[0], wp.max(path.through[1], path.through[2])) / weight
        if most < _FAINT:
            path.random = following(path.random)
            if uniform(path.random) * _FAINT < most:
                path.through = path.through * (_FAINT / most)
            else:
                path.alive = 0
        if path.order > s.settings.highest:
            path.alive = 0
        return path

    @wp.func
    def connect(
        smoke: smoke_type, s: _Scene, path: _Path, base: int, row: int, column: int, out: wp.array3d[wp.vec3]
    ) -> wp.uint64:
        """Samples every light and the sky at a path's last scattering, and adds to each one's image the light that is
        scattered there along the path to the camera. Returns the next random state."""
        planes = s.settings.kept + 2
        count = s.lights.shape[0]
        plane = wp.min(path.order, planes - 1)
        random = path.random
        for n in range(count):
            way = s.lights[n].place
            reach = float(_NEVER)
            strength = float(1.0)
            if s.lights[n].point != 0:
                way = way - path.p
                reach = wp.length(way)
                away = wp.max(reach, s.lights[n].radius)
                strength = 1.0 / wp.max(away * away, 1.0e-12)
                way = wp.normalize(way)
            if free(s.mesh, path.p, way) >= reach:
                got = _passed(smoke, s.grid, path.p, way, reach, random)
                random = got.random
                strength = strength * got.share * phase(s.settings.g, wp.dot(path.d, way))
                light = strength * wp.cw_mul(path.through, s.lights[n].colour)
                _add(out, (base + n) * planes + plane, row, column, light)
        if wp.max(s.settings.sky) > 0.0:
            random = following(random)
            height = 1.0 - 2.0 * uniform(random)
            random = following(random)
            turn = _TWO_PI * uniform(random)
            across = wp.sqrt(wp.max(1.0 - height * height, 0.0))
            way = wp.vec3(across * wp.cos(turn), height, across * wp.sin(turn))
            if free(s.mesh, path.p, way) >= _NEVER:
                got = _passed(smoke, s.grid, path.p, way, _NEVER, random)
                random = got.random
                own = phase(s.settings.g, wp.dot(path.d, way))
                light = got.share * own / (own + 1.0) * wp.cw_mul(path.through, s.settings.sky)
                _add(out, (base + count) * planes + plane, row, column, light)
        return random

    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        s: _Scene,
        first: int,
        last: int,
        parts: int,
        together: int,
        # out:
        out: wp.array3d[wp.vec3],
    ):
        group, row, column = wp.tid()
        pixel = wp.uint64(row) * wp.uint64(s.view.width) + wp.uint64(column)
        start = ray(s.view, row, column)
        part = first + group * together - 1
        past = wp.min(first + (group + 1) * together, last)
        samples = int(0)
        path = _Path()
        # One loop for all paths: a thread whose path has ended begins its next path while its neighbours continue.
        while part < past:
            if path.alive == 0:
                if samples == 0:
                    part += 1
                    # Some parts have one sample more than others.
                    samples = s.settings.samples // parts + wp.where(part < s.settings.samples % parts, 1, 0)
                    path.random = stir(s.settings.key + stir(pixel * wp.uint64(1048576) + wp.uint64(part)))
                samples -= 1
                path.p = start.origin
                path.d = start.direction
                path.chance = 0.0
                path.through = wp.vec3(1.0 / float(s.settings.samples))
                path.order = 0
                path.alive = 1
            if part < past:
                base = (part - first) * (s.lights.shape[0] + 2)
                path = extend(smoke, s, path, base, row, column, out)
                if path.alive == 1:
                    random = connect(smoke, s, path, base, row, column, out)
                    # After its last order a path continues only to the sky and to emission.
                    if path.order == s.settings.highest and wp.max(s.settings.sky) == 0.0 and smoke.emission == 0.0:
                        path.alive = 0
                    random = following(random)
                    u = uniform(random)
                    random = following(random)
                    before = path.d
                    path.d = scatter(s.settings.g, before, u, uniform(random))
                    path.chance = phase(s.settings.g, wp.dot(before, path.d)) / _FOUR_PI
                    path.random = random

    return kernel


def make_lights(lights: Sequence[tuple[Sequence[float], Sequence[float], float | None]]) -> list[PathLight]:
    """Makes lights for `trace`.

    Args:
        lights: For each light its direction (of length 1) or position in voxels, its colour as in `PathLight`, and the
            radius of a point light in voxels or None for a light at infinity.
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
    """Upper bounds of the extinction per voxel in bricks, for the part of the grid that has smoke.

    `most` is float [X, Y, Z], the bound of each brick of `edge` voxels along an axis. The first brick begins at voxel
    `low`, and the bricks extend over `size` voxels. There is no smoke outside them.
    """

    most: wp.array
    edge: int
    low: tuple[int, int, int]
    size: tuple[int, int, int]


def bounds(medium: Medium, densest: float) -> Majorants:
    """Computes majorants, in bricks so large that the densest smoke has an optical depth of about one in them.

    Args:
        medium: The smoke.
        densest: The smoke's largest extinction per voxel.
    """
    density, device, edge = medium.density, medium.device, BRICK
    most = medium.buffer(tuple(-(-n // edge) for n in density.shape), float)
    _majorants(medium, most.shape, [_GLOW, _SLACK], [most])
    begin, end = _filled(most.numpy() > 0.0)
    low = tuple(edge * n for n in begin)
    size = tuple(min(edge * n, most) - least for n, most, least in zip(end, density.shape, low, strict=True))
    inner = most[begin[0] : end[0], begin[1] : end[1], begin[2] : end[2]].contiguous()
    while 2 * edge * densest <= _DEEP and max(inner.shape) > 1:
        edge *= 2
        wider = medium.buffer(tuple(-(-n // 2) for n in inner.shape), float)
        wp.launch(_coarser, wider.shape, [inner], [wider], device=device)
        inner = wider
    return Majorants(inner, edge, low, size)


def _filled(there: np.ndarray) -> tuple[list[int], list[int]]:
    """Returns the first cell of the smallest box around all true cells, and the cell after its last."""
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
    mesh: wp.uint64,
    settings: PathSettings,
    first: int,
    parts: int,
    out: wp.array,
) -> None:
    """Traces the paths of each pixel, or some of the equal parts into which they are divided.

    Args:
        medium: The smoke.
        view: The camera, [H, W] pixels; paths go through pixel centres.
        majorants: The result of `bounds`.
        lights: `PathLight` [L]; L may be 0.
        mesh: Id of a mesh of obstacles in voxels, which absorb all light; 0: none.
        settings: Settings of the paths.
        first: Index of the first part to trace.
        parts: Number of parts in total.
        out: vec3 [P * (L + 2) * (settings.kept + 2), H, W], light in R, G, B, added to: for each of the P parts to
            trace, for each of the L lights, the sky and the emission, the light of each order from 0 to `settings.kept`
            and the light of all higher orders. The sum over all parts is the mean over all samples.
    """
    traced = out.shape[0] // ((lights.shape[0] + 2) * (settings.kept + 2))
    # With fewer threads than keep a GPU busy, more paths per thread would not be faster.
    together = max(1, traced * view.height * view.width // _THREADS) if medium.device.is_cuda else 1
    scene = _Scene()
    scene.view, scene.lights, scene.mesh, scene.settings = view, lights, mesh, settings
    grid = _Grid()
    grid.bounds, grid.edge = majorants.most, float(majorants.edge)
    grid.low, grid.size = (wp.vec3(*map(float, v)) for v in (majorants.low, majorants.size))
    scene.grid = grid
    size = (-(-traced // together), view.height, view.width)
    _trace(medium, size, [scene, first, first + traced, parts, together], [out], mesh != 0)
