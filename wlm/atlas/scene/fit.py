"""From a scene's lightmaps to one model: mixtures of the states, tiles of all sheets, one allocation.

The states' light is divided by its peak, so that each counts by its PSNR. Tiles are dealt to mixtures of one, two and
more components (`mixture`). For a tile, a mixture and a size the squared error of all states is what the mixture leaves
and

    sum_m || sum_k f[m, k] r_k ||² = sum_j || sum_k L[k, j] r_k ||²,    F^T F = L L^T (Cholesky),

with r_k the residual of component k; least squares are linear, so that the curve is had by fitting K mixtures of
components under L, not the M states. Numbers of components and sizes are then allocated to the tiles of all sheets at
once: one more sample gains as much in every object.
"""

import math
import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from wlm import interop
from wlm.atlas.layout import Size, allocate, place, texels_of
from wlm.atlas.model import TEXELS, tile_counts
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.mixture import Mixtures, find_mixtures, moments
from wlm.atlas.scene.model import (
    ENTRY,
    FACTOR_BITS,
    NUMBER_BITS,
    SHEET_BITS,
    SHORT_ENTRY,
    TEXEL_BITS,
    SceneModel,
    SceneProfile,
    SheetPlace,
    pack_tiles,
)
from wlm.atlas.scene.packing import WIDTHS, packed
from wlm.atlas.scene.planes import Plane, planes_of
from wlm.atlas.scene.seen import scene_weights
from wlm.atlas.stages import Stages, one_thread
from wlm.atlas.tiles import Tiles, errors, patches, solve, solved, tile_light, weighted
from wlm.errors import WlmError
from wlm.formats.dds import MOST_SIDE
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.system import Meter, OnProgress

_RANKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # components of a tile
_MIXTURES = 128  # of one rank, at most
_FACTOR_SHARE = 0.15  # of the budget, that the factors of all mixtures that are tried may take
# Tiles that mixtures are found of, numbers of their moments at most, and texels of each for the bounds.
_SAMPLES, _MOMENTS, _SAMPLE_TEXELS = 8192, 1 << 24, 16
_PAYS = 0.99  # of the error: more components leave less, or no more are tried
_SIDES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16)
_ROUGH = 3  # rounds of conjugate gradients of a curve
_AT_ONCE = 1024  # tiles
_TRIES, _FULL = 12, 0.995  # of placing all tiles, and how much of the room is full enough
_PERCENTILE = 99.9  # of a state's light: its peak
_BRIGHT = 1024.0  # what a component's largest texel becomes: RGB9E5 has as many octaves below it as above
_LEAST_GAIN = 2.0**-24
_NO_ROOM = "budget: {:g} is less than the smallest tiles and their table take: expected more"


@dataclass(frozen=True, eq=False)
class _SceneTiles:
    """The tiles of all sheets and levels that have a weight.

    Attributes:
        texels: float32 [T, B + 1, B + 1, M, 3], their light over its peaks.
        weight: float32 [T, P], of their points; all add up to 1.
        plane: int [T], their sheet or level, ascending.
        index: int64 [T], number of each within it, row by row.
        size: B.
        device: Where they are fitted.
    """

    texels: torch.Tensor
    weight: torch.Tensor
    plane: np.ndarray
    index: np.ndarray
    size: int
    device: str

    def light(self, at: np.ndarray | slice) -> tuple[torch.Tensor, torch.Tensor]:
        """On the device the texels of some tiles, and the weights of their points."""
        return self.texels[at].to(self.device), self.weight[at].to(self.device)

    def points(self, texels: torch.Tensor) -> torch.Tensor:
        """Light at the points of tiles [T, N, 3, P] of texels [T, B + 1, B + 1, N, 3]."""
        return tile_light(texels.flatten(3)).unflatten(1, (-1, 3))

    def components(self, texels: torch.Tensor, mixtures: Mixtures, number: torch.Tensor) -> torch.Tensor:
        """Texels [T, B + 1, B + 1, K, 3] of components, of the states' and the tiles' mixtures."""
        parts = torch.einsum("tkmc,tyxmc->tyxkc", mixtures.take[number], texels)
        return (parts + mixtures.offset[number][:, None, None]).clamp(min=0.0)


