"""The model of a scene's lightmaps: one table and one texture for all sheets and all states.

The lightmaps of a sheet share its tiles. Light at a point in state m is a sum over components,

    C_m(u) = sum_k f[m, k] T_p[page K + k](place of u by T_c),

with K layers of T_p for each page, and f a factor for each state, component and channel. With as many components as
states they are the states' own light and f is 1 or 0; with fewer, which pays where light changes over hours, they are
what the states have in common (`mixture`). Between two states light and so f is linear.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from wlm.atlas.model import LUT_BITS, SOURCE_BITS
from wlm.system import Model, Settings

TEXEL_BITS = 32
"""Bits of a texel of T_p: RGB9E5."""

FACTOR_BITS = 96
"""Bits of a component's factors in a state: three floats."""


class SceneProfile(Settings):
    """Settings of a scene's compression.

    Attributes:
        name: Shown in reports.
        budget: Bits of T_p, T_c and the factors as a fraction of all lightmaps' at 48 bits per texel, 1 - CR of eq. 9.
        tile: Texels of a lightmap along a tile, 3 to 15.
        components: K, of each texel; 0: the number that leaves the least error.
        views: Random views around the scene, and as many from inside; a texel counts by the pixels that show it.
        unseen: Weight of what no view shows, as a fraction of the mean weight of the scene.
        border: Factor on the weight within a texel of a chart's border.
    """

    FILES: ClassVar[str] = "atlas-scene"

    budget: float = Field(0.05, gt=0.0, le=2.0)
    tile: int = Field(7, ge=3, le=15)
    components: int = Field(0, ge=0, le=64)
    views: int = Field(64, ge=1, le=4096)
    unseen: float = Field(0.05, gt=0.0, le=1.0)
    border: float = Field(4.0, gt=0.0, le=100.0)


@dataclass(frozen=True)
class SheetPlace:
    """Where a sheet is.

    Attributes:
        name: For people.
        height, width: Texels of its lightmaps.
        row, column: Its first entry in T_c.
        rows, columns: Its tiles.
        page: Its page of T_p.
    """

    name: str
    height: int
    width: int
    row: int
    column: int
    rows: int
    columns: int
    page: int


@dataclass(frozen=True, eq=False)
class SceneModel(Model):
    """Compressed lightmaps of a scene.

    Attributes:
        name: The scene's name.
        source: `LightmappedScene.source`.
        profile: The settings of the compression.
        states: Names of the states, M.
        sheets: At least one.
        factor: float32 [M, K, 3], finite, not negative.
        texels: uint32 [pages K, Hp, Wp], T_p, RGB9E5; a page's components follow each other.
        lut: uint16 [Hc, Wc, 2], T_c: `wlm.atlas.model.pack_entries`.
        report: Facts about the compression, for people.
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
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def bits(self) -> int:
        """Bits of T_p, T_c and the factors."""
        entries = self.lut.shape[0] * self.lut.shape[1]
        return self.texels.size * TEXEL_BITS + entries * LUT_BITS + self.factor.size // 3 * FACTOR_BITS

    @property
    def compression_ratio(self) -> float:
        """CR of eq. 9 over all lightmaps."""
        source = sum(each.height * each.width for each in self.sheets) * SOURCE_BITS * len(self.states)
        return 1.0 - self.bits / source

    def table(self) -> np.ndarray:
        """int32 [S, 7], the sheets as kernels and shaders read them: rows and columns of texels, first row and column
        in T_c, rows and columns of tiles, page."""
        rows = [(s.height, s.width, s.row, s.column, s.rows, s.columns, s.page) for s in self.sheets]
        return np.array(rows, np.int32)
