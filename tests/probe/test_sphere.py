"""Spherical harmonics against quadrature, SciPy and known light, and the conventions of the engines."""

import math

import numpy as np
import pytest
from builders.checks import misuse_of
from scipy.special import sph_harm_y

from wlm.errors import WlmError
from wlm.probe.conventions import CANONICAL, CONVENTIONS, from_canonical, to_canonical
from wlm.probe.sphere import basis, coefficient_bands, irradiance, sh_count

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


def test_the_basis_equals_that_of_scipy():
    directions = np.concatenate([unit(40), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    values = basis(directions, 25)
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    for band in range(5):
        for m in range(-band, band + 1):
            # SciPy's has the Condon-Shortley phase.
            value = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m
            real = value.real if m >= 0 else value.imag
            expected = real * (1 if m == 0 else np.sqrt(2))
            np.testing.assert_allclose(values[:, band * band + band + m], expected, atol=1e-13)


@pytest.mark.parametrize(("coefficients", "within"), [(4, 0.25), (9, 0.094), (25, 0.059), (121, 0.028)])
def test_a_far_light_gives_the_clamped_cosine(coefficients, within):
    towards, normals = unit(1), unit(200)
    # The coefficients of a point light are the basis itself; the series comes closer with every even band.
    values = np.repeat(basis(towards, coefficients)[0][:, None], 3, axis=1)
    error = irradiance(values, normals) - np.maximum(normals @ towards[0], 0.0)[:, None]
    # The largest errors of these series, at the terminator or at the pole.
    assert within / 2 < np.abs(error).max() < 1.01 * within


def test_which_numbers_are_bands():
    assert [sh_count(outputs) for outputs in (3, 12, 27, 48, 75)] == [1, 4, 9, 16, 25]
    assert [sh_count(outputs) for outputs in (0, 1, 2, 6, 9, 26, 28)] == [None] * 7
    assert coefficient_bands(9).tolist() == [0, 1, 1, 1, 2, 2, 2, 2, 2]


def test_wrong_use_is_refused():
    for wrong in (0, 2, 8, -1):
        assert "whole bands" in misuse_of(basis, unit(1), wrong)
    for wrong in (np.zeros((1, 3)), np.full((1, 3), np.nan), 2 * unit(1)):
        assert "unit length" in misuse_of(basis, wrong, 4)
    assert "[M, 3]" in misuse_of(basis, np.ones(3), 4)
    assert "[..., C, 3]" in misuse_of(irradiance, np.zeros(27), unit(1))


def light(d):
    """Radiance of a made-up surrounding, a polynomial of degree 2: [M, 3]."""
    x, y, z = d.T
    red = 1.0 + 0.3 * x - 0.5 * y + 0.7 * z + 0.2 * x * y - 0.3 * y * z + 0.4 * z * z + 0.15 * x * z - 0.25 * x * x
    return np.stack([red, 2.0 - 0.9 * y + 0.5 * x * z, 0.7 + 0.6 * z * z - 0.4 * x * y], 1)


def canonical_coefficients():
    """The light's projection onto the canonical basis, float64 [1, 9, 3] (gaussian-probe-compression, eq. 1)."""
    d, solid = quadrature(8)
    return np.einsum("m,mc,mk->ck", solid, basis(d, 9), light(d))[None]


def irradiance_over_pi(normals):
    """What a white diffuse surface reflects: [M, 3]."""
    return irradiance(canonical_coefficients()[0], normals) / np.pi


def threejs_get_at(c, d):
    x, y, z = d.T[..., None]
    return (
        0.282095 * c[0]
        + 0.488603 * (y * c[1] + z * c[2] + x * c[3])
        + 1.092548 * (x * y * c[4] + y * z * c[5] + x * z * c[7])
        + 0.315392 * (3.0 * z * z - 1.0) * c[6]
        + 0.546274 * (x * x - y * y) * c[8]
    )


def godot_shader(c, n):
    """What the ambient light of a surface gets from its lightmap probes."""
    x, y, z = n.T[..., None]
    return (
        0.886227 * c[0]
        + 1.023327 * (c[1] * y + c[2] * z + c[3] * x)
        + 0.858086 * (c[4] * x * y + c[5] * y * z + c[7] * x * z)
        + 0.247708 * c[6] * (3.0 * z * z - 1.0)
        + 0.429043 * c[8] * (x * x - y * y)
    )


def unreal_basis(d):
    x, y, z = d.T
    columns = [
        0.282095 + 0.0 * x,
        -0.488603 * y,
        0.488603 * z,
        -0.488603 * x,
        1.092548 * x * y,
        -1.092548 * y * z,
        0.315392 * (3.0 * z * z - 1.0),
        -1.092548 * x * z,
        0.546274 * (x * x - y * y),
    ]
    return np.stack(columns, 1)


def unity_shade_sh9(c, n):
    """Two dot products and a last term, from the constants that Unity uploads for a probe."""
    x, y, z = n.T[..., None]
    linear = c[3] * x + c[1] * y + c[2] * z + (c[0] - c[6])
    quadratic = c[4] * x * y + c[5] * y * z + 3.0 * c[6] * z * z + c[7] * z * x
    return linear + quadratic + c[8] * (x * x - y * y)


def test_threejs_is_canonical_and_yields_radiance():
    d = unit(64)
    coefficients = from_canonical(canonical_coefficients(), "threejs")[0]
    np.testing.assert_allclose(threejs_get_at(coefficients, d), light(d), atol=1e-5)


def test_godot_shader_yields_irradiance_over_pi():
    n = unit(20)
    coefficients = from_canonical(canonical_coefficients(), "godot")[0]
    np.testing.assert_allclose(godot_shader(coefficients, n), irradiance_over_pi(n), atol=1e-5)


def test_godot_bake_becomes_canonical():
    # The baker's estimate with evenly spread rays: 4 / rays times the sum of light times basis.
    d, solid = quadrature(8)
    share = solid / solid.sum()
    baked = 4.0 * np.einsum("m,mc,mk->ck", share, basis(d, 9), light(d))[None]
    np.testing.assert_allclose(to_canonical(baked, "godot"), canonical_coefficients(), atol=1e-12)


def test_unreal_basis_yields_radiance_and_diffuse_transfer():
    d = unit(64)
    coefficients = from_canonical(canonical_coefficients(), "unreal")[0]
    np.testing.assert_allclose(unreal_basis(d) @ coefficients, light(d), atol=1e-5)
    transfer = np.repeat([np.pi, 2.0 * np.pi / 3.0, np.pi / 4.0], [1, 3, 5])
    np.testing.assert_allclose((unreal_basis(d) * transfer) @ coefficients / np.pi, irradiance_over_pi(d), atol=1e-5)


def test_unity_evaluation_yields_irradiance_over_pi():
    n = unit(64)
    coefficients = from_canonical(canonical_coefficients(), "unity")[0]
    np.testing.assert_allclose(unity_shade_sh9(coefficients, n), irradiance_over_pi(n), atol=1e-12)


def test_unity_lights():
    # AddAmbientLight adds the colour to the first number alone.
    ambient = np.zeros((1, 9, 3))
    ambient[0, 0] = 0.2, 0.5, 0.9
    d = unit(20)
    np.testing.assert_allclose(basis(d, 9) @ to_canonical(ambient, "unity")[0], np.tile(ambient[0, 0], (20, 1)))
    # AddDirectionalLight: a far light of 16 pi / 17 shows its own colour on a surface that faces it, and its numbers
    # are colour * 16 pi / 17 * basis * (1 / 2 sqrt(pi), sqrt(3) / 3 sqrt(pi), sqrt(15) / 8 sqrt(pi), ...).
    colour, power, root = np.array([1.0, 0.6, 0.3]), 16.0 * math.pi / 17.0, math.sqrt(math.pi)
    towards = unit(5)
    for way in towards:
        shone = (power * basis(way[None], 9)[0][:, None] * colour)[None]
        stored = from_canonical(shone, "unity")
        np.testing.assert_allclose(unity_shade_sh9(stored[0], way[None])[0], colour)
        factor = [0.5, *[math.sqrt(3.0) / 3.0] * 3, *[math.sqrt(15.0) / 8.0] * 2, math.sqrt(5.0) / 16.0]
        factor = np.array([*factor, math.sqrt(15.0) / 8.0, math.sqrt(15.0) / 16.0]) / root
        expected = unreal_basis(way[None])[0] * np.array([1, -1, 1, -1, 1, -1, 1, -1, 1]) * factor
        np.testing.assert_allclose(stored[0], power * expected[:, None] * colour, atol=2e-6)


@pytest.mark.parametrize("name", CONVENTIONS)
@pytest.mark.parametrize("coefficients", [1, 4, 9])
def test_round_trip(name, coefficients):
    values = np.random.default_rng(1).normal(size=(50, coefficients, 3)).astype(np.float32)
    for first, second in ((to_canonical, from_canonical), (from_canonical, to_canonical)):
        back = second(first(values, name), name)
        assert back.dtype == np.float64
        np.testing.assert_allclose(back, values, rtol=4e-16)
        np.testing.assert_array_equal(back.astype(np.float32), values)
    if name != CANONICAL:
        assert not np.array_equal(from_canonical(values, name), values) or (name, coefficients) == ("unreal", 1)


def test_values_are_left_alone_and_nan_stays_nan():
    values = np.ones((2, 4, 3))
    values[1, 2, 0] = np.nan
    for name in CONVENTIONS:
        converted = to_canonical(values, name)
        assert np.isnan(converted).sum() == 1 and np.isnan(converted[1, 2, 0])
    converted[:] = 0.0
    assert values[0, 0, 0] == 1.0


@pytest.mark.parametrize("name", ["threejs", "godot"])
def test_higher_bands_where_a_convention_has_a_rule_for_them(name):
    values = np.ones((1, 25, 3))
    np.testing.assert_allclose(from_canonical(values, name), 1.0 if name == "threejs" else 1.0 / np.pi)


def test_errors():
    for name in ("unreal", "unity"):
        with pytest.raises(WlmError, match=rf"convention {name}: expected bands L0 to L2, got L3 \(16 coefficients\)"):
            to_canonical(np.ones((1, 16, 3)), name)
    for name in CONVENTIONS:
        for count in (2, 8):
            with pytest.raises(WlmError, match=f"convention {name}: expected 1, 4, 9 ... coefficients .* got {count}"):
                from_canonical(np.ones((1, count, 3)), name)
    with pytest.raises(WlmError, match="convention: expected threejs, godot, unreal, unity, got 'frostbite'"):
        to_canonical(np.ones((1, 9, 3)), "frostbite")
    for shape in ((9, 3), (1, 3, 9), (1, 9, 4)):
        assert "[N, C, 3]" in misuse_of(to_canonical, np.ones(shape), CANONICAL)
