"""Packing of integers of a few bits each, without gaps."""

from collections.abc import Sequence

import numpy as np


def pack_bits(values: np.ndarray, widths: np.ndarray | Sequence[int]) -> np.ndarray:
    """Packs integers of given bit widths, row by row.

    Args:
        values: [K, C], below 2**16.
        widths: int [C], bits of each column, 0 to 16.

    Returns:
        uint8 [ceil(K * sum(widths) / 8)]; the lowest bit of each number comes first.

    Raises:
        ValueError: A number needs more bits than its column has.
    """
    values = np.asarray(values)
    if values.size and (values.max(0) >> np.asarray(widths)).any():
        raise ValueError("a number exceeds the bit width of its column")
    columns = [(values[:, c, None] >> np.arange(width)) & 1 for c, width in enumerate(widths)]
    return np.packbits(np.concatenate(columns, 1).astype(np.uint8), bitorder="little")


def unpack_bits(packed: np.ndarray, widths: np.ndarray | Sequence[int], count: int) -> np.ndarray:
    """Inverts `pack_bits` for `count` rows; returns uint16 [count, C].

    Raises:
        ValueError: The number of bytes does not match the number of rows.
    """
    total = int(np.sum(widths))
    if len(packed) != -(-count * total // 8):
        raise ValueError(f"expected the bytes of {count} rows of {total} bits, found {len(packed)} bytes")
    bits = np.unpackbits(packed, count=count * total, bitorder="little").reshape(count, total).astype(np.uint16)
    columns = [
        (bits[:, end - width : end] << np.arange(width, dtype=np.uint16)).sum(1, dtype=np.uint16)
        for end, width in zip(np.cumsum(widths), widths, strict=True)
    ]
    return np.stack(columns, 1)
