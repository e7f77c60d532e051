"""Triangles that light is drawn on: which way they face."""

import numpy as np
import pytest
from builders.gltf_scene import box

from wlm.formats.geometry import Geometry


@pytest.mark.parametrize("size", [1.0, 1e-20, 1e18])
def test_a_room_faces_its_middle(size):
    position, triangle, uv = box((-1, -1, -1), (1, 1, 1))
    position = (np.array([5.0, -2.0, 0.5]) + position * [1.0, 2.0, 0.5]) * size
    walls, outside = (Geometry(position.astype(np.float32), faces, uv) for faces in (triangle[:, ::-1], triangle))
    assert walls.is_room and not outside.is_room
    mixed = np.concatenate([walls.triangle[:6], outside.triangle[6:]])
    assert not Geometry(walls.position, mixed, uv).is_room


def test_a_plane_and_nothing_are_no_rooms():
    position, triangle, uv = box((-1, -1, -1), (1, 1, 1))
    assert not Geometry((position * [1, 0, 1]).astype(np.float32), triangle[:, ::-1], uv).is_room
    assert not Geometry(position.astype(np.float32), np.zeros((0, 3), np.uint32), uv).is_room
