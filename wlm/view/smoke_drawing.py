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
from wlm_kernels.smoke import picture as kernels

_AMBIENT = 0.2  # of an obstacle's colour, so that its dark side stands out from a black background


class Drawing:
    """Pictures from one camera, under the same lights.

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
        lights: Sequence[Light],
        *,
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
            background: A linear colour.
            ramp: Colour of the emission; None: grey, as it is.
            obstacles: They are drawn, and cast shadows on the smoke's surface.
            rule: How a light's direction weighs the lightmaps, one of `wlm.smoke.camera.RULES`.
            device: As `wlm.interop.check_device` returns it.

        Raises:
            ValueError: A light has no direction, a negative irradiance or a visibility of another shape; no such rule.
        """
        self._camera, self._obstacles, self._device = camera, tuple(obstacles), device
        self._background = tuple(map(float, background))
        height, width = camera.height, camera.width
        for light in lights:
            irradiance = np.asarray(light.irradiance, np.float64)
            if irradiance.shape != (3,) or not ((irradiance >= 0) & np.isfinite(irradiance)).all():
                raise ValueError(f"irradiance: expected three numbers of at least 0, got {light.irradiance}")
            if light.visibility is not None and tuple(light.visibility.shape) != (height, width):
                raise ValueError(f"visibility: expected {(height, width)}, got {tuple(light.visibility.shape)}")

        def put(
            values: Sequence | np.ndarray, shape: tuple[int, ...], kind: torch.dtype = torch.float32
        ) -> torch.Tensor:
            return torch.tensor(np.asarray(values), dtype=kind).reshape(shape).to(device)

        wp.init()  # which wrapping a tensor doesn't do
        with stream(device):
            self.image = torch.zeros((height, width, 3), device=device)
            self.solid_light = torch.zeros_like(self.image)
            self.solid_depth = torch.full((height, width), math.inf, device=device)
            toward = [unit(light.toward) for light in lights]
            self._axes = [light_axes(way) for way in toward]
            shares = [weights(camera.axes @ way, rule) for way in toward]
            self._visibility = torch.ones((len(lights), height, width), device=device)
            for own, light in zip(self._visibility, lights, strict=True):
                if light.visibility is not None:
                    own.copy_(light.visibility)
            # One more than there are: an array needs a place in memory.
            rows = max(len(lights), 1)
            padded = [*toward, *np.zeros((rows - len(lights), 3))], [*shares, *np.zeros((rows - len(lights), 6))]
            colours = [*(light.irradiance for light in lights), *np.zeros((rows - len(lights), 3))]
            self._lamps = (put(padded[0], (rows, 3)), put(colours, (rows, 3)), put(padded[1], (rows, 6)))
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

    def __call__(self, six: SixWay) -> torch.Tensor:
        """Draws a frame.

        Args:
            six: Lightmaps on the device, with transparency and, if there are obstacles, with depth.

        Returns:
            `image`.

        Raises:
            ValueError: The lightmaps lack a plane.
        """
        if six.transparency is None:
            raise ValueError("transparency: expected that of the lightmaps, found none")
        if self._obstacles and six.depth is None:
            raise ValueError("six: expected lightmaps with their depth, for the obstacles")
        with stream(self._device):
            solids, planes = None, (six.lightmaps, six.transparency, six.emission)
            if self._obstacles:
                self.draw_obstacles()
                surface, mesh = to_warp(six.depth.contiguous()), self._as_solids()
                for axes, seen in zip(self._axes, self._visibility, strict=True):
                    cast_shadow(mesh.points, mesh.triangles, axes, self._camera.in_world(), surface, to_warp(seen))
                solids = surface, to_warp(self.solid_light, wp.vec3), to_warp(self.solid_depth)
            arrays = tuple(None if plane is None else to_warp(plane.float().contiguous()) for plane in planes)
            glow = None if self._ramp is None else (to_warp(self._ramp[0]), to_warp(self._ramp[1], wp.vec3))
            image = to_warp(self.image, wp.vec3)
            kernels.compose(arrays, glow, self._as_lamps(), self._background, solids, image)
        return self.image

    def _as_solids(self) -> kernels.Solids:
        points, triangles, owner, tints = self._solids
        return kernels.Solids(to_warp(points, wp.vec3), to_warp(triangles), to_warp(owner), to_warp(tints, wp.vec3))

    def _as_lamps(self) -> kernels.Lamps:
        toward, irradiance, shares = self._lamps
        visibility = self._visibility if len(self._axes) else self.solid_depth[None]
        arrays = to_warp(toward, wp.vec3), to_warp(irradiance, wp.vec3), to_warp(shares), to_warp(visibility)
        return kernels.Lamps(len(self._axes), *arrays)
