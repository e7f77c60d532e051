"""Marches along camera rays in equal steps: guiding maps, six-way lightmaps, lights from any direction, and motion.

All marches have the loop that `march` describes; they differ in what they sum. The optical depths to the lights are
computed once, at the nodes of a lattice (`depth_lattice`), and used by all pixels. Read `tests/reference/marching.py`
first: `guide` is algorithm 1 of neural-six-way-lightmaps in 20 lines, and `lit` the light of one source. `_loop` of
`tests/smoke/test_motion.py` computes `motion` pixel by pixel.
"""

from dataclasses import replace
from typing import Any

import warp as wp

from wlm_kernels.smoke.depth_lattice import Lattice, add_up, axis, depths_at, make_lattice, reach
from wlm_kernels.smoke.march import (
    BRICK,
    OPTIONS,
    MarchParameters,
    Medium,
    View,
    absorbed,
    begin,
    begin_jittered,
    between_nodes,
    box_of,
    emitted,
    for_smoke,
    in_tiles,
    look,
    node,
    optical_depth,
    parameters,
    pass_step,
    phase,
    pixel_of,
    require_orthographic,
    surface,
)
from wlm_kernels.smoke.settings import March

PLANES = ("right", "left", "top", "bottom", "front", "back", "transparency", "emission", "depth")
"""Planes that `coarse_six_way` writes."""

UNLIT_PLANES = ("transparency", "emission", "depth")
"""Planes that `unlit` writes."""

DEPTH = PLANES.index("depth")

_BORDER = wp.constant(1.0)  # voxels from the box's faces, nearer to which the trilinear density fades
_CLEAR = wp.constant(1e-3)  # largest opacity of a pixel that counts as free of smoke


def _in_bricks(medium: Medium, march: March) -> Medium:
    """Returns the smoke with its bricks if steps are shorter than a brick, so that marches skip empty bricks."""
    return medium.in_bricks() if march.step < BRICK else medium


@wp.func
def _both_depths(smoke: Any, p: wp.vec3, up: wp.vec3, step: float) -> wp.vec2:
    return wp.vec2(optical_depth(smoke, p, up, step), optical_depth(smoke, p, -up, step))


@for_smoke
def _guide(smoke_type: Any, from_lattice: bool) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        nodes: wp.array3d[wp.vec2],
        view: View,
        lattice: Lattice,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        a, b, lane = wp.tid()
        row, column = pixel_of(a, b, lane)
        if row >= view.height or column >= view.width:
            return
        random = wp.rand_init(march.seed, row * view.width + column)
        r = begin(view, row, column, smoke, march.step, 0.5 + march.jitter * (wp.randf(random) - 0.5))
        light = float(0.0)
        depth = float(0.0)
        rise = wp.dot(view.up, r.direction)
        front = phase(march.g, -1.0)
        above = phase(march.g, rise)
        below = phase(march.g, -rise)
        while r.done < r.count:
            r = look(r, smoke)
            if r.x > 0.0:
                depth = surface(depth, r, view, march.threshold)
                tau = wp.vec2()
                if wp.static(from_lattice):
                    tau = depths_at(nodes, lattice, r.place)
                else:
                    tau = _both_depths(smoke, r.place, view.up, march.step)
                # The light from the front comes along the ray, through the smoke that the ray has passed.
                light += 0.5 * front * r.t * r.t * absorbed(2.0 * r.x)
                light += r.t * absorbed(r.x) * (above * wp.exp(-tau[0]) + below * wp.exp(-tau[1]))
            r = pass_step(r, march.cutoff)
        out[0, row, column] = light
        out[1, row, column] = r.t
        out[2, row, column] = depth

    return kernel


