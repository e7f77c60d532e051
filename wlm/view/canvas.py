"""Draws named meshes in the panels of a window; drawing a name again updates it."""

from types import ModuleType
from typing import Any

import numpy as np


class Canvas:
    """The panels of a plotter. A mesh is identified by panel and name; drawing it again updates what changed."""

    def __init__(self, pyvista: ModuleType, plotter: Any, panels: int) -> None:
        """Uses the first renderers of a plotter of the package pyvista as panels."""
        self._pyvista, self._plotter = pyvista, plotter
        self.renderers = plotter.renderers[:panels]
        self._drawn: dict[tuple[int, str], tuple[Any, Any]] = {}  # the actor and its data

    def textured(
        self,
        panel: int,
        name: str,
        position: np.ndarray,
        triangle: np.ndarray,
        uv: np.ndarray,
        picture: np.ndarray,
        *,
        nearest: bool = False,
        one_sided: bool = False,
    ) -> None:
        """Draws triangles, with v of their UVs down, under a texture uint8 [H, W, 3]; later calls only change the
        texture.

        With `nearest` it is read without a filter; with `one_sided`, triangles that face away from the camera are
        hidden.
        """
        drawn = self._drawn.get((panel, name))
        if drawn is None:
            mesh = self._triangles(position, triangle)
            mesh.active_texture_coordinates = np.stack([uv[:, 0], 1.0 - uv[:, 1]], 1).astype(np.float32)
            drawn = self._add(panel, name, mesh, texture=self._pyvista.Texture(picture))
        texture = self._pyvista.Texture(np.ascontiguousarray(picture))
        texture.interpolate, texture.repeat = not nearest, False
        drawn[0].texture = texture
        drawn[0].prop.culling = "back" if one_sided else "none"
        drawn[0].visibility = True

    def coloured(
        self,
        panel: int,
        name: str,
        position: np.ndarray,
        triangle: np.ndarray,
        colours: np.ndarray,
        *,
        shape: bool = False,
        one_sided: bool = False,
    ) -> None:
        """Draws triangles with vertex colours, uint8 [V, 3]; the other arguments are those of `textured`. With `shape`
        a light at the camera shades the mesh."""
        drawn = self._drawn.get((panel, name))
        if drawn is not None and len(drawn[1].points) == len(position) and drawn[1].n_cells == len(triangle):
            mesh = drawn[1]
            mesh.points = np.asarray(position, np.float32)
            mesh.regular_faces = triangle
            mesh.point_data["colours"] = colours
            drawn[0].visibility = True
        else:
            mesh = self._triangles(position, triangle)
            mesh.point_data["colours"] = colours
            self._add(panel, name, mesh, scalars="colours", rgb=True, lighting=shape)
        self._drawn[panel, name][0].prop.culling = "back" if one_sided else "none"

    def background(self, panel: int, colour: np.ndarray) -> None:
        """Fills a panel behind the meshes with a colour [3] in [0, 1]."""
        self._plotter.subplot(0, panel)
        self._plotter.set_background(tuple(map(float, colour)), all_renderers=False)

    def hide(self, panel: int, *names: str) -> None:
        """Hides meshes; names that were never drawn are ignored."""
        for name in names:
            if (panel, name) in self._drawn:
                self._drawn[panel, name][0].visibility = False

    def _triangles(self, position: np.ndarray, triangle: np.ndarray) -> Any:
        points = np.asarray(position, np.float32)
        return self._pyvista.PolyData.from_regular_faces(points, np.asarray(triangle, np.int64))

    def _add(self, panel: int, name: str, mesh: Any, **options: Any) -> tuple[Any, Any]:
        self._plotter.subplot(0, panel)
        options = {"lighting": False, "show_scalar_bar": False} | options
        actor = self._plotter.add_mesh(mesh, name=f"{panel} {name}", render=False, reset_camera=False, **options)
        self._drawn[panel, name] = actor, mesh
        return actor, mesh
