"""Tiles at their own resolutions: how many samples each gets, and the samples of least squared error.

The lightmap is cut into tiles of B x B texels whose borders lie on texel centres. A tile becomes nx x ny samples, 1 to
B + 1 a side, the outermost on its borders, and between them light is bilinear: with B + 1 a side it is the lightmap
itself. Tiles share no sample, so each is a small weighted least squares problem of its own, solved for every size.
Which sizes to keep within a budget of samples is then a choice of one point a tile on its curve of error against
samples; at the best choice all tiles gain as much by one more sample, and that gain, a Lagrange multiplier, is found by
bisection.

This takes the place of sections 3.1 to 3.3 of lightmap-uv-clustering-cascade: sharp shadows get samples and even walls
next to none, within a triangle too, which that paper names as its limit (section 5.1).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

__all__ = ["Tiles", "allocate", "curves", "cut", "errors", "linear", "place", "solve", "solved", "tile_counts"]

SUPERSAMPLING = 2
"""Points of the light a texel and axis that a tile is fitted to."""

_AT_ONCE = 8192  # tiles
_ROUGH, _FINE = 3, 40  # rounds of conjugate gradients, from the unweighted solution
# Where no point of a tile is seen that a sample reaches, it stays near the unweighted solution.
_RIDGE = 1e-4
_BISECTIONS = 60


@dataclass(frozen=True)
class Tiles:
    """The light of the tiles that matter.

    Attributes:
        index: int64 [T], which tile of the grid, row by row.
        light: float [T, 3, m * m], at m x m points of the tile, row by row, (k + 0.5) / m along an axis.
        weight: float [T, m * m], how much a point's squared error counts, 0 or more; over all tiles they add up to 1.
        size: Texels along a tile.
    """

    index: torch.Tensor
    light: torch.Tensor
    weight: torch.Tensor
    size: int


def tile_counts(height: int, width: int, size: int) -> tuple[int, int]:
    """Rows and columns of the grid of tiles over a lightmap; the last may reach beyond it."""
    return max(1, -(-(height - 1) // size)), max(1, -(-(width - 1) // size))


def cut(image: np.ndarray, weight: np.ndarray, size: int, device: str) -> Tiles:
    """Cuts a lightmap into tiles.

    Args:
        image: float [H, W, 3], without gaps.
        weight: float [2 H, 2 W], of each quarter of a texel; at least one is above 0.
        size: B, texels along a tile.
        device: "cpu" or "cuda:0".

    Returns:
        The tiles in which some weight is above 0.
    """
    height, width = image.shape[:2]
    rows, columns = tile_counts(height, width, size)
    light = _between(_between(image, rows * size, 0), columns * size, 1)
    count = _folded(_folded(np.asarray(weight, np.float64), rows * size, 0), columns * size, 1)
    m = SUPERSAMPLING * size

    def tiles(values: np.ndarray) -> np.ndarray:
        cells = values.reshape(rows, m, columns, m, -1).transpose(0, 2, 4, 1, 3)
        return cells.reshape(rows * columns, -1, m * m)

    weights = tiles(count)[:, 0]
    seen = np.flatnonzero(weights.any(1))
    put = lambda values: torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)  # noqa: E731
    return Tiles(
        torch.from_numpy(seen).to(device),
        put(tiles(light)[seen]),
        put(weights[seen] / count.sum()),
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
    """Weights along an axis for ``_between``'s points: what lies outside of the outermost centres goes to them."""
    weight = np.moveaxis(weight, axis, 0)
    inner = weight[1:-1].copy()
    if not len(inner):  # a single texel, whose quarters all lie outside
        inner = np.zeros((1, *weight.shape[1:]))
    inner[0] += weight[0]
    inner[-1] += weight[-1]
    room = np.zeros((SUPERSAMPLING * texels, *weight.shape[1:]))
    room[: len(inner)] = inner
    return np.moveaxis(room, 0, axis)


def linear(samples: int, points: int, device: str = "cpu") -> torch.Tensor:
    """float [points, samples], the weights with which samples make light at the points of an axis of a tile."""
    place = (torch.arange(points, device=device) + 0.5) / points * (samples - 1)
    first = place.floor().clamp(max=max(samples - 2, 0)).long()
    result = torch.zeros((points, samples), device=device)
    row = torch.arange(points, device=device)
    result[row, first] = 1.0 - (place - first)
    if samples > 1:
        result[row, first + 1] = place - first
    return result