@dataclass(frozen=True, eq=False)
class _Tried:
    """Tiles with one number of components.

    Attributes:
        mixtures: Those there are.
        number: int [T], the one of each tile.
        error: float64 [sizes, T], mean over the states, at each size.
        left: The error that is left where tiles may have up to so many components, about.
    """

    mixtures: Mixtures
    number: np.ndarray
    error: np.ndarray
    left: float

    @property
    def rank(self) -> int:
        return self.mixtures.factor.shape[2]


@dataclass(frozen=True, eq=False)
class _Layout:
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


def compress_scene(
    scene: LightmappedScene,
    profile: str | os.PathLike[str] | SceneProfile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
    **overrides: Any,
) -> SceneModel:
    """Compresses all lightmaps of a scene into one table and one texture.

    Args:
        scene: The scene.
        profile: The settings: a profile's name, a YAML file or a `SceneProfile`.
        seed: Of the random views.
        device: "cpu" or "cuda:N".
        progress: Called as each stage begins, and about twice a second in stages of many steps.
        overrides: Settings that replace the profile's, by name.

    Returns:
        The model; its report says how many tiles, samples and components each sheet has, and the error left where tiles
        may have up to so many components.

    Raises:
        WlmError: No such profile or device, a wrong setting, or a budget that the smallest model exceeds.
    """
    device = interop.check_device(device)
    profile = SceneProfile.load(profile).override(overrides)
    with one_thread(device):
        return _compressed(scene, profile, seed, Stages(device, progress))


def _compressed(scene: LightmappedScene, profile: SceneProfile, seed: int, stages: Stages) -> SceneModel:
    device = stages.device
    with stages("weights"):
        weights = scene_weights(scene, profile, seed, device)
        peak = _peaks(scene, weights)
        planes = planes_of(scene, weights, profile.mips, device)
    layout = _laid_out(planes, profile.tile)
    # One state has one component.
    numbers = ENTRY if len(scene.states) > 1 else SHORT_ENTRY
    bits = profile.budget * scene.source_bits - len(planes) * SHEET_BITS
    room = bits - math.prod(layout.shape) * numbers * NUMBER_BITS
    with stages("tiles"):
        tiles = _tiles(planes, peak, profile.tile, device)
    if room < len(tiles.index) * TEXEL_BITS:
        raise WlmError(_NO_ROOM.format(profile.budget))
    sizes = np.array([(nx, ny) for ny in _SIDES for nx in _SIDES if max(nx, ny) <= profile.tile + 1])
    with stages("curves"):
        tried = _candidates(tiles, sizes, profile, room, seed, stages)
    with stages("allocate"):
        given = _allocated(tried, sizes, room, profile)
        if numbers == SHORT_ENTRY and given.page.any():
            numbers = ENTRY
            given = _allocated(tried, sizes, bits - math.prod(layout.shape) * ENTRY * NUMBER_BITS, profile)
    with stages("solve"):
        texels, scale = _texels(tiles, tried, given)
    lut = np.ascontiguousarray(_table(tiles, layout, given)[..., :numbers])
    rows = [
        SheetPlace(plane.name, *plane.frames.shape[1:3], row, column, *grid, plane.smaller)
        for plane, row, column, grid in zip(planes, layout.row, layout.column, layout.grid, strict=True)
    ]
    sheets = len(scene.sheets)
    counts, samples, many = (
        np.bincount(tiles.plane, each, len(planes))[:sheets]
        for each in (None, given.size.prod(1) * given.count, given.count)
    )
    report = {
        "components": {str(each): int((given.count == each).sum()) for each in np.unique(given.count).tolist()},
        "mixtures": len(np.unique(given.component)),
        "tiles": counts.astype(int).tolist(),
        "samples": samples.astype(int).tolist(),
        "components by sheet": (many / np.maximum(counts, 1)).round(2).tolist(),
        "pages": len(texels),
        "error by components": {str(each.rank): each.left for each in tried},
        "peaks": peak.tolist(),
        "seconds": stages.seconds,
    }
    factor = (given.factors * peak[:, None] / scale[:, None]).transpose(1, 0, 2).astype(np.float32)
    parts = (tuple(rows[:sheets]), np.ascontiguousarray(factor), texels, lut, tuple(rows[sheets:]), report)
    return SceneModel(scene.name, scene.source, profile, scene.states, *parts)


