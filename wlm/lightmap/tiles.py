"""Cutting a lightmap set into tiles, and the least model that each needs.

A tile is the unit of streaming and of fitting, with a model of its own (neural-dynamic-gi, sections 3.5 and 9).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.data import LightmapSet
from wlm.texels import check_size, fill_gaps
from wlm.workers import each

TILE = 128  # texels a side: the paper's tile (Table 1)

# A colour that was encoded and decoded again in float32 is off by a few parts in 10^6; a half float's step is at
# least 488 such parts, so one step with this slack is never mistaken for two.
_STEP_SLACK = 1.01
_FLAT_DB = 50.0  # between half and one level of 8 bits
_OUTLIER = 4.0  # a single texel of another value is within the budget of most tiles, and not what it means
_HALF_MIN_EXPONENT = -14  # below 2**-14 half floats are subnormal and their step no longer shrinks
_HALF_MANTISSA_BITS = 10


@dataclass(frozen=True)
class TileGrid:
    """How tiles cover a map: row-major; the last row and column reach past its end where its size is no multiple of
    a tile's.

    Attributes:
        height: Height of the map in texels.
        width: Width of the map in texels.
        rows: Tiles from top to bottom.
        cols: Tiles from left to right.
    """

    height: int
    width: int
    rows: int
    cols: int

    @classmethod
    def of(cls, height: int, width: int) -> TileGrid:
        """Makes the grid of a map.

        Args:
            height: In texels, at least 1.
            width: In texels, at least 1.

        Raises:
            WlmError: A size is below 1, or beyond what `wlm.texels.check_size` allows.
        """
        check_size(height, width)
        return cls(height, width, -(-height // TILE), -(-width // TILE))

    @property
    def count(self) -> int:
        """Number of tiles, empty ones included."""
        return self.rows * self.cols

    def origin(self, index: int) -> tuple[int, int]:
        """Returns row and column of a tile's first texel.

        Args:
            index: Number of the tile, row-major, in [0, count).

        Raises:
            WlmError: The number is outside the grid.
        """
        if not 0 <= index < self.count:
            raise WlmError(f"tiles: tile {index} is outside the grid of {self.rows}x{self.cols} tiles")
        row, column = divmod(int(index), self.cols)
        return row * TILE, column * TILE


@dataclass(frozen=True, eq=False)
class TileData:
    """A batch of N tiles, ready for fitting.

    Attributes:
        index: `[N]` int64, number of each tile in its grid, row-major.
        colour: `[N, T, 128, 128, 3]` float32, `irradiance ** (1 / gamma)`. Texels outside the mask hold the
            nearest valid one of the tile; past the map's end its last row and column repeat. All zero in an empty
            tile.
        mask: `[N, 128, 128]` bool, true where a texel is valid; false past the map's end.
    """

    index: np.ndarray
    colour: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True, eq=False)
class TileCut:
    """N tiles of a set as they are in it.

    Attributes:
        index: `[N]` int64, number of each tile in its grid, row-major.
        light: Of each tile `[T, h, w, 3]` float32, irradiance; h and w are 128, or less at the map's end.
        mask: Of each `[h, w]` bool, true where a texel is valid.
    """

    index: np.ndarray
    light: list[np.ndarray]
    mask: list[np.ndarray]

    def encoded(self, gamma: float) -> TileData:
        """The tiles ready for fitting; they take N * T * 192 KiB of memory."""
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
        return TileData(self.index, colour, np.stack([_whole(valid) for valid in self.mask]))


class TileKind(IntEnum):
    """The least model that a tile needs; the numbers are those in files."""

    EMPTY = 0
    """No valid texel: nothing is stored."""
    CONSTANT = 1
    """One colour per time."""
    STATIC = 2
    """One colour per time and one pattern for all times."""
    DYNAMIC = 3
    """The full model."""
    FRAMES = 4
    """The lightmap of each time as BC7, see `wlm.lightmap.frames`."""
    VIDEO = 5
    """The lightmaps of all times as a part of an AV1 stream, see `wlm.lightmap.video`."""
    LEVELS = 6
    """The lightmap of each time as levels that are coded without loss, see `wlm.lightmap.levels`."""


UNPACKED = (TileKind.VIDEO, TileKind.LEVELS)
"""Kinds whose levels of 10 bits are unpacked when a file is read: one for decoders, shaders and engines."""


def split(lightmaps: LightmapSet, gamma: float, tiles: Sequence[int] | None = None) -> TileData:
    """Cuts a set into tiles of gamma-encoded colour (neural-dynamic-gi, section 4).

    Args:
        lightmaps: The set, `[T, H, W, 3]`.
        gamma: Colours are stored as `x ** (1 / gamma)`, which spends precision on the dark; above 0.
        tiles: Numbers of the tiles, in the order of the result; None for all. They take N * T * 192 KiB of memory.

    Returns:
        The N tiles.

    Raises:
        WlmError: A number is outside the grid or given twice, there is none, or gamma is not above 0.
    """
    _check_gamma(gamma)
    grid = TileGrid.of(*lightmaps.mask.shape)
    return cut(lightmaps, np.arange(grid.count) if tiles is None else np.array(list(tiles), np.int64)).encoded(gamma)


def cut(lightmaps: LightmapSet, index: np.ndarray) -> TileCut:
    """Cuts tiles out of a set, without a copy.

    Args:
        lightmaps: The set, `[T, H, W, 3]`.
        index: `[N]` int64, numbers of the tiles.

    Raises:
        WlmError: A number is outside the grid or given twice, or there is none.
    """
    grid = TileGrid.of(*lightmaps.mask.shape)
    check_index(index, grid)
    windows = []
    for tile in index:
        y, x = grid.origin(tile)
        windows.append((slice(y, min(y + TILE, grid.height)), slice(x, min(x + TILE, grid.width))))
    return TileCut(index, [lightmaps.frames[:, *at] for at in windows], [lightmaps.mask[at] for at in windows])


def valid_texels(mask: np.ndarray, number: int) -> np.ndarray:
    """The valid texels of a tile, bool [128, 128]; none past the map's end.

    Args:
        mask: bool [H, W], true where a texel is valid.
        number: Of the tile in the grid.
    """
    y, x = TileGrid.of(*mask.shape).origin(number)
    return _whole(mask[y : y + TILE, x : x + TILE])


def channel_means(colour: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Mean of each channel of each tile at each time, over the valid texels (neural-dynamic-gi, section 4).

    Args:
        colour: `[N, T, 128, 128, 3]`, as in `TileData`.
        mask: `[N, 128, 128]` bool.

    Returns:
        `[N, T, 3]` float64, summed in float64; 0 for an empty tile.
    """
    means = np.zeros((*colour.shape[:2], 3))
    for n, valid in enumerate(mask):
        if valid.any():
            # [T, K, 3]: only the valid texels are summed, so what the gaps hold has no weight.
            means[n] = colour[n][:, valid].mean(axis=1, dtype=np.float64)
    return means


