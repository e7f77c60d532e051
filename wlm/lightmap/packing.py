"""Each tile's maps and network as streams, one after another: a tile is read, and streamed, alone.

A stream is a byte and what an adaptive arithmetic coder (`wlm.lightmap.streams`) makes of the rest: F_uv and F_uvt
block by block, F_ut, F_vt, and the bytes of the network. It leaves out what no valid texel reads at a time that is
evaluated, which a fit sets to zero; where one of these isn't zero it holds everything.

The streams of a tile, those that it has, are in the order of `STREAMS`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.bc7 import pack_mode6, unpack_mode6
from wlm.formats.parts import Part
from wlm.lightmap.model import Profile, TimeAxis
from wlm.lightmap.reads import Reads
from wlm.lightmap.streams import (
    BlockGrid,
    code_blocks,
    code_bytes,
    code_plane,
    load_kernels,
    read_blocks,
    read_bytes,
    read_plane,
)
from wlm.lightmap.tiles import TileKind, valid_texels
from wlm.lightmap.weights import pack_net, packed_bytes, unpack_net
from wlm.workers import each
from wlm_kernels.lightmap import tile_coder

STREAMS = ("uv", "uvt", "ut", "vt", "net")
"""The streams of a tile; a static one has the first and the last."""

PACKED = ("uv", "uvt", "ut", "vt", "net", "net_static")
"""The parts of a model that are packed."""

TILE_STREAMS = Part(np.uint8, (None,))
STREAM_SIZES = Part(np.uint32, (None, len(STREAMS)))

_STATIC = ("uv", "net")


def clear_unread(parts: Mapping[str, np.ndarray], used: np.ndarray, reads: Reads | None) -> dict[str, np.ndarray]:
    """Sets what decodes to no valid texel to zero, and the ends of a block in an order that is cheap to code.

    Args:
        parts: `uv`, uint8 [32, 32, 16], and of a dynamic tile `uvt`, `ut` and `vt`.
        used: bool [128, 128], the tile's valid texels.
        reads: What a dynamic tile reads; None: the tile is static.

    Returns:
        The same parts, which decode to the same light.
    """
    result = dict(parts)
    result["uv"] = _cleared(parts["uv"].reshape(-1, 16), by_block(used)).reshape(parts["uv"].shape)
    if reads is None:
        return result
    blocks = by_block(reads.texels)
    texels = (reads.slices[:, None, None] & blocks).reshape(-1, 16)
    result["uvt"] = _cleared(parts["uvt"].reshape(-1, 16), texels).reshape(parts["uvt"].shape)
    for name, columns in zip(("ut", "vt"), reads.columns, strict=True):
        result[name] = parts[name] * (reads.rows[:, None] & columns)[..., None]
    return result


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
        _unpacked(parts[name].reshape(-1, 16))
    if profile.net_bits == 8:
        for net in parts["net"]:
            pack_net(net, profile.inputs(dynamic), profile.hidden)


def pack_tiles(
    parts: Mapping[str, np.ndarray], profile: Profile, kind: np.ndarray, mask: np.ndarray, axis: TimeAxis
) -> dict[str, np.ndarray]:
    """Packs the maps and networks of all tiles.

    Args:
        parts: `uv`, `uvt`, `ut`, `vt`, `net` and `net_static` as `LightmapModel` has them.
        profile: The settings.
        kind: uint8 [tiles], `TileKind` of each tile of the grid.
        mask: bool [H, W], true where a texel is valid.
        axis: The time axis.

    Returns:
        `streams`, uint8 [bytes], and `stream_sizes`, uint32 [N_m, 5], the bytes of each stream, 0 of those that a tile
        lacks.

    Raises:
        WlmError: A block isn't of BC7 mode 6, or a network not on the levels that the settings say.
    """

    def packed(tile: tuple[int, int, int]) -> list[bytes]:
        place, number, row = tile
        dynamic, used = bool(kind[number] == TileKind.DYNAMIC), valid_texels(mask, number)
        streams = dict.fromkeys(STREAMS, b"")
        streams["uv"] = code_blocks(*_unpacked(parts["uv"][place].reshape(-1, 16)), _grid(used))
        if dynamic:
            reads = Reads.of(used, profile, axis)
            streams["uvt"] = code_blocks(
                *_unpacked(parts["uvt"][row].reshape(-1, 16)), _grid(reads.texels, reads.slices)
            )
            for name, columns in zip(("ut", "vt"), reads.columns, strict=True):
                streams[name] = code_plane(parts[name][row], reads.rows, columns)
        net = parts["net" if dynamic else "net_static"][row]
        if profile.net_bits == 8:
            values = pack_net(net, profile.inputs(dynamic), profile.hidden)
        else:
            values = net.view(np.uint8).reshape(-1, 2).T.ravel()
        streams["net"] = code_bytes(values, _classes(profile, dynamic))
        return [streams[name] for name in STREAMS]

    load_kernels(tile_coder)
    tiles = list(each(packed, mapped_tiles(kind)))
    return {
        "streams": np.frombuffer(b"".join(stream for tile in tiles for stream in tile), np.uint8),
        "stream_sizes": np.array([[len(stream) for stream in tile] for tile in tiles], np.uint32).reshape(
            -1, len(STREAMS)
        ),
    }


def unpack_tiles(
    streams: np.ndarray,
    sizes: np.ndarray,
    table: Mapping[str, Part],
    profile: Profile,
    kind: np.ndarray,
    mask: np.ndarray,
    axis: TimeAxis,
) -> dict[str, np.ndarray]:
    """Reads what `pack_tiles` wrote.

    Args:
        streams, sizes: Its result.
        table: The parts, with the sizes that they must have.
        profile, kind, mask, axis: As for `pack_tiles`.

    Returns:
        `uv`, `uvt`, `ut`, `vt`, `net` and `net_static`.

    Raises:
        ValueError: The streams aren't those of these tiles.
    """
    mapped = mapped_tiles(kind)
    if len(sizes) != len(mapped) or int(sizes.sum(dtype=np.uint64)) != len(streams):
        raise ValueError(
            f"part stream_sizes: expected those of {len(mapped)} tiles and {len(streams)} bytes, found others"
        )
    parts = {name: np.empty(table[name].shape, table[name].dtype) for name in PACKED}
    ends = np.cumsum(sizes.astype(np.int64).ravel()).reshape(sizes.shape)

    def unpack(job: tuple[tuple[int, int, int], np.ndarray, np.ndarray]) -> None:
        (place, number, row), last, size = job
        dynamic, used = bool(kind[number] == TileKind.DYNAMIC), valid_texels(mask, number)
        own = {name: streams[b - n : b] for name, b, n in zip(STREAMS, last, size, strict=True)}
        for name in STREAMS:
            if (len(own[name]) > 0) != (dynamic or name in _STATIC):
                found = "has none" if dynamic or name in _STATIC else "is static, and has one"
                raise ValueError(f"part streams: tile {number}: {name}: {found}")

        def read(name: str, call: Any, *arguments: Any) -> Any:
            try:
                return call(own[name], *arguments)
            except ValueError as error:
                raise ValueError(f"part streams: tile {number}: {name}: {error}") from error

        parts["uv"][place] = pack_mode6(*read("uv", read_blocks, _grid(used))).reshape(32, 32, 16)
        net = "net" if dynamic else "net_static"
        if dynamic:
            reads = Reads.of(used, profile, axis)
            blocks = read("uvt", read_blocks, _grid(reads.texels, reads.slices))
            parts["uvt"][row] = pack_mode6(*blocks).reshape(parts["uvt"].shape[1:])
            for name, columns in zip(("ut", "vt"), reads.columns, strict=True):
                parts[name][row] = read(name, read_plane, reads.rows, columns)
        classes = _classes(profile, dynamic)
        values = read("net", read_bytes, classes)
        if profile.net_bits == 8:
            parts[net][row] = unpack_net(values, profile.inputs(dynamic), profile.hidden)
        else:
            parts[net][row] = np.ascontiguousarray(values.reshape(2, -1).T).view("<f2").ravel()

    load_kernels(tile_coder)
    for _ in each(unpack, zip(mapped, ends, sizes.astype(np.int64), strict=True)):
        continue
    return parts


def mapped_tiles(kind: np.ndarray) -> list[tuple[int, int, int]]:
    """Of each tile with maps its place among these, its number, and its place among those of its kind."""
    numbers = np.flatnonzero(np.isin(kind, (TileKind.STATIC, TileKind.DYNAMIC)))
    rows = [int((kind[:number] == kind[number]).sum()) for number in numbers]
    return [(place, int(number), row) for place, (number, row) in enumerate(zip(numbers, rows, strict=True))]


def by_block(texels: np.ndarray) -> np.ndarray:
    """Texels [4 h, 4 w] block by block, [h w, 16]."""
    h, w = texels.shape
    return texels.reshape(h // 4, 4, w // 4, 4).swapaxes(1, 2).reshape(-1, 16)


def _unpacked(blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Blocks [n, 16] as ends, uint8 [n, 2, 4], and indices [n, 16]."""
    try:
        return unpack_mode6(blocks)
    except WlmError as error:
        raise WlmError("maps: expected blocks of BC7 mode 6, found others") from error


