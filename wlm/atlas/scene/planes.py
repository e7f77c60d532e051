"""What is cut into tiles: the sheets of a scene and, with mips, their smaller levels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from wlm.atlas.model import TAIL_OCTAVES
from wlm.atlas.resize import box
from wlm.atlas.scene.data import LightmappedScene
from wlm.texels import fill_gaps


@dataclass(frozen=True, eq=False)
class Plane:
    """A sheet, or a level of one.

    Attributes:
        name: The sheet's.
        frames: float32 [M, H, W, 3], without gaps.
        weight: float64 [2 H, 2 W], of each quarter of a texel.
        smaller: The number of the next smaller level; 0: there is none.
    """

    name: str
    frames: np.ndarray
    weight: np.ndarray
    smaller: int = 0


def planes_of(scene: LightmappedScene, weights: Sequence[np.ndarray], mips: bool, device: str) -> list[Plane]:
    """The sheets and then, with mips, their levels: of each a quarter of its sides, rounded up, and halves of that.

    A level's texel is the mean of the texels of charts that it covers, and counts as much as one of them.

    Args:
        scene: The scene.
        weights: `scene_weights`.
        mips: Whether there are levels.
        device: "cpu" or "cuda:N".
    """
    pairs = zip(scene.sheets, weights, strict=True)
    planes = [Plane(sheet.name, sheet.frames, weight) for sheet, weight in pairs]
    if not mips:
        return planes
    for number, sheet in enumerate(scene.sheets):
        before = number
        for level in _levels(planes[number], sheet.mesh.mask, device):
            planes[before] = replace(planes[before], smaller=len(planes))
            before = len(planes)
            planes.append(level)
    return planes


def _levels(plane: Plane, mask: np.ndarray, device: str) -> list[Plane]:
    states, height, width, _ = plane.frames.shape
    share = torch.from_numpy(mask).double()[..., None]
    light = torch.from_numpy(plane.frames).permute(1, 2, 0, 3).flatten(2).double()
    sums = torch.cat([light * share, share], 2).to(device)
    weight = torch.from_numpy(plane.weight).double()[..., None].to(device)
    levels, side = [], (-(-height >> TAIL_OCTAVES), -(-width >> TAIL_OCTAVES))
    while True:
        sums, weight = box(sums, *side), box(weight, *(2 * each for each in side))
        values = sums.cpu().numpy()
        inside = values[..., -1] > 1e-9
        filled = fill_gaps(values[..., :-1] / np.maximum(values[..., -1:], 1e-9), inside)
        frames = filled.reshape(*side, states, 3).transpose(2, 0, 1, 3).astype(np.float32)
        levels.append(Plane(plane.name, np.ascontiguousarray(frames), weight[..., 0].cpu().numpy()))
        if max(side) == 1:
            return levels
        side = tuple(max(each >> 1, 1) for each in side)
