"""The model of a scene's compressed lightmaps: its settings and arrays, as stored in a file and in GPU memory.

A lightmap is read through a lookup texture (lightmap-uv-clustering-cascade, eq. 7): C(u) = T_p(F(T_c(u))), where T_c is
the lookup texture, T_p the colour texture, and F depends on the method:

    tiles    A point lies in a tile of the lightmap. The tile's entry of T_c, read without a filter, names a rectangle
             of T_p; a point has the same relative position in the tile and in the rectangle. Our method.
    cascade  T_c, read bilinearly at new UVs in which triangles share texels, gives a coordinate, which a triangle wave
             folds into [0, 1] (eq. 8). The paper's method.
    plain    No lookup texture: the lightmap at a lower resolution, or under new UVs.
    shared   The lightmaps of several sheets (UV layouts) or states (hours, light layers) share tiles. A tile has K
             components, rectangles of one size beside each other in T_p. Light in state m is

                 C_m(u) = f[m, first] + sum_k f[m, first + 1 + k] T_p[page](place by T_c, k rectangles to the right),

             with f a constant and a factor of each component, for each state and channel; negative sums become 0.
             Tiles whose light changes alike share these numbers f, a mixture. Between two states f is interpolated
             linearly. In block-compressed tiles the last components may be *coarse*: each is a single block of 4 x 4
             texels. Where states have little in common, a sheet has *separate* tiles with one component in each
             state, and light is interpolated linearly between two states.

With mips a model is `shared` and has smaller levels of each sheet, which are read in the same way.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from wlm.errors import WlmError
from wlm.formats.limits import check_sides
from wlm.system import Model, Settings

SOURCE_BITS = 48
"""Bits per texel of a lightmap: three half floats (eq. 9)."""

COLOUR_BITS = {"half": 64, "rgb9e5": 32, "bc6h": 8, "astc": 8}
"""Bits per texel of a texture on a GPU, by format: half floats, which desktop GPUs support with four channels but
not with three; RGB9E5; BC6H; ASTC 4x4."""

TEXELS, BLOCKS = "rgb9e5", "bc6h"
"""The formats of the two textures of colour "mixed"."""

BLOCK_SIDE = 4
"""Texels along a block of BC6H or ASTC."""

LUT_BITS = 32
"""Bits per entry of T_c of two numbers."""

LUT_STEPS = 65535.0
"""The integer that is a coordinate of 1 in T_c of method "cascade", and in new UVs."""

FACTOR_BITS = 128
"""Bits of a component's factors in one state: three floats, stored in a texel of four floats."""

SHEET_BITS = 128
"""Bits of the row of a sheet or level in the table of sheets: eight numbers of 16 bits."""

ENTRY, SHORT_ENTRY = 4, 2
"""Number of integers per entry of T_c; the short entry applies where all tiles have one component on one page."""

# An entry of a tile has one number per axis: the rectangle's first texel, and its number of texels less one.
SIDE_BITS = 4
MOST_SIZE = 1 << (16 - SIDE_BITS)
"""Largest number of texels of T_p, or of blocks, that an entry can address along an axis."""

COUNT_BITS, COARSE_BITS = 8, 4
"""Bit counts in an entry's fourth number: the lowest bits are the number of components, the next the number of coarse
ones, and the remaining bits the page."""

MOST_PAGES, MOST_COARSE = 1 << (16 - COUNT_BITS - COARSE_BITS), (1 << COARSE_BITS) - 1

MIP_OCTAVES = 2
"""Octaves from a lightmap to the first of its smaller levels, whose sides are a quarter as long."""

FIRST_BLOCK_CODE, NO_BLOCKS = 12, 1 << SIDE_BITS
"""The size code from which on an entry of colour "mixed" names 1 to 4 blocks along an axis instead of texels; and a
code that no entry uses."""

_BUDGET, _SHARED_BUDGET = 0.17, 0.05


