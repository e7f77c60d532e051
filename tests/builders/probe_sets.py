"""Light probes on the surfaces of a made-up room: as good as baked ones for whoever only compresses them."""

import numpy as np

from wlm.probe.data import ProbeSet, from_arrays
from wlm.probe.sphere import basis

ROOM = np.array([8.0, 3.0, 6.0])  # metres, y up
BLOCKS = np.array([[[1.0, 0.0, 1.0], [2.5, 1.2, 2.5]], [[5.0, 0.0, 3.0], [6.0, 2.2, 4.5]]])  # lowest, highest corner
WINDOW = np.array([0.0, 1.8, 3.0])
LAMP = np.array([6.5, 2.7, 1.5])


def surface_points(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points 2 cm off the walls, the floor, the ceiling and two blocks, spread evenly by area; float64 [N, 3]."""
    boxes = [(np.zeros(3), ROOM, -1.0), *((low, high, 1.0) for low, high in BLOCKS)]
    faces = []
    for low, high, outwards in boxes:
        for axis in range(3):
            for side, sign in ((low, -1.0), (high, 1.0)):
                size = high - low
                size[axis] = 0.0
                corner = low.copy()
                corner[axis] = side[axis] + 0.02 * sign * outwards
                faces.append((np.prod(np.delete(size, axis)), corner, size))
    area = np.array([face[0] for face in faces])
    picked = rng.choice(len(faces), count, p=area / area.sum())
    corner, size = (np.array([face[i] for face in faces])[picked] for i in (1, 2))
    return corner + rng.random((count, 3)) * size


def synthetic(count: int, seed: int = 0, coefficients: int = 9, dead: int = 0) -> ProbeSet:
    """Makes a set with soft light from a window, a lamp with hard shadows behind the blocks, and coloured walls."""
    rng = np.random.default_rng(seed)
    position = surface_points(count, rng)

    def lobe(target: np.ndarray, sharp: float) -> tuple[np.ndarray, np.ndarray]:
        """A light's direction and distance squared; SH of a lobe around it, the wider the faster its bands fall."""
        way = target - position
        squared = (way**2).sum(axis=1)
        band = np.sqrt(np.arange(coefficients)).astype(int)
        return basis(way / np.sqrt(squared)[:, None], coefficients) * sharp ** (band * (band + 1)), squared

    window, far = lobe(WINDOW, 0.75)
    lamp, near = lobe(LAMP, 0.95)
    values = window[..., None] * [1.0, 1.2, 1.6] * (6.0 / (1.0 + far))[:, None, None]
    values += lamp[..., None] * [8.0, 5.5, 2.5] * (_visible(position, LAMP) / (1.0 + near))[:, None, None]
    values[:, 0] += 0.3 * (1.0 + np.sin(position[:, :1] * [0.5, 0.8, 1.1])) * [0.9, 0.7, 0.5]
    if dead:
        values[np.linspace(0, count - 1, dead).astype(int)] = 0.0
    return from_arrays(position, values.astype(np.float32), name="room")


def _visible(position: np.ndarray, light: np.ndarray) -> np.ndarray:
    """1 where no block lies between a point and the light, else 0."""
    way = light - position
    way[way == 0.0] = 1e-12
    visible = np.ones(len(position))
    for low, high in BLOCKS:
        first, second = (low - position) / way, (high - position) / way
        enters = np.minimum(first, second).max(axis=1)
        leaves = np.maximum(first, second).min(axis=1)
        visible[(enters < leaves) & (leaves > 0.0) & (enters < 1.0)] = 0.0
    return visible
