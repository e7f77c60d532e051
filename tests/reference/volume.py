"""Reading a cascaded lighting volume, from the blocks by name: no slots, no windows but their limits."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

Blocks = Mapping[tuple[int, int, int, int], np.ndarray]  # (level, x, y, z) -> [D]


def read(
    blocks: Blocks, bases: np.ndarray, sizes: Sequence[float], sides: np.ndarray, points: np.ndarray, channels: int
) -> tuple[np.ndarray, np.ndarray]:
    """The light at points, and how much of it each level answered.

    Args:
        blocks: Those that are there; ones outside their level's window don't count.
        bases: int [L, 3], the first block of each window.
        sizes: [L], side of a block.
        sides: int [L, 3], blocks along the axes of each window.
        points: [M, 3].
        channels: D.

    Returns:
        float64 [M, D] and shares [M, L]; what is covered is their sum.
    """
    values = np.zeros((len(points), channels))
    shares = np.zeros((len(points), len(sizes)))
    for i, point in enumerate(points):
        left = 1.0
        for level, size in enumerate(sizes):
            # The light of block b stands at (b + 1/2) size.
            place = [float(x) / size - 0.5 for x in point]
            found = 0.0
            for corner in itertools.product((0, 1), repeat=3):
                block = [math.floor(x) + c for x, c in zip(place, corner, strict=True)]
                weight = math.prod(1.0 - abs(x - b) for x, b in zip(place, block, strict=True))
                local = np.array(block) - bases[level]
                inside = ((local >= 0) & (local < sides[level])).all()
                if inside and (level, *block) in blocks:
                    values[i] += left * weight * blocks[level, *block]
                    found += weight
            shares[i, level] = left * found
            left *= 1.0 - found
        if shares[i].sum() > 0.0:
            values[i] /= shares[i].sum()
    return values, shares
