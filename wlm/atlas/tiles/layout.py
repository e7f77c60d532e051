"""Chooses the sizes of tiles within a budget of bits, and their places in the texture.

A tile has an error at each size that it may have, and a size takes a number of bits. In the best choice of sizes one
more bit would reduce the error by about the same amount in every tile. That amount, a Lagrange multiplier, is found by
bisection. With colour "mixed" there are two textures, one of BC6H blocks and one of RGB9E5 texels, and the chosen size
of a tile says which one it is in.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.atlas.model import (
    BLOCK_SIDE,
    BLOCKS,
    COLOUR_BITS,
    MOST_SIZE,
    NO_BLOCKS,
    SIDE_BITS,
    TEXELS,
    Profile,
    first_block_code,
)
from wlm.errors import WlmError

_BISECTIONS, _CLOSE = 60, 1e-6
_TILES_AT_ONCE = 1 << 16
_WIDTHS = np.linspace(0.7, 1.5, 17)  # candidate widths of a page over the square root of its area
_SIDES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14)  # texels, beside the largest side: above 6 every second one is enough


@dataclass(frozen=True)
class Size:
    """A size that a tile may have: samples along x and y, their format (a key of `COLOUR_BITS`), and whether the tile
    is in the second texture of "mixed"."""

    nx: int
    ny: int
    format: str
    second: bool = False

    @property
    def bits(self) -> int:
        """The number of bits of a tile on a GPU."""
        return self.nx * self.ny * COLOUR_BITS[self.format]

    @property
    def step(self) -> int:
        """The number of texels of which the tile's width and height are multiples: 4 for blocks, else 1."""
        return BLOCK_SIDE if self.format in ("bc6h", "astc") else 1


@dataclass(frozen=True)
class Layout:
    """The chosen size of each tile, an index, int [T]; x and y of each tile's first texel, int64 [T, 2]; and the rows
    and columns of T_p and of the second texture of "mixed"."""

    chosen: np.ndarray
    first: np.ndarray
    shapes: tuple[tuple[int, int], ...]


def sizes_of(profile: Profile) -> list[Size]:
    """Returns the sizes that a tile may have; in block formats tiles consist of whole blocks and share none."""
    most, colour = profile.tile + 1, profile.colour
    code = first_block_code(colour)
    most_texels = min(most, code)
    format, blocks = (TEXELS, BLOCKS) if colour == "mixed" else (colour, colour)
    sides = sorted({*(side for side in _SIDES if side < most_texels), most_texels}) if code else []
    whole = range(BLOCK_SIDE, min(most + BLOCK_SIDE - 1, 1 << SIDE_BITS) + 1, BLOCK_SIDE) if code < NO_BLOCKS else []
    sizes = [Size(nx, ny, format) for ny in sides for nx in sides]
    return sizes + [Size(nx, ny, blocks, bool(code)) for ny in whole for nx in whole]


def layout(error: torch.Tensor | np.ndarray, sizes: list[Size], room: float, least: float) -> Layout | None:
    """Chooses a size for each of T tiles, and places the tiles' rectangles in textures that take at most `room` bits;
    returns None if not even the smallest sizes fit. `error`, float64 [sizes, T] on any device, is the error of each
    tile at each size; a bit is only spent where it reduces the error by at least `least`."""
    cost = np.array([size.bits for size in sizes], np.float64)
    sides = np.array([(size.nx, size.ny) for size in sizes])
    second = np.array([size.second for size in sizes])
    textures = [next(size for size in sizes if size.second == each) for each in sorted(set(second.tolist()))]
    budget, fewest = room, error.shape[1] * cost.min()
    while True:
        chosen = allocate(error, cost, budget, least)
        first, shapes, bits = np.zeros((len(chosen), 2), np.int64), [], 0
        for texture in textures:
            members = np.flatnonzero(second[chosen] == texture.second)
            first[members], shape = packed(sides[chosen[members]], step=texture.step)
            shapes.append(shape)
            most = MOST_SIZE * texture.step
            if max(shape) > most:
                raise WlmError(
                    f"budget: too large: a colour texture would have {max(shape)} texels along a side, expected at "
                    f"most {most}; give less"
                )
            bits += math.prod(shape) * COLOUR_BITS[texture.format]
        if bits <= room:
            return Layout(chosen, first, tuple(shapes))
        total = cost[chosen].sum()
        if total <= fewest:
            return None
        # The area lost between shelves is about the same next time.
        budget = min(budget, total) * min(0.999 * room / bits, 0.99)


