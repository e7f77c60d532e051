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
    """Returns the norms of rows [..., D] of float32 numbers, float64 [...]."""
    return np.sqrt(np.einsum("...d,...d->...", values, values, dtype=np.float64))


def magnitudes(values: np.ndarray, hours: int = 1) -> np.ndarray:
    """Returns m, by which errors of live probes [V, T D] at T hours are divided, float64 [V, T]; each hour has its own
    floor. It is positive if any number is not 0."""
    norm = norms(values.reshape(len(values), hours, -1))
    brightest = norm.max(0, initial=0.0)
    lit = brightest > 0
    floor = np.full(hours, norm.max(initial=0.0))  # of an hour without light
    floor[lit] = FLOOR * np.exp(np.log(np.maximum(norm[:, lit], _LEAST * brightest[lit])).mean(0))
    return np.hypot(norm, floor)


def relative_errors(decoded: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns the relative errors |decoded - L| / m of live probes [V, D], float64 [V]."""
    return norms(decoded.astype(np.float64) - values) / magnitudes(values)[:, 0]


def with_magnitude(values: np.ndarray, hours: int = 1) -> np.ndarray:
    """Returns numbers whose squared error is about the squared relative error, float64 [V, T (D + 1)]: for each of T
    hours the numbers of live probes [V, T D] divided by m, then the logarithm of m, less that of the brightest."""
    m = magnitudes(values, hours)
    light = values.reshape(len(values), hours, -1) / m[..., None]
    return np.concatenate([light, np.log(m / m.max())[..., None]], 2).reshape(len(values), -1)
