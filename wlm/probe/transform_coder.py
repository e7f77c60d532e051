"""Probes of one region as whole numbers: sparse where that costs little.

What is minimised is the squared error plus a price on every number, by FISTA (Beck and Teboulle, A Fast Iterative
Shrinkage-Thresholding Algorithm, 2009), over the tree's transform, which is not orthogonal: rounding each number for
itself would cost up to 1 dB. The kept numbers are then fitted without the price, and rounded; where the rounding of
others can be made up for, they are moved.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm.probe.entropy import LARGEST
from wlm.probe.transform import Coding, Places, colours, make_stream, stored_step
from wlm.probe.tree import FIRST, RADII, Tree

MANY = 4096
"""Probes above which a fit begins where one at a near step came to."""

BIT = 0.1155
"""Squared steps that a bit is worth at fine steps: 2 ln 2 / 12."""

_ABOVE = 1.05  # the largest eigenvalue of the transform: what a step downhill is divided by
_PRICE = 0.25  # of a number that isn't zero, in steps
_ROUND = 0.4  # what is added before rounding down: below half, a smaller number is cheaper
_SPARSE, _FREE, _MOVES = 25, 15, 3  # rounds with the price, without it, and of moving rounded numbers
# Of many probes, whose numbers depend on each other farther: rounds with the price, and from where these came to for
# another step; and what is added, for a number that is kept is worth its bits.
_OF_MANY, _AGAIN, _NEAR, _HALF = 45, 10, 0.1, 0.5
_SINGLE, _LEAST_SINGLE = 2.0**13, 1e-30  # the largest number in steps up to which float32 will do, and the least step


@dataclass(frozen=True)
class Measured:
    """What a region says of itself before it is coded.

    Attributes:
        largest: Of its numbers.
        inner: Live probes that are predicted.
        change: float64 [D, D], the sum of the products of what isn't predicted, in terms of `colours`.
    """

    largest: float
    inner: int
    change: np.ndarray


@dataclass(frozen=True)
class Coded:
    """A region's numbers at a step.

    Attributes:
        stream: uint8 [B].
        error: The sum of squares.
        grid: Of the tree.
    """

    stream: np.ndarray
    error: float
    grid: int

    def cost(self, step: float) -> float:
        """The error, with what the bytes are worth at a step."""
        return self.error + BIT * step**2 * 8 * len(self.stream)


class Coder:
    """The probes of a region."""

    def __init__(
        self,
        position: np.ndarray,
        values: np.ndarray,
        live: np.ndarray,
        trees: Callable[[np.ndarray, int], Tree] = Tree,
    ):
        """Makes the tree.

        Args:
            position: float64 [N, 3].
            values: float32 [N, D].
            live: bool [N], one at least is.
            trees: What makes a tree of places.
        """
        self._trees = trees
        self._values = values[live].astype(np.float64)
        self._code = Places.of(position).code[live]
        self._coding = Coding(True)
        self._turned: np.ndarray | None = None
        self._warm: tuple[float, np.ndarray] | None = None  # a step, and where its numbers came to
        self.plant(FIRST)

    def measure(self) -> Measured:
        tree = self._tree
        inner = np.concatenate([*tree.levels[1:], np.zeros(0, np.int64)]).astype(np.int64)
        predicted = tree.coefficients(self._values)
        largest = float(np.abs(predicted @ colours(self._values.shape[1]) * tree.reach[:, None]).max())
        change = (predicted @ colours(self._values.shape[1]))[inner]
        return Measured(largest, len(inner), change.T @ change)

    def choose(self, coding: Coding) -> None:
        """Takes a way to code."""
        self._coding, self._turned, self._warm = coding, None, None

    def settle(self, step: float) -> None:
        """Takes the grid of the tree that costs least at a step."""
        if not self._coding.predicted or len(self._tree.levels) < 2:
            return
        # Of many probes the other distances cost more time than they are worth bytes.
        others = range(len(RADII)) if len(self._code) <= MANY else (0, 1)
        trees = [self._tree] + [self._trees(self._code, grid) for grid in others if grid != self._tree.grid]
        costs = []
        for self._tree in trees:
            costs.append(self.plain(step).cost(stored_step(step)))
        self._take(trees[int(np.argmin(costs))])

    def plant(self, grid: int) -> None:
        """Takes the tree of a grid."""
        self._take(self._trees(self._code, grid))

    def _take(self, tree: Tree) -> None:
        self._tree, self._warm = tree, None

    def plain(self, step: float) -> Coded:
        """Each number rounded for itself."""
        return self._coded(step, _rounded(self._exact() / stored_step(step)))

    def uncoded(self, step: float) -> Coded:
        """As `plain`, without the bytes."""
        step = stored_step(step)
        return Coded(np.zeros(0, np.uint8), self._error(step, _rounded(self._exact() / step)), self._tree.grid)

    def fitted(self, step: float) -> Coded:
        """Numbers that are worth their bits together."""
        tree, step = self._tree, stored_step(step)
        if not self._coding.predicted:
            return self.plain(step)
        order, bound = tree.order, _ABOVE * tree.eigenvalue
        # Half the memory, which is what takes the time, where that leaves a thousandth of a step.
        single = step > _LEAST_SINGLE and np.abs(self._exact()).max() < _SINGLE * step
        kind = np.float32 if single else np.float64
        target, reach = self._target()[order].astype(kind), tree.reach[order, None].astype(kind)

        def downhill(number: np.ndarray) -> np.ndarray:
            change = number / reach
            tree.compose(change)
            change -= target
            tree.transpose(change)
            change /= reach
            change /= bound
            return np.subtract(number, change, out=change)

        price = _PRICE * step / bound

        def shrunk(number: np.ndarray) -> np.ndarray:
            size = np.abs(number)
            size -= price
            return np.copysign(np.maximum(size, 0.0, out=size), number, out=size)

        def priced(number: np.ndarray, rounds: int) -> np.ndarray:
            return _accelerated(number, lambda x: shrunk(downhill(x)), rounds)

        share = _ROUND
        if len(target) <= MANY:
            number = priced(self._exact()[order].astype(kind), _SPARSE)
        elif self._warm is None or abs(math.log2(step / self._warm[0])) > _NEAR:
            number = priced(self._exact()[order].astype(kind), _OF_MANY)
            self._warm, share = (step, number), _HALF
        else:
            # All from one place: a fit that went on from the last one would keep fewer and fewer numbers.
            number, share = priced(self._warm[1].astype(kind), _AGAIN), _HALF
        kept = number != 0.0
        number = _accelerated(number, lambda x: downhill(x) * kept, _FREE)
        q = _rounded(number / step, share)
        for _ in range(_MOVES):
            moved = downhill((q * step).astype(kind)) / step
            q = np.where((q == 0) & (np.abs(moved) < 1.0 - share), 0, _rounded(moved, share))
        back = np.empty_like(q)
        back[order] = q
        return self._coded(step, back)

    def _target(self) -> np.ndarray:
        if self._turned is None:
            self._turned = self._values @ self._coding.basis(self._values.shape[1])
        return self._turned

    def _exact(self) -> np.ndarray:
        """The numbers before rounding, in units of the values."""
        turned = self._target()
        return self._tree.coefficients(turned) * self._tree.reach[:, None] if self._coding.predicted else turned

    def _coded(self, step: float, q: np.ndarray) -> Coded:
        tree = self._tree if self._coding.predicted else None
        return Coded(make_stream(self._coding, tree, q), self._error(stored_step(step), q), self._tree.grid)

    def _error(self, step: float, q: np.ndarray) -> float:
        decoded = q * step
        if self._coding.predicted:
            decoded = self._tree.values(decoded / self._tree.reach[:, None])
        return float(np.square(decoded - self._target()).sum())


class Coders:
    """The coders of some regions, by their numbers: what a process of a fit holds."""

    def __init__(self, trees: Callable[[np.ndarray, int], Tree] = Tree) -> None:
        self._trees = trees
        self._coders: dict[int, Coder] = {}

    def add(self, number: int, position: np.ndarray, values: np.ndarray, live: np.ndarray) -> Measured:
        self._coders[number] = Coder(position, values, live, self._trees)
        return self._coders[number].measure()

    def run(self, method: str, *arguments: Any) -> dict[int, Any]:
        return {number: getattr(coder, method)(*arguments) for number, coder in self._coders.items()}

    def close(self) -> None:
        self._coders.clear()


def _rounded(number: np.ndarray, share: float = _ROUND) -> np.ndarray:
    size = np.minimum(np.floor(np.abs(number) + share), LARGEST)
    return np.copysign(size, number).astype(np.int64)


def _accelerated(first: np.ndarray, step: Callable[[np.ndarray], np.ndarray], rounds: int) -> np.ndarray:
    """FISTA: a step from where the last two point to."""
    current, ahead, weight = first, first, 1.0
    for _ in range(rounds):
        before, current = current, step(ahead)
        following = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * weight * weight))
        ahead = current - before
        ahead *= (weight - 1.0) / following
        ahead += current
        weight = following
    return current
