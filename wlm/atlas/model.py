"""The model of a lightmap atlas: its settings and its arrays, as stored and as used.

A lightmap is read through a look-up table (lightmap-uv-clustering-cascade, eq. 7): C(u) = T_p(F(T_c(u))), with T_c the
small table, T_p the small colour texture and one of these for F:

    tiles    u picks a tile of the lightmap; its entry of T_c, read without a filter, says which rectangle of T_p holds
             the tile, and u's place in the tile is u's place in the rectangle. Ours.
    cascade  T_c is read with a bilinear filter and gives a coordinate, which a triangle wave brings into [0, 1]
             (eq. 8). The paper's; u is a coordinate of the mesh's new, shared UVs.
    plain    there is no table: the lightmap at a lower resolution, or under new UVs.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from wlm.config import load_settings, profile_path

__all__ = [
    "BLOCK_SIDE",
    "COLOUR_BITS",
    "LUT_BITS",
    "MOST_SIZE",
    "SOURCE_BITS",
    "SIDE_BITS",
    "AtlasModel",
    "Profile",
    "compression_ratio",
    "load_profile",
    "pack_entries",
    "unpack_entries",
]

SOURCE_BITS = 48
"""Of a texel of the lightmap: three half floats (eq. 9)."""

COLOUR_BITS = {"half": 48, "bc6h": 8, "astc": 8}
"""Of a texel of T_p, by how it is stored: half floats, BC6H or ASTC 4x4."""

BLOCK_SIDE = 4
"""Texels along a block of BC6H or ASTC."""

LUT_BITS = 32
"""Of an entry of T_c: two numbers of 16 bits."""

# An entry of a tile is two numbers, one an axis: the rectangle's first texel, and its texels less one.
SIDE_BITS = 4
MOST_SIZE = 1 << (16 - SIDE_BITS)
"""Texels that T_p may have along an axis, where tiles are."""


class Profile(BaseModel):
    """Settings of a compression.

    Attributes:
        name: Shown in reports.
        method: "tiles" or "cascade", see the module.
        colour: How T_p is stored: "half" floats, "bc6h" or "astc" (4x4).
        budget: Of "tiles": bits of T_p and T_c as a share of the lightmap's at 48 bits a texel, 1 - CR of eq. 9.
        tile: Of "tiles": texels of the lightmap along a tile, 3 to 15. A tile has up to one sample more, so that
            the longest of them keeps every texel.
        views: Random views of the unit sphere from which it is counted how much each texel is seen; 0: texels count
            by their area on the mesh.
        unseen: Weight of what no view sees, as a share of the mean weight.
        border: Weight of what lies within a texel of a chart's border, as a multiple: an error there is a seam.
        fallback: Whether a plain smaller lightmap of as many bits takes the place of what has the larger error.
        threshold: lambda of eq. 4; 0 shares no triangles.
        colour_threshold: lambda_h of section 3.2.1.
        max_radiance: Triangles with a brighter texel are not shared, and lambda and lambda_h are shares of it (section
            4.1.1); null: the brightest texel of the charts, so that a dark lightmap is told apart as a bright one is.
        scale: epsilon, of the repacked lightmap (section 3.3.1).
        colour_scale: epsilon_p, of T_p against that.
        lut_scale: epsilon_c, of T_c against that; 0: no table, method "plain".
        space: Where T_p and T_c are tuned: in random "views", or in "uv" at points of the mesh's surface.
        steps: Of Adam.
        colour_rate, lut_rate: First learning rates of T_p, whose unit is the lightmap's mean, and of T_c.
        final_rate: Both rates end here, as a share of the first.
        resolution: Pixels along a side of a view.
        gradient: Weight of the image gradients' L1 in the loss beside the colours' L1 (section 3.3.3).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    method: Literal["tiles", "cascade"] = "tiles"
    colour: Literal["half", "bc6h", "astc"] = "half"
    budget: float = Field(0.17, gt=0.0, le=2.0)
    tile: int = Field(7, ge=3, le=15)
    views: int = Field(64, ge=0, le=4096)
    unseen: float = Field(0.05, gt=0.0, le=1.0)
    border: float = Field(16.0, gt=0.0, le=100.0)
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


