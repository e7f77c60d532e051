"""Rate-distortion optimisation of blocks of 4 x 4 texels: blocks are repeated where that adds little error.

A block codec's bytes hardly compress, since no two blocks are equal. Here a block is replaced by an earlier one that
fits its texels nearly as well: zstd or LZMA then stores a match in place of 16 bytes. The block with the least error
within a window is used (the nearest of equals) if its error exceeds that of the original by no more than a given
amount. The size in GPU memory and the decoder stay the same.
"""

import numpy as np

_SIDE = 4
_BYTES = 16
_WINDOW = 512  # blocks


def reuse_blocks(
    data: bytes, decoded: np.ndarray, target: np.ndarray, weight: np.ndarray, allowed: np.ndarray
) -> bytes:
    """Replaces blocks of a picture by earlier ones where that adds little error.

    Args:
        data: Blocks of 16 bytes, row by row.
        decoded: float32 [H, W, C], the decoded blocks; H and W are multiples of 4.
        target: float32 [H, W, C], the original texels.
        weight: float32 [H, W, C], weight of each squared error.
        allowed: float32 [H, W, C]; its sum over a block limits the increase of the block's weighted squared error.

    Returns:
        The same number of blocks.
    """
    blocks = np.frombuffer(data, np.uint8).reshape(-1, _BYTES)
    return reuse_in_order(blocks, *(by_block(image) for image in (decoded, target, weight, allowed))).tobytes()


def reuse_in_order(
    blocks: np.ndarray,
    decoded: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    allowed: np.ndarray,
    window: int = _WINDOW,
) -> np.ndarray:
    """Replaces blocks by earlier ones, like `reuse_blocks`, for blocks in the order of the file.

    Args:
        blocks: uint8 [n, 16].
        decoded, target, weight, allowed: float32 [n, V], V values per block; see `reuse_blocks`.
        window: Number of preceding blocks that are tried as replacements.

    Returns:
        uint8 [n, 16].
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
    """Cuts an image [H, W, C] into blocks, float32 [blocks, values of a block]."""
    height, width, channels = image.shape
    squares = image.reshape(height // _SIDE, _SIDE, width // _SIDE, _SIDE, channels).transpose(0, 2, 1, 3, 4)
    return squares.reshape(-1, _SIDE * _SIDE * channels).astype(np.float32)
