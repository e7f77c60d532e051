"""The most that copies between the objects of a scene could gain.

A tile could be stored as another object's tile with a gain and an offset. Here each tile of a lightmap is matched with
all tiles of the other objects in the same lighting state, in eight orientations, by a gain and an offset for each
channel. The best match is offered to the allocation of sizes as one more size, of `BITS` bits. The gain is the
reduction of the weighted squared error in equal bits, in dB. It is an upper bound: matched tiles are the original ones,
their numbers take no bits, and they may be copies themselves.
"""

from collections.abc import Sequence

import numpy as np
import torch

from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import LUT_BITS, SOURCE_BITS, Profile, tile_counts
from wlm.atlas.stages import Stages
from wlm.atlas.tiles.fit import Tiles, curves, cut
from wlm.atlas.tiles.layout import allocate, sizes_of

BITS = 48
"""Bits of a gain and an offset for each of three channels, 8 each."""


def affine_gain(
    scene: LightmappedScene, weights: Sequence[np.ndarray], share: float, device: str = "cpu"
) -> tuple[float, float]:
    """Returns the upper bound of the gain in dB, and the share of tiles that become copies.

    Args:
        scene: The scene.
        weights: Weights of the quarters of all texels, [2 H, 2 W] for each sheet.
        share: Bits of the lightmaps as a share of the uncompressed ones.
        device: "cpu" or "cuda:N".
    """
    profile = Profile.load("standard")
    sizes = sizes_of(profile)
    cost = np.array([size.bits for size in sizes] + [BITS], np.float64)
    error, room = [], 0.0
    for state in range(len(scene.states)):
        pieces = [
            cut(sheet.lightmaps[state], weight, profile.tile, device)
            for sheet, weight in zip(scene.sheets, weights, strict=True)
        ]
        together = (torch.cat([getattr(each, name) for each in pieces]) for name in ("index", "light", "weight"))
        tiles = Tiles(*together, profile.tile)
        owner = torch.repeat_interleave(torch.tensor([len(each.index) for each in pieces], device=device))
        error.append(torch.cat([curves(tiles, sizes, Stages(device)), _copied(tiles, owner)[None]]).cpu().numpy())
        for sheet in scene.sheets:
            room += (
                share * sheet.mask.size * SOURCE_BITS - np.prod(tile_counts(*sheet.mask.shape, profile.tile)) * LUT_BITS
            )
    whole = np.concatenate(error, 1)
    chosen = allocate(whole, cost, room, 0.0)
    plain = allocate(whole[:-1], cost[:-1], room, 0.0)
    before, after = (whole[each, np.arange(len(each))].sum() for each in (plain, chosen))
    return float(10.0 * np.log10(before / after)), float((chosen == len(sizes)).mean())


def _copied(tiles: Tiles, owner: torch.Tensor) -> torch.Tensor:
    """Returns the weighted squared error of each tile as gain and offset of another object's, float64 [T]."""
    side = 2 * tiles.size
    light = tiles.light.double()
    centred = light - light.mean(2, keepdim=True)
    unit = centred / centred.norm(dim=2, keepdim=True).clamp(min=1e-12)
    score = light.new_full((len(light),), -1.0)
    match = torch.zeros_like(light)
    square = unit.unflatten(2, (side, side))
    for turn in range(8):
        turned = torch.rot90(square.mT if turn > 3 else square, turn % 4, (2, 3)).flatten(2)
        fit = sum((centred[:, c] @ turned[:, c].T).square() for c in range(3))
        fit[owner[:, None] == owner[None]] = -1.0
        best, number = fit.max(1)
        better = best > score
        score[better], match[better] = best[better], turned[number[better]]
    weight = tiles.weight.double()[:, None]
    total = weight.sum(2, keepdim=True).clamp(min=1e-300)
    x, y = (each - (weight * each).sum(2, keepdim=True) / total for each in (light, match))
    gain = (weight * x * y).sum(2, keepdim=True) / (weight * y * y).sum(2, keepdim=True).clamp(min=1e-300)
    return (weight * (x - gain * y).square()).sum(2).mean(1)
