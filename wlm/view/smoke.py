"""Pictures of smoke under lights, with the obstacles of a scene."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp
from wlm.smoke.camera import DIRECTIONS, Camera, unit, weights
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import ObstacleSettings, obstacle_mesh
from wlm.smoke.shading import AnyLight, Light, Ramp, checked_albedo, checked_colour, glow_of
from wlm.smoke.transport.lighting import LitSmoke
from wlm.smoke.transport.orders import ScatteredSmoke
from wlm_kernels.smoke import picture as kernels
from wlm_kernels.smoke.march import Solid

# Share of an obstacle's colour that is always lit, so that its dark side differs from a black background.
_AMBIENT = 0.2


class Drawing:
    """Draws pictures of smoke from one camera, under fixed lights, into buffers that are allocated once.

    With lightmaps, at a pixel an obstacle is in front of all of the smoke or behind all of it, depending on the depth
    of the smoke's surface, and shadows this surface. Smoke that a march lights `among` the obstacles is shadowed in
    its depth, also from point lights, and ends at them. Point lights do not light obstacles.

    `move` sets the positions of the obstacles, at first those of time 0, and draws the obstacles alone. A call then
    only launches kernels, so on CUDA a graph can capture it.

    Attributes:
        image: float32 [H, W, 3], linear, the last picture.
        solid_light, solid_depth: Light [H, W, 3] of the obstacles and distance [H, W] along the ray, infinite where
            there is no obstacle.
        visibility: Share of each of the L lights that obstacles let through to the surface of lightmaps, [L, H, W]: 0
            or 1.
    """

    def __init__(
        self,
        camera: Camera,
        lights: Sequence[AnyLight],
        *,
        albedo: Sequence[float] = (1.0, 1.0, 1.0),
        background: Sequence[float] = (0.0, 0.0, 0.0),
        ramp: Ramp | None = None,
        obstacles: Sequence[ObstacleSettings] = (),
        rule: str = "squared",
        device: str = "cpu",
    ) -> None:
        """Allocates the buffers for a view under any number of lights.

        `albedo`, R, G, B, is applied to light scattered once; `background` is a linear colour; `ramp` is the colour of
        the emission, None for grey; obstacles are drawn and cast shadows on the smoke's surface. `rule` is how the
        lightmaps are weighted by a light's direction, one of `wlm.smoke.camera.RULES`.
        """
        self._camera, self._obstacles, self._device = camera, tuple(obstacles), device
        self._albedo, self._background = tuple(map(float, checked_albedo(albedo))), tuple(map(float, background))
        self._ramp = ramp
        height, width = camera.height, camera.width
        colours, toward, shares = [], [], []
        for light in lights:
            if isinstance(light, Light):
                colours.append(checked_colour("irradiance", light.irradiance))
                toward.append(unit(light.toward))
                shares.append(weights(camera.axes @ toward[-1], rule))
            else:
                colours.append(checked_colour("intensity", light.intensity))
                toward.append(np.zeros(3))
                shares.append(np.zeros(len(DIRECTIONS)))

        def put(values: Sequence | np.ndarray, shape: tuple[int, ...]) -> torch.Tensor:
            return torch.tensor(np.asarray(values), dtype=torch.float32).reshape(shape).to(device)

        with stream(device):
            self.image = torch.zeros((height, width, 3), device=device)
            self.solid_light = torch.zeros_like(self.image)
            self.solid_depth = torch.full((height, width), math.inf, device=device)
            self._directional = all(way.any() for way in toward)
            self.visibility = torch.ones((len(lights), height, width), device=device)
            # At least one row: an empty array has no memory.
            rows = max(len(lights), 1)
            zeros = np.zeros((rows - len(lights), 3))
            self._lamps = tuple(put([*values, *zeros], (rows, 3)) for values in (toward, colours))
            self._shares = put(shares, (len(lights), len(DIRECTIONS)))
            if self._obstacles:
                points, triangles, owner = self._mesh_at(0.0)
                indices = wp.array(triangles.ravel(), dtype=wp.int32, device=device)
                mesh = wp.Mesh(wp.array(points, dtype=wp.vec3, device=device), indices)
                colours = np.array([obstacle.colour for obstacle in obstacles], np.float32)
                tints = wp.array(colours, dtype=wp.vec3, device=device)
                self._solids = kernels.Solids(mesh, wp.array(owner, dtype=wp.int32, device=device), tints)
                self._draw_obstacles()

    def move(self, time: float) -> None:
        """Moves the obstacles to their positions at a time in seconds, and draws them there."""
        if any(obstacle.eased.moves for obstacle in self._obstacles):
            with stream(self._device):
                self._solids.mesh.points.assign(self._mesh_at(time)[0])
                self._solids.mesh.refit()
                self._draw_obstacles()

    def _mesh_at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the obstacles as `obstacle_mesh` does, relative to the camera, so that float32 is exact enough."""
        points, triangles, owner = obstacle_mesh(self._obstacles, time)
        return (points - np.asarray(self._camera.position)).astype(np.float32), triangles, owner

    def _draw_obstacles(self) -> None:
        out = to_warp(self.solid_light, wp.vec3), to_warp(self.solid_depth)
        kernels.light_solids(self._solids, self._as_lamps(), _AMBIENT, self._camera.in_world(), *out)

    def among(self, volume: DensityVolume) -> DensityVolume:
        """Returns the volume with the obstacles for marches that light it; they follow `move`."""
        if not self._obstacles:
            return volume
        solid = Solid()
        solid.mesh, solid.voxel, solid.stop = self._solids.mesh.id, volume.voxel, to_warp(self.solid_depth)
        solid.corner = wp.vec3(*(np.asarray(volume.origin) - self._camera.position))
        return replace(volume, solid=solid)

    def draw_shadows(self, surface: torch.Tensor) -> None:
        """Writes to `visibility` which lights reach the smoke's surface at distances [H, W]; 0: no surface, lit."""
        if self._obstacles:
            with stream(self._device):
                view = self._camera.in_world()
                kernels.shadow(self._solids, self._as_lamps(), view, to_warp(surface.contiguous()))

    def __call__(self, smoke: SixWay | LitSmoke | ScatteredSmoke) -> torch.Tensor:
        """Draws a frame, and returns `image`.

        `smoke`, on the device, are lightmaps with transparency and, if there are obstacles, with depth; or smoke that
        was lit by the drawing's lights, among its obstacles. `ScatteredSmoke` already includes the albedo.
        """
        six = smoke if isinstance(smoke, SixWay) else None
        seen = smoke.lit if isinstance(smoke, ScatteredSmoke) else smoke
        if six is not None and not self._directional:
            raise ValueError("lights: expected only directional lights for six-way lightmaps, got a point light")
        if seen.transparency is None:
            raise ValueError("smoke: expected lightmaps or lit smoke with transparency, found none")
        if self._obstacles and seen.depth is None:
            raise ValueError("smoke: expected a depth, which obstacles need, found none")
        with stream(self._device):
            solids = None
            if self._obstacles:
                surface = self.solid_depth  # lit smoke ends there, so that no obstacle is before it
                if six is not None:
                    self.draw_shadows(seen.depth)
                    surface = seen.depth.contiguous()
                solids = to_warp(surface), to_warp(self.solid_light, wp.vec3), to_warp(self.solid_depth)
            glow = None
            if seen.emission is not None:
                fire = glow_of(seen.emission.float(), self._ramp, None if six is not None else seen.thrown)
                glow = to_warp(fire.expand_as(self.image).contiguous(), wp.vec3)
            transparency = to_warp(seen.transparency.float().contiguous())
            image, common = to_warp(self.image, wp.vec3), (self._as_lamps(), self._background, solids)
            if six is not None:
                planes = self._of_albedo((self._shares[:, :, None, None] * six.lightmaps.float()).sum(1))
            else:
                planes = smoke.planes if isinstance(smoke, ScatteredSmoke) else self._of_albedo(smoke.planes)
            kernels.compose(to_warp(planes, wp.vec3), transparency, glow, *common, image)
        return self.image

    def _of_albedo(self, planes: torch.Tensor) -> torch.Tensor:
        return torch.stack([value * planes for value in self._albedo], -1)

    def _as_lamps(self) -> kernels.Lamps:
        toward, irradiance = self._lamps
        count = len(self.visibility)
        visibility = self.visibility if count else self.solid_depth[None]
        return kernels.Lamps(count, to_warp(toward, wp.vec3), to_warp(irradiance, wp.vec3), to_warp(visibility))


