"""Charts: connected triangles, and those that only touch."""

import numpy as np

from wlm.atlas.charts import charts, welded


def test_welded():
    """One place and one UV is one corner; -0 is 0; another place or another UV is another corner."""
    position = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [0, 0, 0], [0, 0, 1]])
    uv = np.array([[0, 0], [1, 0], [0, 1], [0, -0.0], [0.5, 0], [0, 0]])
    corner = welded(position, uv, np.array([[0, 1, 2], [3, 4, 5]]))
    assert corner.dtype == np.int32 and corner.shape == (2, 3)
    assert corner[0, 0] == corner[1, 0]
    assert len(np.unique(corner)) == 5


def test_edges_join_and_corners_do_not():
    """A strip of two, one that touches it by a corner, one apart; and one that shares an edge of that, turned over."""
    corner = np.array([[4, 5, 6], [0, 1, 2], [2, 1, 3], [3, 7, 8], [5, 4, 9]])
    np.testing.assert_array_equal(charts(corner), [0, 1, 1, 2, 0])


def test_a_bridge_that_takes_no_part():
    corner = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4]])
    np.testing.assert_array_equal(charts(corner), [0, 0, 0])
    np.testing.assert_array_equal(charts(corner, np.array([True, False, True])), [0, -1, 1])
    np.testing.assert_array_equal(charts(corner, np.zeros(3, bool)), [-1, -1, -1])


def test_three_at_an_edge_and_a_triangle_twice():
    np.testing.assert_array_equal(charts(np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4], [0, 1, 2]])), [0, 0, 0, 0])


def test_none_and_one():
    assert charts(np.zeros((0, 3), np.int32)).shape == (0,)
    np.testing.assert_array_equal(charts(np.array([[7, 8, 9]])), [0])
