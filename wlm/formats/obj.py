"""Wavefront OBJ: positions, UVs and triangles of a mesh.

Faces are read with `v`, `v/vt`, `v//vn` or `v/vt/vn`, numbers counted from 1 or back from the last. A polygon is cut
into a fan about its first corner, which is right for convex ones. `vt`'s v points up; here it points down, as in glTF.
Normals, groups, materials, lines, points and curves are left out.
"""

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import OBJ_BYTES
from wlm.formats.reading import read_file


@dataclass(frozen=True, eq=False)
class ObjMesh:
    """What an OBJ file holds; a vertex is a distinct pair of `v` and `vt`.

    Attributes:
        position: float64 [V, 3].
        uv: float64 [V, 2], u right, v down; None where no face has UVs.
        triangle: int32 [F, 3], in the order of the faces; maybe none.
    """

    position: np.ndarray
    uv: np.ndarray | None
    triangle: np.ndarray


def read_obj(path: str | os.PathLike[str]) -> ObjMesh:
    """Reads an OBJ file.

    Args:
        path: The file, UTF-8 or any other text whose numbers are ASCII.

    Returns:
        The mesh of all its faces.

    Raises:
        WlmError: The file is missing, a line is malformed (its number is named), or some faces have UVs and
            others none.
    """
    data = read_file(path, OBJ_BYTES, "the OBJ file")
    points: list[tuple[float, float, float]] = []
    places: list[tuple[float, float]] = []
    corners: list[tuple[int, int]] = []  # (v, vt), three a triangle; vt is -1 where there is none
    bare = None  # the line of the first face without UVs
    for number, words in _statements(data):
        kind = words[0]
        try:
            if kind == "v":
                points.append((float(words[1]), float(words[2]), float(words[3])))
            elif kind == "vt":
                places.append((float(words[1]), 1.0 - float(words[2]) if len(words) > 2 else 1.0))
            elif kind == "f":
                polygon = [_corner(word, len(points), len(places)) for word in words[1:]]
                if len(polygon) < 3:
                    raise WlmError(f"{path}: line {number}: expected three corners or more, found {len(polygon)}")
                if bare is None and any(place < 0 for _, place in polygon):
                    bare = number
                for second, third in zip(polygon[1:-1], polygon[2:], strict=True):
                    corners += [polygon[0], second, third]
        except (ValueError, IndexError) as error:
            raise WlmError(f"{path}: line {number}: malformed {kind}: {' '.join(words)[:60]}") from error
    pairs = np.array(corners, np.int64).reshape(-1, 2)
    if bare is not None and (pairs[:, 1] >= 0).any():
        raise WlmError(f"{path}: line {bare}: expected v/vt as other faces have, found a corner without a UV")
    # A pair as one number, whose order is that of pairs.
    keys, triangle = np.unique(pairs[:, 0] * (len(places) + 1) + pairs[:, 1] + 1, return_inverse=True)
    vertex, place = np.divmod(keys, len(places) + 1)
    return ObjMesh(
        position=np.array(points, np.float64).reshape(-1, 3)[vertex],
        uv=np.array(places, np.float64)[place - 1] if bare is None and len(pairs) else None,
        triangle=triangle.reshape(-1, 3).astype(np.int32),
    )


def _statements(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Yields each statement's line number and words, lines that end in a backslash joined, comments left out."""
    held: list[str] = []
    # Line by line: a list of all lines would be many times the file.
    lines = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", errors="replace")
    for number, line in enumerate(lines, 1):
        line = line.partition("#")[0].rstrip()
        if line.endswith("\\"):
            held += line[:-1].split()
            continue
        words = held + line.split()
        held = []
        if words:
            yield number, words


def _corner(word: str, points: int, places: int) -> tuple[int, int]:
    """Reads "v", "v/vt", "v//vn" or "v/vt/vn" as numbers from 0; -1 stands for no vt."""
    fields = word.split("/")
    place = _index(fields[1], places) if len(fields) > 1 and fields[1] else -1
    return _index(fields[0], points), place


def _index(text: str, count: int) -> int:
    number = int(text)
    index = number - 1 if number > 0 else count + number
    if number == 0 or not 0 <= index < count:
        raise ValueError
    return index