def solve(tiles: Tiles, nx: int, ny: int, rounds: int = _FINE) -> torch.Tensor:
    """The samples of least weighted squared error, at one size for all tiles.

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
    # One large product of matrices is quicker than two small ones a tile.
    both = torch.kron(ay, ax)
    start = light @ torch.kron(torch.linalg.pinv(ay), torch.linalg.pinv(ax)).T
    weight = weight / weight.mean(2, keepdim=True)
    ridge = _RIDGE * points**2 / (nx * ny)
    diagonal = weight @ both + ridge
    # In terms of the difference to the start, towards which the ridge pulls.
    change = torch.zeros_like(start)
    residual = ((light - start @ both.T) * weight) @ both
    towards = residual / diagonal
    direction, energy = towards, (residual * towards).sum(2, keepdim=True)
    for _ in range(rounds):
        image = ((direction @ both.T) * weight) @ both + ridge * direction
        step = energy / (direction * image).sum(2, keepdim=True).clamp(min=1e-30)
        change = change + step * direction
        residual = residual - step * image
        towards = residual / diagonal
        before, energy = energy, (residual * towards).sum(2, keepdim=True)
        direction = towards + energy / before.clamp(min=1e-30) * direction
    return (start + change).view(-1, 3, ny, nx).permute(0, 2, 3, 1)


def _side(tiles: Tiles) -> int:
    """Points along a tile."""
    return SUPERSAMPLING * tiles.size


def errors(tiles: Tiles, samples: torch.Tensor) -> torch.Tensor:
    """Weighted squared error of each tile, mean of the channels, float64 [T]; their sum is the mean squared error.

    Args:
        tiles: T of them.
        samples: float [T, ny, nx, 3].
    """
    count, ny, nx, _ = samples.shape
    device, points = str(samples.device), _side(tiles)
    both = torch.kron(linear(ny, points, device), linear(nx, points, device))
    shown = samples.permute(0, 3, 1, 2).reshape(count, 3, ny * nx) @ both.T
    each = ((shown - tiles.light) ** 2).mean(1) * tiles.weight
    return each.double().sum(1)


def curves(
    tiles: Tiles, sizes: list[tuple[int, int]], stored: Callable[[torch.Tensor], torch.Tensor] | None = None
) -> np.ndarray:
    """The error of every tile at every size, float64 [sizes, T].

    Args:
        tiles: T of them.
        sizes: nx and ny.
        stored: What becomes of samples [T, ny, nx, 3] in the file; None: they stay.
    """
    rounds = _ROUGH if stored is None else _FINE  # a codec's error is worth an exact solution
    result = np.empty((len(sizes), len(tiles.index)))
    for i, (nx, ny) in enumerate(sizes):
        for part, piece in _pieces(tiles):
            samples = solve(piece, nx, ny, rounds).clamp(min=0.0)
            result[i, part] = errors(piece, samples if stored is None else stored(samples)).cpu().numpy()
    return result


def solved(tiles: Tiles, sizes: np.ndarray) -> list[np.ndarray]:
    """The samples of every tile at its own size.

    Args:
        tiles: T of them.
        sizes: int [T, 2], nx and ny.

    Returns:
        float32 [ny, nx, 3] of each, not negative.
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
    """The size of each tile with the least error in all, within a budget.

    Args:
        error: [sizes, T].
        cost: [sizes], samples of each size.
        budget: Samples of all tiles.
        least: Error that a sample must save to be worth having.

    Returns:
        int [T], numbers of sizes. The cheapest of all where even they are over the budget.
    """

    def best(gain: float) -> np.ndarray:
        return (error + gain * cost[:, None]).argmin(0)

    chosen = best(least)
    if cost[chosen].sum() <= budget:
        return chosen
    low, high = least, max(least, error.max() + 1e-30)  # at the high end nothing is worth a sample
    for _ in range(_BISECTIONS):
        middle = np.sqrt(low * high) if low > 0 else high * 1e-6
        if cost[best(middle)].sum() > budget:
            low = middle
        else:
            high = middle
    return best(high)


def place(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Puts rectangles on shelves of one width, the highest first; each shelf is as high as its first.

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
