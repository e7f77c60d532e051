"""The model of principal components: each live probe is a magnitude times a sum of a few directions with 8-bit
coefficients.

    sh_i = m_i sum_k c_ik b_k,   m_i = exp(low_0 + step_0 q_i0),   c_ik = low_k + step_k q_ik,   q in 0 ... 255

The magnitude of a probe is about the norm of its numbers, so that the precision follows the light of each probe. The
directions b_k are the right singular vectors of all probes' numbers; with as many directions as numbers they are the
unit vectors, which take no memory. Ambient light, the first three numbers of spherical harmonics, is clamped at 0. This
is the method of Sloan et al., Clustered Principal Components for Precomputed Radiance Transfer, 2003, with one cluster.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from wlm.formats.parts import Part
from wlm.probe.model import Content, Profile
from wlm.probe.relative import norms

ENOUGH = 0.02
"""Relative error at which no component is added: RMS over all probes of the error divided by the probe's norm."""

_LEVELS = 255
_MOST_LOG = 88.0  # largest logarithm in a file: the exponential still fits float32


@dataclass(frozen=True, eq=False)
class Components(Content):
    """V live probes of D numbers, each a sum of K components.

    Attributes:
        outputs: Numbers per probe, D.
        code: uint8 [V, 1 + K], codes of the logarithm of the magnitude and of the coefficients.
        bounds: float16 [2, 1 + K], lowest value and step of each column of `code`.
        basis: float16 [K, D]; empty where the directions are the unit vectors, K = D.
    """

    METHOD: ClassVar[str] = "pca"
    DECODER: ClassVar[str] = "wlm.probe.pca.decode:ComponentDecoder"
    BUNDLE: ClassVar[str] = "wlm.probe.pca.bundle:component_bundle"

    outputs: int
    code: np.ndarray
    bounds: np.ndarray
    basis: np.ndarray

    @property
    def count(self) -> int:
        """The number of components, K."""
        return self.code.shape[1] - 1

    @property
    def nbytes(self) -> int:
        return component_bytes(len(self.code), self.outputs, self.count, identity=not len(self.basis))

    def facts(self) -> dict[str, Any]:
        return {"components": self.count, "basis": "principal components" if len(self.basis) else "unit vectors"}

    def settings(self) -> dict[str, int]:
        return {"count": self.count}

    @classmethod
    def table(cls, profile: Profile, outputs: int, count: int, live: int) -> dict[str, Part]:
        if count > outputs:
            raise ValueError(f"setting count: expected at most {outputs} components, found {count}")
        return {
            "code": Part(np.uint8, (1 + count, live)),
            "bounds": Part(np.float16, (2, 1 + count)),
            "basis": Part(np.float16, (0 if count == outputs else count, outputs)),
        }

    def parts(self) -> dict[str, np.ndarray]:
        return {"code": self.code.T, "bounds": self.bounds, "basis": self.basis}

    @classmethod
    def from_parts(cls, profile: Profile, outputs: int, stored: Mapping[str, np.ndarray], dropped: int) -> Self:
        bounds = stored["bounds"].astype(np.float64)
        most = np.maximum(np.abs(bounds[0]), np.abs(bounds[0] + 255.0 * bounds[1]))
        largest = float(np.abs(stored["basis"].astype(np.float64)).max(initial=0.0)) if stored["basis"].size else 1.0
        if (bounds[1] < 0).any() or most[0] > _MOST_LOG:
            raise ValueError(f"part bounds: expected steps of at least 0, and log magnitudes within {_MOST_LOG:g}")
        if not np.exp(most[0]) * most[1:].sum() * largest <= np.finfo(np.float32).max:
            raise ValueError("parts bounds and basis: expected light within the range of float32")
        return cls(outputs, np.ascontiguousarray(stored["code"].T), stored["bounds"], stored["basis"])


def component_bytes(live: int, outputs: int, count: int, *, identity: bool) -> int:
    """Returns the bytes of the GPU buffer of V = `live` probes in `count` components; see `wlm.probe.pca.bundle`."""
    basis = 0 if identity else count * -(-outputs // 2)
    return 4 * (2 + count + basis + -(-live * (1 + count) // 4))


def fit_components(values: np.ndarray, most_bytes: int | None = None) -> tuple[Components, float]:
    """Compresses live probes with the fewest components whose relative error is at most `ENOUGH`.

    Args:
        values: float32 [V, D], numbers of live probes; no row is zero.
        most_bytes: Largest number of GPU bytes; None: no limit. At least one component is fitted.

    Returns:
        The components and their relative error, which exceeds `ENOUGH` only if `most_bytes` does not allow more
        components.
    """
    values = values.astype(np.float64)
    live, outputs = values.shape
    norm = norms(values)
    directions = np.linalg.svd(np.linalg.qr(values / norm.max(), mode="r"))[2]
    identity = component_bytes(live, outputs, outputs, identity=True)
    best, error = _coded(values, norm, directions[:1].astype(np.float16))
    for count in range(1, min(live, outputs) + 1):
        size = component_bytes(live, outputs, count, identity=False)
        if size >= identity:
            if most_bytes is None or identity <= most_bytes:
                best, error = _coded(values, norm, np.zeros((0, outputs), np.float16))
            break
        if count > 1:
            if most_bytes is not None and size > most_bytes:
                break
            best, error = _coded(values, norm, directions[:count].astype(np.float16))
        if error <= ENOUGH:
            break
    return best, error


def _coded(values: np.ndarray, norm: np.ndarray, basis: np.ndarray) -> tuple[Components, float]:
    """Codes probes [V, D] in a basis, given their norms; returns the components and their relative error."""
    logarithm, code, bounds = _quantised(np.log(norm)[:, None])
    magnitude = np.exp(logarithm)
    # Coefficients for the basis as it is stored: its rounding causes no error of its own.
    directions = basis.astype(np.float64) if len(basis) else np.eye(values.shape[1])
    inverse = np.linalg.pinv(directions) if len(basis) else directions
    decoded, codes, ranges = _quantised((values / magnitude) @ inverse)
    error = magnitude * (decoded @ directions) - values
    components = Components(
        outputs=values.shape[1],
        code=np.concatenate([code, codes], 1),
        bounds=np.concatenate([bounds, ranges], 1),
        basis=basis,
    )
    return components, float(np.sqrt(np.square(norms(error) / norm).mean()))


def _quantised(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quantises columns [V, C] over their ranges. Returns the rounded numbers, float64; the codes, uint8; and the
    lowest value and step of each column, float16 [2, C]."""
    low = -_half_above(-numbers.min(0))
    step = _half_above((numbers.max(0) - low) / _LEVELS)
    code = np.divide(numbers - low, step, out=np.zeros_like(numbers), where=step > 0)
    code = np.clip(np.rint(code), 0, _LEVELS).astype(np.uint8)
    return low + code * step, code, np.stack([low, step]).astype(np.float16)


def _half_above(numbers: np.ndarray) -> np.ndarray:
    near = numbers.astype(np.float16)
    return np.where(near < numbers, np.nextafter(near, np.float16(np.inf)), near).astype(np.float64)
