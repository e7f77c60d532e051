"""Reading of OpenVDB's `.vdb` files: the float grids that Blender, Houdini and EmberGen write, as dense arrays.

No package of OpenVDB can be installed from an index, so the format is read here: files from version 222 on (OpenVDB
2.0, 2013) and trees `float_5_4_3`, stored as floats or halves, with whole leaves or only their active voxels,
uncompressed or compressed by zlib or Blosc. Grids of other types are skipped. The only description of the format is
OpenVDB's source code: `io/Archive.cc`, `io/Compression.h`, `tree/RootNode.h`, `InternalNode.h`, `LeafNode.h`."""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from wlm.errors import WlmError
from wlm.formats.blosc import unpack as unpack_blosc
from wlm.formats.reading import damaged

_MAGIC, _OLDEST, _NEWEST = 0x56444220, 222, 224
_HALF = "_HalfFloat"
_FLOATS = ("Tree_float_5_4_3", "Tree_float_5_4_3" + _HALF)
_ZIP, _ACTIVE_MASK, _BLOSC = 1, 2, 4
# Codes of the format: one or two inactive values are stored, and a mask selects between them.
_ONE_VALUE, _TWO_VALUES, _MASK, _ALL = (2, 4, 5), 5, (3, 4, 5), 6
_LEAF, _LOWER, _UPPER = 8, 16, 32  # children along an edge of each kind of node
_LOWER_EDGE, _UPPER_EDGE = _LEAF * _LOWER, _LEAF * _LOWER * _UPPER  # voxels
_MASK_BYTES = _LEAF**3 // 8
_FARTHEST = 1 << 30  # bound of coordinates, which prevents overflow
_LONGEST_TEXT = 1 << 16
_MOST_GRIDS = 4096
_DAMAGE = (ValueError, LookupError, OverflowError, MemoryError, struct.error, zlib.error)


@dataclass(frozen=True, eq=False)
class VdbGrid:
    """A grid of a file.

    Attributes:
        name: Name of the grid in the file.
        matrix: float64 [4, 4], from the indices of voxel centres to world space.
        low: Index of the lowest voxel of the bounding box, (x, y, z).
        values: float32 [X, Y, Z] over the bounding box of the active voxels, or voxel 0 if none is active.
    """

    name: str
    matrix: np.ndarray
    low: tuple[int, int, int]
    values: np.ndarray


@dataclass(frozen=True)
class _Entry:
    """An entry in the file's list of grids: its offset in bytes, and the name of a grid whose tree it shares."""

    name: str
    type: str
    parent: str
    at: int


