"""Meshes of obstacles and sources, from files."""

import functools
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from wlm.errors import WlmError
from wlm.formats.gltf import read_gltf
from wlm.formats.meshes import SUFFIXES as OTHERS
from wlm.formats.meshes import read_mesh
from wlm.formats.reading import system_errors

SUFFIXES = (".glb", ".gltf", *OTHERS)
"""Extensions of files that are read here."""
MOST_TRIANGLES = 1 << 20
_HOLES = 0.05  # share of the surface of a solid that may be holes
_MERGED = 1e-6  # distance of corners that are one, relative to the mesh's longest edge


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface in a mesh file, in its unit.

    Attributes:
        points: float64 [V, 3], corners; those at one place are one.
        triangles: int64 [F, 3], anticlockwise seen from outside, if most of the file's are so or most are not.
        is_open: Whether the holes' area is above 5% of the surface's, so that it bounds no solid.
        thickness: Twice the volume over the area; of a plate about its thickness.
    """

    points: np.ndarray
    triangles: np.ndarray
    is_open: bool
    thickness: float


def read_surface(path: str | os.PathLike[str]) -> Surface:
    """Reads all triangles of a file, whose name ends in one of `SUFFIXES`, or returns them if it has not changed.
    Raises a WlmError if the file is missing or damaged, has no triangles or more than `MOST_TRIANGLES`."""
    with system_errors(f"{path}: cannot read the mesh"):
        status = os.stat(path)
    return _read(os.fspath(path), status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=32)  # pictures ask for it at each frame
def _read(path: str, changed: int, size: int) -> Surface:
    if Path(path).suffix.lower() in OTHERS:
        arrays = read_mesh(path)
        parts = [(arrays.position, arrays.triangle)]
    else:
        parts = [(each.position, each.triangle) for each in read_gltf(path)[1]]
    count = sum(len(triangle) for _, triangle in parts)
    if count > MOST_TRIANGLES:
        raise WlmError(f"{path}: expected at most {MOST_TRIANGLES:,} triangles, found {count:,}: simplify the mesh")
    corners = np.concatenate([np.empty((0, 3, 3)), *(position[triangle] for position, triangle in parts)])
    if not np.isfinite(corners).all():
        raise WlmError(f"{path}: expected finite positions, found NaN or infinity")
    flat = corners.reshape(-1, 3)
    unit = _MERGED * max(float(np.ptp(flat, axis=0).max(initial=0.0)) if len(flat) else 0.0, 1e-30)
    _, first, number = np.unique(np.round(flat / unit), axis=0, return_index=True, return_inverse=True)
    points, triangles = flat[first], number.reshape(-1, 3)
    a, b, c = points[triangles].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    kept = normals.any(1)
    if not kept.any():
        raise WlmError(f"{path}: expected triangles, found none{' with an area' * bool(len(triangles))}")
    triangles, area = triangles[kept], 0.5 * float(np.linalg.norm(normals, axis=1).sum())
    volume = float(((a - points.mean(0)) * normals).sum()) / 6.0
    if volume < 0.0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    for array in (points, triangles):
        array.flags.writeable = False
    return Surface(points, triangles, _hole_area(points, triangles) > _HOLES * area, 2.0 * abs(volume) / area)


def _hole_area(points: np.ndarray, triangles: np.ndarray) -> float:
    """Returns the area of holes: that of circles as long as the edges around them."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    a, b = edges[count % 2 == 1].T
    _, loop = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(len(points),) * 2), directed=False)
    around = np.bincount(loop[a], np.linalg.norm(points[a] - points[b], axis=1))
    return float((around**2).sum()) / (4.0 * np.pi)
