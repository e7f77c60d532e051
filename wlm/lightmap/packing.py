"""Each tile's maps and network as deflated streams, one after another: a tile is read, and streamed, alone.

A block of BC7 mode 6 is a picture of 16 indices in 4 bits and ten numbers of 7 bits and 1 bit, which have nothing in
common: they are taken apart, the same number of all blocks side by side. Blocks that hold no valid texel, and indices
of texels that aren't valid, come last; a fit leaves these at zero, so that they take up next to nothing.

The streams of a tile, those that it has, are in the order of `STREAMS`; each is a zlib stream.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.bc7 import pack_mode6, unpack_mode6
from wlm.formats.deflate import inflate
from wlm.formats.parts import Part
from wlm.lightmap.model import Profile
from wlm.lightmap.tiles import TILE, TileKind, valid_texels
from wlm.lightmap.weights import pack_net, packed_bytes, unpack_net

STREAMS = ("uv ends", "uv indices", "uvt ends", "uvt indices", "ut", "vt", "net")
"""The streams of a tile; a static one has the first two and the last."""

PACKED = ("uv", "uvt", "ut", "vt", "net", "net_static")
"""The parts of a model that are packed."""

TILES = Part(np.uint8, (None,))
SIZES = Part(np.uint32, (None, len(STREAMS)))

_STATIC = ("uv ends", "uv indices", "net")
_NONE = np.empty(0, np.uint8)


def clear_unused(uv: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Sets what decodes to no valid texel to zero: the blocks without one, and the other texels' indices.

    Args:
        uv: Blocks of F_uv, uint8 [32, 32, 16].
        used: bool [128, 128], the tile's valid texels.
    """
    ends, bits, indices = _parts_of(uv.reshape(-1, 16))
    texels = _by_block(used)
    blocks = texels.any(1)
    return _blocks_of(ends * blocks[:, None], bits * blocks[:, None], indices * texels).reshape(uv.shape)


def check_packable(parts: Mapping[str, np.ndarray], profile: Profile, dynamic: bool) -> None:
    """Checks the maps and networks of some tiles before they are relied on.

    Args:
        parts: `uv`, `net` and, of dynamic tiles, `uvt`, as a trainer gives them.
        profile: The settings.
        dynamic: Whether the tiles are dynamic rather than static.

    Raises:
        WlmError: A block isn't of BC7 mode 6, or a network not on the levels that the settings say.
    """
    for name in ("uv", "uvt") if dynamic else ("uv",):
        _parts_of(parts[name].reshape(-1, 16))
    if profile.net_bits == 8:
        for net in parts["net"]:
            pack_net(net, profile.inputs(dynamic), profile.hidden)


def pack_tiles(
    parts: Mapping[str, np.ndarray], profile: Profile, kind: np.ndarray, mask: np.ndarray
) -> dict[str, np.ndarray]:
    """Packs the maps and networks of all tiles.

    Args:
        parts: `uv`, `uvt`, `ut`, `vt`, `net` and `net_static` as `LightmapModel` has them.
        profile: The settings.
        kind: uint8 [tiles], `TileKind` of each tile of the grid.
        mask: bool [H, W], true where a texel is valid.

    Returns:
        `tiles`, uint8 [bytes], and `sizes`, uint32 [N_m, 7], the bytes of each stream, 0 of those that a tile lacks.

    Raises:
        WlmError: A block isn't of BC7 mode 6, or a network not on the levels that the settings say.
    """
    streams, sizes = [], []
    for place, number, row in _mapped(kind):
        raw = dict.fromkeys(STREAMS, _NONE)
        raw["uv ends"], raw["uv indices"] = _packed_blocks(parts["uv"][place], valid_texels(mask, number))
        if kind[number] == TileKind.DYNAMIC:
            raw["uvt ends"], raw["uvt indices"] = _packed_blocks(parts["uvt"][row])
            raw |= {name: np.moveaxis(parts[name][row], 2, 0) for name in ("ut", "vt")}
        dynamic = bool(kind[number] == TileKind.DYNAMIC)
        net = parts["net" if dynamic else "net_static"][row]
        if profile.net_bits == 8:
            raw["net"] = pack_net(net, profile.inputs(dynamic), profile.hidden)
        else:  # the high bytes of half floats are alike, the low ones noise
            raw["net"] = net.view(np.uint8).reshape(-1, 2).T
        packed = [
            zlib.compress(np.ascontiguousarray(values).tobytes(), 9) if values.size else b"" for values in raw.values()
        ]
        streams += packed
        sizes.append([len(stream) for stream in packed])
    return {
        "tiles": np.frombuffer(b"".join(streams), np.uint8),
        "sizes": np.array(sizes, np.uint32).reshape(-1, len(STREAMS)),
    }


