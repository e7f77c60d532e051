"""The decode of principal components, number by number."""

import math

import numpy as np


def decode(code: np.ndarray, bounds: np.ndarray, basis: np.ndarray, ambient: int) -> np.ndarray:
    """Decodes live probes; the first `ambient` numbers of each are clamped at 0.

    Args:
        code: uint8 [V, 1 + K].
        bounds: float16 [2, 1 + K], lowest value and step of each column.
        basis: float16 [K, D]; empty where the directions are the unit vectors, K = D.

    Returns:
        float64 [V, D].
    """
    low, step = bounds.astype(np.float64).tolist()
    rows = basis.astype(np.float64).tolist() or np.eye(code.shape[1] - 1).tolist()
    result = []
    for codes in code.tolist():
        magnitude, *coefficients = (first + unit * c for first, unit, c in zip(low, step, codes, strict=True))
        sums = [math.fsum(c * row[d] for c, row in zip(coefficients, rows, strict=True)) for d in range(len(rows[0]))]
        light = [math.exp(magnitude) * value for value in sums]
        result.append([max(value, 0.0) if d < ambient else value for d, value in enumerate(light)])
    return np.array(result)
