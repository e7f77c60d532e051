"""The model of a scene's lightmaps: one table and one texture for all sheets and all states.

The lightmaps of a sheet share its tiles. A tile has a few components, K rectangles of one size beside each other in
T_p, and a mixture; of tiles in blocks the last components may be *coarse*, of one block of 4 x 4 texels each. Light at
a point in state m is

    C_m(u) = f[m, first] + sum_k f[m, first + 1 + k] T_p[page](place of u by T_c, k rectangles to the right),

with f a constant and a factor of each component, for each state and channel; what is negative is 0. Tiles whose light
changes alike from state to state share a mixture (`mixture`). Between two states f is linear. With mips a sheet is
followed by smaller ones, its levels, that are read in the same way.

Where states have little in common they are kept *apart*: a sheet has tiles of its own in each state, of one component,
and between two states light is linear.
"""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from wlm.atlas.model import BLOCK_SIDE, FIRST_BLOCK_CODE, NO_BLOCKS, SOURCE_BITS, pack_entries, unpack_entries
from wlm.system import Model, Settings

TEXEL_BITS = 32
"""Bits of a texel of T_p: RGB9E5."""

NUMBER_BITS = 16
"""Bits of each of the numbers of an entry of T_c."""

ENTRY, SHORT_ENTRY = 4, 2
"""Numbers of an entry; and where there are one component and one page alone."""

FACTOR_BITS = 128
"""Bits of a component's factors in a state: three floats, in a texel of four."""

SHEET_BITS = 128
"""Bits of a sheet's or level's row: eight numbers of 16."""

COUNT_BITS, COARSE_BITS = 8, 4
"""Of an entry's fourth number: the lowest, for the number of components, and the next, for how many of them are coarse;
above them is the page."""

MOST_PAGES, MOST_COARSE = 1 << (16 - COUNT_BITS - COARSE_BITS), (1 << COARSE_BITS) - 1


class SceneProfile(Settings):
    """Settings of a scene's compression.

    Attributes:
        name: Shown in reports.
        colour: How T_p is stored: "rgb9e5"; or "mixed": two textures, RGB9E5 and BC6H, and each tile in one of them.
        budget: Bits of T_p, T_c and the factors as a fraction of all lightmaps' at 48 bits per texel, 1 - CR of eq. 9.
        tile: Texels of a lightmap along a tile, 3 to 15.
        components: Most components of a tile; 0: as many as pay.
        mips: Whether there are smaller levels of each sheet, within the budget.
        views: Random views around the scene, and as many from inside; a texel counts by the pixels that show it.
        unseen: Weight of what no view shows, as a fraction of the mean weight of the scene.
        border: Factor on the weight within a texel of a chart's border.
    """

    FILES: ClassVar[str] = "atlas-scene"

    colour: Literal["rgb9e5", "mixed"] = "rgb9e5"
    budget: float = Field(0.05, gt=0.0, le=2.0)
    tile: int = Field(7, ge=3, le=15)
    components: int = Field(0, ge=0, le=64)
    mips: bool = False
    views: int = Field(64, ge=1, le=4096)
    unseen: float = Field(0.05, gt=0.0, le=1.0)
    border: float = Field(4.0, gt=0.0, le=100.0)


@dataclass(frozen=True)
class SheetPlace:
    """Where a sheet, or a level of one, is.

    Attributes:
        name: For people.
        height, width: Texels of its lightmaps.
        row, column: Its first entry in T_c.
        rows, columns: Its tiles.
        smaller: The row in `SceneModel.table` of the next smaller level; 0: there is none.
    """

    name: str
    height: int
    width: int
    row: int
    column: int
    rows: int
    columns: int
    smaller: int = 0


