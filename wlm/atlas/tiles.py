"""The method "tiles": each tile of the lightmap at its own resolution, with the samples of least squared error.

The lightmap is cut into tiles of B x B texels whose borders lie on texel centres. A tile becomes nx x ny samples, 1 to
B + 1 per axis, the outermost on its borders, and light is bilinear between them: with B + 1 it is the lightmap itself.
Tiles share no sample, so each is a small weighted least squares problem of its own, solved for every size. The sizes
are then allocated within a budget of samples: each tile has a curve of error against samples, and at the optimum one
more sample gains as much in every tile. That gain, a Lagrange multiplier, is found by bisection.

This replaces sections 3.1 to 3.3 of lightmap-uv-clustering-cascade: sharp shadows get samples and evenly lit walls next
to none, within a triangle too, which that paper names as its limit (section 5.1).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from wlm.atlas import colour
from wlm.atlas.model import (
    BLOCK_SIDE,
    COLOUR_BITS,
    LUT_BITS,
    MOST_SIZE,
    SIDE_BITS,
    SOURCE_BITS,
    AtlasModel,
    Profile,
    pack_entries,
    tile_counts,
)
from wlm.atlas.stages import Stages
from wlm.atlas.weights import FineGrid, weights
from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.exr import HALF_MAX
from wlm.formats.parts import Part, check_parts
from wlm.system import Meter, OnProgress

SUPERSAMPLING = 2
"""Points per texel and axis that a tile is fitted to."""

_AT_ONCE = 8192  # tiles
_ROUGH, _FINE = 3, 40  # rounds of conjugate gradients, from the unweighted solution
# A sample that reaches no point with a weight stays near the unweighted solution.
_RIDGE = 1e-4
_BISECTIONS = 60
# A sample must save this fraction of the squared range, of one texel of the lightmap: half float's rounding there.
_LEAST_GAIN = 2.0**-24
_WIDTHS = np.linspace(0.7, 1.5, 17)  # of T_p, over the square root of its number of samples


@dataclass(frozen=True)
class Tiles:
    """The light of the tiles that have a weight.

    Attributes:
        index: int64 [T], number of the tile in the grid, row by row.
        light: float [T, 3, m * m], at m x m points of the tile, row by row, (k + 0.5) / m along an axis.
        weight: float [T, m * m], weight of a point's squared error, 0 or more; over all tiles they add up to 1.
        size: Texels along a tile.
    """

    index: torch.Tensor
    light: torch.Tensor
    weight: torch.Tensor
    size: int


def fit_tiles(grid: FineGrid, profile: Profile, seed: int, stages: Stages) -> AtlasModel | None:
    """Compresses a lightmap to tiles.

    Args:
        grid: The mesh, with its lightmap, and the device.
        profile: `budget`, `colour`, `tile` and the settings of `weights`.
        seed: Seed of the random views.
        stages: Reports and times the stages.

    Returns:
        The model; None where not even the smallest tiles and their table fit the budget.

    Raises:
        WlmError: A package for the blocks of T_p is missing, or T_p has too many texels along a side.
    """
    mesh = grid.mesh
    with stages("weights"):
        tiles = cut(mesh.filled, weights(grid, profile, seed), profile.tile, grid.device)
    height, width = mesh.mask.shape
    rows, columns = tile_counts(height, width, profile.tile)
    bits = profile.budget * height * width * SOURCE_BITS
    room = (bits - rows * columns * LUT_BITS) / COLOUR_BITS[profile.colour]
    sizes = _sizes(profile)
    if room < len(tiles.index) * min(nx * ny for nx, ny in sizes):
        return None
    with stages("curves"):
        stored = None if profile.colour == "half" else _round_trip(profile.colour)
        error = curves(tiles, sizes, stored, stages.progress, stages.checkpoint)
    with stages("allocate"):
        peak = float(np.ptp(mesh.filled[mesh.mask]))
        least = peak**2 * _LEAST_GAIN / (height * width)
        packed = layout(error, np.array(sizes), room, least, profile.colour != "half")
        if packed is None:
            return None
        chosen, first, shape = packed
    with stages("solve"):
        samples = solved(tiles, chosen)
    with stages("write"):
        texels, lut = _composed(samples, tiles.index.cpu().numpy(), chosen, first, shape, (rows, columns))
        textures = colour.quantise(texels, profile.colour)
    report = {
        "tiles": len(tiles.index),
        "of tiles": rows * columns,
        "samples": int(chosen.prod(1).sum()),
        "constant tiles": int((chosen.prod(1) == 1).sum()),
    }
    settings = (mesh.name, mesh.source, profile, "tiles", profile.colour, height, width)
    return AtlasModel(*settings, **textures, lut=lut, report=report)


def _sizes(profile: Profile) -> list[tuple[int, int]]:
    """The sizes that a tile may have; where T_p is made of blocks, whole ones, so that no block has two tiles."""
    if profile.colour == "half":
        sides = range(1, profile.tile + 2)
    else:
        sides = range(BLOCK_SIDE, profile.tile + 1 + BLOCK_SIDE, BLOCK_SIDE)
        sides = [side for side in sides if side <= 1 << SIDE_BITS]
    return [(nx, ny) for ny in sides for nx in sides]


def _round_trip(codec: str) -> Callable[[torch.Tensor], torch.Tensor]:
    """Encoding and decoding of tiles [T, ny, nx, 3] whose sides are whole blocks."""

    def stored(samples: torch.Tensor) -> torch.Tensor:
        count, ny, nx, _ = samples.shape
        _, decoded = colour.encode(samples.cpu().numpy().reshape(count * ny, nx, 3), codec)
        return torch.from_numpy(decoded.reshape(count, ny, nx, 3)).to(samples)

    return stored


def layout(
    error: np.ndarray, sizes: np.ndarray, room: float, least: float, blocks: bool
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]] | None:
    """Allocates sizes whose rectangles fit in a T_p of a given number of texels, and places them.

    Args:
        error: float64 [sizes, T], `curves`.
        sizes: int [sizes, 2], nx and ny.
        room: Most texels of T_p.
        least: As for `allocate`.
        blocks: Whether T_p is made of blocks.

    Returns:
        The tiles' sizes, int [T, 2]; their first texels, int64 [T, 2]; rows and columns of T_p. None where not even
        the smallest sizes fit.

    Raises:
        WlmError: T_p has more texels along a side than an entry of T_c can name.
    """
    cost, budget = sizes.prod(1).astype(np.float64), room
    step, fewest = BLOCK_SIDE if blocks else 1, error.shape[1] * cost.min()
    while True:
        chosen = sizes[allocate(error, cost, budget, least)]
        total = chosen.prod(1).sum()
        best = None
        for share in _WIDTHS:
            width = max(int(chosen[:, 0].max()), -(-round(share * math.sqrt(total)) // step) * step)
            first, height = place(chosen, width)
            # No shelf may reach as far as the width allows.
            width = int((first[:, 0] + chosen[:, 0]).max())
            if best is None or width * height < best[0]:
                best = width * height, first, (height, width)
        area, first, shape = best
        if max(shape) > MOST_SIZE:
            raise WlmError(f"budget: T_p would have {max(shape)} texels along a side; tiles allow {MOST_SIZE}")
        if area <= room:
            return chosen, first, shape
        if total <= fewest:
            return None
        # The area lost between shelves is about the same next time.
        budget = min(budget, total) * min(0.999 * room / area, 0.99)


def _composed(
    samples: list[np.ndarray],
    index: np.ndarray,
    sizes: np.ndarray,
    first: np.ndarray,
    shape: tuple[int, int],
    counts: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """T_p, float32, and T_c. Tiles without a weight show the texture's first texel."""
    texels = np.zeros((*shape, 3), np.float32)
    for values, (x, y), (nx, ny) in zip(samples, first.tolist(), sizes.tolist(), strict=True):
        texels[y : y + ny, x : x + nx] = values
    entry_first, entry_size = np.zeros((counts[0] * counts[1], 2), int), np.ones((counts[0] * counts[1], 2), int)
    entry_first[index], entry_size[index] = first, sizes
    return texels.clip(max=HALF_MAX), pack_entries(entry_first, entry_size).reshape(*counts, 2)


