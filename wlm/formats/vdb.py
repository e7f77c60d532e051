"""Reading of OpenVDB's `.vdb` files: the float grids that Blender, Houdini and EmberGen write, as dense arrays.

No package of OpenVDB can be installed from an index, so the format is read here: files from version 222 on (OpenVDB
2.0, 2013) and trees `float_5_4_3` and `double_5_4_3`, stored in full or as halves, with whole leaves or only their
active voxels, uncompressed or compressed by zlib or Blosc. Grids of other types are listed only. The only description
of the format is OpenVDB's source code: `io/Archive.cc`, `io/Compression.h`, `tree/RootNode.h`, `InternalNode.h`,
`LeafNode.h`."""

import math
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from wlm.errors import WlmError
from wlm.formats.blosc import unpack as unpack_blosc
from wlm.formats.limits import SURE_BOX, VOXELS, VOXELS_A_BYTE
from wlm.formats.reading import damaged

MAGIC, _OLDEST, NEWEST = 0x56444220, 222, 224
_HALF = "_HalfFloat"
_NUMBERS = ("float", "double", "fp4", "fp8", "fp16", "fpn")
ZIP, ACTIVE_MASK, _BLOSC = 1, 2, 4
# Codes of the format: one or two inactive values are stored, and a mask selects between them.
_ONE_VALUE, _TWO_VALUES, _MASK, _ALL = (2, 4, 5), 5, (3, 4, 5), 6
LEAF, LOWER, UPPER = 8, 16, 32
"""Voxels along an edge of a leaf, and children along an edge of a lower and of an upper inner node."""

_LOWER_EDGE, _UPPER_EDGE = LEAF * LOWER, LEAF * LOWER * UPPER  # voxels
_MASK_BYTES = LEAF**3 // 8
LARGEST = 2**31 - 1
"""Largest number of voxels that a kernel can index."""
_FARTHEST = 1 << 30  # bound of coordinates, which prevents overflow
_LONGEST_TEXT = 1 << 16
_MOST_GRIDS = 4096
DAMAGE = (ValueError, LookupError, OverflowError, MemoryError, struct.error, zlib.error)
"""Exceptions for damaged data."""


@dataclass(frozen=True)
class GridHead:
    """The name of a grid, the type of its values such as "float", and its class such as "level set", "" if unknown."""

    name: str
    type: str
    group: str

    @property
    def is_number(self) -> bool:
        """Whether the grid has one number per voxel that can be read."""
        return self.type in _NUMBERS

    def __str__(self) -> str:
        kind = self.group if self.group and self.is_number else self.type
        return (self.name or "an unnamed grid") + ("" if kind in _NUMBERS else f" ({kind})")


@dataclass(frozen=True, eq=False)
class VdbGrid:
    """A grid of a file: its name, and values float32 [X, Y, Z] over the bounding box of the active voxels, or voxel 0
    if none is active. `low` is the box's lowest voxel (x, y, z); `matrix`, float64 [4, 4], maps indices of voxel
    centres to world space; `background` is the value of all voxels that are not stored."""

    name: str
    matrix: np.ndarray
    low: tuple[int, int, int]
    values: np.ndarray
    background: float


@dataclass(frozen=True)
class _Entry:
    """A grid of a file: whether it is stored as halves, the grid whose tree it shares, and its offset in bytes."""

    head: GridHead
    half: bool
    parent: str
    at: int


class GridFile(ABC):
    """A file of grids in memory, of which only the list of grids, `heads`, has been read, in the order of the file; of
    several with one name, only the first can be read. `FORMAT` is the name of the format."""

    FORMAT: ClassVar[str]

    def __init__(self, data: bytes, where: str) -> None:
        """Reads the list of grids from the content of a file, which `where` names in messages."""
        self._where, self._data = where, data
        with damaged(f"{where}: cannot read the {self.FORMAT} file", *DAMAGE):
            entries = list(self._list())
        self._entries = {entry.head.name: entry for entry in reversed(entries)}
        self.heads = tuple(entry.head for entry in entries)

    def read(self, name: str, trust: bool) -> VdbGrid:
        """Reads a grid; `trust` tells whether it may be as large as it claims."""
        where = f"{self._where}: {name or 'grid 0'}"
        with (
            damaged(f"{where}: cannot read the {self.FORMAT} file", *DAMAGE),
            np.errstate(over="ignore", invalid="ignore"),  # of doubles, which the caller repairs
        ):
            return self._read(self._entries[name], where, trust)

    @abstractmethod
    def _list(self) -> Iterator[Any]:
        """Yields for each grid of the file an object whose attribute `head` is its `GridHead`."""

    @abstractmethod
    def _read(self, entry: Any, where: str, trust: bool) -> VdbGrid:
        """Reads the grid of an entry."""


