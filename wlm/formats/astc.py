"""Blocks of ASTC HDR with 4 x 4 texels: tables for the part of the format that `wlm_kernels.astc` writes.

A block of 128 bits stores one line in colour space, or two lines and the number of the partition that assigns texels to
them. A line has two ends of 12 bits per channel, on a scale that is roughly the logarithm of light, which are packed
into bytes in one of several layouts. From the lowest bit, a block contains the block mode, the partition, the endpoint
mode, and the bytes, each rounded to one of as many numbers as the other bits leave room for; the texels' weights start
at the highest bit and grow downwards.

Khronos' Data Format Specification 1.4, chapter "ASTC Compressed Texture Image Formats", specifies the format.
"""

import numpy as np

# The modes in which blocks are stored: lines, endpoint mode, and the sizes of the ranges of weights and of bytes, each
# a power of two or three times one. The format fixes the last size: it is the largest for which there is room.
_MODES = (
    (1, 11, 12, 256), (1, 11, 16, 192), (1, 11, 24, 64), (1, 7, 32, 192), (2, 7, 4, 256), (2, 7, 6, 128),
    (2, 7, 12, 32), (2, 11, 3, 64), (2, 11, 6, 24),
)  # fmt: skip
_WEIGHTS = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32)  # the format's ranges of weights

# For ranges with trits, by the range and the bits of its values: the trit's factor, and the pattern of the low bits.
_TRITS = {
    (24, 8): (44, "cb000cbcb"), (96, 8): (11, "edcb000ed"), (192, 8): (5, "fedcb000f"),
    (6, 6): (50, "0000000"), (12, 6): (23, "b000b0b"), (24, 6): (11, "cb000cb"),
}  # fmt: skip

# The layouts of a line's ends: endpoint mode, shift from the fields to 12 bits, number, factor of the largest channel's
# number in the header h, and the bytes. A byte has the low bits of its field; "c7:h0,a8" is a byte of field c, of 7
# bits, with bit 0 of h and bit 8 of a above them. The fields are the largest channel a of the brighter end, what is
# below it in the others (g, b), in the darker end (c), and what is further below in the darker end's others (d, e, with
# a sign). Endpoint mode 7 has no d and e: all channels of the darker end are below by c.
_FIELDS = "agbcdeh"
_LAYOUTS = (
    (11, 0, 7, 8, "a12: c7:h0,a8 g6:h1,a9 b6:h2,a10 d6:h3,a11,d5 e6:h4,c6,e5"),
    (11, 0, 6, 8, "a12: c7:h0,a8 g7:h1,g6 b7:h2,b6 d5:h3,a11,a9 e5:h4,c6,a10"),
    (11, 1, 5, 8, "a11: c8:h0,a8 g6:h1,a9 b6:h2,a10 d6:h3,c7,d5 e6:h4,c6,e5"),
    (11, 1, 4, 8, "a11: c6:h0,a8 g8:h1,g6 b8:h2,b6 d5:h3,g7,a9 e5:h4,b7,a10"),
    (11, 2, 3, 8, "a10: c7:h0,a8 g7:h1,g6 b7:h2,b6 d6:h3,a9,d5 e6:h4,c6,e5"),
    (11, 2, 2, 8, "a10: c7:h0,a8 g6:h1,a9 b6:h2,c6 d7:h3,d6,d5 e7:h4,e6,e5"),
    (11, 3, 0, 8, "a9: c6:h0,a8 g7:h1,g6 b7:h2,b6 d7:h3,d6,d5 e7:h4,e6,e5"),
    (11, 3, 1, 8, "a9: c6:h0,a8 g8:h1,g6 b8:h2,b6 d6:h3,g7,d5 e6:h4,b7,e5"),
    (7, 1, 0, 4, "a11:h1,h0 g5:h2,a9,a8 b5:h3,a7,a10 c7:a6,c6,c5"),
    (7, 1, 1, 4, "a11:h1,h0 g6:h2,a8,g5 b6:h3,a7,b5 c5:a6,a10,a9"),
    (7, 2, 2, 4, "a10:h1,h0 g5:h2,a9,a8 b5:h3,a7,a6 c8:c7,c6,c5"),
    (7, 3, 3, 4, "a9:h1,h0 g6:h2,a8,g5 b6:h3,a7,b5 c7:a6,c6,c5"),
    (7, 4, 12, 1, "a8:h1,h0 g7:h2,g6,g5 b7:h3,b6,b5 c6:a6,a7,c5"),
)


