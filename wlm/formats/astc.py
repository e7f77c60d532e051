"""Blocks of ASTC HDR with 4 x 4 texels: the subset of the format that `wlm_kernels.astc` writes.

A block of 128 bits stores one line in colour space, or two lines and the number of the partition that assigns texels to
them. A line has two ends of 12 bits per channel, on a scale that is roughly the logarithm of light, which are packed
into bytes in one of 15 layouts. The bytes are rounded to a range of numbers, as large as the bits that the texels'
weights leave. From the lowest bit, a block contains the block mode, the number of lines, the partition, the endpoint
mode, and the bytes; the weights start at the highest bit and grow downwards.

Khronos' Data Format Specification 1.4, chapter 23 ("ASTC"), specifies the format.
"""

import math

import numpy as np

# Numbers of a range: 1, 3 (trits) or 5 (quints) times a power of two.
_RANGES = [(2**bits * base, base, bits) for bits in range(9) for base in (1, 3, 5)]
_RANGES = sorted(each for each in _RANGES if 1 < each[0] <= 256)
_LEVELS = [levels for levels, _, _ in _RANGES]
_PACKED = {1: (0, 1), 3: (8, 5), 5: (7, 3)}  # bits of a group of trits or quints, and numbers in the group

# Factor of the trit or quint, and pattern of the low bits (a is the lowest), of colours and weights that are stored.
_COLOUR = {
    6: (204, "000000000"), 10: (113, "000000000"), 12: (93, "b000b0bb0"), 20: (54, "b0000bb00"),
    24: (44, "cb000cbcb"), 40: (26, "cb0000cbc"), 48: (22, "dcb000dcb"), 80: (13, "dcb0000dc"), 96: (11, "edcb000ed"),
    160: (6, "edcb0000e"), 192: (5, "fedcb000f"),
}  # fmt: skip
_WEIGHT = {6: (50, "0000000"), 10: (28, "0000000"), 12: (23, "b000b0b"), 20: (13, "b0000b0"), 24: (11, "cb000cb")}
_PLAIN = {3: (0, 32, 63), 5: (0, 16, 32, 47, 63)}


def _bits_of(count: int, levels: int) -> int:
    """Counts the bits of `count` numbers of a range."""
    _, base, bits = _RANGES[_LEVELS.index(levels)]
    packed, group = _PACKED[base]
    return count * bits + math.ceil(count * packed / group)


def _expanded(levels: int, width: int, patterns: dict[int, tuple[int, str]]) -> list[int]:
    """Returns the value of `width` bits of each stored number of a range."""
    _, base, bits = _RANGES[_LEVELS.index(levels)]
    if base == 1:
        return [int(f"{number:0{bits}b}" * width, 2) >> (bits * width - width) for number in range(levels)]
    factor, pattern = patterns[levels]
    values = []
    for number in range(levels):
        high, low = divmod(number, 1 << bits)
        mixed = int(
            "".join(letter if letter == "0" else str(low >> "abcdef".index(letter) & 1) for letter in pattern), 2
        )
        flip = (1 << len(pattern)) - 1 if low & 1 else 0
        values.append((flip & 1 << width - 1) | (high * factor + mixed ^ flip) >> 2)
    return values


def _trits(packed: int) -> tuple[int, ...]:
    """Decodes five trits from 8 bits."""
    if packed >> 2 & 7 == 7:
        rest, t3, t4 = packed >> 5 << 2 | packed & 3, 2, 2
    else:
        rest = packed & 31
        t3, t4 = (packed >> 7, 2) if packed >> 5 & 3 == 3 else (packed >> 5 & 3, packed >> 7)
    if rest & 3 == 3:
        t2, t1, t0 = 2, rest >> 4, (rest >> 3 & 1) << 1 | (rest >> 2 & ~(rest >> 3) & 1)
    elif rest >> 2 & 3 == 3:
        t2, t1, t0 = 2, 2, rest & 3
    else:
        t2, t1, t0 = rest >> 4, rest >> 2 & 3, (rest >> 1 & 1) << 1 | (rest & ~(rest >> 1) & 1)
    return t0, t1, t2, t3, t4


def _quints(packed: int) -> tuple[int, ...]:
    """Decodes three quints from 7 bits."""
    low = packed & 1
    if packed >> 1 & 3 == 3 and packed >> 5 == 0:
        return 4, 4, low << 2 | (packed >> 4 & ~low & 1) << 1 | (packed >> 3 & ~low & 1)
    if packed >> 1 & 3 == 3:
        q2, rest = 4, (packed >> 3 & 3) << 3 | (~packed >> 5 & 3) << 1 | low
    else:
        q2, rest = packed >> 5, packed & 31
    return (rest >> 3, 4, q2) if rest & 7 == 5 else (rest & 7, rest >> 3, q2)


