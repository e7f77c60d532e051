"""A box of six sides, each with the whole lightmap on it."""

from pathlib import Path

import numpy as np

from wlm.formats.gltf import document_from_arrays
from wlm.formats.gltf_writer import write_glb


def box() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions [24, 3] from -1 to 1, triangles [12, 3] that face outwards, UVs [24, 2]."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    position, triangle = [], []
    for axis in range(3):
        for end in (-1.0, 1.0):
            side = np.empty((4, 3))
            side[:, axis], side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = end, corners[:, 0], corners[:, 1]
            faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * len(position)
            position.append(side)
            triangle.append(faces if end > 0 else faces[:, ::-1])
    return np.concatenate(position), np.concatenate(triangle).astype(np.uint32), np.tile(0.5 + 0.5 * corners, (6, 1))


def write_room(path: Path, low: np.ndarray | float = -1.0, high: np.ndarray | float = 1.0) -> None:
    """Writes the box, between two corners, as a mesh whose sides face its middle."""
    position, triangle, uv = box()
    position = low + (0.5 + 0.5 * position) * np.subtract(high, low)
    document, _ = document_from_arrays(position, triangle[:, ::-1], uv, "room")
    write_glb(path, document, [], 0)
