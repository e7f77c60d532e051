"""The model of a lightmap atlas: its settings and its arrays, as stored and as used.

A lightmap is read through a look-up table (lightmap-uv-clustering-cascade, eq. 7): C(u) = T_p(F(T_c(u))), with T_c the
small table, T_p the small colour texture and one of these for F:

    tiles    u lies in a tile of the lightmap. The tile's entry of T_c, read without a filter, names a rectangle of T_p;
             relative position in the tile is relative position in the rectangle. Ours.
    cascade  T_c, read bilinearly at the mesh's new, shared UVs, gives a coordinate, which a triangle wave folds into
             [0, 1] (eq. 8). The paper's.
    plain    No table: the lightmap at a lower resolution, or under new UVs.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from wlm.errors import WlmError
from wlm.system import Model, Settings
from wlm.texels import check_size

SOURCE_BITS = 48
"""Bits per texel of the lightmap: three half floats (eq. 9)."""

COLOUR_BITS = {"half": 64, "rgb9e5": 32, "bc6h": 8, "astc": 8}
"""Bits per texel of a texture on a GPU, by how it is stored: half floats, which desktop GPUs have of four channels and
not of three; RGB9E5; BC6H; ASTC 4x4."""

TEXELS, BLOCKS = "rgb9e5", "bc6h"
"""The formats of the two textures of colour "mixed"."""

BLOCK_SIDE = 4
"""Texels along a block of BC6H or ASTC."""

LUT_BITS = 32
"""Bits per entry of T_c: two numbers of 16 bits."""

LUT_STEPS = 65535.0
"""The integer that is a coordinate of 1 in T_c of method "cascade"."""

# An entry of a tile has one number per axis: the rectangle's first texel, and its number of texels less one.
SIDE_BITS = 4
MOST_SIZE = 1 << (16 - SIDE_BITS)
"""Most places along an axis that entries of method "tiles" can name: texels of T_p, or blocks."""

TAIL_OCTAVES = 2
"""Of mips: how much smaller than the lightmap the tail's first level is, a power of two."""

FIRST_BLOCK_CODE, NO_BLOCKS = 12, 1 << SIDE_BITS
"""Of colour "mixed": the size's code from which on an entry names blocks, 1 to 4 along an axis, and not texels; a code
that no entry has."""


