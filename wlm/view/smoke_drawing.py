"""Drawing frames of smoke with a scene's lights, glow and obstacles, in buffers that stay where they are."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from wlm.interop import stream, to_warp
from wlm.ops.raster import rasterize
from wlm.smoke.camera import Camera, unit, weights
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import ObstacleSettings, obstacle_mesh
from wlm.smoke.shading import Light, Ramp, cast_shadow, light_axes
from wlm.smoke.transport.lighting import LitSmoke
from wlm.smoke.transport.lights import AnyLight, checked_albedo, checked_colour
from wlm.smoke.transport.orders import ScatteredSmoke
from wlm_kernels.smoke import picture as kernels

_AMBIENT = 0.2  # of an obstacle's colour, so that its dark side stands out from a black background


class Drawing:
    """Pictures from one camera, under the same lights.

    At a pixel an obstacle is before all of the smoke or behind all of it, by the depth of the smoke's surface; it keeps
    directional lights off this surface, and no point lights, which don't light it either.

    What a frame changes, the places of obstacles, is set by `move`. A call then launches kernels and nothing else: on
    CUDA a graph may capture it, with the lightmaps in their place.

    Attributes:
        image: float32 [H, W, 3], linear: the last picture.
        solid_light, solid_depth: Of the obstacles, [H, W, 3] and [H, W], the distance along the ray, infinite where
            there is none.
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
        """Makes the buffers.

        Args:
            camera: The view.
            lights: Any number; with obstacles, which make it themselves, their visibility isn't used.
            albedo: R, G, B, the share of light that a scattering leaves, of light that was scattered once.
            background: A linear colour.
            ramp: Colour of the emission; None: grey, as it is.
            obstacles: They are drawn, and cast shadows on the smoke's surface.
            rule: How a light's direction weighs the lightmaps, one of `wlm.smoke.camera.RULES`.
            device: As `wlm.interop.check_device` returns it.

        Raises:
            ValueError: A light has no direction, a negative irradiance or a visibility of another shape; not an albedo;
                no such rule.
        """
        self._camera, self._obstacles, self._device = camera, tuple(obstacles), device
        self._albedo, self._background = tuple(map(float, checked_albedo(albedo))), tuple(map(float, background))
        height, width = camera.height, camera.width
        colours, toward, shares, visible = [], [], [], []
        for light in lights:
            if isinstance(light, Light):
                colours.append(checked_colour("irradiance", light.irradiance))
                toward.append(unit(light.toward))
                shares.append(weights(camera.axes @ toward[-1], rule))
                visible.append(light.visibility)
            else:
                colours.append(checked_colour("intensity", light.intensity))
                toward.append(np.zeros(3))
                shares.append(np.zeros(6))
                visible.append(None)
            if visible[-1] is not None and tuple(visible[-1].shape) != (height, width):
                raise ValueError(f"visibility: expected {(height, width)}, got {tuple(visible[-1].shape)}")

        def put(
            values: Sequence | np.ndarray, shape: tuple[int, ...], kind: torch.dtype = torch.float32
        ) -> torch.Tensor:
            return torch.tensor(np.asarray(values), dtype=kind).reshape(shape).to(device)

        with stream(device):
            self.image = torch.zeros((height, width, 3), device=device)
            self.solid_light = torch.zeros_like(self.image)
            self.solid_depth = torch.full((height, width), math.inf, device=device)
            self._axes = [light_axes(way) if way.any() else None for way in toward]
            self._visibility = torch.ones((len(lights), height, width), device=device)
            for own, seen in zip(self._visibility, visible, strict=True):
                if seen is not None:
                    own.copy_(seen)
            # One more than there are: an array needs a place in memory.
            rows = max(len(lights), 1)
            more = [np.zeros((rows - len(lights), n)) for n in (3, 3, 6)]
            parts = zip((toward, colours, shares), more, strict=True)
            self._lamps = tuple(put([*values, *zeros], (rows, zeros.shape[1])) for values, zeros in parts)
            self._ramp = None if ramp is None else (put(ramp.stops, (-1,)), put(ramp.colours, (-1, 3)))
            if self._obstacles:
                points, triangles, owner = (torch.from_numpy(part).to(device) for part in obstacle_mesh(obstacles, 0.0))
                tints = put([obstacle.colour for obstacle in obstacles], (-1, 3))
                self._solids = (points, triangles, owner, tints)
                self._clip = torch.empty((len(points), 4), device=device)

    def move(self, time: float) -> None:
        """Puts obstacles where they are at a time, in seconds."""
        if self._obstacles:
            with stream(self._device):
                self._solids[0].copy_(torch.from_numpy(obstacle_mesh(self._obstacles, time)[0]))

    def draw_obstacles(self) -> None:
        """Fills `solid_light` and `solid_depth`."""
        if not self._obstacles:
            return
        with stream(self._device):
            solids, view = self._as_solids(), self._camera.in_world()
            kernels.clip_points(solids, view, to_warp(self._clip, wp.vec4))
            drawn = rasterize(self._clip, self._solids[1], self._camera.height, self._camera.width)
            seen = to_warp(drawn.triangle), to_warp(drawn.barycentric.contiguous(), wp.vec2)
            out = to_warp(self.solid_light, wp.vec3), to_warp(self.solid_depth)
            kernels.light_solids(solids, self._as_lamps(), _AMBIENT, view, *seen, *out)

    def __call__(self, smoke: SixWay | LitSmoke | ScatteredSmoke) -> torch.Tensor:
        """Draws a frame.

        Args:
            smoke: On the device: lightmaps, with transparency and, if there are obstacles, with depth; or smoke under
                the drawing's lights, of all orders with its albedo already.

        Returns:
            `image`.

        Raises:
            ValueError: The lightmaps lack a plane, or are to be lit by a point light.
        """
        six = smoke if isinstance(smoke, SixWay) else None
        seen = smoke.lit if isinstance(smoke, ScatteredSmoke) else smoke
        if six is not None and None in self._axes:
            raise ValueError("six: expected directional lights alone, since lightmaps know no places")
        if seen.transparency is None:
            raise ValueError("transparency: expected that of the lightmaps, found none")
        if self._obstacles and seen.depth is None:
            raise ValueError("six: expected lightmaps with their depth, for the obstacles")
        with stream(self._device):
            solids = None
            if self._obstacles:
                self.draw_obstacles()
                surface, mesh = to_warp(seen.depth.contiguous()), self._as_solids()
                for axes, own in zip(self._axes, self._visibility, strict=True):
                    if axes is not None:
                        cast_shadow(mesh.points, mesh.triangles, axes, self._camera.in_world(), surface, to_warp(own))
                solids = surface, to_warp(self.solid_light, wp.vec3), to_warp(self.solid_depth)
            glow = self._glow_of(seen.emission, None if six is not None else seen.thrown)
            transparency = to_warp(seen.transparency.float().contiguous())
            image, common = to_warp(self.image, wp.vec3), (self._as_lamps(), self._background, solids)
            if six is not None:
                lightmaps = to_warp(six.lightmaps.float().contiguous())
                kernels.compose(lightmaps, transparency, glow, self._albedo, *common, image)
            else:
                planes = smoke.planes if isinstance(smoke, ScatteredSmoke) else self._of_albedo(smoke.planes)
                kernels.compose_lights(to_warp(planes, wp.vec3), transparency, glow, *common, image)
        return self.image

    def _of_albedo(self, planes: torch.Tensor) -> torch.Tensor:
        """Light scattered once, [L, H, W] of albedo 1, in the albedo's colour, [L, H, W, 3]."""
        return torch.stack([value * planes for value in self._albedo], -1)

    def _glow_of(self, emission: torch.Tensor | None, thrown: torch.Tensor | None) -> wp.array | None:
        """The smoke's own light, vec3 [H, W]; what fire throws on it is in the mean colour of the fire that is seen."""
        if emission is None:
            return None
        ramp = None if self._ramp is None else (to_warp(self._ramp[0]), to_warp(self._ramp[1], wp.vec3))
        glow = torch.empty_like(self.image)
        kernels.glow_of(to_warp(emission.float().contiguous()), ramp, to_warp(glow, wp.vec3))
        if thrown is not None:
            glow += thrown * (1.0 if ramp is None else glow.sum((0, 1)) / emission.sum().clamp(min=1e-12))
        return to_warp(glow, wp.vec3)

    def _as_solids(self) -> kernels.Solids:
        points, triangles, owner, tints = self._solids
        return kernels.Solids(to_warp(points, wp.vec3), to_warp(triangles), to_warp(owner), to_warp(tints, wp.vec3))

    def _as_lamps(self) -> kernels.Lamps:
        toward, irradiance, shares = self._lamps
        visibility = self._visibility if len(self._axes) else self.solid_depth[None]
        arrays = to_warp(toward, wp.vec3), to_warp(irradiance, wp.vec3), to_warp(shares), to_warp(visibility)
        return kernels.Lamps(len(self._axes), *arrays)
