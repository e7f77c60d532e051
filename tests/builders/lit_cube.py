"""A cube with a chart and a light of its own on every face, for tests of lightmap atlases."""

import numpy as np

from wlm.atlas.data import LightmappedScene, from_arrays

HEIGHT, WIDTH = 64, 96
DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
"""Normals. Face k has the triangles [k t, (k + 1) t), t = 2 `parts`², and its chart in cell k of 2 x 3."""


def corners(parts: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions in [-1, 1]³, triangles and UVs; every face has its own vertices, and charts end 10% before a cell."""
    line = np.linspace(-1.0, 1.0, parts + 1)
    s, t = (axis.reshape(-1) for axis in np.meshgrid(line, line, indexing="ij"))
    first = (np.arange(parts)[:, None] * (parts + 1) + np.arange(parts)).reshape(-1)
    square = np.stack([first, first + 1, first + parts + 1, first + 1, first + parts + 2, first + parts + 1], 1)
    positions, triangles, uvs = [], [], []
    for number, direction in enumerate(DIRECTIONS):
        axis = int(np.abs(direction).argmax())
        position = np.empty((len(s), 3))
        position[:, axis], position[:, axis - 1], position[:, axis - 2] = direction[axis], s, t
        positions.append(position)
        outward = square.reshape(-1, 3)[:, :: int(direction[axis])]
        triangles.append(outward + number * len(s))
        place = 0.5 + 0.45 * np.stack([s, t], 1)
        uvs.append((place + [number % 3, number // 3]) / [3.0, 2.0])
    return np.concatenate(positions), np.concatenate(triangles), np.concatenate(uvs)


def waves(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """A smooth light that varies everywhere, [H, W, 3], 0.1 to 2.1."""
    y, x = (np.mgrid[:height, :width] + 0.5) / np.array([height, width]).reshape(2, 1, 1)
    base = 1.1 + np.sin(9.0 * y + 1.0) * np.cos(14.0 * x * x)
    return np.stack([base, 0.1 + 0.8 * base, 2.2 - base], axis=-1).astype(np.float32)


def lit_cube(parts: int = 2, lightmap: np.ndarray | None = None) -> LightmappedScene:
    """The cube with waves, or another light."""
    return from_arrays(*corners(parts), waves() if lightmap is None else lightmap, name="cube")
