"""From a scene's lightmaps to one model: components of all states, tiles of all sheets, one allocation.

The states' light is divided by its peak, so that each counts by its PSNR. Few components are fitted to it (`mixture`);
their tiles are those of `wlm.atlas.tiles`. For a tile and a size the squared error of all states is

    sum_m || sum_k f[m, k] r_k ||² = sum_j || sum_k L[k, j] r_k ||²,    F^T F = L L^T (Cholesky),

with r_k the residual of component k; least squares are linear, so that the curve is had by fitting the K mixtures of
components under L, not the M states. Sizes are then allocated to the tiles of all sheets at once: one more sample gains
as much in every object. The number of components is the one that leaves the least error, of a sample of the tiles.
"""

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from wlm import interop
from wlm.atlas.layout import Size, allocate, place, texels_of
from wlm.atlas.model import LUT_BITS, MOST_SIZE, TEXELS, pack_entries, tile_counts
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.mixture import components, factorise
from wlm.atlas.scene.model import FACTOR_BITS, TEXEL_BITS, SceneModel, SceneProfile, SheetPlace
from wlm.atlas.scene.seen import scene_weights
from wlm.atlas.stages import Stages, one_thread
from wlm.atlas.tiles import Tiles, cut, errors, patches, solve, solved, tile_light, weighted
from wlm.errors import WlmError
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.system import Meter, OnProgress

_SAMPLES = 8_000  # texels that factors are fitted to
_TRIED = 256  # tiles that a number of components is tried on
_COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64)
_ROUGH = 3  # rounds of conjugate gradients of a curve
_AT_ONCE = 8192  # tiles
_PERCENTILE = 99.9  # of a state's light: its peak
_BRIGHT = 1024.0  # what a component's largest texel becomes: RGB9E5 has as many octaves below it as above
_LEAST_GAIN = 2.0**-24
_NO_ROOM = "budget: {:g} is less than the smallest tiles and their table take: expected more"
_WIDTHS = np.linspace(0.7, 1.5, 9)  # of a page, over the square root of its number of samples


@dataclass(frozen=True, eq=False)
class _SceneTiles:
    """The tiles of all sheets that have a weight.

    Attributes:
        component: For each component its light; they share index and weight. `index` counts within a sheet.
        sheet: int [T], their sheets, ascending.
    """

    component: list[Tiles]
    sheet: np.ndarray


@dataclass(frozen=True, eq=False)
class _Layout:
    """Sheets of tiles.

    Attributes:
        grid: Rows and columns of tiles of each sheet.
        row, column: The first entry of each sheet in T_c.
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
        The model; its report says how many tiles and samples each sheet has, and the error left by each number of
        components that was tried.

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
    layout = _laid_out(scene, profile.tile)
    peak = _peaks(scene, weights)
    with stages("components"):
        light, weight = _sampled(scene, weights, peak, seed)
        chosen, tried = _choose(scene, weights, peak, light, weight, layout, profile, stages)
        factor = factorise(np.sqrt(weight)[:, None] * light, chosen)
    with stages("tiles"):
        tiles = _tiles(_parts(scene, factor, peak), weights, profile.tile, device)
    with stages("curves"):
        sizes = _sizes(profile)
        error = _curves(tiles, sizes, factor, stages)
    with stages("allocate"):
        room = _room(scene, profile, layout, chosen)
        sheet_of = tiles.sheet
        size, first, page, shape = _placed(error, np.array(sizes), room, sheet_of, profile)
    with stages("solve"):
        texels, scale = _texels(tiles, size, first, page[sheet_of], shape, int(page.max()) + 1)
    lut = _table(tiles, layout, size, first)
    sheets = tuple(
        SheetPlace(sheet.name, *sheet.mesh.mask.shape, row, column, *grid, int(number))
        for sheet, row, column, grid, number in zip(
            scene.sheets, layout.row, layout.column, layout.grid, page, strict=True
        )
    )
    samples, counts = (np.bincount(sheet_of, each, len(sheets)).astype(int) for each in (size.prod(1), None))
    report = {
        "components": chosen,
        "tiles": counts.tolist(),
        "samples": samples.tolist(),
        "pages": int(page.max()) + 1,
        "error by components": tried,
        "peaks": peak.tolist(),
        "seconds": stages.seconds,
    }
    factor = (factor * peak[:, None, None] / scale).astype(np.float32)
    return SceneModel(scene.name, scene.source, profile, scene.states, sheets, factor, texels, lut, report)


def _laid_out(scene: LightmappedScene, tile: int) -> _Layout:
    """Places the sheets' tables in one, on shelves."""
    grid = [tile_counts(*sheet.mesh.mask.shape, tile) for sheet in scene.sheets]
    across = np.array([(columns, rows) for rows, columns in grid])
    best = None
    for share in _WIDTHS:
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