def cut(image: np.ndarray, weight: np.ndarray, size: int, device: str) -> Tiles:
    """Cuts a lightmap into tiles.

    Args:
        image: float [H, W, 3], without gaps.
        weight: float [2 H, 2 W], of each quarter of a texel; at least one is above 0.
        size: B, texels along a tile.
        device: "cpu" or "cuda:N".

    Returns:
        The tiles in which some weight is above 0.
    """
    height, width = image.shape[:2]
    rows, columns = tile_counts(height, width, size)
    light = _between(_between(image, rows * size, 0), columns * size, 1)
    weight = _folded(_folded(np.asarray(weight, np.float64), rows * size, 0), columns * size, 1)
    m = SUPERSAMPLING * size

    def tiles(values: np.ndarray) -> np.ndarray:
        cells = values.reshape(rows, m, columns, m, -1).transpose(0, 2, 4, 1, 3)
        return cells.reshape(rows * columns, -1, m * m)

    def on_device(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)

    tile_weight = tiles(weight)[:, 0]
    index = np.flatnonzero(tile_weight.any(1))
    return Tiles(
        torch.from_numpy(index).to(device),
        on_device(tiles(light)[index]),
        on_device(tile_weight[index] / weight.sum()),
        size,
    )


def _between(image: np.ndarray, texels: int, axis: int) -> np.ndarray:
    """Bilinear values along an axis at 1/4, 3/4, 5/4 ... texels from the first texel's centre."""
    place = (np.arange(SUPERSAMPLING * texels) + 0.5) / SUPERSAMPLING
    last = image.shape[axis] - 1
    place = place.clip(0, last)
    first = np.minimum(place.astype(np.int64), max(last - 1, 0))
    share = np.expand_dims((place - first).astype(np.float32), tuple(i for i in range(image.ndim) if i != axis))
    near, far = image.take(first, axis), image.take(np.minimum(first + 1, last), axis)
    return near + share * (far - near)