def most_voxels(size: int, trust: bool) -> int:
    """Returns the most voxels of the box of a grid of `size` bytes; `trust` lifts the limit."""
    return LARGEST if trust else min(VOXELS, max(SURE_BOX, VOXELS_A_BYTE * size))


class VdbFile(GridFile):
    """A `.vdb` file."""

    FORMAT = "OpenVDB"

    def _read(self, entry: _Entry, where: str, trust: bool) -> VdbGrid:
        matrix, cursor, flags = self._head(entry, where)
        name = entry.head.name
        if entry.parent:
            if entry.parent not in self._entries or self._entries[entry.parent].parent:
                raise WlmError(f"{where}: the grid {entry.parent}, whose tree it shares, is missing")
            entry = self._entries[entry.parent]
            _, cursor, flags = self._head(entry, where)
        tree = _Tree(cursor, flags, entry, where)
        low, values = tree.dense(most_voxels(len(self._data), trust))
        return VdbGrid(name, matrix, low, values, float(tree.background))

    def _list(self) -> Iterator[_Entry]:
        cursor = Cursor(self._data)
        magic, version = cursor.unpack("<qI")
        if magic != MAGIC:
            raise WlmError(f"{self._where}: expected an OpenVDB file, found other content")
        if not _OLDEST <= version <= NEWEST:
            raise WlmError(f"{self._where}: expected version {_OLDEST} to {NEWEST} of OpenVDB's files, found {version}")
        cursor.unpack("<II")  # the version of the library
        (offsets,) = cursor.unpack("<?")
        if not offsets:
            raise WlmError(
                f"{self._where}: expected a file with the offsets of its grids, found a stream: save it anew"
            )
        cursor.take(36)  # the UUID of the file
        cursor.metadata()
        (count,) = cursor.unpack("<I")
        if count > _MOST_GRIDS:
            raise WlmError(f"{self._where}: expected at most {_MOST_GRIDS} grids, found {count}")
        for _ in range(count):
            # Grids of equal names have a number after a separator character.
            name, kind, parent = (cursor.text() for _ in range(3))
            at, _, end = cursor.unpack("<3q")
            cursor.at = at + 4
            group, plain = cursor.metadata(), kind.removesuffix(_HALF)
            head = GridHead(name.partition("\x1e")[0], plain.removeprefix("Tree_").removesuffix("_5_4_3"), group)
            yield _Entry(head, plain != kind, parent.partition("\x1e")[0], at)
            cursor.at = end

    def _head(self, entry: _Entry, where: str) -> tuple[np.ndarray, "Cursor", int]:
        """Returns a grid's transform, a cursor at the start of its tree, and its compression flags."""
        if not entry.head.is_number:
            raise WlmError(f"{where}: expected a grid of floats, found {entry.head.type}")
        cursor = Cursor(self._data, entry.at)
        (flags,) = cursor.unpack("<I")
        if flags & ~(ZIP | ACTIVE_MASK | _BLOSC):
            raise WlmError(f"{where}: expected values compressed by zlib or Blosc, found the flags {flags}")
        cursor.metadata()
        return _matrix(cursor, where), cursor, flags


