"""Meshes in formats other than glTF, read with trimesh: OBJ, PLY, STL and OFF.

trimesh gets only the bytes of the file, so that a material can't name another file. It accepts some damaged files
silently, so its result is checked: numbers are finite and triangles name vertices that exist. Polygons are cut
into triangles. Normals, colours and materials are left out. The v of these formats points up; here it points down, as
in glTF.
"""

import codecs
import io
import os
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import MATERIALS, MODEL_BYTES, NUMBER_BYTES, SURE_CORNERS, Budget
from wlm.formats.reading import damaged, read_file

SUFFIXES = (".obj", ".ply", ".stl", ".off")
"""File name extensions that are read here."""

_LINE = re.compile(rb"^ *(vt|vn|v|f) ([^\r\n]*)", re.MULTILINE)
_RELATIVE = re.compile(rb"^ *f [^\r\n]*-", re.MULTILINE)
_ZERO = re.compile(rb"^ *f [^\r\n]*[ /]0(?=[ /\r\n]|\Z)", re.MULTILINE)


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """The triangles of a file, int32 [F, 3], in the order of the file, maybe none, of vertices float64 [V, 3]. Their
    UVs are float64 [V, 2], u right, v down; None where the file or some of its meshes have no UVs."""

    position: np.ndarray
    uv: np.ndarray | None
    triangle: np.ndarray


def read_mesh(path: str | os.PathLike[str]) -> MeshArrays:
    """Reads all triangles of a file, whose name ends in one of `SUFFIXES`, as one mesh."""
    import trimesh

    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise WlmError(
            f"{path}: expected a mesh file ({', '.join(SUFFIXES)}), found {suffix or 'a name without an ending'}"
        )
    data = read_file(path, MODEL_BYTES, f"the {suffix[1:].upper()} file")
    if suffix == ".obj":
        with damaged(f"{path}: malformed OBJ", ValueError, MemoryError):
            data = _absolute(data)
    # A number of a text takes trimesh up to 100 bytes, and a file of many materials the square of their number in time.
    numbers = sum(map(data.count, (b" ", b"\n", b"\r", b"\t")))
    Budget(str(path), max(SURE_CORNERS, len(data) // NUMBER_BYTES), "numbers").spend(numbers)
    if len(set(re.findall(rb"usemtl[^\n]*", data))) > MATERIALS:
        raise WlmError(f"{path}: expected at most {MATERIALS:,} materials (usemtl), found more: join some of them")
    # trimesh's readers raise any NumPy error on damaged text.
    with damaged(f"{path}: malformed {suffix[1:].upper()}", Exception):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], process=False)
            meshes = [each for each in scene.dump() if isinstance(each, trimesh.Trimesh)]
        parts = [_checked(each) for each in meshes]
    if not parts:
        return MeshArrays(np.empty((0, 3)), None, np.empty((0, 3), np.int32))
    position, uv, triangle = zip(*parts, strict=True)
    first = np.cumsum([0, *map(len, position[:-1])])
    return MeshArrays(
        np.concatenate(position),
        None if any(each is None for each in uv) else np.concatenate(uv),
        np.concatenate([each + start for each, start in zip(triangle, first, strict=True)], dtype=np.int32),
    )


def _absolute(data: bytes) -> bytes:
    """Returns an OBJ with absolute numbers of vertices: trimesh counts relative ones back from the last vertex of the
    file. A byte order mark and tabs, with which it overlooks lines, are left out. Raises a ValueError if a face names
    vertex 0, or one before the first."""
    data = data.removeprefix(codecs.BOM_UTF8).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").replace(b"\t", b" ")
    if _ZERO.search(data):
        raise ValueError("expected vertices counted from 1, found 0")
    if not _RELATIVE.search(data):
        return data
    counts = {b"v": 0, b"vt": 0, b"vn": 0}

    def number(text: bytes, count: int) -> bytes:
        value = count + 1 + int(text) if text.startswith(b"-") else int(text or b"1")
        if value < 1:
            raise ValueError(f"expected at most {count} earlier vertices, found {int(text)}")
        return b"%d" % value if text else b""

    def line(found: re.Match[bytes]) -> bytes:
        word, rest = found.groups()
        if word != b"f":
            counts[word] += 1
            return found[0]
        corners = [zip(corner.split(b"/"), counts.values(), strict=False) for corner in rest.split()]
        return b"f " + b" ".join(b"/".join(number(*each) for each in corner) for corner in corners)

    return _LINE.sub(line, data)


def _checked(mesh) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Returns the positions, UVs (None if it has none) and triangles of a trimesh; ValueError for wrong numbers."""
    position, triangle = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    uv = getattr(mesh.visual, "uv", None)
    uv = None if uv is None or not len(uv) else np.asarray(uv, np.float64)[:, :2] * [1.0, -1.0] + [0.0, 1.0]
    if uv is not None and uv.shape != (len(position), 2):
        raise ValueError(f"expected UVs [{len(position)}, 2], one for each vertex, found {list(uv.shape)}")
    for name, values in (("positions", position), ("UVs", uv)):
        if values is not None and not np.isfinite(values).all():
            raise ValueError(f"expected finite {name}, found NaN or infinity")
    if triangle.size and not 0 <= triangle.min() <= triangle.max() < len(position):
        raise ValueError(
            f"expected vertex numbers 0 to {len(position) - 1}, found {triangle.min()} to {triangle.max()}"
        )
    return position, uv, triangle.reshape(-1, 3)