class Profile(Settings):
    """Settings of a compression.

    Attributes:
        name: Shown in reports.
        method: "tiles" or "cascade", see the module.
        colour: How T_p is stored: "half" floats, "rgb9e5", "bc6h" or "astc" (4x4); or, for "tiles", "mixed": two
            textures, RGB9E5 and BC6H, and each tile in one of them.
        budget: For "tiles": bits of T_p and T_c as a fraction of the lightmap's at 48 bits per texel, 1 - CR of eq. 9.
        tile: For "tiles": texels of the lightmap along a tile, 3 to 15. A tile has up to one sample more per axis, and
            with these it keeps every texel.
        views: Random views of the unit sphere; a texel counts by the pixels that show it. 0: by its area on the mesh.
        unseen: Weight of what no view shows, as a fraction of the mean weight.
        border: Factor on the weight within a texel of a chart's border: an error there is a seam.
        relative: How much of the weight is of the relative error, 0 to 1; the rest is of the error in linear light.
        mips: Whether there is a tail of smaller levels, `wlm.atlas.mips`; for "tiles" its bits are part of the budget.
        fallback: Whether a plain smaller lightmap of as many bits replaces the result if its error is no larger.
        threshold: lambda of eq. 4; 0 shares no triangles.
        colour_threshold: lambda_h of section 3.2.1.
        max_radiance: Triangles with a brighter texel are not shared, and lambda and lambda_h are fractions of it
            (section 4.1.1); null: the brightest texel of the charts, which treats dark and bright lightmaps alike.
        scale: epsilon, of the repacked lightmap (section 3.3.1).
        colour_scale: epsilon_p, sides of T_p over those of the repacked lightmap.
        lut_scale: epsilon_c, the same for T_c; 0: no table, method "plain".
        space: Where T_p and T_c are tuned: in random "views", or in "uv" at points of the mesh's surface.
        steps: Steps of Adam.
        colour_rate, lut_rate: Initial learning rates of T_p, in units of the lightmap's mean, and of T_c.
        final_rate: Learning rates of the last step as a fraction of the initial ones.
        resolution: Pixels along a side of a view.
        gradient: Weight of the image gradients' L1 in the loss beside the colours' L1 (section 3.3.3).
    """

    FILES: ClassVar[str] = "atlas"

    method: Literal["tiles", "cascade"] = "tiles"
    colour: Literal["half", "rgb9e5", "bc6h", "astc", "mixed"] = "half"
    budget: float = Field(0.17, gt=0.0, le=2.0)
    tile: int = Field(7, ge=3, le=15)
    views: int = Field(64, ge=0, le=4096)
    unseen: float = Field(0.05, gt=0.0, le=1.0)
    border: float = Field(16.0, gt=0.0, le=100.0)
    relative: float = Field(0.0, ge=0.0, le=1.0)
    mips: bool = False
    fallback: bool = True
    threshold: float = Field(0.03, ge=0.0, le=1.0)
    colour_threshold: float = Field(0.09, ge=0.0, le=2.0)
    max_radiance: float | None = Field(2.0, gt=0.0)
    scale: float = Field(0.5, gt=0.0, le=1.0)
    colour_scale: float = Field(0.4, gt=0.0, le=1.0)
    lut_scale: float = Field(0.7, ge=0.0, le=1.0)
    space: Literal["views", "uv"] = "views"
    steps: int = Field(5000, ge=0)
    colour_rate: float = Field(5e-4, gt=0.0, lt=1.0)
    lut_rate: float = Field(5e-5, gt=0.0, lt=1.0)
    final_rate: float = Field(1.0, gt=0.0, le=1.0)
    resolution: int = Field(2048, ge=16, le=8192)
    gradient: float = Field(1.0, ge=0.0)

    def override(self, values: Mapping[str, Any], prefix: str = "") -> Self:
        """Replaces some settings, as `wlm.system.Settings.override`.

        Raises:
            WlmError: Unknown or out of range; or a budget or two textures for the cascade, which has none.
        """
        if (values.get("method") or self.method) == "cascade":
            if values.get("budget") is not None:
                raise WlmError(
                    f"{prefix}budget: profiles of the cascade have sizes of their own; expected one of tiles, or none"
                )
            if (values.get("colour") or self.colour) == "mixed":
                raise WlmError(f"{prefix}colour: expected half, rgb9e5, bc6h or astc for a cascade, found mixed")
        return super().override(values, prefix)


_FREE_TEXELS = 1 << 24  # 4,096 x 4,096, of which a decoded lightmap takes 192 MiB
_MOST_SHARE = 65536


@dataclass(frozen=True, eq=False)
class AtlasModel(Model):
    """A compressed lightmap.

    Attributes:
        name: The mesh's name.
        source: `LightmappedMesh.source`.
        profile: The settings of the compression.
        method: "tiles", "cascade" or "plain"; "plain" also where the profile's method does not pay.
        colour: How T_p is stored, as in `Profile`; "plain" is never "mixed".
        height, width: Texels of the lightmap.
        texels: half [Hp, Wp, 3], T_p, finite, not negative; what is stored decodes to just that. Of "mixed" the
            texture in RGB9E5.
        blocks: uint8 [B, 16], the blocks of T_p, row by row; of "mixed" those of its second texture; [0, 16] for none.
        block_texels: half [Hb, Wb, 3], multiples of 4, the second texture of "mixed"; [0, 0, 3] for none.
        lut: uint16 [Hc, Wc, 2], T_c: for "tiles" `pack_entries`' [ty, tx, 2]; for "cascade" coordinates in units of
            1 / `LUT_STEPS`; [0, 0, 2] for "plain".
        tail: uint8 [B, 16], the mips' blocks, level by level, of ASTC beside it and else of BC6H; [0, 16] for none.
        uv: float32 [F, 3, 2] in [0, 1], the corners' new UVs; [0, 3, 2] where the mesh keeps its own.
        report: Facts about the compression, for people: "seconds" by stage (not saved, since they differ from run to
            run), groups, why it is plain.
    """

    SYSTEM: ClassVar[str] = "atlas"

    name: str
    source: str
    profile: Profile
    method: str
    colour: str
    height: int
    width: int
    texels: np.ndarray
    blocks: np.ndarray = field(default_factory=lambda: np.empty((0, 16), np.uint8))
    block_texels: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 3), np.float16))
    lut: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 2), np.uint16))
    tail: np.ndarray = field(default_factory=lambda: np.empty((0, 16), np.uint8))
    uv: np.ndarray = field(default_factory=lambda: np.empty((0, 3, 2), np.float32))
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def compression_ratio(self) -> float:
        """CR of eq. 9."""
        textures = (self.texels.shape[:2], self.lut.shape[:2], (self.height, self.width), self.colour)
        return compression_ratio(*textures, self.block_texels.shape[:2], len(self.tail))

    @property
    def first_block_code(self) -> int:
        """That of the entries of T_c, `first_block_code`."""
        return first_block_code(self.colour, self.texels.shape[:2])


