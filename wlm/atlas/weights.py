"""Computes the weight of a lightmap's error at each place, from visibility and distance to a seam."""

from functools import cached_property

import numpy as np
import torch
from torch.nn.functional import max_pool2d

from wlm.atlas.coverage import covered_texels
from wlm.atlas.data import LightmappedScene, Sheet
from wlm.atlas.model import Profile
from wlm.atlas.views import scene_views, sheet_charts, texel_triangles, visibility

RESOLUTION = 768
"""Pixels along a side of the views in which visibility is counted."""

_BORDER = 2  # cells of the fine grid: one texel
# The relative error is the error over the light plus this share of the 99th percentile of the texels: darker light is
# black on a screen that shows the brighter.
_DARK, _BRIGHT = 0.05, 99.0
_SAMPLES = 1 << 22  # texels from which the percentile is estimated


class FineGrid:
    """A grid over a sheet whose cells are quarters of texels, and properties of the cells, computed when first used."""

    def __init__(self, sheet: Sheet, device: str) -> None:
        self.sheet, self.device = sheet, device
        self.height, self.width = (2 * count for count in sheet.mask.shape)

    @cached_property
    def light(self) -> torch.Tensor:
        """The sheet's lightmap on the device, float32 [H, W, 3]; copying a large one takes a while."""
        return torch.from_numpy(self.sheet.lightmap).to(self.device)

    @cached_property
    def mask(self) -> torch.Tensor:
        """The sheet's mask on the device, bool [H, W]."""
        return torch.from_numpy(self.sheet.mask).to(self.device)

    @cached_property
    def triangle(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The triangle at each cell's centre, and the barycentric weights of its corners, as in `texel_triangles`."""
        return texel_triangles(self.sheet, self.height, self.width, self.device)

    @cached_property
    def covered(self) -> torch.Tensor:
        """Whether a triangle contains the cell's centre, computed exactly: bool [2 H, 2 W]."""
        return self._covered(self.height, self.width)

    @cached_property
    def border(self) -> torch.Tensor:
        """Whether a chart's border is within a texel of the cell: bool [2 H, 2 W]."""
        triangle = self.triangle[0]
        chart = torch.from_numpy(sheet_charts(self.sheet)).to(self.device)
        chart = torch.where(triangle < 0, -1, chart[triangle.clamp(min=0)])
        # Numbers of charts are whole in float32 up to 2 ** 24.
        return _largest(chart.float()) != -_largest(-chart.float())

    @cached_property
    def texels(self) -> torch.Tensor:
        """Whether a cell is part of a mask texel whose centre is in a triangle: bool [2 H, 2 W]."""
        return _quarters(self._covered(*self.mask.shape) & self.mask)

    @cached_property
    def relative(self) -> torch.Tensor:
        """The factor from squared error to squared relative error of light, up to a constant: float64 [2 H, 2 W]."""
        light = self.light.mean(2, dtype=torch.float64)
        bright = light[self.mask]
        dark = _DARK * float(np.percentile(bright[:: max(1, len(bright) // _SAMPLES)].cpu().numpy(), _BRIGHT))
        return _quarters(1.0 / (light + (dark or 1.0)).square())

    def _covered(self, height: int, width: int) -> torch.Tensor:
        triangle = self.sheet.triangle[self.sheet.active]
        return covered_texels(self.sheet.uv, triangle, height, width, self.device) > 0


def _quarters(texels: torch.Tensor) -> torch.Tensor:
    return texels.repeat_interleave(2, 0).repeat_interleave(2, 1)


def _largest(values: torch.Tensor) -> torch.Tensor:
    window = 2 * _BORDER + 1
    across = max_pool2d(values[None, None], (1, window), 1, (0, _BORDER))
    return max_pool2d(across, (window, 1), 1, (_BORDER, 0))[0, 0]


def weights(scene: LightmappedScene, grid: FineGrid, profile: Profile, seed: int) -> torch.Tensor:
    """Returns the weight of each cell of a scene's only sheet, float64 [2 H, 2 W] on the grid's device: computed by
    `spread` from the number of pixels that show it in random views. Views from inside count as much as views from
    around the scene. At least one weight is above 0."""
    count, shape = profile.views, (grid.height, grid.width, grid.device)
    views = scene_views(scene, count, seed)
    around, inside = (visibility(scene, each, RESOLUTION, *shape) for each in (views[:count], views[count:]))
    if around.any() and inside.any():
        inside *= around.sum() / inside.sum()
    return spread(grid, around + inside, profile.unseen, profile.border, profile.relative)


def spread(
    grid: FineGrid,
    visible: torch.Tensor,
    unseen: float,
    border: float,
    relative: float = 0.0,
    mean: float | None = None,
) -> torch.Tensor:
    """Turns pixel counts of cells (quarters of texels), float64 [2 H, 2 W], into weights. The weight `unseen` times the
    mean is added in every cell, weights near a chart's border are multiplied by `border`, and `relative` is the share
    that counts relative errors. `mean` is the mean count of a cell; None: computed from this sheet."""
    # A texel is also read at its centre, and a small triangle may contain that centre but no quarter's.
    used = grid.covered | grid.texels | (visible > 0)
    if not used.any():  # the mesh is smaller than a cell, and no pixel shows it
        used = _quarters(grid.mask)
    if mean is None:
        mean = float(visible[used].mean()) or 1.0
    result = torch.where(used, visible + unseen * mean, 0.0)
    result = torch.where(grid.border, border * result, result)
    if relative:
        share = relative * result.sum() / (result * grid.relative).sum()
        result = result * (1.0 - relative + share * grid.relative)
    return result
