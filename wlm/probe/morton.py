"""Morton keys of grid cells, and the order of points along a Z-curve."""

import numpy as np

_CELLS = 1023  # along an axis of the unit cube
# Steps that spread 21 bits out to every third bit.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_keys(cell: np.ndarray) -> np.ndarray:
    """Returns Morton keys, uint64 [M], of cells int64 [M, 3] below 2 ** 21: the interleaved bits of x, y and z."""
    bits = cell.astype(np.uint64)
    for shift, mask in _SPREAD:
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits[:, 0] | bits[:, 1] << np.uint64(1) | bits[:, 2] << np.uint64(2)


def morton_order(x: np.ndarray) -> np.ndarray:
    """Returns indices that sort points [N, 3] of the unit cube along a Z-curve, int [N]; ties keep their order."""
    cell = np.clip(x * _CELLS, 0, _CELLS).astype(np.int64)
    return np.argsort(morton_keys(cell), kind="stable")
