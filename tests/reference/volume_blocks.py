"""The blocks of a cascaded volume, one probe at a time: which there are, and what light each has."""

import itertools
import math

import numpy as np

LEAST = 0.1
SMOOTH, LENGTH, NOISE = 0.3, 3.0, 0.03


def hat(x: np.ndarray) -> float:
    """The share of a block's light at a place, in sides from its centre."""
    return float(np.prod(np.maximum(1.0 - np.abs(x), 0.0)))


def around(place: np.ndarray, size: float) -> list[tuple[int, ...]]:
    """The eight blocks whose centres are round a place."""
    low = np.floor(place / size - 0.5).astype(int)
    return [tuple((low + corner).tolist()) for corner in itertools.product((0, 1), repeat=3)]


def blocks(position: np.ndarray, size: float) -> set[tuple[int, ...]]:
    """Selects the blocks that have a tenth of the light at some probe."""
    near = ((place, block) for place in position for block in around(place, size))
    return {block for place, block in near if hat(place / size - np.array(block) - 0.5) >= LEAST}


def near(position: np.ndarray, block: tuple[int, ...], size: float) -> np.ndarray:
    """Numbers of the probes within a side of its centre along each axis."""
    x = position / size - np.array(block) - 0.5
    return np.flatnonzero(((x >= -1.0) & (x < 1.0)).all(1))


def weights(position: np.ndarray, block: tuple[int, ...], size: float) -> np.ndarray:
    """Returns the weights of probes [M, 3], whose sum is 1, by ordinary kriging with a Lagrange multiplier."""
    x = position / size - np.array(block) - 0.5

    def smooth(a: np.ndarray, b: np.ndarray) -> float:
        return SMOOTH * math.exp(-float(np.linalg.norm(a - b)) / LENGTH)

    lattice = [np.array(c) for c in itertools.product(range(-2, 3), repeat=3)]
    read = np.array([[hat(place - c) for c in lattice] for place in x])  # A
    count = len(x)
    system = np.ones((count + 1, count + 1))
    system[:-1, :-1] = read @ read.T + [[smooth(a, b) for b in x] for a in x] + NOISE * np.eye(count)
    system[-1, -1] = 0.0
    right = np.append([hat(place) + smooth(place, np.zeros(3)) for place in x], 1.0)
    return np.linalg.solve(system, right)[:-1]
