"""The method "tiles": each tile of the lightmap at its own resolution, with the samples of least squared error.

The lightmap is cut into tiles of B x B texels whose borders lie on texel centres. A tile becomes nx x ny samples, 1 to
B + 1 per axis, the outermost on its borders, and light is interpolated bilinearly between them; with B + 1 samples per
axis this gives the lightmap itself. Tiles share no sample, so each is a small weighted least-squares problem, which is
solved for every size. The error of a tile is measured with its samples as stored. The sizes are then allocated within a
budget, `wlm.atlas.tiles.layout`.

This replaces sections 3.1 to 3.3 of lightmap-uv-clustering-cascade: sharp shadows get many samples and evenly lit walls
few, even within one triangle, which the paper's method can't do (section 5.1).
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from wlm import interop
from wlm.atlas import colour
from wlm.atlas.data import LightmappedScene
from wlm.atlas.model import (
    BLOCK_SIDE,
    BLOCKS,
    LUT_BITS,
    SOURCE_BITS,
    TEXELS,
    AtlasModel,
    Profile,
    SheetPlace,
    first_block_code,
    pack_entries,
    tile_counts,
)
from wlm.atlas.stages import Stages
from wlm.atlas.tiles.layout import Layout, Size, layout, sizes_of, texels_of
from wlm.atlas.weights import FineGrid, weights
from wlm.formats.exr import HALF_MAX
from wlm.formats.parts import Part
from wlm.ops.tensors import on_stream
from wlm.system import Meter
from wlm_kernels.atlas import solve as kernels

SUPERSAMPLING = 2
"""Points per texel and axis at which a tile is fitted."""

_AT_ONCE, _AT_ONCE_CUDA = 8192, 65536  # tiles; other numbers change the last bits of products on a GPU
_SHARES = tuple((k + 0.5) / SUPERSAMPLING for k in range(SUPERSAMPLING))  # weight of the second texel at a point
# Conjugate gradient rounds from the unweighted solution: for curves, for curves of blocks, and for stored samples.
_ROUGH, _MEDIUM, _FINE = 3, 10, 24
# Ridge regularisation: a sample that reaches no point with a weight stays near the unweighted solution.
_RIDGE = 1e-4
# A bit must save this fraction of one texel's squared range, which is the rounding of a half float there.
_LEAST_GAIN = 2.0**-24 / 48


@dataclass(frozen=True)
class Tiles:
    """The light of the T tiles that have a weight above 0, with their numbers in the grid, int64 [T], row by row.

    `light`, float [T, 3, m * m], is at m x m points of the tile, row by row, at (k + 0.5) / m of its side along each
    axis; `weight`, float [T, m * m], is each point's weight in the squared error, with a sum of 1 over all tiles. A
    tile has `size` texels along a side.
    """

    index: torch.Tensor
    light: torch.Tensor
    weight: torch.Tensor
    size: int


def fit_tiles(
    scene: LightmappedScene, grid: FineGrid, profile: Profile, seed: int, stages: Stages
) -> AtlasModel | None:
    """Compresses a scene of one sheet and state to tiles; None if even the smallest tiles exceed the budget."""
    (sheet,) = scene.sheets
    with stages("weights"):
        tiles = cut(grid.light, weights(scene, grid, profile, seed), profile.tile, grid.device)
    height, width = sheet.mask.shape
    rows, columns = tile_counts(height, width, profile.tile)
    bits = profile.budget * height * width * SOURCE_BITS
    room = bits - rows * columns * LUT_BITS
    sizes = sizes_of(profile)
    if room < len(tiles.index) * min(size.bits for size in sizes):
        return None
    with stages("curves"):
        error = curves(tiles, sizes, stages)
    with stages("allocate"):
        packed = layout(error, sizes, room, least_gain(grid))
        if packed is None:
            return None
    with stages("solve"):
        samples = solved(tiles, sizes, packed.chosen)
    with stages("write"):
        return composed_model(scene, profile, samples, sizes, packed, tiles.index.cpu().numpy(), grid.device)


def composed_model(
    scene: LightmappedScene,
    profile: Profile,
    samples: list[tuple[np.ndarray, torch.Tensor, torch.Tensor]],
    sizes: list[Size],
    packed: Layout,
    index: np.ndarray,
    device: str,
) -> AtlasModel:
    """Makes the model from the tiles' solved samples, sizes and places, and numbers in the grid, int64 [T]."""
    size, mixed, code = scene.sheets[0].mask.shape, profile.colour == "mixed", first_block_code(profile.colour)
    counts = tile_counts(*size, profile.tile)
    kinds = np.array([(each.nx, each.ny, each.step > 1, each.second) for each in sizes])[packed.chosen]
    sides = kinds[:, :2]
    images = [(torch.zeros((*shape, 3), device=device), torch.zeros(shape, device=device)) for shape in packed.shapes]
    for members, values, weight in samples:
        each = sizes[packed.chosen[members[0]]]
        # Copying a large texture through the host would take seconds.
        at = tuple(torch.from_numpy(part).to(device) for part in texels_of(packed.first[members], each.nx, each.ny))
        images[each.second][0][at], images[each.second][1][at] = values, weight
    formats = (TEXELS, BLOCKS) if mixed else (profile.colour,)
    first, *second = (
        {
            name: part[None]
            for name, part in colour.quantise(texels.clamp_(max=HALF_MAX), format, weight, device).items()
        }
        for (texels, weight), format in zip(images, formats, strict=True)
    )
    textures = first | ({"blocks": second[0]["blocks"], "block_texels": second[0]["texels"]} if mixed else {})
    # All other tiles of the grid show the first texel or block.
    total = counts[0] * counts[1]
    place, side = np.zeros((total, 2), int), np.full((total, 2), 1 if code else BLOCK_SIDE)
    blocks = np.full(total, not code)
    place[index], side[index], blocks[index] = packed.first, sides, kinds[:, 2]
    lut = pack_entries(place, side, blocks, code).reshape(*counts, 2)
    report = {
        "tiles": len(index),
        "of tiles": counts[0] * counts[1],
        "samples": int(sides.prod(1).sum()),
        "constant tiles": int((sides == 1).all(1).sum()),
    }
    if mixed:
        report["tiles of blocks"] = int(kinds[:, 3].sum())
    sheets = (SheetPlace(scene.sheets[0].name, *size, 0, 0, *counts),)
    settings = (scene.name, scene.source, profile, "tiles", profile.colour, scene.states, sheets)
    return AtlasModel(*settings, **textures, lut=lut, report=report)