class Profile(Settings):
    """Settings of a compression of lightmaps to an atlas."""

    FILES: ClassVar[str] = "atlas"

    method: Literal["tiles", "cascade"] = "tiles"
    """Method, tiles or cascade. Several lightmaps need tiles, which they then share."""
    colour: Literal["half", "rgb9e5", "bc6h", "astc", "mixed"] = "half"
    """Format of the colour texture T_p; for tiles also mixed: an RGB9E5 and a BC6H texture; each tile uses one of them.
    Several lightmaps or mips need rgb9e5 or mixed."""
    budget: float | None = Field(None, gt=0.0, le=2.0)
    """For tiles: bits of the textures as a fraction of those of all lightmaps at 48 bits per texel. It is 1 - CR of
    eq. 9; None: 0.17 for one lightmap, 0.05 for several."""
    tile: int = Field(7, ge=3, le=15)
    """For tiles: texels of the lightmap along a tile. A tile has up to one sample more per axis, enough to
    keep every texel."""
    views: int = Field(64, ge=1, le=4096)
    """Number of random views around the scene, and of as many inside; a texel weighs more if more pixels show it."""
    unseen: float = Field(0.05, gt=0.0, le=1.0)
    """For one lightmap: weight of texels that no view shows, as a fraction of the mean weight."""
    border: float = Field(16.0, gt=0.0, le=100.0)
    """For one lightmap: factor by which errors within a texel of a chart's border count more; they show as seams."""
    relative: float = Field(0.0, ge=0.0, le=1.0)
    """For one lightmap: 0 minimises the error in linear light, 1 the relative error, which counts more in dark places;
    values between mix both."""
    mips: bool = False
    """Store mip levels, within the budget, for surfaces that are far away; needs colour rgb9e5 or mixed."""
    fallback: bool = True
    """For one lightmap: store a plain smaller lightmap of as many bits instead if the error of that is no larger."""
    threshold: float = Field(0.03, ge=0.0, le=1.0)
    """For the cascade: lambda of eq. 4, the largest mean difference of the light in triangles that share texels, as a
    fraction of `max_radiance`; 0: none share."""
    colour_threshold: float = Field(0.09, ge=0.0, le=2.0)
    """For the cascade: lambda_h of section 3.2.1, the largest distance of the dominant colours of triangles that share
    texels, as a fraction of `max_radiance`."""
    max_radiance: float | None = Field(2.0, gt=0.0)
    """For the cascade: triangles with brighter texels share none, and both thresholds are fractions of this radiance
    (section 4.1.1); None: the brightest texel of the charts, which treats dark and bright lightmaps alike."""
    patch_size: Literal[2, 3, 5, 9, 17, 33, 65, 129, 257, 513, 1025, 2049, 4097] | None = None
    """For the cascade: largest number of samples along an edge of a triangle when its light is compared; None: R_s, one
    per texel of its longest edge (eq. 1)."""
    scale: float = Field(0.5, gt=0.0, le=1.0)
    """For the cascade: epsilon, texels of the repacked lightmap per original texel along a side (section 3.3.1)."""
    colour_scale: float = Field(0.4, gt=0.0, le=1.0)
    """For the cascade: epsilon_p, the colour texture T_p's sides as a fraction of the repacked lightmap's sides."""
    lut_scale: float = Field(0.7, ge=0.0, le=1.0)
    """For the cascade: epsilon_c, the lookup texture T_c's sides as a fraction of the same sides; 0: no T_c."""
    space: Literal["views", "uv"] = "views"
    """For the cascade: tune both textures by the error in random views, or (uv) at random points of the mesh."""
    steps: int = Field(5000, ge=0)
    """For the cascade: number of optimiser steps (Adam)."""
    colour_rate: float = Field(5e-4, gt=0.0, lt=1.0)
    """For the cascade: initial learning rate of the colour texture, in units of the lightmap's mean."""
    lut_rate: float = Field(5e-5, gt=0.0, lt=1.0)
    """For the cascade: initial learning rate of the lookup texture, in units of T_p's sides."""
    final_rate: float = Field(1.0, gt=0.0, le=1.0)
    """For the cascade: learning rates of the last step as a fraction of the initial ones."""
    resolution: int = Field(2048, ge=16, le=8192)
    """For the cascade: pixels along a side of a view from which the textures are tuned."""
    gradient: float = Field(1.0, ge=0.0)
    """For the cascade: weight of errors of image gradients in the loss; errors of colours weigh 1 (section 3.3.3)."""

    def override(self, values: Mapping[str, Any], prefix: str = "") -> Self:
        """Returns the profile with new `values` of settings, by name; None changes nothing. Error messages begin with
        `prefix`.

        Raises:
            WlmError: A setting is unknown or out of range; or the method is cascade and a budget or the colour "mixed"
                is given, which it can't have.
        """
        if (values.get("method") or self.method) == "cascade":
            if values.get("budget") is not None:
                raise WlmError(
                    f"{prefix}budget: expected none for method cascade, whose settings give the sizes of its textures; "
                    "choose a profile of tiles, or give no budget"
                )
            if (values.get("colour") or self.colour) == "mixed":
                raise WlmError(f"{prefix}colour: expected half, rgb9e5, bc6h or astc for a cascade, found mixed")
        return super().override(values, prefix)

    def checked(self, lightmaps: int) -> tuple[Self, str]:
        """Returns the profile with its budget filled in, and the method to use.

        Args:
            lightmaps: Number of lightmaps, UV layouts (sheets) times states.

        Returns:
            The settings, with a budget unless the method is the cascade; and "tiles", "cascade" or "shared".

        Raises:
            WlmError: The method or colour can't be used for several lightmaps or mips.
        """
        budget = self.budget or (_BUDGET if lightmaps == 1 else _SHARED_BUDGET)
        filled = self.model_copy(update={"budget": budget if self.method == "tiles" else None})
        if lightmaps == 1 and not self.mips:
            return filled, self.method
        if self.method != "tiles":
            raise WlmError(f"method: expected tiles for several lightmaps or mips, found {self.method}")
        if self.colour not in (TEXELS, "mixed"):
            raise WlmError(f"colour: expected rgb9e5 or mixed for several lightmaps or mips, found {self.colour}")
        return filled, "shared"


