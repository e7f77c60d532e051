"""Rate-distortion optimisation of blocks of 4 x 4 texels: blocks are repeated where that adds little error.

A block codec's bytes hardly compress, since no two blocks are equal. Here a block is replaced by an earlier one that
fits its texels nearly as well: zstd or LZMA then stores a match in place of 16 bytes. Of a window of earlier blocks the
one with the least error is used (the nearest, if several have it), if its error exceeds that of the original block by
no more than a given amount. The size in GPU memory and the decoder stay the same.
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
        The chosen blocks, as many as in `data`.
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
    """Does the work of `reuse_blocks` for blocks in any order; each may be replaced by one before it.

    Args:
        blocks: uint8 [n, 16], in the order in which the file stores them.
        decoded, target, weight, allowed: float32 [n, V], V values per block; see `reuse_blocks`.
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
    """Cuts an image [H, W, C] into blocks of 4 x 4 texels, float32 [H W / 16, 16 C], row by row."""
    height, width, channels = image.shape
    squares = image.reshape(height // _SIDE, _SIDE, width // _SIDE, _SIDE, channels).transpose(0, 2, 1, 3, 4)
    return squares.reshape(-1, _SIDE * _SIDE * channels).astype(np.float32)
