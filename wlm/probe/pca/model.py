"""The model of principal components: each live probe is a magnitude times a sum of a few directions with coefficients
of a few bits.

    sh_i = m_i sum_k c_ik b_pk,   m_i = exp(low_p0 + step_p0 q_i0),   c_ik = low_pk + step_pk q_ik,   q_ik < 2^n_pk

Probes with similar light share a cluster p, that is, its directions, ranges and bits. The first direction of a cluster
is its mean, whose coefficient takes no bits; the others are its principal components. Instead, a few probes have one
cluster and the unit vectors, which take no memory. This is the method of Sloan et al., Clustered Principal Components
for Precomputed Radiance Transfer, 2003, with bits n_pk of each cluster that have the least sum of squared errors. Where
errors are relative, the magnitude of a probe is about the norm of its numbers, so that the precision follows its light;
else all probes have one. Ambient light, the first three numbers of spherical harmonics, is clamped at 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from wlm.formats.parts import Part
from wlm.probe.model import Content, Profile
from wlm_kernels.probe.components import GROUP

CLUSTERS = 256
"""Largest number of clusters."""

WIDEST = 16
"""Largest number of bits of a code."""

LEVELS = 127
"""Largest integer of a direction."""

_MOST_LOG = 88.0  # largest logarithm in a file: the exponential still fits float32
_RECORDS = 1 << 15  # probes that are packed at once


@dataclass(frozen=True, eq=False)
class Components(Content):
    """V live probes of D numbers at each of T hours, a sum of up to K components, in C clusters.

    Attributes:
        outputs: Numbers per probe at one hour, D.
        cluster: uint8 [V], the cluster of each probe.
        code: uint16 [V, 1 + K], codes of the logarithm of the magnitude and of the coefficients.
        width: uint8 [C, 1 + K], bits of these codes.
        bounds: float16 [2, C, 1 + K], lowest value and step of each code; 0 for coefficients that a cluster lacks.
        basis: [C, K, T D], directions of each cluster: for one hour int8, in units of 1/127, and for several float16;
            empty, [0, K, T D], where they are the unit vectors, K = T D.
        hours: T, number of hours.
    """

    METHOD: ClassVar[str] = "pca"
    DECODER: ClassVar[str] = "wlm.probe.pca.decode:ComponentDecoder"
    BUNDLE: ClassVar[str] = "wlm.probe.pca.bundle:component_bundle"

    outputs: int
    cluster: np.ndarray
    code: np.ndarray
    width: np.ndarray
    bounds: np.ndarray
    basis: np.ndarray
    hours: int = 1

    @property
    def count(self) -> int:
        """The largest number of components of a cluster, K."""
        return self.width.shape[1] - 1

    @property
    def clusters(self) -> int:
        """The number of clusters, C."""
        return len(self.width)

    @property
    def used(self) -> np.ndarray:
        """Which codes a GPU has, bool [C, 1 + K]: those of magnitudes, and of coefficients that are not 0."""
        magnitude = np.arange(self.count + 1) == 0
        return (self.width > 0) | (self.bounds[0] != 0) | magnitude | (not len(self.basis) and self.hours == 1)

    @property
    def bits(self) -> np.ndarray:
        """The number of bits of a probe in each cluster, int [C]."""
        return self.width.sum(1, dtype=np.int64)

    @property
    def nbytes(self) -> int:
        bits, columns = int(self.bits[self.cluster].sum()), int(self.used.sum())
        sizes = len(self.code), self.outputs, columns, self.clusters, bits
        return component_bytes(*sizes, self.hours, identity=not len(self.basis))

    def at(self, factors: np.ndarray, scales: np.ndarray) -> Self:
        basis = self.basis.astype(np.float64) if len(self.basis) else np.eye(self.count)[None]
        mixed = (factors * scales) @ basis.reshape(*basis.shape[:2], self.hours, -1)
        return replace(self, basis=np.clip(mixed, -65504, 65504).astype(np.float16), hours=1)

    def facts(self) -> dict[str, Any]:
        basis = "principal components" if len(self.basis) else "unit vectors"
        bits = round(float(self.bits[self.cluster].mean()), 1)
        return {"components": self.count, "clusters": self.clusters, "GPU_bits_per_probe": bits, "basis": basis}

    def settings(self) -> dict[str, int]:
        return ({"count": self.count} if len(self.basis) else {}) | (
            {"clusters": self.clusters} if self.clusters > 1 else {}
        )

    @classmethod
    def table(cls, profile: Profile, outputs: int, hours: int, count: int, live: int, clusters: int) -> dict[str, Part]:
        numbers = hours * outputs
        if count > numbers + 1 or (clusters > 1 and not count):
            raise ValueError(f"setting count: expected at most {numbers + 1} components in clusters, found {count}")
        columns = 1 + (count or numbers)
        return {
            "cluster": Part(np.uint8, (live if clusters > 1 else 0,)),
            "code": Part(np.uint16, (columns, live)),
            "width": Part(np.uint8, (clusters, columns)),
            "bounds": Part(np.float16, (2, clusters, columns)),
            "basis": Part(np.int8 if hours == 1 else np.float16, (clusters if count else 0, columns - 1, numbers)),
        }

    def parts(self) -> dict[str, np.ndarray]:
        cluster = self.cluster if self.clusters > 1 else self.cluster[:0]
        basis = {"width": self.width, "bounds": self.bounds, "basis": self.basis}
        return {"cluster": cluster, "code": self.code.T, **basis}

    @classmethod
    def from_parts(
        cls, profile: Profile, outputs: int, hours: int, stored: Mapping[str, np.ndarray], dropped: int
    ) -> Self:
        bounds, code = stored["bounds"].astype(np.float64), np.ascontiguousarray(stored["code"].T)
        width, basis, cluster = stored["width"], stored["basis"], stored["cluster"]
        if len(width) == 1:
            cluster = np.zeros(len(code), np.uint8)
        if (width > WIDEST).any() or cluster.max() >= len(width) or (code >> width[cluster]).any():
            raise ValueError(f"parts code and width: expected codes of at most {WIDEST} bits, and clusters that exist")
        most = np.maximum(np.abs(bounds[0]), np.abs(bounds[0] + (2.0**width - 1.0) * bounds[1]))
        if (bounds[1] < 0).any() or not most[:, 0].max() <= _MOST_LOG:
            raise ValueError(f"part bounds: expected steps of at least 0, and log magnitudes within {_MOST_LOG:g}")
        largest = np.abs(basis.astype(np.float64)).max() * unit_of(basis) if len(basis) else 1.0
        if not (np.exp(most[:, 0]) * most[:, 1:].sum(1)).max() * largest <= np.finfo(np.float32).max:
            raise ValueError("parts bounds and basis: expected light within the range of float32")
        return cls(outputs, cluster, code, width, stored["bounds"], basis, hours)

    def packed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the buffers of a GPU with a word for the first bit of each `GROUP` of probes and for the end of the
        last one, uint32; the clusters of each group, as words; and the codes of all probes one after another, from the
        lowest bit of a word, uint32. The last group is filled up with cluster 0, without codes."""
        padded = np.pad(self.cluster, (0, -len(self.cluster) % GROUP))
        first = np.append(0, np.cumsum(self.bits[padded]))
        index = (self.clusters - 1).bit_length()
        width = self.width[self.cluster]
        codes = _bits(self.code, width)
        return first[::GROUP].astype("<u4"), _bits(padded[:, None], np.full_like(padded, index)[:, None]), codes


