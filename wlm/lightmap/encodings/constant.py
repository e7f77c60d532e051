"""Encoding of constant tiles, whose texels all have the same colour at a time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from wlm.formats.folder import rounded
from wlm.lightmap.encodings.base import DeviceTiles, Encoding
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TILE, TileKind


class ConstantTiles(DeviceTiles):
    """The constant tiles of a sheet. They need no memory on the device."""

    def __init__(self, sheet: SheetModel) -> None:
        """Takes the colours of the sheet's constant tiles."""
        super().__init__(sheet.numbers(TileKind.CONSTANT))
        self._axis, self._colours = sheet.axis, sheet.constant.astype(np.float32)

    def colours(self, time: float) -> np.ndarray:
        """Returns the linear radiance of all tiles, float32 [n, 3]."""
        before, after, share = self._axis.neighbours(time)
        return (1.0 - share) * self._colours[:, before] + share * self._colours[:, after]

    def radiance(self, rows: np.ndarray, time: float) -> np.ndarray:
        return np.broadcast_to(self.colours(time)[rows, None, None], (len(rows), TILE, TILE, 3)).astype(np.float32)


class Constant(Encoding):
    """Stores one colour for each time in the arrays of the sheet; `pack` gives no bytes."""

    kind = TileKind.CONSTANT

    def upload(self, sheet: SheetModel, device: str, gelu: str) -> list[DeviceTiles]:
        return [ConstantTiles(sheet)] if len(sheet.constant) else []

    def describe(self, sheet: SheetModel, number: int) -> dict[str, Any]:
        return {"radiance": rounded(sheet.constant[sheet.row(number)])}

    def fill_records(self, sheet: SheetModel, times: Sequence[float], records: np.ndarray) -> None:
        colours, numbers = sheet.constant.astype(np.float64), sheet.numbers(TileKind.CONSTANT)
        for table, time in zip(records, times, strict=True):
            before, after, share = sheet.axis.neighbours(time)
            light = (1.0 - share) * colours[:, before] + share * colours[:, after]
            table[numbers, 1, :3] = light ** (1.0 / sheet.profile.gamma)
