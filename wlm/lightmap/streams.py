"""Streams of coded numbers: maps, planes, bytes and levels to a stream and back, see `wlm_kernels.lightmap.coder`.

A stream's first byte has the number of lowest bits that are 0 in all numbers of it (0 to 7), and 8 more where it holds
everything, what isn't read as well.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

from wlm_kernels.lightmap import coder, level_coder, tile_coder

_ROOM = 2.0  # of a stream, beside what its numbers take uncoded
_WHOLE = 8

LEVELS = 1 << level_coder.LEVEL_BITS
"""Levels of a channel, from 0."""


@dataclass(frozen=True)
class _Size:
    """What a coder has room for, and the width of its predictions at first."""

    width: int
    mixtures: int = coder.MIXTURES
    trees: int = coder.TREES
    bits: int = 8
    nodes: int = 512


_SIZES = {
    "blocks": _Size(12),
    "numbers": _Size(25),
    "levels": _Size(4, level_coder.LEVEL_MIXTURES, level_coder.LEVEL_TREES, level_coder.LEVEL_BITS, LEVELS),
}


@dataclass(frozen=True, eq=False)
class BlockGrid:
    """The blocks of a map.

    Attributes:
        side: Blocks along u and along v.
        used: bool [side * side, 16], texels that are read, in every slice that is.
        slices: bool [S], slices that are read.
    """

    side: int
    used: np.ndarray
    slices: np.ndarray


def load_kernels(module: ModuleType) -> None:
    """Compiles the kernels of `tile_coder` or `level_coder`, which threads are to find compiled."""
    wp.load_module(module, "cpu")
    _tables()


@cache
def _tables() -> tuple[wp.array, wp.array, wp.array]:
    """Logarithm, sigmoid and rate, see `coder.Coder`."""
    logarithm = [0] + [round(256 * math.log(i)) for i in range(1, 65538)]
    half = coder.HALF
    sigmoid = [round(65536 / (1 + math.exp((half - i) / 256))) for i in range(2 * half)]
    rate = [131072 // (2 * n + 3) for n in range(coder.LIMIT + 1)]
    return _array(logarithm), _array(sigmoid), _array(rate)


def code_blocks(ends: np.ndarray, indices: np.ndarray, grid: BlockGrid) -> bytes:
    """Codes BC7 mode 6 blocks.

    Args:
        ends: uint8 [n, 2, 4], of blocks slice by slice, row by row.
        indices: uint8 [n, 16].
        grid: What they are, n of them.
    """
    used = _everywhere(grid)
    whole = bool((ends[~used.any(1)]).any() or indices[~used].any())
    if whole:
        used = np.ones_like(used)
    held = _held(grid, whole)
    ends, indices, used = (values[held] for values in (ends.reshape(-1, 8), indices, used))
    ordered = used[:, 0] & (ends[:, :4].sum(1, dtype=int) > ends[:, 4:].sum(1, dtype=int))
    ends = np.where(ordered[:, None], np.roll(ends, 4, 1), ends)
    indices = np.where(ordered[:, None] & used, 15 - indices, indices)
    # All lowest bits of ends are 0, and so many of the others, or none is left out.
    zeros = min(_zeros(ends), 7)
    coarse = max(zeros - 1, 0)
    arrays = _array(ends), _array(indices)
    return _written(
        lambda c: _launch_blocks(c, grid, whole, coarse, *arrays), len(ends) * 17, "blocks", coarse | _WHOLE * whole
    )


def read_blocks(stream: np.ndarray, grid: BlockGrid) -> tuple[np.ndarray, np.ndarray]:
    """Reads what `code_blocks` wrote: ends and indices.

    Raises:
        ValueError: The stream isn't one of such blocks.
    """
    coarse, whole = _first(stream)
    held = _held(grid, whole)
    count = len(grid.slices) * grid.side**2
    ends, indices = np.zeros((count, 8), np.uint8), np.zeros((count, 16), np.uint8)
    found = _array(np.zeros((int(held.sum()), 8))), _array(np.zeros((int(held.sum()), 16)))
    _read(stream, "blocks", lambda c: _launch_blocks(c, grid, whole, coarse, *found))
    ends[held], indices[held] = (values.numpy() for values in found)
    used = np.ones((count, 16), bool) if whole else _everywhere(grid)
    swapped = used[:, 0] & (indices[:, 0] > 7)
    ends[swapped] = np.roll(ends[swapped], 4, 1)
    indices[swapped] = (15 - indices[swapped]) * used[swapped]
    return ends.reshape(-1, 2, 4), indices


def code_plane(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> bytes:
    """Codes a plane.

    Args:
        values: uint8 [rows, columns, 2].
        rows, columns: bool, those that are read.
    """
    read = rows[:, None] & columns
    whole = bool(values[~read].any())
    chosen = np.moveaxis(values if whole else values[rows][:, columns], 2, 0)
    coarse = min(_zeros(chosen), 7)
    array = _array(chosen)
    return _written(
        lambda c: _launch(c, tile_coder.code_planes, coarse, array), chosen.size, "numbers", coarse | _WHOLE * whole
    )


def read_plane(stream: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Reads what `code_plane` wrote.

    Raises:
        ValueError: The stream isn't one of such a plane.
    """
    coarse, whole = _first(stream)
    if whole:
        rows, columns = np.ones_like(rows), np.ones_like(columns)
    found = _array(np.zeros((2, int(rows.sum()), int(columns.sum()))))
    _read(stream, "numbers", lambda c: _launch(c, tile_coder.code_planes, coarse, found))
    values = np.zeros((len(rows), len(columns), 2), np.uint8)
    values[np.ix_(rows, columns)] = np.moveaxis(found.numpy(), 0, 2)
    return values