def _bits(numbers: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Returns the lowest bits of integers, `width` of each, one after another from the lowest bit of a word; uint32."""
    pieces = []
    for start in range(0, len(numbers), _RECORDS):
        part = slice(start, start + _RECORDS)
        place = np.arange(max(int(width.max(initial=0)), 1))
        bits = (numbers[part, :, None] >> place.astype(numbers.dtype) & 1).astype(np.uint8)
        pieces.append(bits[place < width[part, :, None]])
    data = np.packbits(np.concatenate(pieces), bitorder="little")
    return np.pad(data, (0, -len(data) % 4)).view("<u4")


def unit_of(basis: np.ndarray) -> float:
    """Returns the value of 1 in a basis."""
    return 1 / LEVELS if basis.dtype == np.int8 else 1.0


def component_bytes(
    live: int, outputs: int, columns: int, clusters: int, bits: int, hours: int, *, identity: bool
) -> int:
    """Returns the bytes of the GPU buffers of V = `live` probes with `bits` bits of codes together, for `columns` codes
    of all C `clusters` together; see `wlm.probe.pca.bundle`, and for several hours `wlm.probe.bundle`."""
    row = -(-outputs // 2) * (hours + 1) if hours > 1 else 0 if identity else -(-outputs // 4)
    groups = 1 + -(-live // GROUP) * (1 + (clusters - 1).bit_length() * GROUP // 32)
    return 4 * (4 + clusters + columns + -(-columns // 4) + (columns - clusters) * row + groups + -(-bits // 32))
