"""SH evaluation against quadrature, SciPy's complex harmonics and light whose irradiance is known."""

import numpy as np
import pytest
from scipy.special import eval_legendre, sph_harm_y

from wlm.probe.sphere import (
    basis,
    coefficient_bands,
    cosine_factor,
    fibonacci_sphere,
    irradiance,
    sh_count,
)

RNG = np.random.default_rng(5)


def unit(count):
    vectors = RNG.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def quadrature(order):
    """Directions and weights that integrate polynomials up to 2 * order - 1 exactly."""
    z, weight = np.polynomial.legendre.leggauss(order)
    phi = np.arange(2 * order) * np.pi / order
    z, phi = (grid.ravel() for grid in np.meshgrid(z, phi, indexing="ij"))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(phi), ring * np.sin(phi), z], 1), np.repeat(weight * np.pi / order, 2 * order)


def test_the_order_and_the_signs_are_canonical():
    x, y, z = d = unit(20).T
    values = basis(d.T, 9)
    named = [np.ones(20), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    published = [0.282095, 0.488603, 0.488603, 0.488603, 1.092548, 1.092548, 0.315392, 1.092548, 0.546274]
    for column, (shape, factor) in enumerate(zip(named, published, strict=True)):
        np.testing.assert_allclose(values[:, column], factor * shape, atol=2e-6)


def test_the_basis_is_orthonormal():
    directions, weights = quadrature(16)
    values = basis(directions, 121)
    np.testing.assert_allclose((values * weights[:, None]).T @ values, np.eye(121), atol=1e-12)


def test_the_basis_equals_that_of_scipy():
    directions = unit(40)
    values = basis(directions, 25)
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    for band in range(5):
        for m in range(-band, band + 1):
            # SciPy's has the Condon-Shortley phase.
            value = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m
            real = value.real if m >= 0 else value.imag
            expected = real * (1 if m == 0 else np.sqrt(2))
            np.testing.assert_allclose(values[:, band * band + band + m], expected, atol=1e-13)


def test_the_poles_are_finite():
    poles = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    values = basis(poles, 25)
    # Only m = 0 is left there, with sqrt((2l + 1) / 4 pi).
    expected = np.zeros((2, 25))
    for band in range(5):
        expected[:, band * band + band] = np.sqrt((2 * band + 1) / (4 * np.pi)) * np.array([1, (-1) ** band])
    np.testing.assert_allclose(values, expected, atol=1e-15)


def test_radiance_of_projected_light_is_that_light():
    directions, weights = quadrature(8)
    light = 1.0 + directions[:, 1] * directions[:, 2] - 0.5 * directions[:, 0]  # in L2
    values = (basis(directions, 9) * weights[:, None]).T @ np.stack([light, 2 * light, 0 * light], 1)
    there = unit(15)
    again = 1.0 + there[:, 1] * there[:, 2] - 0.5 * there[:, 0]
    np.testing.assert_allclose(basis(there, 9) @ values, np.stack([again, 2 * again, 0 * again], 1), atol=1e-12)


@pytest.mark.parametrize("band", range(9))
def test_cosine_factors_are_the_integrals_of_the_cosine(band):
    z, weight = np.polynomial.legendre.leggauss(20)
    z, weight = (z + 1) / 2, weight / 2  # from 0 to 1
    expected = 2 * np.pi * np.sum(weight * z * eval_legendre(band, z))
    assert cosine_factor(band) == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16, 25])
def test_constant_light_gives_pi_times_its_radiance(coefficients):
    values = np.zeros((coefficients, 3))
    values[0] = np.array([1.0, 2.0, 0.5]) * np.sqrt(4 * np.pi)
    np.testing.assert_allclose(irradiance(values, unit(10)), np.pi * np.tile([1.0, 2.0, 0.5], (10, 1)), rtol=1e-12)


@pytest.mark.parametrize(("coefficients", "within"), [(4, 0.25), (9, 0.094), (25, 0.059), (121, 0.028)])
def test_a_far_light_gives_the_clamped_cosine(coefficients, within):
    towards, normals = unit(1), unit(200)
    # The coefficients of a point light are the basis itself; the series comes closer with every even band.
    values = np.repeat(basis(towards, coefficients)[0][:, None], 3, axis=1)
    error = irradiance(values, normals) - np.maximum(normals @ towards[0], 0.0)[:, None]
    # The largest errors of these series, at the terminator or at the pole.
    assert within / 2 < np.abs(error).max() < 1.01 * within


def test_many_probes_at_once():
    values, normals = RNG.normal(size=(4, 5, 9, 3)).astype(np.float32), unit(6)
    light = irradiance(values, normals)
    assert light.shape == (4, 5, 6, 3) and light.dtype == np.float64
    np.testing.assert_allclose(light[2, 3], irradiance(values[2, 3], normals), rtol=1e-12)
    assert irradiance(values[:0], normals).shape == (0, 5, 6, 3)


def test_fibonacci_directions_are_even():
    directions = fibonacci_sphere(32)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-12)
    assert np.abs(directions.mean(0)).max() < 0.02
    nearest = np.sort(directions @ directions.T, axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).min() > 20.0  # 39 degrees were it a perfect packing
    assert fibonacci_sphere(1).tolist() == [[1.0, 0.0, 0.0]]


def test_which_numbers_are_bands():
    assert [sh_count(outputs) for outputs in (3, 12, 27, 48, 75)] == [1, 4, 9, 16, 25]
    assert [sh_count(outputs) for outputs in (0, 1, 2, 6, 9, 26, 28)] == [None] * 7
    assert coefficient_bands(9).tolist() == [0, 1, 1, 1, 2, 2, 2, 2, 2]


def test_wrong_use_is_refused():
    for wrong in (0, 2, 8, -1):
        with pytest.raises(ValueError, match="whole bands"):
            basis(unit(1), wrong)
    for wrong in (np.zeros((1, 3)), np.full((1, 3), np.nan), 2 * unit(1)):
        with pytest.raises(ValueError, match="unit length"):
            basis(wrong, 4)
    with pytest.raises(ValueError, match=r"\[M, 3\]"):
        basis(np.ones(3), 4)
    with pytest.raises(ValueError, match=r"\[..., C, 3\]"):
        irradiance(np.zeros(27), unit(1))
