"""Converts spherical harmonics between the conventions of engines and of this package.

The canonical numbers, those of this package, are the radiance L projected onto the orthonormal real basis, c_lm =
integral of L Y_lm (gaussian-probe-compression, eq. 1), all signs plus, in the order 1; y, z, x; xy, yz, 3z2-1, xz,
x2-y2; and so on, m from -l to l in band l. All engines here use this order, and differ by one factor each:

=======  ==========================================  ========  ========================================
name     type in the engine                          bands     engine's number / canonical number
=======  ==========================================  ========  ========================================
threejs  SphericalHarmonics3 (LightProbe)            any       1: this is the canonical convention
godot    LightmapGIData.probe_data["sh"]             any       1 / pi
unreal   FSHVector2, FSHVector3, FSHVectorRGB3       L0 to L2  (-1)^m, the Condon-Shortley phase
unity    SphericalHarmonicsL2 (LightProbes)          L0 to L2  K_lm A_l / pi
=======  ==========================================  ========  ========================================

- three.js: `getAt` is the radiance and `getIrradianceAt` the irradiance.
- Godot: the baker stores the average of 4 L Y over the sphere, which is the integral of L Y divided by pi. The numbers
  are not convolved with the cosine: the shader multiplies the bands by pi, 2 pi / 3 and pi / 4 for irradiance / pi.
- Unreal: y, x, yz and xz have a minus sign, z, xy, 3z2-1 and x2-y2 have none. Its tables end with band 2. These are the
  vectors of the engine's own maths, not the packed bricks of a volumetric lightmap.
- Unity: `Evaluate` and the shader's ShadeSH9 are plain polynomials that yield irradiance / pi. The basis' constants
  K_lm (0.2821; 0.4886; 1.0925, 0.3154 for 3z2-1, 0.5463 for x2-y2) and the clamped cosine's A_l / pi = 1, 2/3, 1/4
  (Ramamoorthi and Hanrahan 2001) are therefore part of the numbers, and are removed here. C# indexes the numbers
  [channel, coefficient]; here, as everywhere in this package, the channel is last.

Axes and units are not converted. In each engine positions and directions share one frame (three.js and Godot
right-handed with y up, Unity left-handed with y up, Unreal left-handed with z up, in centimetres), which is kept.
Windowing against ringing and exposure, if a bake applied them, stay in the numbers.
"""

import math

import numpy as np

from wlm.errors import WlmError
from wlm.probe.sphere import coefficient_bands, cosine_factor, sh_count

CANONICAL = "threejs"
CONVENTIONS = (CANONICAL, "godot", "unreal", "unity")

_LAST_BAND = {"unreal": 2, "unity": 2}

# Constants in front of the basis' polynomials, and the clamped cosine's factors over pi; bands 0 to 2.
_K1, _K2 = math.sqrt(3.0 / (4.0 * math.pi)), math.sqrt(15.0 / (4.0 * math.pi))
_BASIS = np.array([math.sqrt(0.25 / math.pi), *[_K1] * 3, _K2, _K2, math.sqrt(5.0 / (16.0 * math.pi)), _K2, _K2 / 2.0])
_COSINE = np.array([cosine_factor(band) / math.pi for band in coefficient_bands(9)])


def to_canonical(values: np.ndarray, name: str) -> np.ndarray:
    """Converts an engine's coefficients to canonical ones. `values` are [N, C, 3], C = 1, 4, 9 ... coefficients, RGB
    last. NaN and Inf are kept. `name` is one of `CONVENTIONS`. Returns float64 [N, C, 3]; `from_canonical` inverts it,
    without any rounding for "threejs" and "unreal". Raises a WlmError if the name is unknown, C is not the square of a
    number of bands, or the engine has fewer bands. Raises a ValueError if the shape is different."""
    return _checked(values) / _factors(values.shape[1], name)[:, None]


def from_canonical(values: np.ndarray, name: str) -> np.ndarray:
    """Converts canonical coefficients to an engine's convention; arguments and errors are those of `to_canonical`."""
    return _checked(values) * _factors(values.shape[1], name)[:, None]


def _checked(values: np.ndarray) -> np.ndarray:
    if values.ndim != 3 or values.shape[2] != 3:
        raise ValueError(f"values: expected the shape [N, C, 3] (probes, coefficients, RGB), got {values.shape}")
    return values.astype(np.float64)


def _factors(coefficients: int, name: str) -> np.ndarray:
    """Returns the factors from canonical coefficients to an engine's, one per coefficient, float64 [C]."""
    if name not in CONVENTIONS:
        raise WlmError(f"convention: expected {', '.join(CONVENTIONS)}, got {name!r}")
    if sh_count(3 * coefficients) is None:
        raise WlmError(f"convention {name}: expected 1, 4, 9 ... coefficients per colour channel, got {coefficients}")
    bands = coefficient_bands(coefficients)
    highest, last = bands[-1], _LAST_BAND.get(name, bands[-1])
    if highest > last:
        raise WlmError(f"convention {name}: expected bands L0 to L{last}, got L{highest} ({coefficients} coefficients)")
    if name == "godot":
        return np.full(coefficients, 1.0 / math.pi)
    if name == "unreal":
        order = np.arange(coefficients) - bands * (bands + 1)  # m, from -l to l
        return np.where(order % 2 == 0, 1.0, -1.0)
    if name == "unity":
        return (_BASIS * _COSINE)[:coefficients]
    return np.ones(coefficients)
