"""Light probes and lightmap users of a Godot 4 lightmap bake (`.lmbake`): reading, replacing and writing.

The file is a Godot binary resource (`RSRC`, or compressed `RSCC`) of the type `LightmapGIData`. Its property
`probe_data` is a dictionary with `points` and nine colours `sh` for each point; the tetrahedra and the BSP tree are
skipped. `lightmap_textures` refers to pictures, each of one or more slices; `user_data` has four values for each mesh
that uses them: the path of its node, its rectangle, its slice, and -1 or the cell of a GridMap.

The nine colours are spherical harmonics L0 to L2 in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2, all signs plus, in
the axes of the scene (right-handed, y up, metres). They represent the incoming radiance divided by pi, without the
cosine convolution: see "godot" in `wlm.probe.conventions`. Probes inside walls are often all zero.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import BAKE_BYTES, Budget, check_growth
from wlm.formats.reading import read_file
from wlm.formats.zstd import decompress

COEFFICIENTS = 9
_TYPE = "LightmapGIData"
_PROPERTY, _TEXTURES, _USERS, _DIRECTIONAL = "probe_data", "lightmap_textures", "user_data", "uses_spherical_harmonics"

# Versions of the container: 4 came with Godot 4.0, 6 with 4.3.
_ENGINE = 4
_FORMATS = (4, 5, 6)
_HAS_UIDS, _IS_DOUBLE, _HAS_SCRIPT_CLASS = 2, 4, 8
_RESERVED = 11
_WRITTEN_FORMAT, _NAMED_IDS = 4, 1  # every Godot 4 reads it

# Compressed files use Zstandard in blocks of 4096 bytes. The limit bounds the memory for a damaged size.
_ZSTD = 2
_LARGEST_BLOCK = 1 << 20

# Types of values. A real number has 4 bytes, or 8 in a file of a double-precision build.
_BOOL, _INT, _FLOAT, _RECTANGLE, _AABB, _LONG = 2, 3, 4, 11, 15, 40
_STRING, _STRING_NAME, _NODE_PATH, _OBJECT, _DICTIONARY, _ARRAY = 5, 44, 22, 24, 26, 30
_BYTES, _INTS, _STRINGS, _VECTOR3S, _COLOURS = 31, 32, 34, 35, 36
# Reals of the types of a fixed size: float, Vector2, Rect2, Vector3, Plane, Quaternion, AABB, Basis, Transform3D,
# Transform2D, Vector4, Projection; and bytes of nil, bool, int, Color, RID, 64-bit int, double, Callable, Signal (these
# two are not stored), Vector2i, Rect2i, Vector3i, Vector4i.
_REALS = {4: 1, 10: 2, 11: 4, 12: 3, 13: 4, 14: 4, 15: 6, 16: 9, 17: 12, 18: 6, 50: 4, 52: 16}
_SIZES = {1: 0, 2: 4, 3: 4, 20: 16, 23: 4, 40: 8, 41: 8, 42: 0, 43: 0, 45: 8, 46: 16, 47: 12, 51: 16}
# The same for an element of a packed array: of Vector3, Vector2, Vector4; and of bytes, ints and floats of 32 bits,
# colours, ints and floats of 64 bits.
_PACKED_REALS = {_VECTOR3S: 3, 37: 2, 53: 4}
_PACKED_SIZES = {_BYTES: 1, _INTS: 4, 33: 4, _COLOURS: 16, 48: 8, 49: 8}
# Kinds of references to a resource: no content, two strings (in old files), an index, an index.
_EMPTY, _EXTERNAL_PATH, _, _EXTERNAL = range(4)

# A value or name counts as so many bytes, and all may take so many: a million for any size of file.
_COST, _SURE, _GROWTH = 32, 32 << 20, 8

# Real files nest values two deep. The limit keeps a damaged file from exhausting the stack.
_DEEPEST = 32


@dataclass(frozen=True)
class GodotUser:
    """A mesh that uses a lightmap: path of its node with "/" between names; the rectangle x, y, width, height, by whose
    last two UV2 is scaled and by whose first two it is offset, v down; index of the slice, counted through all
    textures."""

    node: str
    rectangle: tuple[float, float, float, float]
    slice: int


@dataclass(frozen=True)
class GodotUsers:
    """The lightmaps of a bake, by Godot's names of the pictures (res://...), and their users in the order of the file.
    If they are directional, each slice has four parts: one of light and three of directions."""

    textures: tuple[str, ...]
    users: tuple[GodotUser, ...]
    directional: bool


def read_users(path: str | os.PathLike[str]) -> GodotUsers:
    """Reads the meshes that use a bake's lightmaps, and their rectangles."""
    reader = _reader(path)
    names, external = _open(reader)
    textures: list[str] = []
    users: list[GodotUser] = []
    directional = False
    for _ in range(reader.u32()):
        name = reader.name(names)
        if name == _TEXTURES:
            reader.expect(name, _ARRAY, "an array")
            for _ in range(reader.u32() & 0x7FFFFFFF):
                reader.expect(name, _OBJECT, "a texture")
                if reader.u32() != _EXTERNAL or (index := reader.u32()) >= len(external):
                    raise WlmError(f"{path}: {name}: expected references to texture files, found an embedded texture")
                textures.append(reader.refer(external[index]))
        elif name == _USERS:
            reader.expect(name, _ARRAY, "an array")
            count = reader.u32() & 0x7FFFFFFF
            if count % 4:
                raise WlmError(f"{path}: {name}: expected four values for each mesh, found {count} in all")
            users += [reader.user(names) for _ in range(count // 4)]
        elif name == _DIRECTIONAL:
            reader.expect(name, _BOOL, "a boolean")
            directional = reader.u32() != 0
        else:
            reader.skip()
    return GodotUsers(tuple(textures), tuple(users), directional)


def read_lmbake(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Reads the light probes of a Godot 4 lightmap bake, at least one. Returns the positions, float64 [N, 3] in metres,
    and the stored coefficients, float32 [N, 9, 3] in RGB, which the module's description defines."""
    points, colours, _, _ = _read(path)
    return points, colours.reshape(len(points), COEFFICIENTS, 4)[..., :3].copy()


def relit(path: str | os.PathLike[str], sh: np.ndarray) -> bytes:
    """Replaces the coefficients [N, 9, 3] of the N probes of a bake, and returns the new content of the file. Raises a
    WlmError as `read_lmbake` does, or if the bake is compressed. Raises a ValueError if the shape is wrong."""
    points, colours, reader, at = _read(path)
    if bytes(reader.data[:4]) != b"RSRC":
        raise WlmError(f"{path}: the bake is compressed; save it without compression to replace its light")
    if sh.shape != (len(points), COEFFICIENTS, 3):
        raise ValueError(f"sh: expected the shape ({len(points)}, {COEFFICIENTS}, 3), got {sh.shape}")
    changed = colours.reshape(len(points), COEFFICIENTS, 4)
    changed[..., :3] = sh
    light = changed.astype(f"{reader.order}f4").tobytes()
    return bytes(reader.data[:at]) + light + bytes(reader.data[at + len(light) :])


def _read(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, _Reader, int]:
    """Returns the probes' points [N, 3] and colours [9 N, 4], the reader, and the colours' byte offset in the file."""
    reader = _reader(path)
    names, _ = _open(reader)
    points = colours = None
    at = 0
    for _ in range(reader.u32()):
        if reader.name(names) != _PROPERTY:
            reader.skip()
            continue
        reader.expect(_PROPERTY, _DICTIONARY, "a dictionary")
        for _ in range(reader.u32() & 0x7FFFFFFF):
            key = reader.key()
            if key == "points":
                points = reader.vectors()
            elif key == "sh":
                colours = reader.colours()
                at = reader.position - 16 * len(colours)
            else:
                reader.skip()
    if points is None or colours is None or len(points) == 0:
        raise WlmError(
            f"{path}: {_PROPERTY} has no probes: bake with LightmapProbe nodes, or let Godot generate probes"
        )
    if len(colours) != COEFFICIENTS * len(points):
        raise WlmError(
            f"{path}: {_PROPERTY}.sh: expected {COEFFICIENTS} colours for each of {len(points)} points, "
            f"found {len(colours)}"
        )
    return points, colours, reader, at


def _reader(path: str | os.PathLike[str]) -> _Reader:
    data = read_file(path, BAKE_BYTES, "the bake")
    magic = data[:4]
    if magic == b"RSCC":
        # The decompressed content has no magic number, and its offsets count from its start.
        return _Reader(path, _decompress(_Reader(path, data, 4, len(data))), 0, len(data))
    if magic == b"RSRC":
        return _Reader(path, data, 4, len(data))
    raise WlmError(f"{path}: expected a Godot binary resource (RSRC or RSCC), found {magic!r} at its start")


def _open(reader: _Reader) -> tuple[list[str], list[str]]:
    """Reads the header up to the main resource's properties; returns the name table and the external file names."""
    path = reader.path
    big = reader.u32()
    if big > 1:
        raise WlmError(f"{path}: byte order: expected 0 or 1, found {big}: the file is damaged")
    reader.order = "<>"[big]
    reader.u32()  # a flag for doubles that is never set
    major, minor, version = reader.u32(), reader.u32(), reader.u32()
    if major != _ENGINE or version not in _FORMATS:
        raise WlmError(
            f"{path}: expected a resource of Godot {_ENGINE}, format {_FORMATS[0]} to {_FORMATS[-1]}, "
            f"found Godot {major}.{minor}, format {version}"
        )
    kind = reader.string()
    if kind != _TYPE:
        raise WlmError(f"{path}: expected a resource of the type {_TYPE}, found {kind!r}")
    reader.take(8)  # offset of import metadata
    flags = reader.u32()
    reader.real = 8 if flags & _IS_DOUBLE else 4
    reader.take(8)  # the resource's own UID
    if flags & _HAS_SCRIPT_CLASS:
        reader.string()
    reader.take(4 * _RESERVED)
    names = [reader.string() for _ in range(reader.u32())]
    external = []
    for _ in range(reader.u32()):
        reader.string()  # the type of an external resource
        external.append(reader.string())
        if flags & _HAS_UIDS:
            reader.take(8)
    offset = None
    for _ in range(reader.u32()):
        reader.string()
        offset = reader.u64()  # the last is the main resource
    if offset is None:
        raise WlmError(f"{path}: the file contains no resource: expected at least one")
    reader.seek(offset)
    reader.string()  # the type, repeated
    return names, external


class _Reader:
    """Reads numbers and values from bytes, and raises an error at their end. A stated length is compared with the
    remaining bytes before anything is allocated."""

    def __init__(self, path: str | os.PathLike[str], data: bytes, start: int, held: int) -> None:
        self.path = path
        self.data = memoryview(data)
        self.position = start
        self.order = "<"
        self.real = 4
        # Compressed bakes hold many values in few bytes, and values refer to names of any length by an index.
        self._budget = Budget(str(path), max(_SURE, _GROWTH * held), "bytes of names and values")

    def take(self, count: int) -> memoryview:
        self._budget.spend(_COST)
        left = len(self.data) - self.position
        if count > left:
            raise WlmError(
                f"{self.path}: cut short or damaged: expected {count} bytes at byte {self.position}, found {left}"
            )
        piece = self.data[self.position : self.position + count]
        self.position += count
        return piece

    def seek(self, offset: int) -> None:
        self.position = 0
        self.take(offset)

    def u32(self) -> int:
        return struct.unpack(self.order + "I", self.take(4))[0]

    def u64(self) -> int:
        return struct.unpack(self.order + "Q", self.take(8))[0]

    def string(self) -> str:
        """Reads a length in bytes and UTF-8 text that ends in a NUL."""
        return self._text(self.u32())

    def name(self, names: list[str]) -> str:
        """Reads an index into the name table, or inline text if the highest bit is set."""
        index = self.u32()
        if index & 0x80000000:
            return self._text(index & 0x7FFFFFFF)
        if index >= len(names):
            raise WlmError(f"{self.path}: damaged: expected an index of a name below {len(names)}, found {index}")
        return self.refer(names[index])

    def refer(self, name: str) -> str:
        """Returns `name` unchanged and takes its length from the budget: a value refers to it, perhaps many times."""
        self._budget.spend(len(name))
        return name

    def key(self) -> str | None:
        """Reads a key of a dictionary; returns None if it is not text."""
        start = self.position
        if self.u32() in (_STRING, _STRING_NAME):
            return self.string()
        self.position = start
        self.skip()
        return None

    def expect(self, field: str, kind: int, text: str) -> None:
        marker = self.u32()
        if marker != kind:
            raise WlmError(f"{self.path}: {field}: expected {text} (type {kind}), found type {marker}")

    def user(self, names: list[str]) -> GodotUser:
        """Reads one mesh that uses a lightmap: the four values of an entry of `user_data`."""
        self.expect(_USERS, _NODE_PATH, "a path")
        steps, below = struct.unpack(self.order + "HH", self.take(4))
        path = [self.name(names) for _ in range(steps)]
        self._repeat(below & 0x7FFF, self._skip_name)
        self.expect(_USERS, _RECTANGLE, "a rectangle")
        x, y, width, height = np.frombuffer(self.take(4 * self.real), f"{self.order}f{self.real}").tolist()
        number = self._whole()
        self._whole()
        return GodotUser("/".join(path), (x, y, width, height), number)

    def _whole(self) -> int:
        kind = self.u32()
        if kind not in (_INT, _LONG):
            raise WlmError(f"{self.path}: {_USERS}: expected a whole number, found type {kind}")
        return struct.unpack(self.order + ("i" if kind == _INT else "q"), self.take(4 if kind == _INT else 8))[0]

    def vectors(self) -> np.ndarray:
        """Reads a packed array of Vector3 as float64 [N, 3]."""
        self.expect(f"{_PROPERTY}.points", _VECTOR3S, "a packed array of Vector3")
        values = np.frombuffer(self.take(self.u32() * 3 * self.real), f"{self.order}f{self.real}")
        return values.reshape(-1, 3).astype(np.float64)

    def colours(self) -> np.ndarray:
        """Reads a packed array of Color as float32 [N, 4]."""
        self.expect(f"{_PROPERTY}.sh", _COLOURS, "a packed array of Color")
        values = np.frombuffer(self.take(self.u32() * 16), f"{self.order}f4")
        return values.reshape(-1, 4).astype(np.float32)

    def skip(self, depth: int = 0) -> None:
        """Skips one value of any type."""
        if depth > _DEEPEST:
            raise WlmError(f"{self.path}: damaged: values are nested more than {_DEEPEST} deep")
        kind = self.u32()
        if kind in _REALS or kind in _SIZES:
            self.take(_REALS.get(kind, 0) * self.real + _SIZES.get(kind, 0))
        elif kind in _PACKED_REALS or kind in _PACKED_SIZES:
            size = self.u32() * (_PACKED_REALS.get(kind, 0) * self.real + _PACKED_SIZES.get(kind, 0))
            self.take(size + -size % 4)  # only bytes need the padding
        elif kind in (_STRING, _STRING_NAME):
            self.string()
        elif kind == _STRINGS:
            self._repeat(self.u32(), self.string)
        elif kind == _NODE_PATH:
            names, subnames = struct.unpack(self.order + "HH", self.take(4))
            self._repeat(names + (subnames & 0x7FFF), self._skip_name)
        elif kind == _OBJECT:
            reference = self.u32()
            if reference > _EXTERNAL:
                raise WlmError(f"{self.path}: damaged: expected a reference of kind 0 to 3, found {reference}")
            if reference == _EXTERNAL_PATH:
                self._repeat(2, self.string)
            elif reference != _EMPTY:
                self.take(4)
        elif kind == _DICTIONARY:
            self._repeat(2 * (self.u32() & 0x7FFFFFFF), lambda: self.skip(depth + 1))
        elif kind == _ARRAY:
            self._repeat(self.u32() & 0x7FFFFFFF, lambda: self.skip(depth + 1))
        else:
            raise WlmError(f"{self.path}: expected a value of a known type, found type {kind}")

    def _text(self, length: int) -> str:
        return bytes(self.take(length)).rstrip(b"\0").decode("utf-8", "replace")

    def _skip_name(self) -> None:
        index = self.u32()
        if index & 0x80000000:
            self.take(index & 0x7FFFFFFF)

    def _repeat(self, count: int, read: Callable[[], object]) -> None:
        # Each call reads at least four bytes, so the size of the file bounds the loop.
        for _ in range(count):
            read()


def _decompress(reader: _Reader) -> bytes:
    path = reader.path
    mode, block, total = reader.u32(), reader.u32(), reader.u32()
    if mode != _ZSTD:
        raise WlmError(f"{path}: compression: expected Zstandard ({_ZSTD}), found {mode}; save it without compression")
    if not 0 < block <= _LARGEST_BLOCK:
        raise WlmError(f"{path}: compression: expected blocks of 1 to {_LARGEST_BLOCK} bytes, found {block}")
    # The last block contains the rest and is stored even if it is empty.
    full, rest = divmod(total, block)
    sizes = np.frombuffer(reader.take(4 * (full + 1)), "<u4")
    check_growth(f"{path}: compression", len(reader.data), total)
    pieces = []
    for i, size in enumerate(sizes.tolist()):
        expected = block if i < full else rest
        packed = bytes(reader.take(size))
        try:
            pieces.append(decompress(packed, expected, f"compressed block {i}") if expected else b"")
        except ValueError as error:
            raise WlmError(f"{path}: {error}") from error
    return b"".join(pieces)


def lmbake_bytes(
    points: np.ndarray, sh: np.ndarray, tetrahedra: np.ndarray, planes: np.ndarray, children: np.ndarray
) -> bytes:
    """Returns the content of a new bake in format 4, with a `LightmapGIData` that sets only `probe_data`.

    `points`, [N, 3], are in metres; `sh`, [N, 9, 3], are the numbers that the module's description defines;
    `tetrahedra`, int [T, 4], are indices of points. `planes`, [M, 4], n x = d, are those of a BSP tree; `children`, int
    [M, 2], its two children per node, on the side n x > d and on the other: each is the index of a node, or -1 - t for
    tetrahedron t.
    """
    low, high = points.min(0), points.max(0)
    node = np.zeros((len(planes), 6), "<u4")
    node[:, :4] = planes.astype("<f4").view("<u4")
    node[:, 4:] = children.astype("<i4").view("<u4")
    data = {
        "bounds": _u32(_AABB) + np.concatenate([low, high - low]).astype("<f4").tobytes(),
        "points": _u32(_VECTOR3S, len(points)) + points.astype("<f4").tobytes(),
        "tetrahedra": _u32(_INTS, tetrahedra.size) + tetrahedra.astype("<i4").tobytes(),
        "bsp": _u32(_INTS, node.size) + node.tobytes(),
        "sh": _u32(_COLOURS, COEFFICIENTS * len(points)) + np.pad(sh, ((0, 0), (0, 0), (0, 1))).astype("<f4").tobytes(),
        "interior": _u32(_BOOL, 0),
        "baked_exposure": _u32(_FLOAT) + struct.pack("<f", 1.0),
    }
    content = _u32(_DICTIONARY, len(data)) + b"".join(_u32(_STRING) + _text(key) + each for key, each in data.items())
    head = b"RSRC" + _u32(0, 0, _ENGINE, 0, _WRITTEN_FORMAT) + _text(_TYPE)
    # No import metadata, no UID, no script class.
    head += struct.pack("<QIQ", 0, _NAMED_IDS, 0) + _u32(*[0] * _RESERVED)
    head += _u32(1) + _text(_PROPERTY) + _u32(0)  # names; external resources
    head += _u32(1) + _text("local://1")
    body = _text(_TYPE) + _u32(1) + _u32(0) + content
    return head + struct.pack("<Q", len(head) + 8) + body + b"RSRC"


def _u32(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _u32(len(data)) + data
