"""The gaps between charts, filled after decoding so that a filter's footprint may leave a chart.

A bilinear read at the edge of a chart takes in texels outside it. The fit spends nothing on those; each takes the light
of the nearest valid texel once its map is decoded, as a baker dilates charts before a lightmap is stored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

REACH = 2
"""Texels from a chart, along rows and columns, that are filled: a bilinear read needs one, its half-size mip two."""

OFFSETS = sorted(
    ((y, x) for y in range(-REACH, REACH + 1) for x in range(-REACH, REACH + 1) if (y, x) != (0, 0)),
    key=lambda at: (at[0] ** 2 + at[1] ** 2, at),
)
"""Rows and columns to a texel's neighbours in the order in which they are asked: the nearest first, then by row."""


@dataclass(frozen=True, eq=False)
class Gaps:
    """The texels of a map that are filled.

    Attributes:
        target: int [G, 2], row and column of each.
        source: int [G, 2], of the valid texel whose light it takes.
    """

    target: np.ndarray
    source: np.ndarray

    @classmethod
    def of(cls, mask: np.ndarray) -> Gaps:
        """Finds the texels within `REACH` of a valid one, and the nearest valid one of each.

        Args:
            mask: bool [H, W], true where a texel is valid.
        """
        height, width = mask.shape
        found = np.zeros(mask.shape, np.int8)  # 1 + the place in `OFFSETS`
        if not mask.all():
            padded = np.pad(mask, REACH)
            for i, (y, x) in enumerate(OFFSETS):
                valid = padded[REACH + y : REACH + y + height, REACH + x : REACH + x + width]
                found[valid & ~mask & (found == 0)] = i + 1
        target = np.argwhere(found)
        offsets = np.array(OFFSETS)[found[found > 0].astype(int) - 1]
        return cls(target, target + offsets.reshape(-1, 2))

    def fill(self, image: np.ndarray) -> None:
        """Fills a decoded map [H, W, C] in place."""
        image[tuple(self.target.T)] = image[tuple(self.source.T)]

    def within(self, window: tuple[slice, slice]) -> Gaps:
        """Those whose target lies in a window of the map, in the map's rows and columns."""
        inside = [(at >= part.start) & (at < part.stop) for at, part in zip(self.target.T, window, strict=True)]
        chosen = inside[0] & inside[1]
        return Gaps(self.target[chosen], self.source[chosen])
