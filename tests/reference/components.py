"""The decode of principal components, number by number."""

import math

import numpy as np


def decode(code: np.ndarray, bounds: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Decodes live probes.

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
        result.append([math.exp(magnitude) * value for value in sums])
    return np.array(result)