def _folded(weight: np.ndarray, texels: int, axis: int) -> np.ndarray:
    """Weights along an axis at `_between`'s points; those beyond the outermost texel centres go to these centres."""
    weight = np.moveaxis(weight, axis, 0)
    inner = weight[1:-1].copy()
    if not len(inner):  # a single texel, whose quarters all lie beyond its centre
        inner = np.zeros((1, *weight.shape[1:]))
    inner[0] += weight[0]
    inner[-1] += weight[-1]
    padded = np.zeros((SUPERSAMPLING * texels, *weight.shape[1:]))
    padded[: len(inner)] = inner
    return np.moveaxis(padded, 0, axis)


def linear(samples: int, points: int, device: str = "cpu") -> torch.Tensor:
    """float [points, samples], weights of linear interpolation from samples to points along an axis of a tile."""
    place = (torch.arange(points, device=device) + 0.5) / points * (samples - 1)
    first = place.floor().clamp(max=max(samples - 2, 0)).long()
    result = torch.zeros((points, samples), device=device)
    row = torch.arange(points, device=device)
    result[row, first] = 1.0 - (place - first)
    if samples > 1:
        result[row, first + 1] = place - first
    return result


def solve(tiles: Tiles, nx: int, ny: int, rounds: int = _FINE) -> torch.Tensor:
    """Solves for the samples of least weighted squared error, at one size for all tiles.

    Conjugate gradients on the normal equations, all tiles at once, from the solution with equal weights, which is a
    product of two pseudoinverses.

    Args:
        tiles: T of them.
        nx, ny: Samples along x and y.
        rounds: Of conjugate gradients.

    Returns:
        float [T, ny, nx, 3].
    """
    light, weight = tiles.light, tiles.weight[:, None]
    device, points = str(light.device), _side(tiles)
    ax, ay = (linear(n, points, device) for n in (nx, ny))
    # One large product of matrices is faster than two small ones per tile.
    both = torch.kron(ay, ax)
    start = light @ torch.kron(torch.linalg.pinv(ay), torch.linalg.pinv(ax)).T
    weight = weight / weight.mean(2, keepdim=True)
    ridge = _RIDGE * points**2 / (nx * ny)
    diagonal = weight @ both + ridge
    # In terms of the difference to the start, towards which the ridge pulls.
    change = torch.zeros_like(start)
    residual = ((light - start @ both.T) * weight) @ both
    preconditioned = residual / diagonal
    direction, energy = preconditioned, (residual * preconditioned).sum(2, keepdim=True)
    for _ in range(rounds):
        image = ((direction @ both.T) * weight) @ both + ridge * direction
        step = energy / (direction * image).sum(2, keepdim=True).clamp(min=1e-30)
        change = change + step * direction
        residual = residual - step * image
        preconditioned = residual / diagonal
        before, energy = energy, (residual * preconditioned).sum(2, keepdim=True)
        direction = preconditioned + energy / before.clamp(min=1e-30) * direction
    return (start + change).view(-1, 3, ny, nx).permute(0, 2, 3, 1)


def _side(tiles: Tiles) -> int:
    """Points along a tile."""
    return SUPERSAMPLING * tiles.size


def errors(tiles: Tiles, samples: torch.Tensor) -> torch.Tensor:
    """Weighted squared error of each tile, mean of the channels, float64 [T]; the sum is the mean squared error.

    Args:
        tiles: T of them.
        samples: float [T, ny, nx, 3].
    """
    count, ny, nx, _ = samples.shape
    device, points = str(samples.device), _side(tiles)
    both = torch.kron(linear(ny, points, device), linear(nx, points, device))
    interpolated = samples.permute(0, 3, 1, 2).reshape(count, 3, ny * nx) @ both.T
    squared = ((interpolated - tiles.light) ** 2).mean(1) * tiles.weight
    return squared.double().sum(1)


