"""Fits principal components: divides probes among clusters, and allocates bits.

Every code of a probe costs bits, and every code of a cluster the memory of its direction. At a given price of a bit,
each code has the number of bits that is cheapest together with its squared error, and each probe belongs to the cluster
that is cheapest for it; a bisection finds the price at which the whole has the wanted size or error (Chou, Lookabaugh
and Gray, Entropy-Constrained Vector Quantization, 1989, with codes of one length in each cluster).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.cluster.vq import kmeans2

from wlm.probe.pca.model import LEVELS, WIDEST, Components, component_bytes, unit_of
from wlm.probe.relative import norms

ENOUGH = 0.02
"""Error at which no bit is added: in root mean square over all probes, as a share of their light."""

_TRIED = ((8, 16, 32, 64), (4, 1))  # numbers of clusters, each way until there is no gain
_FEWEST = 8  # probes per cluster, in the mean; smaller sets have unit vectors, unless their probes have many numbers
_MEANS, _SUBSPACES, _PRICED, _LAST = 5, 3, 3, 4  # rounds of k-means, with subspaces, with prices, and of all probes
_RANK = 8  # dimension of a subspace before there are prices
_MOST = 64  # directions of a cluster
_SAMPLE = 1 << 13  # probes from which clusters are chosen
_MADE_UP = 1 / 16  # of the rounding of the magnitude, that coefficients in unit vectors do not make up for
_NARROW, _SHARES = 5, (1.0, 0.75, 0.5)  # fewer bits may be worth more if they cover only a share of the range
_CHEAP, _DEAR, _HALVINGS = -80.0, 40.0, 48  # exponents of prices, and the steps of their bisection


class _Target(NamedTuple):
    """The wanted size and error of V probes of D numbers at T hours: most bytes, and an error that is enough."""

    live: int
    outputs: int
    hours: int
    bytes: float
    error: float


class _Clusters(NamedTuple):
    """Probes in the order of their clusters: their indices, their clusters, and the first probe of each cluster."""

    order: np.ndarray
    label: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, label: np.ndarray) -> "_Clusters":
        order = np.argsort(label, kind="stable")
        return cls(order, label[order], np.searchsorted(label[order], np.arange(label.max() + 1)))

    @property
    def rows(self) -> list[np.ndarray]:
        """The indices of the probes of each cluster."""
        return np.split(self.order, self.start[1:])


class _Table(NamedTuple):
    """Errors of clusters by numbers of bits.

    Attributes:
        clusters: The probes of each cluster.
        directions: float64 [C, 1 + K, D], mean and directions; None: unit vectors without a mean.
        error: float64 [C, 1 + K, WIDEST + 1], sum of the squared errors of the magnitude and of each coefficient, by
            its bits.
        low, step: Their codes, of the same shape.
        rest: Sum of squared errors that no number of bits removes.
        rounding: float64 [C], sum of the squared errors by rounded directions in each dimension that these do not span.
    """

    clusters: _Clusters
    directions: np.ndarray | None
    error: np.ndarray
    low: np.ndarray
    step: np.ndarray
    rest: float
    rounding: np.ndarray


class _Plan(NamedTuple):
    """Bits of each code, [C, 1 + K], at a price of a bit; GPU bytes; predicted error; and the table they are from."""

    width: np.ndarray
    price: float
    size: int
    error: float
    table: _Table


def fit_components(
    values: np.ndarray, most_bytes: int | None = None, hours: int = 1, enough: float = ENOUGH, *, relative: bool = True
) -> tuple[Components, float]:
    """Compresses live probes to the smallest GPU buffers whose error is at most `enough`, over all hours.

    Args:
        values: float32 [V, T D], numbers of live probes at T hours; no row is zero.
        most_bytes: Largest number of GPU bytes; None: no limit. The smallest model may be larger.
        hours: T.
        enough: Error at which no bit is added.
        relative: Whether the error of a probe is a share of its own light, the norm of its numbers; else of the root
            mean square light of all probes.

    Returns:
        The components and their error, the root mean square over the probes, which exceeds `enough` only if
        `most_bytes` or the widest codes do not allow less.
    """
    values = values.astype(np.float64)
    live, numbers = values.shape
    light = norms(values)
    if not relative:  # rounded like the codes of magnitudes, so that it takes no bits and has no error
        light[:] = np.exp(np.float64(np.float16(np.log(np.sqrt(np.square(light).mean())))))
    unit, logarithm = values / light[:, None], np.log(light)
    target = _Target(live, numbers // hours, hours, np.inf if most_bytes is None else most_bytes, enough)
    some = slice(None, None, -(-live // _SAMPLE))
    best = None
    if live <= max(_FEWEST, numbers) * _FEWEST:
        best = _planned(_tabled(unit, logarithm, np.zeros(live, int), hours, identity=True), target)
    for counts in _TRIED:
        for clusters in counts:
            if clusters > max(live // _FEWEST, 1):
                continue
            label = _divided(unit[some], clusters)
            plan = _refined(unit[some], logarithm[some], label, target, _PRICED if clusters > 1 else 1)
            better = best is None or _worth(plan, target) < _worth(best, target)
            best = plan if better else best
            if not better:
                break
    assert best is not None
    if best.table.directions is not None:
        label = _cheapest(unit, logarithm, best)
        best = _refined(unit, logarithm, label, target, _LAST)
    while True:  # the errors of plans are predictions, far too small for magnitudes without bits
        components, error = _coded(values, light, hours, best)
        if error <= enough or best.error > target.error or not best.error:
            return components, error
        lower = min(max(0.9 * target.error * enough / error, 0.5 * best.error), 0.99 * best.error)
        best = _planned(best.table, target := target._replace(error=lower))


def _worth(plan: _Plan, target: _Target) -> tuple[float, float, int]:
    """Returns what is less for a better plan."""
    return max(plan.size, target.bytes), max(plan.error, target.error), plan.size


def _divided(unit: np.ndarray, clusters: int) -> np.ndarray:
    """Returns a first cluster of each probe [V, D]: the one in whose subspace it has the least error."""
    clusters = min(clusters, len(np.unique(unit.round(6), axis=0)))
    label = np.zeros(len(unit), int)
    if clusters == 1:
        return label
    label = _compact(kmeans2(unit, clusters, iter=_MEANS, minit="++", rng=0)[1])
    for _ in range(_SUBSPACES):
        error = np.empty((len(unit), label.max() + 1))
        for cluster, rows in enumerate(_Clusters.of(label).rows):
            mean, *directions = _directions(unit[rows], _RANK)
            away = unit - mean
            error[:, cluster] = np.square(away).sum(1) - np.square(away @ np.array(directions).T).sum(1)
        label = _compact(error.argmin(1))
    return label


def _compact(label: np.ndarray) -> np.ndarray:
    return np.unique(label, return_inverse=True)[1]


def _directions(unit: np.ndarray, count: int) -> np.ndarray:
    """Returns the mean of probes [V, D] and their first principal directions, [1 + count, D]."""
    mean = unit.mean(0)
    vectors = np.linalg.eigh((unit - mean).T @ (unit - mean))[1].T[::-1]
    return np.concatenate([mean[None], vectors[:count]])


def _tabled(
    unit: np.ndarray, logarithm: np.ndarray, label: np.ndarray, hours: int, *, identity: bool = False
) -> _Table:
    """Measures the errors of all numbers of bits for probes [V, D] in given clusters."""
    clusters = _Clusters.of(label)
    order, rest, directions, rounding = clusters.order, 0.0, None, np.zeros(label.max() + 1)
    columns = [logarithm[order], *unit[order].T]
    if not identity:
        directions = np.stack([_directions(unit[rows], _MOST) for rows in clusters.rows])
        away = [unit[rows] - own[0] for rows, own in zip(clusters.rows, directions, strict=True)]
        inside = np.concatenate([each @ own[1:].T for each, own in zip(away, directions, strict=True)])
        rest = max(sum(float(np.square(each).sum()) for each in away) - float(np.square(inside).sum()), 0.0)
        columns[1:] = inside.T
    found = [[_quantised(column, clusters, width, rough=True) for width in range(WIDEST + 1)] for column in columns]
    error, low, step = (np.array([[each[i] for each in row] for row in found]).transpose(2, 0, 1) for i in (1, 2, 3))
    if identity:
        error[:, 0] *= _MADE_UP
    if directions is not None and hours == 1:
        energy = np.concatenate([np.bincount(label)[:, None], error[:, 1:, 0]], 1)
        rounding = (energy * np.square(np.abs(directions).max(2) / LEVELS) / 12).sum(1)
    return _Table(clusters, directions, error, low, step, rest, rounding)


def _priced(table: _Table, price: float, target: _Target) -> _Plan:
    """Gives each code the bits that are cheapest at a price of a bit."""
    probes = len(table.clusters.order)
    counts = np.diff(table.clusters.start, append=probes)
    share, identity = target.live / probes, table.directions is None
    cost = table.error + price * counts[:, None, None] * np.arange(WIDEST + 1)
    width = cost.argmin(2)
    used = np.ones(width.shape, bool)
    if not identity:
        # The price of a direction's memory, which these probes pay in proportion to their number.
        some = target.live, target.outputs
        memory = component_bytes(*some, 8, 1, 0, target.hours, identity=False)
        memory -= component_bytes(*some, 4, 1, 0, target.hours, identity=False)
        used[:, 1:] = (table.error[:, :, 0] - cost.min(2))[:, 1:] > price * 8 * memory / 4 / share
        width *= used
        used[:, 1:] &= width[:, 1:] > 0
    bits = int(np.ceil(share * (counts * width.sum(1)).sum()))
    columns = int(used.sum()) + (0 if identity else len(width))  # of the means, too
    sizes = target.live, target.outputs, columns, len(width), bits, target.hours
    error = table.rest + np.take_along_axis(table.error, width[..., None], 2).sum()
    error += (table.rounding * np.maximum(target.hours * target.outputs - used.sum(1), 0)).sum()
    return _Plan(width, price, component_bytes(*sizes, identity=identity), float(np.sqrt(error / probes)), table)


def _planned(table: _Table, target: _Target) -> _Plan:
    """Finds the price for which the bytes suffice, or a higher one for which the error is still small enough."""

    def edge(too_dear: Callable[[_Plan], bool]) -> tuple[_Plan, _Plan]:
        low, high = _CHEAP, _DEAR
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if too_dear(_priced(table, 2.0**middle, target)) else (middle, high)
        return _priced(table, 2.0**low, target), _priced(table, 2.0**high, target)

    fitting = edge(lambda plan: plan.size <= target.bytes)[1]
    if fitting.error > target.error:
        return fitting
    return edge(lambda plan: plan.error > target.error)[0]


def _refined(unit: np.ndarray, logarithm: np.ndarray, label: np.ndarray, target: _Target, rounds: int) -> _Plan:
    """Moves probes to the clusters that are cheapest for them, and returns the best plan of some rounds."""
    plans = [_planned(_tabled(unit, logarithm, label, target.hours), target)]
    for _ in range(rounds - 1):
        label = _cheapest(unit, logarithm, plans[-1])
        plans.append(_planned(_tabled(unit, logarithm, label, target.hours), target))
    return min(plans, key=lambda plan: _worth(plan, target))


def _cheapest(unit: np.ndarray, logarithm: np.ndarray, plan: _Plan) -> np.ndarray:
    """Returns the cluster of each probe, int [V], in which its squared error and the price of its bits are least."""
    table, cost = plan.table, np.empty((len(unit), len(plan.width)))
    assert table.directions is not None
    for cluster, (width, own) in enumerate(zip(plan.width, table.directions, strict=True)):
        used = np.flatnonzero(width[1:]) + 1
        away = unit - own[0]
        inside = away @ own[used].T
        columns = np.concatenate([logarithm[:, None], inside], 1)
        at = cluster, np.append(0, used), width[np.append(0, used)]
        low, step = table.low[at], table.step[at]
        code = np.divide(columns - low, step, out=np.zeros_like(columns), where=step > 0)
        coded = low + step * np.clip(np.rint(code), 0, 2.0 ** at[2] - 1)
        cost[:, cluster] = np.square(away).sum(1) - np.square(inside).sum(1) + np.square(coded - columns).sum(1)
        cost[:, cluster] += plan.price * width.sum()
    return _compact(cost.argmin(1))


def _coded(values: np.ndarray, light: np.ndarray, hours: int, plan: _Plan) -> tuple[Components, float]:
    """Codes probes [V, T D] of given magnitudes; returns the components and their error relative to these."""
    table, chosen = plan.table, [np.append(0, np.flatnonzero(width[1:]) + 1) for width in plan.width]
    identity = table.directions is None
    columns = 1 + (values.shape[1] if identity else max(map(len, chosen)))
    shape = len(chosen), columns
    number = np.float16 if hours > 1 else np.int8
    basis = np.zeros((0 if identity else len(chosen), columns - 1, values.shape[1]), number)
    bounds, widths = np.zeros((2, *shape), np.float16), np.zeros(shape, np.uint8)
    code, cluster, square = np.zeros((len(values), columns), np.uint16), np.empty(len(values), np.uint8), 0.0
    for own, (rows, used) in enumerate(zip(table.clusters.rows, chosen, strict=True)):
        one = _Clusters.of(np.zeros(len(rows), int))
        width = plan.width[own].tolist()
        found = [_quantised(np.log(light[rows]), one, width[0])]
        magnitude = np.exp(found[0].values)[:, None]
        # The coefficients make up for the rounding of the magnitude and of the directions.
        numbers = values[rows] / magnitude
        if table.directions is None:
            found += [_quantised(column, one, bits) for column, bits in zip(numbers.T, width[1:], strict=True)]
            sums = np.stack([each.values for each in found[1:]], 1)
        else:
            basis[own, : len(used)], scale = _rounded(table.directions[own, used], hours)
            mean, *directions = basis[own, : len(used)].astype(np.float64) * unit_of(basis)
            found.append(_quantised(np.full(len(rows), scale), one, 0))
            sums = found[1].values[:, None] * mean
            if directions:
                numbers = (numbers - sums) @ np.linalg.pinv(directions)
                found += [_quantised(column, one, width[k]) for column, k in zip(numbers.T, used[1:], strict=True)]
                sums += np.stack([each.values for each in found[2:]], 1) @ directions
        square += float(np.square((magnitude * sums - values[rows]) / light[rows, None]).sum())
        cluster[rows], code[rows, : len(found)] = own, np.stack([each.code for each in found], 1)
        bounds[:, own, : len(found)] = np.concatenate([(each.low, each.step) for each in found], 1)
        widths[own, : len(found)] = width if identity else [width[0], 0, *(width[k] for k in used[1:])]
    components = Components(values.shape[1] // hours, cluster, code, widths, bounds, basis, hours)
    return components, math.sqrt(square / len(values))


def _rounded(directions: np.ndarray, hours: int) -> tuple[np.ndarray, float]:
    """Rounds directions [K, T D] to the form in which a model stores them, each over its own range; returns also the
    scale of the first."""
    if hours > 1:
        return directions.astype(np.float16), 1.0
    scale = np.abs(directions).max(1, keepdims=True)
    scale[scale == 0] = 1.0
    return np.rint(directions / scale * LEVELS).astype(np.int8), float(scale[0, 0])


class _Quantised(NamedTuple):
    """Codes of numbers [V], the sum of squared errors, the lowest value and the step of each cluster, and the rounded
    numbers."""

    code: np.ndarray
    error: np.ndarray
    low: np.ndarray
    step: np.ndarray
    values: np.ndarray


def _quantised(numbers: np.ndarray, clusters: _Clusters, width: int, *, rough: bool = False) -> _Quantised:
    """Quantises numbers [V], in the order of their clusters, over their range in each cluster, or over the share of it
    that has the least squared error. `rough` codes are not rounded where they are wide, and their error is a mean."""
    label, start = clusters.label, clusters.start
    counts = np.diff(start, append=len(numbers))
    mean = np.add.reduceat(numbers, start) / counts
    if width == 0:
        low = mean.astype(np.float16).astype(np.float64)
        error = np.add.reduceat(np.square(low[label] - numbers), start)
        return _Quantised(np.zeros(len(numbers)), error, low, np.zeros_like(low), low[label])
    below, above = np.minimum.reduceat(numbers, start) - mean, np.maximum.reduceat(numbers, start) - mean
    best: list[np.ndarray] = []
    for share in _SHARES if width < _NARROW else _SHARES[:1]:
        low = -_half_above(-(mean + share * below))
        step = _half_above((mean + share * above - low) / (2**width - 1))
        if rough and width >= _NARROW:
            return _Quantised(numbers, counts * np.square(step) / 12, low, step, numbers)
        code = np.divide(numbers - low[label], step[label], out=np.zeros_like(numbers), where=step[label] > 0)
        code = np.clip(np.rint(code), 0, 2**width - 1)
        values = low[label] + code * step[label]
        found = [code, np.add.reduceat(np.square(values - numbers), start), low, step, values]
        if best:
            less = found[1] < best[1]
            pick = [less[label], less, less, less, less[label]]
            found = [np.where(each, new, old) for each, new, old in zip(pick, found, best, strict=True)]
        best = found
    return _Quantised(*best)


def _half_above(numbers: np.ndarray) -> np.ndarray:
    near = numbers.astype(np.float16)
    return np.where(near < numbers, np.nextafter(near, np.float16(np.inf)), near).astype(np.float64)