def load_profile(name: str) -> Profile:
    """Loads ``configs/atlas-NAME.yaml``, or a YAML file of one's own.

    Raises:
        WlmError: Unknown profile, unreadable file, or a wrong setting.
    """
    path = name if name.endswith((".yaml", ".yml")) else profile_path("atlas", name)
    return load_settings(Profile, path)


@dataclass(frozen=True, eq=False)
class AtlasModel:
    """A compressed lightmap.

    Attributes:
        name: Of the mesh.
        source: ``LightmappedMesh.source``.
        profile: What it was asked to be.
        method: What it is: "tiles", "cascade" or "plain". It may be "plain" where the method does not pay.
        colour: How T_p is stored, as in ``Profile``.
        height, width: Texels of the lightmap.
        texels: half [Hp, Wp, 3], T_p, finite, not negative; what ``blocks`` decode to where there are any.
        blocks: uint8 [B, 16], the blocks of T_p, row by row, or [0, 16].
        lut: uint16 [Hc, Wc, 2], T_c: of "tiles" ``pack_entries``' [ty, tx, 2]; of "cascade" coordinates in 1 / 65535;
            [0, 0, 2] of "plain".
        uv: float32 [F, 3, 2] in [0, 1], the corners' new UVs; [0, 3, 2] where the mesh keeps its own.
        report: What was found on the way, for people: seconds by stage, groups, why it is plain.
    """

    name: str
    source: str
    profile: Profile
    method: str
    colour: str
    height: int
    width: int
    texels: np.ndarray
    blocks: np.ndarray
    lut: np.ndarray
    uv: np.ndarray
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def compression_ratio(self) -> float:
        """CR of eq. 9."""
        return compression_ratio(self.texels.shape[:2], self.lut.shape[:2], (self.height, self.width), self.colour)


def compression_ratio(texels: tuple[int, int], lut: tuple[int, int], size: tuple[int, int], colour: str) -> float:
    """CR of eq. 9: 1 less the bits of both textures over the lightmap's.

    Args:
        texels: Rows and columns of T_p. Whole blocks count, where it is made of them.
        lut: Of T_c, (0, 0) for none.
        size: Of the lightmap.
        colour: How T_p is stored, as in ``Profile``.
    """
    side = 1 if colour == "half" else BLOCK_SIDE
    rows, columns = (-(-count // side) * side for count in texels)
    bits = rows * columns * COLOUR_BITS[colour] + lut[0] * lut[1] * LUT_BITS
    return 1.0 - bits / (size[0] * size[1] * SOURCE_BITS)


def pack_entries(first: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Entries of T_c for tiles.

    Args:
        first: int [..., 2], x and y of the rectangle's first texel, below ``MOST_SIZE``.
        size: int [..., 2], its texels along x and y, 1 to 16.

    Returns:
        uint16 [..., 2]: ``first`` shifted left by 4, plus ``size`` - 1.

    Raises:
        ValueError: A number out of range.
    """
    first, size = np.asarray(first), np.asarray(size)
    if (first < 0).any() or (first >= MOST_SIZE).any() or (size < 1).any() or (size > 1 << SIDE_BITS).any():
        raise ValueError(f"an entry beyond a texture of {MOST_SIZE} texels or a tile of {1 << SIDE_BITS}")
    return ((first << SIDE_BITS) + size - 1).astype(np.uint16)


def unpack_entries(lut: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undoes ``pack_entries``: first texels and sizes, int64 [..., 2] each."""
    lut = np.asarray(lut).astype(np.int64)
    return lut >> SIDE_BITS, (lut & ((1 << SIDE_BITS) - 1)) + 1
