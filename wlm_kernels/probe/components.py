"""Decodes light probes from principal components, one thread per number. Reference: `tests/reference/components.py`."""

from typing import Any

import warp as wp

GROUP = wp.constant(64)
"""Probes that share the place of their first bit."""


@wp.func
def _code(words: wp.array1d[wp.uint32], bit: wp.uint32, width: int) -> int:
    """Reads an integer of some bits, fewer than 32, at any place."""
    if width == 0:
        return 0
    word = int(bit >> wp.uint32(5))
    shift = int(bit & wp.uint32(31))
    code = words[word] >> wp.uint32(shift)
    if shift + width > 32:
        code = code | (words[word + 1] << wp.uint32(32 - shift))
    return int(code & ((wp.uint32(1) << wp.uint32(width)) - wp.uint32(1)))


@wp.kernel(enable_backward=False)
def _decode_components(
    # in:
    group: wp.array1d[wp.uint32],
    index: wp.array1d[wp.uint32],
    index_bits: int,
    codes: wp.array1d[wp.uint32],
    cluster: wp.array1d[wp.vec2i],
    width: wp.array1d[wp.uint8],
    bounds: wp.array1d[wp.vec2],
    basis: wp.array2d[Any],
    unit: float,
    row: wp.array1d[int],
    numbers: wp.array1d[int],
    ambient: int,
    # out:
    out: wp.array2d[float],
):
    i, d = wp.tid()
    probe = int(-1)
    if numbers[i] >= 0:
        probe = row[numbers[i]]
    total = float(0.0)
    if probe >= 0:
        # From the nearer end of the group.
        place = probe % GROUP
        half = place / (GROUP / 2)
        bit = group[probe / GROUP + half]
        begin = probe - place + half * place
        for other in range(begin, begin + wp.where(half == 0, place, GROUP - place)):
            bits = cluster[_code(index, wp.uint32(other * index_bits), index_bits)][1]
            bit += wp.uint32(wp.where(half == 0, bits, -bits))
        own = _code(index, wp.uint32(probe * index_bits), index_bits)
        first = cluster[own][0]
        last = cluster[own + 1][0]
        bits = int(width[first])
        logarithm = bounds[first][0] + bounds[first][1] * float(_code(codes, bit, bits))
        bit += wp.uint32(bits)
        if basis.shape[0] == 0:
            for k in range(first + 1, first + 1 + d):
                bit += wp.uint32(width[k])
            k = first + 1 + d
            total = bounds[k][0] + bounds[k][1] * float(_code(codes, bit, int(width[k])))
        else:
            for k in range(first + 1, last):
                bits = int(width[k])
                coefficient = bounds[k][0] + bounds[k][1] * float(_code(codes, bit, bits))
                total += coefficient * unit * float(basis[k - own - 1, d])
                bit += wp.uint32(bits)
        total *= wp.exp(logarithm)
    if d < ambient:
        total = wp.max(total, 0.0)
    out[i, d] = total


def decode_components(
    group: wp.array,
    index: wp.array,
    index_bits: int,
    codes: wp.array,
    cluster: wp.array,
    width: wp.array,
    bounds: wp.array,
    basis: wp.array,
    unit: float,
    row: wp.array,
    numbers: wp.array,
    ambient: int,
    out: wp.array,
) -> None:
    """Decodes light probes to their D numbers (light coefficients).

    Args:
        group: uint32 [ceil(V / GROUP) + 1], first bit of each group of probes in `codes`, and the end of the last one.
        index: uint32 words, the clusters of V probes, of `index_bits` bits each, and 0 up to the end of the last group.
        index_bits: Bits of a cluster's number.
        codes: uint32 words, the bits of V probes one after another, from the lowest bit of a word: for each probe the
            code of its magnitude, and those of its coefficients.
        cluster: vec2i [C + 1], for each of C clusters its first row in the arrays below, and the bits of its probes.
        width: uint8 [Q], bits of each code of a cluster: first of the magnitude, then of each coefficient.
        bounds: vec2 [Q], the value of code 0 of the magnitude's logarithm and of each coefficient, and the step between
            codes.
        basis: int8 or float16 [Q - C, D], the direction of each coefficient, cluster after cluster; empty: the
            coefficients are the probe's numbers.
        unit: Value of 1 in `basis`.
        row: int [N], place of each probe in `codes`; -1 for a dead probe (without light), which decodes to 0.
        numbers: int [M], indices of the probes to decode, below N; -1 decodes to 0.
        ambient: Number of the first numbers of a probe that are clamped at 0.
        out: float [M, D], the probes' numbers, written.
    """
    inputs = [group, index, index_bits, codes, cluster, width, bounds, basis, unit, row, numbers, ambient]
    wp.launch(_decode_components, out.shape, inputs=inputs, outputs=[out], device=out.device)
