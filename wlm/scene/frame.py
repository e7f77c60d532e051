"""`Renderer`: draws frames of a scene on a device, the same on the CPU and on CUDA.

A frame draws all triangles in one image with their UVs, decodes the pages of the virtual texture that the image needs,
and computes radiance: base colour / pi times the irradiance of the lightmaps, or of the probes at the centre of a
moving object. Smoke is blended in linear radiance, back to front. A pixel is the mean of `samples` x `samples` points.

    colour = sRGB(tone(2^exposure x radiance))      with `wlm.texels.filmic` as the tone
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.hours import DAY
from wlm.formats.light import read_light
from wlm.interop import to_warp
from wlm.lightmap.virtual.texture import BUDGET, VirtualTexture
from wlm.ops.raster import Raster, interpolate, rasterize, texture
from wlm.probe.sphere import unit_or_zero
from wlm.scene.content import Scene
from wlm.scene.probes import DayProbes, six_lights
from wlm.smoke.data import read_six_way
from wlm.texels import fill_gaps, filmic

STAGES = ("triangles", "pages", "light", "objects", "smoke", "display")
"""The parts of a frame, in order of work: `objects` is the light of the probes."""

DECODES = 64
"""Largest number of pages that are decoded in a frame; a day of a minute or less needs many."""

_SETTLE = 128  # most repetitions of a frame that must be complete; 64 look at every pixel
_LARGEST = 8192  # pixels along a side, with all points
_SMOKE_BYTES = 1 << 30  # of the lightmaps of one folder


@dataclass(eq=False)
class Frame:
    """A drawn frame of H x W pixels.

    Attributes:
        screen: float32 [H, W, 3] on the device, sRGB in [0, 1].
        surface: bool [H, W] on the device, pixels that show the mesh under lightmaps at all of their points.
        hour: The hour of the day; 24 and more on the next day.
        stages: Seconds of each stage; each waits until the device has finished.
        decoded: Pages that were decoded.
        current: Share of the points on the mesh that show their own page within its tolerance of time.
    """

    screen: torch.Tensor
    surface: torch.Tensor
    hour: float
    stages: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    decoded: int = 0
    current: float = 1.0

    def picture(self) -> np.ndarray:
        """Returns the picture, uint8 [H, W, 3]."""
        return (self.screen * 255.0 + 0.5).to(torch.uint8).cpu().numpy()


@dataclass(frozen=True, eq=False)
class _View:
    """The camera at a second: eye [3]; rows right, up and forward [3, 3]; clip x and y of a point over its distance to
    the right and upwards, divided by its depth [2]."""

    eye: np.ndarray
    axes: np.ndarray
    zoom: np.ndarray

    def __call__(self, position: torch.Tensor) -> torch.Tensor:
        """Returns positions [V, 3] in clip space, [V, 4]; z / w = -1 / depth is exact in float32 at every distance."""
        offset = position.double() - torch.tensor(self.eye, device=position.device)
        # A matrix product may round rows differently, which would open cracks between triangles.
        x, y, w = (offset[:, 0] * a + offset[:, 1] * b + offset[:, 2] * c for a, b, c in self.axes.tolist())
        return torch.stack([self.zoom[0] * x, self.zoom[1] * y, -torch.ones_like(w), w], 1).float()


class Renderer:
    """Draws frames of a scene. It may be used in a `with` statement, which closes it; the scene stays open.

    Attributes:
        scene, device: The scene, and "cpu" or "cuda:N".
        height, width: Pixels of a frame.
        samples: Points along a side of a pixel.
        pages: The virtual texture of the lightmaps; its `set_weights` dims and recolours light groups.
    """

    def __init__(
        self,
        scene: Scene,
        height: int,
        width: int,
        device: str = "cpu",
        *,
        samples: int = 2,
        decodes: int = DECODES,
        budget: int = BUDGET,
    ) -> None:
        """Loads the scene onto the device.

        Args:
            scene: The scene.
            height, width: Pixels.
            device: "cpu", "cuda" or "cuda:N".
            samples: Points along a side of a pixel, 1 to 4.
            decodes: Largest number of pages that are decoded in a frame.
            budget: Bytes of the physical texture of the lightmaps.

        Raises:
            WlmError: There is no such device, a size is out of range, or a file of smoke is damaged.
        """
        if not 1 <= samples <= 4:
            raise WlmError(f"samples: expected 1 to 4 points along a side of a pixel, got {samples}")
        if not (height >= 1 and width >= 1 and samples * max(height, width) <= _LARGEST):
            raise WlmError(f"size: expected 1 to {_LARGEST // samples} pixels along a side, got {width} x {height}")
        self.scene, self.height, self.width, self.samples = scene, height, width, samples
        self.device = interop.check_device(device)
        self._device = torch.device(self.device)
        books = {files: _book(files, self._device) for files in {puff.files for puff in scene.smoke}}
        self._smoke = [books[puff.files] for puff in scene.smoke]
        with interop.stream(self.device):
            self._probes = DayProbes(scene, self.device) if scene.moving or scene.smoke else None
            meshes = [scene.mesh, *(moving.mesh for moving in scene.moving)]
            firsts = np.cumsum([0, *(len(mesh.position) for mesh in meshes)])
            triangle = [mesh.triangle + first for mesh, first in zip(meshes, firsts, strict=False)]
            self._firsts = firsts.tolist()
            self._position = self._put(np.concatenate([mesh.position for mesh in meshes]))
            self._triangle = self._put(np.concatenate(triangle))
            self._uv = self._put(np.concatenate([mesh.uv for mesh in meshes]))
            self._colour = self._put(np.concatenate([mesh.colour for mesh in meshes]))
            self._fixed = len(scene.mesh.triangle)
        self.pages = VirtualTexture(scene.light, self.device, decodes=decodes, budget=budget)

    def _put(self, values: np.ndarray) -> torch.Tensor:
        return torch.tensor(values, device=self._device)

    def draw(
        self, second: float, *, hour: float | None = None, complete: bool = False, original: torch.Tensor | None = None
    ) -> Frame:
        """Draws the frame of a second of the film.

        Args:
            second: Time of the camera, the moving objects and the smoke.
            hour: Hour of the light; None: that of the second.
            complete: Whether to decode until every point shows its own page, for pictures; a film does not wait.
            original: A lightmap of `original` that is shown instead of the pages.
        """
        hour = self.scene.hour_at(second) if hour is None else hour
        view, stages = self._view(second), dict.fromkeys(STAGES, 0.0)
        height, width = self.samples * self.height, self.samples * self.width
        with interop.stream(self.device), torch.no_grad():
            with self._timed(stages, "objects"):
                smoke_light = self._move(second, hour, view, complete)
            with self._timed(stages, "triangles"):
                raster = rasterize(view(self._position), self._triangle, height, width, derivative=True)
                uv, slope = interpolate(self._uv, self._triangle, raster, derivatives=True)
                colours = interpolate(self._colour, self._triangle, raster)
                fixed = (raster.triangle >= 0) & (raster.triangle < self._fixed)
            frame = Frame(colours, self._means(fixed.float()[..., None])[..., 0] > 0.999, hour, stages)
            if original is not None:
                light = texture(original, uv, derivatives=slope)
            else:
                light = self._lightmap(hour, fixed, uv, slope, complete, frame)
            with self._timed(stages, "light"):
                colour, exposure = self.scene.sky_at(hour)
                radiance = colours * torch.where(fixed[..., None], light / math.pi, torch.ones_like(light))
                sky = torch.tensor(colour, dtype=torch.float32, device=self._device)
                radiance = torch.where((raster.triangle < 0)[..., None], sky, radiance)
            with self._timed(stages, "smoke"):
                self._blend(second, view, raster, smoke_light, radiance)
            with self._timed(stages, "display"):
                frame.screen = _screen(self._means(radiance), exposure)
        return frame

    def original(self, hour: float) -> torch.Tensor:
        """Reads the scene's original lightmap of an hour for `draw`, float32 [H, W, 3], with its gaps filled.

        Raises:
            WlmError: The file is damaged, or has another size than the lightmaps.
        """
        path, own = self.scene.originals[hour], self.scene.light.light
        light = np.nan_to_num(read_light(path)[0][..., :3], posinf=65504.0)
        if light.shape[:2] != own.mask.shape:
            raise WlmError(
                f"{path}: expected {own.width} x {own.height} texels, as in {self.scene.light.name}, found "
                f"{light.shape[1]} x {light.shape[0]}"
            )
        return self._put(fill_gaps(np.maximum(light, np.float32(0.0)), own.mask))

    def memory(self) -> dict[str, int]:
        """Returns the bytes on the device by part: those of the virtual texture, the mesh, the probes and the smoke."""
        mesh = (self._position, self._triangle, self._uv, self._colour)
        parts = {f"lightmaps: {name}": size for name, size in self.pages.report()["memory"].items()}
        parts["meshes"] = sum(part.nbytes for part in mesh)
        if self._probes is not None:
            parts["probes: volume"] = self._probes.volume.memory_bytes
            parts["probes: light"] = self._probes.decoder.device_bytes
        if self._smoke:
            parts["smoke"] = sum(book.nbytes for book in set(self._smoke))
        return parts

    def close(self) -> None:
        """Closes the virtual texture."""
        self.pages.close()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @contextmanager
    def _timed(self, stages: dict[str, float], name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        if self.device != "cpu":
            torch.cuda.current_stream(self._device).synchronize()
        stages[name] += time.perf_counter() - start

    def _view(self, second: float) -> _View:
        eye, target, fov = self.scene.camera_at(second)
        forward, right = target - eye, np.cross(target - eye, [0.0, 1.0, 0.0])
        if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
            right = np.array([1.0, 0.0, 0.0])  # a curve between two rows may pass above the target
            forward = forward if forward.any() else np.array([0.0, -1.0, 0.0])
        axes = unit_or_zero(np.stack([right, np.cross(right, forward), forward]))
        tangent = math.tan(math.radians(fov) / 2.0)
        return _View(eye, axes, np.array([self.height / self.width, 1.0]) / tangent)

    def _move(self, second: float, hour: float, view: _View, complete: bool) -> np.ndarray:
        """Places the moving objects, and lights their vertices by the irradiance at their centres. `complete` waits for
        the light of the hour.

        Returns:
            SH of radiance at the centres of the squares of smoke, float32 [N, 9, 3].
        """
        if self._probes is None:
            return np.zeros((0, 9, 3), np.float32)
        moving = [(each, each.pose(second)) for each in self.scene.moving]
        centres = [each.centre(pose) for each, pose in moving]
        centres += [puff.position + 0.5 * puff.size * view.axes[1] for puff in self.scene.smoke]
        coefficients = self._probes.at(np.stack(centres), hour, view.eye, complete=complete)
        for i, (each, pose) in enumerate(moving):
            place = slice(*self._firsts[i + 1 : i + 3])
            position, radiance = each.lit(pose, coefficients[i])
            self._position[place], self._colour[place] = self._put(position), self._put(radiance)
        return coefficients[len(moving) :]

    def _lightmap(
        self, hour: float, fixed: torch.Tensor, uv: torch.Tensor, slope: torch.Tensor, complete: bool, frame: Frame
    ) -> torch.Tensor:
        """Decodes the pages of the view and returns the irradiance at its points, float32 [h, w, 3]."""
        sheet = to_warp(torch.where(fixed, 0, -1).to(torch.int32))
        pixels = sheet, to_warp(uv, wp.vec2), to_warp(slope.reshape(*fixed.shape, 4), wp.vec4)
        points = tuple(part.flatten() for part in pixels)
        count = max(int(fixed.sum()), 1)
        for _ in range(_SETTLE if complete else 1):
            with self._timed(frame.stages, "pages"):
                self.pages.frame(hour % DAY, *pixels)
            with self._timed(frame.stages, "light"):
                light, coarser, change = map(wp.to_torch, self.pages.read(*points))
            late = (coarser > 0) | (change > self.pages.tolerance)
            frame.decoded += self.pages.report()["decoded"]
            frame.current = 1.0 - int(late.sum()) / count
            if frame.current == 1.0:
                break
        return light.reshape(*fixed.shape, 3)

    def _blend(
        self, second: float, view: _View, raster: Raster, coefficients: np.ndarray, radiance: torch.Tensor
    ) -> None:
        """Draws the smoke over the picture, the farthest first: squares that are parallel to the image."""
        right, up, forward = view.axes
        lower = np.array([puff.position for puff in self.scene.smoke]).reshape(-1, 3) - view.eye
        height, width = radiance.shape[:2]
        for i in np.argsort(-(lower @ forward), kind="stable"):
            puff, depth = self.scene.smoke[i], float(lower[i] @ forward)
            if depth <= 0.0:
                continue
            # Left, top, and side of the square in pixels.
            side = puff.size * view.zoom / depth * [0.5 * width, 0.5 * height]
            x = (1.0 + float(lower[i] @ right) * view.zoom[0] / depth) * 0.5 * width - 0.5 * side[0]
            y = (1.0 - float(lower[i] @ up) * view.zoom[1] / depth) * 0.5 * height - side[1]
            rows = slice(*(int(np.clip(round(end), 0, height)) for end in (y, y + side[1])))
            columns = slice(*(int(np.clip(round(end), 0, width)) for end in (x, x + side[0])))
            if rows.start >= rows.stop or columns.start >= columns.stop:
                continue
            v, u = torch.meshgrid(
                (torch.arange(rows.start, rows.stop, device=self._device) + 0.5 - y) / side[1],
                (torch.arange(columns.start, columns.stop, device=self._device) + 0.5 - x) / side[0],
                indexing="ij",
            )
            lights = six_lights(coefficients[i], np.stack([right, up, -forward])) / (4.0 * math.pi)
            planes = self._smoke[i][puff.frame(second)].float()
            glow = planes[..., 7:].expand(-1, -1, 3)
            lit = planes[..., :6] @ self._put(lights.astype(np.float32)) + glow
            read = texture(torch.cat([lit, planes[..., 6:7]], 2), torch.stack([u, v], 2).float().contiguous())
            # Depth is -1 / w; it is 0 where no surface is.
            ahead = (raster.depth[rows, columns] > -1.0 / depth)[..., None]
            behind = radiance[rows, columns]
            radiance[rows, columns] = torch.where(ahead, read[..., :3] + read[..., 3:] * behind, behind)

    def _means(self, points: torch.Tensor) -> torch.Tensor:
        """Returns the means of the points of each pixel, [H, W, C]."""
        shape = (self.height, self.samples, self.width, self.samples, points.shape[2])
        return points.reshape(shape).mean((1, 3))


def _book(files: Sequence[Path], device: torch.device) -> torch.Tensor:
    """Reads the frames of smoke, float16 [N, H, W, 8]: six lightmaps, transparency and emission."""
    frames = []
    for path in files:
        six = read_six_way(path)
        if six.transparency is None:
            raise WlmError(f"{path}: expected transparency, found none")
        glow = torch.zeros_like(six.transparency) if six.emission is None else six.emission
        planes = torch.cat([six.lightmaps, six.transparency[None], glow[None]]).permute(1, 2, 0)
        if frames and planes.shape != frames[0].shape:
            raise WlmError(f"{path}: expected frames of one size, found another than in {files[0].name}")
        frames.append(planes.to(device, torch.float16))
        if len(files) * frames[0].nbytes > _SMOKE_BYTES:
            raise WlmError(
                f"{path.parent}: expected at most {_SMOKE_BYTES >> 20} MiB of six-way lightmaps, found "
                f"{len(files)} frames of {frames[0].nbytes} bytes"
            )
    return torch.stack(frames)


def _screen(radiance: torch.Tensor, exposure: float) -> torch.Tensor:
    """Converts radiance to sRGB in [0, 1], as `wlm.view.display.Display` does on the host."""
    x = filmic((radiance * 2.0**exposure).clamp(min=0.0)).clamp(max=1.0)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
