"""Scenes of a lightmap on its mesh or as a flat picture: lightmaps over time and lightmaps of meshes."""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from wlm.formats.geometry import Geometry
from wlm.view.canvas import Canvas, Hit
from wlm.view.scene import Scene, State

_NO_CHART = 77  # grey level, as on the HTML pages
_SHARE = 0.6  # opacity of a tile's colour over the light
_MESH = "mesh"


def flat_geometry(height: int, width: int) -> Geometry:
    """Makes two triangles that show a whole lightmap; its longer side is 1."""
    x, y = np.array([width, height]) / (2.0 * max(width, height))
    position = np.array([[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return Geometry(position, np.array([[0, 2, 1], [0, 3, 2]], np.uint32), uv)


def compared(decoded: bool, original: bool) -> tuple[str, ...]:
    """Titles of the panels."""
    if decoded and original:
        return ("decoded", "original", "error")
    return ("decoded",) if decoded else ("original",)


@dataclass(kw_only=True)
class SurfaceScene(Scene):
    """A scene of one lightmap.

    Attributes:
        geometry: The mesh, with lightmap UVs.
        brightness: Exposure at 0 EV.
        height, width: Size of the lightmap in texels.
        mask: bool [H, W], texels inside charts; None if unknown.
    """

    geometry: Geometry
    brightness: float = 1.0
    height: int
    width: int
    mask: np.ndarray | None = None

    @abstractmethod
    def lights(self, state: State) -> dict[str, np.ndarray]:
        """Light float32 [H, W, 3] by name, "decoded" or "original" or both, with the gaps between charts filled."""

    @abstractmethod
    def tell_texel(self, row: int, column: int, state: State) -> str:
        """Further facts about a texel, besides its position and light."""

    @abstractmethod
    def tile_colours(self) -> np.ndarray:
        """Colours [H, W, 3] in [0, 1] of the texels' tiles, for the view "tiles"."""

    def draw(self, canvas: Canvas, state: State) -> None:
        display, lights = state.display(self.brightness), self.lights(state)
        for panel, name in enumerate(self.panels):
            if name == "error":
                picture = display.error(lights["decoded"], lights["original"])
                if self.flat and self.mask is not None:
                    # These texels are not visible on the mesh, and are in no score.
                    picture[~self.mask] = _NO_CHART
            else:
                picture = display.picture(lights[name])
            if panel == 0 and state.view == "tiles":
                mixed = _SHARE * 255.0 * self.tile_colours() + (1.0 - _SHARE) * picture
                picture = (mixed + 0.5).astype(np.uint8)
            shape = self.geometry
            place, hidden = (shape.position, shape.triangle, shape.uv), self.room and not state.outside
            canvas.textured(panel, _MESH, *place, picture, nearest=self.flat, one_sided=hidden)

    def describe(self, hit: Hit, state: State) -> str:
        u, v = hit.weights @ self.geometry.uv[self.geometry.triangle[hit.cell]]
        column = int(np.clip(np.floor(u * self.width), 0, self.width - 1))
        row = int(np.clip(np.floor(v * self.height), 0, self.height - 1))
        values = ", ".join(f"{name} {_rgb(light[row, column])}" for name, light in self.lights(state).items())
        parts = (f"texel {column}, {row}", f"UV {u:.4f} {v:.4f}", self.tell_texel(row, column, state), values)
        return "   ".join(filter(None, parts))


def _rgb(light: np.ndarray) -> str:
    return " ".join(f"{value:.4g}" for value in light)
