"""From a scene's lightmaps to one model: mixtures of the states, tiles of all sheets, one allocation.

The states' light is divided by how much it varies, so that each counts by its PSNR (`detail`). Tiles are dealt to
mixtures of one, two and more components (`mixture`), each has a curve of error for each number of them (`curves`), they
count by what the views that show them lose (`balance`), and numbers and sizes are allocated to the tiles of all sheets
at once (`allocation`): one more bit gains as much in every object.

States that have little in common, a shadow mask and the light of a sky, lose by sharing sizes. So the same is done with
the tiles of each state apart, and the better of the two is kept. Apart, all that an object and a state has by itself is
there to be allocated: a scene is no worse than its parts.
"""

import os
from typing import Any

import numpy as np
import torch

from wlm import interop
from wlm.atlas.colour import encode
from wlm.atlas.layout import Size, texels_of
from wlm.atlas.model import BLOCK_SIDE, BLOCKS, TEXELS
from wlm.atlas.scene.allocation import Allocated
from wlm.atlas.scene.curves import SceneTiles, Tried
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.detail import peaks_of, scales, variation
from wlm.atlas.scene.model import (
    SceneModel,
    SceneProfile,
    SheetPlace,
    coarse_place,
    extent,
    pack_tiles,
)
from wlm.atlas.scene.planes import planes_of
from wlm.atlas.scene.seen import scene_weights
from wlm.atlas.scene.sharing import Layout, fitted
from wlm.atlas.stages import Stages, one_thread
from wlm.atlas.tiles import (
    Tiles,
    solved,
)
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.system import OnProgress

_AT_ONCE = 1024  # tiles
_BRIGHT = 1024.0  # what a component's largest texel becomes: RGB9E5 has as many octaves below it as above


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
    kept = fitted(scene, planes, unit, varies, profile, seed, stages)
    planes, layout, tiles, tried, given = kept.planes, kept.layout, kept.tiles, kept.tried, kept.given
    stride = len(planes) // kept.apart
    with stages("solve"):
        texels, blocks, scale = _texels(tiles, tried, given)
    lut = np.ascontiguousarray(_table(tiles, layout, given)[..., : kept.numbers])
    rows = [
        SheetPlace(plane.name, *plane.frames.shape[1:3], row, column, *grid, plane.smaller)
        for plane, row, column, grid in zip(planes, layout.row, layout.column, layout.grid, strict=True)
    ]
    sheets = len(scene.sheets)
    counts, samples, many = (
        np.bincount(tiles.plane % stride, each, stride)[:sheets]
        for each in (None, extent(given.size, given.count, given.coarse).prod(1), given.count)
    )
    report = {
        "components": {str(each): int((given.count == each).sum()) for each in np.unique(given.count).tolist()},
        "mixtures": len(np.unique(given.component)),
        "tiles": counts.astype(int).tolist(),
        "samples": samples.astype(int).tolist(),
        "components by sheet": (many / np.maximum(counts, 1)).round(2).tolist(),
        "pages": len(texels),
        "apart": kept.apart > 1,
        "expected gain of states apart": kept.gain,
        "tiles of blocks": int(given.second.sum()),
        "coarse components": int(given.coarse.sum()),
        "error by components": {str(each.rank): each.left for each in tried},
        "units": unit.tolist(),
        "seconds": stages.seconds,
    }
    # Apart, all states have the factors of one, times their units.
    factor = (given.factors * unit[:, None] / scale[:, None]).transpose(1, 0, 2).astype(np.float32)
    levels = tuple(rows[sheets:stride])
    parts = (tuple(rows[:sheets]), np.ascontiguousarray(factor), texels, lut, levels, report)
    second = {"blocks": blocks[0], "block_texels": blocks[1].astype(np.float16)} if blocks else {}
    return SceneModel(scene.name, scene.source, profile, scene.states, *parts, **second, later=tuple(rows[stride:]))


def _of_texels(weight: np.ndarray) -> np.ndarray:
    """Weights of texels [H, W] of those of their quarters [2 H, 2 W]."""
    return weight.reshape(weight.shape[0] // 2, 2, -1, 2).sum((1, 3))


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
                    light[texture][place], owner[texture][place] = values.cpu().numpy(), number[:, None, None]
                    share[texture][place] = weights.cpu().numpy()
                    np.maximum.at(largest, number, values.amax((1, 2)).cpu().numpy())
    scale = np.divide(_BRIGHT, largest, out=np.ones_like(largest), where=largest > 0)
    first, second = (texels * scale[number] for texels, number in zip(light, owner, strict=True))
    pages = [encode(page, BLOCKS, weight, tiles.device) for page, weight in zip(second, share[1], strict=True)]
    blocks = tuple(np.stack(each) for each in zip(*pages, strict=True))
    return pack_rgb9e5(first), blocks, scale.astype(np.float64)


def _table(tiles: SceneTiles, layout: Layout, given: Allocated) -> np.ndarray:
    """T_c, uint16 [Hc, Wc, 4]. Tiles without a weight are black."""
    columns = np.array([each[1] for each in layout.grid])[tiles.plane]
    row = tiles.index // columns + np.array(layout.row)[tiles.plane]
    column = tiles.index % columns + np.array(layout.column)[tiles.plane]
    table = np.zeros((*layout.shape, 4), np.uint16)
    table[row, column] = pack_tiles(
        given.first, given.size, given.component, given.count, given.page, given.second, given.coarse
    )
    return table
