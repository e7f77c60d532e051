"""What of a scene's lightmaps is seen: the sheet and the place in it at each pixel of views of the whole scene."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from wlm.atlas.model import Profile
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.detail import FLOOR, scales
from wlm.atlas.scene.model import SceneProfile
from wlm.atlas.weights import FineGrid, spread
from wlm.interop import check_device
from wlm.ops.views import View, Viewpoint, sphere_views, visible_points

RESOLUTION = 768
"""Pixels along a side of a view that visibility is counted in."""


def scene_views(scene: LightmappedScene, count: int, seed: int | None = None) -> list[View | Viewpoint]:
    """Makes views of a scene: cameras around it and, where viewers can stand in it, as many from inside.

    Args:
        scene: The scene.
        count: Number of cameras around it, at least 0.
        seed: None spreads them evenly; else they are random.
    """
    return [*sphere_views(count, seed), *scene.indoors().views(count, 0 if seed is None else seed)]


def seen_points(
    scene: LightmappedScene, views: Sequence[View | Viewpoint], resolution: int, device: str
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Draws a scene from each camera.

    Args:
        scene: The scene.
        views: The cameras.
        resolution: Pixels along a side, 1 to 16,384.
        device: "cpu" or "cuda:N".

    Yields:
        For each camera, on the device: bool [h, w], the pixels that show a sheet; and of these, row by row, the sheet,
        int32 [N], and the UVs in it, float32 [N, 2].

    Raises:
        WlmError: There is no such device.
        ValueError: The resolution is out of range.
    """
    position, triangle, uv, owner = scene.geometry()
    sheet_of = torch.from_numpy(owner).to(check_device(device))
    for visible, _, place in visible_points(position, triangle, uv, views, resolution, device):
        sheet = torch.where(visible >= 0, sheet_of[visible.clamp(min=0).long()], -1)
        hit = sheet >= 0
        yield hit, sheet[hit], place[hit]


def scene_weights(
    scene: LightmappedScene, varies: Sequence[np.ndarray], profile: SceneProfile, seed: int, device: str
) -> list[np.ndarray]:
    """How much each quarter of a texel counts: the pixels of random views of the scene that show it, and a little.

    Objects that are seen large so get more than those that are small, far away or hidden. A view counts by the inverse
    of how much the light that it shows varies (`wlm.atlas.scene.detail`), and by no more if it shows more pixels.

    Args:
        scene: The scene.
        varies: `variation`.
        profile: `views`, `unseen` and `border`.
        seed: Of the views.
        device: "cpu" or "cuda:N".

    Returns:
        For each sheet float64 [2 H, 2 W], 0 where there is no triangle.

    Raises:
        WlmError: There is no such device.
    """
    grids = [FineGrid(sheet.mesh, device) for sheet in scene.sheets]
    visible = _counts(scene, grids, Detail(scene, varies, device), scene_views(scene, profile.views, seed), device)
    # As `spread` has them.
    used = [grid.covered | grid.texels | (count > 0) for grid, count in zip(grids, visible, strict=True)]
    cells = sum(int(each.sum()) for each in used)
    mean = sum(float(count[each].sum()) for count, each in zip(visible, used, strict=True)) / max(cells, 1)
    settings = Profile(name="", unseen=profile.unseen, border=profile.border)
    spreads = (spread(grid, count, settings, mean or 1.0) for grid, count in zip(grids, visible, strict=True))
    return [each.cpu().numpy() for each in spreads]


def _counts(
    scene: LightmappedScene,
    grids: Sequence[FineGrid],
    detail: "Detail",
    views: Sequence[View | Viewpoint],
    device: str,
) -> list[torch.Tensor]:
    """Shares of views that show each cell of each sheet, over how much light varies in the view."""
    sizes = [(grid.height, grid.width) for grid in grids]
    first = np.cumsum([0, *(height * width for height, width in sizes)])
    place = torch.tensor(np.array([(*size, start) for size, start in zip(sizes, first, strict=False)]), device=device)
    count = torch.zeros(int(first[-1]), dtype=torch.float64, device=device)
    for _, sheet, uv in seen_points(scene, views, RESOLUTION, device):
        if not len(sheet):
            continue
        height, width, start = place[sheet.long()].T
        column = torch.minimum((uv[:, 0].double() * width).long().clamp(min=0), width - 1)
        row = torch.minimum((uv[:, 1].double() * height).long().clamp(min=0), height - 1)
        cell, pixels = torch.unique(start + row * width + column, return_counts=True)
        count[cell] += pixels / (detail.lost(sheet, uv) * len(sheet))
    return [count[a:b].reshape(size) for a, b, size in zip(first, first[1:], sizes, strict=False)]


class Detail:
    """How much the light of a scene varies, on a device.

    Args:
        scene: The scene.
        varies: `variation`.
        device: "cpu" or "cuda:N".
    """

    def __init__(self, scene: LightmappedScene, varies: Sequence[np.ndarray], device: str) -> None:
        masks = [sheet.mesh.mask for sheet in scene.sheets]
        scale = scales(varies, masks)
        even = [np.tensordot(1.0 / scale**2, each, 1).ravel() / len(scale) for each in varies]
        first = np.cumsum([0, *(mask.size for mask in masks)])
        place = np.array([(*mask.shape, start) for mask, start in zip(masks, first, strict=False)])
        self._even, self._place = torch.from_numpy(np.concatenate(even)).to(device), torch.from_numpy(place).to(device)

    def sizes(self, sheet: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows and columns of texels of the sheet at each point, int64 [N]."""
        return tuple(self._place[sheet.long()].T[:2])

    def lost(self, sheet: torch.Tensor, uv: torch.Tensor) -> float:
        """What a view of the points [N] loses, in about, mean of states in which light varies alike; above 0."""
        height, width, start = self._place[sheet.long()].T
        column, row = (
            (uv[:, axis].double() * side).long().clamp(min=0).minimum(side - 1)
            for axis, side in ((0, width), (1, height))
        )
        return float(self._even[start + row * width + column].mean()) + FLOOR
