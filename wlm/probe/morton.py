"""Morton keys of grid cells, and the order of points along a Z-curve."""

import numpy as np

from wlm_kernels.probe.volume_frame import SPREAD

_CELLS = 1023  # along an axis of the unit cube


def spread_bits(numbers: np.ndarray) -> np.ndarray:
    """Returns whole numbers below 2 ** 21, of any shape, with two zeros between each two bits, uint64."""
    bits = numbers.astype(np.uint64)
    for shift, mask in zip((32, 16, 8, 4, 2), SPREAD, strict=True):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits


def morton_keys(cell: np.ndarray) -> np.ndarray:
    """Returns Morton keys, uint64 [M], of cells int64 [M, 3] below 2 ** 21: the interleaved bits of x, y and z."""
    bits = spread_bits(cell)
    return bits[:, 0] | bits[:, 1] << np.uint64(1) | bits[:, 2] << np.uint64(2)


def morton_order(x: np.ndarray) -> np.ndarray:
    """Returns indices that sort points [N, 3] of the unit cube along a Z-curve, int [N]; ties keep their order."""
    cell = np.clip(x * _CELLS, 0, _CELLS).astype(np.int64)
    return np.argsort(morton_keys(cell), kind="stable")
