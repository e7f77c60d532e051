"""From a scene's lightmaps to one model: mixtures of the states, tiles of all sheets, one allocation.

The states' light is divided by how much it varies, so that each counts by its PSNR (`detail`). Tiles are dealt to
mixtures of one, two and more components (`mixture`), each has a curve of error for each number of them (`curves`), they
count by what the views that show them lose (`balance`), and numbers and sizes are allocated to the tiles of all sheets
at once (`allocation`): one more bit gains as much in every object.
"""

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from wlm import interop
from wlm.atlas.colour import encode
from wlm.atlas.layout import Size, place, texels_of
from wlm.atlas.model import BLOCK_SIDE, BLOCKS, TEXELS, tile_counts
from wlm.atlas.scene.allocation import NO_ROOM, Allocated, allocated
from wlm.atlas.scene.balance import balance, tiles_seen
from wlm.atlas.scene.curves import SceneTiles, Tried, candidates, sizes_of
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.detail import peaks_of, scales, variation
from wlm.atlas.scene.model import (
    ENTRY,
    NUMBER_BITS,
    SHEET_BITS,
    SHORT_ENTRY,
    TEXEL_BITS,
    SceneModel,
    SceneProfile,
    SheetPlace,
    coarse_place,
    extent,
    pack_tiles,
)
from wlm.atlas.scene.packing import WIDTHS
from wlm.atlas.scene.planes import Plane, planes_of
from wlm.atlas.scene.seen import scene_weights
from wlm.atlas.stages import Stages, one_thread
from wlm.atlas.tiles import (
    Tiles,
    patches,
    solved,
    weighted,
)
from wlm.errors import WlmError
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.system import OnProgress

_AT_ONCE = 1024  # tiles
_BRIGHT = 1024.0  # what a component's largest texel becomes: RGB9E5 has as many octaves below it as above


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
        peak = peaks_of(scene)
        varies = variation(scene, peak, device)
        weights = scene_weights(scene, varies, profile, seed, device)
        unit = peak * scales(varies, [_of_texels(weight) for weight in weights])
        planes = planes_of(scene, weights, profile.mips, device)
    layout = _laid_out(planes, profile.tile)
    # One state has one component.
    numbers = ENTRY if len(scene.states) > 1 else SHORT_ENTRY
    bits = profile.budget * scene.source_bits - len(planes) * SHEET_BITS
    room = bits - math.prod(layout.shape) * numbers * NUMBER_BITS
    with stages("tiles"):
        tiles = _tiles(planes, unit, profile.tile, device)
    if room < len(tiles.index) * TEXEL_BITS:
        raise WlmError(NO_ROOM.format(profile.budget))
    sizes = sizes_of(profile)
    with stages("curves"):
        tried = candidates(tiles, sizes, profile, room, seed, stages)
    with stages("balance"):
        seen = tiles_seen(scene, varies, tiles, layout.grid[: len(scene.sheets)], profile, seed, device)
        tried = balance(tried, tiles.weight.double().sum(1).cpu().numpy(), seen, profile, room)
    with stages("allocate"):
        given = allocated(tried, room, profile)
        if numbers == SHORT_ENTRY and given.page.any():
            numbers = ENTRY
            given = allocated(tried, bits - math.prod(layout.shape) * ENTRY * NUMBER_BITS, profile)
    with stages("solve"):
        texels, blocks, scale = _texels(tiles, tried, given)
    lut = np.ascontiguousarray(_table(tiles, layout, given)[..., :numbers])
    rows = [
        SheetPlace(plane.name, *plane.frames.shape[1:3], row, column, *grid, plane.smaller)
        for plane, row, column, grid in zip(planes, layout.row, layout.column, layout.grid, strict=True)
    ]
    sheets = len(scene.sheets)
    counts, samples, many = (
        np.bincount(tiles.plane, each, len(planes))[:sheets]
        for each in (None, extent(given.size, given.count, given.coarse).prod(1), given.count)
    )
    report = {
        "components": {str(each): int((given.count == each).sum()) for each in np.unique(given.count).tolist()},
        "mixtures": len(np.unique(given.component)),
        "tiles": counts.astype(int).tolist(),
        "samples": samples.astype(int).tolist(),
        "components by sheet": (many / np.maximum(counts, 1)).round(2).tolist(),
        "pages": len(texels),
        "tiles of blocks": int(given.second.sum()),
        "coarse components": int(given.coarse.sum()),
        "error by components": {str(each.rank): each.left for each in tried},
        "units": unit.tolist(),
        "seconds": stages.seconds,
    }
    factor = (given.factors * unit[:, None] / scale[:, None]).transpose(1, 0, 2).astype(np.float32)
    parts = (tuple(rows[:sheets]), np.ascontiguousarray(factor), texels, lut, tuple(rows[sheets:]), report)
    second = {"blocks": blocks[0], "block_texels": blocks[1].astype(np.float16)} if blocks else {}
    return SceneModel(scene.name, scene.source, profile, scene.states, *parts, **second)


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