@dataclass(frozen=True, eq=False)
class SceneModel(Model):
    """Compressed lightmaps of a scene.

    Attributes:
        name: The scene's name.
        source: `LightmappedScene.source`.
        profile: The settings of the compression.
        states: Names of the states, M.
        sheets: At least one.
        factor: float32 [M, C, 3], finite, of any sign; of each mixture a constant, then its components' factors.
        texels: uint32 [pages, Hp, Wp], T_p, RGB9E5.
        lut: uint16 [Hc, Wc, 4], T_c: `pack_tiles`; [Hc, Wc, 2], its first two numbers, where there are one component
            and one page.
        levels: With mips the smaller levels of all sheets, for each sheet a quarter, then halves.
        report: Facts about the compression, for people.
        blocks: uint8 [pages, B, 16], the second texture of "mixed", BC6H, row by row; [0, 0, 16] for none.
        block_texels: half [pages, Hb, Wb, 3], what they decode to, multiples of 4; [0, 0, 0, 3] for none.
        later: Where states are apart the sheets and levels of the second state, then those of the third and so on.
    """

    SYSTEM: ClassVar[str] = "atlas-scene"

    name: str
    source: str
    profile: SceneProfile
    states: tuple[str, ...]
    sheets: tuple[SheetPlace, ...]
    factor: np.ndarray
    texels: np.ndarray
    lut: np.ndarray
    levels: tuple[SheetPlace, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)
    blocks: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 16), np.uint8))
    block_texels: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 0, 3), np.float16))
    later: tuple[SheetPlace, ...] = ()

    @property
    def rows(self) -> tuple[SheetPlace, ...]:
        """All sheets and levels, as in `table`."""
        return (*self.sheets, *self.levels, *self.later)

    @property
    def stride(self) -> int:
        """How many rows after a sheet's in one state is its row in the next; 0: all states have one."""
        return len(self.sheets) + len(self.levels) if self.later else 0

    def without_levels(self) -> "SceneModel":
        """The same without mips; what they read stays in the textures."""
        kept = [row for at, row in enumerate(self.later) if at % (self.stride or 1) < len(self.sheets)]
        bare = (replace(row, smaller=0) for row in kept)
        return replace(self, sheets=tuple(replace(s, smaller=0) for s in self.sheets), levels=(), later=tuple(bare))

    @property
    def colour(self) -> str:
        """How T_p is stored, as in `SceneProfile`."""
        return "mixed" if len(self.blocks) else "rgb9e5"

    @property
    def bits(self) -> int:
        """Bits of T_p, T_c, the factors and the sheets' rows."""
        texels = self.texels.size * TEXEL_BITS + self.blocks.size * 8 + self.lut.size * NUMBER_BITS
        return texels + self.factor.size // 3 * FACTOR_BITS + len(self.rows) * SHEET_BITS

    @property
    def compression_ratio(self) -> float:
        """CR of eq. 9 over all lightmaps."""
        source = sum(each.height * each.width for each in self.sheets) * SOURCE_BITS * len(self.states)
        return 1.0 - self.bits / source

    def table(self) -> np.ndarray:
        """int32 [rows, 7], the sheets, then the levels, as kernels and shaders read them; apart, of one state after the
        other: rows and columns of texels, first row and column in T_c, rows and columns of tiles, row of the next
        smaller level."""
        rows = [(s.height, s.width, s.row, s.column, s.rows, s.columns, s.smaller) for s in self.rows]
        return np.array(rows, np.int32)


def pack_tiles(
    first: np.ndarray,
    size: np.ndarray,
    component: np.ndarray,
    count: np.ndarray,
    page: np.ndarray,
    blocks: np.ndarray | bool = False,
    coarse: np.ndarray | int = 0,
) -> np.ndarray:
    """Encodes entries of T_c.

    Args:
        first, size, blocks: As of `pack_entries`: the rectangle of the first component.
        component: int [...], number of the first component's factors, below 65,536.
        count: int [...], components, 0 to 255; 0: the tile is black.
        page: int [...], below `MOST_PAGES`.
        coarse: int [...], how many of the components are coarse, 0 to `MOST_COARSE`; of tiles in blocks alone.

    Returns:
        uint16 [..., 4].
    """
    above = (np.asarray(page) << COARSE_BITS) + coarse
    rest = np.stack(np.broadcast_arrays(component, (above << COUNT_BITS) + count), -1).astype(np.uint16)
    return np.concatenate([pack_entries(first, size, blocks), rest], -1)


def unpack_tiles(lut: np.ndarray, colour: str) -> tuple[np.ndarray, ...]:
    """Decodes `pack_tiles`, to int64, and `blocks` to bool [...], in its order; of short entries, too."""
    first, size, blocks = unpack_entries(lut[..., :SHORT_ENTRY], FIRST_BLOCK_CODE if colour == "mixed" else NO_BLOCKS)
    if lut.shape[-1] == SHORT_ENTRY:
        zeros = np.zeros(lut.shape[:-1], np.int64)
        return first, size, zeros, zeros + 1, zeros, blocks[..., 0], zeros
    last = lut[..., 3].astype(np.int64)
    count, above = last & ((1 << COUNT_BITS) - 1), last >> COUNT_BITS
    component, page, coarse = lut[..., 2].astype(np.int64), above >> COARSE_BITS, above & MOST_COARSE
    return first, size, component, count, page, blocks[..., 0], coarse


def coarse_place(size: np.ndarray, whole: np.ndarray, number: np.ndarray | int) -> np.ndarray:
    """Where the coarse components of tiles are, one below the other in columns, beside the others.

    Args:
        size: int [..., 2], texels of the others along x and y.
        whole: int [...], how many others there are.
        number: int [...], of the coarse component, from 0.

    Returns:
        int [..., 2], x and y of the first texel, from that of the tile's first component.
    """
    column, row = np.divmod(number, np.maximum(size[..., 1] // BLOCK_SIDE, 1))
    return np.stack([size[..., 0] * whole + BLOCK_SIDE * column, BLOCK_SIDE * row], -1)


def extent(size: np.ndarray, count: np.ndarray, coarse: np.ndarray | int) -> np.ndarray:
    """Texels along x and y of all components of tiles, int [..., 2], of numbers as of `pack_tiles`."""
    columns = -(-coarse // np.maximum(size[..., 1] // BLOCK_SIDE, 1))
    return np.stack([size[..., 0] * (count - coarse) + BLOCK_SIDE * columns, size[..., 1]], -1)
