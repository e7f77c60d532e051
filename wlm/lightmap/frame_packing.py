"""Frames of tiles as compressed streams, one for each tile: the blocks that a read may reach, hours one after another.

No two blocks of BC7 are alike, but their bytes have habits of their own at each of the sixteen places of a block, and
blocks of one place look alike over the hours. LZMA with models by place (lp and pb of 4) stores real frames in 5 to 15%
less than deflate and zstd do, whichever way the bytes are ordered for those.
"""

import lzma
from collections.abc import Mapping

import numpy as np

from wlm.errors import WlmError
from wlm.formats.bc7 import BLOCK_BYTES
from wlm.formats.bc7_modes import RESERVED, block_modes
from wlm.formats.limits import check_growth
from wlm.formats.parts import Part
from wlm.lightmap.tiles import TILE, TileGrid, TileKind
from wlm.texels import REACH

FRAMES = Part(np.uint8, (None,))
FRAME_SIZES = Part(np.uint32, (None,))

BLOCKS = TILE // 4
"""Blocks along a tile's side."""

# A decoder needs memory of the dictionary's size, which a file doesn't choose.
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": 1 << 20, "lc": 0, "lp": 4, "pb": 4}]

_BLACK = np.zeros(BLOCK_BYTES, np.uint8)
_BLACK[0] = 1 << 6  # mode 6


def needed_blocks(mask: np.ndarray, number: int) -> np.ndarray:
    """The blocks of a tile that a read may reach: those with a texel within `REACH` of a valid one.

    Args:
        mask: bool [H, W], the map's valid texels.
        number: Of the tile in the grid.

    Returns:
        bool [32, 32].
    """
    y, x = TileGrid.of(*mask.shape).origin(number)
    near = np.zeros((TILE + 2 * REACH, TILE + 2 * REACH), bool)
    part = mask[max(y - REACH, 0) : y + TILE + REACH, max(x - REACH, 0) : x + TILE + REACH]
    top, left = REACH - min(y, REACH), REACH - min(x, REACH)
    near[top : top + part.shape[0], left : left + part.shape[1]] = part
    for axis in () if part.all() or not part.any() else (0, 1):
        shifted = [np.roll(near, step, axis) for step in range(-REACH, REACH + 1)]
        near = np.logical_or.reduce(shifted)
    near = near[REACH:-REACH, REACH:-REACH]
    near[mask.shape[0] - y :] = False
    near[:, mask.shape[1] - x :] = False
    return near.reshape(BLOCKS, 4, BLOCKS, 4).any((1, 3))


def clear_unneeded(blocks: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """The blocks [T, 32, 32, 16] of a tile with a black one where none is needed."""
    return np.where(needed[..., None], blocks, _BLACK)


def pack_frames(frames: np.ndarray, kind: np.ndarray, mask: np.ndarray) -> dict[str, np.ndarray]:
    """Packs the frames of all tiles.

    Args:
        frames: uint8 [N_f, T, 32, 32, 16], as `LightmapModel` has them.
        kind: uint8 [tiles], `TileKind` of each tile of the grid.
        mask: bool [H, W], the valid texels.

    Returns:
        `frames`, uint8 [bytes], and `frame_sizes`, uint32 [N_f], the bytes of each tile.

    Raises:
        WlmError: A block is of no mode, or one that nothing needs isn't black.
    """
    streams = []
    for blocks, number in zip(frames, _numbers(kind), strict=True):
        needed = needed_blocks(mask, number)
        if not np.array_equal(blocks, clear_unneeded(blocks, needed)):
            raise WlmError(f"frames: tile {number}: expected black blocks where no read reaches, found others")
        kept = blocks[:, needed]
        _check_modes(kept, number)
        streams.append(lzma.compress(kept.tobytes(), lzma.FORMAT_RAW, filters=_FILTERS) if kept.size else b"")
    sizes = np.array([len(stream) for stream in streams], np.uint32)
    return {"frames": np.frombuffer(b"".join(streams), np.uint8), "frame_sizes": sizes}


def unpack_frames(
    frames: np.ndarray, sizes: np.ndarray, table: Mapping[str, Part], kind: np.ndarray, mask: np.ndarray
) -> np.ndarray:
    """Reads what `pack_frames` wrote.

    Args:
        frames, sizes: Its result.
        table: The parts, with the sizes that they must have.
        kind, mask: As for `pack_frames`.

    Returns:
        The frames, uint8 [N_f, T, 32, 32, 16].

    Raises:
        WlmError, ValueError: The streams aren't those of these tiles.
    """
    numbers, shape = _numbers(kind), table["frames"].shape
    if len(sizes) != len(numbers) or int(sizes.sum(dtype=np.uint64)) != len(frames):
        raise ValueError(
            f"part frame_sizes: expected those of {len(numbers)} tiles and {len(frames)} bytes, found others"
        )
    check_growth("part frames", len(frames), int(np.prod(shape, dtype=object)))
    unpacked = np.empty(shape, np.uint8)
    ends = np.cumsum(sizes.astype(np.int64))
    for blocks, number, last, size in zip(unpacked, numbers, ends, sizes.astype(np.int64), strict=True):
        needed = needed_blocks(mask, number)
        count = len(blocks) * int(needed.sum()) * BLOCK_BYTES
        data = _inflated(frames[last - size : last].tobytes(), count, f"part frames: tile {number}")
        kept = np.frombuffer(data, np.uint8).reshape(len(blocks), -1, BLOCK_BYTES)
        _check_modes(kept, number)
        blocks[...] = _BLACK
        blocks[:, needed] = kept
    return unpacked


def _numbers(kind: np.ndarray) -> list[int]:
    return np.flatnonzero(kind == TileKind.FRAMES).tolist()


def _check_modes(blocks: np.ndarray, number: int) -> None:
    if (block_modes(blocks) == RESERVED).any():
        raise WlmError(f"frames: tile {number}: expected BC7 blocks of modes 0 to 7, found a reserved mode")


def _inflated(stream: bytes, count: int, where: str) -> bytes:
    """The bytes of a stream, which must be `count`; nothing for none."""
    if not count and not stream:
        return b""
    reader = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS)
    try:
        data = reader.decompress(stream, count + 1)
        # The end may lie behind the last byte.
        if len(data) == count and not reader.eof:
            data += reader.decompress(b"", 1)
    except (lzma.LZMAError, EOFError) as error:
        raise ValueError(f"{where}: {error}") from error
    if len(data) != count or not reader.eof or reader.unused_data:
        raise ValueError(f"{where}: expected {count} bytes, compressed, found others")
    return data
