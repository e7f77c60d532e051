"""What scenes draw with: meshes, lines and volumes in the panels of a window, known by name and brought up to date."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

_LEVELS = 256  # of the opacity of smoke
_STEP = 0.5  # voxels between two samples of smoke: whole ones show as stripes, and small ones round the colour away


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
        self._one_sided: set[tuple[int, str]] = set()

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
        """Draws triangles under a picture; later calls change the picture alone.

        Args:
            panel: Number of the panel.
            name: Of the mesh.
            position: [V, 3].
            triangle: int [F, 3].
            uv: [V, 2], u right, v down.
            picture: uint8 [H, W, 3].
            nearest: Whether texels show as squares.
            one_sided: Whether triangles that face away, clockwise as seen, are left out.
        """
        drawn = self._drawn.get((panel, name))
        if drawn is None:
            mesh = self._triangles(position, triangle)
            mesh.active_texture_coordinates = np.stack([uv[:, 0], 1.0 - uv[:, 1]], 1).astype(np.float32)
            drawn = self._add(panel, name, mesh, texture=self._pyvista.Texture(picture))
        texture = self._pyvista.Texture(np.ascontiguousarray(picture))
        texture.interpolate, texture.repeat = not nearest, False
        drawn[0].texture = texture
        self._leave_out(panel, name, one_sided)
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
        """Draws triangles of one colour a vertex.

        Args:
            panel: Number of the panel.
            name: Of the mesh.
            position: [V, 3].
            triangle: int [F, 3].
            colours: uint8 [V, 3].
            shape: Whether a lamp at the camera shows the shape, which the colours don't.
            one_sided: As for `textured`.
        """
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
        self._leave_out(panel, name, one_sided)

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
        actor.mapper.SetSampleDistance(_STEP * voxel)
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
            here = {name: drawn for (where, name), drawn in self._drawn.items() if where == panel}
            # The picker sees the backs that are left out, so what is one-sided is looked for without it.
            walls = {name for name in here if (panel, name) in self._one_sided and here[name][0].visibility}
            for name, (actor, _) in here.items():
                actor.pickable = name not in walls
            picker = vtkCellPicker()
            picker.SetTolerance(0.0)
            picker.Pick(x, y, 0, renderer)
            origin = _world(renderer, x, y, 0.0)
            ray = _world(renderer, x, y, 1.0) - origin
            hits = [
                (distance, Hit(panel, name, cell, weights))
                for name in walls
                for distance, cell, weights in _front_hits(here[name][1], origin, ray)
            ]
            for name, (actor, _) in here.items():
                if actor is picker.GetActor():
                    r, s, _ = picker.GetPCoords()
                    distance = (np.array(picker.GetPickPosition()) - origin) @ ray / (ray @ ray)
                    hits.append((distance, Hit(panel, name, picker.GetCellId(), np.array([1.0 - r - s, r, s]))))
            return min(hits, key=lambda hit: hit[0])[1] if hits else None
        return None

    def _leave_out(self, panel: int, name: str, one_sided: bool) -> None:
        """Draws a mesh without its backs, or with them."""
        self._drawn[panel, name][0].prop.culling = "back" if one_sided else "none"
        (self._one_sided.add if one_sided else self._one_sided.discard)((panel, name))

    def _triangles(self, position: np.ndarray, triangle: np.ndarray) -> Any:
        points = np.asarray(position, np.float32)
        return self._pyvista.PolyData.from_regular_faces(points, np.asarray(triangle, np.int64))

    def _add(self, panel: int, name: str, mesh: Any, **options: Any) -> tuple[Any, Any]:
        self._plotter.subplot(0, panel)
        options = {"lighting": False, "show_scalar_bar": False} | options
        actor = self._plotter.add_mesh(mesh, name=f"{panel} {name}", render=False, reset_camera=False, **options)
        self._drawn[panel, name] = actor, mesh
        return actor, mesh


def _world(renderer: Any, x: int, y: int, depth: float) -> np.ndarray:
    """The point float64 [3] at a pixel, between the near plane, 0, and the far one, 1."""
    renderer.SetDisplayPoint(x, y, depth)
    renderer.DisplayToWorld()
    *point, share = renderer.GetWorldPoint()
    return np.array(point) / share


def _front_hits(mesh: Any, origin: np.ndarray, direction: np.ndarray) -> list[tuple[float, int, np.ndarray]]:
    """The nearest triangle that a ray meets from its front, if any: distance, number and the point's weights.

    Distances are in lengths of `direction` (Möller and Trumbore 1997).
    """
    a, b, c = np.asarray(mesh.points, np.float64)[mesh.regular_faces].transpose(1, 0, 2)
    across, along = b - a, c - a
    turned = np.cross(direction, along)
    scale = np.einsum("fk,fk->f", across, turned)
    front = np.flatnonzero(scale > 0.0)  # the others face away, or are seen from their edge
    scale, turned, across, along = scale[front], turned[front], across[front], along[front]
    away = origin - a[front]
    r = np.einsum("fk,fk->f", away, turned) / scale
    lifted = np.cross(away, across)
    s = lifted @ direction / scale
    distance = np.einsum("fk,fk->f", along, lifted) / scale
    met = np.flatnonzero((r >= 0.0) & (s >= 0.0) & (r + s <= 1.0) & (distance >= 0.0))
    if not len(met):
        return []
    first = met[np.argmin(distance[met])]
    return [(float(distance[first]), int(front[first]), np.array([1.0 - r[first] - s[first], r[first], s[first]]))]
