"""Pictures of smoke: images of the smoke under each light are summed and composited over solid obstacles.

No data is read back to the host. All light is linear. `wlm.smoke.lightmaps.SixWay.shade` and
`wlm.smoke.transport.lighting.LitSmoke.compose` are the same in torch, without obstacles.
"""

from dataclasses import dataclass

import warp as wp

from wlm_kernels.smoke.march import View, ray

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class Solids:
    """Obstacles on a device.

    Attributes:
        points: vec3 [V], corners in the world.
        triangles: int32 [F, 3], indices of each triangle's corners.
        owner: int32 [F], index of each triangle's obstacle.
        colours: vec3 [obstacles], albedo of each obstacle.
    """

    points: wp.array
    triangles: wp.array
    owner: wp.array
    colours: wp.array


@dataclass(frozen=True)
class Lamps:
    """L lights on a device; without lights the arrays have one unused element.

    Attributes:
        count: Number of lights.
        toward: vec3 [L], directions to the lights in the world, of length 1; 0 for a point light, which does not light
            obstacles.
        irradiance: vec3 [L], irradiance of each light in R, G, B; of a point light its intensity.
        visibility: float [L, H, W], share of each light that reaches the smoke.
    """

    count: int
    toward: wp.array
    irradiance: wp.array
    visibility: wp.array


@wp.kernel
def _clip(
    # in:
    points: wp.array(dtype=wp.vec3),
    view: View,
    # out:
    clip: wp.array(dtype=wp.vec4),
):
    n = wp.tid()
    p = points[n] - view.origin
    away = wp.dot(p, view.forward)
    half = 0.5 * view.pitch * float(view.height)
    x = wp.dot(p, view.right) / (half * float(view.width) / float(view.height))
    y = wp.dot(p, view.up) / half
    if view.perspective != 0:
        clip[n] = wp.vec4(x, y, away - 1.0, away)
    elif away > 0.0:
        clip[n] = wp.vec4(x, y, away, 1.0)
    else:
        # With parallel rays the rasteriser does not clip geometry behind the camera, but it skips NaN.
        clip[n] = wp.vec4(wp.nan, wp.nan, wp.nan, wp.nan)


@wp.kernel
def _light_solids(
    # in:
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array2d(dtype=wp.int32),
    owner: wp.array(dtype=wp.int32),
    colours: wp.array(dtype=wp.vec3),
    lights: int,
    toward: wp.array(dtype=wp.vec3),
    irradiance: wp.array(dtype=wp.vec3),
    ambient: float,
    view: View,
    drawn: wp.array2d(dtype=wp.int32),
    barycentric: wp.array2d(dtype=wp.vec2),
    # out:
    light: wp.array2d(dtype=wp.vec3),
    depth: wp.array2d(dtype=float),
):
    i, j = wp.tid()
    n = drawn[i, j]
    if n < 0:
        light[i, j] = wp.vec3(0.0, 0.0, 0.0)
        depth[i, j] = wp.inf
        return
    a = points[triangles[n, 0]]
    b = points[triangles[n, 1]]
    c = points[triangles[n, 2]]
    share = barycentric[i, j]
    r = ray(view, i, j)
    at = share[0] * (a - r.origin) + share[1] * (b - r.origin) + (1.0 - share[0] - share[1]) * (c - r.origin)
    depth[i, j] = wp.dot(at, r.direction)
    normal = wp.normalize(wp.cross(b - a, c - a))
    if wp.dot(normal, r.direction) > 0.0:
        normal = -normal
    total = wp.vec3(ambient, ambient, ambient)
    for lamp in range(lights):
        total += wp.max(wp.dot(normal, toward[lamp]), 0.0) / wp.pi * irradiance[lamp]
    light[i, j] = wp.cw_mul(colours[owner[n]], total)


@wp.func
def _glow(stops: wp.array(dtype=float), colours: wp.array(dtype=wp.vec3), count: int, emission: float) -> wp.vec3:
    """Computes the colour of an emission by a ramp: linear between stops, constant beyond them; grey without stops."""
    if count == 0:
        return wp.vec3(emission, emission, emission)
    colour = colours[0]
    for n in range(1, count):
        share = wp.clamp((emission - stops[n - 1]) / (stops[n] - stops[n - 1]), 0.0, 1.0)
        if emission > stops[n - 1]:
            colour = (1.0 - share) * colours[n - 1] + share * colours[n]
    return colour


@wp.kernel
def _glow_of(
    # in:
    emission: wp.array2d(dtype=float),
    stops: wp.array(dtype=float),
    colours: wp.array(dtype=wp.vec3),
    count: int,
    # out:
    glow: wp.array2d(dtype=wp.vec3),
):
    i, j = wp.tid()
    glow[i, j] = _glow(stops, colours, count, emission[i, j])


