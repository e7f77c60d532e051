"""Probes from coarse to fine, each but the first predicted from coarser ones: a transform over free positions.

A level has the probes that are a distance from all of the coarser levels and from each other, as many as there is room
for; the next level's distance is half of that. Or it has one probe for each cube of a grid that no coarser level has a
probe in, which costs some 8% more bytes, for walls lie across cubes as it happens. A probe's value is the kriging of
the nearest eight of the coarser levels plus its own coefficient (the predicting transform of point clouds, Mammou,
Tourapis, Kim, Robinet, Valentin and Su, Lifting Scheme for Lossy Attribute Encoding, MPEG m42640, 2018):

    value[i] = sum_j w_ij value[parent_ij] + coefficient[i]

A coefficient of a coarse probe reaches many values: `reach` is about the length of what one unit of it changes.
"""

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from wlm.probe.kriging import Kriging

PARENTS = 8
RADII = (0, 45875, 39322, 55706)
"""First distances of the spread levels, in codes; with 0 levels are by cubes, as in all earlier files."""

FIRST = 1
"""The place of that which a fit begins with."""

_FINEST = 18  # halvings: positions have 16 bits an axis
_LEAST = 64  # of a squared distance: all that are left are the last level
_BATCH = 64  # probes that are looked at together at least
_MIX = 2654435761  # odd, 2^32 over the golden ratio: an order without any in space
_FEW_TURNS, _TURNS = 15, 90  # of the power method
_GROWN = 1.03
_AT_ONCE = 1 << 21  # distances, where many places are as far


class Tree:
    """The levels of some places.

    Attributes:
        grid: The argument.
        levels: int64 [n] each, probes of a level in their order, the coarsest first.
        parents: int64 [n, K] each, of the levels but the first.
        order: int64 [N], the probes level after level.
        reach: float64 [N], at least 1.
    """

    def __init__(self, code: np.ndarray, grid: int = 0):
        """Makes the levels.

        Args:
            code: int [N, 3], positions in whole numbers below 2^16: all that follows depends on these alone.
            grid: The place of the first distance in `RADII`.
        """
        place = code.astype(np.float64)
        self.grid = grid
        whole = code.astype(np.int64)
        self.levels = _spread(whole, RADII[grid] ** 2) if grid else _levels(whole)
        self.parents: list[np.ndarray] = []
        self.reach = np.ones(len(code))
        self._down: list[sparse.csr_matrix] = []  # of a level: what it takes of those before it, in their order
        known = self.levels[0]
        weights = []
        for level in self.levels[1:]:
            index, weight = _FirstOfTies(place[known], PARENTS).weights(place[level])
            self.parents.append(known[index])
            weights.append(weight)
            self._down.append(_matrix(index, weight, len(known)))
            known = np.concatenate([known, level])
        self.order = known
        for level, parents, weight in zip(self.levels[:0:-1], self.parents[::-1], weights[::-1], strict=True):
            np.add.at(self.reach, parents, np.square(weight) * self.reach[level][:, None])
        self.reach = np.sqrt(self.reach)
        self._up = [matrix.T.tocsr() for matrix in self._down]
        self._single: tuple[list[sparse.csr_matrix], list[sparse.csr_matrix]] | None = None

    def values(self, coefficient: np.ndarray) -> np.ndarray:
        """Values [N, D] of coefficients [N, D]."""
        return self._in_order(self.compose, coefficient)

    def coefficients(self, value: np.ndarray) -> np.ndarray:
        """Coefficients [N, D] of values [N, D]: undoes `values`."""
        value = value[self.order]
        result = np.empty_like(value)
        result[self.order] = value
        for level, matrix in zip(self.levels[1:], self._down, strict=True):
            result[level] -= matrix @ value[: matrix.shape[1]]
        return result

    def adjoint(self, value: np.ndarray) -> np.ndarray:
        """The transpose of `values`, [N, D] to [N, D]."""
        return self._in_order(self.transpose, value)

    def compose(self, number: np.ndarray) -> None:
        """`values` in place, of rows in `order`, float64 or float32."""
        for matrix in self._matrices(number.dtype)[0]:
            rows, before = matrix.shape
            number[before : before + rows] += matrix @ number[:before]

    def transpose(self, number: np.ndarray) -> None:
        """`adjoint` in place, of rows in `order`, float64 or float32."""
        for matrix in self._matrices(number.dtype)[1][::-1]:
            before, rows = matrix.shape
            number[:before] += matrix @ number[before : before + rows]

    def _matrices(self, dtype: np.dtype) -> tuple[list[sparse.csr_matrix], list[sparse.csr_matrix]]:
        if dtype != np.float32:
            return self._down, self._up
        if self._single is None:
            down, up = ([matrix.astype(np.float32) for matrix in matrices] for matrices in (self._down, self._up))
            self._single = down, up
        return self._single

    def _in_order(self, change: Callable[[np.ndarray], None], rows: np.ndarray) -> np.ndarray:
        ordered = rows[self.order]
        change(ordered)
        result = np.empty_like(ordered)
        result[self.order] = ordered
        return result

    @cached_property
    def eigenvalue(self) -> float:
        """About the largest one of the transform, its numbers divided by their reach, times its transpose."""
        vector, first, size = np.random.default_rng(0).standard_normal((len(self.reach), 1)), 1.0, 1.0
        for turn in range(_TURNS):
            vector = self.adjoint(self.values(vector / self.reach[:, None])) / self.reach[:, None]
            size = float(np.linalg.norm(vector))
            vector /= size
            if turn == _FEW_TURNS - 1:
                first = size
        # Few turns will do unless they end far below: one probe of few may change most, and its part grows late.
        return size if size > _GROWN * first else first


