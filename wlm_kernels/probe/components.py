"""Decodes light probes from principal components, one thread per number. Reference: `tests/reference/components.py`."""

import warp as wp


@wp.func
def _code(codes: wp.array1d[wp.uint32], probe: int, bits: int, place: wp.vec2i) -> int:
    """Reads a code of a probe that has `bits` bits; `place` is the first bit and the width of the code."""
    if place[1] == 0:
        return 0
    # The bits of 32 probes end with a word.
    bit = probe % 32 * bits + place[0]
    word = probe / 32 * bits + bit / 32
    shift = bit % 32
    code = codes[word] >> wp.uint32(shift)
    if shift + place[1] > 32:
        code = code | (codes[word + 1] << wp.uint32(32 - shift))
    return int(code & ((wp.uint32(1) << wp.uint32(place[1])) - wp.uint32(1)))


@wp.kernel(enable_backward=False)
def _decode_components(
    # in:
    codes: wp.array1d[wp.uint32],
    place: wp.array1d[wp.vec2i],
    bounds: wp.array2d[wp.vec2],
    basis: wp.array2d[wp.float16],
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
        count = bounds.shape[1] - 1
        last = place[count + 1]
        bits = last[0] + last[1]
        cluster = _code(codes, probe, bits, place[0])
        if basis.shape[0] == 0:
            limits = bounds[cluster, 1 + d]
            total = limits[0] + limits[1] * float(_code(codes, probe, bits, place[2 + d]))
        else:
            for k in range(count):
                limits = bounds[cluster, 1 + k]
                coefficient = limits[0] + limits[1] * float(_code(codes, probe, bits, place[2 + k]))
                total += coefficient * float(basis[cluster * count + k, d])
        scale = bounds[cluster, 0]
        total *= wp.exp(scale[0] + scale[1] * float(_code(codes, probe, bits, place[1])))
    if d < ambient:
        total = wp.max(total, 0.0)
    out[i, d] = total


def decode_components(
    codes: wp.array,
    place: wp.array,
    bounds: wp.array,
    basis: wp.array,
    row: wp.array,
    numbers: wp.array,
    ambient: int,
    out: wp.array,
) -> None:
    """Decodes light probes to their D numbers (light coefficients).

    Args:
        codes: uint32 words, the bits of V probes one after another, from the lowest bit of a word: for each probe its
            cluster, and the codes of its magnitude and of its K coefficients.
        place: vec2i [2 + K], first bit of each of these in the bits of a probe, and its number of bits.
        bounds: vec2 [C, 1 + K], for each of C clusters the value of code 0 of the magnitude's logarithm and of each
            coefficient, and the step between codes.
        basis: float16 [C K, D], the directions of each cluster; empty: the coefficients are the probe's numbers, K = D.
        row: int [N], place of each probe in `codes`; -1 for a dead probe (without light), which decodes to 0.
        numbers: int [M], indices of the probes to decode, below N; -1 decodes to 0.
        ambient: Number of the first numbers of a probe that are clamped at 0.
        out: float [M, D], the probes' numbers, written.
    """
    inputs = [codes, place, bounds, basis, row, numbers, ambient]
    wp.launch(_decode_components, out.shape, inputs=inputs, outputs=[out], device=out.device)
