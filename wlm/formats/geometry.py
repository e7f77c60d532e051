"""Triangles on which light is displayed."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.gltf import read_gltf
from wlm.formats.gltf_slots import lightmap_uv, usual_set
from wlm.formats.meshes import SUFFIXES, read_mesh

_ROOM = 0.25  # smallest fraction of the bounding box that an interior encloses


@dataclass(frozen=True, eq=False)
class Geometry:
    """Triangles, uint32 [F, 3], of vertices float32 [V, 3], and their lightmap UVs, float32 [V, 2], u right, v down;
    None if UVs were not requested."""

    position: np.ndarray
    triangle: np.ndarray
    uv: np.ndarray | None = None

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest corner of the triangles' bounding box, float32 [3] each."""
        used = self.position[self.triangle.reshape(-1)]
        return used.min(0), used.max(0)

    @property
    def is_room(self) -> bool:
        """Whether the geometry is an interior: most triangles face the middle, like inward-facing walls. The enclosed
        volume (a sum of signed tetrahedra) is negative for triangles that face inwards."""
        if not len(self.triangle):
            return False
        low, high = (corner.astype(np.float64) for corner in self.box)
        if not (high > low).all():
            return False
        # Positions are normalised by the box, so that no size over- or underflows.
        a, b, c = ((self.position[self.triangle] - low) / (high - low) - 0.5).transpose(1, 0, 2)
        return float(np.einsum("fk,fk->", a, np.cross(b, c))) / 6.0 < -_ROOM


def read_geometry(path: str | os.PathLike[str], uv_set: int | None = None, *, with_uv: bool = True) -> Geometry:
    """Reads a mesh from a `.glb`, `.gltf`, `.obj`, `.ply`, `.stl` or `.off` file. `uv_set` is n of `TEXCOORD_n`, the
    lightmap's UVs; None takes 1 if any primitive has it, else 0. `with_uv` tells whether UVs are needed: primitives
    without them are then left out."""
    path = Path(path)
    if path.suffix.lower() in SUFFIXES:
        mesh = read_mesh(path)
        parts = [(mesh.position, mesh.triangle, mesh.uv)] if mesh.uv is not None or not with_uv else []
    else:
        document, primitives = read_gltf(path)
        number = usual_set(primitives) if uv_set is None else uv_set
        parts = [
            (each.position, each.triangle, lightmap_uv(document, each, number) if with_uv else None)
            for each in primitives
            if number in each.uv or not with_uv
        ]
    parts = [part for part in parts if len(part[1])]
    if not parts:
        raise WlmError(f"{path}: expected triangles{' with lightmap UVs' if with_uv else ''}, found none")
    first = np.cumsum([0, *(len(position) for position, _, _ in parts)])
    with np.errstate(over="ignore"):
        position = np.concatenate([position for position, _, _ in parts]).astype(np.float32)
    uv = np.concatenate([uv for _, _, uv in parts]).astype(np.float32) if with_uv else None
    if not np.isfinite(position).all() or (uv is not None and not np.isfinite(uv).all()):
        raise WlmError(f"{path}: expected finite positions and UVs, found NaN or infinity")
    triangle = np.concatenate([triangle + start for (_, triangle, _), start in zip(parts, first[:-1], strict=True)])
    return Geometry(position, triangle.astype(np.uint32), uv)
