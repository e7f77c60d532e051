"""Lightmaps over the day in a window: a model, its input, or both."""

import math
from dataclasses import dataclass

import numpy as np

from wlm.formats.geometry import Geometry
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.evaluation import count_kinds, psnr_of
from wlm.lightmap.model import SheetModel
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.tiles import TILE, TileGrid, TileKind
from wlm.texels import exposure, fill_gaps
from wlm.view.scene import Slider, State
from wlm.view.surface import SurfaceScene, compared, flat_geometry

_COLOURS = {
    TileKind.EMPTY: (0.15, 0.15, 0.15),
    TileKind.CONSTANT: (0.25, 0.5, 1.0),
    TileKind.STATIC: (0.2, 0.8, 0.35),
    TileKind.DYNAMIC: (1.0, 0.45, 0.1),
    TileKind.FRAMES: (0.65, 0.35, 0.9),
}
_NAMED = {
    TileKind.EMPTY: "grey",
    TileKind.CONSTANT: "blue",
    TileKind.STATIC: "green",
    TileKind.DYNAMIC: "orange",
    TileKind.FRAMES: "violet",
}


def lightmap_scene(
    model: SheetModel | None,
    lightmaps: SheetFrames | None,
    *,
    title: str,
    geometry: Geometry | None = None,
    up: int = 1,
) -> SurfaceScene:
    """Makes the scene of a model, of the set that was compressed, or of both side by side.

    Args:
        model: The model; None: the set alone.
        lightmaps: The set, of the model's size; None: the model alone.
        title: Of the window.
        geometry: The mesh, with lightmap UVs; None: the lightmap is a flat picture.
        up: The axis that points up.
    """
    first = model if model is not None else lightmaps
    height, width = (model.height, model.width) if model is not None else lightmaps.mask.shape
    times = first.times
    low, high = (0.0, first.period) if first.period is not None else (float(times[0]), float(times[-1]))
    noon = float(times[len(times) // 2])
    sliders = ()
    if len(times) > 1:
        wraps = first.period is not None
        sliders = (Slider("hour", low, high, noon, (high - low) / 96, wraps=wraps, clock=first.period == 24.0),)
    scene = _LightmapScene(
        title,
        compared(model is not None, lightmaps is not None),
        views=("light", "tiles") if model is not None else ("light",),
        sliders=sliders,
        plays="hour" if sliders else None,
        flat=geometry is None,
        up=up,
        room=geometry is not None and geometry.is_room,
        geometry=flat_geometry(height, width) if geometry is None else geometry,
        height=height,
        width=width,
        mask=None if lightmaps is None else lightmaps.mask,
        model=model,
        lightmaps=lightmaps,
    )
    lights = scene.lights(State({"hour": noon}, "light"))
    scene.brightness = exposure(lights.get("original", next(iter(lights.values()))))
    return scene


@dataclass(kw_only=True)
class _LightmapScene(SurfaceScene):
    model: SheetModel | None
    lightmaps: SheetFrames | None

    def __post_init__(self) -> None:
        self._shown: tuple[float, dict[str, np.ndarray], str] | None = None
        self._decoder = None if self.model is None else SheetDecoder(self.model)
        if self.lightmaps is not None:
            given = self.lightmaps
            self._axis = TimeAxis(given.times, given.period, "frames")
            self._frames = fill_gaps(given.frames, given.mask)

    def lights(self, state: State) -> dict[str, np.ndarray]:
        hour = self._hour(state)
        if self._shown is None or self._shown[0] != hour:
            lights, note = {}, ""
            if self._decoder is not None:
                lights["decoded"] = self._decoder.frame(hour)
            if self.lightmaps is not None:
                before, after, share = self._axis.neighbours(hour)
                mixed = (1.0 - share) * self._frames[before] + share * self._frames[after]
                lights["original"] = mixed.astype(np.float32)
                if self.model is not None and share == 0.0:
                    score = psnr_of(self.model, self.lightmaps, before, lights["decoded"])
                    note = "" if math.isnan(score) else f"PSNR {score:.2f} dB"
                elif share:
                    note = f"original interpolated from {self._axis.times[before]:g} and {self._axis.times[after]:g}"
            self._shown = hour, lights, note
        return self._shown[1]

    def tile_colours(self) -> np.ndarray:
        grid = TileGrid.of(self.height, self.width)
        table = np.array([_COLOURS[kind] for kind in sorted(_COLOURS)], np.float32)
        colours = table[self.model.kind].reshape(grid.rows, grid.cols, 3)
        whole = colours.repeat(TILE, 0).repeat(TILE, 1)
        # Tiles of one kind stand apart.
        whole[::TILE] *= 0.3
        whole[:, ::TILE] *= 0.3
        return whole[: self.height, : self.width]

    def tell_texel(self, row: int, column: int, state: State) -> str:
        outside = "" if self.mask is None or self.mask[row, column] else "outside of the mask"
        if self.model is None:
            return outside
        number = row // TILE * self.model.grid.cols + column // TILE
        told = f"tile {number} ({TileKind(self.model.kind[number]).name.lower()})"
        return "   ".join(filter(None, (told, outside)))

    def caption(self, state: State) -> str:
        self.lights(state)
        note = f"; {self._shown[2]}" if self._shown[2] else ""
        if self.model is None:
            count = len(self.lightmaps.times)
            hours = f", {count} hours" if count > 1 else ""
            return f"{self.lightmaps.name}, {self.width} × {self.height}{hours}{note}"
        size = f"{self.model.name}, {self.width} × {self.height}, profile {self.model.profile.name}"
        counts = count_kinds(self.model)
        kinds = [(kind.name.lower(), _NAMED[kind]) for kind in TileKind if counts[kind.name.lower()]]
        told = (f"{counts[name]} {name}{f' ({colour})' * (state.view == 'tiles')}" for name, colour in kinds)
        return f"{size}, tiles: {', '.join(told)}{note}"

    def _hour(self, state: State) -> float:
        first = self.model if self.model is not None else self.lightmaps
        return state.values.get("hour", float(first.times[0]))
