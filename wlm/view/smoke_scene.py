"""Smoke in a window: volumes under a light, and six-way lightmaps on a billboard."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch.nn.functional import avg_pool3d, grid_sample

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.data import Frames, read_six_way
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.shading import Light
from wlm.system import Meter, OnProgress
from wlm.view.canvas import Canvas
from wlm.view.display import Display
from wlm.view.scene import Scene, Slider, State, frame_slider
from wlm.view.surface import flat_geometry

_TURN = Slider("turn", -180.0, 180.0, 40.0, 5.0, ".0f", "°", wraps=True)
_HEIGHT = Slider("height", -90.0, 90.0, 35.0, 5.0, ".0f", "°")
_WHITE = 0.8  # screen value of the brightest light
_GLOW = np.array([1.0, 0.45, 0.12], np.float32)  # colour of heat, as on the HTML pages
_DARK, _BRIGHT, _SQUARES = 0.03, 0.06, 8  # checkerboard behind the smoke: its two levels, and its squares along a side
_MOST_VOXELS, _MOST_LIT = 4_000_000, 250_000  # voxels that are drawn, and voxels that the light is marched through
_AMBIENT = 0.15  # share of the light everywhere in the smoke, so that its dark side is visible
_COLUMNS, _LEAST_PLANE = 3, 160  # columns of the sheet of planes, and least width of a plane in pixels
_NAME = 1 / 12  # size of a plane's name relative to its width
_EMPTY = "#5a5d63"  # colour of the sheet's empty cells
_PLANES, _SMOKE, _BOX = "planes", "smoke", "box"


def six_way_scene(paths: Sequence[Path], *, title: str, progress: OnProgress | None = None) -> Scene:
    """Makes the scene of six-way lightmaps.

    Args:
        paths: One EXR a frame, of one size, as `wlm smoke bake` or `predict` wrote them.
        title: Title of the window.
        progress: Called about twice a second.
    """
    frames: list[SixWay] = []
    meter = Meter(progress, "read", len(paths))
    for path in paths:
        frames.append(read_six_way(path))
        first, size = frames[0].lightmaps.shape, frames[-1].lightmaps.shape
        if size != first:
            raise WlmError(
                f"{path}: expected {first[2]}x{first[1]} pixels as the first frame, found {size[2]}x{size[1]}"
            )
        if meter.due(len(frames)):
            meter.report(len(frames))
    number = frame_slider(len(frames))
    return _SixWayScene(
        title,
        ("smoke", "lightmaps"),
        sliders=(*number, _TURN, _HEIGHT),
        plays="frame" if number else "turn",
        flat=True,
        frames=frames,
    )


def volume_scene(frames: Frames, *, title: str, up: int = 1) -> Scene:
    """Makes the scene of a volume, or of the frames of a simulation.

    Args:
        frames: Frames as `wlm.smoke.data.load_frames` returns them.
        title: Title of the window.
        up: The axis that points up.
    """
    frames.load(frames.numbers[0])
    number = frame_slider(len(frames.numbers))
    plays = "frame" if number else "turn"
    return _VolumeScene(title, ("smoke",), sliders=(*number, _TURN, _HEIGHT), plays=plays, up=up, frames=frames)


def transmittance(volume: DensityVolume, toward: np.ndarray) -> np.ndarray:
    """Computes the transmittance from each voxel's centre to a distant light.

    Args:
        volume: A float32 volume; it is marched in steps of one voxel.
        toward: [3], unit vector to the light.

    Returns:
        float32 [X, Y, Z].
    """
    density = volume.density.float().cpu()
    shape = torch.tensor(density.shape, dtype=torch.float32)
    centres = torch.stack(torch.meshgrid(*(torch.arange(n) + 0.5 for n in density.shape), indexing="ij"), -1)
    step = torch.tensor(np.asarray(toward), dtype=torch.float32)
    depth = torch.zeros(density.shape)
    for number in range(math.ceil(float(shape.norm()))):
        # The sampler takes z, y, x in [-1, 1] over the box, and reads 0 outside.
        place = (2.0 * (centres + (number + 0.5) * step) / shape - 1.0).flip(-1)
        depth += grid_sample(density[None, None], place[None], align_corners=False)[0, 0]
    return torch.exp(-volume.extinction * volume.voxel * depth).numpy()


@dataclass(kw_only=True)
class _SixWayScene(Scene):
    frames: Sequence[SixWay]

    def __post_init__(self) -> None:
        self._brightness = _WHITE / max(1e-12, *(float(frame.lightmaps.max()) for frame in self.frames))

    def draw(self, canvas: Canvas, state: State) -> None:
        frame, display = self._frame(state), state.display(self._brightness)
        height, width = frame.lightmaps.shape[1:]
        axes = frame.camera.axes
        ground = _squares(height, width) / np.float32(self._brightness)
        cold = replace(frame, emission=None)
        light = cold.shade([Light(tuple(_toward(state) @ axes))], background=torch.from_numpy(ground)).numpy()
        if frame.emission is not None:
            light = light + frame.emission.numpy()[..., None] * _GLOW
        board = flat_geometry(height, width)
        canvas.textured(0, _SMOKE, board.position, board.triangle, board.uv, display.picture(light))
        sheet = _sheet(frame, display)
        page = flat_geometry(*sheet.shape[:2])
        canvas.textured(1, _PLANES, page.position, page.triangle, page.uv, sheet)

    def caption(self, state: State) -> str:
        height, width = self._frame(state).lightmaps.shape[1:]
        count, light = len(self.frames), "right {:.2f}, up {:.2f}, front {:.2f}".format(*_toward(state))
        return f"{width} × {height}, {count} frame{'s' * (count > 1)}; light from {light}"

    def _frame(self, state: State) -> SixWay:
        return self.frames[state.frame]


@dataclass(kw_only=True)
class _VolumeScene(Scene):
    frames: Frames

    def __post_init__(self) -> None:
        self._loaded: tuple[int, DensityVolume, DensityVolume] | None = None
        self._lit: tuple[object, np.ndarray] | None = None

    def draw(self, canvas: Canvas, state: State) -> None:
        number, volume, coarse = self._volume(state)
        key = number, tuple(_toward(state))
        if self._lit is None or self._lit[0] != key:
            light = torch.from_numpy(transmittance(coarse, self._world(state)))
            whole = torch.nn.functional.interpolate(light[None, None], size=volume.shape, mode="trilinear")[0, 0]
            self._lit = key, whole.numpy()
        colour = np.repeat((_AMBIENT + (1.0 - _AMBIENT) * self._lit[1])[..., None], 3, -1)
        if volume.temperature is not None:
            heat = volume.temperature.float().numpy()
            colour = colour + heat[..., None] / max(float(heat.max()), 1e-12) * _GLOW
        density = volume.density.float().numpy()
        most = max(float(density.max()), 1e-12)
        depth = volume.extinction * volume.voxel * most
        pixels = state.display(_WHITE).picture(colour)
        canvas.smoke(0, _SMOKE, pixels, density / most, depth, volume.voxel, np.asarray(volume.origin))
        low = np.asarray(volume.origin)
        canvas.box(0, _BOX, low, low + volume.voxel * np.asarray(volume.shape), (0.75, 0.75, 0.75))

    def caption(self, state: State) -> str:
        number, volume, _ = self._volume(state)
        shape = " × ".join(map(str, self._full))
        drawn = "" if self._full == volume.shape else f", drawn as {' × '.join(map(str, volume.shape))}"
        frames = f", frame {number} at {self.frames.time(number):.2f} s" if len(self.frames.numbers) > 1 else ""
        return f"{shape} voxels{drawn}, extinction {volume.extinction:g}{frames}"

    def _world(self, state: State) -> np.ndarray:
        """Returns the unit vector to the light in the world; a turn of 0 is along z if y is up, along -y if z is up."""
        x, y, z = _toward(state)
        return np.array([x, y, z] if self.up == 1 else [x, -z, y])

    def _volume(self, state: State) -> tuple[int, DensityVolume, DensityVolume]:
        number = self.frames.numbers[state.frame]
        if self._loaded is None or self._loaded[0] != number:
            volume = self.frames.load(number)
            self._full = volume.shape
            self._loaded = number, _coarser(volume, _MOST_VOXELS), _coarser(volume, _MOST_LIT)
        return self._loaded


def _toward(state: State) -> np.ndarray:
    """Returns the unit vector to the light in camera axes: right, up, towards the viewer."""
    turn, height = (math.radians(state.values[name]) for name in ("turn", "height"))
    return np.array([math.sin(turn) * math.cos(height), math.sin(height), math.cos(turn) * math.cos(height)])


def _coarser(volume: DensityVolume, most: int) -> DensityVolume:
    """Returns a volume with at most `most` voxels, by averaging cubes of voxels."""
    factor = next(n for n in itertools.count(1) if math.prod(-(-side // n) for side in volume.shape) <= most)
    if factor == 1:
        return volume

    def pooled(values: torch.Tensor) -> torch.Tensor:
        return avg_pool3d(values.float()[None], factor, ceil_mode=True, count_include_pad=False)[0]

    hot = None if volume.temperature is None else pooled(volume.temperature)
    return replace(volume, density=pooled(volume.density), temperature=hot, voxel=volume.voxel * factor)


def _squares(height: int, width: int) -> np.ndarray:
    side = max(height, width) / _SQUARES
    rows, columns = (np.arange(n) // side for n in (height, width))
    odd = (rows[:, None] + columns) % 2
    return np.repeat(np.where(odd, _BRIGHT, _DARK)[..., None], 3, 2).astype(np.float32)


def _sheet(frame: SixWay, display: Display) -> np.ndarray:
    """Draws a sheet of the lightmaps, the opacity and the emission with their names, uint8 [H, W, 3]."""
    planes = {name: display.picture(frame[name].numpy()) for name in DIRECTIONS}
    planes["alpha"] = Display().picture(1.0 - frame.transparency.numpy())
    if frame.emission is not None:
        planes["emission"] = display.picture(frame.emission.numpy())
    height, width = frame.lightmaps.shape[1:]
    # The names would be larger than small planes.
    enlarged = -(-_LEAST_PLANE // width)
    height, width = height * enlarged, width * enlarged
    sheet = Image.new("RGB", (_COLUMNS * width, -(-len(planes) // _COLUMNS) * height), _EMPTY)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(_NAME * width)
    for number, (name, pixels) in enumerate(planes.items()):
        row, column = divmod(number, _COLUMNS)
        sheet.paste(
            Image.fromarray(pixels).resize((width, height), Image.Resampling.NEAREST), (column * width, row * height)
        )
        pen.text((column * width + 4, row * height + 2), name, "#ffd27f", font)
    return np.asarray(sheet)
