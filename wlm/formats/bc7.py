"""BC7 blocks of 4 x 4 texels: packing of mode 6, exact decoding of all modes, encoding by an optional package, and the
format's tables. Source: Khronos Data Format Specification 1.3, chapter 20 ("BPTC").

The fields of a 128-bit block, from the lowest bit: the mode in unary (mode m is m zeros and a one), the partition, the
rotation, the index selection; the endpoints, R of all subsets, then G, B and A; P bits; the colour indices, and in
modes 4 and 5 the alpha indices. The index of a subset's anchor texel (texel 0 in subset 0) has one bit less.

A block of mode 6 has two RGBA endpoints of 7 bits, a P bit each, and 16 indices: R0 R1 G0 G1 B0 B1 A0 A1 from bit 7 on;
P0 at 63, P1 at 64; the indices from 65, row-major. An endpoint's byte is its 7 bits followed by its P bit. Here it is
packed as two 64-bit words: P1 is bit 0 of the second.
"""

import math

import numpy as np
from PIL import Image

from wlm.formats.hdr_blocks import need

BLOCK_BYTES = 16
"""Size of a block of 4 x 4 texels, in bytes."""

_MODE_BITS = 7
_MODE_6 = 1 << 6
# Bit 7 + 14 c + 7 e of the first word: channel c of endpoint e.
_ENDPOINT_SHIFTS = (7 + 14 * np.arange(4)[None, :] + 7 * np.arange(2)[:, None]).astype(np.uint64)
# Texel 0 lacks its top bit, so its index starts at bit 1 and that of texel i at bit 4 i.
_INDEX_SHIFTS = np.maximum(4 * np.arange(16), 1).astype(np.uint64)

MODES = np.array(
    [
        [3, 4, 0, 0, 4, 0, 1, 0, 3, 0],
        [2, 6, 0, 0, 6, 0, 0, 1, 3, 0],
        [3, 6, 0, 0, 5, 0, 0, 0, 2, 0],
        [2, 6, 0, 0, 7, 0, 1, 0, 2, 0],
        [1, 0, 2, 1, 5, 6, 0, 0, 2, 3],
        [1, 0, 2, 0, 7, 8, 0, 0, 2, 2],
        [1, 0, 0, 0, 7, 7, 1, 0, 4, 0],
        [2, 6, 0, 0, 5, 5, 1, 0, 2, 0],
    ],
    np.int32,
)
"""Per mode: number of subsets; bits of the partition number, the rotation and the index selection; bits of colour and
alpha of an endpoint; P bits per endpoint and per subset; bits of an index and of the second index."""

_TWO = """
CCCC 8888 EEEE ECC8 C880 FEEC FEC8 EC80 C800 FFEC FE80 E800 FFE8 FF00 FFF0 F000
F710 008E 7100 08CE 008C 7310 3100 8CCE 088C 3110 6666 366C 17E8 0FF0 718E 399C
AAAA F0F0 5A5A 33CC 3C3C 55AA 9696 A55A 73CE 13C8 324C 3BDC 6996 C33C 9966 0660
0272 04E4 4E40 2720 C936 936C 39C6 639C 9336 9CC6 817E E718 CCF0 0FCC 7744 EE22
"""  # one bit per texel
_THREE = """
AA685050 6A5A5040 5A5A4200 5450A0A8 A5A50000 A0A05050 5555A0A0 5A5A5050
AA550000 AA555500 AAAA5500 90909090 94949494 A4A4A4A4 A9A59450 2A0A4250
A5945040 0A425054 A5A5A500 55A0A0A0 A8A85454 6A6A4040 A4A45000 1A1A0500
0050A4A4 AAA59090 14696914 69691400 A08585A0 AA821414 50A4A450 6A5A0200
A9A58000 5090A0A8 A8A09050 24242424 00AA5500 24924924 24499224 50A50A50
500AA550 AAAA4444 66660000 A5A0A5A0 50A050A0 69286928 44AAAA44 66666600
AA444444 54A854A8 95809580 96969600 A85454A8 80959580 AA141414 96960000
AAAA1414 A05050A0 A0A5A5A0 96000000 40804080 A9A8A9A8 AAAAAA44 2A4A5254
"""  # two bits per texel
# One hexadecimal digit per partition: the anchor of subset 1 of two, and the anchors of subsets 1 and 2 of three.
_ANCHORS = (
    "FFFFFFFFFFFFFFFFF282288F28228822FF6828FF28222FF66268FF22FFFFF22F",
    "33FF83FF88666533338F336A588685FF8F356A8FF3F5FFFF3F55585A5A8DFC33",
    "F883FF38FFFFFFF8F8F3F8F83F6AFFA8F3FAA89A6F8F3668F3FFFFFFFFFF3FF8",
)
NO_ANCHOR = 16


def _partitions() -> np.ndarray:
    texel = np.arange(16, dtype=np.uint32)
    two = np.array([int(word, 16) for word in _TWO.split()], np.uint32)
    spread = np.bitwise_or.reduce((two[:, None] >> texel & 1) << 2 * texel, axis=1)
    three = np.array([int(word, 16) for word in _THREE.split()], np.uint32)
    return np.stack([np.zeros_like(three), spread, three])