class VdbFile:
    """A `.vdb` file in memory, of which only the list of grids has been read.

    Attributes:
        names: Names of the float grids, in the order of the file.
        others: Names and types of the other grids.
    """

    def __init__(self, data: bytes, where: str) -> None:
        """Reads the list of grids from the content of a file, which `where` names in messages.

        Raises:
            WlmError: The content is no OpenVDB file, is too old or too new, or is damaged.
        """
        self._where, self._data = where, data
        with damaged(f"{where}: cannot read the OpenVDB file", *_DAMAGE):
            entries = list(self._list())
        self._entries = {entry.name: entry for entry in reversed(entries)}
        self.names = tuple(dict.fromkeys(entry.name for entry in entries if entry.type in _FLOATS))
        self.others = tuple(f"{entry.name} ({entry.type})" for entry in entries if entry.type not in _FLOATS)

    def read(self, name: str, most: int) -> VdbGrid:
        """Reads the grid of one of `names`, whose bounding box may have at most `most` voxels.

        Raises:
            WlmError: The grid is damaged, is a frustum, or has a bounding box that is too large.
        """
        entry, where = self._entries[name], f"{self._where}: {name}"
        with damaged(f"{where}: cannot read the OpenVDB file", *_DAMAGE):
            matrix, cursor, flags = self._head(entry, where)
            if entry.parent:
                if entry.parent not in self._entries or self._entries[entry.parent].parent:
                    raise WlmError(f"{where}: the grid {entry.parent}, whose tree it shares, is missing")
                entry = self._entries[entry.parent]
                _, cursor, flags = self._head(entry, where)
            tree = _Tree(cursor, flags, entry.type.endswith(_HALF), where)
            low, values = tree.dense(most)
        return VdbGrid(name, matrix, low, values)

    def _list(self) -> Iterator[_Entry]:
        cursor = _Cursor(self._data)
        magic, version = cursor.unpack("<qI")
        if magic != _MAGIC:
            raise WlmError(f"{self._where}: expected an OpenVDB file, found other content")
        if not _OLDEST <= version <= _NEWEST:
            raise WlmError(
                f"{self._where}: expected version {_OLDEST} to {_NEWEST} of OpenVDB's files, found {version}"
            )
        cursor.unpack("<II")  # the version of the library
        (offsets,) = cursor.unpack("<?")
        if not offsets:
            raise WlmError(f"{self._where}: expected a file with grid offsets, found a stream")
        cursor.take(36)  # the UUID of the file
        cursor.metadata()
        (count,) = cursor.unpack("<I")
        if count > _MOST_GRIDS:
            raise WlmError(f"{self._where}: expected at most {_MOST_GRIDS} grids, found {count}")
        for _ in range(count):
            # Grids of equal names have a number after a separator character.
            name, kind, parent = (cursor.text() for _ in range(3))
            at, _, end = cursor.unpack("<3q")
            yield _Entry(name.partition("\x1e")[0], kind, parent.partition("\x1e")[0], at)
            cursor.at = end

    def _head(self, entry: _Entry, where: str) -> tuple[np.ndarray, "_Cursor", int]:
        """Returns a grid's transform, a cursor at the start of its tree, and its compression flags."""
        cursor = _Cursor(self._data, entry.at)
        (flags,) = cursor.unpack("<I")
        if flags & ~(_ZIP | _ACTIVE_MASK | _BLOSC):
            raise WlmError(f"{where}: expected values compressed by zlib or Blosc, found the flags {flags}")
        cursor.metadata()
        return _matrix(cursor, where), cursor, flags


