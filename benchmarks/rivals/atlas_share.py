"""The cost of a rival's texture: shares of a lightmap's bits, and the texels and blocks that are read."""

import math

import numpy as np

from wlm.atlas.data import Sheet
from wlm.atlas.model import SOURCE_BITS


def budget_bits(sheet: Sheet, share: float) -> int:
    """The bits of a share of a lightmap at 48 per texel.

    Raises:
        ValueError: The share isn't above 0.
    """
    if not 0.0 < share < math.inf:
        raise ValueError(f"share: expected above 0, got {share}")
    return int(share * sheet.mask.size * SOURCE_BITS)


def read_blocks(place: np.ndarray, size: tuple[int, int], block: tuple[int, int] = (1, 1)) -> int:
    """Counts the blocks of a texture that bilinear reads meet.

    Args:
        place: float64 [N, 2], row and column of each read in texels from the first texel's centre.
        size: Rows and columns of the texture.
        block: Width and height of a block in texels.
    """
    low = np.floor(place).astype(np.int64)
    # At a texel's centre nothing else is read.
    near, last, side = (low, np.minimum(low + (place > low), np.array(size) - 1), np.array(block[::-1]))
    read = np.zeros([-(-count // each) for count, each in zip(size, side, strict=True)], bool)
    for y in (near[:, 0], last[:, 0]):
        for x in (near[:, 1], last[:, 1]):
            read[np.maximum(y, 0) // side[0], np.maximum(x, 0) // side[1]] = True
    return int(np.count_nonzero(read))
