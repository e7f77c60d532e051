"""Spherical harmonics (SH) on the sphere of directions: the basis and the irradiance.

The convention of this package is the orthonormal real basis, band by band, within a band from m = -l to l, all signs
plus (no Condon-Shortley phase): 1, y, z, x, xy, yz, 3z²-1, xz, x²-y², ... times positive constants. A probe's
coefficients are those of the incoming radiance (gaussian-probe-compression, eq. 1), in the axes of the scene.
"""

import math

import numpy as np

_UNIT_TOLERANCE = 1e-3  # for a direction's length; float16 normals are within 6e-4


def sh_count(outputs: int) -> int | None:
    """Returns the number C of SH coefficients in RGB of a probe with `outputs` numbers; None for incomplete bands."""
    count = outputs // 3
    return count if count > 0 and outputs == 3 * count and math.isqrt(count) ** 2 == count else None


def ambient_numbers(outputs: int) -> int:
    """Returns how many of a probe's first numbers are ambient light, which is never negative: 3 if a probe with
    `outputs` numbers holds spherical harmonics, else 0."""
    return 0 if sh_count(outputs) is None else 3


def coefficient_bands(coefficients: int) -> np.ndarray:
    """Returns the band l of each coefficient, int64 [C]: 0, 1, 1, 1, 2, ... Raises a ValueError if C is not the square
    of a positive number."""
    if coefficients < 1 or math.isqrt(coefficients) ** 2 != coefficients:
        raise ValueError(f"coefficients: expected whole bands (1, 4, 9, 16, ...), got {coefficients}")
    order = np.arange(math.isqrt(coefficients))
    return np.repeat(order, 2 * order + 1)


def cosine_factor(band: int) -> float:
    """Returns the factor by which convolution with a clamped cosine multiplies a band: pi, 2 pi/3, pi/4, 0, -pi/24, 0,
    ... Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance Environment Maps, 2001, eq. 8. Odd bands
    above the first do not contribute to diffuse surfaces."""
    if band == 1:
        return 2.0 * math.pi / 3.0
    if band % 2:
        return 0.0
    half = band // 2
    return math.pi * (-1.0) ** (half + 1) * 2.0 / ((band + 2) * (band - 1)) * math.comb(band, half) / 2.0**band


def basis(directions: np.ndarray, coefficients: int) -> np.ndarray:
    """Evaluates the SH basis in M directions.

    Args:
        directions: [M, 3], of unit length.
        coefficients: C, the square of the number of bands.

    Returns:
        float64 [M, C], exact to rounding for any number of bands: each column is a polynomial in x, y, z from the
        three-term recurrence of the normalised Legendre functions.

    Raises:
        ValueError: The shape is different, a length is not 1, or C is not a square.
    """
    directions = np.asarray(directions, np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions: expected [M, 3], got {directions.shape}")
    if not (np.abs(np.linalg.norm(directions, axis=1) - 1.0) <= _UNIT_TOLERANCE).all():
        raise ValueError("directions: expected vectors of unit length, got others")
    order = int(coefficient_bands(coefficients)[-1]) + 1
    z = directions[:, 2]
    turned = np.ones(len(z), np.complex128)  # (x + iy)^m: sin^m theta with the cosine and the sine of m phi
    result = np.empty((len(z), coefficients))
    start = math.sqrt(0.25 / math.pi)  # value of band m, order m
    for m in range(order):
        if m > 0:
            turned = turned * (directions[:, 0] + 1j * directions[:, 1])
            start *= math.sqrt((2 * m + 1) / (2 * m))
        before, legendre = np.zeros_like(z), np.full_like(z, start)
        for band in range(m, order):
            if band > m:
                low = ((band - 1) ** 2 - m * m) / (4 * (band - 1) ** 2 - 1)
                factor = math.sqrt((4 * band * band - 1) / (band * band - m * m))
                before, legendre = legendre, factor * (z * legendre - math.sqrt(low) * before)
            middle = band * band + band
            if m == 0:
                result[:, middle] = legendre
            else:
                result[:, middle + m] = math.sqrt(2.0) * legendre * turned.real
                result[:, middle - m] = math.sqrt(2.0) * legendre * turned.imag
    return result


def irradiance(values: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the irradiance of surfaces at a probe; divided by pi, it is the radiance of a white diffuse surface.
    `values` are SH coefficients of radiance, [..., C, 3]; `normals` have unit length, [M, 3]. The result is float64
    [..., M, 3], pi times the radiance if that is constant. Few bands ring below 0: clamp what is shown. Raises a
    ValueError if a shape is different, a normal's length is not 1, or C is not a square."""
    values = np.asarray(values, np.float64)
    if values.ndim < 2 or values.shape[-1] != 3:
        raise ValueError(f"values: expected [..., C, 3], got {values.shape}")
    return irradiance_weights(normals, values.shape[-2]) @ values


def irradiance_weights(normals: np.ndarray, coefficients: int) -> np.ndarray:
    """Returns the factors, float64 [M, C], by which SH of radiance add up to the irradiance at M unit normals."""
    return basis(normals, coefficients) * [cosine_factor(int(band)) for band in coefficient_bands(coefficients)]


def unit_or_zero(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors [M, 3] of any finite length with length 1, float64; vectors of length 0 stay 0."""
    for order in (np.inf, 2):  # squares of very long or short vectors would not fit float64
        length = np.linalg.norm(vectors, order, axis=1, keepdims=True)
        vectors = vectors / np.where(length > 0, length, 1.0)
    return vectors


def fibonacci_sphere(count: int) -> np.ndarray:
    """Returns evenly spaced directions, float64 [count, 3]: a spiral with the golden angle around z."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    phi = np.arange(count) * (math.pi * (3.0 - math.sqrt(5.0)))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)