def _groups() -> np.ndarray:
    """Returns the packed bits of all groups of trits (row 0) and quints (row 1), by the group's digits as a number. Of
    several codes it is the least, since a group that is cut off at its end is filled up with zeros."""
    table = np.zeros((2, 243), np.int32)
    for row, (base, size, decode) in enumerate(((3, 256, _trits), (5, 128, _quints))):
        for packed in reversed(range(size)):
            table[row, sum(digit * base**i for i, digit in enumerate(decode(packed)))] = packed
    return table


# For each layout of endpoint mode 11 (two colours) and 7 (a colour, and a difference to a darker one), from the finest:
# the shift from its fields to 12 bits; its number in the format; bits of its fields, negative for signed ones; and the
# bits of each byte above the low bits of the byte's own field, from the highest. "1.9" is bit 9 of field 1. The fields
# of mode 11 are the format's a, c, b0, b1, d0 and d1; those of mode 7 are R, G, B and S; "h" is the layout's number
# with that of the largest channel.
_LAYOUTS = (
    (11, 0, 7, (12, 7, 6, 6, -6, -6), "- h.0,0.8 h.1,0.9 h.2,0.10 h.3,0.11,4.5 h.4,1.6,5.5"),
    (11, 0, 6, (12, 7, 7, 7, -5, -5), "- h.0,0.8 h.1,2.6 h.2,3.6 h.3,0.11,0.9 h.4,1.6,0.10"),
    (11, 1, 5, (11, 8, 6, 6, -6, -6), "- h.0,0.8 h.1,0.9 h.2,0.10 h.3,1.7,4.5 h.4,1.6,5.5"),
    (11, 1, 4, (11, 6, 8, 8, -5, -5), "- h.0,0.8 h.1,2.6 h.2,3.6 h.3,2.7,0.9 h.4,3.7,0.10"),
    (11, 2, 3, (10, 7, 7, 7, -6, -6), "- h.0,0.8 h.1,2.6 h.2,3.6 h.3,0.9,4.5 h.4,1.6,5.5"),
    (11, 2, 2, (10, 7, 6, 6, -7, -7), "- h.0,0.8 h.1,0.9 h.2,1.6 h.3,4.6,4.5 h.4,5.6,5.5"),
    (11, 3, 1, (9, 6, 8, 8, -6, -6), "- h.0,0.8 h.1,2.6 h.2,3.6 h.3,2.7,4.5 h.4,3.7,5.5"),
    (11, 3, 0, (9, 6, 7, 7, -7, -7), "- h.0,0.8 h.1,2.6 h.2,3.6 h.3,4.6,4.5 h.4,5.6,5.5"),
    (11, 4, 0, (8, 8, 8, 8, 7, 7), "- - - - h.3 h.4"),
    (7, 1, 0, (11, 5, 5, 7), "h.1,h.0 h.2,0.9,0.8 h.3,0.7,0.10 0.6,3.6,3.5"),
    (7, 1, 1, (11, 6, 6, 5), "h.1,h.0 h.2,0.8,1.5 h.3,0.7,2.5 0.6,0.10,0.9"),
    (7, 2, 2, (10, 5, 5, 8), "h.1,h.0 h.2,0.9,0.8 h.3,0.7,0.6 3.7,3.6,3.5"),
    (7, 3, 3, (9, 6, 6, 7), "h.1,h.0 h.2,0.8,1.5 h.3,0.7,2.5 0.6,3.6,3.5"),
    (7, 4, 12, (8, 7, 7, 6), "h.1,h.0 h.2,1.6,1.5 h.3,2.6,2.5 0.6,0.7,3.5"),
    (7, 5, 15, (7, 7, 7, 7), "h.1,h.0 h.2,1.6,1.5 h.3,2.6,2.5 0.6,3.6,3.5"),
)
_HEADER = 6


def _layouts() -> np.ndarray:
    table = np.full((len(_LAYOUTS), 6, 5), -1, np.int32)
    for row, (_, _, _, fields, text) in enumerate(_LAYOUTS):
        for byte, (bits, word) in enumerate(zip(fields, text.split(), strict=True)):
            codes = [] if word == "-" else [part.split(".") for part in word.split(",")]
            table[row, byte, : len(codes)] = [
                (_HEADER if name == "h" else int(name)) << 4 | int(bit) for name, bit in codes
            ]
            table[row, byte, 3:] = bits, len(codes)
    return table


