"""Decides whether tiles are shared by the states, as sums of components, or separate for each state.

Lightmaps of several hours have much in common, which components store once. A shadow mask and the light of a sky have
little in common, and shared tiles would store one at the resolution that the other needs. So tiles of both kinds are
allocated with the same number of bits, and the kind with the smaller mean logarithm of the views' errors is kept.

Separate tiles are as many times more as there are states, so a random sample of them first decides whether computing
all their rate-distortion curves is worthwhile.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import (
    COLOUR_BITS,
    ENTRY,
    FACTOR_BITS,
    LUT_BITS,
    MIP_OCTAVES,
    SHEET_BITS,
    SHORT_ENTRY,
    SOURCE_BITS,
    TEXELS,
    Profile,
    SheetPlace,
    tile_counts,
)
from wlm.atlas.resize import box
from wlm.atlas.shared.allocation import NO_ROOM, Allocated, allocated
from wlm.atlas.shared.balance import ViewShares, balance, tile_shares
from wlm.atlas.shared.curves import Candidate, SceneTiles, candidates, costs
from wlm.atlas.stages import Stages
from wlm.atlas.tiles.fit import patches, weighted
from wlm.atlas.tiles.layout import allocate, packed, sizes_of
from wlm.errors import WlmError
from wlm.texels import fill_gaps

_SAMPLES, _SAMPLE = 1024, 8  # up to this many tiles all are tried separately; beyond it one in eight is sampled
_SAMPLED, _SEPARATE = 100, 200  # batch numbers in the checkpoint for sampled and for separate tiles
_HOPELESS = 1.25  # ratio of sampled separate to shared error above which the rest isn't tried


@dataclass(frozen=True, eq=False)
class Plane:
    """A sheet (UV layout), or a mip level of one, to be cut into tiles. `frames`, float32 [M, H, W, 3], are its
    lightmaps without gaps; `weight`, float64 [2 H, 2 W], the weights of quarters of texels; `smaller` the index of the
    next smaller level, 0 for none."""

    name: str
    frames: np.ndarray
    weight: np.ndarray
    smaller: int = 0


def planes_of(scene: LightmappedScene, weights: Sequence[np.ndarray], mips: bool, device: str) -> list[Plane]:
    """Returns all sheets and then, if `mips`, their mip levels. The first level's sides are a quarter of the sheet's,
    rounded up; each next level's are half as long. A level's texel has the mean light of the chart texels that it
    covers, and the mean of their weights from `scene_weights`."""
    pairs = zip(scene.sheets, weights, strict=True)
    planes = [Plane(sheet.name, sheet.lightmaps, weight) for sheet, weight in pairs]
    if not mips:
        return planes
    for number, sheet in enumerate(scene.sheets):
        before = number
        for level in _levels(planes[number], sheet.mask, device):
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
    levels, side = [], (-(-height >> MIP_OCTAVES), -(-width >> MIP_OCTAVES))
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


@dataclass(frozen=True, eq=False)
class Cut:
    """Sheets and mip levels (`planes_of`), cut into tiles, with the place of each in the lookup texture T_c; rows and
    columns of T_c; and the budget of bits of the whole model."""

    planes: list[Plane]
    places: list[SheetPlace]
    shape: tuple[int, int]
    tiles: SceneTiles
    bits: float

    def room(self, numbers: int) -> float:
        """Returns the bits of the budget that remain for tiles and factors beside the table of sheets and T_c, if an
        entry of T_c has `numbers` integers."""
        return self.bits - len(self.planes) * SHEET_BITS - math.prod(self.shape) * numbers // 2 * LUT_BITS


@dataclass(frozen=True, eq=False)
class Fitted:
    """The components, sizes and places chosen for all tiles.

    Separate tiles are listed state by state in `cut`; `states` is the number of states with separate tiles, 1 if all
    share tiles. `tried` are the errors of all tiles for each number of components, weighted by `balance`; `given` has
    what the tiles got; an entry of T_c has `numbers` integers. `gain` estimates the advantage of separate tiles in
    views, in dB; None if it wasn't computed to the end.
    """

    cut: Cut
    tried: list[Candidate]
    given: Allocated
    numbers: int
    states: int = 1
    gain: float | None = None


def fitted(
    scene: LightmappedScene,
    planes: list[Plane],
    unit: np.ndarray,
    varies: Sequence[np.ndarray],
    profile: Profile,
    seed: int,
    stages: Stages,
) -> Fitted:
    """Chooses components and sizes for the tiles of all planes, from `planes_of`. Tiles are shared by the states or
    separate for each.

    `unit`, float64 [M], is the divisor of each state's light, and `varies` the variation of each sheet's light, from
    `variation`.
    """
    states = len(scene.states)
    # One state has one component.
    numbers = ENTRY if states > 1 else SHORT_ENTRY
    with stages("tiles"):
        bits = profile.budget * scene.texels * SOURCE_BITS
        cut = _cut(planes, [unit] * len(planes), bits, profile.tile, stages.device)
    room = cut.room(numbers)
    if room < len(cut.tiles.index) * COLOUR_BITS[TEXELS]:
        raise WlmError(NO_ROOM.format(profile.budget))
    with stages("curves"):
        tried = candidates(cut.tiles, sizes_of(profile), room, seed, stages, 0)
    with stages("balance"):
        grids = [(place.rows, place.columns) for place in cut.places[: len(scene.sheets)]]
        shown = tile_shares(scene, varies, cut.tiles, grids, profile, seed, stages.device)
        factor = balance(tried, cut.tiles.weights, shown, room)
    with stages("allocate"):
        together = _allocated(cut, tried, factor, numbers, profile)
    if states == 1:
        return together
    with stages("separate"):
        return _choose_sharing(together, unit, factor, shown, profile, seed, stages)


def _choose_sharing(
    together: Fitted,
    unit: np.ndarray,
    factor: np.ndarray,
    shown: ViewShares,
    profile: Profile,
    seed: int,
    stages: Stages,
) -> Fitted:
    """Returns shared tiles, or separate tiles for each state if the views' mean PSNR is higher with separate tiles."""
    states, whole = len(unit), together.cut
    count = len(whole.planes)
    planes = [
        replace(plane, frames=plane.frames[m : m + 1], smaller=plane.smaller and plane.smaller + m * count)
        for m in range(states)
        for plane in whole.planes
    ]
    # Each of the other states needs a constant and a factor.
    bits = whole.bits - 2 * FACTOR_BITS * (states - 1)
    units = [unit[m : m + 1] for m in range(states) for _ in range(count)]
    cut = _cut(planes, units, bits, profile.tile, stages.device)
    room, tiles = cut.room(SHORT_ENTRY), cut.tiles
    if room < len(tiles.index) * COLOUR_BITS[TEXELS]:
        return together
    if len(whole.tiles.index) > _SAMPLES and _hopeless(together, tiles, states, factor, room, profile, seed, stages):
        return together
    tried = candidates(tiles, sizes_of(profile), room, seed, stages, _SEPARATE)
    of_states = shown.by_state(states)
    of_tiles = balance(tried, tiles.weights, of_states, room)
    try:
        separate = _allocated(cut, tried, of_tiles, SHORT_ENTRY, profile)
    except WlmError:  # shared tiles fit where separate ones do not
        return together
    before = shown.psnr(together.given.error / (factor * whole.tiles.weights))
    gain = of_states.psnr(separate.given.error / (of_tiles * tiles.weights)) - before
    return replace(separate, states=states, gain=gain) if gain > 0.0 else replace(together, gain=gain)