def _sampled(
    scene: LightmappedScene, weights: list[np.ndarray], peak: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Light over its peak at random texels, float64 [M, N, 3], and their weights, mean 1."""
    light, share = [], []
    for sheet, weight in zip(scene.sheets, weights, strict=True):
        texel = weight.reshape(weight.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3))
        row, column = np.nonzero(texel)
        light.append(sheet.frames[:, row, column])
        share.append(texel[row, column])
    light, share = np.concatenate(light, axis=1), np.concatenate(share)
    if len(share) > _SAMPLES:
        at = np.random.default_rng(seed).choice(len(share), _SAMPLES, replace=False)
        light, share = light[:, at], share[at]
    return light / peak[:, None, None], share / share.mean()


def _choose(
    scene: LightmappedScene,
    weights: list[np.ndarray],
    peak: np.ndarray,
    light: np.ndarray,
    weight: np.ndarray,
    layout: _Layout,
    profile: SceneProfile,
    stages: Stages,
) -> tuple[int, dict[str, float]]:
    """The number of components, and the error that each that was tried leaves, mean over the states.

    It is the error that no mixture of the components removes, and that of tiles as many samples as there is room for;
    of the latter a few tiles stand for all.
    """
    states = len(scene.states)
    counts = [count for count in _COUNTS if count < states] + [states]
    if profile.components:
        counts = [min(profile.components, states)]
    counts = [count for count in counts if _fits(scene, profile, layout, weights, count)]
    if not counts:
        raise WlmError(_NO_ROOM.format(profile.budget))
    if len(counts) == 1:
        return counts[0], {}
    sizes, tried = _sizes(profile), {}
    best, least = counts[0], math.inf
    texels, few_weight, part = _few(scene, weights, peak, profile.tile)
    share = float(few_weight.double().sum())
    for count in counts:
        factor = factorise(np.sqrt(weight)[:, None] * light, count)
        rest = np.einsum("mkc,knc->mnc", factor, components(light, factor)) - light
        lost = float(np.square(rest).mean(axis=(0, 2)) @ weight) / len(weight)
        patch = components(texels.reshape(states, -1, 3), factor).reshape(count, *texels.shape[1:])
        few = _few_tiles(patch, few_weight, profile.tile, stages.device)
        error = _curves(few, sizes, factor, Stages(stages.device))
        room = _room(scene, profile, layout, count) * part
        number = allocate(error, np.array(sizes).prod(1).astype(float), room, 0.0)
        left = lost + float(error[number, np.arange(len(number))].sum()) / max(share, 1e-9)
        tried[str(count)] = left
        if left < least:
            best, least = count, left
        elif left > 1.5 * least:
            break
    return best, tried


def _few(
    scene: LightmappedScene, weights: list[np.ndarray], peak: np.ndarray, tile: int
) -> tuple[np.ndarray, torch.Tensor, float]:
    """About `_TRIED` of the tiles of all sheets, evenly.

    Returns:
        The light of their texels over its peak, float32 [M, T, B + 1, B + 1, 3]; their points' weights, float [T, P],
        as fractions of the whole scene's; and their number as a fraction of all.
    """
    total = sum(float(each.sum()) for each in weights)
    cuts = [weighted(torch.from_numpy(each), tile) if each.any() else None for each in weights]
    count = sum(len(each[0]) for each in cuts if each)
    step, begin, texels, shares = max(1, count // _TRIED), 0, [], []
    for sheet, weight, each in zip(scene.sheets, weights, cuts, strict=True):
        if each is None:
            continue
        index, share = (values[-begin % step :: step] for values in each)
        begin += len(each[0])
        columns = tile_counts(*sheet.mesh.mask.shape, tile)[1]
        # Texels first, then states.
        frames = torch.from_numpy(sheet.frames).permute(1, 2, 0, 3)
        texels.append(patches(frames, index, columns, tile).permute(3, 0, 1, 2, 4).numpy())
        shares.append(share * (float(weight.sum()) / total))
    light = np.concatenate(texels, 1) / peak[:, None, None, None, None].astype(np.float32)
    return light, torch.cat(shares), len(light[0]) / count


def _few_tiles(patch: np.ndarray, weight: torch.Tensor, tile: int, device: str) -> _SceneTiles:
    """Tiles of the components' texels, float32 [K, T, B + 1, B + 1, 3]."""
    index, weight = torch.arange(len(weight), device=device), weight.to(device)
    light = [tile_light(torch.from_numpy(each).to(device)) for each in patch]
    return _SceneTiles([Tiles(index, each, weight, tile) for each in light], np.zeros(len(weight), int))


def _tile_weight(weight: np.ndarray, tile: int) -> np.ndarray:
    """Weights summed over squares of the size of a tile: which tiles there are, about."""
    side = 2 * tile
    padded = np.pad(weight, ((0, -weight.shape[0] % side), (0, -weight.shape[1] % side)))
    return padded.reshape(padded.shape[0] // side, side, -1, side).sum(axis=(1, 3))


def _fits(
    scene: LightmappedScene, profile: SceneProfile, layout: _Layout, weights: list[np.ndarray], count: int
) -> bool:
    needed = sum(int((_tile_weight(each, profile.tile) > 0).sum()) for each in weights)
    return _room(scene, profile, layout, count) >= 1.1 * needed


def _room(scene: LightmappedScene, profile: SceneProfile, layout: _Layout, count: int) -> float:
    """Texels that each of the components may have."""
    bits = profile.budget * scene.source_bits - math.prod(layout.shape) * LUT_BITS
    return (bits - len(scene.states) * count * FACTOR_BITS) / (TEXEL_BITS * count)


def _parts(scene: LightmappedScene, factor: np.ndarray, peak: np.ndarray) -> list[np.ndarray]:
    """The components of each sheet, float32 [K, H, W, 3]."""
    parts = []
    for sheet in scene.sheets:
        states, height, width, _ = sheet.frames.shape
        light = (sheet.frames / peak[:, None, None, None].astype(np.float32)).reshape(states, -1, 3)
        parts.append(components(light, factor).reshape(-1, height, width, 3))
    return parts


def _tiles(parts: list[np.ndarray], weights: list[np.ndarray], tile: int, device: str) -> _SceneTiles:
    """Cuts the components of all sheets into tiles, whose weights add up to 1."""
    total = sum(float(each.sum()) for each in weights)
    cuts = [
        [cut(each, weight, tile, device) for each in part] if weight.any() else []
        for part, weight in zip(parts, weights, strict=True)
    ]
    sheet = np.repeat(np.arange(len(cuts)), [len(each[0].index) if each else 0 for each in cuts])
    shares = [float(weight.sum()) / total for weight in weights]
    index = torch.cat([each[0].index for each in cuts if each])
    weight = torch.cat([each[0].weight * share for each, share in zip(cuts, shares, strict=True) if each])
    light = [torch.cat([each[k].light for each in cuts if each]) for k in range(len(parts[0]))]
    return _SceneTiles([Tiles(index, each, weight, tile) for each in light], sheet)


def _sizes(profile: SceneProfile) -> list[tuple[int, int]]:
    sides = range(1, profile.tile + 2)
    return [(nx, ny) for ny in sides for nx in sides]


def _curves(tiles: _SceneTiles, sizes: list[tuple[int, int]], factor: np.ndarray, stages: Stages) -> np.ndarray:
    """The error of every tile at every size, mean over the states, float64 [sizes, T]."""
    roots = [np.linalg.cholesky(_gram(factor[:, :, channel]) / len(factor)) for channel in range(3)]
    root = torch.from_numpy(np.stack(roots, axis=2)).float().to(stages.device)  # [K, K, 3]
    count, each = len(tiles.component), tiles.component[0]
    result, meter = np.zeros((len(sizes), len(tiles.sheet))), Meter(stages.progress, "curves", len(sizes))
    # Every mixture of every tile at once, a bounded number of them.
    step = max(1, _AT_ONCE // count)
    pieces = []
    for at in range(0, len(tiles.sheet), step):
        light = torch.stack([component.light[at : at + step] for component in tiles.component])  # [K, T, 3, P]
        mixed = torch.einsum("ktcp,kjc->jtcp", light, root).reshape(-1, *light.shape[2:])
        index, weight = (values[at : at + step] for values in (each.index, each.weight))
        pieces.append((at, Tiles(index.repeat(count), mixed, weight.repeat(count, 1), each.size)))
    for i, (nx, ny) in enumerate(sizes):
        if meter.due(i):
            meter.report(i)
        for at, piece in pieces:
            error = errors(piece, solve(piece, nx, ny, _ROUGH)).reshape(count, -1).sum(0)
            result[i, at : at + len(error)] = error.cpu().numpy()
    return result


def _gram(weight: np.ndarray) -> np.ndarray:
    """F^T F, with what makes it definite where a channel has a component that it does without."""
    gram = weight.T @ weight
    return gram + 1e-9 * max(float(np.trace(gram)), 1e-30) * np.eye(len(gram))


def _placed(
    error: np.ndarray, sizes: np.ndarray, room: float, sheet_of: np.ndarray, profile: SceneProfile
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]:
    """Allocates sizes to the tiles of all sheets and places them on pages.

    Returns:
        The tiles' sizes, int [T, 2], and first texels, int64 [T, 2]; the page of each sheet, int [S]; rows and columns
        of a page.
    """
    cost, budget, pages = sizes.prod(1).astype(np.float64), room, 1
    while True:
        chosen = sizes[allocate(error, cost, budget, _LEAST_GAIN / error.shape[1])]
        area = np.bincount(sheet_of, chosen.prod(1))
        page = _pages(area, pages)
        first, shape = _packed(chosen, page[sheet_of])
        if max(shape) > MOST_SIZE:
            if pages >= len(area):
                raise WlmError(f"budget: a page would have {max(shape)} texels along a side; tiles allow {MOST_SIZE}")
            pages += 1
            continue
        if shape[0] * shape[1] * pages <= room:
            return chosen, first, page, shape
        if chosen.prod(1).sum() <= error.shape[1]:
            raise WlmError(_NO_ROOM.format(profile.budget))
        budget = min(budget, float(chosen.prod(1).sum())) * min(0.999 * room / (shape[0] * shape[1] * pages), 0.99)


def _pages(area: np.ndarray, pages: int) -> np.ndarray:
    """Deals sheets to pages, the largest first, each to the emptiest page: int [S]."""
    page, full = np.zeros(len(area), int), np.zeros(pages)
    for number in np.argsort(-area, kind="stable"):
        page[number] = full.argmin()
        full[page[number]] += area[number]
    return page


def _packed(size: np.ndarray, page: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Packs tiles on their pages, which have one size: first texels, int64 [T, 2], and rows and columns."""
    groups = [np.flatnonzero(page == number) for number in range(int(page.max()) + 1)]
    most = max(float(size[group].prod(1).sum()) for group in groups)
    best = None
    for share in _WIDTHS:
        width = max(int(size[:, 0].max()), round(share * math.sqrt(most)))
        first, height, widest = np.zeros((len(size), 2), np.int64), 0, 0
        for group in groups:
            first[group], tall = place(size[group], width)
            height = max(height, tall)
            widest = max(widest, int((first[group, 0] + size[group, 0]).max()))
        if best is None or widest * height < best[0]:
            best = widest * height, first, (height, widest)
    return best[1], best[2]


def _texels(
    tiles: _SceneTiles, size: np.ndarray, first: np.ndarray, page: np.ndarray, shape: tuple[int, int], pages: int
) -> tuple[np.ndarray, np.ndarray]:
    """T_p, uint32 [pages K, Hp, Wp], and what each component was multiplied by, float64 [K, 3]."""
    light = np.zeros((pages, len(tiles.component), *shape, 3), np.float32)
    sides, chosen = np.unique(size, axis=0, return_inverse=True)
    sizes = [Size(nx, ny, TEXELS) for nx, ny in sides.tolist()]
    for k, each in enumerate(tiles.component):
        for members, values, _ in solved(each, sizes, chosen.ravel()):
            row, column = texels_of(first[members], values.shape[2], values.shape[1])
            light[page[members, None, None], k, row, column] = values
    largest = light.max(axis=(0, 2, 3)).astype(np.float64)
    scale = np.divide(_BRIGHT, largest, out=np.ones_like(largest), where=largest > 0)
    return pack_rgb9e5(light * scale[None, :, None, None].astype(np.float32)).reshape(-1, *shape), scale


def _table(tiles: _SceneTiles, layout: _Layout, size: np.ndarray, first: np.ndarray) -> np.ndarray:
    """T_c, uint16 [Hc, Wc, 2]. Tiles without a weight show the page's first texel."""
    corner, texels = np.zeros((*layout.shape, 2), int), np.ones((*layout.shape, 2), int)
    index = tiles.component[0].index.cpu().numpy()
    columns = np.array([each[1] for each in layout.grid])[tiles.sheet]
    row = index // columns + np.array(layout.row)[tiles.sheet]
    column = index % columns + np.array(layout.column)[tiles.sheet]
    corner[row, column], texels[row, column] = first, size
    return pack_entries(corner, texels)