def picture(
    smoke: SixWay | LitSmoke | ScatteredSmoke,
    lights: Sequence[AnyLight] | None = None,
    *,
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    ramp: Ramp | None = None,
    obstacles: Sequence[ObstacleSettings] = (),
    time: float = 0.0,
    rule: str = "squared",
) -> torch.Tensor:
    """Draws lit smoke and a scene's obstacles, as one call of `Drawing` does, which explains the other options: float32
    [H, W, 3], linear.

    `smoke` are lightmaps with their camera and transparency, and with their depth if there are obstacles; or smoke that
    was lit before, by single or multiple scattering, which needs no lights and cannot have obstacles. `time` is that of
    the obstacles, in seconds.
    """
    lit = smoke.lit if isinstance(smoke, ScatteredSmoke) else smoke
    if lit.camera is None:
        raise ValueError("smoke: expected lightmaps or lit smoke with a camera, found none")
    options = {"albedo": albedo, "background": background, "ramp": ramp, "obstacles": obstacles, "rule": rule}
    device = device_name(lit.transparency.device if lit.transparency is not None else lit.lightmaps.device)
    if obstacles and not isinstance(smoke, SixWay):
        raise ValueError("obstacles: expected none with lit smoke, which a Drawing draws among obstacles")
    drawing = Drawing(lit.camera, lit.lights if lights is None else lights, **options, device=device)
    drawing.move(time)
    return drawing(smoke)