def _grid(texels: np.ndarray, slices: np.ndarray | None = None) -> BlockGrid:
    """The blocks of a map's slices whose valid, or read, texels are given."""
    side = texels.shape[0] // 4
    return BlockGrid(side, by_block(texels), np.ones(1, bool) if slices is None else slices)


def _cleared(blocks: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Blocks [n, 16] without what isn't used, bool [n, 16]."""
    ends, indices = _unpacked(blocks)
    ends, indices = ends * used.any(1)[:, None, None], indices * used
    # A block's first index is below 8, which fixes the order of its ends; where it isn't used, they are in order.
    swapped = ~used[:, 0] & (ends[:, 0].sum(1, dtype=int) > ends[:, 1].sum(1, dtype=int))
    ends[swapped] = ends[swapped][:, ::-1]
    indices[swapped] = (15 - indices[swapped]) * used[swapped]
    return pack_mode6(ends, indices)


def _classes(profile: Profile, dynamic: bool) -> np.ndarray:
    """The class of each of a network's bytes: weights by layer, and high and low bytes of half floats."""
    inputs, hidden = profile.inputs(dynamic), profile.hidden
    if profile.net_bits == 16:
        count = (inputs + hidden + 2) * hidden + 3 * (hidden + 1)
        return np.repeat([3, 4], count)
    halves = (packed_bytes(inputs, hidden) - (inputs + hidden + 3) * hidden) // 2
    return np.repeat(np.arange(5), [inputs * hidden, hidden * hidden, 3 * hidden, halves, halves])