def unpack_tiles(
    tiles: np.ndarray,
    sizes: np.ndarray,
    table: Mapping[str, Part],
    profile: Profile,
    kind: np.ndarray,
    mask: np.ndarray,
) -> dict[str, np.ndarray]:
    """Reads what `pack_tiles` wrote.

    Args:
        tiles, sizes: Its result.
        table: The parts, with the sizes that they must have.
        profile, kind, mask: As for `pack_tiles`.

    Returns:
        `uv`, `uvt`, `ut`, `vt`, `net` and `net_static`.

    Raises:
        ValueError: The streams aren't those of these tiles.
    """
    mapped = _mapped(kind)
    if len(sizes) != len(mapped) or int(sizes.sum(dtype=np.uint64)) != len(tiles):
        raise ValueError(f"part sizes: expected those of {len(mapped)} tiles and {len(tiles)} bytes, found others")
    parts = {name: np.empty(table[name].shape, table[name].dtype) for name in PACKED}
    ends = np.cumsum(sizes.astype(np.int64).ravel()).reshape(sizes.shape)
    for (place, number, row), last, size in zip(mapped, ends, sizes.astype(np.int64), strict=True):
        streams = {name: tiles[b - n : b] for name, b, n in zip(STREAMS, last, size, strict=True)}
        dynamic = kind[number] == TileKind.DYNAMIC
        for name in STREAMS:
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


def _mapped(kind: np.ndarray) -> list[tuple[int, int, int]]:
    """Of each tile with maps its place among these, its number, and its place among those of its kind."""
    numbers = np.flatnonzero(np.isin(kind, (TileKind.STATIC, TileKind.DYNAMIC)))
    rows = [int((kind[:number] == kind[number]).sum()) for number in numbers]
    return [(place, int(number), row) for place, (number, row) in enumerate(zip(numbers, rows, strict=True))]


def _by_block(used: np.ndarray) -> np.ndarray:
    """Texels [128, 128] block by block, [1024, 16]."""
    return used.reshape(TILE // 4, 4, TILE // 4, 4).swapaxes(1, 2).reshape(-1, 16)


def _parts_of(blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blocks [n, 16] as endpoints of 7 bits [n, 8], their lowest bits [n, 2] and indices [n, 16]."""
    try:
        endpoints, indices = unpack_mode6(blocks)
    except WlmError as error:
        raise WlmError("maps: expected blocks of BC7 mode 6, found others") from error
    return (endpoints >> 1).swapaxes(1, 2).reshape(-1, 8), endpoints[..., 0] & 1, indices


def _blocks_of(ends: np.ndarray, bits: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """The inverse of `_parts_of`."""
    return pack_mode6(ends.reshape(-1, 4, 2).swapaxes(1, 2) << 1 | bits[..., None], indices)


def _orders(count: int, used: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The order of blocks and that of texels: those in use first."""
    if used is None:
        return np.arange(count), np.arange(16 * count)
    texels = _by_block(used)
    return np.argsort(~texels.any(1), kind="stable"), np.argsort(~texels.ravel(), kind="stable")


def _packed_blocks(blocks: np.ndarray, used: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The streams of a map: endpoints, one after another, with their lowest bits; and indices, two a byte."""
    ends, bits, indices = _parts_of(blocks.reshape(-1, 16))
    order, texels = _orders(len(ends), used)
    nibbles = indices.ravel()[texels]
    plain = np.concatenate([ends[order].T.ravel(), np.packbits(bits[order].T)])
    return plain, nibbles[::2] | nibbles[1::2] << 4


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
    return _blocks_of(ends, bits, indices)


def _inflated(stream: np.ndarray, count: int, where: str) -> np.ndarray:
    """The bytes of a zlib stream, which must be `count`."""
    data = inflate(stream.tobytes(), count, where, f"{count} bytes, deflated, found others")
    return np.frombuffer(data, np.uint8)
