"""Decodes light probes from principal components, one thread per number. Reference: `tests/reference/components.py`."""

import warp as wp


@wp.kernel(enable_backward=False)
def _decode_components(
    # in:
    code: wp.array2d[wp.uint8],
    bounds: wp.array2d[float],
    basis: wp.array2d[wp.float16],
    row: wp.array1d[int],
    numbers: wp.array1d[int],
    ambient: int,
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
    if d < ambient:
        total = wp.max(total, 0.0)
    out[i, d] = total


def decode_components(
    code: wp.array,
    bounds: wp.array,
    basis: wp.array,
    row: wp.array,
    numbers: wp.array,
    ambient: int,
    out: wp.array,
) -> None:
    """Decodes light probes to their D numbers (light coefficients).

    Args:
        code: uint8 [V, 1 + K], for each of V probes the codes of its magnitude and of its K coefficients.
        bounds: float [2, 1 + K], for each column of `code` the value of code 0 and the step between codes.
        basis: float16 [K, D], the principal components; empty: the coefficients are the probe's numbers, K = D.
        row: int [N], row of each probe in `code`; -1 for a dead probe (without light), which decodes to 0.
        numbers: int [M], indices of the probes to decode, below N.
        ambient: Number of the first numbers of a probe that are clamped at 0.
        out: float [M, D], the probes' numbers, written.
    """
    inputs = [code, bounds, basis, row, numbers, ambient]
    wp.launch(_decode_components, out.shape, inputs=inputs, outputs=[out], device=out.device)
