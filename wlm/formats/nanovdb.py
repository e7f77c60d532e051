"""Reading of NanoVDB's `.nvdb` files and raw grid buffers as dense arrays.

Grids of floats, doubles and the quantised floats Fp4, Fp8, Fp16 and FpN of version 32 are read; grids of other types
are listed only. The only description of the format is the source code of OpenVDB, `nanovdb/NanoVDB.h` and `io/IO.h`.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats import blosc
from wlm.formats.limits import GROWTH, SURE_BYTES, check_growth
from wlm.formats.vdb import LEAF, LOWER, UPPER, Cursor, GridFile, GridHead, Tiles, VdbGrid, leaf_array, most_voxels

_VERSION = 32  # the major version, the only one with the layout that is read here
# Sizes in bytes of a file's segment header, of a grid's metadata in it, and of the header of a grid.
_SEGMENT, _META, _GRID = 16, 176, 672
_RAW_SIZE, _RAW_NAME, _LINEAR, _SHIFT, _CLASS = 32, 40, 384, 528, 632  # offsets in the header of a grid
_ROOT = 24  # offset of the root's place in the tree, which follows the header
_ZIP, _BLOSC = 1, 2
_LONGEST_NAME = 1 << 12
_NODE = 32  # bytes before the masks of an inner node
_CLASSES = {1: "level set", 2: "fog volume", 3: "staggered"}
_NAMES = dict(enumerate("? float double int16 int32 int64 vec3f vec3d mask half uint32 bool rgba8".split()))
_NAMES |= {13: "fp4", 14: "fp8", 15: "fp16", 16: "fpn"}
_BITS = {"fp4": 4, "fp8": 8, "fp16": 16}
_CODES = 96  # bytes before the codes of a quantised leaf; minimum and quantum are at bytes 80 and 84
_CHUNK = 1 << 12  # leaves that are unpacked at a time


@dataclass(frozen=True)
class _Entry:
    """A grid of a file: its bytes from `at` to `end`, its unpacked size, and the codec, 0 for none."""

    head: GridHead
    at: int
    end: int
    size: int
    codec: int


class NanoVdbFile(GridFile):
    """A `.nvdb` file or a buffer of raw grids."""

    FORMAT = "NanoVDB"

    def _read(self, entry: _Entry, where: str, trust: bool) -> VdbGrid:
        if entry.codec and not trust:
            check_growth(where, entry.end - entry.at, entry.size, GROWTH, SURE_BYTES)
        data = self._data[entry.at : entry.end]
        data = _unpacked(data, entry.size, entry.codec) if entry.codec else data
        return _Grid(data, where).dense(entry.head.name, most_voxels(len(data), trust))

    def _list(self) -> Iterator[_Entry]:
        cursor = Cursor(self._data)
        if not len(self._data):
            raise ValueError("the file is empty")
        while cursor.at < len(self._data):
            begin = cursor.at
            magic, early, count, codec, late = cursor.unpack("<8sI2HI")
            if magic[:7] != b"NanoVDB" or magic[7:] not in b"012":
                raise ValueError(f"expected the signature of NanoVDB at byte {begin}, found {magic!r}")
            # Raw grids of early versions have the signature of files, but a checksum where files have the version.
            if magic[7:] == b"1" or (magic[7:] == b"0" and early >> 21 != _VERSION == late >> 21):
                yield self._raw(cursor, begin)
                continue
            cursor.at = begin + _SEGMENT
            if codec > _BLOSC:
                raise ValueError(f"expected a codec from 0 to {_BLOSC}, found {codec}")
            metas = []
            for _ in range(count):
                meta = cursor.take(_META)
                (length,) = struct.unpack_from("<I", meta, 136)
                if not 0 < length <= _LONGEST_NAME:
                    raise ValueError(f"expected a grid's name of 1 to {_LONGEST_NAME} bytes, found {length} bytes")
                metas.append((meta, cursor.take(length)[:-1].decode("utf-8", "replace")))
            for meta, name in metas:
                size, packed = struct.unpack_from("<2Q", meta)
                kind, group = struct.unpack_from("<2I", meta, 32)
                cursor.skip(packed)
                yield _Entry(_head(name, kind, group), cursor.at - packed, cursor.at, size, codec)

    def _raw(self, cursor: Cursor, begin: int) -> _Entry:
        cursor.at = begin
        grid = cursor.take(_GRID)
        (size,) = struct.unpack_from("<Q", grid, _RAW_SIZE)
        group, kind = struct.unpack_from("<2I", grid, _CLASS)
        name = grid[_RAW_NAME:][:256].partition(b"\0")[0].decode("utf-8", "replace")
        cursor.skip(max(size, _GRID) - _GRID)
        return _Entry(_head(name, kind, group), begin, cursor.at, size, 0)


def _head(name: str, kind: int, group: int) -> GridHead:
    return GridHead(name, _NAMES.get(kind, f"type {kind}"), _CLASSES.get(group, ""))


def _unpacked(data: bytes, size: int, codec: int) -> bytes:
    """Decompresses a grid of `size` bytes; its pieces each have their compressed length in front of them."""
    pieces, cursor, left = [], Cursor(data), size
    while cursor.at < len(data):
        (length,) = cursor.unpack("<Q")
        piece = cursor.take(length)
        if codec == _BLOSC and (stated := blosc.unpacked_size(piece)) <= left:
            pieces.append(blosc.unpack(piece, stated))
        elif codec == _ZIP:
            # The limit of zlib must not be 0, which it reads as none.
            pieces.append(zlib.decompressobj().decompress(piece, left + 1))
        else:
            raise ValueError(f"expected a grid of {size} bytes after decompression, found more")
        left -= len(pieces[-1])
        if left < 0 or not length:
            break
    if left:
        raise ValueError(f"expected a grid of {size} bytes after decompression, found {size - left}")
    return b"".join(pieces)


class _Grid:
    """An unpacked grid. Its nodes are addressed by offsets, which may coincide: each level's nodes are counted first,
    and must not take more bytes than the grid has."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where = np.frombuffer(data, np.uint8), where
        if len(data) < _GRID + 64 or bytes(data[:7]) != b"NanoVDB":
            raise ValueError("the header of the grid is missing")
        version = self._number("<I", 16) >> 21
        if version != _VERSION:
            raise WlmError(f"{where}: expected version {_VERSION} of NanoVDB's grids, found {version}; convert it anew")
        self._type = _NAMES.get(self._number("<I", _CLASS + 4), "?")
        if not GridHead("", self._type, "").is_number:
            raise WlmError(f"{where}: expected a grid of floats, found {self._type}")
        # Bytes of a value, and of an inner node's table entry, which is a value or a child's offset.
        self._value = "<f8" if self._type == "double" else "<f4"

    def dense(self, name: str, most: int) -> VdbGrid:
        """Returns the grid over the box of its active voxels, or voxel 0 if none is active."""
        data, wide = self._data, self._type == "double"
        root = _GRID + self._number("<q", _GRID + _ROOT)
        low, high = self._rows(np.array([root]), 24, "<i4").reshape(2, 3).astype(np.int64)
        if (high < low).any():
            low, high = np.zeros((2, 3), np.int64)
        values, first = leaf_array(low, high + 1, most, self._where)
        background = np.float32(self._number("<d" if wide else "<f", root + (32 if wide else 28)))
        values.fill(background)
        count = self._number("<I", root + 24)
        if count * 32 > data.size:
            raise ValueError(f"expected a root of at most {data.size // 32} nodes, found {count}")
        rows = self._rows(root + (96 if wide else 64) + 32 * np.arange(count), 32)
        keys, children = (
            np.ascontiguousarray(rows[:, i : i + 8]).view(f"<{kind}8")[:, 0] for i, kind in ((0, "u"), (8, "i"))
        )
        if len(np.unique(keys)) < count:
            raise ValueError("expected root nodes at different places, found two at one")
        axes = [(keys >> np.uint64(shift) & np.uint64((1 << 21) - 1)) << np.uint64(12) for shift in (42, 21, 0)]
        corners = np.stack(axes, 1).astype(np.uint32).view(np.int32).astype(np.int64)
        begin = 24 if wide else 20
        constant = np.ascontiguousarray(rows[:, begin : begin + (8 if wide else 4)]).view(self._value)[:, 0]
        Tiles.paste_roots(values, first, corners[children == 0], constant[children == 0])
        nodes, places = root + children[children != 0], corners[children != 0]
        for side in (UPPER, LOWER):
            nodes, places = self._inner(nodes, places, side, values, first, background)
        self._leaves(nodes, (places - first) // LEAF, values)
        matrix = np.eye(4)
        matrix[:3, :3] = np.frombuffer(data[_LINEAR : _LINEAR + 72].tobytes(), "<f8").reshape(3, 3)
        matrix[:3, 3] = np.frombuffer(data[_SHIFT : _SHIFT + 24].tobytes(), "<f8")
        inside = tuple(slice(a, b) for a, b in zip(low - first, high + 1 - first, strict=True))
        return VdbGrid(name, matrix, tuple(low.tolist()), values[inside], float(background))

    def _inner(
        self, nodes: np.ndarray, corners: np.ndarray, side: int, values: np.ndarray, first: np.ndarray, background: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """Reads inner nodes with `side` children along each edge and writes constant children (tiles) to `values`;
        returns the byte offsets and corners of those child nodes that overlap the box."""
        edge = LEAF if side == LOWER else LEAF * LOWER
        masks, table = side**3 // 8, -(-(_NODE + side**3 // 4 + (32 if self._type == "double" else 16)) // 32) * 32
        found, places = [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
        self._count(len(nodes), table + 8 * side**3)
        for node, corner in zip(nodes.tolist(), corners, strict=True):
            rows = self._rows(np.array([node]), table + 8 * side**3)[0]
            child = np.unpackbits(rows[_NODE + masks : _NODE + 2 * masks], bitorder="little").view(bool)
            offsets = rows[table:].view("<i8")
            constant = rows[table:].view(self._value)[:: 1 if self._type == "double" else 2].astype(np.float32)
            seen = ~child & (constant != background)
            if seen.any():
                cube = (side,) * 3
                Tiles(corner, edge, constant.reshape(cube), seen.reshape(cube), seen).paste(values, first)
            index = np.flatnonzero(child)
            place = corner + edge * np.stack(np.unravel_index(index, (side,) * 3), 1)
            inside = ((place + edge > first) & (place < first + values.shape)).all(1)
            found.append(node + offsets[index[inside]])
            places.append(place[inside])
        return np.concatenate(found), np.concatenate(places)

    def _leaves(self, nodes: np.ndarray, places: np.ndarray, values: np.ndarray) -> None:
        """Decodes leaves of 8^3 voxels at byte offsets `nodes` into the box `values`, at `places` [N, 3] in leaves."""
        x, y, z = (n // LEAF for n in values.shape)
        cut = values.reshape(x, LEAF, y, LEAF, z, LEAF).transpose(0, 2, 4, 1, 3, 5)
        form = {"float": "<f4", "double": "<f8"}.get(self._type, "")
        head = 96 if self._type == "float" else 128 if form else _CODES
        groups = [(np.arange(len(nodes)), 8 * np.dtype(form).itemsize if form else _BITS.get(self._type, 0))]
        if self._type == "fpn":  # each leaf states its number of bits
            self._count(len(nodes), _CODES + LEAF**3 // 8)
            width = self._rows(nodes, 16)[:, 15] >> 5
            if (width > 4).any():
                raise ValueError("expected codes of at most 16 bits in its leaves, found longer ones")
            groups = [(np.flatnonzero(width == b), 1 << b) for b in range(5)]
        for chosen, bits in groups:
            size = head + LEAF**3 * bits // 8
            self._count(len(chosen), size)
            for at in range(0, len(chosen), _CHUNK):
                part = chosen[at : at + _CHUNK]
                rows = self._rows(nodes[part], size)
                stored = np.ascontiguousarray(rows[:, head:])
                if form:
                    numbers = stored.view(form).astype(np.float32)
                else:
                    low, quantum = (np.ascontiguousarray(rows[:, i : i + 4]).view("<f4") for i in (80, 84))
                    numbers = _codes(stored, bits) * quantum + low
                cut[tuple(places[part].T)] = numbers.reshape(-1, LEAF, LEAF, LEAF)

    def _count(self, count: int, size: int) -> None:
        if count * size > self._data.size:
            raise ValueError(
                f"expected nodes within its {self._data.size} bytes, found {count} nodes of {size} bytes each"
            )

    def _number(self, form: str, at: int) -> int:
        return struct.unpack_from(form, self._data, at)[0]

    def _rows(self, offsets: np.ndarray, size: int, form: str = "u1") -> np.ndarray:
        """Returns the `size` bytes at each of N byte offsets as numbers of the type `form`, [N, numbers]."""
        if len(offsets) and not 0 <= offsets.min() <= offsets.max() <= self._data.size - size:
            raise ValueError(f"expected nodes within its {self._data.size} bytes, found one outside")
        if not len(offsets):
            return np.zeros((0, size // np.dtype(form).itemsize), form)
        return np.lib.stride_tricks.sliding_window_view(self._data, size)[offsets].view(form)


def _codes(packed: np.ndarray, bits: int) -> np.ndarray:
    """Unpacks the 512 codes of N leaves, `bits` (1 to 16) each, lowest bits of a byte first: float32 [N, 512]."""
    if bits == 16:
        return packed.view("<u2").astype(np.float32)
    shifts = np.arange(0, 8, bits, dtype=np.uint8)
    return (packed[:, :, None] >> shifts & ((1 << bits) - 1)).reshape(len(packed), -1).astype(np.float32)
