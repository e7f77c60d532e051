"""Base classes of the ways to store a tile: `Encoding` on the host, `DeviceTiles` for decoding on a device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from wlm.bundle import Texture
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TileKind


class DeviceTiles(ABC):
    """All tiles of a sheet that are stored with the same encoding, uploaded to a device, where they take
    `device_bytes`; `numbers`, int [n], are their numbers in the grid, rising."""

    device_bytes = 0

    def __init__(self, numbers: np.ndarray) -> None:
        """Takes the numbers of the tiles in the grid, in increasing order."""
        self.numbers = numbers
        self._row_of = {int(number): row for row, number in enumerate(numbers)}

    def among(self, numbers: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Finds the tiles of this encoding in `numbers`; returns their indices there and in `self.numbers`, int32."""
        pairs = [(i, self._row_of[number]) for i, number in enumerate(numbers) if number in self._row_of]
        places, rows = np.array(pairs, np.int32).reshape(-1, 2).T
        return places, np.ascontiguousarray(rows)

    @abstractmethod
    def radiance(self, rows: np.ndarray, time: float) -> np.ndarray:
        """Decodes the k tiles `numbers[rows]` to radiance, float32 [k, 128, 128, 3]; gaps between charts stay."""


class Encoding(ABC):
    """One way to store tiles, those of one kind."""

    kind: ClassVar[TileKind]

    def packed_size(self, sheet: SheetModel, number: int) -> int:
        """Returns the number of bytes that `pack` gives for a tile: 0, unless a subclass overrides both."""
        return 0

    def pack(self, sheet: SheetModel, number: int) -> bytes:
        """Returns a tile's maps and network, or its frames, as bytes."""
        return b""

    def unpack(self, sheet: SheetModel, number: int, data: np.ndarray) -> None:  # noqa: B027
        """Writes a tile, given as the bytes of `pack`, uint8, into the arrays of a sheet. Raises a WlmError or
        ValueError if the bytes are not a valid tile of this encoding."""

    @abstractmethod
    def upload(self, sheet: SheetModel, device: str, gelu: str) -> list[DeviceTiles]:
        """Uploads a sheet's tiles of this encoding to a device; returns an empty list if the sheet has none. `gelu` is
        the GELU variant of the networks, see `wlm_kernels.mlp`."""

    def textures(self, sheet: SheetModel) -> dict[str, Texture]:
        """Returns the textures that the shader reads for tiles of this encoding, by name."""
        return {}

    @abstractmethod
    def describe(self, sheet: SheetModel, number: int) -> dict[str, Any]:
        """Returns the entry of a tile in the JSON document of a bundle, as JSON values."""

    @abstractmethod
    def fill_records(self, sheet: SheetModel, times: Sequence[float], records: np.ndarray) -> None:
        """Writes the records of all tiles of this encoding into the shader's tables, one table for each given time.

        `times` are stored times, or any times if the model interpolates with the network. `records`, float32 [times,
        tiles, rows, 4], is written; each tile has a record of `record_fours` rows, whose first number is already set.
        """


def columns(count: int, height: int, width: int) -> int:
    """Returns how many images to put in a row so that a texture of `count` images is about as wide as high."""
    return max(int(np.ceil(np.sqrt(count * height / width))), 1)


def side_by_side(images: np.ndarray, fmt: str, height: int, width: int) -> dict[str, Any]:
    """Arranges images, [n, rows, columns, bytes] of texels or blocks, side by side in several rows of one texture;
    returns the keyword arguments of `Texture`. `height` and `width` are the size of an image in texels."""
    across = columns(len(images), height, width)
    missing = -len(images) % across
    padded = np.concatenate([images, np.zeros((missing, *images.shape[1:]), images.dtype)])
    grid = padded.reshape(-1, across, *images.shape[1:]).swapaxes(1, 2)
    data = np.ascontiguousarray(grid).reshape(grid.shape[0] * grid.shape[1], -1, images.shape[-1])
    return {"data": data, "fmt": fmt, "width": across * width, "height": -(-len(images) // across) * height}
