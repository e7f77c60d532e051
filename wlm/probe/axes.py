"""Changes of axes: a scene's x, y and z exchanged or mirrored, as between engines of other handedness or up axis."""

import numpy as np

from wlm.errors import WlmError
from wlm.probe.sphere import basis, fibonacci_sphere, sh_count

FORM = "three of x, y, z, each once, a mirrored one with a minus sign, such as x,z,-y"
"""Form of a change of axes: the old axes that become the new x, y and z."""


def read_axes(text: str | None) -> np.ndarray:
    """Returns a change of axes as a matrix, float64 [3, 3], with new = matrix @ old; None: no change. Raises a WlmError
    if the text is not of the form `FORM`."""
    names = "x,y,z" if text is None else text.replace(" ", "")
    parts = names.split(",")
    if sorted(part.removeprefix("-") for part in parts) != ["x", "y", "z"]:
        raise WlmError(f"axes: expected {FORM}, got {text!r}")
    matrix = np.zeros((3, 3))
    for row, part in enumerate(parts):
        matrix[row, "xyz".index(part[-1])] = -1.0 if part[0] == "-" else 1.0
    return matrix


def turned(values: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Returns the light of probes in other axes. `values` are [N, D], canonical spherical harmonics in RGB
    (`wlm.probe.conventions`). `matrix` is [3, 3], orthogonal: new = matrix @ old. The result is [N, D] of the type of
    `values`; with exact zeros and signs where coefficients are exchanged or mirrored. Raises a WlmError if the numbers
    are not spherical harmonics in RGB, and the axes change."""
    if (matrix == np.eye(3)).all():
        return values
    coefficients = sh_count(values.shape[1])
    if coefficients is None:
        raise WlmError(f"axes: expected spherical harmonics in RGB, 3, 12, 27 ... numbers, got {values.shape[1]}")
    # The light at a new direction is that at the old one: basis(new) @ new coefficients = basis(old) @ old ones.
    old = fibonacci_sphere(4 * coefficients)
    change = np.linalg.lstsq(basis(old @ matrix.T, coefficients), basis(old, coefficients), rcond=None)[0]
    whole = np.round(change)
    change = np.where(np.abs(change - whole) < 1e-9, whole, change)
    light = values.reshape(len(values), coefficients, 3).astype(np.float64)
    return np.einsum("cd,ndk->nck", change, light).reshape(values.shape).astype(values.dtype)
