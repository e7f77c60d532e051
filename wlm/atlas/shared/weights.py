"""Computes the weights of errors in a scene's sheets and states.

A place in a sheet (UV layout) weighs more if more pixels show it in views of the whole scene. Quality is the mean PSNR
of views and states, a mean of logarithms, so an error counts by its share of the whole error of its view or state. At
equal bits the whole error is proportional to how much light varies from texel to texel, so views and states are
weighted by the inverse of the variation of their light.
"""

from collections.abc import Sequence

import numpy as np
import torch

from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import Profile
from wlm.atlas.views import Points, cells_at, points_at, scene_views, visible_uv
from wlm.atlas.weights import RESOLUTION, FineGrid, spread

UNSEEN, BORDER = 0.05, 4.0
"""Weight of texels that no view shows, as a fraction of the mean weight of the scene; and the factor on the weight
within a texel of a chart's border."""

FLOOR = 1e-8
"""The squared error, over the squared peak, that is assumed where no light varies."""

_PERCENTILE = 99.9  # percentile of a state's light that is its peak


def peaks_of(scene: LightmappedScene) -> np.ndarray:
    """Returns a high percentile of each state's light in charts, float64 [M], above 0."""
    light = [sheet.lightmaps[:, sheet.mask].max(axis=2) for sheet in scene.sheets]
    peak = np.percentile(np.concatenate(light, axis=1), _PERCENTILE, axis=1)
    # A black state is stored exactly whatever its peak is.
    return np.where(peak > 0, peak, float(peak.max()) or 1.0).astype(np.float64)


def variation(scene: LightmappedScene, peak: np.ndarray, device: str) -> list[np.ndarray]:
    """Returns for each sheet how much light varies, float32 [M, H, W]: the squared second differences along both axes
    within charts, averaged over the channels. Light is first divided by `peak`, float64 [M]."""
    result = []
    for sheet in scene.sheets:
        mask = torch.from_numpy(sheet.mask).to(device)
        frames = (torch.from_numpy(frame).to(device) / float(p) for frame, p in zip(sheet.lightmaps, peak, strict=True))
        result.append(np.stack([_variation(frame, mask).cpu().numpy() for frame in frames]))
    return result


def _variation(light: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    result = torch.zeros(mask.shape, device=light.device)
    for values, inside, out in ((light, mask, result), (light.transpose(0, 1), mask.T, result.T)):
        bend = (values[:-2] - 2.0 * values[1:-1] + values[2:]).square().mean(2)
        out[1:-1] += bend * (inside[:-2] & inside[1:-1] & inside[2:])
    return result


def scales(varies: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> np.ndarray:
    """Returns divisors of the M states' light, float64 [M] with geometric mean 1, that make all states vary equally;
    from `variation` and the weights [H, W] of each sheet's texels."""
    sums = sum((each * weight).sum((1, 2), dtype=np.float64) for each, weight in zip(varies, weights, strict=True))
    total = sum(float(weight.sum()) for weight in weights)
    root = np.sqrt(sums / max(total, 1e-30) + FLOOR)
    return root / np.exp(np.log(root).mean())


def scene_weights(
    scene: LightmappedScene, varies: Sequence[np.ndarray], profile: Profile, seed: int, device: str
) -> list[np.ndarray]:
    """Returns for each sheet the weights of quarters of texels, float64 [2 H, 2 W]: how many pixels of random views of
    the scene show each, 0 where there is no triangle. An object that is large in the views thus gets more weight than
    one that is small, far away or hidden. The weight of a view is the inverse of the variation of the light that it
    shows; it does not grow with its number of pixels."""
    grids, detail = [FineGrid(sheet, device) for sheet in scene.sheets], Detail(scene, varies, device)
    sizes = [grid.height * grid.width for grid in grids]
    counts = torch.zeros(sum(sizes), dtype=torch.float64, device=device)
    for drawn in visible_uv(scene, scene_views(scene, profile.views, seed), RESOLUTION, device):
        points = points_at(scene, *drawn)[1]
        if len(points):
            cell, pixels = torch.unique(detail.cells(points, 2), return_counts=True)
            counts[cell] += pixels / (detail.lost(points) * len(points))
    visible = [each.reshape(grid.height, grid.width) for each, grid in zip(counts.split(sizes), grids, strict=True)]
    # The cells that `spread` uses.
    used = [grid.covered | grid.texels | (count > 0) for grid, count in zip(grids, visible, strict=True)]
    cells = sum(int(each.sum()) for each in used)
    mean = sum(float(count[each].sum()) for count, each in zip(visible, used, strict=True)) / max(cells, 1)
    pairs = zip(grids, visible, strict=True)
    return [spread(grid, count, UNSEEN, BORDER, mean=mean or 1.0).cpu().numpy() for grid, count in pairs]


class Detail:
    """How much a scene's light varies at each texel of its sheets, mean over states scaled to vary equally."""

    def __init__(self, scene: LightmappedScene, varies: Sequence[np.ndarray], device: str) -> None:
        masks = [sheet.mask for sheet in scene.sheets]
        scale = scales(varies, masks)
        even = [np.tensordot(1.0 / scale**2, each, 1).ravel() / len(scale) for each in varies]
        first = np.cumsum([0, *(mask.size for mask in masks)])
        place = np.array([(*mask.shape, start) for mask, start in zip(masks, first, strict=False)])
        self._even, self._place = torch.from_numpy(np.concatenate(even)).to(device), torch.from_numpy(place).to(device)

    def sizes(self, points: Points) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the rows and columns of texels of the sheet at each point, int64 [N] each."""
        return tuple(self._place[points.sheet.long()].T[:2])

    def cells(self, points: Points, fine: int = 1) -> torch.Tensor:
        """Returns the numbers of the cells at N points, int64 [N], sheet by sheet; a texel has `fine` cells per
        axis."""
        start = self._place[points.sheet.long(), 2]
        return fine**2 * start + cells_at(points.uv, *(fine * side for side in self.sizes(points)))

    def lost(self, points: Points) -> float:
        """Estimates the error of a view that shows the points, above 0: the mean variation of light over the states,
        which are scaled to vary equally."""
        return float(self._even[self.cells(points)].mean()) + FLOOR
