"""Weights tiles by the error of the views that show them.

A mean of PSNRs is highest where sum_v log E_v is least, with E_v the mean squared error of view v. Its bound
sum_v E_v / E'_v, where E'_v is the error under the last allocation, has the same slope there and is a sum over tiles.
So each allocation gives the weights of the next one, and the sum of logarithms falls (majorisation-minimisation, Hunter
and Lange 2004). A tile's errors are all proportional to its weight, so they are computed only once.

The mean of logarithms also decides whether states have separate tiles.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array, hstack

from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import Profile
from wlm.atlas.shared.curves import Candidate, SceneTiles, costs
from wlm.atlas.shared.weights import FLOOR, UNSEEN, Detail
from wlm.atlas.tiles.layout import allocate
from wlm.atlas.views import points_at, scene_views, visible_uv
from wlm.atlas.weights import RESOLUTION

_ROUNDS = 4


@dataclass(frozen=True)
class ViewShares:
    """The tiles that V views show. `share`, float64 [V, T], is the fraction of a view's pixels that shows each tile, 0
    for tiles of smaller mip levels; `lost`, float64 [V], is each view's error that was assumed in the first weights."""

    share: csr_array
    lost: np.ndarray

    def by_state(self, states: int) -> "ViewShares":
        """Returns the shares for separate tiles in each state, divided by the number of states: a view's error is their
        mean."""
        return replace(self, share=hstack([self.share] * states, "csr") / states)

    def psnr(self, error: np.ndarray) -> float:
        """Returns the mean PSNR of the views in dB, for peak 1; `error` [T] is each tile's error divided by its
        weight."""
        if not len(self.lost):
            return -10.0 * math.log10(float(error.mean()) + FLOOR)
        return float(-10.0 * np.log10(self.share @ error + FLOOR).mean())


def tile_shares(
    scene: LightmappedScene,
    varies: Sequence[np.ndarray],
    tiles: SceneTiles,
    grids: Sequence[tuple[int, int]],
    profile: Profile,
    seed: int,
    device: str,
) -> ViewShares:
    """Renders random views (those of the first weights); returns the fraction of each view's pixels that shows each
    tile, and each view's assumed error. `grids` has the rows and columns of tiles of each sheet."""
    first = np.cumsum([0, *(rows * columns for rows, columns in grids)])
    row = np.full(first[-1], -1)
    of = np.flatnonzero(tiles.plane < len(scene.sheets))
    row[first[tiles.plane[of]] + tiles.index[of]] = of
    detail = Detail(scene, varies, device)
    place = torch.tensor(np.array([(*grid, start) for grid, start in zip(grids, first, strict=False)]), device=device)
    number, rows, at, share, lost = torch.from_numpy(row).to(device), [], [], [], []
    views = scene_views(scene, profile.views, seed)
    for drawn in visible_uv(scene, views, RESOLUTION, device):
        points = points_at(scene, *drawn)[1]
        if not len(points):
            continue
        height, width = detail.sizes(points)
        down, across, start = place[points.sheet.long()].T
        x, y = (
            ((points.uv[:, axis] * side - 0.5).clamp(min=0.0) / tiles.size).long().minimum(count - 1)
            for axis, side, count in ((0, width, across), (1, height, down))
        )
        found, pixels = torch.unique(number[start + y * across + x], return_counts=True)
        found, pixels = found.cpu().numpy(), pixels.cpu().numpy()
        rows.append(np.full(len(found), len(lost))[found >= 0])
        at.append(found[found >= 0])
        share.append(pixels[found >= 0] / len(points))
        lost.append(detail.lost(points))
    shape = len(lost), len(tiles.index)
    if not lost:
        return ViewShares(csr_array(shape), np.zeros(0))
    parts = np.concatenate(share), (np.concatenate(rows), np.concatenate(at))
    return ViewShares(csr_array(parts, shape=shape), np.array(lost))


def balance(tried: list[Candidate], weight: np.ndarray, shown: ViewShares, bits: float) -> np.ndarray:
    """Returns factors for the tiles' weights, float64 [T], that favour tiles in views with little error; the sum of all
    weights is unchanged. `bits` is the budget of all tiles."""
    error, cost, tiles = np.concatenate([each.error for each in tried]), costs(tried), np.arange(len(weight))
    visible = np.asarray(shown.share.sum(0)).ravel() > 0
    if not visible.any():
        return np.ones(len(weight))

    def counts(lost: np.ndarray) -> np.ndarray:
        result = shown.share.T @ (1.0 / lost)
        return result + UNSEEN * float(result[visible].mean())

    before, factor = counts(shown.lost), np.ones(len(weight))
    for _ in range(_ROUNDS):
        chosen = allocate(error * factor, cost, bits, 0.0)
        factor = counts(shown.share @ (error[chosen, tiles] / weight) + FLOOR) / before
        factor *= float(weight.sum()) / float((factor * weight).sum())
    return factor
