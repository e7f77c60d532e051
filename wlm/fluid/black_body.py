"""Light of black bodies, for temperatures in kelvin."""

import numpy as np

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


def black_body_luminance(kelvin: np.ndarray) -> np.ndarray:
    """Returns the luminance of black bodies in candela per square metre, float64, for temperatures of any shape.

    Planck's law, weighted by the CIE's luminous efficiency; the logarithm is interpolated in 1 / T to 1e-4. It is 0
    up to 100 K and constant above 100,000 K.
    """
    inverse = np.geomspace(1 / _COLD, 1 / _HOT, _SAMPLES)[:, None]
    exponent = _PLANCK * _LIGHT / (_BOLTZMANN * _WAVELENGTHS) * inverse
    radiance = 2 * _PLANCK * _LIGHT**2 / _WAVELENGTHS**5 / np.expm1(np.minimum(exponent, 700.0))
    table = np.log(_EFFICACY * _STEP * (radiance * _EFFICIENCY).sum(1))
    kelvin = np.asarray(kelvin, np.float64)
    return np.where(kelvin > _COLD, np.exp(np.interp(-1 / np.maximum(kelvin, _COLD), -inverse[:, 0], table)), 0.0)