def guide(medium: Medium, view: View, march: March, out: wp.array, *, shared: bool = True) -> None:
    """Computes a guiding map (algorithm 1): smoke lit from the front, top and bottom, its transparency and its depth.

    Two things differ from the paper's algorithm. Its line 9 lacks the step length h as a factor of the light; here each
    step is integrated exactly. Its two lights from the sides lie along the cross product of the view and the world's z,
    so at the left and the right where z is up; here they are above and below the camera. Each pixel's samples are
    shifted by a random number, the jitter.

    Args:
        medium: The smoke, of albedo 1.
        view: The camera, [H, W] pixels.
        march: Settings; its step, at least a voxel, is also the step towards the lights. Its cutoff causes an error of
            at most the cutoff in transparency, and 2.5 times the cutoff in light (for g = 0).
        out: float [3, H, W], written: sum of the light scattered under the three lights, each of irradiance 4 pi;
            transparency; distance from the camera, in the unit of `View.voxel`, to the first sample denser than the
            threshold, 0 if there is none.
        shared: Whether the optical depths to the top and the bottom are interpolated between the nodes of a lattice,
            at least a voxel apart; otherwise each sample marches to the lights itself, which is slower and more exact.
    """
    medium = _in_bricks(medium, march)
    lattice, nodes = Lattice(), medium.buffer((0, 0, 0), wp.vec2)
    if shared:
        lattice, nodes = reach(medium, view.up, None, replace(march, spacing=max(march.step, 1.0)))
    _guide(medium, in_tiles(*out.shape[1:]), [nodes, view, lattice, parameters(march)], [out], shared)


@wp.func
def _in_plane(nodes: wp.array4d[wp.vec2], i: int, j: int, k: int, fx: float, fy: float) -> wp.vec4:
    sides = wp.vec4()
    for pair in range(2):
        a = wp.lerp(node(nodes[pair], i, j, k), node(nodes[pair], i, j + 1, k), fy)
        b = wp.lerp(node(nodes[pair], i + 1, j, k), node(nodes[pair], i + 1, j + 1, k), fy)
        c = wp.lerp(a, b, fx)
        sides[2 * pair] = c[0]
        sides[2 * pair + 1] = c[1]
    return sides


@for_smoke
def _coarse(smoke_type: Any, hot: bool) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        nodes: wp.array4d[wp.vec2],
        view: View,
        lattice: Lattice,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        a, b, lane = wp.tid()
        row, column = pixel_of(a, b, lane)
        if row >= view.height or column >= view.width:
            return
        r = begin_jittered(view, row, column, smoke, march)
        sides = wp.vec4()
        glow = float(0.0)
        depth = float(0.0)
        # All samples of the ray share its place in the lattice's first two axes.
        x = (wp.dot(r.origin - view.origin, view.right) - lattice.low[0]) / lattice.gap[0]
        y = (wp.dot(r.origin - view.origin, view.up) - lattice.low[1]) / lattice.gap[1]
        i = wp.clamp(int(x), 0, nodes.shape[1] - 2)
        j = wp.clamp(int(y), 0, nodes.shape[2] - 2)
        fx = wp.clamp(x - float(i), 0.0, 1.0)
        fy = wp.clamp(y - float(j), 0.0, 1.0)
        loaded = int(-2)  # the plane of nodes whose depths are in `near`
        near = wp.vec4()
        far = wp.vec4()
        while r.done < r.count:
            r = look(r, smoke)
            if wp.static(hot):
                glow += emitted(r, smoke)
            if r.x > 0.0:
                depth = surface(depth, r, view, march.threshold)
                z = (r.distance - lattice.low[2]) / lattice.gap[2]
                k = wp.clamp(int(z), 0, nodes.shape[3] - 2)
                if k != loaded:
                    if k == loaded + 1:
                        near = far
                    else:
                        near = _in_plane(nodes, i, j, k, fx, fy)
                    far = _in_plane(nodes, i, j, k + 1, fx, fy)
                    loaded = k
                tau = wp.lerp(near, far, wp.clamp(z - float(k), 0.0, 1.0))
                left = wp.vec4(wp.exp(-tau[0]), wp.exp(-tau[1]), wp.exp(-tau[2]), wp.exp(-tau[3]))
                sides += r.t * absorbed(r.x) * left
            r = pass_step(r, march.cutoff)
        across = wp.dot(view.right, r.direction)
        rise = wp.dot(view.up, r.direction)
        out[0, row, column] = phase(march.g, across) * sides[0]
        out[1, row, column] = phase(march.g, -across) * sides[1]
        out[2, row, column] = phase(march.g, rise) * sides[2]
        out[3, row, column] = phase(march.g, -rise) * sides[3]
        out[4, row, column] = 0.5 * phase(march.g, -1.0) * absorbed(2.0 * r.tau)
        out[5, row, column] = phase(march.g, 1.0) * r.t * r.tau
        out[6, row, column] = r.t
        out[7, row, column] = glow
        out[8, row, column] = depth

    return kernel


