"""What a set of probes says of their surroundings: which are inside of something, and the surfaces that they lie on."""

import numpy as np

from wlm.errors import WlmError

_VALID = 0.5


def check_valid(where: str, field: str, valid: np.ndarray, count: int) -> np.ndarray:
    """Which of `count` probes are valid, bool [N].

    Args:
        where, field: What an error names.
        valid: [N], true or false, or from 0 to 1.
        count: N.

    Raises:
        WlmError: Another shape or type, or a number out of range.
    """
    _check(where, field, valid, "biuf", (count,))
    bad = np.flatnonzero(~((valid >= 0) & (valid <= 1)))
    if len(bad):
        raise WlmError(f"{where}: {field}[{bad[0]}]: expected true or false, or 0 to 1, got {float(valid[bad[0]]):g}")
    return valid >= _VALID


def check_normal(where: str, field: str, normal: np.ndarray, count: int) -> np.ndarray:
    """Normals of `count` probes, float64 [N, 3], of length 1, or 0 where a probe lies on no surface.

    Args:
        where, field: What an error names.
        normal: [N, 3], of any length.
        count: N.

    Raises:
        WlmError: Another shape or type, or a number that isn't finite.
    """
    _check(where, field, normal, "iuf", (count, 3))
    normal = normal.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(normal).all(1))
    if len(bad):
        raise WlmError(f"{where}: {field}[{bad[0]}]: expected finite numbers, got {normal[bad[0]].tolist()}")
    # By the largest number first: squares of what is very long or short don't fit.
    normal = _divided(normal, np.abs(normal).max(1, keepdims=True))
    return _divided(normal, np.linalg.norm(normal, axis=1, keepdims=True))


def _divided(normal: np.ndarray, length: np.ndarray) -> np.ndarray:
    return normal / np.where(length > 0, length, 1.0)


def _check(where: str, field: str, array: np.ndarray, kinds: str, shape: tuple[int, ...]) -> None:
    if array.dtype.kind not in kinds or array.shape != shape:
        expected = "numbers" if kinds == "iuf" else "numbers, or true and false,"
        raise WlmError(f"{where}: {field}: expected {expected} {list(shape)}, got {array.dtype} {list(array.shape)}")