def _range(levels: int) -> tuple[int, int]:
    """Returns 1 or 3, and the power of two by which it is multiplied."""
    base = 3 if levels % 3 == 0 else 1
    return base, (levels // base).bit_length() - 1


def _values(levels: int, width: int) -> list[int]:
    """Returns the value of `width` bits of each stored number of a range."""
    base, bits = _range(levels)
    if levels == 3:
        return [0, 32, 63]
    if base == 1:
        return [int(f"{number:0{bits}b}" * width, 2) >> (bits - 1) * width for number in range(levels)]
    factor, pattern = _TRITS[levels, width]
    values = []
    for number in range(levels):
        trit, low = divmod(number, 1 << bits)
        mixed = int("".join("0" if each == "0" else str(low >> "abcdef".index(each) & 1) for each in pattern), 2)
        flip = (2 << width) - 1 if low & 1 else 0
        values.append(flip & 1 << width - 1 | (trit * factor + mixed ^ flip) >> 2)
    return values


def _modes() -> dict[str, np.ndarray]:
    """Returns the tables with a row for each mode."""
    rows, wanted = len(_MODES), np.arange(256)[:, None]
    modes, shares, weight_codes = (np.zeros((rows, columns), np.int32) for columns in (8, 32, 32))
    rounded, byte_codes = np.zeros((rows, 5, 256), np.int32), np.zeros((rows, 256), np.int32)
    for row, (lines, kind, weights, levels) in enumerate(_MODES):
        fine, rho = divmod(_WEIGHTS.index(weights), 6)
        # The grid of weights has 4 columns (bits 7 and 8: 0) and 4 rows (bits 5 and 6: 2).
        block_mode = rho + 2 >> 1 | (rho & 1) << 4 | 2 << 5 | fine << 9 | lines - 1 << 11
        modes[row] = lines, kind, block_mode, weights, *_range(weights), *_range(levels)
        values = np.array(_values(weights, 6))
        weight_codes[row, :weights] = order = np.argsort(values)
        shares[row, :weights] = values[order] + (values[order] > 32)
        values = np.array(_values(levels, 8))
        byte_codes[row, values] = np.arange(levels)
        for kept in range(5):
            far = np.abs(values - wanted) + 1000 * (values >> 8 - kept != wanted >> 8 - kept)
            rounded[row, kept] = values[far.argmin(1)]
    names = ("modes", "shares", "weight_codes", "rounded", "byte_codes")
    return dict(zip(names, (modes, shares, weight_codes, rounded, byte_codes), strict=True))


def _layouts() -> np.ndarray:
    table = np.zeros((len(_LAYOUTS), 6, 7), np.int32)
    for row, layout in enumerate(_LAYOUTS):
        for byte, word in enumerate(layout[-1].split()):
            own, _, tops = word.partition(":")
            sources = [_FIELDS.index(top[0]) << 4 | int(top[1:]) for top in tops.split(",") if top]
            bits, signed = int(own[1:]), own[0] in "de"
            # Rounding must not change the sign, which is among the low bits of fields of 5 bits.
            kept = len(sources) + (signed and bits == 5)
            table[row, byte, : len(sources)] = sources
            table[row, byte, 3:] = len(sources), kept, _FIELDS.index(own[0]), (1 << bits - signed) - 1
    return table


def _groups() -> np.ndarray:
    """Returns the bits of five trits by the trits as a number, the first the lowest. Of several codes it is the least,
    since a group that is cut off at its end is filled up with zeros."""
    table = np.zeros(243, np.int32)
    for code in reversed(range(256)):
        rest, t3, t4 = code & 31, code >> 5 & 3, code >> 7
        if code >> 2 & 7 == 7:
            rest, t3, t4 = code >> 5 << 2 | code & 3, 2, 2
        elif t3 == 3:
            t3, t4 = t4, 2
        t0, t1, t2 = rest & 3, rest >> 2 & 3, rest >> 4
        if t0 == 3:
            t0, t1, t2 = t1, t2, 2
        elif t1 == 3:
            t1, t2 = 2, 2
        table[min(t0, 2) + 3 * t1 + 9 * t2 + 27 * t3 + 81 * t4] = code
    return table


def _partitions() -> np.ndarray:
    """Returns the different divisions of a block by two lines."""
    seed = np.arange(1024, 2048, dtype=np.uint32)
    word = seed ^ seed >> 15
    word -= word << 17
    word += word << 7
    word += word << 4
    word ^= word >> 5
    word += word << 16
    word ^= word >> 7
    word ^= word >> 3
    word ^= word << 6
    word ^= word >> 17
    near = np.where(seed & 2, 4, 5)
    shifts = np.where(seed & 1, near, 5), np.where(seed & 1, 5, near)
    slopes = [((word >> 4 * i & 15) ** 2 >> shifts[i % 2])[:, None] for i in range(4)]
    y, x = np.divmod(2 * np.arange(16), 8) * np.array([[2], [1]])
    first = slopes[0] * x + slopes[1] * y + (word >> 14)[:, None] & 63
    second = slopes[2] * x + slopes[3] * y + (word >> 10)[:, None] & 63
    masks = (first < second) @ (1 << np.arange(16))
    found: dict[int, int] = {}
    for number, mask in enumerate(masks.tolist()):
        if 0 < mask < 0xFFFF and mask ^ 0xFFFF not in found:
            found.setdefault(mask, number)
    return np.array([*found.items()], np.int32)


TABLES = _modes() | {
    "heads": np.array([layout[1:4] for layout in _LAYOUTS], np.int32),
    "layouts": _layouts(),
    "groups": _groups(),
    "partitions": _partitions(),
}
"""The tables of `wlm_kernels.astc.Tables`, int32, by name."""
