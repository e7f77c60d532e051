"""Exact decoding of all eight BC7 modes, and encoding by an optional package. `wlm.formats.bc7` packs mode 6.

The fields of a 128-bit block, from the lowest bit: the mode in unary (mode m is m zeros and a one), the partition, the
rotation, the index selection; the endpoints, R of all subsets, then G, B and A; P bits; the colour indices, and in
modes 4 and 5 the alpha indices. The index of a subset's anchor texel (texel 0 in subset 0) has one bit less. Source:
Khronos Data Format Specification 1.3, chapter 20 ("BPTC").
"""

import numpy as np

from wlm.formats.bc7 import BLOCK_BYTES, WEIGHTS
from wlm.formats.hdr_blocks import need

ENCODERS = ("ultrafast", "veryfast", "fast", "basic", "slow")
"""Presets of `encode_image`, from the fastest to the best."""

RESERVED = 8
"""Value of `block_modes` for a block whose first byte is zero, which the format reserves."""

FIELDS = (
    "subsets", "partition", "rotation", "selection", "colour", "alpha", "own_bits", "shared_bits", "index", "second"
)  # fmt: skip
"""Columns of `MODES`."""

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
SHARES[2] = WEIGHTS

_PIECE = 1 << 16  # blocks decoded at once: 8 MiB of unpacked bits


def encode_image(picture: np.ndarray, extra: str, profile: str = "slow") -> np.ndarray:
    """Encodes an opaque image, uint8 [H, W, 3] with sizes in multiples of 4, by Intel's ISPC texture compressor, in one
    thread.

    Args:
        extra: Name of the optional extra of wlm that installs the compressor, for the error message.
        profile: Quality of the compressor, one of `ENCODERS`.

    Returns:
        The blocks, uint8 [H/4, W/4, 16].

    Raises:
        WlmError: The package is missing.
    """
    texcomp = need("ispc_texcomp", extra)
    height, width = picture.shape[:2]
    opaque = np.concatenate([picture, np.full((height, width, 1), 255, np.uint8)], axis=2)
    surface = texcomp.RGBASurface(opaque.tobytes(), width, height)
    data = texcomp.compress_blocks_bc7(surface, texcomp.BC7EncSettings.from_profile(profile))
    return np.frombuffer(data, np.uint8).reshape(height // 4, width // 4, BLOCK_BYTES).copy()


# The mode of a block by its first byte: the number of its lowest bit that is set.
_MODE_OF = np.array([RESERVED, *((byte & -byte).bit_length() - 1 for byte in range(1, 256))], np.uint8)


def block_modes(blocks: np.ndarray) -> np.ndarray:
    """Returns the mode of each block, uint8 [...]; `RESERVED` for the reserved encoding.

    Args:
        blocks: uint8 [..., 16].
    """
    return _MODE_OF[blocks[..., 0]]


def decode_blocks(blocks: np.ndarray) -> np.ndarray:
    """Decodes blocks of any mode, uint8 [..., 16], bit-exactly to RGBA texels, uint8 [..., 16, 4], row-major.

    Reserved blocks become transparent black.

    Raises:
        ValueError: Wrong shape or type.
    """
    if blocks.dtype != np.uint8 or blocks.shape[-1:] != (BLOCK_BYTES,):
        raise ValueError(f"expected blocks uint8 [..., 16], got {blocks.dtype} {blocks.shape}")
    flat = blocks.reshape(-1, BLOCK_BYTES)
    texels = np.zeros((len(flat), 16, 4), np.uint8)
    for start in range(0, len(flat), _PIECE):
        piece = flat[start : start + _PIECE]
        modes = block_modes(piece)
        for mode in range(len(MODES)):
            chosen = np.flatnonzero(modes == mode)
            if len(chosen):
                texels[start + chosen] = _texels(np.unpackbits(piece[chosen], axis=1, bitorder="little"), mode)
    return texels.reshape(*blocks.shape[:-1], 16, 4)


def _texels(bits: np.ndarray, mode: int) -> np.ndarray:
    """Decodes n blocks of one mode, given as bits [n, 128], to RGBA texels, uint8 [n, 16, 4]."""
    is_of = dict(zip(FIELDS, MODES[mode].tolist(), strict=True))
    subsets, at = is_of["subsets"], mode + 1

    def take(count: int) -> np.ndarray:
        nonlocal at
        at += count
        return _number(bits[:, at - count : at])

    partition, rotation, selection = (take(is_of[name]) for name in ("partition", "rotation", "selection"))
    ends = np.full((len(bits), 2 * subsets, 4), 255)
    for channel, count in enumerate([is_of["colour"]] * 3 + [is_of["alpha"]]):
        for end in range(2 * subsets if count else 0):
            ends[:, end, channel] = take(count)
    lowest = [take(1) for _ in range(2 * subsets * is_of["own_bits"] + subsets * is_of["shared_bits"])]
    for channel, count in enumerate([is_of["colour"]] * 3 + [is_of["alpha"]]):
        if not count:
            continue
        if lowest:
            shared = 2 * subsets // len(lowest)  # endpoints to a P bit
            ends[:, :, channel] = 2 * ends[:, :, channel] + np.repeat(np.stack(lowest, 1), shared, axis=1)
            count += 1
        ends[:, :, channel] <<= 8 - count
        ends[:, :, channel] |= ends[:, :, channel] >> count
    subset = PARTITIONS[subsets - 1][partition][:, None] >> 2 * np.arange(16, dtype=np.uint32) & 3
    first = _shares(bits, at, is_of["index"], ANCHORS[subsets - 1][partition])
    at += 16 * is_of["index"] - subsets
    colour = alpha = first
    if is_of["second"]:
        second = _shares(bits, at, is_of["second"], ANCHORS[0][partition])
        colour = np.where(selection[:, None] == 1, second, first)
        alpha = np.where(selection[:, None] == 1, first, second)
    rows = np.arange(len(bits))[:, None]
    share = np.stack([colour, colour, colour, alpha], axis=2)
    texels = (64 - share) * ends[rows, 2 * subset] + share * ends[rows, 2 * subset + 1] + 32 >> 6
    for channel in range(3):
        turned = rotation == channel + 1
        texels[turned] = _swapped(texels[turned], channel)
    return texels.astype(np.uint8)


def _number(bits: np.ndarray) -> np.ndarray:
    """Converts bits [n, count], the lowest first, to numbers [n]."""
    return bits.astype(np.int64) @ (1 << np.arange(bits.shape[1]))


def _shares(bits: np.ndarray, at: int, count: int, anchors: np.ndarray) -> np.ndarray:
    """Returns the interpolation weights of n blocks, [n, 16], whose indices of `count` bits begin at bit `at`."""
    texel = np.arange(16)
    short = (texel == 0) | (texel == anchors[:, :1]) | (texel == anchors[:, 1:])
    start = at + count * texel - (np.cumsum(short, axis=1) - short)
    index = np.zeros(short.shape, np.int64)
    for bit in range(count):
        value = np.take_along_axis(bits, np.minimum(start + bit, 127), axis=1).astype(np.int64)
        index |= np.where(short & (bit == count - 1), 0, value) << bit
    return SHARES[count - 2][index]


def _swapped(texels: np.ndarray, channel: int) -> np.ndarray:
    """Returns RGBA texels with alpha and one other channel swapped."""
    order = list(range(4))
    order[channel], order[3] = 3, channel
    return texels[..., order]