class _Cursor:
    """A position in the bytes of a file, from which values are read."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data, self.at = data, at

    def take(self, count: int) -> bytes:
        end = self.at + count
        if not 0 <= self.at <= end <= len(self.data):
            raise ValueError(f"the file ends before byte {end}")
        piece = self.data[self.at : end]
        self.at = end
        return piece

    def unpack(self, form: str) -> tuple:
        return struct.unpack(form, self.take(struct.calcsize(form)))

    def text(self) -> str:
        (length,) = self.unpack("<I")
        if length > _LONGEST_TEXT:
            raise ValueError(f"expected a text of at most {_LONGEST_TEXT} bytes, found {length}")
        return self.take(length).decode("utf-8", "replace")

    def metadata(self) -> None:
        for _ in range(self.unpack("<I")[0]):
            self.text()
            self.text()
            self.take(self.unpack("<I")[0])

    def bits(self, count: int) -> np.ndarray:
        """Reads a mask, bool [count]."""
        packed = np.frombuffer(self.take(count // 8), np.uint8)
        return np.unpackbits(packed, bitorder="little").view(bool)


class _Tree:
    """The nodes of a grid: first the topology, with only the masks of leaves, and then the values of the leaves."""

    def __init__(self, cursor: _Cursor, flags: int, half: bool, where: str) -> None:
        self._cursor, self._flags, self._half, self._where = cursor, flags, half, where
        self._tiles: list[_Tiles] = []
        self._corners: list[np.ndarray] = []  # the corners of leaves
        self._masks: list[bytes] = []
        if cursor.unpack("<I") != (1,):
            raise ValueError("expected a tree with one value buffer per leaf, found another number")
        self._background, tiles, children = cursor.unpack("<fII")
        for _ in range(tiles):
            *corner, value, active = cursor.unpack("<3if?")
            shape = (1, 1, 1)
            self._tiles.append(_Tiles(corner, _UPPER_EDGE, np.full(shape, value), np.full(shape, active)))
        for _ in range(children):
            self._node(np.array(cursor.unpack("<3i"), np.int64), _UPPER, _LOWER_EDGE)
        self._check_places()

    def _node(self, corner: np.ndarray, side: int, edge: int) -> None:
        """Reads an inner node with `side` children along each edge, each of `edge` voxels."""
        cursor, count = self._cursor, side**3
        children, active = cursor.bits(count), cursor.bits(count)
        values = self._values(active)
        seen = ~children & (active | (values != self._background))
        if seen.any():
            cube = (side,) * 3
            self._tiles.append(_Tiles(corner, edge, values.reshape(cube), active.reshape(cube), seen.reshape(cube)))
        places = corner + edge * np.stack(np.unravel_index(np.flatnonzero(children), (side,) * 3), 1)
        if edge == _LEAF:
            self._corners.append(places)
            self._masks.append(cursor.take(_MASK_BYTES * len(places)))
        else:
            for place in places:
                self._node(place, _LOWER, _LEAF)

    def _check_places(self) -> None:
        """Raises an error if two nodes cover the same voxels: a small malicious file could cause much work."""
        leaves = np.concatenate([np.zeros((0, 3)), *self._corners])
        tiles = np.array([[*tiles.corner, tiles.edge] for tiles in self._tiles]).reshape(-1, 4)
        if any(len(np.unique(places, axis=0)) < len(places) for places in (leaves, tiles)):
            raise ValueError("expected nodes at different positions, found two at the same position")

    def dense(self, most: int) -> tuple[tuple[int, int, int], np.ndarray]:
        """Returns the lowest voxel of the active voxels' bounding box, and the values in the box, float32 [X, Y, Z]."""
        corners = np.concatenate([np.zeros((0, 3), np.int64), *self._corners])
        masks = np.frombuffer(b"".join(self._masks), np.uint8).reshape(-1, _MASK_BYTES)
        low, high = self._box(corners, masks)
        if not (low.min() >= -_FARTHEST and high.max() <= _FARTHEST and math.prod((high - low).tolist()) <= most):
            box = [low.tolist(), (high - 1).tolist()]
            raise WlmError(f"{self._where}: expected a box of at most {most} voxels, found {box}")
        # The array consists of whole leaves.
        first = low // _LEAF * _LEAF
        values = np.full(-(-(high - first) // _LEAF) * _LEAF, self._background, np.float32)
        for tiles in self._tiles:
            tiles.paste(values, first)
        inside = ((corners >= first) & (corners < first + values.shape)).all(1)
        for at, mask, kept in zip((corners - first).tolist(), masks, inside.tolist(), strict=True):
            self._cursor.take(_MASK_BYTES)  # the mask is repeated
            leaf = self._values(np.unpackbits(mask, bitorder="little").view(bool))
            if kept:
                x, y, z = at
                values[x : x + _LEAF, y : y + _LEAF, z : z + _LEAF] = leaf.reshape(_LEAF, _LEAF, _LEAF)
        return tuple(low.tolist()), values[tuple(slice(a, b) for a, b in zip(low - first, high - first, strict=True))]

    def _box(self, corners: np.ndarray, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the lowest corner of the box of the active voxels, [3], and its highest corner plus one, [3]."""
        lows, highs = [], []
        some = masks.any(1)
        corners, masks = corners[some], masks[some]
        # Only leaves at the border of the bounding box of all leaves matter, and these are few.
        ends = corners.min(0, initial=_FARTHEST), corners.max(0, initial=-_FARTHEST)
        outer = ((corners == ends[0]) | (corners == ends[1])).any(1)
        for corner, mask in zip(corners[outer], masks[outer], strict=True):
            places = np.argwhere(np.unpackbits(mask, bitorder="little").reshape((_LEAF,) * 3))
            lows.append(corner + places.min(0))
            highs.append(corner + places.max(0) + 1)
        for tiles in self._tiles:
            if tiles.active.any():
                places = np.argwhere(tiles.active & tiles.seen)
                lows.append(tiles.corner + tiles.edge * places.min(0))
                highs.append(tiles.corner + tiles.edge * (places.max(0) + 1))
        if not lows:
            # No voxel is active, for example before the smoke starts.
            return np.zeros(3, np.int64), np.ones(3, np.int64)
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def _values(self, active: np.ndarray) -> np.ndarray:
        """Reads the values of a node's voxels or children, float32 [count]; `active` is the node's mask."""
        cursor = self._cursor
        (kind,) = cursor.unpack("<B")
        if kind > _ALL:
            raise ValueError(f"expected a storage code from 0 to {_ALL}, found {kind}")
        others = [self._background if kind == 0 else -self._background, self._background]
        if kind in _ONE_VALUE:
            others[0] = cursor.unpack("<f")[0]
        if kind == _TWO_VALUES:
            others[1] = cursor.unpack("<f")[0]
        chosen = cursor.bits(len(active)) if kind in _MASK else None
        count = len(active)
        if self._flags & _ACTIVE_MASK and kind != _ALL:
            count = int(np.count_nonzero(active))
        stored = self._numbers(count)
        if count == len(active):
            return stored
        values = np.full(len(active), others[0], np.float32)
        if chosen is not None:
            values[chosen] = others[1]
        values[active] = stored
        return values

    def _numbers(self, count: int) -> np.ndarray:
        """Reads and decompresses the next numbers, float32 [count]."""
        cursor, size = self._cursor, count * (2 if self._half else 4)
        if not count and self._half:
            return np.zeros(0, np.float32)
        if self._flags & (_ZIP | _BLOSC):
            (packed,) = cursor.unpack("<q")
            piece = cursor.take(abs(packed))
            if packed > 0 and self._flags & _BLOSC:
                piece = unpack_blosc(piece, size)
            elif packed > 0:
                piece = zlib.decompressobj().decompress(piece, size + 1)
            if len(piece) != size:
                raise ValueError(f"expected {size} bytes after decompression, found at least {len(piece)}")
        else:
            piece = cursor.take(size)
        return np.frombuffer(piece, "<f2" if self._half else "<f4").astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Tiles:
    """Children of a node with one constant value each (tiles).

    Attributes:
        corner: Index of the lowest voxel of the node, [3].
        edge: Edge of a child, in voxels.
        values, active: Value and active state of each child, [N, N, N], N children along each edge.
        seen: Whether each child is a tile that differs from the background, [N, N, N]; by default, all are.
    """

    corner: np.ndarray
    edge: int
    values: np.ndarray
    active: np.ndarray
    seen: np.ndarray = field(default_factory=lambda: np.ones((1, 1, 1), bool))

    def paste(self, values: np.ndarray, first: np.ndarray) -> None:
        """Writes the tiles into the values of a box of voxels, whose lowest voxel is `first`."""
        place = np.asarray(self.corner) - first
        begin = np.maximum(place, 0)
        end = np.minimum(place + self.edge * len(self.values), values.shape)
        if (begin >= end).any():
            return
        # The child of each voxel along each axis.
        child = np.ix_(*(np.arange(b, e) for b, e in zip(begin - place, end - place, strict=True)))
        child = tuple(along // self.edge for along in child)
        part = values[tuple(slice(b, e) for b, e in zip(begin, end, strict=True))]
        np.copyto(part, self.values[child], where=self.seen[child])


def _matrix(cursor: _Cursor, where: str) -> np.ndarray:
    """Reads a transform, float64 [4, 4], from the indices of voxel centres to world space."""
    kind = cursor.text()
    matrix = np.eye(4)
    if kind in ("AffineMap", "UnitaryMap"):
        # The file stores the transpose, for row vectors.
        matrix = np.array(cursor.unpack("<16d")).reshape(4, 4).T
    elif kind in ("ScaleMap", "UniformScaleMap", "ScaleTranslateMap", "UniformScaleTranslateMap"):
        if kind.endswith("TranslateMap"):
            matrix[:3, 3] = cursor.unpack("<3d")
        matrix[:3, :3] = np.diag(cursor.unpack("<3d"))
        cursor.take(4 * 24)  # values derived from the scale
    elif kind == "TranslationMap":
        matrix[:3, 3] = cursor.unpack("<3d")
    else:
        raise WlmError(f"{where}: expected a linear transform, found a {kind[:40]}")
    if not np.isfinite(matrix).all():
        raise ValueError("expected a transform of finite numbers")
    return matrix
