"""Reading of light probes and lightmap rectangles from Unity's `LightingData.asset` and `LightProbes.asset`.

UnityPy (extra `unity`) lists the objects and their layouts, which the file contains, in a separate process
(`unity_child`). The objects are read here, since UnityPy allocates as many values as a file claims. Unity's editor
writes lighting data in binary whatever the serialization mode of the project; text assets (`unity_text`) come from
scripts and from other tools."""

import json
import os
import struct
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats import unity_child, unity_text
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import PROBES
from wlm.formats.reading import damaged, read_file

_EXTRA = "unity"
_BYTES = 1 << 28
_SECONDS = 60.0  # wall-clock limit of the process; its CPU time is limited further
_MOST_STEPS = 1 << 17  # values and arrays that are skipped one by one; real files have some dozens
_COEFFICIENTS, _CHANNELS = 9, 3
_NO_LIGHTMAP = 65534  # indices from here on mean that the renderer has no lightmap
_TEXT, _BUNDLE = b"%YAML", b"Unity"
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
_POSITIONS, _LIGHT, _RENDERERS = "m_Data.m_Positions", "m_BakedCoefficients", "m_LightmappedRendererData"
_WANTED = {"LightProbes": {_POSITIONS, _LIGHT}, "LightingDataAsset": {_RENDERERS}}


@dataclass(frozen=True)
class Rectangle:
    """The rectangle of a renderer in its lightmap.

    Attributes:
        lightmap: Index of the lightmap.
        scale_offset: `lightmapScaleOffset`: UVs are scaled by the first two numbers and offset by the last two, v up.
    """

    lightmap: int
    scale_offset: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class LightingData:
    """Content of an asset.

    Attributes:
        position: float64 [N, 3], positions of the light probes in Unity's axes.
        values: float64 [N, 9, 3], coefficients of `SphericalHarmonicsL2`.
        rectangles: One for each renderer with a lightmap, in the order of the file, which does not name renderers.
    """

    position: np.ndarray
    values: np.ndarray
    rectangles: tuple[Rectangle, ...]


def read_lighting_data(path: str | os.PathLike[str]) -> LightingData:
    """Reads the light probes and lightmap rectangles of an asset.

    Raises:
        WlmError: UnityPy is missing; or the file is missing, damaged, YAML text, an asset bundle, or has no such data.
    """
    data = read_file(path, _BYTES, "the asset")
    if data.startswith(_TEXT):
        return _read_text(path, data)
    if data.startswith(_BUNDLE):
        raise WlmError(f"{path}: expected an asset of Unity's editor, found an asset bundle")
    need("UnityPy", _EXTRA)
    positions, values = [np.empty((0, 3))], [np.empty((0, _COEFFICIENTS, _CHANNELS))]
    rectangles: list[Rectangle] = []
    with damaged(f"{path}: the asset is damaged, or UnityPy cannot read its version", *_DAMAGE):
        objects = list_objects(path, data)
        if not any(kind in _WANTED for kind, _, _, _ in objects):
            raise WlmError(f"{path}: expected Unity's lighting data or light probes, found neither")
        for kind, tree, content, order in objects:
            if kind not in _WANTED:
                continue
            arrays = _Walk(content, order, _WANTED[kind]).arrays(tree)
            if kind != "LightProbes":
                rectangles += _rectangles(arrays[_RENDERERS])
                continue
            place, light = _columns(arrays[_POSITIONS], ["x", "y", "z"]), _columns(arrays[_LIGHT], _NAMES)
            if len(place) != len(light):
                raise WlmError(f"{path}: expected light for each of {len(place)} probes, found light for {len(light)}")
            positions.append(place)
            values.append(light.reshape(-1, _CHANNELS, _COEFFICIENTS).transpose(0, 2, 1))
    position = np.concatenate(positions)
    if len(position) > PROBES:
        raise WlmError(f"{path}: expected at most {PROBES:,} light probes, found {len(position):,}")
    return LightingData(position, np.concatenate(values), tuple(rectangles))


def _read_text(path: str | os.PathLike[str], data: bytes) -> LightingData:
    objects = unity_text.objects(data)
    texts = [text for kind, text in objects if kind == "LightProbes"]
    if not texts:
        found = ", ".join(sorted({kind for kind, _ in objects})[:4]) or "nothing"
        raise WlmError(
            f"{path}: expected LightProbes in this text asset, found {found} (the light of Adaptive Probe Volumes is "
            "in .bytes files, which wlm does not read: bake a Light Probe Group)"
        )
    with damaged(f"{path}: the asset is damaged", ValueError):
        positions, values = zip(*map(unity_text.probes, texts), strict=True)
    return LightingData(np.concatenate(positions), np.concatenate(values), ())


_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, RecursionError, struct.error)
_NAMES = [f"sh[{i:2d}]" for i in range(_COEFFICIENTS * _CHANNELS)]


def list_objects(path: str | os.PathLike[str], data: bytes) -> list[tuple[str, Any, bytes, str]]:
    """Returns the type, layout, bytes and byte order of each object; the layout is None for types that are not read.

    Raises:
        ValueError: UnityPy cannot read the file.
    """
    # With -P, a module beside the program cannot replace a package.
    command = [sys.executable, "-P", unity_child.__file__, os.fspath(path), *_WANTED]
    try:
        run = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ValueError(str(error)) from error
    if run.returncode:
        lines = run.stderr.decode(errors="replace").strip().splitlines()
        raise ValueError(lines[-1] if run.returncode > 0 and lines else "UnityPy crashed")
    found = []
    for kind, tree, start, size, order in json.loads(run.stdout):
        if tree is not None and not 0 <= start <= start + size <= len(data):
            raise ValueError(f"an object of {size} bytes at {start} exceeds the file of {len(data)} bytes")
        found.append((kind, tree, data[start : start + size] if tree is not None else b"", order))
    return found


class _Walk:
    """Reads the values of a serialized object in order, by its layout, until all requested arrays are found.

    A stated length is compared with the remaining bytes before anything is allocated.
    """

    def __init__(self, data: bytes, order: str, wanted: set[str]) -> None:
        self._data, self._order, self._wanted = data, order, wanted
        self._at = self._steps = 0
        self._found: dict[str, np.ndarray] = {}

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
        kind, _, flags, children = node
        if flags & _ALIGNED or kind in ("Array", "TypelessData"):
            return None
        if kind in _NUMBERS:
            return np.dtype(self._order + _NUMBERS[kind])
        kinds = [self._fixed(child) for child in children]
        if any(kind is None for kind in kinds):
            return None
        return np.dtype([(child[1], kind) for child, kind in zip(children, kinds, strict=True)])

    def _count(self) -> int:
        count = struct.unpack(self._order + "i", self._take(4))[0]
        if count < 0:
            raise ValueError(f"expected an array of 0 or more values, found {count}")
        return count

    def _take(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise ValueError(f"expected {size} bytes at byte {self._at}, found {len(self._data) - self._at}")
        self._at += size
        return self._data[self._at - size : self._at]


def _columns(rows: np.ndarray, names: list[str]) -> np.ndarray:
    """Returns fields of structured rows as float64 [N, fields]."""
    return np.stack([rows[name] for name in names], 1).astype(np.float64)


def _rectangles(rows: np.ndarray) -> list[Rectangle]:
    rows = rows[rows["lightmapIndex"] < _NO_LIGHTMAP]
    places = _columns(rows["lightmapST"], list("xyzw")).tolist()
    return [Rectangle(int(n), tuple(place)) for n, place in zip(rows["lightmapIndex"], places, strict=True)]
