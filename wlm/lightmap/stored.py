"""Tiles of a lightmap file that are read and unpacked when they are needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from wlm.errors import WlmError
from wlm.formats import zstd
from wlm.formats.artifact import Pieces
from wlm.lightmap.encodings import encoding_of
from wlm.lightmap.model import PACKED, PACKED_KINDS, SheetModel, part_table
from wlm.workers import each

_FEW = 4  # tiles that are unpacked without threads, whose start takes as long


@dataclass(frozen=True, eq=False)
class PackedMask:
    """The mask of an atlas, which is unpacked at its first use: at 4096 x 4096 texels that takes as long as some tiles.

    `frame` is a zstd frame of a bit for each texel, row-major, the first in the highest bit of the first byte; None:
    all are valid. `where` names the file and the sheet in messages.
    """

    where: str
    shape: tuple[int, int]
    frame: bytes | None

    def check(self) -> None:
        """Checks that the frame states the right size. Raises a ValueError if it does not."""
        if self.frame is not None:
            zstd.check_frame(self.frame, -(-math.prod(self.shape) // 8), "part mask")

    def bits(self) -> np.ndarray | None:
        """Unpacks the frame, uint8 [bytes]; None if all texels are valid."""
        try:
            size = -(-math.prod(self.shape) // 8)
            data = None if self.frame is None else zstd.decompress(self.frame, size, "part mask")
        except ValueError as error:
            raise WlmError(f"{self.where}: {error}") from error
        return None if data is None else np.frombuffer(data, np.uint8)

    @cached_property
    def texels(self) -> np.ndarray:
        """Which texels are valid, bool [H, W]; for errors see `bits`."""
        if (bits := self.bits()) is None:
            return np.ones(self.shape, bool)
        return np.unpackbits(bits, count=math.prod(self.shape)).view(bool).reshape(self.shape)


@dataclass(frozen=True, eq=False)
class StoredTiles:
    """The packed tiles of a sheet in a file, or of a model that is about to be saved: a zstd frame for each, by rising
    number, int [n], and the sheet's mask. `where` names the file and the sheet in messages."""

    where: str
    numbers: np.ndarray
    pieces: Sequence[bytes]
    mask: PackedMask

    def read(self, sheet: SheetModel) -> dict[str, np.ndarray]:
        """Reads and unpacks the tiles of a sheet, which may have some of the file's tiles. Returns the arrays in
        `PACKED`, by name."""
        table, filled = part_table(sheet.profile, sheet.kind, len(sheet.times)), copy(sheet)
        arrays = {name: np.zeros(table[name].shape, table[name].dtype) for name in PACKED}
        vars(filled).update(arrays)

        def unpack(number: int) -> None:
            encoding = encoding_of(sheet.kind[number])
            try:
                frame = self.pieces[int(np.searchsorted(self.numbers, number))]
                data = zstd.decompress(frame, encoding.packed_size(filled, number), "the packed tile")
                encoding.unpack(filled, number, np.frombuffer(data, np.uint8))
            except (WlmError, ValueError) as error:
                raise WlmError(f"{self.where}: tile {number}: {error}") from error

        numbers = sheet.numbers(*PACKED_KINDS).tolist()
        for _ in each(unpack, numbers) if len(numbers) > _FEW else map(unpack, numbers):
            continue
        return arrays

    def close(self) -> None:
        """Closes the file, if the pieces are in one."""
        if isinstance(self.pieces, Pieces):
            self.pieces.close()
