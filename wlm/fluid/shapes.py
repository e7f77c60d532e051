"""Closed surfaces as triangles, anticlockwise from outside: corners float64 [V, 3], triangles int64 [F, 3]."""

import numpy as np

_SIDES = 24  # of a sphere, from pole to pole; twice as many around it


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """A sphere of radius 1, in rings from pole to pole."""
    polar = np.linspace(0.0, np.pi, _SIDES + 1)
    return _revolved(np.sin(polar), np.cos(polar))


def cylinder() -> tuple[np.ndarray, np.ndarray]:
    """A cylinder along y of radius and half height 1."""
    return _revolved(np.array([0.0, 1.0, 1.0, 0.0]), np.array([1.0, 1.0, -1.0, -1.0]))


def box() -> tuple[np.ndarray, np.ndarray]:
    """A cube of half edge 1."""
    points = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)]) * 2.0 - 1.0
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return points, np.array([half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))])


def _revolved(radius: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A surface of revolution about y, of rings from above; the first and the last ring are points."""
    columns = 2 * _SIDES
    angle = np.linspace(0.0, 2.0 * np.pi, columns, endpoint=False)
    middle = slice(1, -1)
    ring = np.stack(np.broadcast_arrays(np.cos(angle), 0.0, np.sin(angle)), -1)
    rings = radius[middle, None, None] * ring + height[middle, None, None] * np.array([0.0, 1.0, 0.0])
    points = np.concatenate([[[0, height[0], 0]], rings.reshape(-1, 3), [[0, height[-1], 0]]])
    here = np.arange(columns)
    beside = (here + 1) % columns
    last = len(points) - 1
    triangles = [np.stack([np.zeros_like(here), 1 + beside, 1 + here], 1)]
    for row in range(len(radius) - 3):
        a, b = 1 + row * columns + here, 1 + row * columns + beside
        triangles += [np.stack([a, b, a + columns], 1), np.stack([b, b + columns, a + columns], 1)]
    first = last - columns
    triangles.append(np.stack([np.full_like(here, last), first + here, first + beside], 1))
    return points, np.concatenate(triangles)
