"""Exact packing and decoding of BC7 mode 6: per block two RGBA endpoints of 7 bits, a P bit each, and 16 indices.

Bits from the lowest: 0-6 the mode (only bit 6 set); the endpoints' upper 7 bits R0 R1 G0 G1 B0 B1 A0 A1 from
bit 7 on; P0 at 63, P1 at 64; the indices from 65, 3 bits for texel 0 and 4 for the others, row-major. An
endpoint's byte is its 7 bits followed by its P bit. Here a block is two 64-bit words: P1 is bit 0 of the second.
"""

import numpy as np

from wlm.errors import WlmError

BLOCK_BYTES = 16
"""Size of a block of 4 x 4 texels, in bytes."""

WEIGHTS = np.array([0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64], np.uint8)
"""Weight of endpoint 1 for each index, in 64ths."""
WEIGHTS.flags.writeable = False

_MODE_BITS = 7
_MODE_6 = 1 << 6
# Bit 7 + 14 c + 7 e of the first word: channel c of endpoint e.
_ENDPOINT_SHIFTS = (7 + 14 * np.arange(4)[None, :] + 7 * np.arange(2)[:, None]).astype(np.uint64)
# Texel 0 lacks its top bit, so its index starts at bit 1 and that of texel i at bit 4 i.
_INDEX_SHIFTS = np.maximum(4 * np.arange(16), 1).astype(np.uint64)


def pack_mode6(endpoints: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Packs endpoints and indices into blocks.

    The file requires an index below 8 for texel 0. Where it is larger, the endpoints are swapped and the indices
    become 15 - index, which decodes to the same texels.

    Args:
        endpoints: uint8 [..., 2, 4], RGBA; the four bytes of an endpoint share their lowest bit.
        indices: uint8 [..., 16] in 0..15, row-major.

    Returns:
        The blocks, uint8 [..., 16].

    Raises:
        ValueError: Wrong shapes or types, an index above 15, or an endpoint without a shared lowest bit.
    """
    if endpoints.dtype != np.uint8 or indices.dtype != np.uint8:
        raise ValueError(f"expected uint8 endpoints and indices, got {endpoints.dtype} and {indices.dtype}")
    if endpoints.shape[-2:] != (2, 4) or indices.shape != (*endpoints.shape[:-2], 16):
        raise ValueError(
            f"expected endpoints [..., 2, 4] and indices [..., 16], got {endpoints.shape}, {indices.shape}"
        )
    if indices.size and indices.max() > 15:
        raise ValueError(f"expected indices in 0..15, got {indices.max()}")
    parity = endpoints & 1
    if np.any(parity != parity[..., :1]):
        raise ValueError("expected the four bytes of every endpoint to share their lowest bit")
    swapped = indices[..., :1] >= 8
    endpoints = np.where(swapped[..., None], endpoints[..., ::-1, :], endpoints)
    indices = np.where(swapped, 15 - indices, indices)
    low, high = _words(endpoints, indices)
    words = np.stack([low, high], axis=-1).astype("<u8")
    return words.view(np.uint8)


def unpack_mode6(blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reads the endpoints, uint8 [..., 2, 4], and indices, uint8 [..., 16], of blocks; the inverse of `pack_mode6`.

    Raises:
        ValueError: Wrong shape or type.
        WlmError: A block is of another mode.
    """
    if blocks.dtype != np.uint8 or blocks.shape[-1:] != (BLOCK_BYTES,):
        raise ValueError(f"expected blocks uint8 [..., 16], got {blocks.dtype} {blocks.shape}")
    words = np.ascontiguousarray(blocks).view("<u8").astype(np.uint64)
    low, high = words[..., 0], words[..., 1]
    foreign = (low & np.uint64((1 << _MODE_BITS) - 1)) != _MODE_6
    if np.any(foreign):
        place = int(np.flatnonzero(foreign)[0])
        raise WlmError(f"BC7 block {place}: expected mode 6, found {_mode_name(int(low.flat[place]))}")
    parity = np.stack([low >> np.uint64(63), high & np.uint64(1)], axis=-1)
    upper = (low[..., None, None] >> _ENDPOINT_SHIFTS) & np.uint64(0x7F)
    endpoints = (upper << np.uint64(1)) | parity[..., None]
    indices = (high[..., None] >> _INDEX_SHIFTS) & np.uint64(0xF)
    indices[..., 0] &= np.uint64(0x7)
    return endpoints.astype(np.uint8), indices.astype(np.uint8)


def decode_mode6(blocks: np.ndarray) -> np.ndarray:
    """Decodes blocks, uint8 [..., 16], bit-exactly to RGBA texels, uint8 [..., 16, 4], row-major.

    Raises:
        ValueError: Wrong shape or type.
        WlmError: A block is of another mode.
    """
    endpoints, indices = unpack_mode6(blocks)
    # The sum fits in 16 bits: at most 64 * 255 + 32.
    share = WEIGHTS[indices].astype(np.uint16)[..., None]
    ends = endpoints.astype(np.uint16)
    mixed = (64 - share) * ends[..., None, 0, :] + share * ends[..., None, 1, :]
    return ((mixed + 32) >> 6).astype(np.uint8)


def decode_image(blocks: np.ndarray) -> np.ndarray:
    """Decodes the blocks of an image, uint8 [H/4, W/4, 16], to RGBA, uint8 [H, W, 4]; raises like `decode_mode6`."""
    if blocks.ndim != 3:
        raise ValueError(f"expected blocks [H/4, W/4, 16], got {blocks.shape}")
    return blocks_image(decode_mode6(blocks))


def blocks_image(texels: np.ndarray) -> np.ndarray:
    """Rearranges texels by block, [..., H/4, W/4, 16, C], into images [..., H, W, C]."""
    *rest, rows, columns, _, channels = texels.shape
    image = texels.reshape(*rest, rows, columns, 4, 4, channels).swapaxes(-4, -3)
    return image.reshape(*rest, 4 * rows, 4 * columns, channels)


def _words(endpoints: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Packs blocks, in which texel 0 has an index below 8, into two 64-bit words each."""
    wide = endpoints.astype(np.uint64)
    low = np.bitwise_or.reduce((wide >> np.uint64(1)) << _ENDPOINT_SHIFTS, axis=(-2, -1))
    low |= np.uint64(_MODE_6) | ((wide[..., 0, 0] & np.uint64(1)) << np.uint64(63))
    high = np.bitwise_or.reduce(indices.astype(np.uint64) << _INDEX_SHIFTS, axis=-1)
    return low, high | (wide[..., 1, 0] & np.uint64(1))


def _mode_name(low: int) -> str:
    """Names the mode of a block: the position of the lowest set bit; a first byte of zero is reserved."""
    byte = low & 0xFF
    return f"mode {(byte & -byte).bit_length() - 1}" if byte else "a reserved mode"
