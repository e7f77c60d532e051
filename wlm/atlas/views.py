"""Finds the surface point at each pixel of a view of a scene, and at each texel of a sheet.

Cameras come from `wlm.ops.views` (around the scene) and `wlm.ops.indoors` (at eye height inside the scene). Triangles
without a lightmap, or that aren't `active`, hide what is behind them; their pixels count as uncovered.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.atlas.charts import charts, welded
from wlm.atlas.data import LightmappedScene, Sheet
from wlm.interop import check_device
from wlm.ops import raster as ops_raster
from wlm.ops.views import View, Viewpoint, sphere_views, visible_points


@dataclass(frozen=True, eq=False)
class Points:
    """N points of a scene's surface, on one device.

    Attributes:
        uv: float32 [N, 2], each point's UV in its sheet.
        sheet: int32 [N], number of the point's sheet.
        triangle: int64 [N], the triangle's number in the whole scene.
        weight: float32 [N, 3], barycentric weights of the triangle's corners.
    """

    uv: torch.Tensor
    sheet: torch.Tensor
    triangle: torch.Tensor
    weight: torch.Tensor

    def __len__(self) -> int:
        return len(self.uv)


def scene_views(scene: LightmappedScene, count: int, seed: int | None = None) -> list[View | Viewpoint]:
    """Makes `count` cameras around a scene and, where viewers can stand in it, as many inside. Without a seed they are
    spread evenly; a seed places all, also those inside, at random."""
    return [*sphere_views(count, seed), *scene.indoors.views(count, 0 if seed is None else seed)]


def visible_uv(
    scene: LightmappedScene, views: Sequence[View | Viewpoint], resolution: int, device: str
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Renders the visible triangle and its UVs from each camera, square pictures of `resolution` pixels along a side.

    Yields for each camera, on the device: int32 [h, w], number of the visible triangle, -1 for none or one without a
    lightmap; float32 [h, w, 2], barycentric weights of the triangle's corners 0 and 1 (all three add up to 1); float32
    [h, w, 2], UVs. Weights and UVs are 0 in uncovered pixels.
    """
    all_of = scene.triangles
    lit = torch.tensor(all_of.sheet >= 0, device=check_device(device))
    hidden = bool((all_of.sheet < 0).any())
    drawn = visible_points(all_of.position, all_of.triangle, all_of.uv, views, resolution, device)
    for visible, barycentric, uv in drawn:
        if hidden:
            covered = (visible >= 0) & lit[visible.clamp(min=0).long()]
            visible = torch.where(covered, visible, -1)
            barycentric, uv = barycentric * covered[..., None], uv * covered[..., None]
        yield visible, barycentric, uv


def points_at(
    scene: LightmappedScene, visible: torch.Tensor, barycentric: torch.Tensor, uv: torch.Tensor
) -> tuple[torch.Tensor, Points]:
    """Returns the covered pixels of a view from `visible_uv`, bool [h, w], and the points at them, row by row."""
    hit = visible >= 0
    triangle = visible[hit].long()
    sheet = torch.from_numpy(scene.triangles.sheet).to(visible.device)[triangle]
    return hit, Points(uv[hit], sheet, triangle, corner_weights(barycentric[hit]))


def corner_weights(barycentric: torch.Tensor) -> torch.Tensor:
    """Returns the barycentric weights of all three corners, float32 [N, 3], from those of corners 0 and 1, [N, 2]."""
    return torch.cat([barycentric, 1.0 - barycentric.sum(1, keepdim=True)], dim=1)


def cells_at(uv: torch.Tensor, height: int | torch.Tensor, width: int | torch.Tensor) -> torch.Tensor:
    """Returns the numbers of the cells, row by row, at N UVs in a grid of `height` x `width` cells over UV space, int64
    [N]; a UV of 1 is in the last row or column. The size of the grid may differ from UV to UV, int64 [N]."""
    column, row = ((uv[:, axis].double() * side).long() for axis, side in ((0, width), (1, height)))
    return row.clamp(min=0).clamp(max=height - 1) * width + column.clamp(min=0).clamp(max=width - 1)


def visibility(
    scene: LightmappedScene, views: Sequence[View | Viewpoint], resolution: int, height: int, width: int, device: str
) -> torch.Tensor:
    """Counts the pixels that show each cell of a grid over the UV space of a scene with one sheet, in square pictures
    of all cameras; returns float64 [height, width] on the device, row 0 at v = 0.

    Cells may be smaller than texels. A pixel belongs to the cell in which its UV lies; a UV of 1 lies in the last cell.
    """
    if height < 1 or width < 1:
        raise ValueError(f"height, width: expected at least 1 cell each, got {height} and {width}")
    count = torch.zeros(height * width, dtype=torch.int64, device=check_device(device))
    # Pixels without a triangle add 0, each to a separate cell: selecting the other pixels would wait for the GPU.
    own = torch.arange(resolution**2, device=count.device) % count.numel()
    for visible, _, uv in visible_uv(scene, views, resolution, device):
        shown = visible.reshape(-1) >= 0
        count.index_add_(0, torch.where(shown, cells_at(uv.reshape(-1, 2), height, width), own), shown.long())
    return count.reshape(height, width).double()


def texel_triangles(sheet: Sheet, height: int, width: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Finds the active triangle that contains the centre of each cell of a grid [height, width] over UV space, row 0 at
    v = 0.

    Returns on the device: int64 [height, width], the number of the triangle in the sheet (the first if there are
    several, -1 for none); float32 [height, width, 2], the barycentric weights of its corners 0 and 1.
    """
    active = torch.tensor(np.flatnonzero(sheet.active), device=device)
    raster = ops_raster.rasterize_uv(
        torch.tensor(sheet.uv, dtype=torch.float32, device=device),
        torch.tensor(sheet.triangle, device=device)[active],
        height,
        width,
    )
    return torch.where(raster.triangle >= 0, active[raster.triangle.clamp(min=0).long()], -1), raster.barycentric


def sheet_charts(sheet: Sheet) -> np.ndarray:
    """Numbers the charts of a sheet, int32 [F]: active triangles connected by edges whose ends coincide in space and in
    UV space have the same number; -1 for triangles that aren't active."""
    return charts(welded(sheet.position, sheet.uv, sheet.triangle), sheet.active)
