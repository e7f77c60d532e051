"""Meshes of a scene: triangles with base colours, normals and lightmap UVs, from glTF files."""

import os
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.formats.gltf import read_gltf, vertex_colours, vertex_normals
from wlm.formats.gltf_slots import lightmap_uv, usual_set
from wlm.probe.sphere import unit_or_zero


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with their colours; V vertices and F triangles.

    Attributes:
        position: float32 [V, 3].
        triangle: int32 [F, 3].
        colour: float32 [V, 3], base colours, linear.
        normal: float32 [V, 3], of unit length; of files without normals the means of the triangles at a vertex.
        uv: float32 [V, 2], lightmap UVs, u right, v down; 0 in files without UVs.
    """

    position: np.ndarray
    triangle: np.ndarray
    colour: np.ndarray
    normal: np.ndarray
    uv: np.ndarray


def read_mesh(path: str | os.PathLike[str], *, with_uv: bool = False) -> Mesh:
    """Reads all triangles that a `.glb` or `.gltf` file draws. `with_uv` tells whether every primitive must have
    lightmap UVs: `TEXCOORD_1` if the file has any, else `TEXCOORD_0`."""
    document, primitives = read_gltf(path)
    if not primitives:
        raise WlmError(f"{path}: expected triangles, found none")
    number = usual_set(primitives)
    lacking = next((each for each in primitives if number not in each.uv), None)
    if with_uv and lacking is not None:
        raise WlmError(f"{path}: {lacking.name}: expected lightmap UVs in TEXCOORD_{number}, found none")
    parts = zip(primitives, vertex_colours(document, primitives), vertex_normals(document, primitives), strict=True)
    rows, first = [], 0
    for each, colour, normal in parts:
        if normal is None:
            normal = _normals(each.position, each.triangle)
        uv = lightmap_uv(document, each, number) if number in each.uv else np.zeros((len(each.position), 2), np.float32)
        rows.append((each.position, each.triangle + first, colour, normal, uv))
        first += len(each.position)
    with np.errstate(over="ignore"):
        position, triangle, colour, normal, uv = (np.concatenate(part) for part in zip(*rows, strict=True))
        made = Mesh(position.astype(np.float32), triangle, colour, normal.astype(np.float32), uv)
    for name, values in vars(made).items():
        if not np.isfinite(values).all():
            raise WlmError(f"{path}: {name}: expected finite numbers, found NaN or infinity")
    return made


def _normals(position: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Returns vertex normals [V, 3]: means over the triangles at a vertex, weighted by their areas."""
    a, b, c = position[triangle].transpose(1, 0, 2)
    normal = np.zeros_like(position)
    for corner in triangle.T:
        np.add.at(normal, corner, np.cross(b - a, c - a))
    return unit_or_zero(normal)
