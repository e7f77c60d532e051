"""What scenes draw with: meshes, lines and volumes in the panels of a window, known by name and brought up to date."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

_LEVELS = 256  # of the opacity of smoke


@dataclass(frozen=True)
class Hit:
    """What lies under the cursor.

    Attributes:
        panel: Number of the panel.
        name: That the scene gave the mesh.
        cell: Number of the mesh's cell.
        weights: Of a triangle's corners at the point, float64 [3].
    """

    panel: int
    name: str
    cell: int
    weights: np.ndarray


class Canvas:
    """The panels of a plotter. A mesh is known by its panel and its name; drawing it again replaces what changed."""

    def __init__(self, pyvista: ModuleType, plotter: Any, panels: int) -> None:
        """Takes the first panels of a plotter.

        Args:
            pyvista: The package.
            plotter: Its plotter.
            panels: How many; they are the plotter's first renderers.
        """
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
    ) -> None:
        """Draws triangles under a picture; later calls change the picture alone.

        Args:
            panel: Number of the panel.
            name: Of the mesh.
            position: [V, 3].
            triangle: int [F, 3].
            uv: [V, 2], u right, v down.
            picture: uint8 [H, W, 3].
            nearest: Whether texels show as squares.
        """
        drawn = self._drawn.get((panel, name))
        if drawn is None:
            mesh = self._triangles(position, triangle)
            mesh.active_texture_coordinates = np.stack([uv[:, 0], 1.0 - uv[:, 1]], 1).astype(np.float32)
            drawn = self._add(panel, name, mesh, texture=self._pyvista.Texture(picture))
        texture = self._pyvista.Texture(np.ascontiguousarray(picture))
        texture.interpolate, texture.repeat = not nearest, False
        drawn[0].texture = texture
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
    ) -> None:
        """Draws triangles of one colour a vertex.

        Args:
            panel: Number of the panel.
            name: Of the mesh.
            position: [V, 3].
            triangle: int [F, 3].
            colours: uint8 [V, 3].
            shape: Whether a lamp at the camera shows the shape, which the colours don't.
        """
        drawn = self._drawn.get((panel, name))
        if drawn is not None and len(drawn[1].points) == len(position) and drawn[1].n_cells == len(triangle):
            mesh = drawn[1]
            mesh.points = np.asarray(position, np.float32)
            mesh.regular_faces = triangle
            mesh.point_data["colours"] = colours
            drawn[0].visibility = True
            return
        mesh = self._triangles(position, triangle)
        mesh.point_data["colours"] = colours
        self._add(panel, name, mesh, scalars="colours", rgb=True, lighting=shape)

    def line(self, panel: int, name: str, points: np.ndarray, colour: str, *, closed: bool = False) -> None:
        """Draws a line through points [N, 3]."""
        self._add(panel, name, self._pyvista.lines_from_points(points, close=closed), color=colour, line_width=2)

    def box(self, panel: int, name: str, low: np.ndarray, high: np.ndarray, colour: Sequence[float]) -> None:
        """Draws the edges of a box between two corners [3]."""
        mesh = self._pyvista.Box(np.stack([low, high], 1).ravel())
        self._add(panel, name, mesh, color=colour, style="wireframe", line_width=1.5)

    def smoke(
        self,
        panel: int,
        name: str,
        colour: np.ndarray,
        density: np.ndarray,
        depth: float,
        voxel: float,
        origin: np.ndarray,
    ) -> None:
        """Draws a volume.

        Args:
            panel: Number of the panel.
            name: Of the volume.
            colour: uint8 [X, Y, Z, 3].
            density: float [X, Y, Z] in [0, 1].
            depth: Optical depth of a voxel's edge at density 1.
            voxel: Its length.
            origin: [3], the corner of the first voxel.
        """
        codes = np.concatenate([colour, (density[..., None] * 255.0 + 0.5).astype(np.uint8)], -1)
        codes = np.ascontiguousarray(codes.transpose(2, 1, 0, 3).reshape(-1, 4))
        grid = self._pyvista.ImageData(
            dimensions=density.shape, spacing=(voxel,) * 3, origin=np.asarray(origin) + 0.5 * voxel
        )
        grid.point_data["smoke"] = codes
        self._plotter.subplot(0, panel)
        options = {"name": f"{panel} {name}", "render": False, "reset_camera": False, "show_scalar_bar": False}
        # Made anew, since this mapper doesn't see that voxels changed. On GPUs VTK 9.7 takes the opacities of coloured
        # voxels for much less, and ignores their unit of length.
        actor = self._plotter.add_volume(grid, scalars="smoke", mapper="fixed_point", **options)
        actor.mapper.SetAutoAdjustSampleDistances(False)
        actor.mapper.SetSampleDistance(voxel)
        actor.mapper.SetImageSampleDistance(1.0 if self._plotter.off_screen else 2.0)
        opacity = actor.prop.GetScalarOpacity(0)
        opacity.RemoveAllPoints()
        for level in range(_LEVELS):
            opacity.AddPoint(level, 1.0 - np.exp(-depth * level / (_LEVELS - 1)))
        actor.prop.SetScalarOpacityUnitDistance(voxel)
        self._drawn[panel, name] = actor, grid

    def hide(self, panel: int, *names: str) -> None:
        """Hides meshes; those that were never drawn don't matter."""
        for name in names:
            if (panel, name) in self._drawn:
                self._drawn[panel, name][0].visibility = False

    def hit(self, x: int, y: int) -> Hit | None:
        """The triangle of a mesh at a pixel of the window, counted from the lower left."""
        from vtkmodules.vtkRenderingCore import vtkCellPicker

        for panel, renderer in enumerate(self.renderers):
            if not renderer.IsInViewport(x, y):
                continue
            picker = vtkCellPicker()
            picker.SetTolerance(0.0)
            picker.Pick(x, y, 0, renderer)
            found = picker.GetActor()
            for (where, name), (actor, _) in self._drawn.items():
                if found is not None and where == panel and actor is found:
                    r, s, _ = picker.GetPCoords()
                    return Hit(panel, name, picker.GetCellId(), np.array([1.0 - r - s, r, s]))
        return None

    def _triangles(self, position: np.ndarray, triangle: np.ndarray) -> Any:
        points = np.asarray(position, np.float32)
        return self._pyvista.PolyData.from_regular_faces(points, np.asarray(triangle, np.int64))

    def _add(self, panel: int, name: str, mesh: Any, **options: Any) -> tuple[Any, Any]:
        self._plotter.subplot(0, panel)
        options = {"lighting": False, "show_scalar_bar": False} | options
        actor = self._plotter.add_mesh(mesh, name=f"{panel} {name}", render=False, reset_camera=False, **options)
        self._drawn[panel, name] = actor, mesh
        return actor, mesh