def coarse_six_way(medium: Medium, view: View, march: March, out: wp.array) -> None:
    """Computes six-way lightmaps, transparency, emission and depth by one march in large steps.

    The six lights lie along the axes of the orthographic camera. The optical depths to the four lights at the sides are
    computed at the nodes of a lattice along these axes; rays run along the lattice's third axis. The other two lights
    need no march: of the light from the front, which comes and returns along the ray, a ray of transparency T scatters
    (1 - T^2) / 2 in total; of the light from the back, which passes all smoke of the ray wherever it is scattered,
    -T ln T. Given T, both are exact for any step.

    Args:
        medium: The smoke, of albedo 1.
        view: An orthographic camera, [H, W] pixels.
        march: Settings. The default cutoff causes an error below 1e-3 in every plane.
        out: float [9, H, W], written: the images `PLANES`, each light of irradiance 4 pi.
    """
    require_orthographic(view, "six-way lightmaps")
    medium = _in_bricks(medium, march)
    spacing = march.spacing or march.step
    lattice, counts = make_lattice(medium.shape, (view.right, view.up, view.forward), spacing, view.origin)
    nodes = add_up(medium, lattice, counts, 2, spacing)
    hot = medium.temperature is not None
    _coarse(medium, in_tiles(*out.shape[1:]), [nodes, view, lattice, parameters(march)], [out], hot)


@for_smoke
def _light(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        nodes: wp.array3d[wp.vec2],
        view: View,
        lattice: Lattice,
        march: MarchParameters,
        shadow: float,
        # out:
        out: wp.array3d[float],
    ):
        a, b, lane = wp.tid()
        row, column = pixel_of(a, b, lane)
        if row >= view.height or column >= view.width:
            return
        r = begin_jittered(view, row, column, smoke, march)
        light = wp.vec2()
        cosine = wp.dot(axis(lattice, 0), r.direction)
        forth = phase(march.g, cosine)
        back = phase(march.g, -cosine)
        while r.done < r.count:
            r = look(r, smoke)
            if r.x > 0.0:
                depths = shadow * depths_at(nodes, lattice, r.place)
                share = r.t * absorbed(r.x)
                if lattice.point == 0:
                    light += share * wp.vec2(forth * wp.exp(-depths[0]), back * wp.exp(-depths[1]))
                else:
                    way = lattice.place - r.place
                    # Closer than half a step a sample would represent far more light than its step receives.
                    away = wp.max(wp.length(way), wp.max(lattice.radius, 0.5 * r.length))
                    share = share * phase(march.g, wp.dot(wp.normalize(way), r.direction))
                    light += wp.vec2(share * wp.exp(-depths[0]) / (away * away), 0.0)
            r = pass_step(r, march.cutoff)
        out[0, row, column] = light[0]
        if lattice.point == 0:
            out[1, row, column] = light[1]

    return kernel


