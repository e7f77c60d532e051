"""A room in a file."""

from pathlib import Path

import numpy as np
from builders.gltf_scene import box

from wlm.formats.gltf import document_from_meshes
from wlm.formats.gltf_writer import write_glb


def write_room(path: Path, low: np.ndarray | float = -1.0, high: np.ndarray | float = 1.0) -> None:
    """Writes a box between two corners as a mesh whose sides face its middle, each with the whole lightmap on it."""
    position, triangle, _ = box(np.broadcast_to(low, 3), np.broadcast_to(high, 3), inward=True)
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], (6, 1))
    document, _ = document_from_meshes([("room", position, triangle, uv)], "room")
    write_glb(path, document, [], 0)