def code_bytes(values: np.ndarray, classes: np.ndarray) -> bytes:
    """Codes bytes.

    Args:
        values: uint8 [n].
        classes: int [n], 0 to 7; bytes of one class are alike.
    """
    arrays = _array(classes), _array(values)
    return _written(lambda c: _launch(c, tile_coder.code_bytes, *arrays), len(values), "numbers", 0)


def read_bytes(stream: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Reads what `code_bytes` wrote.

    Raises:
        ValueError: The stream isn't one of so many bytes.
    """
    _check_plain(stream)
    found = _array(np.zeros(len(classes)))
    _read(stream, "numbers", lambda c: _launch(c, tile_coder.code_bytes, _array(classes), found))
    return found.numpy().astype(np.uint8)


def code_levels(levels: np.ndarray, valid: np.ndarray) -> bytes:
    """Codes the levels of a tile's valid texels.

    Args:
        levels: uint16 [T, H, W, 3], below `LEVELS`.
        valid: bool [H, W], one at least.
    """
    times = len(levels)
    listed, counts = np.zeros((times, 3, LEVELS), np.int32), np.zeros((times, 3), np.int32)
    places = np.zeros((times, 3, *valid.shape), np.int32)
    for t, channel in np.ndindex(times, 3):
        found, place = np.unique(levels[t, ..., channel][valid], return_inverse=True)
        listed[t, channel, : len(found)], counts[t, channel] = found, len(found)
        places[t, channel, valid] = place
    arrays = _array(listed), _array(counts), _array(places)
    return _written(lambda c: _launch_levels(c, valid, *arrays), 4 * times * int(valid.sum()), "levels", 0)


def read_levels(stream: np.ndarray, valid: np.ndarray, times: int) -> np.ndarray:
    """Reads what `code_levels` wrote: uint16 [times, H, W, 3]; texels that aren't valid have levels near them.

    Raises:
        ValueError: The stream isn't one of such levels.
    """
    _check_plain(stream)
    shapes = (times, 3, LEVELS), (times, 3), (times, 3, *valid.shape)
    arrays = [wp.zeros(shape, dtype=int, device="cpu") for shape in shapes]
    _read(stream, "levels", lambda c: _launch_levels(c, valid, *arrays))
    listed, counts, places = (array.numpy() for array in arrays)
    if (listed[np.arange(LEVELS) < counts[..., None]] >= LEVELS).any() or (places >= counts[..., None, None]).any():
        raise ValueError(f"expected levels below {LEVELS}, and places among them")
    levels = np.empty((times, *valid.shape, 3), np.uint16)
    for t, channel in np.ndindex(times, 3):
        levels[t, ..., channel] = listed[t, channel][places[t, channel]]
    return levels


def _launch_levels(c: coder.Coder, valid: np.ndarray, listed: wp.array, counts: wp.array, places: wp.array) -> None:
    weights = _array(np.zeros((3, level_coder.NEAR)))
    _launch(c, level_coder.code_levels, _array(valid), listed, counts, places, weights)


def _check_plain(stream: np.ndarray) -> None:
    """Raises a `ValueError` where a stream's first byte isn't that of numbers with all of their bits."""
    if _first(stream) != (0, False):
        raise ValueError("expected a first byte of 0")


def _everywhere(grid: BlockGrid) -> np.ndarray:
    """Texels that are read, of all slices: bool [n, 16]."""
    return (grid.slices[:, None, None] & grid.used).reshape(-1, 16)


def _held(grid: BlockGrid, whole: bool) -> np.ndarray:
    """Blocks of the slices that the stream holds, bool [n]."""
    return np.repeat(grid.slices | whole, grid.side**2)


def _zeros(values: np.ndarray) -> int:
    """The number of lowest bits that are 0 in all of some bytes; 8 where all are 0."""
    bits = int(np.bitwise_or.reduce(values, axis=None)) if values.size else 0
    return 8 if bits == 0 else (bits & -bits).bit_length() - 1


def _array(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device="cpu")


def _launch_blocks(
    c: coder.Coder, grid: BlockGrid, whole: bool, coarse: int, ends: wp.array, indices: wp.array
) -> None:
    used = _array(np.ones_like(grid.used) if whole else grid.used)
    texels = wp.empty((ends.shape[0], 16, 4), dtype=int, device="cpu")
    slices = len(grid.slices) if whole else int(grid.slices.sum())
    _launch(c, tile_coder.code_blocks, slices, grid.side, coarse, used, ends, indices, texels)


def _launch(c: coder.Coder, kernel: Any, *arguments: Any) -> None:
    wp.launch(kernel, 1, inputs=[c, *arguments], device="cpu")


def _written(launch: Callable[[coder.Coder], None], plain: int, what: str, first: int) -> bytes:
    """The stream that a launch writes; `plain` is about its size at most."""
    room = int(_ROOM * plain) + 64
    while True:
        c = _coder(np.zeros(room, np.uint8), True, what)
        launch(c)
        size = int(c.place.numpy()[0])
        if size <= room:
            return bytes([first]) + c.data.numpy()[:size].tobytes()
        room = size


def _first(stream: np.ndarray) -> tuple[int, bool]:
    """What a stream's first byte says: lowest bits, and whether it holds everything."""
    if not len(stream) or stream[0] >= 2 * _WHOLE:
        raise ValueError("expected a first byte below 16")
    return int(stream[0]) % _WHOLE, bool(stream[0] & _WHOLE)


def _read(stream: np.ndarray, what: str, launch: Callable[[coder.Coder], None]) -> None:
    """Reads a stream to its end.

    Raises:
        ValueError: It ends before or after what it should hold.
    """
    c = _coder(stream[1:], False, what)
    launch(c)
    if int(c.place.numpy()[0]) != c.data.shape[0] + coder.AHEAD:
        raise ValueError(f"expected another length than {len(stream)} bytes")


def _coder(data: np.ndarray, encode: bool, what: str) -> coder.Coder:
    """A coder before its first number."""
    c = coder.Coder()
    c.logarithm, c.sigmoid, c.rate = _tables()
    c.encode = int(encode)
    c.data = wp.array(np.ascontiguousarray(data), dtype=wp.uint8, device="cpu")
    c.range = wp.zeros(3, dtype=wp.uint32, device="cpu")
    c.place = wp.zeros(1, dtype=int, device="cpu")
    size = _SIZES[what]
    weights = np.full((size.mixtures, size.bits, coder.INPUTS), coder.PREDICTION_WEIGHT)
    weights[:, :, coder.PREDICTIONS] = coder.COUNT_WEIGHT
    c.weights = _array(weights)
    c.widths = _array(np.full((size.mixtures, coder.PREDICTIONS), 1024 * size.width))
    c.chance = _array(np.full((size.trees, size.nodes), 32768))
    c.met = _array(np.full((size.trees, size.nodes), coder.MET))
    return c
