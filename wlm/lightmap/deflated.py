"""Files of before the arithmetic coder: each tile's maps and network as deflated streams, one after another.

A block of BC7 mode 6 is a picture of 16 indices in 4 bits and ten numbers of 7 bits and 1 bit: they are taken apart,
the same number of all blocks side by side. Blocks that hold no valid texel, and indices of texels that aren't valid,
come last. The streams of a tile, those that it has, are in the order of `DEFLATED`; each is a zlib stream.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from wlm.formats.bc7 import pack_mode6
from wlm.formats.deflate import inflate
from wlm.formats.parts import Part
from wlm.lightmap.model import Profile
from wlm.lightmap.packing import PACKED, by_block, mapped_tiles
from wlm.lightmap.tiles import TILE, TileKind, valid_texels
from wlm.lightmap.weights import packed_bytes, unpack_net

DEFLATED = ("uv ends", "uv indices", "uvt ends", "uvt indices", "ut", "vt", "net")
"""The streams of a tile; a static one has the first two and the last."""

TILES = Part(np.uint8, (None,))
SIZES = Part(np.uint32, (None, len(DEFLATED)))

_STATIC = ("uv ends", "uv indices", "net")


def inflate_tiles(
    tiles: np.ndarray,
    sizes: np.ndarray,
    table: Mapping[str, Part],
    profile: Profile,
    kind: np.ndarray,
    mask: np.ndarray,
) -> dict[str, np.ndarray]:
    """Reads the maps and networks of all tiles.

    Args:
        tiles: The streams.
        sizes: Bytes of each stream, 0 of those that a tile lacks.
        table: The parts, with the sizes that they must have.
        profile: The settings.
        kind: uint8 [tiles], `TileKind` of each tile of the grid.
        mask: bool [H, W], true where a texel is valid.

    Returns:
        `uv`, `uvt`, `ut`, `vt`, `net` and `net_static`.

    Raises:
        ValueError: The streams aren't those of these tiles.
    """
    mapped = mapped_tiles(kind)
    if len(sizes) != len(mapped) or int(sizes.sum(dtype=np.uint64)) != len(tiles):
        raise ValueError(f"part sizes: expected those of {len(mapped)} tiles and {len(tiles)} bytes, found others")
    parts = {name: np.empty(table[name].shape, table[name].dtype) for name in PACKED}
    ends = np.cumsum(sizes.astype(np.int64).ravel()).reshape(sizes.shape)
    for (place, number, row), last, size in zip(mapped, ends, sizes.astype(np.int64), strict=True):
        streams = {name: tiles[b - n : b] for name, b, n in zip(DEFLATED, last, size, strict=True)}
        dynamic = kind[number] == TileKind.DYNAMIC
        for name in DEFLATED:
            if len(streams[name]) and not dynamic and name not in _STATIC:
                raise ValueError(f"part tiles: tile {number} is static, and has the stream {name}")

        def read(name: str, count: int, of: dict[str, np.ndarray] = streams, at: int = number) -> np.ndarray:
            return _inflated(of[name], count, f"part tiles: tile {at}: {name}")

        parts["uv"][place] = _unpacked_blocks(read, "uv", TILE * TILE // 16, valid_texels(mask, number)).reshape(
            32, 32, 16
        )
        net = "net" if dynamic else "net_static"
        if dynamic:
            shape = parts["uvt"].shape[1:]
            parts["uvt"][row] = _unpacked_blocks(read, "uvt", int(np.prod(shape[:-1]))).reshape(shape)
            for name in ("ut", "vt"):
                rows, columns = parts[name].shape[1:3]
                parts[name][row] = np.moveaxis(read(name, rows * columns * 2).reshape(2, rows, columns), 0, 2)
        if profile.net_bits == 8:
            shape = profile.inputs(bool(dynamic)), profile.hidden
            parts[net][row] = unpack_net(read("net", packed_bytes(*shape)), *shape)
            continue
        count = parts[net].shape[1]
        parts[net][row] = np.ascontiguousarray(read("net", 2 * count).reshape(2, count).T).view("<f2").ravel()
    return parts


def _orders(count: int, used: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The order of blocks and that of texels: those in use first."""
    if used is None:
        return np.arange(count), np.arange(16 * count)
    texels = by_block(used)
    return np.argsort(~texels.any(1), kind="stable"), np.argsort(~texels.ravel(), kind="stable")


def _unpacked_blocks(read: Any, name: str, count: int, used: np.ndarray | None = None) -> np.ndarray:
    """The blocks of a map, [count, 16], whose streams `read(name, bytes)` gives."""
    order, texels = _orders(count, used)
    plain = read(f"{name} ends", 8 * count + -(-2 * count // 8))
    ends, bits = np.empty((count, 8), np.uint8), np.empty((count, 2), np.uint8)
    ends[order] = plain[: 8 * count].reshape(8, count).T
    bits[order] = np.unpackbits(plain[8 * count :], count=2 * count).reshape(2, count).T
    pairs = read(f"{name} indices", 8 * count)
    indices = np.empty(16 * count, np.uint8)
    indices[texels] = np.stack([pairs & 15, pairs >> 4], 1).ravel()
    indices = indices.reshape(count, 16)
    if (ends > 127).any() or (indices[:, 0] > 7).any():
        raise ValueError(f"part tiles: {name}: expected endpoints of 7 bits and a first index of 3")
    return pack_mode6(ends.reshape(-1, 4, 2).swapaxes(1, 2) << 1 | bits[..., None], indices)


def _inflated(stream: np.ndarray, count: int, where: str) -> np.ndarray:
    """The bytes of a zlib stream, which must be `count`."""
    data = inflate(stream.tobytes(), count, where, f"{count} bytes, deflated, found others")
    return np.frombuffer(data, np.uint8)
