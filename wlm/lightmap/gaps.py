"""Fills the gaps between charts after decoding, so that filtered reads at the edge of a chart are correct.

A bilinear read at the edge of a chart includes texels outside it. The fit ignores these texels. After decoding, each of
them takes the light of the nearest valid texel, as a baker dilates charts before it stores a lightmap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wlm.texels import near_gaps


@dataclass(frozen=True, eq=False)
class Gaps:
    """The texels of a map that are filled.

    Attributes:
        target: int [G, 2], row and column of each filled texel.
        source: int [G, 2], row and column of the valid texel whose light it takes.
    """

    target: np.ndarray
    source: np.ndarray

    @classmethod
    def of(cls, mask: np.ndarray) -> Gaps:
        """Finds the texels to fill: invalid ones within `wlm.texels.REACH` of a valid one of a mask [H, W]."""
        return cls(*near_gaps(mask))

    def fill(self, image: np.ndarray) -> None:
        """Fills the gaps of a decoded map [H, W, C] in place."""
        image[tuple(self.target.T)] = image[tuple(self.source.T)]

    def within(self, window: tuple[slice, slice]) -> Gaps:
        """Returns the gaps whose target lies in a window of the map, in rows and columns of the map."""
        inside = [(at >= part.start) & (at < part.stop) for at, part in zip(self.target.T, window, strict=True)]
        chosen = inside[0] & inside[1]
        return Gaps(self.target[chosen], self.source[chosen])
