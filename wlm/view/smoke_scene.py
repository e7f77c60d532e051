"""Smoke in a window: six-way lightmaps on a billboard under a light."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from wlm.errors import WlmError
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.data import read_six_way
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
_COLUMNS, _LEAST_PLANE = 3, 160  # columns of the sheet of planes, and least width of a plane in pixels
_NAME = 1 / 12  # size of a plane's name relative to its width
_EMPTY = "#5a5d63"  # colour of the sheet's empty cells
_PLANES, _SMOKE = "planes", "smoke"


def six_way_scene(paths: Sequence[Path], *, title: str, progress: OnProgress | None = None) -> Scene:
    """Makes the scene of six-way lightmaps, one EXR a frame, of one size, as `wlm smoke bake` or `predict` write."""
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


def _toward(state: State) -> np.ndarray:
    """Returns the unit vector to the light in camera axes: right, up, towards the viewer."""
    turn, height = (math.radians(state.values[name]) for name in ("turn", "height"))
    return np.array([math.sin(turn) * math.cos(height), math.sin(height), math.cos(turn) * math.cos(height)])


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
