"""Decodes probes from principal components, one thread per number; `wlm/probe/exact.py` is the reference."""

import warp as wp


@wp.kernel(enable_backward=False)
def _decode_components(
    # in:
    code: wp.array2d[wp.uint8],
    bounds: wp.array2d[float],
    basis: wp.array2d[wp.float16],
    row: wp.array1d[int],
    numbers: wp.array1d[int],
    # out:
    out: wp.array2d[float],
):
    i, d = wp.tid()
    probe = row[numbers[i]]
    total = float(0.0)
    if probe >= 0:
        if basis.shape[0] == 0:
            total = bounds[0, 1 + d] + bounds[1, 1 + d] * float(code[probe, 1 + d])
        for k in range(basis.shape[0]):
            coefficient = bounds[0, 1 + k] + bounds[1, 1 + k] * float(code[probe, 1 + k])
            total += coefficient * float(basis[k, d])
        total *= wp.exp(bounds[0, 0] + bounds[1, 0] * float(code[probe, 0]))
    out[i, d] = total


def decode_components(
    code: wp.array, bounds: wp.array, basis: wp.array, row: wp.array, numbers: wp.array, out: wp.array
) -> None:
    """Decodes probes to their D numbers.

    Args:
        code: uint8 [V, 1 + K], codes of magnitude and coefficients.
        bounds: float [2, 1 + K], lowest value and step of each column.
        basis: float16 [K, D]; empty for unit vectors.
        row: int [N], row of each probe in `code`; -1 for a dead probe, which decodes to zero.
        numbers: int [M], indices of probes, below N.
        out: float [M, D], written.
    """
    wp.launch(
        _decode_components, out.shape, inputs=[code, bounds, basis, row, numbers], outputs=[out], device=out.device
    )
