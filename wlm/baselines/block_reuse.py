"""Rate-distortion optimisation of blocks of 4 x 4 texels: blocks repeated where that loses little.

A block codec's bytes hardly compress, for no two blocks are alike. Here a block takes the bytes of one before it that
fits its texels nearly as well: zstd then stores a match in place of 16 bytes. The least of all errors within a window
is taken, of equal ones the nearest, if it is not more than a given amount above the block's own. Memory and decoding
stay as they are.
"""

import numpy as np

_SIDE = 4
_BYTES = 16
_WINDOW = 512  # blocks


def reuse_blocks(
    data: bytes, decoded: np.ndarray, target: np.ndarray, weight: np.ndarray, allowed: np.ndarray
) -> bytes:
    """Repeats blocks.

    Args:
        data: Blocks of 16 bytes, row by row.
        decoded: float32 [H, W, C], what they decode to; H and W multiples of 4.
        target: float32 [H, W, C], what they should decode to.
        weight: float32 [H, W, C], of each squared error.
        allowed: float32 [H, W, C]; its sum over a block is what the block's weighted squared error may grow by.

    Returns:
        As many blocks.
    """
    blocks = np.frombuffer(data, np.uint8).reshape(-1, _BYTES).copy()
    held, wanted, weights, more = (_split(image) for image in (decoded, target, weight, allowed))
    bound = np.sum(np.square(held - wanted) * weights + more, axis=1)
    for i in range(1, len(blocks)):
        first = max(0, i - _WINDOW)
        errors = np.square(held[first:i] - wanted[i]) @ weights[i]
        best = i - 1 - int(errors[::-1].argmin())
        if errors[best - first] <= bound[i]:
            held[i], blocks[i] = held[best], blocks[best]
    return blocks.tobytes()


def _split(image: np.ndarray) -> np.ndarray:
    """float32 [blocks, values of a block] of an image [H, W, C]."""
    height, width, channels = image.shape
    squares = image.reshape(height // _SIDE, _SIDE, width // _SIDE, _SIDE, channels).transpose(0, 2, 1, 3, 4)
    return squares.reshape(-1, _SIDE * _SIDE * channels).astype(np.float32)  # a copy
