"""Whether the states of a scene share tiles, as sums of components, or each has tiles of its own.

Light of hours has much in common, of which components say most once. A shadow mask and the light of a sky have not, and
with tiles in common each is stored where the other needs its texels. So both are allocated, in the same bits, and the
better is kept: a mean over views of the logarithm of what they lose, as they are scored.

Of tiles apart there are as many as states times tiles. A sample of them says whether the others are worth their curves.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from wlm.atlas.layout import allocate, place
from wlm.atlas.model import tile_counts
from wlm.atlas.scene.allocation import NO_ROOM, Allocated, allocated
from wlm.atlas.scene.balance import Seen, balance, tiles_seen
from wlm.atlas.scene.curves import SceneTiles, Tried, candidates, costs, sizes_of
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.model import (
    ENTRY,
    FACTOR_BITS,
    NUMBER_BITS,
    SHEET_BITS,
    SHORT_ENTRY,
    TEXEL_BITS,
    SceneProfile,
)
from wlm.atlas.scene.packing import WIDTHS
from wlm.atlas.scene.planes import Plane
from wlm.atlas.stages import Stages
from wlm.atlas.tiles import patches, weighted
from wlm.errors import WlmError

_SAMPLES, _SAMPLE = 1024, 8  # tiles up to which all are tried apart at once; of more one of so many
_HOPELESS = 1.25  # times the error of a sample where states share tiles: apart isn't tried


@dataclass(frozen=True, eq=False)
class Layout:
    """Tables of sheets and levels.

    Attributes:
        grid: Rows and columns of tiles of each.
        row, column: The first entry of each in T_c.
        shape: Of T_c.
    """

    grid: list[tuple[int, int]]
    row: list[int]
    column: list[int]
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Fitted:
    """What all tiles are given.

    Attributes:
        planes: Sheets and levels; apart, those of one state after the other.
        layout: Of these.
        tiles: Their tiles.
        tried: These with each number of components, weighted by `balance`.
        given: What they are given.
        numbers: Of an entry of T_c.
        apart: States that have tiles of their own; 1: all share theirs.
        gain: dB in views that tiles apart are ahead of shared ones, about; None: not measured to the end.
    """

    planes: list[Plane]
    layout: Layout
    tiles: SceneTiles
    tried: list[Tried]
    given: Allocated
    numbers: int
    apart: int = 1
    gain: float | None = None


def fitted(
    scene: LightmappedScene,
    planes: list[Plane],
    unit: np.ndarray,
    varies: Sequence[np.ndarray],
    profile: SceneProfile,
    seed: int,
    stages: Stages,
) -> Fitted:
    """Allocates to the tiles of all planes what they are given, shared by the states or apart.

    Args:
        scene: The scene.
        planes: `planes_of`.
        unit: float64 [M], what light of each state is divided by.
        varies: `variation`.
        profile: The settings.
        seed: Of views and mixtures.
        stages: Reports and times the stages.

    Raises:
        WlmError: The budget is less than the smallest tiles take.
    """
    device, states, sheets = stages.device, len(scene.states), len(scene.sheets)
    bits = profile.budget * scene.source_bits
    layout = _laid_out(planes, profile.tile)
    # One state has one component.
    numbers = ENTRY if states > 1 else SHORT_ENTRY
    with stages("tiles"):
        tiles = _tiles(planes, [unit] * len(planes), profile.tile, device)
    room = _room(bits, layout, len(planes), numbers)
    if room < len(tiles.index) * TEXEL_BITS:
        raise WlmError(NO_ROOM.format(profile.budget))
    with stages("curves"):
        tried = candidates(tiles, sizes_of(profile), profile, room, seed, stages)
    with stages("balance"):
        seen = tiles_seen(scene, varies, tiles, layout.grid[:sheets], profile, seed, device)
        weight = tiles.weight.double().sum(1).cpu().numpy()
        factor = balance(tried, weight, seen, profile, room)
    with stages("allocate"):
        together = _allocated(planes, layout, tiles, _times(tried, factor), bits, room, numbers, profile)
    if states == 1:
        return together
    with stages("apart"):
        return _better(together, unit, factor, seen, bits, profile, seed, stages)


def _better(
    together: Fitted,
    unit: np.ndarray,
    factor: np.ndarray,
    seen: Seen,
    bits: float,
    profile: SceneProfile,
    seed: int,
    stages: Stages,
) -> Fitted:
    """That, or the same planes with a state each."""
    states, count = len(unit), len(together.planes)
    planes = [
        replace(plane, frames=plane.frames[m : m + 1], smaller=plane.smaller and plane.smaller + m * count)
        for m in range(states)
        for plane in together.planes
    ]
    layout = _laid_out(planes, profile.tile)
    # A constant and a factor for each of the other states.
    bits -= 2 * FACTOR_BITS * (states - 1)
    room = _room(bits, layout, len(planes), SHORT_ENTRY)
    if room < states * len(together.tiles.index) * TEXEL_BITS:
        return together
    tiles = _tiles(planes, [unit[m : m + 1] for m in range(states) for _ in range(count)], profile.tile, stages.device)
    if len(together.tiles.index) > _SAMPLES and _hopeless(together, tiles, states, factor, room, profile, seed, stages):
        return together
    tried = candidates(tiles, sizes_of(profile), profile, room, seed, stages)
    weight = tiles.weight.double().sum(1).cpu().numpy()
    of_states = seen.by_state(states)
    of_tiles = balance(tried, weight, of_states, profile, room)
    try:
        apart = _allocated(planes, layout, tiles, _times(tried, of_tiles), bits, room, SHORT_ENTRY, profile)
    except WlmError:  # shared tiles fit where so many don't
        return together
    before = seen.psnr(together.given.error / (factor * weight[: len(factor)] * states))
    gain = of_states.psnr(apart.given.error / (of_tiles * weight)) - before
    return replace(apart, apart=states, gain=gain) if gain > 0.0 else replace(together, gain=gain)


def _hopeless(
    together: Fitted,
    tiles: SceneTiles,
    states: int,
    factor: np.ndarray,
    room: float,
    profile: SceneProfile,
    seed: int,
    stages: Stages,
) -> bool:
    """Whether tiles apart lose far more than shared ones, of a sample that has as many bits as it has shared."""
    given, count = together.given, len(factor)
    few = np.sort(np.random.default_rng(seed).choice(count, max(count // _SAMPLE, _SAMPLES), replace=False))
    cost = costs(together.tried)
    shared = np.concatenate([each.error for each in together.tried])
    chosen = allocate(shared, cost, room, 0.0)
    taken = cost[chosen]
    own = float(taken[few].sum()) / float(taken.sum()) * room
    # The same tiles of each state.
    members = (np.arange(states)[:, None] * count + few).ravel()
    piece = SceneTiles(
        tiles.texels[members],
        tiles.weight[members],
        tiles.plane[members],
        tiles.index[members],
        tiles.size,
        tiles.device,
    )
    tried = candidates(piece, sizes_of(profile), profile, own, seed, stages)
    error = np.concatenate([each.error for each in tried]) * np.tile(factor[few], states)
    apart = allocate(error, costs(tried), own, 0.0)
    return float(error[apart, np.arange(len(members))].sum()) > _HOPELESS * float(given.error[few].sum())


def _room(bits: float, layout: Layout, planes: int, numbers: int) -> float:
    """Bits that tables leave to tiles and factors."""
    return bits - planes * SHEET_BITS - math.prod(layout.shape) * numbers * NUMBER_BITS


def _times(tried: list[Tried], factor: np.ndarray) -> list[Tried]:
    return [replace(each, error=each.error * factor) for each in tried]


def _allocated(
    planes: list[Plane],
    layout: Layout,
    tiles: SceneTiles,
    tried: list[Tried],
    bits: float,
    room: float,
    numbers: int,
    profile: SceneProfile,
) -> Fitted:
    given = allocated(tried, room, profile)
    if numbers == SHORT_ENTRY and given.page.any():
        numbers = ENTRY
        given = allocated(tried, _room(bits, layout, len(planes), numbers), profile)
    return Fitted(planes, layout, tiles, tried, given, numbers)


def _laid_out(planes: list[Plane], tile: int) -> Layout:
    """Places the tables of sheets and levels in one, on shelves."""
    grid = [tile_counts(*plane.frames.shape[1:3], tile) for plane in planes]
    across = np.array([(columns, rows) for rows, columns in grid])
    best = None
    for share in WIDTHS:
        width = max(int(across[:, 0].max()), round(share * math.sqrt(across.prod(1).sum())))
        first, height = place(across, width)
        width = int((first[:, 0] + across[:, 0]).max())
        if best is None or width * height < best[0]:
            best = width * height, first, (height, width)
    return Layout(grid, best[1][:, 1].tolist(), best[1][:, 0].tolist(), best[2])


def _tiles(planes: list[Plane], units: list[np.ndarray], tile: int, device: str) -> SceneTiles:
    """Cuts light, over the units of each plane's states, into tiles."""
    total = sum(float(plane.weight.sum()) for plane in planes)
    texels, weights, numbers, owner = [], [], [], []
    for number, (plane, unit) in enumerate(zip(planes, units, strict=True)):
        if not plane.weight.any():
            continue
        index, share = weighted(torch.from_numpy(plane.weight), tile)
        columns = tile_counts(*plane.frames.shape[1:3], tile)[1]
        # Texels first, then states.
        frames = torch.from_numpy(plane.frames).permute(1, 2, 0, 3)
        texels.append(patches(frames, index, columns, tile) / torch.from_numpy(unit).float()[:, None])
        weights.append(share * (float(plane.weight.sum()) / total))
        numbers.append(index.numpy())
        owner.append(np.full(len(index), number))
    return SceneTiles(
        torch.cat(texels), torch.cat(weights), np.concatenate(owner), np.concatenate(numbers), tile, device
    )