def _hopeless(
    together: Fitted,
    tiles: SceneTiles,
    states: int,
    factor: np.ndarray,
    room: float,
    profile: Profile,
    seed: int,
    stages: Stages,
) -> bool:
    """Tests on random tiles whether tiles of their own for each state have far more error than shared ones."""
    given, count = together.given, len(factor)
    few = np.sort(np.random.default_rng(seed).choice(count, max(count // _SAMPLE, _SAMPLES), replace=False))
    cost = costs(together.tried)
    taken = cost[allocate(np.concatenate([each.error for each in together.tried]), cost, room, 0.0)]
    own = float(taken[few].sum()) / float(taken.sum()) * room
    # The sample has the same tiles in each state.
    members = (np.arange(states)[:, None] * count + few).ravel()
    tried = candidates(tiles.part(members), sizes_of(profile), own, seed, stages, _SAMPLED)
    error = np.concatenate([each.error for each in tried]) * np.tile(factor[few], states)
    separate = allocate(error, costs(tried), own, 0.0)
    return float(error[separate, np.arange(len(members))].sum()) > _HOPELESS * float(given.error[few].sum())


def _allocated(cut: Cut, tried: list[Candidate], factor: np.ndarray, numbers: int, profile: Profile) -> Fitted:
    """Chooses sizes and places of T tiles, with errors times `factor` [T]; several pages need longer T_c entries."""
    tried = [replace(each, error=each.error * factor) for each in tried]
    given = allocated(tried, cut.room(numbers), profile)
    if numbers == SHORT_ENTRY and given.page.any():
        numbers = ENTRY
        given = allocated(tried, cut.room(numbers), profile)
    return Fitted(cut, tried, given, numbers)


def _cut(planes: list[Plane], units: list[np.ndarray], bits: float, tile: int, device: str) -> Cut:
    """Places all planes in T_c and cuts their light, divided by each state's unit, into tiles; returns it all."""
    total, grid = sum(float(plane.weight.sum()) for plane in planes), []
    texels, weights, numbers, owner = [], [], [], []
    for number, (plane, unit) in enumerate(zip(planes, units, strict=True)):
        grid.append(tile_counts(*plane.frames.shape[1:3], tile))
        if not plane.weight.any():
            continue
        index, share = weighted(torch.from_numpy(plane.weight), tile)
        # The texel axes come first, then the states.
        frames = torch.from_numpy(plane.frames).permute(1, 2, 0, 3)
        texels.append(patches(frames, index, grid[-1][1], tile) / torch.from_numpy(unit).float()[:, None])
        weights.append(share * (float(plane.weight.sum()) / total))
        numbers.append(index.numpy())
        owner.append(np.full(len(index), number))
    arrays = torch.cat(texels), torch.cat(weights), np.concatenate(owner), np.concatenate(numbers)
    first, shape = packed(np.array([(columns, rows) for rows, columns in grid]))
    places = [
        SheetPlace(plane.name, *plane.frames.shape[1:3], row, column, *counts, plane.smaller)
        for plane, (column, row), counts in zip(planes, first.tolist(), grid, strict=True)
    ]
    return Cut(planes, places, shape, SceneTiles(*arrays, tile, device), bits)
