"""Numbers the tiles and the pages of the sheets of a model, for a virtual texture.

A page is a square of texels of one mip level of a sheet. Level L has ceil(H / 2^L) x ceil(W / 2^L) texels, in rows of
pages; the last level of a sheet has one page. Tiles and pages are numbered sheet by sheet, pages level by level, and
row by row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.sheet import Sheet
from wlm.lightmap.tiles import TILE
from wlm.texels import REACH
from wlm_kernels.lightmap.pages import COARSE_LEVEL, FAR


@dataclass(frozen=True, eq=False)
class Layout:
    """The tiles and pages of S sheets; the arrays are described at `wlm_kernels.lightmap.virtual.Pages`.

    Attributes:
        sheets, models: The sheets, group by group, and their models.
        groups: Names of the light groups.
        surfaces: int [F, G], index of the sheet of each surface (a layer of an atlas, or three channels of it) in each
            group, or -1.
        side, border: Texels along a side of a page without its border, and of the border.
        tile_first: int [S + 1], number of the first tile of each sheet, and the number of all tiles.
        first, columns, levels, place, parent: As in `Pages`.
        inner: int [P, 4], first and last row, first and last column of the tiles below each page without its border.
        own: int [P], the tile below a page of level 0 that has a parent, else -1.
        reader, read: int [E] each, a page and a tile that it reads; pages of whole sheets are left out.
    """

    sheets: list[Sheet]
    models: list[SheetModel]
    groups: tuple[str, ...]
    surfaces: np.ndarray
    side: int
    border: int
    tile_first: np.ndarray
    first: np.ndarray
    columns: np.ndarray
    levels: np.ndarray
    place: np.ndarray
    parent: np.ndarray
    inner: np.ndarray
    own: np.ndarray
    reader: np.ndarray
    read: np.ndarray

    @classmethod
    def of(cls, model: LightmapModel, side: int, border: int) -> Layout:
        """Numbers the tiles and pages of a model; `side` is a divisor of 128."""
        models = list(model.sheets.values())
        tile_first = np.cumsum([0, *(own.grid.count for own in models)])
        grids = [_levels(own, side) for own in models]
        most = max(map(len, grids))
        first, columns = np.zeros((2, len(models), most), np.int32)
        parts: dict[str, list[np.ndarray]] = {
            name: [] for name in ("place", "parent", "inner", "own", "reader", "read")
        }
        count = 0
        for s, (own, grid) in enumerate(zip(models, grids, strict=True)):
            for level, (rows, across) in enumerate(grid):
                first[s, level], columns[s, level] = count, across
                row, column = (part.ravel() for part in np.mgrid[:rows, :across])
                parts["place"].append(np.stack([np.full_like(row, s), np.full_like(row, level), row, column], 1))
                count += len(row)
                whole = level + 1 == len(grid)
                above = 0 if whole else grid[level + 1][1]
                parts["parent"].append(np.full(1, -1) if whole else count + row // 2 * above + column // 2)
                inner = _tiles_below(own, level, row, column, side, 0)
                parts["inner"].append(inner)
                parts["own"].append(
                    np.full(len(row), -1)
                    if level or whole
                    else tile_first[s] + inner[:, 0] * own.grid.cols + inner[:, 2]
                )
                if level < COARSE_LEVEL and not whole:
                    boxes = _tiles_below(own, level, row, column, side, border + (REACH if level else FAR))
                    for page, box in enumerate(boxes, int(first[s, level])):
                        parts["read"].append(_numbers(box, own.grid.cols) + tile_first[s])
                        parts["reader"].append(np.full(len(parts["read"][-1]), page))
        nothing = np.zeros(0, np.int32)
        arrays = {name: np.concatenate(part or [nothing]).astype(np.int32) for name, part in parts.items()}
        levels = np.array([len(grid) for grid in grids], np.int32)
        sheets = list(model.sheets)
        surfaces = _surfaces(sheets, model.groups)
        return cls(sheets, models, model.groups, surfaces, side, border, tile_first, first, columns, levels, **arrays)

    @property
    def whole(self) -> np.ndarray:
        """The numbers of the pages that cover a whole sheet each, int [S]."""
        return np.flatnonzero(self.parent < 0)

    @property
    def footprint(self) -> int:
        """Largest number of tiles that a page reads, except the pages of whole sheets."""
        return int(np.bincount(self.reader).max(initial=0))

    def below(self, page: int) -> np.ndarray:
        """Returns the tiles below a page without its border, int [n]."""
        sheet = self.place[page, 0]
        return _numbers(self.inner[page], self.models[sheet].grid.cols) + self.tile_first[sheet]


def _surfaces(sheets: list[Sheet], groups: tuple[str, ...]) -> np.ndarray:
    """Returns `Layout.surfaces`."""
    of = {sheet: (sheet.atlas, sheet.layer, sheet.channels) for sheet in sheets}
    rows = {surface: row for row, surface in enumerate(dict.fromkeys(of.values()))}
    found = np.full((len(rows), len(groups)), -1, np.int32)
    for number, sheet in enumerate(sheets):
        found[rows[of[sheet]], groups.index(sheet.group)] = number
    return found


def _numbers(box: np.ndarray, columns: int) -> np.ndarray:
    """Returns the numbers of the tiles in a box of first and last row, first and last column."""
    row, column = np.arange(box[0], box[1] + 1), np.arange(box[2], box[3] + 1)
    return (row[:, None] * columns + column).ravel()


def _levels(own: SheetModel, side: int) -> list[tuple[int, int]]:
    """Returns the rows and columns of pages of each level of a sheet."""
    found: list[tuple[int, int]] = []
    while not found or found[-1] != (1, 1):
        texels = side << len(found)
        found.append((-(-own.height // texels), -(-own.width // texels)))
    return found


def _tiles_below(
    own: SheetModel, level: int, row: np.ndarray, column: np.ndarray, side: int, margin: int
) -> np.ndarray:
    """Returns the first and last row and column of the tiles below pages with a margin in texels, int [n, 4]."""
    ends = []
    for at, size in ((row, own.height), (column, own.width)):
        low, high = (at * side - margin) << level, ((at + 1) * side + margin) << level
        ends += [np.maximum(low, 0) // TILE, (np.minimum(high, size) - 1) // TILE]
    return np.stack(ends, 1)
