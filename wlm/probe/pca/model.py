"""The model of principal components: each live probe is a magnitude times a sum of a few directions with coefficients
of a few bits.

    sh_i = m_i sum_k c_ik b_pk,   m_i = exp(low_p0 + step_p0 q_i0),   c_ik = low_pk + step_pk q_ik,   q_ik < 2^n_k

Probes with similar light share a cluster p, that is, its directions and ranges. The first direction of a cluster is its
mean, whose coefficient is 1 and takes no bits; the others are its principal components. Instead, a few probes have one
cluster and the unit vectors, which take no memory. This is the method of Sloan et al., Clustered Principal Components
for Precomputed Radiance Transfer, 2003, with bits n_k that have the least sum of squared errors. The magnitude of a
probe is about the norm of its numbers, so that the precision follows the light of each probe. Ambient light, the first
three numbers of spherical harmonics, is clamped at 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from scipy.cluster.vq import kmeans2

from wlm.formats.parts import Part
from wlm.probe.model import Content, Profile
from wlm.probe.relative import norms

ENOUGH = 0.02
"""Relative error at which no bit is added: RMS over all probes of the error divided by the probe's magnitude."""

CLUSTERS = 256
"""Largest number of clusters."""

_WIDEST = 8  # bits of a code
_MOST_LOG = 88.0  # largest logarithm in a file: the exponential still fits float32
_TRIED = (1, 8, 24)  # numbers of clusters
_FEWEST = 8  # probes per cluster, in the mean; smaller sets have unit vectors, unless their probes have many numbers
_ROUNDS = 6  # of k-means, and again of k-means with subspaces
_BITS, _RANK = 6, 8  # mean bits of a coefficient in most fits, and the largest dimension of a subspace for clustering
_MOST = 64  # directions of a cluster
_SAMPLE = 1 << 13  # probes from which clusters and bits are chosen
_MADE_UP = 1 / 16  # of the rounding of the magnitude, that coefficients in unit vectors do not make up for
_RECORDS = 1 << 15  # probes that are packed at once
_NARROW, _SHARES = 5, (1.0, 0.75, 0.55)  # fewer bits may be worth more if they cover only a share of the range


