"""Light of black bodies, for temperatures in kelvin."""

import functools

import numpy as np
import torch

# The CIE's luminous efficiency of wavelengths from 400 to 760 nm in steps of 10 nm (1924, photopic).
_EFFICIENCY = np.array(
    [0.0004, 0.0012, 0.004, 0.0116, 0.023, 0.038, 0.06, 0.091, 0.139, 0.208, 0.323, 0.503, 0.71, 0.862, 0.954, 0.995]
    + [0.995, 0.952, 0.87, 0.757, 0.631, 0.503, 0.381, 0.265, 0.175, 0.107, 0.061, 0.032, 0.017, 0.0082, 0.0041]
    + [0.0021, 0.00105, 0.00052, 0.00025, 0.00012, 0.00006]
)
_WAVELENGTHS, _STEP = 1e-9 * np.arange(400, 761, 10), 1e-8  # metres
_EFFICACY = 683.0  # lumens per watt
_PLANCK, _LIGHT, _BOLTZMANN = 6.62607015e-34, 299792458.0, 1.380649e-23
_COLD, _HOT, _SAMPLES = 100.0, 1e5, 1024
_TO_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
GLOWING = 1500.0
"""Kelvins at which a black body emits 1, as `wlm.fluid.volume` and scenes define the light of a temperature."""


def black_body_colour(kelvin: np.ndarray) -> np.ndarray:
    """Returns the colours of black bodies, linear Rec. 709 of luminance 1, float64 [N, 3], for temperatures [N] of at
    least 500 K: Planck's law and the CIE's matching functions of 1931, in the analytic fit of Wyman, Sloan and Shirley
    2013, whose error is 1% of their peak. Negative components are 0: below 1,900 K the colour is outside the gamut."""

    def lobes(*rows: tuple[float, float, float, float]) -> np.ndarray:
        wave = 1e9 * _WAVELENGTHS
        return sum(h * np.exp(-0.5 * ((wave - m) * np.where(wave < m, a, b)) ** 2) for h, m, a, b in rows)

    x = lobes((0.362, 442.0, 0.0624, 0.0374), (1.056, 599.8, 0.0264, 0.0323), (-0.065, 501.1, 0.0490, 0.0382))
    y = lobes((0.821, 568.8, 0.0213, 0.0247), (0.286, 530.9, 0.0613, 0.0322))
    z = lobes((1.217, 437.0, 0.0845, 0.0278), (0.681, 459.0, 0.0385, 0.0725))
    exponent = _PLANCK * _LIGHT / (_BOLTZMANN * _WAVELENGTHS) / np.asarray(kelvin, np.float64)[:, None]
    light = (1.0 / (_WAVELENGTHS**5 * np.expm1(exponent))) @ np.stack([x, y, z], 1)
    colour = np.maximum(light @ _TO_RGB.T, 0.0)
    return colour / (colour @ np.linalg.inv(_TO_RGB)[1])[:, None]


def black_body_light(kelvin: torch.Tensor) -> torch.Tensor:
    """Returns the luminance of black bodies relative to 1,500 K, at most 65,504, like `kelvin` in shape and type."""
    table = _lights(kelvin.device)
    at = (1 / _COLD - 1 / kelvin.float().clamp(_COLD, _HOT)) * ((len(table) - 1) / (1 / _COLD - 1 / _HOT))
    first = at.long().clamp(max=len(table) - 2)
    light = torch.exp(torch.lerp(table[first], table[first + 1], at - first))
    return torch.where(kelvin > _COLD, light, 0.0).clamp(max=65504.0).to(kelvin.dtype)


@functools.cache
def _lights(device: torch.device) -> torch.Tensor:
    """Returns the logarithm of the light of black bodies at equal steps of 1 / T, float32 [4096]. It is kept, since a
    CUDA graph cannot copy it to the GPU."""
    inverse = np.linspace(1 / _COLD, 1 / _HOT, 4 * _SAMPLES)
    light = black_body_luminance(1 / inverse) / black_body_luminance(np.array(GLOWING))
    return torch.from_numpy(np.log(np.maximum(light, 1e-30)).astype(np.float32)).to(device)


@functools.cache
def _luminances() -> tuple[np.ndarray, np.ndarray]:
    """Returns inverse temperatures, falling, and the logarithm of the luminance at each, float64 [1024]."""
    inverse = np.geomspace(1 / _COLD, 1 / _HOT, _SAMPLES)[:, None]
    exponent = _PLANCK * _LIGHT / (_BOLTZMANN * _WAVELENGTHS) * inverse
    radiance = 2 * _PLANCK * _LIGHT**2 / _WAVELENGTHS**5 / np.expm1(np.minimum(exponent, 700.0))
    return inverse[:, 0], np.log(_EFFICACY * _STEP * (radiance * _EFFICIENCY).sum(1))


def black_body_luminance(kelvin: np.ndarray) -> np.ndarray:
    """Returns the luminance of black bodies in candela per square metre, float64, for temperatures of any shape.

    Planck's law, weighted by the CIE's luminous efficiency; the logarithm is interpolated in 1 / T to 1e-4. It is 0
    up to 100 K and constant above 100,000 K.
    """
    (inverse, table), kelvin = _luminances(), np.asarray(kelvin, np.float64)
    return np.where(kelvin > _COLD, np.exp(np.interp(-1 / np.maximum(kelvin, _COLD), -inverse, table)), 0.0)