@wp.func
def _behind(
    i: int,
    j: int,
    background: wp.vec3,
    solids: int,
    surface: wp.array2d(dtype=float),
    solid_light: wp.array2d(dtype=wp.vec3),
    solid_depth: wp.array2d(dtype=float),
) -> wp.vec4:
    """Returns the light of the obstacle or background at a pixel, and 1 if it is an obstacle in front of the smoke."""
    if solids != 0 and solid_depth[i, j] < wp.inf:
        light = solid_light[i, j]
        return wp.vec4(light[0], light[1], light[2], wp.where(solid_depth[i, j] < surface[i, j], 1.0, 0.0))
    return wp.vec4(background[0], background[1], background[2], 0.0)


@wp.kernel
def _compose(
    # in:
    planes: wp.array3d(dtype=wp.vec3),
    transparency: wp.array2d(dtype=float),
    glow: wp.array2d(dtype=wp.vec3),
    hot: int,
    lights: int,
    irradiance: wp.array(dtype=wp.vec3),
    visibility: wp.array3d(dtype=float),
    background: wp.vec3,
    solids: int,
    surface: wp.array2d(dtype=float),
    solid_light: wp.array2d(dtype=wp.vec3),
    solid_depth: wp.array2d(dtype=float),
    # out:
    image: wp.array2d(dtype=wp.vec3),
):
    i, j = wp.tid()
    behind = _behind(i, j, background, solids, surface, solid_light, solid_depth)
    if behind[3] > 0.0:
        image[i, j] = wp.vec3(behind[0], behind[1], behind[2])
        return
    total = transparency[i, j] * wp.vec3(behind[0], behind[1], behind[2])
    for lamp in range(lights):
        total += wp.cw_mul((visibility[lamp, i, j] / (4.0 * wp.pi)) * planes[lamp, i, j], irradiance[lamp])
    if hot != 0:
        total += glow[i, j]
    image[i, j] = total


def clip_points(solids: Solids, view: View, clip: wp.array) -> None:
    """Writes the obstacles' corners in clip space, vec4 [V]; a corner that must not be drawn becomes NaN."""
    wp.launch(_clip, solids.points.shape, [solids.points, view], [clip], device=clip.device)


def light_solids(
    solids: Solids,
    lamps: Lamps,
    ambient: float,
    view: View,
    drawn: wp.array,
    barycentric: wp.array,
    light: wp.array,
    depth: wp.array,
) -> None:
    """Computes the light that obstacles reflect to each pixel; obstacles cast no shadows on each other.

    Args:
        solids: The obstacles.
        lamps: The lights.
        ambient: Ambient light, added to each colour channel before the albedo is applied.
        view: The camera in the world.
        drawn, barycentric: int32 [H, W] and vec2 [H, W], results of the rasteriser.
        light: vec3 [H, W], written; 0 where there is no obstacle.
        depth: float [H, W], written: distance along the rays, infinite where there is no obstacle.
    """
    inputs = [*vars(solids).values(), lamps.count, lamps.toward, lamps.irradiance, ambient, view, drawn, barycentric]
    wp.launch(_light_solids, depth.shape, inputs, [light, depth], device=depth.device)


def glow_of(emission: wp.array, ramp: tuple[wp.array, wp.array] | None, glow: wp.array) -> None:
    """Converts the emission of each pixel to a colour by a colour ramp.

    Args:
        emission: float [H, W].
        ramp: Emission at each of S stops, float [S], and the colours there, vec3 [S]; None: grey.
        glow: vec3 [H, W], the emitted light in R, G, B, written.
    """
    # Without a ramp, the kernel gets arrays that it does not read.
    stops, colours = ramp or (emission.flatten(), glow.flatten())
    inputs = [emission, stops, colours, 0 if ramp is None else stops.shape[0]]
    wp.launch(_glow_of, emission.shape, inputs, [glow], device=glow.device)


def compose(
    planes: wp.array,
    transparency: wp.array,
    glow: wp.array | None,
    lamps: Lamps,
    background: tuple[float, float, float],
    solids: tuple[wp.array, wp.array, wp.array] | None,
    image: wp.array,
) -> None:
    """Composites the smoke's light over obstacles and a background.

    Args:
        planes: vec3 [L, H, W], the light of the smoke under each light at an irradiance, or intensity, of 4 pi.
        transparency: float [H, W], transparency of the smoke.
        glow: vec3 [H, W], light that the smoke emits; None: it is cold.
        lamps: The lights.
        background: R, G, B of the background, linear.
        solids: Depth of the smoke's surface, float [H, W], and the light and the depth of obstacles from
            `light_solids`; None: no obstacles.
        image: vec3 [H, W], written.
    """
    inputs = [planes, transparency, image if glow is None else glow, int(glow is not None), lamps.count]
    inputs += [lamps.irradiance, lamps.visibility, wp.vec3(*background)]
    inputs += [int(solids is not None), *(solids or (transparency, image, transparency))]
    wp.launch(_compose, image.shape, inputs, [image], device=image.device)
