"""Errors relative to the light of each probe.

The light of a probe is the norm |L| of its numbers: for spherical harmonics, the root mean square of the radiance over
all directions times a constant. Errors are divided by

    m = sqrt(|L|^2 + floor^2),   floor = FLOOR * geometric mean of |L| over the live probes

so that light of 1 and of 1 : 10,000 in one set are about equally exact, and noise in nearly black probes costs nothing.
"""

import numpy as np

FLOOR = 1e-4
"""The floor of relative errors, as a share of the geometric mean of all live probes' light."""

_LEAST = 1e-6  # of the brightest probe: darker probes count as this bright in the mean


def norms(values: np.ndarray) -> np.ndarray:
    """Returns the norms of rows [N, D] of float32 numbers, float64 [N]."""
    return np.sqrt(np.einsum("nd,nd->n", values, values, dtype=np.float64))


def magnitudes(values: np.ndarray) -> np.ndarray:
    """Returns m, by which errors of live probes [V, D] are divided, float64 [V]; positive if any number is not 0."""
    norm = norms(values)
    least = _LEAST * norm.max(initial=0.0)
    floor = FLOOR * np.exp(np.log(np.maximum(norm, least)).mean()) if least > 0 else 0.0
    return np.hypot(norm, floor)


def relative_errors(decoded: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns the relative errors |decoded - L| / m of live probes [V, D], float64 [V]."""
    return norms(decoded.astype(np.float64) - values) / magnitudes(values)


def with_magnitude(values: np.ndarray) -> np.ndarray:
    """Returns numbers whose squared error is about the squared relative error, float64 [V, D + 1]: the numbers of live
    probes [V, D] divided by m, then the logarithm of m, less that of the brightest probe."""
    m = magnitudes(values)
    return np.concatenate([values / m[:, None], np.log(m / m.max())[:, None]], 1)
