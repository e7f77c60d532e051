"""The decode of principal components, number by number."""

import math

import numpy as np


def decode(
    cluster: np.ndarray, code: np.ndarray, bounds: np.ndarray, basis: np.ndarray, unit: float, ambient: int
) -> np.ndarray:
    """Decodes live probes.

    Args:
        cluster: uint8 [V], the cluster of each probe.
        code: uint16 [V, 1 + K], codes of the magnitude's logarithm and of the coefficients.
        bounds: float16 [2, C, 1 + K], lowest value and step of each column of the codes.
        basis: [C, K, D], directions in multiples of `unit`; empty where they are the unit vectors, K = D.
        ambient: Number of the first numbers of a probe that are clamped at 0.

    Returns:
        float64 [V, D].
    """
    low, step = bounds.astype(np.float64).tolist()
    rows = (basis * np.float64(unit)).tolist() or [np.eye(code.shape[1] - 1).tolist()]
    result = []
    for own, codes in zip(cluster.tolist(), code.tolist(), strict=True):
        numbers = zip(low[own], step[own], codes, strict=True)
        magnitude, *coefficients = (first + one * c for first, one, c in numbers)
        columns = zip(*rows[own], strict=True)
        sums = [math.fsum(c * number for c, number in zip(coefficients, column, strict=True)) for column in columns]
        values = [math.exp(magnitude) * value for value in sums]
        result.append([max(value, 0.0) for value in values[:ambient]] + values[ambient:])
    return np.array(result)
