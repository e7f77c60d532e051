"""Scenes of lightmaps, on their mesh or as a flat picture: lightmaps over time, and lightmaps of meshes."""

import math
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from wlm.atlas.model import AtlasModel, unpack_entries
from wlm.formats.geometry import Geometry
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.evaluation import count_kinds, psnr_of
from wlm.lightmap.model import SheetModel
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.tiles import TILE, TileGrid, TileKind
from wlm.texels import exposure, fill_gaps
from wlm.view.canvas import Canvas
from wlm.view.display import heat
from wlm.view.scene import Scene, Slider, State

_NO_CHART, _PAPER = 77, (27, 27, 31)  # colours outside charts of errors and of light, as on the HTML pages
_SHARE = 0.6  # opacity of a tile's colour over the light
_MESH = "mesh"
_COLOURS = {
    TileKind.EMPTY: ("grey", (0.15, 0.15, 0.15)),
    TileKind.CONSTANT: ("blue", (0.25, 0.5, 1.0)),
    TileKind.DYNAMIC: ("orange", (1.0, 0.45, 0.1)),
    TileKind.FRAMES: ("violet", (0.65, 0.35, 0.9)),
}
"""Name and colour of each kind of tile in the view "tiles"."""


def flat_geometry(height: int, width: int) -> Geometry:
    """Makes two triangles that show a whole lightmap; its longer side is 1."""
    x, y = np.array([width, height]) / (2.0 * max(width, height))
    position = np.array([[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return Geometry(position, np.array([[0, 2, 1], [0, 3, 2]], np.uint32), uv)


def compared(original: bool) -> tuple[str, ...]:
    """Returns the titles of the panels, left to right, of decoded light, with or without its original."""
    return ("decoded", "original", "error") if original else ("decoded",)


@dataclass(kw_only=True)
class SurfaceScene(Scene):
    """A scene of one lightmap of `height` x `width` texels on a mesh with lightmap UVs; `mask`, bool [H, W], are the
    texels inside charts, and `brightness` is the exposure at 0 EV."""

    geometry: Geometry
    brightness: float = 1.0
    height: int
    width: int
    mask: np.ndarray

    @abstractmethod
    def lights(self, state: State) -> dict[str, np.ndarray]:
        """Light float32 [H, W, 3] by name, "decoded" and perhaps "original", with the gaps between charts filled."""

    @abstractmethod
    def tile_colours(self) -> np.ndarray:
        """Colours [H, W, 3] in [0, 1] of the texels' tiles, for the view "tiles"."""

    def draw(self, canvas: Canvas, state: State) -> None:
        display, lights = state.display(self.brightness), self.lights(state)
        for panel, name in enumerate(self.panels):
            if name == "error":
                picture = display.error(lights["decoded"], lights["original"])
            else:
                picture = display.picture(lights[name])
            if self.flat:
                # These texels are not visible on the mesh, and are in no score.
                picture[~self.mask] = _NO_CHART if name == "error" else _PAPER
            if panel == 0 and state.view == "tiles":
                mixed = _SHARE * 255.0 * self.tile_colours() + (1.0 - _SHARE) * picture
                picture = (mixed + 0.5).astype(np.uint8)
            shape = self.geometry
            place = shape.position, shape.triangle, shape.uv
            canvas.textured(panel, _MESH, *place, picture, nearest=self.flat, one_sided=self.room)


def lightmap_scene(
    model: SheetModel, lightmaps: SheetFrames | None, *, title: str, geometry: Geometry | None = None, up: int = 1
) -> SurfaceScene:
    """Makes the scene of a sheet of lightmaps over time, beside its input of the same size if that is given, on a mesh
    with lightmap UVs or as a flat picture."""
    height, width, times = model.height, model.width, model.times
    low, high = (0.0, model.period) if model.period is not None else (float(times[0]), float(times[-1]))
    noon = float(times[len(times) // 2])
    sliders = ()
    if len(times) > 1:
        wraps = model.period is not None
        sliders = (Slider("hour", low, high, noon, (high - low) / 96, wraps=wraps, clock=model.period == 24.0),)
    scene = _LightmapScene(
        title,
        compared(lightmaps is not None),
        views=("light", "tiles"),
        sliders=sliders,
        flat=geometry is None,
        up=up,
        room=geometry is not None and geometry.is_room,
        geometry=flat_geometry(height, width) if geometry is None else geometry,
        height=height,
        width=width,
        mask=model.mask if lightmaps is None else lightmaps.mask,
        model=model,
        lightmaps=lightmaps,
    )
    scene.brightness = exposure(scene.lights(State({"hour": noon}, "light"))["decoded"])
    return scene


@dataclass(kw_only=True)
class _LightmapScene(SurfaceScene):
    model: SheetModel
    lightmaps: SheetFrames | None

    def __post_init__(self) -> None:
        self._shown: tuple[float, dict[str, np.ndarray], str] | None = None
        self._decoder = SheetDecoder(self.model)
        if self.lightmaps is not None:
            given = self.lightmaps
            self._axis = TimeAxis(given.times, given.period, "frames")
            self._frames = fill_gaps(given.frames, given.mask)

    def lights(self, state: State) -> dict[str, np.ndarray]:
        hour = state.values.get("hour", float(self.model.times[0]))
        if self._shown is None or self._shown[0] != hour:
            lights, note = {"decoded": self._decoder.frame(hour)}, ""
            if self.lightmaps is not None:
                before, after, share = self._axis.neighbours(hour)
                mixed = (1.0 - share) * self._frames[before] + share * self._frames[after]
                lights["original"] = mixed.astype(np.float32)
                if share == 0.0:
                    score = psnr_of(self.model, self.lightmaps, before, lights["decoded"])
                    note = "" if math.isnan(score) else f"PSNR {score:.2f} dB"
                else:
                    note = f"original interpolated from {self._axis.times[before]:g} and {self._axis.times[after]:g}"
            self._shown = hour, lights, note
        return self._shown[1]

    def tile_colours(self) -> np.ndarray:
        grid = TileGrid.of(self.height, self.width)
        table = np.zeros((max(TileKind) + 1, 3), np.float32)
        table[list(_COLOURS)] = [colour for _, colour in _COLOURS.values()]
        colours = table[self.model.kind].reshape(grid.rows, grid.cols, 3)
        whole = colours.repeat(TILE, 0).repeat(TILE, 1)
        # Dark borders separate tiles of one kind.
        whole[::TILE] *= 0.3
        whole[:, ::TILE] *= 0.3
        return whole[: self.height, : self.width]

    def caption(self, state: State) -> str:
        self.lights(state)
        note = f"; {self._shown[2]}" if self._shown[2] else ""
        size = f"{self.model.name}, {self.width} × {self.height}, profile {self.model.profile.name}"
        counts = count_kinds(self.model)
        kinds = [(kind.name.lower(), _COLOURS[kind][0]) for kind in TileKind if counts[kind.name.lower()]]
        told = (f"{counts[name]} {name}{f' ({colour})' * (state.view == 'tiles')}" for name, colour in kinds)
        return f"{size}, tiles: {', '.join(told)}{note}"


def atlas_scene(
    model: AtlasModel, original: np.ndarray | None = None, *, title: str, flat: bool = False, up: int = 1
) -> SurfaceScene:
    """Makes the scene of a mesh under its lightmap: the first sheet of a model in its first state. `original`, [H, W,
    3], is the lightmap that was compressed, shown beside the decoded one; `flat` shows the lightmap unwrapped."""
    sheet = model.scene.sheets[0]
    height, width = sheet.mask.shape
    shape = Geometry(sheet.position.astype(np.float32), sheet.triangle[sheet.active].astype(np.uint32), sheet.uv)
    light = {"decoded": fill_gaps(model.decoder().lightmap(), sheet.mask)}
    if original is not None:
        light["original"] = fill_gaps(np.nan_to_num(original[..., :3], posinf=65504.0), sheet.mask)
    return _AtlasScene(
        title,
        compared("original" in light),
        views=("light", "tiles") if model.method == "tiles" else ("light",),
        flat=flat,
        up=up,
        room=not flat and shape.is_room,
        geometry=flat_geometry(height, width) if flat else shape,
        brightness=exposure(light["decoded"][sheet.mask]),
        height=height,
        width=width,
        model=model,
        light=light,
        mask=sheet.mask,
    )


@dataclass(kw_only=True)
class _AtlasScene(SurfaceScene):
    model: AtlasModel
    light: dict[str, np.ndarray]

    def lights(self, state: State) -> dict[str, np.ndarray]:
        return self.light

    def tile_colours(self) -> np.ndarray:
        _, size, _ = unpack_entries(self.model.lut, self.model.first_block_code)
        side = self.model.profile.tile
        share = size.prod(-1) / (side + 1) ** 2
        rows, columns = (
            np.minimum(np.arange(n) // side, count - 1) for n, count in zip(self.mask.shape, share.shape, strict=True)
        )
        colours = heat(share)[rows][:, columns] / 255.0
        colours[::side] *= 0.7
        colours[:, ::side] *= 0.7
        return colours

    def caption(self, state: State) -> str:
        size = f"textures {100 * (1.0 - self.model.compression_ratio):.1f}% of half floats"
        text = f"{self.width} × {self.height}, {size}, method {self.model.method}"
        if state.view == "tiles":
            text += f"; a tile's texels: 1 is black, {(self.model.profile.tile + 1) ** 2} is white"
        return text