class Cursor:
    """A position in bytes, or in a file (`wlm.formats.reading.FileBytes`), from which values are read."""

    def __init__(self, data: Any, at: int = 0) -> None:
        self.data, self.at = data, at

    def skip(self, count: int) -> None:
        """Moves past the next bytes, which must exist."""
        end = self.at + count
        if not 0 <= self.at <= end <= len(self.data):
            raise ValueError(f"the file ends before byte {end}")
        self.at = end

    def take(self, count: int) -> bytes:
        """Returns the next bytes."""
        begin = self.at
        self.skip(count)
        return self.data[begin : self.at]

    def unpack(self, form: str) -> tuple:
        """Returns the next numbers, in a format of `struct`."""
        return struct.unpack(form, self.take(struct.calcsize(form)))

    def text(self) -> str:
        """Reads a text with its length in front of it."""
        (length,) = self.unpack("<I")
        if length > _LONGEST_TEXT:
            raise ValueError(f"expected a text of at most {_LONGEST_TEXT} bytes, found {length}")
        return self.take(length).decode("utf-8", "replace")

    def metadata(self) -> str:
        """Reads metadata; returns the class of the grid, "" if it is not stated."""
        group = ""
        for _ in range(self.unpack("<I")[0]):
            name, _, (length,) = self.text(), self.text(), self.unpack("<I")
            if name == "class" and length < _LONGEST_TEXT:
                group = self.take(length).decode("utf-8", "replace")
            else:
                self.skip(length)
        return "" if group == "unknown" else group

    def bits(self, count: int) -> np.ndarray:
        """Reads a mask, bool [count]."""
        packed = np.frombuffer(self.take(count // 8), np.uint8)
        return np.unpackbits(packed, bitorder="little").view(bool)


class _Tree:
    """The nodes of a grid: first the topology, with only the masks of leaves, and then the values of the leaves."""

    def __init__(self, cursor: Cursor, flags: int, entry: _Entry, where: str) -> None:
        self._cursor, self._flags, self._where = cursor, flags, where
        self._one = "<d" if entry.head.type == "double" else "<f"
        self._many = "<f2" if entry.half else self._one
        self._bytes = np.dtype(self._many).itemsize
        self._tiles: list[Tiles] = []
        self._corners: list[np.ndarray] = []  # the corners of leaves
        self._masks: list[bytes] = []
        if cursor.unpack("<I") != (1,):
            raise ValueError("expected a tree with one value buffer per leaf, found another number")
        self.background = np.float32(cursor.unpack(self._one)[0])
        tiles, children = cursor.unpack("<II")
        kind = np.dtype([("corner", "<i4", 3), ("value", self._one), ("active", "u1")])
        self._roots = np.frombuffer(cursor.take(tiles * kind.itemsize), kind)
        corners = [self._roots["corner"].astype(np.int64)]
        for _ in range(children):
            corners.append(np.array([cursor.unpack("<3i")], np.int64))
            self._node(corners[-1][0], UPPER, _LOWER_EDGE)
        # Nodes that overlap would multiply the work for a byte of the file.
        places = np.concatenate(corners)
        if (places % _UPPER_EDGE).any() or len(np.unique(places, axis=0)) < len(places):
            raise ValueError(
                f"expected root nodes at different multiples of {_UPPER_EDGE} voxels, found two at one or one elsewhere"
            )

    def _node(self, corner: np.ndarray, side: int, edge: int) -> None:
        """Reads an inner node with `side` children along each edge, each of `edge` voxels."""
        cursor, count = self._cursor, side**3
        children, active = cursor.bits(count), cursor.bits(count)
        values = self._values(active)
        seen = ~children & (active | (values != self.background))
        if seen.any():
            cube = (side,) * 3
            self._tiles.append(Tiles(corner, edge, values.reshape(cube), seen.reshape(cube), active.reshape(cube)))
        places = corner + edge * np.stack(np.unravel_index(np.flatnonzero(children), (side,) * 3), 1)
        if edge == LEAF:
            self._corners.append(places)
            self._masks.append(cursor.take(_MASK_BYTES * len(places)))
        else:
            for place in places:
                self._node(place, LOWER, LEAF)

    def dense(self, most: int) -> tuple[tuple[int, int, int], np.ndarray]:
        """Returns the lowest voxel of the active voxels' bounding box, and the values in the box, float32 [X, Y, Z]."""
        corners = np.concatenate([np.zeros((0, 3), np.int64), *self._corners])
        masks = np.frombuffer(b"".join(self._masks), np.uint8).reshape(-1, _MASK_BYTES)
        low, high = self._box(corners, masks)
        values, first = leaf_array(low, high, most, self._where)
        values.fill(self.background)
        Tiles.paste_roots(values, first, self._roots["corner"].astype(np.int64), self._roots["value"])
        for tiles in self._tiles:
            tiles.paste(values, first)
        inside = ((corners >= first) & (corners < first + values.shape)).all(1)
        for at, mask, kept in zip((corners - first).tolist(), masks, inside.tolist(), strict=True):
            self._cursor.take(_MASK_BYTES)  # the mask is repeated
            leaf = self._values(np.unpackbits(mask, bitorder="little").view(bool))
            if kept:
                x, y, z = at
                values[x : x + LEAF, y : y + LEAF, z : z + LEAF] = leaf.reshape(LEAF, LEAF, LEAF)
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
            places = np.argwhere(np.unpackbits(mask, bitorder="little").reshape((LEAF,) * 3))
            lows.append(corner + places.min(0))
            highs.append(corner + places.max(0) + 1)
        for tiles in self._tiles:
            places = np.argwhere(tiles.active & tiles.seen)
            if len(places):
                lows.append(tiles.corner + tiles.edge * places.min(0))
                highs.append(tiles.corner + tiles.edge * (places.max(0) + 1))
        places = self._roots["corner"][self._roots["active"] != 0].astype(np.int64)
        if len(places):
            lows.append(places.min(0))
            highs.append(places.max(0) + _UPPER_EDGE)
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
        others = [self.background if kind == 0 else -self.background, self.background]
        if kind in _ONE_VALUE:
            others[0] = cursor.unpack(self._one)[0]
        if kind == _TWO_VALUES:
            others[1] = cursor.unpack(self._one)[0]
        chosen = cursor.bits(len(active)) if kind in _MASK else None
        count = len(active)
        if self._flags & ACTIVE_MASK and kind != _ALL:
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
        cursor, half, size = self._cursor, self._many == "<f2", count * self._bytes
        if not count and half:
            return np.zeros(0, np.float32)
        if self._flags & (ZIP | _BLOSC):
            (packed,) = cursor.unpack("<q")
            piece = cursor.take(abs(packed))
            if packed > 0 and self._flags & _BLOSC:
                piece = unpack_blosc(piece, size)
            elif packed > 0:
                piece = zlib.decompressobj().decompress(piece, size + 1)
            if len(piece) != size:
                raise ValueError(
                    f"expected a node's values of {size} bytes after decompression, found {len(piece)} or more"
                )
        else:
            piece = cursor.take(size)
        return np.frombuffer(piece, self._many).astype(np.float32)


def leaf_array(low: np.ndarray, high: np.ndarray, most: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Allocates the whole leaves around a box of voxels from `low` [3] up to but without `high` [3]. Returns
    uninitialised values, float32 [X, Y, Z], and their first voxel [3]."""
    first = low // LEAF * LEAF
    shape = -(-(high - first) // LEAF) * LEAF
    if not (low.min() >= -_FARTHEST and high.max() <= _FARTHEST and math.prod(shape.tolist()) <= most):
        box = [low.tolist(), (high - 1).tolist()]
        raise WlmError(f"{where}: expected a box of at most {most} voxels, found {box}")
    return np.empty(shape, np.float32), first


@dataclass(frozen=True, eq=False)
class Tiles:
    """Children of a node with one constant value each (tiles): the node's lowest voxel, the edge of a child in voxels,
    and [N, N, N] each child's value, whether it is a tile that differs from the background, and whether it is active.
    """

    corner: np.ndarray
    edge: int
    values: np.ndarray
    seen: np.ndarray
    active: np.ndarray

    @staticmethod
    def paste_roots(values: np.ndarray, first: np.ndarray, corners: np.ndarray, constants: np.ndarray) -> None:
        """Writes N constant cubes of 4096 voxels an edge, tiles of the root, with lowest voxels `corners` [N, 3]."""
        begins = np.maximum(corners - first, 0)
        ends = np.minimum(corners - first + _UPPER_EDGE, values.shape)
        for i in np.flatnonzero((begins < ends).all(1)).tolist():
            values[tuple(slice(a, b) for a, b in zip(begins[i], ends[i], strict=True))] = constants[i]

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


def _matrix(cursor: Cursor, where: str) -> np.ndarray:
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
        reason = " (a camera's frustum)" if "Frustum" in kind else ""
        raise WlmError(
            f"{where}: expected a linear transform, found a {kind[:40]}{reason}: resample the grid to cubic voxels"
        )
    if not np.isfinite(matrix).all():
        raise ValueError("expected a transform of finite numbers")
    return matrix
