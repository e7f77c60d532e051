"""What of a tile's maps decoding reads: no more than that is worth a bit in the file."""

from dataclasses import dataclass

import numpy as np

from wlm.lightmap.model import Profile, TimeAxis, encode_time
from wlm.lightmap.tiles import TILE

_SLACK = 1e-4  # of a cell: float32 may round a place to either side of a cell's middle


@dataclass(frozen=True, eq=False)
class Reads:
    """What the valid texels of a dynamic tile read, at the times that a decoder evaluates.

    Attributes:
        slices: bool [S], of F_uvt.
        texels: bool [R, R], of each of these slices.
        rows: bool [rows], of F_ut and F_vt.
        columns: bool [2, columns], of F_ut and of F_vt.
    """

    slices: np.ndarray
    texels: np.ndarray
    rows: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, used: np.ndarray, profile: Profile, axis: TimeAxis) -> "Reads":
        """Those of a tile.

        Args:
            used: bool [128, 128], the tile's valid texels.
            profile: The settings.
            axis: The time axis. Where light is interpolated as radiance, stored times alone are evaluated.
        """
        centres = (np.arange(TILE) + 0.5) / TILE
        across = _cells(centres, profile.uvt_resolution).astype(np.int64)
        along = _cells(centres, profile.plane_columns)
        slices, rows = (
            _cells(encode_time(axis)[0], count, axis.periodic).any(0)
            if axis.interpolation == "radiance"
            else np.ones(count, bool)
            for count in (profile.uvt_slices, profile.plane_rows)
        )
        return cls(
            slices,
            across.T @ used @ across > 0,
            rows,
            np.stack([along[used.any(axis)].any(0) for axis in (0, 1)]),
        )


def _cells(places: np.ndarray, count: int, periodic: bool = False) -> np.ndarray:
    """The cells of an axis that linear filtering reads at places in [0, 1], bool [places, count]."""
    x = np.asarray(places, np.float64) * count - 0.5
    first, last = np.floor(x - _SLACK), np.floor(x + _SLACK) + 1
    cells = np.zeros((len(x), count), bool)
    for step in range(3):
        cell = np.minimum(first + step, last).astype(np.int64)
        cells[np.arange(len(x)), cell % count if periodic else cell.clip(0, count - 1)] = True
    return cells
