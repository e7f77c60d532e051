"""A program for `wlm.formats.child` that reads the arrays of a Unity file by UnityPy.

UnityPy lists the objects and their layouts, which the file contains. A layout can describe endless work, and UnityPy
would allocate as many values as a file claims, so this program reads the values itself.
"""

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np

PACKAGE, MEMORY, SECONDS = "UnityPy", 768 << 20, 2

KINDS = "kinds"
"""Name of the array of the types of all objects."""

POSITIONS, LIGHT, RENDERERS = "m_Data.m_Positions", "m_BakedCoefficients", "m_LightmappedRendererData"
"""Paths of the arrays that are read."""

WANTED = {"LightProbes": (POSITIONS, LIGHT), "LightingDataAsset": (RENDERERS,)}
"""The arrays of each type of object that has some."""

_COLUMNS: dict[str, list[tuple[str, ...]]] = {
    POSITIONS: [("x",), ("y",), ("z",)],
    LIGHT: [(f"sh[{i:2d}]",) for i in range(27)],
    RENDERERS: [("lightmapIndex",), *(("lightmapST", axis) for axis in "xyzw")],
}

_MOST_STEPS = 1 << 17  # values and arrays that are skipped one by one; real files have some dozens
_ALIGNED = 0x4000  # flag of a value: the next one starts at a multiple of 4 bytes
_NUMBERS = {
    "bool": "u1",
    "char": "u1",
    "SInt8": "i1",
    "UInt8": "u1",
    "short": "i2",
    "SInt16": "i2",
    "unsigned short": "u2",
    "UInt16": "u2",
    "int": "i4",
    "SInt32": "i4",
    "Type*": "i4",
    "unsigned int": "u4",
    "UInt32": "u4",
    "long long": "i8",
    "SInt64": "i8",
    "unsigned long long": "u8",
    "UInt64": "u8",
    "FileSize": "u8",
    "float": "f4",
    "double": "f8",
}

Object = tuple[str, Any, bytes | memoryview, str]
"""Type, layout, bytes and byte order of an object; a layout is a list: type, name, flags, the children's layouts."""


def main(data: bytes) -> dict[str, np.ndarray]:
    """Returns what `encode` returns for the objects of a file."""
    # `UnityPy.load` would decompress by any method that a file names.
    from UnityPy.files import SerializedFile
    from UnityPy.streams import EndianBinaryReader

    asset = SerializedFile(EndianBinaryReader(data), name="asset")
    found: list[Object] = []
    for item in asset.objects.values():
        kind, start, size = item.type.name, item.byte_start, item.byte_size
        if kind not in WANTED:
            found.append((kind, None, b"", ""))
            continue
        if not 0 <= start <= start + size <= len(data):
            raise ValueError(f"an object of {size} bytes at {start} exceeds the file of {len(data)} bytes")
        content = memoryview(data)[start : start + size]
        found.append((kind, _tree(item.serialized_type.node), content, asset.header.endian))
    return encode(found, len(data))


def encode(objects: Iterable[Object], most: int) -> dict[str, np.ndarray]:
    """Returns the types of the objects, `KINDS`, and their arrays by path, float64 [N, columns], empty without objects.

    The arrays together may come from at most `most` bytes: objects may overlap in the file.

    Raises:
        ValueError: An object is damaged, or lacks an array.
    """
    kinds: set[str] = set()
    tables = {path: [np.empty((0, len(columns)))] for path, columns in _COLUMNS.items()}
    for kind, tree, content, order in objects:
        kinds.add(kind)
        arrays = _Walk(content, order, WANTED[kind]).arrays(tree) if kind in WANTED else {}
        for path, rows in arrays.items():
            most -= rows.nbytes
            if most < 0:
                raise ValueError("expected objects at different places, found several at one")
            table = np.empty((len(rows), len(_COLUMNS[path])))
            for index, names in enumerate(_COLUMNS[path]):
                column = rows
                for name in names:
                    column = column[name]
                table[:, index] = column
            tables[path].append(table)
    return {KINDS: np.array(sorted(kinds), str)} | {path: np.concatenate(rows) for path, rows in tables.items()}


def _tree(node: Any) -> Any:
    return node and [node.m_Type, node.m_Name, node.m_MetaFlag, [_tree(each) for each in node.m_Children]]


class _Walk:
    """Reads the values of a serialized object in order, by its layout, until all requested arrays are found.

    A stated length is compared with the remaining bytes before anything is allocated.
    """

    def __init__(self, data: bytes | memoryview, order: str, wanted: Iterable[str]) -> None:
        self._data, self._order, self._wanted = memoryview(data), order, set(wanted)
        self._at = self._steps = 0
        self._found: dict[str, np.ndarray] = {}
        self._known: dict[int, np.dtype | None] = {}  # types of layouts by their identity

    def arrays(self, tree: Any) -> dict[str, np.ndarray]:
        """Returns the requested arrays by path; raises ValueError if one is missing."""
        if tree is None:
            raise ValueError("the file does not contain the layout of its objects")
        for node in tree[3]:
            self._step(node, node[1])
            if len(self._found) == len(self._wanted):  # the rest of the object is not needed
                return self._found
        raise ValueError(f"the array {min(self._wanted - self._found.keys())} is missing")

    def _step(self, node: Any, path: str) -> None:
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise ValueError(f"more than {_MOST_STEPS:,} values before the requested arrays")
        kind, _, flags, children = node
        if kind == "Array":
            self._array(children[1], path)
        elif kind == "TypelessData":
            self._take(self._count())
        elif kind in _NUMBERS:
            self._take(np.dtype(_NUMBERS[kind]).itemsize)
        else:
            for child in children:
                self._step(child, path if child[0] == "Array" else f"{path}.{child[1]}")
        if flags & _ALIGNED:
            self._at += -self._at % 4

    def _array(self, element: Any, path: str) -> None:
        count = self._count()
        kind = self._fixed(element)
        if kind is not None and kind.itemsize:
            rows = self._take(count * kind.itemsize)
            if path in self._wanted:
                self._found[path] = np.frombuffer(rows, kind)
            return
        if path in self._wanted:
            raise ValueError(f"{path}: expected an array of numbers, found values of varying size")
        for _ in range(count):
            self._step(element, path)

    def _fixed(self, node: Any) -> np.dtype | None:
        """Returns the NumPy type of a layout's value, or None if its size varies."""
        if id(node) not in self._known:
            kind, _, flags, children = node
            kinds = [self._fixed(child) for child in children]
            if flags & _ALIGNED or kind in ("Array", "TypelessData"):
                found = None
            elif kind in _NUMBERS:
                found = np.dtype(self._order + _NUMBERS[kind])
            elif any(each is None for each in kinds):
                found = None
            else:
                found = np.dtype([(child[1], each) for child, each in zip(children, kinds, strict=True)])
            self._known[id(node)] = found
        return self._known[id(node)]

    def _count(self) -> int:
        count = struct.unpack(self._order + "i", self._take(4))[0]
        if count < 0:
            raise ValueError(f"expected an array of 0 or more values, found {count}")
        return count

    def _take(self, size: int) -> memoryview:
        if size > len(self._data) - self._at:
            raise ValueError(f"expected {size} bytes at byte {self._at}, found {len(self._data) - self._at}")
        self._at += size
        return self._data[self._at - size : self._at]