def check_area(size: tuple[int, int], texels: tuple[int, int], lut: tuple[int, int]) -> None:
    """Checks that a lightmap is no larger than its textures can make plausible: a few bytes must not claim gigabytes.

    Args:
        size: Rows and columns of the lightmap.
        texels: Those of T_p.
        lut: Those of T_c, (0, 0) for none.

    Raises:
        WlmError: The lightmap is beyond what `wlm.texels.check_size` allows; or it has more than 2^24 texels, and more
            than 65,536 for each texel of T_p and T_c.
    """
    check_size(*size)
    stored = math.prod(texels) + math.prod(lut)
    if math.prod(size) > max(_FREE_TEXELS, _MOST_SHARE * stored):
        raise WlmError(
            f"size: expected a lightmap of at most {_MOST_SHARE} texels for each of the {stored} that its textures "
            f"hold, found {size[1]}x{size[0]}"
        )


def compression_ratio(
    texels: tuple[int, int],
    lut: tuple[int, int],
    size: tuple[int, int],
    colour: str,
    block_texels: tuple[int, int] = (0, 0),
    tail: int = 0,
) -> float:
    """CR of eq. 9: 1 less the bits of the textures on a GPU over the lightmap's at 48 a texel.

    Args:
        texels: Rows and columns of T_p. Blocks count whole.
        lut: Rows and columns of T_c, (0, 0) for none.
        size: Rows and columns of the lightmap.
        colour: How T_p is stored, as in `Profile`.
        block_texels: Rows and columns of the second texture of "mixed".
        tail: Blocks of the mips.
    """
    first = TEXELS if colour == "mixed" else colour
    side = BLOCK_SIDE if first in ("bc6h", "astc") else 1
    rows, columns = (-(-count // side) * side for count in texels)
    bits = rows * columns * COLOUR_BITS[first] + lut[0] * lut[1] * LUT_BITS
    bits += (math.prod(block_texels) + tail * BLOCK_SIDE**2) * COLOUR_BITS[BLOCKS]
    return 1.0 - bits / (size[0] * size[1] * SOURCE_BITS)


def tail_shapes(height: int, width: int) -> list[tuple[int, int]]:
    """Rows and columns of the mips of a lightmap: a quarter, in whole blocks, then halves, rounded down, to one texel.

    The first level is a margin larger than a quarter where that isn't of whole blocks, which Direct3D and browsers ask
    for: `tail_share` of it is the lightmap.
    """
    step = BLOCK_SIDE << TAIL_OCTAVES
    height, width = (-(-side // step) * BLOCK_SIDE for side in (height, width))
    levels = max(height, width).bit_length()
    return [(max(height >> level, 1), max(width >> level, 1)) for level in range(levels)]


def tail_share(height: int, width: int) -> tuple[float, float]:
    """How much of the mips is the lightmap, from the first texel on, along v and u."""
    first = tail_shapes(height, width)[0]
    return height / (first[0] << TAIL_OCTAVES), width / (first[1] << TAIL_OCTAVES)


def tail_codec(colour: str) -> str:
    """The format of the mips' blocks, by `colour` of the model: that which its GPU has."""
    return "astc" if colour == "astc" else BLOCKS


def tail_blocks(height: int, width: int) -> int:
    """Blocks of a level of so many rows and columns."""
    return -(-height // BLOCK_SIDE) * -(-width // BLOCK_SIDE)


def tail_bits(height: int, width: int) -> int:
    """Bits of the mips of a lightmap on a GPU."""
    return sum(tail_blocks(*shape) for shape in tail_shapes(height, width)) * BLOCK_SIDE**2 * COLOUR_BITS[BLOCKS]


def disk_ratio(file_bytes: int, size: tuple[int, int]) -> float:
    """CR of a model's file: 1 less its bits over the lightmap's.

    Args:
        file_bytes: The file's size.
        size: Rows and columns of the lightmap.
    """
    return 1.0 - file_bytes * 8 / (size[0] * size[1] * SOURCE_BITS)


def tile_counts(height: int, width: int, tile: int) -> tuple[int, int]:
    """Rows and columns of the grid of tiles over a lightmap: the shape of T_c for "tiles".

    Tiles span texel centres; the last ones may reach beyond the lightmap.
    """
    return max(1, -(-(height - 1) // tile)), max(1, -(-(width - 1) // tile))


def first_block_code(colour: str, shape: tuple[int, ...]) -> int:
    """The size's code from which on an entry of T_c names blocks, and not texels; `NO_BLOCKS` if none does.

    Args:
        colour: How T_p is stored, as in `Profile`.
        shape: Rows and columns of T_p. Of BC6H and ASTC all entries name blocks where it has more than `MOST_SIZE`
            texels along a side: of lightmaps above some 5,000 x 5,000.
    """
    if colour == "mixed":
        return FIRST_BLOCK_CODE
    return 0 if colour in ("bc6h", "astc") and max(shape) > MOST_SIZE else NO_BLOCKS


def pack_entries(
    first: np.ndarray, size: np.ndarray, blocks: np.ndarray | bool = False, code: int = FIRST_BLOCK_CODE
) -> np.ndarray:
    """Encodes entries of T_c for tiles.

    Args:
        first: int [..., 2], x and y of the rectangle's first texel, below `MOST_SIZE`, of blocks below four times that.
        size: int [..., 2], the rectangle's texels along x and y, 1 to 16.
        blocks: bool [...], where an entry names blocks: first texel and size are multiples of 4, and sizes of other
            entries are at most `code`.
        code: `first_block_code`.

    Returns:
        uint16 [..., 2]: the first texel shifted left by 4, plus the size less 1. Of blocks, their numbers in place of
        texels', and the size's part is `code` more.

    Raises:
        ValueError: A number is out of range.
    """
    first, size, blocks = np.asarray(first), np.asarray(size), np.asarray(blocks)[..., None]
    most = np.where(blocks, 1 << SIDE_BITS, code)
    if (np.where(blocks, first | size, 0) % BLOCK_SIDE).any() or (blocks.any() and (size > most).any()):
        raise ValueError("an entry that isn't of whole blocks, or beyond the sizes beside them")
    steps = np.where(blocks, code + size // BLOCK_SIDE, size) - 1
    first = np.where(blocks, first // BLOCK_SIDE, first)
    if (first < 0).any() or (first >= MOST_SIZE).any() or (size < 1).any() or (size > 1 << SIDE_BITS).any():
        raise ValueError(f"an entry beyond a texture of {MOST_SIZE} texels or a tile of {1 << SIDE_BITS}")
    return ((first << SIDE_BITS) + steps).astype(np.uint16)


def unpack_entries(lut: np.ndarray, code: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decodes `pack_entries`.

    Args:
        lut: uint16 [..., 2].
        code: `first_block_code`.

    Returns:
        First texels and sizes, int64 [..., 2] each, and whether they name blocks, bool [..., 2]: of a sound file the
        same along both axes.
    """
    lut = np.asarray(lut).astype(np.int64)
    first, size = lut >> SIDE_BITS, (lut & ((1 << SIDE_BITS) - 1)) + 1
    blocks = size > code
    return np.where(blocks, first * BLOCK_SIDE, first), np.where(blocks, (size - code) * BLOCK_SIDE, size), blocks
