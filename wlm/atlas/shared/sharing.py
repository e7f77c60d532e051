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
class Layout:
    """The places of sheets and mip levels in the lookup texture T_c, and the rows and columns of T_c."""

    places: list[SheetPlace]
    shape: tuple[int, int]

    @property
    def grids(self) -> list[tuple[int, int]]:
        """The rows and columns of tiles of each sheet and level."""
        return [(place.rows, place.columns) for place in self.places]


@dataclass(frozen=True, eq=False)
class Fitted:
    """The components, sizes and places chosen for all tiles.

    Attributes:
        planes, layout, tiles: Sheets and levels, their places and tiles; separate tiles are listed state by state.
        tried: The errors of all tiles for each number of components, weighted by `balance`.
        given: Components, sizes and places of the tiles.
        numbers: Number of integers per entry of T_c.
        states: Number of states with separate tiles; 1: all share tiles.
        gain: Estimated advantage of separate tiles in views, in dB; None if it wasn't computed to the end.
    """

    planes: list[Plane]
    layout: Layout
    tiles: SceneTiles
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
    """Chooses components and sizes for the tiles of all planes. Tiles are shared by the states or separate for each.

    Args:
        scene: The scene.
        planes: Sheets and mip levels, from `planes_of`.
        unit: float64 [M], the divisor of each state's light.
        varies: Variation of each sheet's light, from `variation`.
        profile: The settings.
        seed: Seed of all random choices.
        stages: Reports and times the stages.

    Raises:
        WlmError: The budget is less than the smallest tiles take.
    """
    device, states, sheets = stages.device, len(scene.states), len(scene.sheets)
    bits = profile.budget * scene.texels * SOURCE_BITS
    layout = _laid_out(planes, profile.tile)
    # One state has one component.
    numbers = ENTRY if states > 1 else SHORT_ENTRY
    with stages("tiles"):
        tiles = _tiles(planes, [unit] * len(planes), profile.tile, device)
    room = _room(bits, layout, len(planes), numbers)
    if room < len(tiles.index) * COLOUR_BITS[TEXELS]:
        raise WlmError(NO_ROOM.format(profile.budget))
    with stages("curves"):
        tried = candidates(tiles, sizes_of(profile), room, seed, stages, 0)
    with stages("balance"):
        shown = tile_shares(scene, varies, tiles, layout.grids[:sheets], profile, seed, device)
        weight = tiles.weight.double().sum(1).cpu().numpy()
        factor = balance(tried, weight, shown, room)
    with stages("allocate"):
        together = _allocated(planes, layout, tiles, _times(tried, factor), bits, room, numbers, profile)
    if states == 1:
        return together
    with stages("separate"):
        return _choose_sharing(together, unit, factor, shown, bits, profile, seed, stages)


