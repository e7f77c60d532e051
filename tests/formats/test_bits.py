"""Integers of a few bits: against a packing of one bit after another."""

import numpy as np
import pytest

from wlm.formats.bits import pack_bits, unpack_bits

SEVERAL = [(3, [4, 5]), (7, [16, 16, 16, *[10] * 16]), (5, [11] * 9), (64, [1, 2, 3, 16]), (0, [3, 16])]


def pack_slowly(values, widths):
    """One bit after another, through Python's integers."""
    number, at = 0, 0
    for row in values.tolist():
        for value, width in zip(row, widths, strict=True):
            number |= value << at
            at += int(width)
    return list(number.to_bytes(-(-at // 8), "little"))


@pytest.mark.parametrize(("count", "widths"), [*SEVERAL, *((77, [bits]) for bits in range(17))], ids=str)
def test_against_a_slow_packing(count, widths):
    rng = np.random.default_rng(count)
    random = rng.integers(0, 2**16, (count, len(widths))) % 2 ** np.array(widths)
    largest = np.broadcast_to(2 ** np.array(widths) - 1, random.shape)
    for values in (random, random.astype(np.uint16), np.zeros_like(random), largest):
        packed = pack_bits(values, widths)
        assert packed.dtype == np.uint8 and packed.tolist() == pack_slowly(values, widths)
        back = unpack_bits(packed, widths, count)
        assert back.dtype == np.uint16
        np.testing.assert_array_equal(back, values)


def test_bits_that_do_not_fit():
    with pytest.raises(ValueError, match="exceeds the bit width"):
        pack_bits(np.array([[3, 8]], np.uint16), np.array([2, 3]))
    for length in (1, 3):
        with pytest.raises(ValueError, match=f"expected the bytes of 2 rows of 5 bits, found {length} bytes"):
            unpack_bits(np.zeros(length, np.uint8), np.array([2, 3]), 2)
