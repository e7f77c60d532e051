"""Surfaces for bakes, and the room of the demo."""

from pathlib import Path

import numpy as np

from wlm.bake.geometry import Material, Surface

ROOM = Path(__file__).resolve().parents[2] / "demos" / "cornell"
"""The folder with `room.gltf` and `room.yaml`."""

SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))


def quad(corner, along, up, uv=SQUARE, material: Material | None = None) -> Surface:
    """A parallelogram whose front is at the end of along x up."""
    corner, along, up = (np.array(each, float) for each in (corner, along, up))
    position = np.array([corner, corner + along, corner + along + up, corner + up])
    normal = np.cross(along, up)
    normal = np.tile(normal / np.linalg.norm(normal), (4, 1))
    triangle = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    places = None if uv is None else np.array(uv, float)
    return Surface(position, triangle, normal, places, None, material or Material())
