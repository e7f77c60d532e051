"""Rate-distortion optimisation of blocks of 4 x 4 texels: blocks are repeated where that adds little error.

A block codec's bytes hardly compress, since no two blocks are equal. Here a block is replaced by an earlier one that
fits its texels nearly as well: zstd or LZMA then stores a match in place of 16 bytes. Of a window of earlier blocks the
one with the least error is used (the nearest, if several have it), if its error exceeds that of the original block by
no more than a given amount. The size in GPU memory and the decoder stay the same.
"""

import numpy as np

_SIDE = 4


def reuse_blocks(
    blocks: np.ndarray,
    decoded: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    allowed: np.ndarray,
    window: int = 512,
) -> np.ndarray:
    """Replaces blocks by earlier ones where that adds little error.

    Args:
        blocks: uint8 [n, 16], in the order in which the file stores them.
        decoded: float32 [n, V], the V values that each block decodes to, see `by_block`.
        target: float32 [n, V], the original values.
        weight: float32 [n, V], weight of each squared error.
        allowed: float32 [n, V]; its sum over a block limits the increase of the block's weighted squared error.
        window: Number of preceding blocks that are tried as replacements.

    Returns:
        The chosen blocks, uint8 [n, 16].
    """
    blocks, held = blocks.copy(), decoded.copy()
    bound = np.sum(np.square(held - target) * weight + allowed, axis=1)
    for i in range(1, len(blocks)):
        first = max(0, i - window)
        errors = np.square(held[first:i] - target[i]) @ weight[i]
        best = i - 1 - int(errors[::-1].argmin())
        if errors[best - first] <= bound[i]:
            held[i], blocks[i] = held[best], blocks[best]
    return blocks


def by_block(image: np.ndarray) -> np.ndarray:
    """Cuts an image [H, W, C], H and W multiples of 4, into its blocks row by row, float32 [H W / 16, 16 C]."""
    height, width, channels = image.shape
    squares = image.reshape(height // _SIDE, _SIDE, width // _SIDE, _SIDE, channels).transpose(0, 2, 1, 3, 4)
    return squares.reshape(-1, _SIDE * _SIDE * channels).astype(np.float32)
