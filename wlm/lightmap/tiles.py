"""Cuts lightmaps into tiles, classifies the tiles, and assembles maps from them.

Each tile is fitted, stored and streamed on its own (neural-dynamic-gi, sections 3.5 and 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import check_sides
from wlm.lightmap.data import SheetFrames
from wlm.texels import fill_gaps
from wlm.workers import each

TILE = 128
"""Texels along a side of a tile, as in table 1 of the paper."""

# A colour that was encoded and decoded again in float32 is off by a few parts in 10^6; a half float's step is at
# least 488 such parts, so one step with this slack is never mistaken for two.
_STEP_SLACK = 1.01
_FLAT_DB = 50.0  # an error between half a level and one level of 8 bits
_OUTLIER = 4.0  # largest error of one texel, so that a single texel of another value does not count as flat
_HALF_MIN_EXPONENT = -14  # below 2**-14 half floats are subnormal and their step no longer shrinks
_HALF_MANTISSA_BITS = 10


@dataclass(frozen=True)
class TileGrid:
    """The grid of 128 x 128 tiles that covers a map of `height` x `width` texels, numbered row by row; tiles may reach
    past the map's edges."""

    height: int
    width: int
    rows: int
    cols: int

    @classmethod
    def of(cls, height: int, width: int) -> TileGrid:
        """Makes the grid of a map of `height` x `width` texels; raises WlmError if the size is out of range."""
        check_sides("size", width, height)
        return cls(height, width, -(-height // TILE), -(-width // TILE))

    @property
    def count(self) -> int:
        """Number of tiles, empty ones included."""
        return self.rows * self.cols

    def origin(self, index: int) -> tuple[int, int]:
        """Returns the row and the column of the first texel of tile `index`, which is in [0, count)."""
        if not 0 <= index < self.count:
            raise WlmError(f"tiles: tile {index} is outside the grid of {self.rows}x{self.cols} tiles")
        row, column = divmod(int(index), self.cols)
        return row * TILE, column * TILE

    def window(self, index: int) -> tuple[slice, slice]:
        """Returns the rows and the columns of the map that a tile covers."""
        y, x = self.origin(index)
        return slice(y, min(y + TILE, self.height)), slice(x, min(x + TILE, self.width))

    def tiles_with(self, mask: np.ndarray) -> np.ndarray:
        """Returns which tiles have a true texel in a mask [H, W], bool [rows, columns]."""
        whole = np.zeros((self.rows * TILE, self.cols * TILE), bool)
        whole[: self.height, : self.width] = mask
        return whole.reshape(self.rows, TILE, self.cols, TILE).any(axis=(1, 3))

    def texels_of(self, tiles: np.ndarray) -> np.ndarray:
        """Returns a mask of the texels of chosen tiles, bool [H, W], given bool [rows, columns]."""
        return tiles.repeat(TILE, 0).repeat(TILE, 1)[: self.height, : self.width]


@dataclass(frozen=True, eq=False)
class TileData:
    """N tiles as gamma-space colours, padded to 128 x 128 texels, with their numbers in the grid, int64 [N], row-major.

    `colour`, float32 [N, T, 128, 128, 3], is `irradiance ** (1 / gamma)`: texels outside the mask repeat the nearest
    valid one of the tile; past the map's end its last row and column repeat; all is 0 in an empty tile. `mask`, bool
    [N, 128, 128], is true where a texel is valid; false past the map's end.
    """

    index: np.ndarray
    colour: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True, eq=False)
class TileCut:
    """N tiles as array views into their lightmaps, without a copy: numbers int64 [N] in the grid, and for each tile the
    irradiance at T times, float32 [T, h, w, 3], and the mask, bool [h, w]; h and w are 128, or less at the map's end.
    """

    index: np.ndarray
    light: list[np.ndarray]
    mask: list[np.ndarray]

    def encoded(self, gamma: float) -> TileData:
        """Converts the tiles to gamma-space colours, padded to 128 x 128 texels, which take N * T * 192 KiB."""
        colour = np.zeros((len(self.index), len(self.light[0]), TILE, TILE, 3), np.float32)

        def encode(i: int) -> None:
            valid, out = self.mask[i], colour[i]
            if not valid.any():
                return
            rows, columns = valid.shape
            out[:, :rows, :columns] = fill_gaps(self.light[i], valid)
            out[:, :rows, columns:] = out[:, :rows, columns - 1 : columns]
            out[:, rows:] = out[:, rows - 1 : rows]
            if gamma != 1.0:
                np.power(out, np.float32(1.0 / gamma), out=out)

        list(each(encode, range(len(self.index))))
        return TileData(self.index, colour, np.stack(list(map(_whole, self.mask))))


class TileKind(IntEnum):
    """How a tile is stored. The numbers are written to files."""

    EMPTY = 0
    """No valid texel: nothing is stored."""
    CONSTANT = 1
    """One colour at each time for all texels."""
    DYNAMIC = 3
    """Feature maps and a network."""
    FRAMES = 4
    """The lightmap of each time as BC7, see `wlm.lightmap.encodings.frames`."""


def split(lightmaps: SheetFrames, gamma: float, tiles: Sequence[int] | None = None) -> TileData:
    """Cuts a sheet, or the tiles of it with the given numbers, into tiles of gamma-encoded colour, `x ** (1 / gamma)`,
    which gives dark values more precision (neural-dynamic-gi, section 4). N tiles take N * T * 192 KiB of memory."""
    grid = TileGrid.of(*lightmaps.mask.shape)
    return cut(lightmaps, np.arange(grid.count) if tiles is None else np.array(list(tiles), np.int64)).encoded(gamma)


def cut(lightmaps: SheetFrames, index: np.ndarray) -> TileCut:
    """Cuts the tiles with the numbers `index` out of a sheet, without a copy. Raises WlmError as `check_index` does."""
    grid = TileGrid.of(*lightmaps.mask.shape)
    check_index(index, grid)
    windows = [grid.window(tile) for tile in index]
    return TileCut(index, [lightmaps.frames[:, *at] for at in windows], [lightmaps.mask[at] for at in windows])


def valid_texels(mask: np.ndarray, number: int) -> np.ndarray:
    """Cuts tile `number` out of a mask [H, W]: bool [128, 128], false past the map's edges."""
    return _whole(mask[TileGrid.of(*mask.shape).window(number)])


def classify(colour: np.ndarray, gamma: float, peak: float | None = None) -> TileKind:
    """Finds the kind of a tile that is not stored as frames: `EMPTY`, `CONSTANT` or `DYNAMIC`.

    A tile is constant if, at every time, the greatest value of each channel is at most one step of half float above the
    least, in linear space. For values that are not light, whose range is `peak`, it also is if, at every time, its
    channel means have a PSNR of `_FLAT_DB` and no texel is off by more than `_OUTLIER` times the RMS error at that
    PSNR: 8-bit sources are never exactly flat.

    Args:
        colour: float32 [T, K, 3], the K valid texels at each time, in gamma space.
        gamma: Exponent that makes them linear.
        peak: See `wlm.lightmap.profile.Profile.peak`.
    """
    if not colour.size:
        return TileKind.EMPTY
    encoded = colour.astype(np.float64)
    # Decoding is monotonic, so the extremes are taken before it.
    low, high = encoded.min(axis=1) ** gamma, encoded.max(axis=1) ** gamma
    constant = (high - low <= _STEP_SLACK * _half_step(low)).all() or (peak and _is_flat(encoded**gamma, peak))
    return TileKind.CONSTANT if constant else TileKind.DYNAMIC


def check_index(index: np.ndarray, grid: TileGrid) -> None:
    """Raises `WlmError` unless the tile numbers `index`, `[N]`, are in the grid and distinct, with at least one."""
    if not index.size:
        raise WlmError("tiles: expected at least one tile, got none")
    for tile in (index.min(), index.max()):
        grid.origin(tile)
    numbers, counts = np.unique(index, return_counts=True)
    if (counts > 1).any():
        raise WlmError(f"tiles: tile {numbers[counts > 1][0]} is given twice")


def place(image: np.ndarray, tiles: np.ndarray, index: np.ndarray, grid: TileGrid) -> None:
    """Writes tiles [N, 128, 128, C], of the given numbers [N] in the grid, into a map [H, W, C]; texels past the map's
    end are dropped."""
    for tile, number in zip(tiles, index, strict=True):
        part = image[grid.window(number)]
        part[...] = tile[: part.shape[0], : part.shape[1]]


def _whole(valid: np.ndarray) -> np.ndarray:
    mask = np.zeros((TILE, TILE), bool)
    mask[: valid.shape[0], : valid.shape[1]] = valid
    return mask


def _half_step(value: np.ndarray) -> np.ndarray:
    """Returns the distance from each non-negative value to the next larger half float."""
    # frexp gives value = m 2^e with m in [0.5, 1): the leading bit is worth 2^(e - 1).
    exponent = np.frexp(value)[1] - 1
    exponent = np.where(value > 0, np.maximum(exponent, _HALF_MIN_EXPONENT), _HALF_MIN_EXPONENT)
    return np.ldexp(1.0, exponent - _HALF_MANTISSA_BITS)


def _is_flat(linear: np.ndarray, peak: float) -> bool:
    error = np.abs(linear - linear.mean(axis=1, keepdims=True))
    allowed = peak * 10.0 ** (-_FLAT_DB / 20.0)
    return bool((np.square(error).mean((1, 2)) <= allowed**2).all() and error.max() <= _OUTLIER * allowed)