def static_pattern(colour: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Pattern of each tile whose product with the means approximates a tile whose light only changes in strength.

    It is the sum over t of colour over the sum over t of means: weighted by the means, so that a nearly black time,
    whose texels are a few steps of half float apart, hardly counts, and a mean of 0 is never divided by.
    `means * pattern` is exact where the tile is the product of one colour per time and a pattern, in gamma-encoded
    and so in linear space.

    Args:
        colour: `[N, T, 128, 128, 3]`, as in `TileData`.
        means: `[N, T, 3]`, from `channel_means`.

    Returns:
        `[N, 128, 128, 3]` float64 with a mean of 1 over the valid texels; 0 in a channel that is black at
        every time.
    """
    total = means.sum(axis=1)[:, None, None, :]
    pattern = np.zeros((len(colour), *colour.shape[2:]))
    np.divide(colour.sum(axis=1, dtype=np.float64), total, out=pattern, where=total > 0)
    return pattern


def classify(tiles: TileData, gamma: float, static_budget_db: float = 60.0, peak: float | None = None) -> np.ndarray:
    """Finds the least model that each tile needs, from a stated error budget.

    In linear space, over the valid texels:

    - `EMPTY`: there is none.
    - `CONSTANT`: at every time no channel spans more than one step of half float, as wide as it is at the
      channel's least value. A half-float source holds nothing finer. An all-zero tile is one.
    - `STATIC`: `means * static_pattern` is good enough at every time: its PSNR, with the range of the tile at
      that time as the peak (neural-dynamic-gi, section 10.2), is at least the budget, or no channel of any
      texel is more than one step of half float off. The second covers times whose range is zero or so small
      that the PSNR would measure the half float. A set of one time is such a product exactly.
    - `DYNAMIC`: the rest.

    With a peak, of values that aren't light, the PSNR's peak is that one, and a tile is constant as well where at every
    time its channels' means have a PSNR of `_FLAT_DB` and no texel is off by more than `_OUTLIER` times the error that
    this allows: sources of 8 bits are never flat.

    Args:
        tiles: From `split`.
        gamma: The one given to `split`.
        static_budget_db: The lowest PSNR in decibels that makes a tile static; infinite admits only what is within a
            step of half float.
        peak: Of `wlm.lightmap.model.Profile`.

    Returns:
        `[N]` int64 of `TileKind`.

    Raises:
        WlmError: Gamma is not above 0, or the budget is NaN.
    """
    _check_gamma(gamma)
    if math.isnan(static_budget_db):
        raise WlmError("tiles: expected static_budget_db in decibels, got NaN")
    means = channel_means(tiles.colour, tiles.mask)
    kinds = np.empty(len(tiles.index), np.int64)
    for n, valid in enumerate(tiles.mask):
        colour = tiles.colour[n]
        if not valid.any():
            kinds[n] = TileKind.EMPTY
        elif _is_constant(colour, valid, gamma) or (peak and _is_flat(colour, valid, gamma, peak)):
            kinds[n] = TileKind.CONSTANT
        elif _is_static(colour, valid, means[n], gamma, static_budget_db, peak):
            kinds[n] = TileKind.STATIC
        else:
            kinds[n] = TileKind.DYNAMIC
    return kinds


def check_index(index: np.ndarray, grid: TileGrid) -> None:
    """Checks numbers of tiles, `[N]`.

    Raises:
        WlmError: There is none, one is outside the grid, or one is given twice.
    """
    if not index.size:
        raise WlmError("tiles: expected at least one tile, got none")
    for tile in (index.min(), index.max()):
        grid.origin(tile)
    numbers, counts = np.unique(index, return_counts=True)
    if (counts > 1).any():
        raise WlmError(f"tiles: tile {numbers[counts > 1][0]} is given twice")


def parse_tiles(text: str, count: int) -> list[int]:
    """Reads a list of tiles: numbers and closed ranges, separated by commas.

    Args:
        text: Such as "0-3,7".
        count: Number of tiles in the grid.

    Returns:
        The numbers in the order written.

    Raises:
        WlmError: A part that is neither, a range that runs down, a number outside [0, count) or given twice.
    """
    tiles: list[int] = []
    for part in text.split(","):
        # At most 9 digits: a longer number is outside any grid, and int() refuses very long ones in its own
        # words.
        match = re.fullmatch(r"\s*([0-9]{1,9})\s*(?:-\s*([0-9]{1,9})\s*)?", part)
        if not match:
            raise WlmError(f"tiles: expected a number or first-last, got {part.strip()!r} in {text!r}")
        first = int(match[1])
        last = first if match[2] is None else int(match[2])
        if last < first:
            raise WlmError(f"tiles: the range {part.strip()!r} runs down; expected first-last")
        if last >= count:
            raise WlmError(f"tiles: tile {last} is out of range; expected 0 to {count - 1}")
        tiles.extend(range(first, last + 1))
    for tile, count in Counter(tiles).items():
        if count > 1:
            raise WlmError(f"tiles: tile {tile} is given twice in {text!r}")
    return tiles


def assemble(tiles: np.ndarray, index: np.ndarray, grid: TileGrid, fill: float = 0.0) -> np.ndarray:
    """Puts tiles back into a map; the inverse of `split`.

    Args:
        tiles: `[N, 128, 128, C]`, any dtype.
        index: `[N]`, number of each tile in the grid.
        grid: The map's.
        fill: Value of the texels of tiles that `index` lacks.

    Returns:
        `[H, W, C]`, of the tiles' dtype. What the tiles hold past the map's end is dropped.

    Raises:
        WlmError: Shapes do not fit, or a number is outside the grid or given twice.
    """
    tiles = np.asarray(tiles)
    index = np.asarray(index)
    if tiles.ndim != 4 or tiles.shape[1:3] != (TILE, TILE) or index.shape != tiles.shape[:1]:
        raise WlmError(
            f"tiles: expected tiles [N, {TILE}, {TILE}, C] and N numbers, got {tiles.shape} and {index.shape}"
        )
    check_index(index, grid)
    image = np.full((grid.height, grid.width, tiles.shape[3]), fill, tiles.dtype)
    place(image, tiles, index, grid)
    return image


def place(image: np.ndarray, tiles: np.ndarray, index: np.ndarray, grid: TileGrid) -> None:
    """Writes tiles into a map.

    Args:
        image: `[H, W, C]`, written.
        tiles: `[N, 128, 128, C]`. What they hold past the map's end is dropped.
        index: `[N]`, number of each tile in the grid.
        grid: The map's.
    """
    for tile, number in zip(tiles, index, strict=True):
        y, x = grid.origin(number)
        part = image[y : y + TILE, x : x + TILE]
        part[...] = tile[: part.shape[0], : part.shape[1]]


def _whole(valid: np.ndarray) -> np.ndarray:
    """The valid texels of a tile [h, w] as [128, 128]."""
    mask = np.zeros((TILE, TILE), bool)
    mask[: valid.shape[0], : valid.shape[1]] = valid
    return mask


def _check_gamma(gamma: float) -> None:
    if not (math.isfinite(gamma) and gamma > 0):
        raise WlmError(f"tiles: expected a finite gamma above 0, got {gamma}")


def _half_step(value: np.ndarray) -> np.ndarray:
    """Distance from each non-negative value to the next larger half float, at any magnitude."""
    # frexp gives value = m 2^e with m in [0.5, 1): the leading bit is worth 2^(e - 1).
    exponent = np.frexp(value)[1] - 1
    exponent = np.where(value > 0, np.maximum(exponent, _HALF_MIN_EXPONENT), _HALF_MIN_EXPONENT)
    return np.ldexp(1.0, exponent - _HALF_MANTISSA_BITS)


def _is_constant(colour: np.ndarray, valid: np.ndarray, gamma: float) -> bool:
    """Whether no channel of [T, 128, 128, 3] spans more than a step of half float at any time."""
    encoded = colour[:, valid].astype(np.float64)  # [T, K, 3]
    # Decoding is monotonic, so the extremes are taken before it.
    low, high = encoded.min(axis=1) ** gamma, encoded.max(axis=1) ** gamma
    return bool((high - low <= _STEP_SLACK * _half_step(low)).all())


def _is_flat(colour: np.ndarray, valid: np.ndarray, gamma: float, peak: float) -> bool:
    """Whether the channels' means are near all texels of [T, 128, 128, 3] at every time, see `classify`."""
    linear = colour[:, valid].astype(np.float64) ** gamma
    error = np.abs(linear - linear.mean(axis=1, keepdims=True))
    allowed = peak * 10.0 ** (-_FLAT_DB / 20.0)
    return bool((np.square(error).mean((1, 2)) <= allowed**2).all() and error.max() <= _OUTLIER * allowed)


def _is_static(
    colour: np.ndarray,  # [T, 128, 128, 3]
    valid: np.ndarray,  # [128, 128]
    means: np.ndarray,  # [T, 3]
    gamma: float,
    budget_db: float,
    set_peak: float | None,
) -> bool:
    """Whether one colour per time, multiplied by one pattern, meets the budget at every time."""
    pattern = static_pattern(colour[None], means[None])[0][valid] ** gamma  # [K, 3]
    for frame, mean in zip(colour, means, strict=True):
        linear = frame[valid].astype(np.float64) ** gamma
        error = np.abs(mean**gamma * pattern - linear)
        if (error <= _STEP_SLACK * _half_step(linear)).all():
            continue
        peak = np.ptp(linear) if set_peak is None else set_peak
        # A range of zero is one grey in all channels; the error above is then more than a step of half float.
        if peak == 0.0 or 10.0 * math.log10(peak * peak / np.mean(np.square(error))) < budget_db:
            return False
    return True
