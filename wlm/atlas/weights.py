"""Weights of a lightmap's error: how much each part of it counts, by visibility and by nearness to a seam."""

from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from wlm.atlas.coverage import covered_texels
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.model import Profile
from wlm.atlas.views import mesh_charts, mesh_views, surface_points, texel_triangles, visibility

_BORDER = 2  # cells of the fine grid: one texel
_RESOLUTION = 768  # pixels along a side of a view that visibility is counted in
_POINTS = 4  # random points of the surface per cell, where there are no views
_POINTS_AT_ONCE = 1 << 20
# Relative error is that over the light and this share of what all but a hundredth of the texels stay below: darker
# light is black on a screen that shows the brighter.
_DARK, _BRIGHT = 0.05, 99.0


class FineGrid:
    """The lightmap's grid at twice its resolution: each cell is a quarter of a texel. Its maps are computed once.

    Attributes:
        mesh: The mesh.
        device: "cpu" or "cuda:N".
        height, width: Cells, 2 H and 2 W.
    """

    def __init__(self, mesh: LightmappedMesh, device: str) -> None:
        self.mesh, self.device = mesh, device
        self.height, self.width = (2 * count for count in mesh.mask.shape)

    @cached_property
    def triangle(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The triangle that holds each cell's centre, and the weights of its corners, as `texel_triangles`."""
        return texel_triangles(self.mesh, self.height, self.width, self.device)

    @cached_property
    def covered(self) -> np.ndarray:
        """bool [2 H, 2 W], whether a triangle holds the centre, exactly."""
        mesh = self.mesh
        return covered_texels(mesh.uv, mesh.triangle[mesh.active], self.height, self.width) > 0

    @cached_property
    def border(self) -> np.ndarray:
        """bool [2 H, 2 W], within a texel of a chart's border."""
        triangle = self.triangle[0].cpu().numpy()
        chart = np.where(triangle < 0, -1, mesh_charts(self.mesh)[triangle])
        window = 2 * _BORDER + 1
        return maximum_filter(chart, window) != minimum_filter(chart, window)

    @cached_property
    def texels(self) -> np.ndarray:
        """bool [2 H, 2 W], the quarters of the texels of the mask whose own centres a triangle holds."""
        mesh = self.mesh
        inside = covered_texels(mesh.uv, mesh.triangle[mesh.active], *mesh.mask.shape) > 0
        return np.repeat(np.repeat(inside & mesh.mask, 2, 0), 2, 1)

    @cached_property
    def relative(self) -> np.ndarray:
        """float64 [2 H, 2 W], what a squared error of linear light counts as one of relative light, up to a factor."""
        light = self.mesh.filled.mean(2, dtype=np.float64)
        dark = _DARK * float(np.percentile(light[self.mesh.mask], _BRIGHT))
        weight = 1.0 / np.square(light + (dark or 1.0))
        return np.repeat(np.repeat(weight, 2, 0), 2, 1)


def weights(grid: FineGrid, profile: Profile, seed: int) -> np.ndarray:
    """How much each cell counts: the pixels that show it in random views, and a little for those that none shows.

    Returns:
        float64 [2 H, 2 W], 0 where there is no triangle; at least one is above 0.
    """
    mesh, height, width = grid.mesh, grid.height, grid.width
    if not profile.views:
        visible = _areas(mesh, height, width, seed)
    else:
        visible = _seen(grid, profile.views, seed)
    return spread(grid, visible, profile)


def spread(grid: FineGrid, visible: np.ndarray, profile: Profile, mean: float | None = None) -> np.ndarray:
    """Weights by counts of pixels: those, a little where there are none, and more at borders of charts.

    Args:
        grid: The grid.
        visible: [2 H, 2 W], pixels that show each cell.
        profile: `unseen` and `border`.
        mean: Of the pixels of a cell, of which what isn't seen has a fraction; None: this lightmap's.

    Returns:
        As `weights`.
    """
    # A texel is read at its centre too, of which a small triangle may hold no quarter's.
    used = grid.covered | grid.texels | (visible > 0)
    if not used.any():  # the mesh is smaller than a cell, and no pixel shows it
        used = np.repeat(np.repeat(grid.mesh.mask, 2, 0), 2, 1)
    if mean is None:
        mean = visible[used].mean() or 1.0
    result = np.where(used, visible + profile.unseen * mean, 0.0)
    result = np.where(grid.border, profile.border * result, result)
    if profile.relative:
        share = profile.relative * result.sum() / (result * grid.relative).sum()
        result = result * (1.0 - profile.relative + share * grid.relative)
    return result


def _seen(grid: FineGrid, count: int, seed: int) -> np.ndarray:
    """Pixels of random views that show each cell, float64 [2 H, 2 W]; views from inside count as much as the others."""
    views = mesh_views(grid.mesh, count, seed)
    around, inside = (
        visibility(grid.mesh, each, _RESOLUTION, grid.height, grid.width, grid.device)
        for each in (views[:count], views[count:])
    )
    if around.any() and inside.any():
        inside *= around.sum() / inside.sum()
    return around + inside


def _areas(mesh: LightmappedMesh, height: int, width: int, seed: int) -> np.ndarray:
    """How many random points of the mesh's surface lie in each cell of UV space, int64 [height, width]."""
    random = np.random.default_rng(seed)
    count = np.zeros(height * width, np.int64)
    total = _POINTS * height * width
    for first in range(0, total, _POINTS_AT_ONCE):
        points = min(_POINTS_AT_ONCE, total - first)
        triangle, weight = surface_points(mesh, points, random)
        uv = np.einsum("nk,nkc->nc", weight, mesh.uv[mesh.triangle[triangle]])
        column, row = ((uv[:, i] * n).astype(np.int64).clip(0, n - 1) for i, n in enumerate((width, height)))
        count += np.bincount(row * width + column, minlength=height * width)
    return count.reshape(height, width)