def curves(
    tiles: Tiles,
    sizes: list[tuple[int, int]],
    stored: Callable[[torch.Tensor], torch.Tensor] | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
) -> np.ndarray:
    """The error of every tile at every size, float64 [sizes, T].

    Args:
        tiles: T of them.
        sizes: nx and ny.
        stored: Maps samples [T, ny, nx, 3] to their values in the file; None: they stay.
        progress: Called with the sizes done.
        checkpoint: Where the errors of the sizes done are kept, as batch 0.
    """
    rounds = _ROUGH if stored is None else _FINE  # a codec's error deserves an exact solution
    result, meter = np.empty((len(sizes), len(tiles.index))), Meter(progress, "curves", len(sizes))
    begin = 0

    def load(state: dict[str, np.ndarray]) -> None:
        nonlocal begin
        done = check_parts(state, {"error": Part(np.float64, (None, len(tiles.index)), least=0.0)})["error"]
        begin = min(len(done), len(sizes))
        result[:begin] = done[:begin]

    if checkpoint is not None:
        checkpoint.restore(0, load)
    for i, (nx, ny) in enumerate(sizes[begin:], begin):
        if meter.due(i):
            try:
                meter.report(i)
            except KeyboardInterrupt:
                if checkpoint is not None:
                    checkpoint.save_running(0, {"error": result[:i]})
                raise
        for part, piece in _pieces(tiles):
            samples = solve(piece, nx, ny, rounds).clamp(min=0.0)
            result[i, part] = errors(piece, samples if stored is None else stored(samples)).cpu().numpy()
        if checkpoint is not None and checkpoint.due():
            checkpoint.save_running(0, {"error": result[: i + 1]})
    return result


def solved(tiles: Tiles, sizes: np.ndarray) -> list[np.ndarray]:
    """Solves for the samples of every tile at its own size.

    Args:
        tiles: T of them.
        sizes: int [T, 2], nx and ny.

    Returns:
        For each tile float32 [ny, nx, 3], not negative.
    """
    result: list[np.ndarray] = [np.empty(0)] * len(sizes)
    for nx, ny in np.unique(sizes, axis=0).tolist():
        chosen = np.flatnonzero((sizes == (nx, ny)).all(1))
        rows = torch.from_numpy(chosen).to(tiles.index.device)
        group = Tiles(tiles.index[rows], tiles.light[rows], tiles.weight[rows], tiles.size)
        for part, piece in _pieces(group):
            values = solve(piece, nx, ny).clamp(min=0.0).cpu().numpy()
            for row, samples in zip(chosen[part], values, strict=True):
                result[row] = samples
    return result


def _pieces(tiles: Tiles) -> Iterator[tuple[slice, Tiles]]:
    for first in range(0, len(tiles.index), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        yield part, Tiles(tiles.index[part], tiles.light[part], tiles.weight[part], tiles.size)


def allocate(error: np.ndarray, cost: np.ndarray, budget: float, least: float) -> np.ndarray:
    """Chooses the size of each tile for the least total error within a budget.

    Args:
        error: [sizes, T].
        cost: [sizes], samples of each size.
        budget: Samples of all tiles.
        least: Error that a sample must save to be allocated.

    Returns:
        int [T], numbers of sizes. The cheapest of all where even they are over the budget.
    """

    def best(gain: float) -> np.ndarray:
        return (error + gain * cost[:, None]).argmin(0)

    chosen = best(least)
    if cost[chosen].sum() <= budget:
        return chosen
    low, high = least, max(least, error.max() + 1e-30)  # at the high end no sample pays
    for _ in range(_BISECTIONS):
        middle = np.sqrt(low * high) if low > 0 else high * 1e-6
        if cost[best(middle)].sum() > budget:
            low = middle
        else:
            high = middle
    return best(high)


def place(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Packs rectangles on shelves of one width, the highest first; each shelf is as high as its first rectangle.

    Args:
        sizes: int [R, 2], width and height of each.
        width: Of the shelves, at least that of the widest.

    Returns:
        int64 [R, 2], x and y of each; and the height of all shelves.
    """
    first = np.zeros((len(sizes), 2), np.int64)
    x = y = height = 0
    order = np.lexsort((-sizes[:, 0], -sizes[:, 1]))
    for i, (w, h) in zip(order.tolist(), sizes[order].tolist(), strict=True):
        if x + w > width:
            x, y, height = 0, y + height, 0
        height = height or h
        first[i] = x, y
        x += w
    return first, y + height