def texels_of(first: np.ndarray, nx: int, ny: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns rows [n, ny, 1] and columns [n, 1, nx] of the texels of n rectangles from their first (x, y) [n, 2]."""
    row = first[:, 1, None, None] + np.arange(ny)[:, None]
    return row, first[:, 0, None, None] + np.arange(nx)


def allocate(error: torch.Tensor | np.ndarray, cost: np.ndarray, budget: float, least: float) -> np.ndarray:
    """Chooses the size of each tile, int [T], for the least sum of `error`, float64 [sizes, T], within a budget of
    bits; each bit must save an error of at least `least`. If even the cheapest sizes exceed the budget, all tiles get
    the cheapest."""
    error = torch.as_tensor(error)
    bits = torch.from_numpy(np.asarray(cost, np.float64)).to(error.device)

    def best(gain: float) -> torch.Tensor:
        parts = [(each + gain * bits[:, None]).argmin(0) for each in error.split(_TILES_AT_ONCE, 1)]
        return torch.cat(parts)

    chosen = best(least)
    if float(bits[chosen].sum()) <= budget:
        return chosen.cpu().numpy()
    low, high = least, max(least, float(error.max()) + 1e-30)  # at the high end no bit pays
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high) if low > 0 else high * 1e-6
        if float(bits[best(middle)].sum()) > budget:
            low = middle
        else:
            high = middle
        if high <= low * (1.0 + _CLOSE):
            break
    return best(high).cpu().numpy()


def packed(
    size: np.ndarray, pages: Sequence[np.ndarray] | None = None, step: int = 1
) -> tuple[np.ndarray, tuple[int, int]]:
    """Packs rectangles, int [R, 2] texels along x and y, multiples of `step`, on pages of equal size, with the width of
    least area.

    `pages` has for each page the numbers of its rectangles (None: all are on one page); the width that the shelves
    (rows) may take is a multiple of `step`. Returns the first texel (x, y) of each rectangle on its page, int64 [R, 2],
    and the rows and columns of a page.
    """
    first = np.zeros((len(size), 2), np.int64)
    if not len(size):
        return first, (step, step)
    pages = [np.arange(len(size))] if pages is None else pages
    most, shelves = max(float(size[page].prod(1).sum()) for page in pages), [Shelves(size[page]) for page in pages]
    widths = [max(int(size[:, 0].max()), -(-round(share * math.sqrt(most)) // step) * step) for share in _WIDTHS]
    taken = [tuple(map(max, zip(*(each.extent(width) for each in shelves), strict=True))) for width in widths]
    shape, width = min(zip(taken, widths, strict=True), key=lambda each: math.prod(each[0]))
    for each, page in zip(shelves, pages, strict=True):
        first[page] = each.place(width)
    return first, shape


class Shelves:
    """Packs rectangles, int [R, 2] widths and heights, on shelves (rows), by falling height and then width. Each shelf
    is as high as its first rectangle."""

    def __init__(self, sizes: np.ndarray) -> None:
        self._order = np.lexsort((-sizes[:, 0], -sizes[:, 1]))
        ordered = sizes[self._order]
        starts = np.flatnonzero(np.append(True, (ordered[1:] != ordered[:-1]).any(1))[: len(sizes)])
        self._sizes, self._counts = ordered[starts], np.diff(np.append(starts, len(sizes)))

    def place(self, width: int) -> np.ndarray:
        """Returns x and y of each rectangle on shelves `width` wide, int64 [R, 2]."""
        first, at = np.empty((len(self._order), 2), np.int64), 0
        for x, y, w, h, columns, count in self._grids(width):
            row, column = np.divmod(np.arange(count), columns)
            first[self._order[at : at + count]] = np.stack([x + w * column, y + h * row], 1)
            at += count
        return first

    def extent(self, width: int) -> tuple[int, int]:
        """Returns the rows and columns of texels that the shelves take; none may reach as far as the width allows."""
        ends = [(y + h * -(-count // n), x + w * min(n, count)) for x, y, w, h, n, count in self._grids(width)]
        return max((row for row, _ in ends), default=0), max((column for _, column in ends), default=0)

    def _grids(self, width: int) -> Iterator[tuple[int, ...]]:
        """Yields grids of equal rectangles, in order: x and y of the first, width and height, columns, and number."""
        x = y = height = 0
        for (w, h), count in zip(self._sizes.tolist(), self._counts.tolist(), strict=True):
            # The first ones share the last shelf with the size before; the others fill shelves of their own.
            if beside := min((width - x) // w, count) if height else 0:
                yield x, y, w, h, beside, beside
            x, rest, columns = x + w * beside, count - beside, width // w
            if rest:
                yield 0, y + height, w, h, columns, rest
                x, y, height = w * ((rest - 1) % columns + 1), y + height + h * ((rest - 1) // columns), h