def _anchors() -> np.ndarray:
    found = np.full((3, 64, 2), NO_ANCHOR, np.int32)
    for (subsets, place), digits in zip(((1, 0), (2, 0), (2, 1)), _ANCHORS, strict=True):
        found[subsets, :, place] = [int(digit, 16) for digit in digits]
    return found


PARTITIONS = _partitions()
"""uint32 [3, 64], by the number of subsets - 1 and the partition: the subset of each texel, two bits each."""

ANCHORS = _anchors()
"""int32 [3, 64, 2], indexed likewise: the anchors of subsets 1 and 2, or `NO_ANCHOR`."""

SHARES = np.zeros((3, 16), np.int32)
"""Weight of endpoint 1 for each index, in 64ths, indexed by the number of index bits - 2."""
SHARES[0, :4] = 0, 21, 43, 64
SHARES[1, :8] = 0, 9, 18, 27, 37, 46, 55, 64
SHARES[2] = 0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64
SHARES.flags.writeable = False


def pack_mode6(endpoints: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Packs endpoints, uint8 [..., 2, 4], RGBA, and indices, uint8 [..., 16] in 0..15, row-major, into blocks, uint8
    [..., 16]; the four bytes of an endpoint share their lowest bit.

    The file requires an index below 8 for texel 0. Where it is larger, the endpoints are swapped and the indices become
    15 - index, which decodes to the same texels.
    """
    if endpoints.dtype != np.uint8 or indices.dtype != np.uint8:
        raise ValueError(f"endpoints, indices: expected uint8, got {endpoints.dtype} and {indices.dtype}")
    if endpoints.shape[-2:] != (2, 4) or indices.shape != (*endpoints.shape[:-2], 16):
        raise ValueError(
            f"endpoints, indices: expected [..., 2, 4] and [..., 16], got {endpoints.shape}, {indices.shape}"
        )
    if indices.size and indices.max() > 15:
        raise ValueError(f"indices: expected 0 to 15, got {indices.max()}")
    parity = endpoints & 1
    if np.any(parity != parity[..., :1]):
        raise ValueError("endpoints: expected the four bytes of each endpoint to have the same lowest bit")
    swapped = indices[..., :1] >= 8
    endpoints = np.where(swapped[..., None], endpoints[..., ::-1, :], endpoints)
    indices = np.where(swapped, 15 - indices, indices)
    low, high = _words(endpoints, indices)
    words = np.stack([low, high], axis=-1).astype("<u8")
    return words.view(np.uint8)


def decode_image(blocks: np.ndarray) -> np.ndarray:
    """Decodes images of blocks of any mode, uint8 [..., R, C, 16], bit-exactly to RGBA, uint8 [..., 4 R, 4 C, 4].
    Blocks whose first byte is 0, which the format reserves, become black."""
    if blocks.dtype != np.uint8 or blocks.ndim < 3 or blocks.shape[-1] != BLOCK_BYTES:
        raise ValueError(f"blocks: expected uint8 [..., H/4, W/4, 16], got {blocks.dtype} {blocks.shape}")
    *rest, rows, columns, _ = blocks.shape
    size = 4 * columns, 4 * rows * math.prod(rest)
    pixels = Image.frombytes("RGBA", size, blocks.tobytes(), "bcn", 7)
    return np.array(pixels).reshape(*rest, 4 * rows, 4 * columns, 4)


def encode_image(picture: np.ndarray, extra: str, profile: str = "slow") -> np.ndarray:
    """Encodes an opaque image, uint8 [H, W, 3] with sizes in multiples of 4, by Intel's ISPC texture compressor, in one
    thread; returns blocks, uint8 [H/4, W/4, 16].

    `extra` names the extra of wlm that installs the compressor, `profile` its quality: "ultrafast", "veryfast", "fast",
    "basic" or "slow".
    """
    texcomp = need("ispc_texcomp", extra)
    height, width = picture.shape[:2]
    opaque = np.concatenate([picture, np.full((height, width, 1), 255, np.uint8)], axis=2)
    surface = texcomp.RGBASurface(opaque.tobytes(), width, height)
    data = texcomp.compress_blocks_bc7(surface, texcomp.BC7EncSettings.from_profile(profile))
    return np.frombuffer(data, np.uint8).reshape(height // 4, width // 4, BLOCK_BYTES).copy()


def _words(endpoints: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Packs blocks, in which texel 0 has an index below 8, into two 64-bit words each."""
    wide = endpoints.astype(np.uint64)
    low = np.bitwise_or.reduce((wide >> np.uint64(1)) << _ENDPOINT_SHIFTS, axis=(-2, -1))
    low |= np.uint64(_MODE_6) | ((wide[..., 0, 0] & np.uint64(1)) << np.uint64(63))
    high = np.bitwise_or.reduce(indices.astype(np.uint64) << _INDEX_SHIFTS, axis=-1)
    return low, high | (wide[..., 1, 0] & np.uint64(1))