def _of_texels(weight: np.ndarray) -> np.ndarray:
    """Weights of texels [H, W] of those of their quarters [2 H, 2 W]."""
    return weight.reshape(weight.shape[0] // 2, 2, -1, 2).sum((1, 3))


def _tiles(planes: list[Plane], unit: np.ndarray, tile: int, device: str) -> SceneTiles:
    """Cuts the light of all states into tiles."""
    total = sum(float(plane.weight.sum()) for plane in planes)
    texels, weights, numbers, owner = [], [], [], []
    scale = torch.from_numpy(unit).float()[:, None]
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
    return SceneTiles(
        torch.cat(texels), torch.cat(weights), np.concatenate(owner), np.concatenate(numbers), tile, device
    )


def _texels(
    tiles: SceneTiles, tried: list[Tried], given: Allocated
) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """T_p, uint32 [pages, Hp, Wp]; the second texture, blocks and what they decode to, if there is one; and what each
    component was multiplied by, float64 [C, 3]."""
    light = [np.zeros((*shape, 3), np.float32) for shape in given.shapes]
    owner, share = ([np.zeros(shape, kind) for shape in given.shapes] for kind in (np.int32, np.float32))
    largest = np.zeros((len(given.factors), 3), np.float32)
    for rank, each in enumerate(tried):
        members = np.flatnonzero(given.rank == rank)
        for part in np.array_split(members, -(-len(members) // _AT_ONCE)) if len(members) else ():
            texels, weight = tiles.light(part)
            mixtures, mixture = each.mixtures.to(tiles.device), torch.from_numpy(each.number[part]).to(tiles.device)
            components = tiles.points(tiles.components(texels, mixtures, mixture))
            kinds = np.column_stack([given.size[part], given.second[part]])
            sides, chosen = np.unique(kinds, axis=0, return_inverse=True)
            sizes = [Size(nx, ny, BLOCKS if second else TEXELS, bool(second)) for nx, ny, second in sides.tolist()]
            block, sizes = len(sizes), [*sizes, Size(BLOCK_SIDE, BLOCK_SIDE, BLOCKS, True)]
            whole = each.rank - given.coarse[part]
            for k in range(each.rank):
                piece = Tiles(mixture, components[:, k].contiguous(), weight, tiles.size)
                number = np.where(k < whole, chosen.ravel(), block)
                for at, values, weights in solved(piece, sizes, number):
                    at, (ny, nx) = part[at], values.shape[1:3]
                    texture, whole_of = int(given.second[at[0]]), each.rank - given.coarse[at]
                    aside = coarse_place(given.size[at], whole_of, np.maximum(k - whole_of, 0))
                    aside = np.where((k < whole_of)[:, None], given.size[at] * [k, 0], aside)
                    row, column = texels_of(given.first[at] + aside, nx, ny)
                    number = given.component[at] + 1 + k
                    place = given.page[at, None, None], row, column
                    light[texture][place], owner[texture][place] = values, number[:, None, None]
                    share[texture][place] = weights
                    np.maximum.at(largest, number, values.max((1, 2)))
    scale = np.divide(_BRIGHT, largest, out=np.ones_like(largest), where=largest > 0)
    first, second = (texels * scale[number] for texels, number in zip(light, owner, strict=True))
    pages = [encode(page, BLOCKS, weight, tiles.device) for page, weight in zip(second, share[1], strict=True)]
    blocks = tuple(np.stack(each) for each in zip(*pages, strict=True))
    return pack_rgb9e5(first), blocks, scale.astype(np.float64)


def _table(tiles: SceneTiles, layout: _Layout, given: Allocated) -> np.ndarray:
    """T_c, uint16 [Hc, Wc, 4]. Tiles without a weight are black."""
    columns = np.array([each[1] for each in layout.grid])[tiles.plane]
    row = tiles.index // columns + np.array(layout.row)[tiles.plane]
    column = tiles.index % columns + np.array(layout.column)[tiles.plane]
    table = np.zeros((*layout.shape, 4), np.uint16)
    table[row, column] = pack_tiles(
        given.first, given.size, given.component, given.count, given.page, given.second, given.coarse
    )
    return table
