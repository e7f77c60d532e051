"""Weights of a lightmap's error: how much each part of it counts, by visibility and by nearness to a seam."""

from functools import cached_property

import numpy as np
import torch
from torch.nn.functional import max_pool2d

from wlm.atlas.coverage import covered_on
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
_SAMPLES = 1 << 22  # texels that this is found of


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
    def covered(self) -> torch.Tensor:
        """bool [2 H, 2 W], whether a triangle holds the centre, exactly."""
        mesh = self.mesh
        return covered_on(mesh.uv, mesh.triangle[mesh.active], self.height, self.width, self.device) > 0

    @cached_property
    def border(self) -> torch.Tensor:
        """bool [2 H, 2 W], within a texel of a chart's border."""
        triangle = self.triangle[0]
        chart = torch.from_numpy(mesh_charts(self.mesh)).to(self.device)
        chart = torch.where(triangle < 0, -1, chart[triangle.clamp(min=0)])
        # Numbers of charts are whole in float32 up to 2 ** 24.
        return _largest(chart.float()) != -_largest(-chart.float())

    @cached_property
    def texels(self) -> torch.Tensor:
        """bool [2 H, 2 W], the quarters of the texels of the mask whose own centres a triangle holds."""
        mesh = self.mesh
        inside = covered_on(mesh.uv, mesh.triangle[mesh.active], *mesh.mask.shape, self.device) > 0
        return _quarters(inside & torch.from_numpy(mesh.mask).to(self.device))

    @cached_property
    def relative(self) -> torch.Tensor:
        """float64 [2 H, 2 W], what a squared error of linear light counts as one of relative light, up to a factor."""
        mesh = self.mesh
        light = torch.from_numpy(mesh.filled).to(self.device).mean(2, dtype=torch.float64)
        bright = light[torch.from_numpy(mesh.mask).to(self.device)]
        dark = _DARK * float(np.percentile(bright[:: max(1, len(bright) // _SAMPLES)].cpu().numpy(), _BRIGHT))
        return _quarters(1.0 / (light + (dark or 1.0)).square())


def _quarters(texels: torch.Tensor) -> torch.Tensor:
    """Each texel as four cells."""
    return texels.repeat_interleave(2, 0).repeat_interleave(2, 1)


def _largest(values: torch.Tensor) -> torch.Tensor:
    """The largest value within a texel of each cell."""
    window = 2 * _BORDER + 1
    across = max_pool2d(values[None, None], (1, window), 1, (0, _BORDER))
    return max_pool2d(across, (window, 1), 1, (_BORDER, 0))[0, 0]


def weights(grid: FineGrid, profile: Profile, seed: int) -> torch.Tensor:
    """How much each cell counts: the pixels that show it in random views, and a little for those that none shows.

    Returns:
        float64 [2 H, 2 W] on the grid's device, 0 where there is no triangle; at least one is above 0.
    """
    mesh, height, width = grid.mesh, grid.height, grid.width
    if not profile.views:
        visible = torch.from_numpy(_areas(mesh, height, width, seed)).double().to(grid.device)
    else:
        visible = _seen(grid, profile.views, seed)
    return spread(grid, visible, profile)


def spread(grid: FineGrid, visible: torch.Tensor, profile: Profile, mean: float | None = None) -> torch.Tensor:
    """Weights by counts of pixels: those, a little where there are none, and more at borders of charts.

    Args:
        grid: The grid.
        visible: float64 [2 H, 2 W] on its device, pixels that show each cell.
        profile: `unseen` and `border`.
        mean: Of the pixels of a cell, of which what isn't seen has a fraction; None: this lightmap's.

    Returns:
        As `weights`.
    """
    # A texel is read at its centre too, of which a small triangle may hold no quarter's.
    used = grid.covered | grid.texels | (visible > 0)
    if not used.any():  # the mesh is smaller than a cell, and no pixel shows it
        used = _quarters(torch.from_numpy(grid.mesh.mask).to(grid.device))
    if mean is None:
        mean = float(visible[used].mean()) or 1.0
    result = torch.where(used, visible + profile.unseen * mean, 0.0)
    result = torch.where(grid.border, profile.border * result, result)
    if profile.relative:
        share = profile.relative * result.sum() / (result * grid.relative).sum()
        result = result * (1.0 - profile.relative + share * grid.relative)
    return result


def _seen(grid: FineGrid, count: int, seed: int) -> torch.Tensor:
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
