"""Chooses the sizes of tiles within a budget of bits, and their places in the texture.

Each tile has a curve of error against bits. At the optimum one more bit reduces the error by the same amount in every
tile. That gain, a Lagrange multiplier, is found by bisection. With colour "mixed" a tile's sizes have two formats, each
with its own texture: blocks where the block format is accurate, RGB9E5 for other light and for small tiles.
"""

import math
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
    pack_entries,
)
from wlm.errors import WlmError
from wlm.formats.exr import HALF_MAX

_BISECTIONS, _CLOSE = 60, 1e-6
_TILES_AT_ONCE = 1 << 16
_WIDTHS = np.linspace(0.7, 1.5, 17)  # candidate widths of T_p over the square root of its number of samples
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
    """Chooses sizes whose rectangles fit in textures of `room` bits, and places the rectangles; returns None if not
    even the smallest sizes fit. `error` is float64 [sizes, T] on any device; `least` is the smallest error that a bit
    must save.

    Raises:
        WlmError: A texture has more texels along a side than an entry of T_c can name.
    """
    cost = np.array([size.bits for size in sizes], np.float64)
    sides = np.array([(size.nx, size.ny) for size in sizes])
    second = np.array([size.second for size in sizes])
    textures = [next(size for size in sizes if size.second == each) for each in sorted(set(second.tolist()))]
    budget, fewest = room, error.shape[1] * cost.min()
    while True:
        chosen = allocate(error, cost, budget, least)
        counts, widths, shapes, bits = np.bincount(chosen, minlength=len(sizes)), [], [], 0
        for texture in textures:
            members = (second == texture.second) & (counts > 0)
            width, shape = _narrowest(_Kinds.of(sides[members], counts[members]), texture.step)
            widths.append(width)
            shapes.append(shape)
            most = MOST_SIZE * texture.step
            if max(shape) > most:
                raise WlmError(
                    f"budget: too large, T_p would have {max(shape)} texels along a side; expected at most {most}"
                )
            bits += math.prod(shape) * COLOUR_BITS[texture.format]
        if bits <= room:
            first = np.zeros((len(chosen), 2), np.int64)
            for texture, width in zip(textures, widths, strict=True):
                members = np.flatnonzero(second[chosen] == texture.second)
                first[members] = place(sides[chosen[members]], width)[0]
            return Layout(chosen, first, tuple(shapes))
        total = cost[chosen].sum()
        if total <= fewest:
            return None
        # The area lost between shelves is about the same next time.
        budget = min(budget, total) * min(0.999 * room / bits, 0.99)


