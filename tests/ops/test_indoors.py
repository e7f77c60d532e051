"""Viewers stand in rooms and streets, and not in, on or beside things."""

import numpy as np
import pytest
from builders.gltf_scene import box

from wlm.ops.indoors import EYES, EYES_SHARE, indoors
from wlm.ops.views import visible_points


def joined(*parts):
    first = np.cumsum([0, *(len(position) for position, _, _ in parts)])
    triangle = np.concatenate([triangle + start for (_, triangle, _), start in zip(parts, first[:-1], strict=True)])
    return np.concatenate([position for position, _, _ in parts]), triangle


ROOM = box((0, 0, 0), (6, 3, 5), inward=True)
TABLE = box((2, 0, 2), (3, 0.8, 3))


def test_viewers_stand_a_metre_above_a_rooms_floor():
    position, triangle = joined(ROOM, TABLE)
    there = indoors(position, triangle, metres=True)
    assert there.height == EYES and len(there.eye) > 100
    x, y, z = there.eye.T
    on_table = (x > 2) & (x < 3) & (z > 2) & (z < 3)
    np.testing.assert_allclose(y, np.where(on_table, 1.8, 1.0), atol=1e-5)
    assert ((x > 0.2 - 1e-4) & (x < 5.8 + 1e-4)).all()
    views = there.views(7, seed=3)
    assert len(views) == 7 and len({tuple(view.eye) for view in views}) == 7
    uv = np.zeros((len(position), 2))
    for visible, _, _ in visible_points(position, triangle, uv, views, 24, "cpu"):
        assert (visible >= 0).all()  # a closed room leaves no pixel free


def test_the_height_of_the_eyes_is_a_share_where_the_unit_is_not_the_metre():
    position, triangle, _ = ROOM
    rooms = (1, False, EYES_SHARE * 3), (0.1, True, EYES_SHARE * 0.3), (100, True, EYES_SHARE * 300), (2, True, EYES)
    for scale, metres, expected in rooms:
        there = indoors(position * scale, triangle, metres=metres)
        assert there.height == pytest.approx(expected) and len(there.eye) > 100


def test_nobody_stands_in_or_on_a_thing():
    thing = box((0, 0, 0), (1, 1, 1))
    for metres in (False, True):
        assert not len(indoors(*thing[:2], metres=metres).eye)
        assert not len(indoors(thing[0] * 50, thing[1], metres=metres).eye)
    assert indoors(*thing[:2], metres=True).views(5) == []
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]], float)
    assert not len(indoors(flat, np.array([[0, 2, 1]]), metres=True).eye)