def _laid_out(planes: list[Plane], tile: int) -> _Layout:
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
    return _Layout(grid, best[1][:, 1].tolist(), best[1][:, 0].tolist(), best[2])


def _peaks(scene: LightmappedScene, weights: list[np.ndarray]) -> np.ndarray:
    """The bright end of each state's light, float64 [M], above 0; of what is seen, and of one texel not."""
    seen = [(weight > 0).reshape(weight.shape[0] // 2, 2, -1, 2).any(axis=(1, 3)) for weight in weights]
    light = [sheet.frames[:, each].max(axis=2) for sheet, each in zip(scene.sheets, seen, strict=True)]
    peak = np.percentile(np.concatenate(light, axis=1), _PERCENTILE, axis=1)
    # A state of darkness is exact whatever its peak is.
    return np.where(peak > 0, peak, float(peak.max()) or 1.0).astype(np.float64)


def _tiles(planes: list[Plane], peak: np.ndarray, tile: int, device: str) -> _SceneTiles:
    """Cuts the light of all states into tiles."""
    total = sum(float(plane.weight.sum()) for plane in planes)
    texels, weights, numbers, owner = [], [], [], []
    scale = torch.from_numpy(peak).float()[:, None]
    for number, plane in enumerate(planes):
        if not plane.weight.any():
            continue
        index, share = weighted(torch.from_numpy(plane.weight), tile)
        columns = tile_counts(*plane.frames.shape[1:3], tile)[1]
        # Texels first, then states.
        frames = torch.from_numpy(plane.frames).permute(1, 2, 0, 3)
        texels.append(patches(frames, index, columns, tile) / scale)
        weights.append(share * (float(plane.weight.sum()) / total))
        numbers.append(index.numpy())
        owner.append(np.full(len(index), number))
    return _SceneTiles(
        torch.cat(texels), torch.cat(weights), np.concatenate(owner), np.concatenate(numbers), tile, device
    )


def _candidates(
    tiles: _SceneTiles, sizes: np.ndarray, profile: SceneProfile, bits: float, seed: int, stages: Stages
) -> list[_Tried]:
    """The error of every tile with one component, two and so on, up to as many as pay."""
    count, states = tiles.texels.shape[0], tiles.texels.shape[3]
    most = min(profile.components or states, states, _RANKS[-1])
    ranks = [*(rank for rank in _RANKS if rank < most), most]
    many = int(min(_FACTOR_SHARE * bits / (states * FACTOR_BITS), MOST_SIDE) / sum(rank + 1 for rank in ranks))
    random = np.random.default_rng(seed)
    samples = min(count, _SAMPLES, _MOMENTS // (3 * states**2))
    few = np.sort(random.choice(count, max(samples, 1), replace=False))
    moment = []
    for at in np.array_split(few, -(-len(few) // _AT_ONCE)):
        texels, weight = tiles.light(at)
        moment.append(moments(tiles.points(texels), weight).cpu().numpy())
    row, column = random.integers(0, tiles.size + 1, (2, _SAMPLE_TEXELS))
    moment, bounds = np.concatenate(moment), tiles.texels[few][:, row, column].numpy()
    meter, tried, before, eager = Meter(stages.progress, "curves", len(ranks) * count), [], math.inf, np.arange(count)
    for done, rank in enumerate(ranks):
        mixtures = find_mixtures(moment, bounds, rank, 1 if rank == states else min(max(many, 1), _MIXTURES), seed)
        # Where a tile isn't tried, nothing is gained.
        error = np.repeat(tried[0].error.max(0)[None], len(sizes), 0) if tried else np.zeros((len(sizes), count))
        number = np.zeros(count, int)
        number[eager], error[:, eager] = _curves(tiles, eager, mixtures, sizes, meter, done * count)
        tried.append(_Tried(mixtures, number, error, 0.0))
        left, chosen = _left(tried, sizes, bits)
        tried[-1] = replace(tried[-1], left=left)
        # A tile that has fewer components than it may have takes no more where others may.
        eager = np.flatnonzero(chosen == done)
        if left > _PAYS * before or not len(eager):
            break
        before = left
    return tried


def _curves(
    tiles: _SceneTiles, members: np.ndarray, mixtures: Mixtures, sizes: np.ndarray, meter: Meter, done: int
) -> tuple[np.ndarray, np.ndarray]:
    """`number` and `error` of `_Tried`, of some tiles."""
    device, rank = tiles.device, mixtures.factor.shape[2]
    mixtures = mixtures.to(device)
    factor, offset = mixtures.factor, mixtures.offset
    root = _roots(mixtures.factor)
    number, error = np.zeros(len(members), int), np.zeros((len(sizes), len(members)))
    step = max(1, _AT_ONCE * 8 // rank)
    for at in range(0, len(members), step):
        if meter.due(done + at):
            meter.report(done + at)
        part = slice(at, at + step)
        texels, weight = tiles.light(members[part])
        light = tiles.points(texels)
        chosen = mixtures.nearest(moments(light, weight))
        components = tiles.points(tiles.components(texels, mixtures, chosen))
        rest = torch.einsum("tmkc,tkcp->tmcp", factor[chosen], components - offset[chosen][..., None]) - light
        lost = (rest.square().mean((1, 2)) * weight).double().sum(1)
        mixed = torch.einsum("tkcp,tckj->tjcp", components, root[chosen]).flatten(0, 1).contiguous()
        piece = Tiles(chosen.repeat_interleave(rank), mixed, weight.repeat_interleave(rank, 0), tiles.size)
        for i, (nx, ny) in enumerate(sizes.tolist()):
            left = errors(piece, solve(piece, nx, ny, _ROUGH)).reshape(-1, rank).sum(1)
            error[i, part] = (left + lost).cpu().numpy()
        number[part] = chosen.cpu().numpy()
    return number, error


def _roots(factor: torch.Tensor) -> torch.Tensor:
    """L of F^T F / M = L L^T, float32 [G, 3, K, K]."""
    gram = torch.einsum("gmkc,gmlc->gckl", factor.double(), factor.double()) / factor.shape[1]
    trace = gram.diagonal(dim1=2, dim2=3).sum(2).clamp(min=1e-30)
    # What makes it definite where components are alike.
    gram = gram + 1e-9 * trace[..., None, None] * torch.eye(gram.shape[2], device=gram.device)
    return torch.linalg.cholesky(gram).float()


def _costs(tried: list[_Tried], sizes: np.ndarray) -> np.ndarray:
    """Bits of each number of components and size."""
    return np.concatenate([sizes.prod(1) * each.rank * float(TEXEL_BITS) for each in tried])


def _left(tried: list[_Tried], sizes: np.ndarray, bits: float) -> tuple[float, np.ndarray]:
    """The error that is left, about; and the number in the list of what each tile takes, int [T]."""
    error = np.concatenate([each.error for each in tried])
    chosen = allocate(error, _costs(tried, sizes), bits, 0.0)
    return float(error[chosen, np.arange(len(chosen))].sum()), chosen // len(sizes)


@dataclass(frozen=True, eq=False)
class _Allocated:
    """What each tile is given.

    Attributes:
        rank: int [T], its number in the list of `_Tried`.
        count: int [T], its components.
        component: int [T], its mixture's first in `factors`.
        factors: float64 [C, M, 3], of each mixture a constant and then its components.
        size: int [T, 2], texels of a component.
        first: int64 [T, 2], place of the first component's on the page.
        page: int64 [T].
        shape: Of a page.
        error: Weighted, mean over the states.
    """

    rank: np.ndarray
    count: np.ndarray
    component: np.ndarray
    factors: np.ndarray
    size: np.ndarray
    first: np.ndarray
    page: np.ndarray
    shape: tuple[int, int]
    error: float


def _allocated(tried: list[_Tried], sizes: np.ndarray, bits: float, profile: SceneProfile) -> _Allocated:
    """Allocates components and sizes to the tiles of all sheets, and places them."""
    error, cost = np.concatenate([each.error for each in tried]), _costs(tried, sizes)
    states, tiles = tried[0].mixtures.factor.shape[1], np.arange(error.shape[1])
    ranks, number = np.array([each.rank for each in tried]), np.stack([each.number for each in tried])
    fewest, budget, found = len(tiles) * float(TEXEL_BITS), bits, None
    for _ in range(_TRIES):
        chosen = allocate(error, cost, budget, _LEAST_GAIN / TEXEL_BITS / len(tiles))
        rank = chosen // len(sizes)
        used, mixture = np.unique(rank * _MIXTURES + number[rank, tiles], return_inverse=True)
        begin = np.cumsum([0, *(ranks[used // _MIXTURES] + 1)])
        size = sizes[chosen % len(sizes)]
        first, page, shape = packed(size * np.stack([ranks[rank], np.ones_like(rank)], 1))
        rest = bits - int(begin[-1]) * states * FACTOR_BITS
        area = math.prod(shape) * (int(page.max()) + 1) * TEXEL_BITS
        total = float(cost[chosen].sum())
        if area <= rest:
            component = begin[mixture.ravel()]
            pairs = (divmod(each, _MIXTURES) for each in used.tolist())
            factors = np.concatenate([tried[r].mixtures.factors(g) for r, g in pairs])
            left = float(error[chosen, tiles].sum())
            best = _Allocated(rank, ranks[rank], component, factors, size, first, page, shape, left)
            if found is None or left < found.error:
                found = best
            if area > _FULL * rest or total >= float(cost[error.argmin(0)].sum()):
                return found
            budget = total * min(0.998 * rest / area, 1.1)
        elif total <= fewest and found is None:
            raise WlmError(_NO_ROOM.format(profile.budget))
        else:
            # The area lost between shelves is about the same next time.
            budget = min(budget, total) * min(max(0.999 * rest / area, 0.1), 0.99)
    if found is None:
        raise WlmError(_NO_ROOM.format(profile.budget))
    return found


def _texels(tiles: _SceneTiles, tried: list[_Tried], given: _Allocated) -> tuple[np.ndarray, np.ndarray]:
    """T_p, uint32 [pages, Hp, Wp], and what each component was multiplied by, float64 [C, 3]."""
    light = np.zeros((int(given.page.max()) + 1, *given.shape, 3), np.float32)
    owner, largest = np.zeros(light.shape[:3], np.int32), np.zeros((len(given.factors), 3), np.float32)
    for rank, each in enumerate(tried):
        members = np.flatnonzero(given.rank == rank)
        for part in np.array_split(members, -(-len(members) // _AT_ONCE)) if len(members) else ():
            texels, weight = tiles.light(part)
            mixtures, mixture = each.mixtures.to(tiles.device), torch.from_numpy(each.number[part]).to(tiles.device)
            components = tiles.points(tiles.components(texels, mixtures, mixture))
            sides, chosen = np.unique(given.size[part], axis=0, return_inverse=True)
            sizes = [Size(nx, ny, TEXELS) for nx, ny in sides.tolist()]
            for k in range(each.rank):
                piece = Tiles(mixture, components[:, k].contiguous(), weight, tiles.size)
                for at, values, _ in solved(piece, sizes, chosen.ravel()):
                    at, (ny, nx) = part[at], values.shape[1:3]
                    row, column = texels_of(given.first[at] + [k * nx, 0], nx, ny)
                    number = given.component[at] + 1 + k
                    light[given.page[at, None, None], row, column] = values
                    owner[given.page[at, None, None], row, column] = number[:, None, None]
                    np.maximum.at(largest, number, values.max((1, 2)))
    scale = np.divide(_BRIGHT, largest, out=np.ones_like(largest), where=largest > 0)
    return pack_rgb9e5(light * scale[owner]), scale.astype(np.float64)


def _table(tiles: _SceneTiles, layout: _Layout, given: _Allocated) -> np.ndarray:
    """T_c, uint16 [Hc, Wc, 4]. Tiles without a weight are black."""
    columns = np.array([each[1] for each in layout.grid])[tiles.plane]
    row = tiles.index // columns + np.array(layout.row)[tiles.plane]
    column = tiles.index % columns + np.array(layout.column)[tiles.plane]
    table = np.zeros((*layout.shape, 4), np.uint16)
    table[row, column] = pack_tiles(given.first, given.size, given.component, given.count, given.page)
    return table