@for_smoke
def _unlit(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        view: View,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        a, b, lane = wp.tid()
        row, column = pixel_of(a, b, lane)
        if row >= view.height or column >= view.width:
            return
        r = begin_jittered(view, row, column, smoke, march)
        glow = float(0.0)
        depth = float(0.0)
        while r.done < r.count:
            r = look(r, smoke)
            if smoke.emission > 0.0:
                glow += emitted(r, smoke)
            depth = surface(depth, r, view, march.threshold)
            r = pass_step(r, march.cutoff)
        out[0, row, column] = r.t
        out[1, row, column] = glow
        out[2, row, column] = depth

    return kernel


def light(
    medium: Medium, view: View, depths: tuple[Lattice, wp.array], march: March, shadow: float, out: wp.array
) -> None:
    """Renders smoke of albedo 1 under a light from any direction and under the opposite light, or under a point light.

    Args:
        medium: The smoke.
        view: The camera, orthographic or in perspective, [H, W] pixels.
        depths: Result of `depth_lattice.reach`.
        march: Settings.
        shadow: Ratio of extinction towards the light to extinction along the camera's rays; 1 is physical.
        out: float [2, H, W], written: light scattered once, from the light and from the opposite light, each of
            irradiance 4 pi. For a point light [1, H, W]: its irradiance is 4 pi at a distance of one voxel.
    """
    lattice, nodes = depths
    _light(medium, in_tiles(*out.shape[1:]), [nodes, view, lattice, parameters(march), shadow], [out])


def unlit(medium: Medium, view: View, march: March, out: wp.array) -> None:
    """Renders unlit smoke: writes the images `UNLIT_PLANES` to `out`, float [3, H, W]; arguments as for `light`."""
    _unlit(_in_bricks(medium, march), in_tiles(*out.shape[1:]), [view, parameters(march)], [out])


@for_smoke
def _motion(smoke_type: Any) -> wp.Kernel:
    @wp.kernel(module="unique", module_options=OPTIONS)
    def kernel(
        # in:
        smoke: smoke_type,
        velocity: wp.array3d[wp.vec3],
        reach: float,
        view: View,
        march: MarchParameters,
        # out:
        out: wp.array3d[float],
    ):
        a, b, lane = wp.tid()
        row, column = pixel_of(a, b, lane)
        if row >= view.height or column >= view.width:
            return
        r = begin(view, row, column, smoke, march.step, 0.5)
        size = box_of(smoke)
        cells = wp.vec3(float(velocity.shape[0]), float(velocity.shape[1]), float(velocity.shape[2]))
        share = wp.cw_div(cells, size)
        border = wp.vec3(_BORDER, _BORDER, _BORDER)
        half = wp.vec3(0.5, 0.5, 0.5)
        moved = wp.vec3()
        opacity = float(0.0)
        while r.done < r.count:
            r = look(r, smoke)
            if r.x > 0.0:
                p = r.place
                # The smoke is traced back by the midpoint rule, as the solver carries it.
                middle = p - 0.5 * reach * between_nodes(velocity, wp.cw_mul(share, p) - half)
                weight = r.t * absorbed(r.x)
                start = p - reach * between_nodes(velocity, wp.cw_mul(share, middle) - half)
                # Smoke that entered the box between the frames counts from the nearest position at the border.
                start = wp.min(wp.max(start, wp.min(p, border)), wp.max(p, size - border))
                moved += weight * (p - start)
                opacity += weight
            r = pass_step(r, march.cutoff)
        across = float(0.0)
        down = float(0.0)
        if opacity > _CLEAR:
            scale = 1.0 / (opacity * view.pitch)
            across = scale * wp.dot(moved, view.right)
            down = -scale * wp.dot(moved, view.up)
        out[0, row, column] = across
        out[1, row, column] = down

    return kernel


def motion(medium: Medium, view: View, velocity: wp.array, reach: float, march: March, out: wp.array) -> None:
    """Computes by how many pixels the smoke that each pixel shows has moved since the previous frame.

    The result is the mean motion along the pixel's ray. Each step has the weight of the opacity that it adds:
    (1 - exp(-sigma h)) times the transparency of the smoke in front of it.

    Args:
        medium: The smoke of the later frame.
        view: An orthographic camera, [H, W] pixels, the same for both frames.
        velocity: vec3 [A, B, C], velocity of the air over the box of the smoke, with any number of cells: trilinear
            between their centres, constant beyond the outermost centres.
        reach: Distance in voxels that smoke with a velocity of 1 moves between the frames.
        march: Only its step and cutoff are used; samples lie in the middles of the steps.
        out: float [2, H, W], written: pixels to the right and down; 0 where there is no smoke.
    """
    require_orthographic(view, "motion vectors")
    _motion(medium.in_bricks(), in_tiles(*out.shape[1:]), [velocity, reach, view, parameters(march)], [out])