class Trees:
    """Trees that are made when they are asked for and kept, for sets of the same places; called as `Tree` is."""

    def __init__(self) -> None:
        self._made: dict[tuple[bytes, int], Tree] = {}

    def __call__(self, code: np.ndarray, grid: int = 0) -> Tree:
        key = code.tobytes(), grid
        if key not in self._made:
            self._made[key] = Tree(code, grid)
        return self._made[key]


class _FirstOfTies(Kriging):
    """Kriging of places in whole numbers, no two alike, whose choice among those that are as far is the first.

    Which of them a search tree finds differs between machines, and the odds of numbers follow from the parents.
    """

    def nearest(self, point: np.ndarray, asked: int) -> tuple[np.ndarray, np.ndarray]:
        distance, index = super().nearest(point, asked)
        self._settle(point, distance, index, 2 * asked)
        return distance, index

    def _settle(self, point: np.ndarray, distance: np.ndarray, index: np.ndarray, looked: int) -> None:
        """Puts the first of all that are as far into `index`, with so many places looked at."""
        looked, asked = min(looked, len(self.place)), distance.shape[1]
        # The last one is left out, unless all are taken.
        tied = np.flatnonzero(distance[:, -1] == distance[:, self.count - 1]) if self.count < asked else []
        for start in range(0, len(tied), max(1, _AT_ONCE // looked)):
            rows = tied[start : start + max(1, _AT_ONCE // looked)]
            far, number = super().nearest(point[rows], looked)
            order = np.lexsort((number, far), axis=-1)
            whole = far[:, -1] > distance[rows, -1] if looked < len(self.place) else np.ones(len(rows), bool)
            index[rows[whole]] = np.take_along_axis(number, order, 1)[whole, :asked]
            if not whole.all():
                more = rows[~whole]
                part = index[more]
                self._settle(point[more], distance[more], part, 2 * looked)
                index[more] = part


def flat(count: int) -> list[np.ndarray]:
    """The one level of probes that predict nothing."""
    return [np.arange(count)]


def _matrix(index: np.ndarray, weight: np.ndarray, count: int) -> sparse.csr_matrix:
    start = np.arange(len(index) + 1) * index.shape[1]
    return sparse.csr_matrix((weight.ravel(), index.ravel(), start), shape=(len(index), count))


def _levels(code: np.ndarray) -> list[np.ndarray]:
    chosen = np.zeros(len(code), bool)
    levels = []
    for halving in range(_FINEST):
        # Sides are powers of two, whole cubes of 2^16: their numbers are exact.
        cell = code >> max(16 - halving, 0)
        key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
        free = np.flatnonzero(~chosen & ~np.isin(key, key[chosen]))
        if halving == _FINEST - 1:
            # The last are where another probe is.
            free = np.flatnonzero(~chosen)
        elif len(free):
            middle = (2 * cell[free] + 1 << max(16 - halving, 0)) - 2 * code[free]
            order = np.lexsort((np.square(middle).sum(1), key[free]))
            first = np.diff(key[free][order], prepend=-1) != 0
            free = np.sort(free[order[first]])
        if len(free):
            chosen[free] = True
            levels.append(free)
        if chosen.all():
            break
    return levels


def _spread(code: np.ndarray, square: int) -> list[np.ndarray]:
    """Levels of probes that are apart, the first by a squared distance; all of it in whole numbers.

    Squares are sums below 2^34 of whole numbers: as floats they are exact, and a root's square rounds back to them.
    """
    count = len(code)
    order = np.argsort(np.arange(count, dtype=np.uint64) * np.uint64(_MIX) & np.uint64(0xFFFFFFFF), kind="stable")
    away = np.full(count, np.inf)  # squared distance to what is chosen, where that is near
    left, levels = np.ones(count, bool), []
    while left.any():
        if square < _LEAST:
            levels.append(np.flatnonzero(left))
            break
        chosen = _apart(code, order[left[order] & (away[order] >= square)], square)
        if len(chosen):
            levels.append(np.sort(chosen))
            left[chosen] = False
            square >>= 2
            rest = np.flatnonzero(left)
            away[rest] = np.minimum(away[rest], _squares(code[chosen], code[rest], square))
        else:
            square >>= 2
    return levels


def _apart(code: np.ndarray, waiting: np.ndarray, square: int) -> np.ndarray:
    """Of probes in their order each that isn't nearer than a squared distance to one before it that was taken."""
    taken: list[np.ndarray] = []
    count = 0
    while len(waiting):
        first = waiting[: max(_BATCH, 4 * count)]
        pairs = cKDTree(code[first]).query_pairs(math.sqrt(square) + 1.0, output_type="ndarray")
        near = np.square(code[first[pairs[:, 0]]] - code[first[pairs[:, 1]]]).sum(1) < square
        pairs = pairs[near]
        alive, chosen = np.ones(len(first), bool), np.zeros(len(first), bool)
        while alive.any():
            # Those that no one before them can rule out any more.
            sure = alive.copy()
            sure[pairs[:, 1]] = False
            chosen |= sure
            alive &= ~sure
            alive[pairs[sure[pairs[:, 0]], 1]] = False
            pairs = pairs[alive[pairs].all(1)]
        taken.append(first[chosen])
        count += len(taken[-1])
        waiting = waiting[len(first) :]
        waiting = waiting[_squares(code[taken[-1]], code[waiting], square) >= square]
    return np.concatenate(taken) if taken else np.zeros(0, np.int64)


def _squares(place: np.ndarray, point: np.ndarray, square: int) -> np.ndarray:
    """Squared distances of points to the nearest place, where they are below a square; else infinity, or more."""
    distance = cKDTree(place).query(point, distance_upper_bound=math.sqrt(square) + 1.0)[0]
    return np.rint(np.square(distance))