def least_gain(grid: FineGrid) -> float:
    """Returns the least squared error that a bit must save to be spent, in proportion to the light's range squared."""
    low, high = grid.light[grid.mask].aminmax()
    return float(high - low) ** 2 * _LEAST_GAIN / grid.mask.numel()


def cut(image: torch.Tensor | np.ndarray, weight: torch.Tensor | np.ndarray, size: int, device: str) -> Tiles:
    """Cuts a lightmap, float [H, W, 3] without gaps, into tiles. Only tiles with a weight above 0 are returned;
    `weight`, float64 [2 H, 2 W], has the weights of quarters of texels, at least one above 0."""
    index, share = weighted(torch.as_tensor(weight, device=device), size)
    columns = tile_counts(*image.shape[:2], size)[1]
    light = torch.as_tensor(image, dtype=torch.float32, device=device)
    parts = [tile_light(patches(light, each, columns, size)) for each in index.split(_AT_ONCE)]
    return Tiles(index, torch.cat(parts), share, size)


def weighted(weight: torch.Tensor, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Selects the tiles with a weight above 0 and returns their `index` and `weight`, as in `Tiles`. The argument has
    the weights of quarters of texels, float64 [2 H, 2 W], at least one above 0."""
    rows, columns = tile_counts(*(side // 2 for side in weight.shape), size)
    m = SUPERSAMPLING * size
    folded = _folded(_folded(weight, rows * m).T, columns * m).T
    cells = folded.reshape(rows, m, columns, m).transpose(1, 2).reshape(rows * columns, m * m)
    index = torch.nonzero(cells.any(1))[:, 0]
    return index, (cells[index] / weight.sum()).float()


def patches(image: torch.Tensor, index: torch.Tensor, columns: int, size: int) -> torch.Tensor:
    """Cuts the texels of tiles, [T, B + 1, B + 1, ...], out of an image [H, W, ...], whose last texels are repeated."""
    step = torch.arange(size + 1, device=image.device)
    row = ((index // columns)[:, None] * size + step).clamp(max=image.shape[0] - 1)
    column = ((index % columns)[:, None] * size + step).clamp(max=image.shape[1] - 1)
    return image[row[:, :, None], column[:, None, :]]


def tile_light(patch: torch.Tensor) -> torch.Tensor:
    """Returns light at the points of tiles, as `Tiles.light`, from the tiles' texels [T, B + 1, B + 1, 3]."""
    near, far = patch[:, :-1], patch[:, 1:]
    down = torch.stack([near + share * (far - near) for share in _SHARES], 2).flatten(1, 2)
    near, far = down[:, :, :-1], down[:, :, 1:]
    points = torch.stack([near + share * (far - near) for share in _SHARES], 3).flatten(2, 3)
    return points.permute(0, 3, 1, 2).flatten(2).contiguous()


def _folded(weight: torch.Tensor, points: int) -> torch.Tensor:
    """Sums weights [2 H, N] to one weight per point of tiles along the first axis; weights beyond the outermost texel
    centres are added to the nearest point."""
    padded = weight.new_zeros((points, weight.shape[1]))
    inner = weight[1:-1]
    padded[: len(inner)] = inner
    padded[0] += weight[0]
    padded[max(len(inner), 1) - 1] += weight[-1]
    return padded


def solve(tiles: Tiles, nx: int, ny: int, rounds: int = _FINE, columns: torch.Tensor | None = None) -> torch.Tensor:
    """Returns the samples of least weighted squared error, float [T, ny, nx, 3], for tiles that all have nx x ny
    samples, by at most `rounds` iterations of conjugate gradients on the normal equations of each tile and channel,
    starting from the solution for equal weights. `columns` is from `fitted_columns` for `ny`, None to compute it."""
    with on_stream(tiles.light.device):
        grid, space = _grid(tiles, nx, ny), functools.partial(_empty, tiles)
        light, weight = (interop.to_warp(_laid_out(values)) for values in (tiles.light, tiles.weight))
        scale = interop.to_warp(1.0 / tiles.weight.mean(1))
        system = kernels.System()
        system.own, system.right, system.down, system.cross, system.diagonal = (
            interop.to_warp(space(nx * ny)) for _ in range(5)
        )
        kernels.gather_system(weight, scale, grid, system)
        # With equal weights the equations separate by axis.
        columns = fitted_columns(tiles, ny) if columns is None else columns
        start = _laid_out((columns @ _axis(nx, grid.points, str(tiles.light.device))[3].T).flatten(2))
        *work, out = (space(3, nx * ny) for _ in range(4))
        ridge = _RIDGE * grid.points**2 / (nx * ny)
        arrays = [interop.to_warp(each) for each in (start, *work, out)]
        # In exact arithmetic the solution needs at most one round per sample.
        rounds = min(rounds, 2 * nx * ny)
        kernels.solve(light, weight, scale, grid, system, ridge, rounds, arrays[0], arrays[1:4], arrays[4])
    return out.unflatten(2, (ny, nx)).permute(0, 2, 3, 1)


def fitted_columns(tiles: Tiles, ny: int) -> torch.Tensor:
    """Returns the ny samples of least squared error along y at each column of points, float [T, 3, ny, m]."""
    points = SUPERSAMPLING * tiles.size
    return _axis(ny, points, str(tiles.light.device))[3] @ tiles.light.unflatten(2, (points, points))


def _grid(tiles: Tiles, nx: int, ny: int) -> kernels.Grid:
    grid = kernels.Grid()
    grid.points, grid.nx, grid.ny = SUPERSAMPLING * tiles.size, nx, ny
    axes = [_axis(samples, grid.points, str(tiles.light.device)) for samples in (nx, ny)]
    (grid.first_x, grid.share_x), (grid.first_y, grid.share_y) = (
        [interop.to_warp(part) for part in axis[:2]] for axis in axes
    )
    return grid


def _laid_out(values: torch.Tensor) -> torch.Tensor:
    """Arranges values [T, ...] in memory; on a GPU the axis of tiles is contiguous, since threads read many at once."""
    if values.device.type == "cpu":
        return values.contiguous()
    return values.movedim(0, -1).contiguous().movedim(-1, 0)


def _empty(tiles: Tiles, *shape: int) -> torch.Tensor:
    """Allocates an array float [T, ...] in the memory layout that `_laid_out` gives."""
    count, device = len(tiles.index), tiles.light.device
    if device.type == "cpu":
        return torch.empty((count, *shape))
    return torch.empty((*shape, count), device=device).movedim(-1, 0)


@functools.cache
def _axis(samples: int, points: int, device: str) -> tuple[torch.Tensor, ...]:
    """Returns the linear interpolation from samples to points along an axis: the sample before each point and the
    weight of the next one, [points] each; the matrix, float [points, samples]; and its pseudoinverse, which is slow to
    compute on a GPU."""
    place, row = (torch.arange(points) + 0.5) / points * (samples - 1), torch.arange(points)
    first = place.floor().clamp(max=max(samples - 2, 0))
    share, before = place - first, first.long()
    matrix = torch.zeros((points, samples))
    matrix[row, before] = 1.0 - share
    if samples > 1:
        matrix[row, before + 1] = share
    inverse = torch.linalg.pinv(matrix.double()).float()
    return tuple(each.to(device) for each in (before.int(), share, matrix, inverse))


def errors(tiles: Tiles, samples: torch.Tensor) -> torch.Tensor:
    """Returns the weighted squared error of samples [T, ny, nx, 3] for each tile, averaged over the channels, float64
    [T]. The sum over all tiles is the MSE."""
    result = torch.empty((len(samples), 3), dtype=torch.float64, device=samples.device)
    flat = samples.permute(0, 3, 1, 2).flatten(2)
    with on_stream(samples.device):
        light, weight, stored = (interop.to_warp(_laid_out(values)) for values in (tiles.light, tiles.weight, flat))
        grid = _grid(tiles, samples.shape[2], samples.shape[1])
        kernels.errors(light, weight, grid, stored, interop.to_warp(result))
    return result.mean(1)


def sample_weights(tiles: Tiles, nx: int, ny: int) -> torch.Tensor:
    """Returns the weight of each sample's squared error, float [T, ny, nx]."""
    points, device = SUPERSAMPLING * tiles.size, str(tiles.weight.device)
    down, across = (_axis(count, points, device)[2].square() for count in (ny, nx))
    return down.T @ tiles.weight.unflatten(1, (points, points)) @ across


def curves(tiles: Tiles, sizes: list[Size], stages: Stages) -> torch.Tensor:
    """Returns the error of every tile at every size, float64 [sizes, T] on the tiles' device, with samples rounded as
    the size's format stores them. The checkpoint of `stages` saves the errors at each size as one batch."""
    meter, pieces = Meter(stages.progress, "curves", len(sizes)), [piece for _, piece in _pieces(tiles)]
    table = {"error": Part(np.float64, (len(tiles.index),), least=0.0)}
    columns: dict[int, list[torch.Tensor]] = {}  # those of one number of rows, which the next sizes share

    def at_size(i: int, size: Size) -> dict[str, torch.Tensor]:
        if meter.due(i):
            meter.report(i)
        result, rounds = [], _ROUGH if size.step == 1 else _MEDIUM
        if size.ny not in columns:
            columns.clear()
            columns[size.ny] = [fitted_columns(piece, size.ny) for piece in pieces]
        for piece, own in zip(pieces, columns[size.ny], strict=True):
            samples = solve(piece, size.nx, size.ny, rounds, own).clamp(min=0.0)
            weight = sample_weights(piece, size.nx, size.ny) if size.step > 1 else None
            result.append(errors(piece, colour.stored(samples, weight, size.format)))
        return {"error": torch.cat(result)}

    kept = (stages.batch(i, table, functools.partial(at_size, i, size))["error"] for i, size in enumerate(sizes))
    return torch.stack([torch.as_tensor(error, device=tiles.index.device) for error in kept])


def solved(tiles: Tiles, sizes: list[Size], chosen: np.ndarray) -> list[tuple[np.ndarray, torch.Tensor, torch.Tensor]]:
    """Solves for the samples of every tile at its own size; `chosen`, int [T], has indices of sizes. Returns groups of
    tiles of one size: the tiles' numbers, int [n]; their samples, float32 [n, ny, nx, 3], not negative; and the weights
    of the samples' squared errors [n, ny, nx]. Samples and weights are on the tiles' device."""
    result = []
    for number in np.unique(chosen).tolist():
        size, members = sizes[number], np.flatnonzero(chosen == number)
        rows = torch.from_numpy(members).to(tiles.index.device)
        group = Tiles(tiles.index[rows], tiles.light[rows], tiles.weight[rows], tiles.size)
        for part, piece in _pieces(group):
            values = solve(piece, size.nx, size.ny).clamp(min=0.0)
            result.append((members[part], values, sample_weights(piece, size.nx, size.ny)))
    return result


def _pieces(tiles: Tiles) -> Iterator[tuple[slice, Tiles]]:
    step = _AT_ONCE if tiles.light.device.type == "cpu" else _AT_ONCE_CUDA
    for first in range(0, len(tiles.index), step):
        part = slice(first, first + step)
        yield part, Tiles(tiles.index[part], _laid_out(tiles.light[part]), _laid_out(tiles.weight[part]), tiles.size)
