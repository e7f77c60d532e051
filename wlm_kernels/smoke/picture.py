"""Pictures of smoke: images of the smoke under each light are summed and composited over solid obstacles.

No data is read back to the host. All light is linear. `wlm.smoke.lightmaps.SixWay.shade` and
`wlm.smoke.transport.lighting.LitSmoke.compose` are the same in torch, without obstacles.
"""

from dataclasses import dataclass

import warp as wp

from wlm_kernels.smoke.march import View, ray

wp.set_module_options({"enable_backward": False})

_FAR = wp.constant(1.0e30)


@dataclass(frozen=True)
class Solids:
    """Obstacles on a device: their surfaces, in the coordinates of the camera `view` of the functions below, the index
    of each triangle's obstacle, int32 [F], and each obstacle's albedo, vec3."""

    mesh: wp.Mesh
    owner: wp.array
    colours: wp.array


@dataclass(frozen=True)
class Lamps:
    """L lights on a device; without lights the arrays have one unused element.

    `toward`, vec3 [L], are directions to the lights in the world, of length 1; 0 for a point light, which does not
    light obstacles. `irradiance`, vec3 [L], is of a point light its intensity. `visibility`, float [L, H, W], is the
    share of each light that reaches the smoke.
    """

    count: int
    toward: wp.array
    irradiance: wp.array
    visibility: wp.array


@wp.kernel
def _light_solids(
    # in:
    mesh: wp.uint64,
    owner: wp.array(dtype=wp.int32),
    colours: wp.array(dtype=wp.vec3),
    lights: int,
    toward: wp.array(dtype=wp.vec3),
    irradiance: wp.array(dtype=wp.vec3),
    ambient: float,
    view: View,
    # out:
    light: wp.array2d(dtype=wp.vec3),
    depth: wp.array2d(dtype=float),
):
    i, j = wp.tid()
    r = ray(view, i, j)
    hit = wp.mesh_query_ray(mesh, r.origin, r.direction, _FAR)
    if not hit.result:
        light[i, j] = wp.vec3(0.0, 0.0, 0.0)
        depth[i, j] = wp.inf
        return
    depth[i, j] = hit.t
    normal = hit.normal
    if wp.dot(normal, r.direction) > 0.0:
        normal = -normal
    total = wp.vec3(ambient, ambient, ambient)
    for lamp in range(lights):
        total += wp.max(wp.dot(normal, toward[lamp]), 0.0) / wp.pi * irradiance[lamp]
    light[i, j] = wp.cw_mul(colours[owner[hit.face]], total)


@wp.kernel
def _shadow(
    # in:
    mesh: wp.uint64,
    toward: wp.array(dtype=wp.vec3),
    view: View,
    surface: wp.array2d(dtype=float),
    # out:
    visibility: wp.array3d(dtype=float),
):
    lamp, i, j = wp.tid()
    share = float(1.0)
    if surface[i, j] > 0.0 and wp.length_sq(toward[lamp]) > 0.0:
        r = ray(view, i, j)
        if wp.mesh_query_ray_anyhit(mesh, r.origin + surface[i, j] * r.direction, toward[lamp], _FAR):
            share = 0.0
    visibility[lamp, i, j] = share


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
    behind = background
    if solids != 0 and solid_depth[i, j] < wp.inf:
        behind = solid_light[i, j]
        if solid_depth[i, j] < surface[i, j]:
            image[i, j] = behind
            return
    total = transparency[i, j] * behind
    for lamp in range(lights):
        total += wp.cw_mul((visibility[lamp, i, j] / (4.0 * wp.pi)) * planes[lamp, i, j], irradiance[lamp])
    if hot != 0:
        total += glow[i, j]
    image[i, j] = total


def light_solids(solids: Solids, lamps: Lamps, ambient: float, view: View, light: wp.array, depth: wp.array) -> None:
    """Computes the light that obstacles reflect to each pixel, vec3 [H, W], 0 where there is none, and their distance
    along the rays, float [H, W], infinite there; obstacles cast no shadows on each other.

    `ambient` is added to each colour channel before the albedo is applied. The camera's `voxel` and `moved` are not
    used.
    """
    inputs = [solids.mesh.id, solids.owner, solids.colours, lamps.count, lamps.toward, lamps.irradiance, ambient, view]
    wp.launch(_light_solids, depth.shape, inputs, [light, depth], device=depth.device)


def shadow(solids: Solids, lamps: Lamps, view: View, surface: wp.array) -> None:
    """Computes which lights reach the surface of the smoke, by a ray from each pixel's surface to each light:
    `visibility` of the lamps is written, 0 where an obstacle is on the way to a directional light.

    `surface`, float [H, W], is the distance along the rays to the surface; 0: no surface, which counts as lit. The
    camera's `voxel` and `moved` are not used.
    """
    size = (lamps.count, *surface.shape)
    inputs = [solids.mesh.id, lamps.toward, view, surface]
    wp.launch(_shadow, size, inputs, [lamps.visibility], device=surface.device)


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
