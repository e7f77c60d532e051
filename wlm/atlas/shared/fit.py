"""Compresses the lightmaps of several sheets and states to one model, whose tiles are sums of components.

Each state's light is divided by its variation, so that errors count as in PSNR (`weights`). Tiles are grouped, and each
group shares the factors by which one, two or more components are summed in each state (`mixture`). Each tile has an
error curve for each number of components (`curves`) and is weighted by the error of the views that show it (`balance`).
Numbers of components and sizes are allocated to the tiles of all sheets at once (`allocation`), so that one more bit
gains as much in every object.

States that have little in common, such as a shadow mask and the light of a sky, lose by sharing sizes. Therefore
separate tiles for each state are tried as well, and the better result is kept (`sharing`), so that a scene is no worse
than with each state compressed alone.
"""

import numpy as np
import torch

from wlm.atlas.colour import quantise
from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import BLOCK_SIDE, BLOCKS, TEXELS, AtlasModel, Profile, coarse_place, extent, pack_tiles
from wlm.atlas.shared.allocation import Allocated
from wlm.atlas.shared.curves import Candidate, SceneTiles
from wlm.atlas.shared.sharing import Cut, fitted, planes_of
from wlm.atlas.shared.weights import peaks_of, scales, scene_weights, variation
from wlm.atlas.stages import Stages
from wlm.atlas.tiles.fit import Tiles, solved
from wlm.atlas.tiles.layout import Size, texels_of
from wlm.interop import moved

_AT_ONCE = 1024  # tiles
_BRIGHT = 1024.0  # a component's largest texel after scaling: RGB9E5 has as many octaves below it as above


def fit_shared(scene: LightmappedScene, profile: Profile, seed: int, stages: Stages) -> AtlasModel:
    """Compresses all lightmaps of a scene into one lookup texture and one or two colour textures.

    The model's report has the numbers of tiles, samples and components of each sheet, and the error for each number of
    components that was tried.
    """
    device = stages.device
    with stages("weights"):
        peak = peaks_of(scene)
        varies = variation(scene, peak, device)
        weights = scene_weights(scene, varies, profile, seed, device)
        of_texels = [each.reshape(each.shape[0] // 2, 2, -1, 2).sum((1, 3)) for each in weights]
        unit = peak * scales(varies, of_texels)
        planes = planes_of(scene, weights, profile.mips, device)
    kept = fitted(scene, planes, unit, varies, profile, seed, stages)
    tiles, tried, given, rows = kept.cut.tiles, kept.tried, kept.given, kept.cut.places
    stride = len(rows) // kept.states
    with stages("solve"):
        textures, scale = _textures(tiles, tried, given)
    lut = np.ascontiguousarray(_lookup(kept.cut, given)[..., : kept.numbers])
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
        "pages": len(textures["texels"]),
        "separate": kept.states > 1,
        "expected gain of separate tiles": kept.gain,
        "tiles of blocks": int(given.second.sum()),
        "coarse components": int(given.coarse.sum()),
        "error by components": {str(each.rank): each.left for each in tried},
        "units": unit.tolist(),
    }
    # With separate tiles every state has the factors of a single state, times its own unit.
    factor = (given.factors * unit[:, None] / scale[:, None]).transpose(1, 0, 2).astype(np.float32)
    textures |= {"lut": lut, "factor": np.ascontiguousarray(factor)}
    places = {"sheets": tuple(rows[:sheets]), "levels": tuple(rows[sheets:stride]), "later": tuple(rows[stride:])}
    settings = (scene.name, scene.source, profile, "shared", "mixed" if "blocks" in textures else TEXELS, scene.states)
    return AtlasModel(*settings, **places, **textures, report=report)


def _textures(tiles: SceneTiles, tried: list[Candidate], given: Allocated) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Solves for the samples of all components and writes them to the colour textures. Returns arrays of the model by
    name, and the factor by which each component was multiplied to use the format's range, float64 [C, 3]."""
    light = [np.zeros((*shape, 3), np.float32) for shape in given.shapes]
    owner, share = ([np.zeros(shape, kind) for shape in given.shapes] for kind in (np.int32, np.float32))
    largest = np.zeros((len(given.factors), 3), np.float32)
    for rank, each in enumerate(tried):
        members = np.flatnonzero(given.rank == rank)
        for part in np.array_split(members, -(-len(members) // _AT_ONCE)) if len(members) else ():
            texels, weight = tiles.light(part)
            mixtures, mixture = moved(each.mixtures, tiles.device), torch.from_numpy(each.number[part]).to(tiles.device)
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
    textures = quantise(first, TEXELS, device=tiles.device)
    pages = [quantise(page, BLOCKS, weight, tiles.device) for page, weight in zip(second, share[1], strict=True)]
    if pages:
        names = {"blocks": "blocks", "block_texels": "texels"}
        textures |= {name: np.stack([page[part] for page in pages]) for name, part in names.items()}
    return textures, scale.astype(np.float64)


def _lookup(cut: Cut, given: Allocated) -> np.ndarray:
    """Makes the lookup texture T_c, uint16 [Hc, Wc, 4]. Tiles without a weight are black."""
    tiles, places = cut.tiles, np.array([(each.row, each.column, each.columns) for each in cut.places])
    first, left, columns = places[tiles.plane].T
    row, column = first + tiles.index // columns, left + tiles.index % columns
    table = np.zeros((*cut.shape, 4), np.uint16)
    table[row, column] = pack_tiles(
        given.first, given.size, given.component, given.count, given.page, given.second, given.coarse
    )
    return table