def _modes() -> np.ndarray:
    """Lists ways to store a block: lines, endpoint mode, and levels of the weights."""
    ways = [(1, 11, 12), (1, 11, 16), (1, 11, 20), (1, 11, 24), (1, 7, 16), (1, 7, 24), (1, 7, 32)]
    ways += [
        (2, 7, 4),
        (2, 7, 5),
        (2, 7, 6),
        (2, 7, 8),
        (2, 7, 10),
        (2, 11, 3),
        (2, 11, 4),
        (2, 11, 5),
        (2, 11, 6),
        (2, 11, 8),
    ]
    rows = []
    for lines, kind, levels in ways:
        index = _LEVELS.index(levels)
        rho, fine = index % 6 + 2, index // 6
        # The grid of weights has 4 columns (bits 7 and 8: 0) and 4 rows (bits 5 and 6: 2).
        mode = (rho >> 1) | (rho & 1) << 4 | 2 << 5 | fine << 9
        room = 128 - (17 if lines == 1 else 29) - _bits_of(16, levels)
        count = lines * (6 if kind == 11 else 4)
        colours = max(i for i, each in enumerate(_LEVELS) if _bits_of(count, each) <= room)
        rows.append((lines, kind, index, levels, colours, mode))
    return np.array(rows, np.int32)


def _weights() -> tuple[np.ndarray, np.ndarray]:
    shares, codes = np.zeros((2, 12, 32), np.int32)
    for row, levels in enumerate(_LEVELS[:12]):
        values = _PLAIN[levels] if levels in _PLAIN else _expanded(levels, 6, _WEIGHT)
        order = np.argsort(values)
        shares[row, :levels] = [values[i] + (values[i] > 32) for i in order]
        codes[row, :levels] = order
    return shares, codes


def _bytes() -> tuple[np.ndarray, np.ndarray]:
    rounded, codes = np.zeros((len(_LEVELS), 5, 256), np.int32), np.zeros((len(_LEVELS), 256), np.int32)
    wanted = np.arange(256)
    for row, levels in enumerate(_LEVELS):
        if levels < 16:
            continue  # too few for the bits that a layout needs
        values = np.array(_expanded(levels, 8, _COLOUR))
        codes[row, values] = np.arange(levels)
        for kept in range(5):
            far = np.abs(values - wanted[:, None]) + 1000 * (values >> 8 - kept != wanted[:, None] >> 8 - kept)
            rounded[row, kept] = values[far.argmin(1)]
    return rounded, codes


def _hash(seed: int) -> int:
    """Mixes the bits of a partition's number (the specification's `hash52`)."""
    word = np.array(seed, np.uint32)
    word ^= word >> 15
    word -= word << 17
    word += word << 7
    word += word << 4
    word ^= word >> 5
    word += word << 16
    word ^= word >> 7
    word ^= word >> 3
    word ^= word << 6
    word ^= word >> 17
    return int(word)


def _mask(number: int) -> int:
    """Returns the texels on the second line of a partition, one bit per texel."""
    seed = number + 1024
    word = _hash(seed)
    near = 4 if seed & 2 else 5
    shifts = (near, 5) if seed & 1 else (5, near)
    a, b, c, d = ((word >> 4 * i & 15) ** 2 >> shifts[i % 2] for i in range(4))
    mask = 0
    for texel in range(16):
        y, x = divmod(texel, 4)
        first, second = (2 * (p * x + q * y) + (word >> shift) & 63 for p, q, shift in ((a, b, 14), (c, d, 10)))
        mask |= (first < second) << texel
    return mask


def _partitions() -> np.ndarray:
    found: dict[int, int] = {}
    for number in range(1024):
        mask = _mask(number)
        if mask and mask != 0xFFFF and mask ^ 0xFFFF not in found:
            found.setdefault(mask, number)
    return np.array([*found.items()], np.int32)


def _tables() -> dict[str, np.ndarray]:
    shares, weight_codes = _weights()
    rounded, byte_codes = _bytes()
    return {
        "modes": _modes(),
        "ranges": np.array([(base, bits) for _, base, bits in _RANGES], np.int32),
        "shares": shares,
        "weight_codes": weight_codes,
        "rounded": rounded,
        "byte_codes": byte_codes,
        "heads": np.array([[shift, number] for _, shift, number, _, _ in _LAYOUTS], np.int32),
        "layouts": _layouts(),
        "groups": _groups(),
        "partitions": _partitions(),
    }


TABLES = _tables()
"""The tables of `wlm_kernels.astc.Tables`, int32, by name."""
