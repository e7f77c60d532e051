"""The gaps between charts, which are filled after decoding so that a filtered read may leave a chart.

A bilinear read at the edge of a chart includes texels outside it. The fit spends nothing on those; each takes the light
of the nearest valid texel once its map is decoded, as a baker dilates charts before a lightmap is stored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wlm.texels import near_gaps


@dataclass(frozen=True, eq=False)
class Gaps:
    """The texels of a map that are filled.

    Attributes:
        target: int [G, 2], row and column of each.
        source: int [G, 2], row and column of the valid texel whose light it takes.
    """

    target: np.ndarray
    source: np.ndarray

    @classmethod
    def of(cls, mask: np.ndarray) -> Gaps:
        """Finds the invalid texels within `wlm.texels.REACH` of a valid one, given the valid texels [H, W]."""
        return cls(*near_gaps(mask))

    def fill(self, image: np.ndarray) -> None:
        """Fills the gaps of a decoded map [H, W, C] in place."""
        image[tuple(self.target.T)] = image[tuple(self.source.T)]

    def within(self, window: tuple[slice, slice]) -> Gaps:
        """Returns the gaps whose target lies in a window of the map, in rows and columns of the map."""
        inside = [(at >= part.start) & (at < part.stop) for at, part in zip(self.target.T, window, strict=True)]
        chosen = inside[0] & inside[1]
        return Gaps(self.target[chosen], self.source[chosen])