def _narrowest(kinds: "_Kinds", step: int) -> tuple[int, tuple[int, int]]:
    """Finds the width of shelves (rows of rectangles) for the smallest texture; returns it and the texture's size."""
    if not len(kinds.size):
        return step, (step, step)
    total = float(kinds.size.prod(1) @ kinds.count)
    best = None
    for share in _WIDTHS:
        width = max(int(kinds.size[:, 0].max()), -(-round(share * math.sqrt(total)) // step) * step)
        runs, height = kinds.shelves(width)
        # No shelf may reach as far as the width allows.
        widest = max(run.widest for run in runs)
        if best is None or widest * height < best[0]:
            best = widest * height, width, (height, widest)
    return best[1:]


def composed(
    samples: list[tuple[np.ndarray, torch.Tensor, torch.Tensor]],
    sizes: list[Size],
    layout: Layout,
    index: np.ndarray,
    counts: tuple[int, int],
    device: str,
) -> tuple[list[tuple[torch.Tensor, torch.Tensor]], np.ndarray]:
    """Makes the colour textures T_p and the lookup texture T_c.

    Args:
        samples: Groups of tiles of one size, from `solved`.
        sizes: The sizes that tiles may have.
        layout: Sizes and places of the tiles.
        index: int64 [T], the tiles' numbers in the grid; all other tiles of the grid show the texture's first texel.
        counts: Rows and columns of the grid.
        device: "cpu" or "cuda:N": copying a large texture through the host takes seconds.

    Returns:
        For each colour texture its texels, float32 [H, W, 3], and their weights [H, W], on the device; and the lookup
        texture T_c.
    """
    textures = [(torch.zeros((*shape, 3), device=device), torch.zeros(shape, device=device)) for shape in layout.shapes]
    for members, values, weight in samples:
        size = sizes[layout.chosen[members[0]]]
        at = tuple(torch.from_numpy(each).to(device) for each in texels_of(layout.first[members], size.nx, size.ny))
        texels, weights = textures[size.second]
        texels[at], weights[at] = values, weight
    total = counts[0] * counts[1]
    mixed = any(size.second for size in sizes)
    code = first_block_code("mixed" if mixed else sizes[0].format)
    first, side, blocks = np.zeros((total, 2), int), np.ones((total, 2), int), np.zeros(total, bool)
    if not code:
        side[:], blocks[:] = BLOCK_SIDE, True
    first[index] = layout.first
    side[index] = np.array([(size.nx, size.ny) for size in sizes])[layout.chosen]
    if mixed:
        blocks[index] = np.array([size.second for size in sizes])[layout.chosen]
    lut = pack_entries(first, side, blocks, code).reshape(*counts, 2)
    return [(texels.clamp_(max=HALF_MAX), weights) for texels, weights in textures], lut


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


@dataclass(frozen=True)
class _Run:
    """The places of all rectangles of one size. The first `beside` rectangles start at (x, y), on a shelf (row) shared
    with another size. All others fill their own shelves, of `each` rectangles, from y = `below` on. `widest` is the
    right end of all rectangles."""

    beside: int
    x: int
    y: int
    each: int
    below: int
    widest: int


@dataclass(frozen=True)
class _Kinds:
    """The different sizes of rectangles, by falling height and then width, and the number of rectangles of each."""

    size: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, size: np.ndarray, count: np.ndarray) -> "_Kinds":
        order = np.lexsort((-size[:, 0], -size[:, 1]))
        return cls(size[order], count[order])

    def shelves(self, width: int) -> tuple[list[_Run], int]:
        """Places the rectangles of each size on shelves `width` wide; returns the places and the total height."""
        runs, x, y, height = [], 0, 0, 0
        for (w, h), count in zip(self.size.tolist(), self.count.tolist(), strict=True):
            each = width // w
            beside = min((width - x) // w, count) if height else 0
            run = _Run(
                beside, x, y, each, y + height, max(x + w * beside if beside else 0, w * min(each, count - beside))
            )
            runs.append(run)
            x += w * beside
            if rest := count - beside:
                y, height = run.below + h * ((rest - 1) // each), h
                x = w * ((rest - 1) % each + 1)
        return runs, y + height


def place(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Packs rectangles, int [R, 2] widths and heights, on shelves (rows) `width` wide, in order of height; each shelf
    is as high as its first rectangle. Returns x and y of each rectangle, int64 [R, 2], and the total height."""
    first = np.zeros((len(sizes), 2), np.int64)
    if not len(sizes):
        return first, 0
    order = np.lexsort((-sizes[:, 0], -sizes[:, 1]))
    ordered = sizes[order]
    starts = np.flatnonzero(np.append(True, (ordered[1:] != ordered[:-1]).any(1)))
    kinds = _Kinds(ordered[starts], np.diff(np.append(starts, len(sizes))))
    runs, height = kinds.shelves(width)
    for run, (w, h), members in zip(runs, kinds.size.tolist(), np.split(order, starts[1:]), strict=True):
        beside, below = members[: run.beside], members[run.beside :]
        first[beside, 0] = run.x + w * np.arange(len(beside))
        first[beside, 1] = run.y
        shelf, column = np.divmod(np.arange(len(below)), run.each)
        first[below, 0] = w * column
        first[below, 1] = run.below + h * shelf
    return first, height