@dataclass(frozen=True)
class SheetPlace:
    """The place of a sheet (a UV layout with its lightmaps), or of its mip level, in the lookup texture T_c: its name,
    the size of its lightmaps in texels, its first entry's row and column, and its numbers of rows and columns of tiles,
    0 if the method has no tiles. `smaller` is the row in `AtlasModel.table` of the next smaller mip level; 0 if there
    is none."""

    name: str
    height: int
    width: int
    row: int = 0
    column: int = 0
    rows: int = 0
    columns: int = 0
    smaller: int = 0

    @property
    def size(self) -> tuple[int, int]:
        """The rows and columns of texels of the sheet's lightmaps."""
        return self.height, self.width


_FREE_TEXELS = 1 << 24  # 4,096 x 4,096 texels: a decoded lightmap of this size takes 192 MiB
_MOST_SHARE = 65536


@dataclass(frozen=True, eq=False)
class AtlasModel(Model):
    """Compressed lightmaps: S sheets (UV layouts of charts), each with a lightmap for each of M states.

    Attributes:
        name: The scene's name.
        source: Hash of the scene, `LightmappedScene.source`.
        profile: The settings of the compression.
        method: "tiles", "cascade", "plain" or "shared", see the module; "plain" also if the profile's method was no
            better. All except "shared" have one sheet and one state.
        colour: Format of T_p, as in `Profile`; "plain" is never "mixed".
        states: Names of the states.
        sheets: The places of the sheets in T_c.
        texels: half [pages, Hp, Wp, 3], T_p as decoded, finite, not negative. For "mixed" the first texture, in RGB9E5.
        lut: uint16 [Hc, Wc, 2 or 4], T_c: `pack_entries` for "tiles", coordinates in units of 1 / `LUT_STEPS` for
            "cascade", `pack_tiles`, or its first two numbers, for "shared"; [0, 0, 2] for "plain".
        blocks: uint8 [pages, B, 16], blocks of T_p, row by row; for "mixed" of its second texture; else [0, 0, 16].
        block_texels: half [pages, Hb, Wb, 3], multiples of 4, the decoded second texture of "mixed"; else [0, 0, 0, 3].
        factor: float32 [M, C, 3], finite, of any sign, for "shared": for each group of tiles that share them, a
            constant and then the components' factors; else [0, 0, 3].
        levels: For "shared" with mips, the mip levels of all sheets: a quarter of a sheet's sides, then an eighth, and
            so on.
        later: For "shared" with separate tiles for each state, the sheets and mip levels of the second state, then of
            the third and so on.
        uv: float32 [F, 3, 2] in [0, 1], rounded by `snapped`, the corners' new UVs; [0, 3, 2] if there are none.
        stored: The scene's triangles and masks; None for a model that can't be saved.
        report: Facts about the compression for the user: "seconds" by stage (not saved, since they differ from run to
            run), numbers of groups and tiles, and why the method is plain.
    """

    SYSTEM: ClassVar[str] = "atlas"

    name: str
    source: str
    profile: Profile
    method: str
    colour: str
    states: tuple[str, ...]
    sheets: tuple[SheetPlace, ...]
    texels: np.ndarray
    lut: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 2), np.uint16))
    blocks: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 16), np.uint8))
    block_texels: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 0, 3), np.float16))
    factor: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 3), np.float32))
    levels: tuple[SheetPlace, ...] = ()
    later: tuple[SheetPlace, ...] = ()
    uv: np.ndarray = field(default_factory=lambda: np.empty((0, 3, 2), np.float32))
    stored: Any = None
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def rows(self) -> tuple[SheetPlace, ...]:
        """All sheets and mip levels, in the order of `table`."""
        return (*self.sheets, *self.levels, *self.later)

    @property
    def stride(self) -> int:
        """The number of rows of `table` per state if each state has separate tiles; 0 if states share tiles and
        rows."""
        return len(self.sheets) + len(self.levels) if self.later else 0

    @property
    def first_block_code(self) -> int:
        """The smallest size code with which an entry of T_c names blocks, from the function `first_block_code`."""
        return first_block_code(self.colour)

    @property
    def bits(self) -> int:
        """The number of bits on a GPU: of T_p, T_c and, for "shared", the factors and the table of sheets."""
        side = BLOCK_SIDE if self.colour in ("bc6h", "astc") else 1
        pages, rows, columns = self.texels.shape[:3]
        first = COLOUR_BITS[TEXELS if self.colour == "mixed" else self.colour]
        bits = pages * -(-rows // side) * -(-columns // side) * side**2 * first
        bits += math.prod(self.block_texels.shape[:3]) * COLOUR_BITS[BLOCKS] + self.lut.nbytes * 8
        if self.method == "shared":
            bits += self.factor.size // 3 * FACTOR_BITS + len(self.rows) * SHEET_BITS
        return bits

    @property
    def source_bits(self) -> int:
        """The number of bits of all original lightmaps, at 48 bits per texel (eq. 9)."""
        return sum(math.prod(each.size) for each in self.sheets) * len(self.states) * SOURCE_BITS

    @property
    def compression_ratio(self) -> float:
        """CR of eq. 9 over all lightmaps: 1 minus `bits` / `source_bits`."""
        return 1.0 - self.bits / self.source_bits

    @cached_property
    def scene(self) -> Any:
        """Returns the `LightmappedScene`, without lightmaps, from the stored triangles and masks.

        Raises:
            WlmError: The stored triangles are damaged.
            ValueError: The model stores no triangles.
        """
        # `stored` imports this module, so it cannot be imported at the top.
        return import_module("wlm.atlas.stored").restore(self)

    def table(self) -> np.ndarray:
        """Makes the table of sheets for kernels and shaders, int32 [rows, 7]: rows and columns of texels, the first row
        and column in T_c, rows and columns of tiles, and the row number of the next smaller mip level. Sheets come
        first, then mip levels; if each state has separate tiles, sheets and levels are repeated for each state."""
        rows = [(s.height, s.width, s.row, s.column, s.rows, s.columns, s.smaller) for s in self.rows]
        return np.array(rows, np.int32)

    def without_mips(self) -> "AtlasModel":
        """Returns the model without its smaller mip levels. The textures still contain the texels of these levels."""
        kept = [row for at, row in enumerate(self.later) if at % (self.stride or 1) < len(self.sheets)]
        sheets, later = (tuple(replace(row, smaller=0) for row in rows) for rows in (self.sheets, kept))
        return replace(self, sheets=sheets, levels=(), later=later)


def check_area(size: tuple[int, int], texels: int, entries: int) -> None:
    """Checks that a lightmap's height and width are plausible for the numbers of texels of T_p and entries of T_c,
    since a file of a few bytes must not claim gigabytes."""
    check_sides("size", *size[::-1])
    stored = texels + entries
    if math.prod(size) > max(_FREE_TEXELS, _MOST_SHARE * stored):
        raise WlmError(
            f"size: expected at most {_MOST_SHARE} texels of a lightmap for each texel of its textures, which have "
            f"{stored}, found {size[1]}x{size[0]}"
        )


def snapped(uv: np.ndarray) -> np.ndarray:
    """Rounds UVs in [0, 1] to the nearest multiples of 1 / `LUT_STEPS`, which a file can store; returns float32."""
    return (np.rint(np.asarray(uv, np.float64) * LUT_STEPS) / LUT_STEPS).astype(np.float32)


def tile_counts(height: int, width: int, tile: int) -> tuple[int, int]:
    """Returns the rows and columns of the grid of tiles over a lightmap. The borders of tiles lie on texel centres; the
    last tiles may reach beyond the lightmap."""
    return max(1, -(-(height - 1) // tile)), max(1, -(-(width - 1) // tile))


def first_block_code(colour: str) -> int:
    """Returns the smallest size code with which an entry of the lookup texture names compressed blocks instead of
    texels; `NO_BLOCKS` if no entry does."""
    return {"mixed": FIRST_BLOCK_CODE, "bc6h": 0, "astc": 0}.get(colour, NO_BLOCKS)


def pack_entries(
    first: np.ndarray, size: np.ndarray, blocks: np.ndarray | bool = False, code: int = FIRST_BLOCK_CODE
) -> np.ndarray:
    """Encodes entries of the lookup texture T_c for the method "tiles".

    Args:
        first: int [..., 2], x and y of the rectangle's first texel, below `MOST_SIZE`, for blocks 4 times that.
        size: int [..., 2], the rectangle's texels along x and y, 1 to 16.
        blocks: bool [...], true for entries that name compressed blocks, whose first texel and size are multiples of 4.
            Sizes of other entries are at most `code`.
        code: Result of `first_block_code`.

    Returns:
        uint16 [..., 2]: the first texel shifted left by 4, plus the size minus 1. For blocks, both are in blocks
        instead of texels, and `code` is added.
    """
    first, size, blocks = np.asarray(first), np.asarray(size), np.asarray(blocks)[..., None]
    most = np.where(blocks, 1 << SIDE_BITS, code)
    if (np.where(blocks, first | size, 0) % BLOCK_SIDE).any() or (blocks.any() and (size > most).any()):
        raise ValueError("an entry of the lookup texture: expected multiples of 4 for blocks, and a size in range")
    steps = np.where(blocks, code + size // BLOCK_SIDE, size) - 1
    first = np.where(blocks, first // BLOCK_SIDE, first)
    if (first < 0).any() or (first >= MOST_SIZE).any() or (size < 1).any() or (size > 1 << SIDE_BITS).any():
        raise ValueError(f"an entry of the lookup texture: expected a place below {MOST_SIZE} and a size of 1 to 16")
    return ((first << SIDE_BITS) + steps).astype(np.uint16)


def unpack_entries(lut: np.ndarray, code: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decodes the result of `pack_entries`. Returns first texels and sizes, int64 [..., 2] each, and whether entries
    name compressed blocks, bool [..., 2]; in a valid file both axes agree."""
    lut = np.asarray(lut).astype(np.int64)
    first, size = lut >> SIDE_BITS, (lut & ((1 << SIDE_BITS) - 1)) + 1
    blocks = size > code
    return np.where(blocks, first * BLOCK_SIDE, first), np.where(blocks, (size - code) * BLOCK_SIDE, size), blocks


def pack_tiles(
    first: np.ndarray,
    size: np.ndarray,
    component: np.ndarray,
    count: np.ndarray,
    page: np.ndarray,
    blocks: np.ndarray | bool = False,
    coarse: np.ndarray | int = 0,
) -> np.ndarray:
    """Encodes entries of the lookup texture T_c for tiles that several lightmaps share, as sums of components.

    Args:
        first, size, blocks: As for `pack_entries`: the rectangle of the first component.
        component: int [...], index in `AtlasModel.factor` of the tile's constant, before its factors; below 65,536.
        count: int [...], number of components, 0 to 255; 0: the tile is black.
        page: int [...], number of the page of T_p, below `MOST_PAGES`.
        coarse: int [...], number of components stored as one block each, 0 to `MOST_COARSE`; 0 without blocks.

    Returns:
        uint16 [..., 4].
    """
    above = (np.asarray(page) << COARSE_BITS) + coarse
    rest = np.stack(np.broadcast_arrays(component, (above << COUNT_BITS) + count), -1).astype(np.uint16)
    return np.concatenate([pack_entries(first, size, blocks), rest], -1)


def unpack_tiles(lut: np.ndarray, code: int) -> tuple[np.ndarray, ...]:
    """Decodes the result of `pack_tiles`, or that of `pack_entries`, whose tiles have one component. Returns the
    arguments of `pack_tiles` in their order: int64, except `blocks`, which is bool [...]."""
    first, size, blocks = unpack_entries(lut[..., :SHORT_ENTRY], code)
    if lut.shape[-1] == SHORT_ENTRY:
        zeros = np.zeros(lut.shape[:-1], np.int64)
        return first, size, zeros, zeros + 1, zeros, blocks[..., 0], zeros
    last = lut[..., 3].astype(np.int64)
    count, above = last & ((1 << COUNT_BITS) - 1), last >> COUNT_BITS
    component, page, coarse = lut[..., 2].astype(np.int64), above >> COARSE_BITS, above & MOST_COARSE
    return first, size, component, count, page, blocks[..., 0], coarse


def coarse_place(size: np.ndarray, whole: np.ndarray, number: np.ndarray | int) -> np.ndarray:
    """Returns where a coarse component of a tile (one stored as a single block) lies, int [..., 2], in texels from the
    tile's first texel. The `whole` full components, of `size` texels each, come first, side by side; the coarse ones,
    numbered from 0 by `number`, are stacked in columns to their right."""
    column, row = np.divmod(number, np.maximum(size[..., 1] // BLOCK_SIDE, 1))
    return np.stack([size[..., 0] * whole + BLOCK_SIDE * column, BLOCK_SIDE * row], -1)


def extent(size: np.ndarray, count: np.ndarray, coarse: np.ndarray | int) -> np.ndarray:
    """Returns the texels along x and y of all components of a tile, int [..., 2]; arguments as in `pack_tiles`."""
    columns = -(-coarse // np.maximum(size[..., 1] // BLOCK_SIDE, 1))
    return np.stack([size[..., 0] * (count - coarse) + BLOCK_SIDE * columns, size[..., 1]], -1)
