"""How much tiles count, by what the views that show them lose.

A mean of PSNRs is least where sum_v log E_v is, with E_v the mean squared error of view v. Its bound
sum_v E_v / E'_v, with E'_v of the last allocation, has the same slope there and is a sum over tiles again: so each
allocation gives the next one's weights, and the sum of logarithms falls (majorisation-minimisation, Hunter and Lange
2004). A tile's errors are all in proportion to its weight, so they are solved for once.

That mean of logarithms also says whether states are better kept apart.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array, hstack

from wlm.atlas.layout import allocate
from wlm.atlas.scene.curves import SceneTiles, Tried, costs
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.detail import FLOOR
from wlm.atlas.scene.model import SceneProfile
from wlm.atlas.scene.seen import RESOLUTION, Detail, scene_views, seen_points

_ROUNDS = 4


@dataclass(frozen=True)
class Seen:
    """What views show of tiles.

    Attributes:
        share: float64 [V, T], of each view's pixels those that show each tile; none shows tiles of smaller levels.
        lost: float64 [V], what the views were taken to lose in the weights of the tiles.
    """

    share: csr_array
    lost: np.ndarray

    def by_state(self, states: int) -> "Seen":
        """The same of tiles of each state, one state after the other: a view loses the mean of its states' errors."""
        return replace(self, share=hstack([self.share] * states, "csr") / states)

    def psnr(self, error: np.ndarray) -> float:
        """dB, mean over the views, of errors of tiles over their weights [T]; the peak is 1."""
        if not len(self.lost):
            return -10.0 * math.log10(float(error.mean()) + FLOOR)
        return float(-10.0 * np.log10(self.share @ error + FLOOR).mean())


def tiles_seen(
    scene: LightmappedScene,
    varies: Sequence[np.ndarray],
    tiles: SceneTiles,
    grids: Sequence[tuple[int, int]],
    profile: SceneProfile,
    seed: int,
    device: str,
) -> Seen:
    """Draws the views of `scene_weights` once more.

    Args:
        scene, varies, profile, seed, device: As of `scene_weights`.
        tiles: The scene's tiles.
        grids: Rows and columns of tiles of each sheet.
    """
    first = np.cumsum([0, *(rows * columns for rows, columns in grids)])
    row = np.full(first[-1], -1)
    of = np.flatnonzero(tiles.plane < len(scene.sheets))
    row[first[tiles.plane[of]] + tiles.index[of]] = of
    detail = Detail(scene, varies, device)
    place = torch.tensor(np.array([(*grid, start) for grid, start in zip(grids, first, strict=False)]), device=device)
    number, rows, at, share, lost = torch.from_numpy(row).to(device), [], [], [], []
    views = scene_views(scene, profile.views, seed)
    for _, sheet, uv in seen_points(scene, views, RESOLUTION, device):
        if not len(sheet):
            continue
        height, width = detail.sizes(sheet)
        down, across, start = place[sheet.long()].T
        x, y = (
            ((uv[:, axis] * side - 0.5).clamp(min=0.0) / tiles.size).long().minimum(count - 1)
            for axis, side, count in ((0, width, across), (1, height, down))
        )
        found, pixels = torch.unique(number[start + y * across + x], return_counts=True)
        found, pixels = found.cpu().numpy(), pixels.cpu().numpy()
        rows.append(np.full(len(found), len(lost))[found >= 0])
        at.append(found[found >= 0])
        share.append(pixels[found >= 0] / len(sheet))
        lost.append(detail.lost(sheet, uv))
    shape = len(lost), len(tiles.index)
    if not lost:
        return Seen(csr_array(shape), np.zeros(0))
    parts = np.concatenate(share), (np.concatenate(rows), np.concatenate(at))
    return Seen(csr_array(parts, shape=shape), np.array(lost))


def balance(tried: list[Tried], weight: np.ndarray, seen: Seen, profile: SceneProfile, bits: float) -> np.ndarray:
    """What the tiles' weights are to be multiplied by, float64 [T]; the sum of all weights stays.

    Args:
        tried: The tiles with each number of components.
        weight: float64 [T], of the tiles in `tried`.
        seen: `tiles_seen`.
        profile: `unseen`.
        bits: Of all tiles.
    """
    error, cost, tiles = np.concatenate([each.error for each in tried]), costs(tried), np.arange(len(weight))
    shown = np.asarray(seen.share.sum(0)).ravel() > 0
    if not shown.any():
        return np.ones(len(weight))

    def counts(lost: np.ndarray) -> np.ndarray:
        result = seen.share.T @ (1.0 / lost)
        return result + profile.unseen * float(result[shown].mean())

    before, factor = counts(seen.lost), np.ones(len(weight))
    for _ in range(_ROUNDS):
        chosen = allocate(error * factor, cost, bits, 0.0)
        factor = counts(seen.share @ (error[chosen, tiles] / weight) + FLOOR) / before
        factor *= float(weight.sum()) / float((factor * weight).sum())
    return factor