def _choose_sharing(
    together: Fitted,
    unit: np.ndarray,
    factor: np.ndarray,
    shown: ViewShares,
    bits: float,
    profile: Profile,
    seed: int,
    stages: Stages,
) -> Fitted:
    """Returns shared tiles, or separate tiles for each state if the views' mean PSNR is higher with separate tiles."""
    states, count = len(unit), len(together.planes)
    planes = [
        replace(plane, frames=plane.frames[m : m + 1], smaller=plane.smaller and plane.smaller + m * count)
        for m in range(states)
        for plane in together.planes
    ]
    layout = _laid_out(planes, profile.tile)
    # Each of the other states needs a constant and a factor.
    bits -= 2 * FACTOR_BITS * (states - 1)
    room = _room(bits, layout, len(planes), SHORT_ENTRY)
    if room < states * len(together.tiles.index) * COLOUR_BITS[TEXELS]:
        return together
    tiles = _tiles(planes, [unit[m : m + 1] for m in range(states) for _ in range(count)], profile.tile, stages.device)
    if len(together.tiles.index) > _SAMPLES and _hopeless(together, tiles, states, factor, room, profile, seed, stages):
        return together
    tried = candidates(tiles, sizes_of(profile), room, seed, stages, _SEPARATE)
    weight = tiles.weight.double().sum(1).cpu().numpy()
    of_states = shown.by_state(states)
    of_tiles = balance(tried, weight, of_states, room)
    try:
        separate = _allocated(planes, layout, tiles, _times(tried, of_tiles), bits, room, SHORT_ENTRY, profile)
    except WlmError:  # shared tiles fit where separate ones do not
        return together
    before = shown.psnr(together.given.error / (factor * weight[: len(factor)] * states))
    gain = of_states.psnr(separate.given.error / (of_tiles * weight)) - before
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
    """Tests on a sample of tiles whether separate tiles have far more error than shared tiles of as many bits."""
    given, count = together.given, len(factor)
    few = np.sort(np.random.default_rng(seed).choice(count, max(count // _SAMPLE, _SAMPLES), replace=False))
    cost = costs(together.tried)
    shared = np.concatenate([each.error for each in together.tried])
    chosen = allocate(shared, cost, room, 0.0)
    taken = cost[chosen]
    own = float(taken[few].sum()) / float(taken.sum()) * room
    # The sample has the same tiles in each state.
    members = (np.arange(states)[:, None] * count + few).ravel()
    piece = SceneTiles(
        tiles.texels[members],
        tiles.weight[members],
        tiles.plane[members],
        tiles.index[members],
        tiles.size,
        tiles.device,
    )
    tried = candidates(piece, sizes_of(profile), own, seed, stages, _SAMPLED)
    error = np.concatenate([each.error for each in tried]) * np.tile(factor[few], states)
    separate = allocate(error, costs(tried), own, 0.0)
    return float(error[separate, np.arange(len(members))].sum()) > _HOPELESS * float(given.error[few].sum())


def _room(bits: float, layout: Layout, planes: int, numbers: int) -> float:
    """Returns the bits that remain for tiles and factors after the lookup texture and the table of sheets."""
    return bits - planes * SHEET_BITS - math.prod(layout.shape) * numbers // 2 * LUT_BITS


def _times(tried: list[Candidate], factor: np.ndarray) -> list[Candidate]:
    return [replace(each, error=each.error * factor) for each in tried]


def _allocated(
    planes: list[Plane],
    layout: Layout,
    tiles: SceneTiles,
    tried: list[Candidate],
    bits: float,
    room: float,
    numbers: int,
    profile: Profile,
) -> Fitted:
    given = allocated(tried, room, profile)
    if numbers == SHORT_ENTRY and given.page.any():
        numbers = ENTRY
        given = allocated(tried, _room(bits, layout, len(planes), numbers), profile)
    return Fitted(planes, layout, tiles, tried, given, numbers)


def _laid_out(planes: list[Plane], tile: int) -> Layout:
    grid = [tile_counts(*plane.frames.shape[1:3], tile) for plane in planes]
    first, shape = packed(np.array([(columns, rows) for rows, columns in grid]))
    places = [
        SheetPlace(plane.name, *plane.frames.shape[1:3], row, column, *counts, plane.smaller)
        for plane, (column, row), counts in zip(planes, first.tolist(), grid, strict=True)
    ]
    return Layout(places, shape)


def _tiles(planes: list[Plane], units: list[np.ndarray], tile: int, device: str) -> SceneTiles:
    """Cuts the light of all planes into tiles, after division by the unit of each state."""
    total = sum(float(plane.weight.sum()) for plane in planes)
    texels, weights, numbers, owner = [], [], [], []
    for number, (plane, unit) in enumerate(zip(planes, units, strict=True)):
        if not plane.weight.any():
            continue
        index, share = weighted(torch.from_numpy(plane.weight), tile)
        columns = tile_counts(*plane.frames.shape[1:3], tile)[1]
        # The texel axes come first, then the states.
        frames = torch.from_numpy(plane.frames).permute(1, 2, 0, 3)
        texels.append(patches(frames, index, columns, tile) / torch.from_numpy(unit).float()[:, None])
        weights.append(share * (float(plane.weight.sum()) / total))
        numbers.append(index.numpy())
        owner.append(np.full(len(index), number))
    return SceneTiles(
        torch.cat(texels), torch.cat(weights), np.concatenate(owner), np.concatenate(numbers), tile, device
    )
