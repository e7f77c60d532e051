"""The decode of principal components, number by number."""

import math

import numpy as np


def decode(code: np.ndarray, bounds: np.ndarray, basis: np.ndarray, ambient: int) -> np.ndarray:
    """Decodes live probes.

    Args:
        code: uint8 [V, 2 + K], cluster, and codes of the magnitude's logarithm and of the coefficients.
        bounds: float16 [2, C, 1 + K], lowest value and step of each column but the first.
        basis: float16 [C K, D]; empty where the directions are the unit vectors, K = D.
        ambient: Number of the first numbers of a probe that are clamped at 0.

    Returns:
        float64 [V, D].
    """
    low, step = bounds.astype(np.float64).tolist()
    count = code.shape[1] - 2
    rows = basis.astype(np.float64).tolist() or np.eye(count).tolist()
    result = []
    for cluster, *codes in code.tolist():
        numbers = zip(low[cluster], step[cluster], codes, strict=True)
        magnitude, *coefficients = (first + unit * c for first, unit, c in numbers)
        own = rows[cluster * count : (cluster + 1) * count]
        sums = [math.fsum(c * row[d] for c, row in zip(coefficients, own, strict=True)) for d in range(len(own[0]))]
        values = [math.exp(magnitude) * value for value in sums]
        result.append([max(value, 0.0) for value in values[:ambient]] + values[ambient:])
    return np.array(result)