@dataclass(frozen=True, eq=False)
class Components(Content):
    """V live probes of D numbers at each of T hours, a sum of K components, in C clusters.

    Attributes:
        outputs: Numbers per probe at one hour, D.
        code: uint8 [V, 2 + K], cluster, and codes of the logarithm of the magnitude and of the coefficients.
        width: uint8 [2 + K], bits of each column of `code`.
        bounds: float16 [2, C, 1 + K], lowest value and step of each column of `code` but the first.
        basis: float16 [C K, T D]; empty where the directions are the unit vectors, K = T D.
        hours: T, number of hours.
    """

    METHOD: ClassVar[str] = "pca"
    DECODER: ClassVar[str] = "wlm.probe.pca.decode:ComponentDecoder"
    BUNDLE: ClassVar[str] = "wlm.probe.pca.bundle:component_bundle"

    outputs: int
    code: np.ndarray
    width: np.ndarray
    bounds: np.ndarray
    basis: np.ndarray
    hours: int = 1

    @property
    def count(self) -> int:
        """The number of components, K."""
        return self.bounds.shape[2] - 1

    @property
    def clusters(self) -> int:
        """The number of clusters, C."""
        return self.bounds.shape[1]

    @property
    def nbytes(self) -> int:
        bits = int(self.width.sum())
        return component_bytes(
            len(self.code), self.outputs, self.count, self.clusters, bits, self.hours, identity=not len(self.basis)
        )

    def at(self, factors: np.ndarray, scales: np.ndarray) -> Self:
        basis = self.basis.astype(np.float64) if len(self.basis) else np.eye(self.count)
        mixed = (factors * scales) @ basis.reshape(len(basis), self.hours, -1)
        return replace(self, basis=np.clip(mixed, -65504, 65504).astype(np.float16), hours=1)

    def facts(self) -> dict[str, Any]:
        basis = "principal components" if len(self.basis) else "unit vectors"
        return {"components": self.count, "clusters": self.clusters, "bits": int(self.width.sum()), "basis": basis}

    def settings(self) -> dict[str, int]:
        return ({"count": self.count} if len(self.basis) else {}) | (
            {"clusters": self.clusters} if self.clusters > 1 else {}
        )

    @classmethod
    def table(cls, profile: Profile, outputs: int, hours: int, count: int, live: int, clusters: int) -> dict[str, Part]:
        outputs *= hours
        if count >= outputs or (clusters > 1 and not count):
            raise ValueError(f"setting count: expected at most {outputs - 1} components in clusters, found {count}")
        numbers = count or outputs
        return {
            "code": Part(np.uint8, (numbers + 1 + (clusters > 1), live)),
            "width": Part(np.uint8, (-(-(numbers + 1 + (clusters > 1)) // 2),)),
            "bounds": Part(np.float16, (2, clusters, 1 + numbers)),
            "basis": Part(np.float16, (clusters * count, outputs)),
        }

    def parts(self) -> dict[str, np.ndarray]:
        first = int(self.clusters == 1)  # all probes are in one cluster
        code, width = self.code[:, first:].T, np.pad(self.width[first:], (0, (len(self.width) - first) % 2))
        width = width[::2] | width[1::2] << 4
        return {"code": code, "width": width, "bounds": self.bounds, "basis": self.basis}

    @classmethod
    def from_parts(
        cls, profile: Profile, outputs: int, hours: int, stored: Mapping[str, np.ndarray], dropped: int
    ) -> Self:
        bounds, code, halves = stored["bounds"].astype(np.float64), stored["code"], stored["width"]
        width = np.stack([halves & 15, halves >> 4], 1).reshape(-1)[: len(code)]
        if bounds.shape[1] == 1:
            code, width = np.pad(code, ((1, 0), (0, 0))), np.pad(width, (1, 0))
        levels = 2.0**width - 1.0
        if (width > _WIDEST).any() or (code > levels[:, None]).any() or code[0].max() >= bounds.shape[1]:
            raise ValueError(f"parts code and width: expected codes of at most {_WIDEST} bits, and clusters that exist")
        most = np.maximum(np.abs(bounds[0]), np.abs(bounds[0] + levels[1:] * bounds[1]))
        largest = float(np.abs(stored["basis"].astype(np.float64)).max(initial=0.0)) if stored["basis"].size else 1.0
        if (bounds[1] < 0).any() or most[:, 0].max() > _MOST_LOG:
            raise ValueError(f"part bounds: expected steps of at least 0, and log magnitudes within {_MOST_LOG:g}")
        if not (np.exp(most[:, 0]) * most[:, 1:].sum(1)).max() * largest <= np.finfo(np.float32).max:
            raise ValueError("parts bounds and basis: expected light within the range of float32")
        code = np.ascontiguousarray(code.T)
        return cls(outputs, code, width, stored["bounds"], stored["basis"], hours)

    def places(self) -> np.ndarray:
        """Returns the first bit and the number of bits of each column of `code` in the bits of a probe, [2 + K, 2]."""
        ends = np.cumsum(self.width, dtype=np.int32)
        return np.stack([ends - self.width, self.width], 1).astype(np.int32)

    def packed(self) -> np.ndarray:
        """Returns the codes as they are on a GPU: all bits of a probe, then those of the next, uint32."""
        place = [(column, bit) for column, width in enumerate(self.width) for bit in range(width)]
        column, bit = np.array(place, np.intp).reshape(-1, 2).T
        words = []
        for start in range(0, len(self.code), _RECORDS):  # records of 32 probes end with a word
            bits = np.packbits(
                self.code[start : start + _RECORDS, column] >> bit.astype(np.uint8) & 1, bitorder="little"
            )
            words.append(np.pad(bits, (0, -len(bits) % 4)).view("<u4"))
        return np.concatenate(words)


def component_bytes(
    live: int, outputs: int, count: int, clusters: int, bits: int, hours: int, *, identity: bool
) -> int:
    """Returns the bytes of the GPU buffers of V = `live` probes with `bits` bits each, and `count` directions for each
    of `clusters`; see `wlm.probe.pca.bundle`, and for several hours `wlm.probe.bundle`."""
    basis = clusters * count * -(-outputs // 2) * (hours + 1 if hours > 1 else int(not identity))
    return 4 * (4 + count + clusters * (1 + count) + basis + -(-live * bits // 32))


def fit_components(
    values: np.ndarray, most_bytes: int | None = None, hours: int = 1, enough: float = ENOUGH
) -> tuple[Components, float]:
    """Compresses live probes to the smallest GPU buffers whose relative error is at most `enough`, over all hours.

    Args:
        values: float32 [V, T D], numbers of live probes at T hours; no row is zero.
        most_bytes: Largest number of GPU bytes; None: no limit. At least one component is fitted.
        hours: T.
        enough: Relative error at which no bit is added.

    Returns:
        The components and their relative error, which exceeds `enough` only if `most_bytes` or the widest codes do not
        allow less.
    """
    values = values.astype(np.float64)
    live, numbers = values.shape
    light = norms(values)
    some = slice(None, None, -(-live // _SAMPLE))
    bits = _WIDEST * (1 + numbers)
    if most_bytes is not None:
        bits = min(bits, 8 * most_bytes // live)
    rank = min(max(bits // _BITS, 1), _RANK)
    plans = []
    for clusters in (0, *_TRIED):
        if clusters <= max(live // _FEWEST, _FEWEST * live <= numbers):
            shape = (values / light[:, None])[some]
            division = _divided(shape, clusters, rank)
            plans += _plans(shape, np.log(light)[some], division, bits, live, hours)
    plans = [plan for plan in plans if most_bytes is None or plan.size <= most_bytes] or [min(plans, key=_size)]
    target = enough
    while True:  # the errors of plans are predictions
        good = [plan for plan in plans if plan.error <= enough]
        plan = min(good, key=_size) if good else min(plans, key=lambda plan: plan.error)
        components, error = _coded(values, light, hours, plan)
        if error <= target or not good:
            return components, error
        enough = min(0.9 * enough * target / error, 0.99 * plan.error)


def _size(plan: "_Plan") -> tuple[int, float]:
    return plan.size, plan.error


class _Division(NamedTuple):
    """Directions of clusters, [C, K, D], the first of each its mean; None: the unit vectors, for one cluster. A probe
    belongs to the cluster in whose subspace of `rank` further directions it has the least error."""

    directions: np.ndarray | None
    rank: int


class _Groups(NamedTuple):
    """Probes in the order of their clusters: their indices, their clusters, and the first probe of each cluster."""

    order: np.ndarray
    label: np.ndarray
    start: np.ndarray


class _Plan(NamedTuple):
    """Bits of each column of `Components.code`, GPU bytes, predicted error, and the division."""

    width: list[int]
    size: int
    error: float
    division: _Division


def _divided(unit: np.ndarray, clusters: int, rank: int) -> _Division:
    """Divides probes [V, D] among clusters; 0 clusters stand for the unit vectors."""
    if clusters == 0:
        return _Division(None, 0)
    label = np.zeros(len(unit), int)
    if clusters > 1:
        label = kmeans2(unit, clusters, iter=_ROUNDS, minit="++", rng=0)[1]
        for _ in range(_ROUNDS):
            label = _nearest(unit, _Division(_subspaces(unit, label, 1 + rank), rank))
    return _Division(_subspaces(unit, label, max(1, min(unit.shape[1] - 1, _MOST))), rank)


def _subspaces(unit: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """Returns the mean and `count` - 1 principal directions of each cluster that has probes, [C, count, D]."""
    result = []
    for cluster in np.unique(label):
        rows = unit[label == cluster]
        mean = rows.mean(0)
        vectors = np.linalg.eigh((rows - mean).T @ (rows - mean))[1]
        result.append(np.concatenate([mean[None], vectors.T[::-1]])[:count])
    return np.array(result)


def _nearest(unit: np.ndarray, division: _Division) -> np.ndarray:
    """Returns the cluster of each probe, int [V]."""
    error = np.empty((len(unit), len(division.directions)))
    for cluster, each in enumerate(division.directions):
        away = unit - each[0]
        inside = away @ each[1 : 1 + division.rank].T
        error[:, cluster] = np.einsum("nd,nd->n", away, away) - np.einsum("nk,nk->n", inside, inside)
    return error.argmin(1)


def _grouped(unit: np.ndarray, division: _Division) -> tuple[_Groups, _Division]:
    """Returns the probes of each cluster, and the division without clusters that have no probe."""
    if division.directions is None:
        nothing = np.zeros(len(unit), int)
        return _Groups(np.arange(len(unit)), nothing, nothing[:1]), division
    used, label = np.unique(_nearest(unit, division), return_inverse=True)
    order = np.argsort(label, kind="stable")
    start = np.searchsorted(label[order], np.arange(len(used)))
    return _Groups(order, label[order], start), division._replace(directions=division.directions[used])


def _numbers(unit: np.ndarray, groups: _Groups, division: _Division) -> tuple[np.ndarray, np.ndarray]:
    """Returns the coefficients [V, K] of probes [V, D] in the order of their clusters, and the sums of these
    components, [V, D]."""
    if division.directions is None:
        return unit, unit
    numbers, sums = np.ones((len(unit), division.directions.shape[1])), np.empty_like(unit)
    for each, rows in zip(division.directions, _pieces(groups), strict=True):
        numbers[rows, 1:] = (unit[rows] - each[0]) @ np.linalg.pinv(each[1:])
        sums[rows] = numbers[rows] @ each
    return numbers, sums


def _plans(
    unit: np.ndarray, logarithm: np.ndarray, division: _Division, bits: int, live: int, hours: int
) -> list[_Plan]:
    """Allocates 0, 1, ... `bits` bits of each probe to the logarithm of its magnitude and to its coefficients, with the
    least sum of squared errors. `unit` and `logarithm` may be of fewer probes than `live`."""
    groups, division = _grouped(unit, division)
    unit, logarithm = unit[groups.order], logarithm[groups.order]
    numbers, sums = _numbers(unit, groups, division)
    rest = np.square(unit - sums).sum()
    places, total, last, picks = np.arange(bits + 1), np.zeros(bits + 1), np.zeros(bits + 1, int), []
    for column, values in enumerate([logarithm, *numbers.T]):
        options = np.full((_WIDEST + 1, bits + 1), np.inf)
        for width in range(min(_WIDEST, bits) + 1):
            error = np.square(_quantised(values, groups, width).values - values).sum()
            if column == 0 and division.directions is None:
                error *= _MADE_UP
            options[width, width:] = total[: bits + 1 - width] + error
        pick = options.argmin(0)
        total, last = options.min(0), np.where(pick > 0, column, last[places - pick])
        picks.append(pick)
    clusters = len(groups.start)
    index = (clusters - 1).bit_length()
    plans = []
    for spent, error in enumerate(np.sqrt((total + rest) / len(unit))):
        count = unit.shape[1] if division.directions is None else max(int(last[spent]), 1)
        identity = division.directions is None
        size = component_bytes(live, unit.shape[1] // hours, count, clusters, index + spent, hours, identity=identity)
        width, left = [], spent
        for pick in reversed(picks):
            width.insert(0, int(pick[left]))
            left -= width[0]
        plans.append(_Plan([index, *width[: 1 + count]], size, float(error), division))
    return plans


def _coded(values: np.ndarray, light: np.ndarray, hours: int, plan: _Plan) -> tuple[Components, float]:
    """Codes probes [V, T D] of given magnitudes; returns the components and their error relative to these."""
    width, division = plan.width, plan.division
    basis = np.zeros((0, values.shape[1]), np.float16)
    if division.directions is not None:
        basis = division.directions[:, : len(width) - 2].astype(np.float16)
        division = division._replace(directions=basis.astype(np.float64))
    groups, division = _grouped(values / light[:, None], division)
    if division.directions is not None:
        basis = division.directions.astype(np.float16).reshape(-1, values.shape[1])
    values, light = values[groups.order], light[groups.order]
    columns = [_quantised(np.log(light), groups, width[1])]
    magnitude = np.exp(columns[0].values)[:, None]
    # The coefficients make up for the rounding of the magnitude and of the directions.
    numbers = _numbers(values / magnitude, groups, division)[0]
    columns += [_quantised(column, groups, bits) for column, bits in zip(numbers.T, width[2:], strict=True)]
    decoded = np.stack([column.values for column in columns[1:]], 1)
    if division.directions is not None:
        pairs = zip(division.directions, _pieces(groups), strict=True)
        decoded = np.concatenate([decoded[rows] @ each for each, rows in pairs])
    error = norms(magnitude * decoded - values) / light
    code = np.empty((len(values), len(width)), np.uint8)
    code[groups.order] = np.stack([groups.label, *(column.code for column in columns)], 1)
    bounds = np.stack([np.stack([column.low, column.step]) for column in columns], 2).astype(np.float16)
    components = Components(values.shape[1] // hours, code, np.array(width, np.uint8), bounds, basis, hours)
    return components, float(np.sqrt(np.square(error).mean()))


class _Quantised(NamedTuple):
    """Rounded numbers [V] and their codes, and the lowest value and the step of each cluster."""

    values: np.ndarray
    code: np.ndarray
    low: np.ndarray
    step: np.ndarray


def _quantised(numbers: np.ndarray, groups: _Groups, width: int) -> _Quantised:
    """Quantises numbers [V], in the order of their clusters, over their range in each cluster, or over the share of it
    that has the least squared error."""
    label, start = groups.label, groups.start
    mean = np.add.reduceat(numbers, start) / np.diff(start, append=len(numbers))
    if width == 0:
        low = mean.astype(np.float16).astype(np.float64)
        return _Quantised(low[label], np.zeros(len(numbers), np.uint8), low, np.zeros_like(low))
    below, above = np.minimum.reduceat(numbers, start) - mean, np.maximum.reduceat(numbers, start) - mean
    best: list[np.ndarray] = []
    for share in _SHARES if width < _NARROW else _SHARES[:1]:
        low = -_half_above(-(mean + share * below))
        step = _half_above((mean + share * above - low) / (2**width - 1))
        code = np.divide(numbers - low[label], step[label], out=np.zeros_like(numbers), where=step[label] > 0)
        code = np.clip(np.rint(code), 0, 2**width - 1)
        values = low[label] + code * step[label]
        found = [values, code, low, step, np.add.reduceat(np.square(values - numbers), start)]
        if best:
            less = found[4] < best[4]
            pick = [less[label], less[label], less, less, less]
            found = [np.where(each, new, old) for each, new, old in zip(pick, found, best, strict=True)]
        best = found
    return _Quantised(best[0], best[1].astype(np.uint8), best[2], best[3])


def _half_above(numbers: np.ndarray) -> np.ndarray:
    near = numbers.astype(np.float16)
    return np.where(near < numbers, np.nextafter(near, np.float16(np.inf)), near).astype(np.float64)


def _pieces(groups: _Groups) -> list[slice]:
    """Returns the probes of each cluster, as slices."""
    return [slice(*ends) for ends in zip(groups.start, [*groups.start[1:], len(groups.order)], strict=True)]
