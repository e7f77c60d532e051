"""Tiles of levels as streams, one for each tile, and as what a GPU reads of them.

A stream is what `wlm.lightmap.streams.code_levels` makes of a tile's levels at all times: nothing is lost, and each
tile is read alone.
"""

import math
from collections.abc import Sequence

import numpy as np

from wlm.formats.limits import VIDEO_BYTES, VIDEO_GROWTH, check_growth
from wlm.lightmap.streams import load_kernels, read_levels
from wlm.lightmap.tiles import TILE, TileKind, valid_texels
from wlm.lightmap.video_packing import words_of
from wlm.workers import each
from wlm_kernels.lightmap import level_coder

STEPS = {101: 362.0, 102: 512.0, 103: 724.0, 104: 1024.0, 105: math.inf}
"""Steps in a tile's whole range by the quality above AV1's 100: 3 dB from one to the next, and all levels."""


def join_streams(streams: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Streams one after another, uint8 [bytes], and their bytes, uint32 [n]."""
    return np.frombuffer(b"".join(streams), np.uint8), np.array([len(stream) for stream in streams], np.uint32)


def unpack_levels(levels: np.ndarray, sizes: np.ndarray, kind: np.ndarray, mask: np.ndarray, times: int) -> np.ndarray:
    """Decodes the streams of a map.

    Args:
        levels: uint8 [bytes], one after another.
        sizes: uint32 [N_l], their bytes.
        kind: uint8 [tiles], `TileKind` of each tile of the grid.
        mask: bool [H, W], the map's valid texels.
        times: T.

    Returns:
        Words uint32 [N_l, T, 128, 128], as of `wlm.lightmap.video_packing.unpack_video`.

    Raises:
        ValueError: The streams aren't those of these tiles.
        WlmError: They claim to become more than a file of their size may.
    """
    numbers = np.flatnonzero(kind == TileKind.LEVELS).tolist()
    if len(sizes) != len(numbers) or int(sizes.sum(dtype=np.uint64)) != len(levels):
        found = f"{len(numbers)} tiles and {len(levels)} bytes, found others"
        raise ValueError(f"part level_sizes: expected those of {found}")
    check_growth("part levels", len(levels), 6 * times * len(numbers) * TILE * TILE, VIDEO_GROWTH, VIDEO_BYTES)
    words = np.empty((len(numbers), times, TILE, TILE), np.uint32)
    ends = np.cumsum(sizes.astype(np.int64)).tolist()

    def unpack(row: int) -> None:
        valid, first = valid_texels(mask, numbers[row]), ends[row - 1] if row else 0
        try:
            words[row] = words_of(read_levels(levels[first : ends[row]], valid, times))
        except ValueError as error:
            raise ValueError(f"part levels: tile {numbers[row]}: {error}") from error

    load_kernels(level_coder)
    for _ in each(unpack, range(len(numbers))):
        continue
    return words
