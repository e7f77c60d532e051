"""Choosing the whole numbers of a transform: sparse where that costs little, and a step for a PSNR or a size.

What is minimised is the squared error plus a price on every number, by FISTA (Beck and Teboulle, A Fast Iterative
Shrinkage-Thresholding Algorithm, 2009), over the tree's transform, which is not orthogonal: rounding each number for
itself would cost up to 1 dB. The kept numbers are then fitted without the price, and rounded; where the rounding of
others can be made up for, they are moved.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.entropy import LARGEST
from wlm.probe.model import Profile
from wlm.probe.transform import FINENESS, VECTORS, Coding, Places, TransformModel, colours, make_stream, read_values
from wlm.probe.tree import Tree
from wlm.system import Meter, OnProgress

_PRICE = 0.25  # of a number that isn't zero, in steps
_ABOVE = 1.05  # the largest eigenvalue of the transform: what a step downhill is divided by
_ROUND = 0.4  # what is added before rounding down: below half, a smaller number is cheaper
_SPARSE, _AGAIN = 25, 20  # rounds with the price, and for another step
_FREE, _MOVES = 15, 3  # rounds without the price, and of moving rounded numbers
_BIT = 0.1155  # squared steps that a bit is worth at fine steps: 2 ln 2 / 12
_COUNTS = (1, 2, 4, 8, 16)  # of stored directions that are tried, and all
_FEW = 4096  # probes up to which it matters how many directions are stored, and how finely
_WIDEST = 64  # numbers of a probe up to which directions are looked for
_TRIES = 14
_FAR = 0.25  # octaves of a step that comes nowhere by smaller ones
_LEAST = -149.0  # of the step's logarithm: float32 has no less
PSNR = 50.0
"""That is wanted where nothing is said."""

_CLOSE = 0.03  # dB above the wanted PSNR that is near enough
FULL = 0.985
"""Of the largest size that is near enough."""


@dataclass(frozen=True, eq=False)
class Coded:
    """Numbers at a step, as a stream."""

    step: float
    stream: np.ndarray
    error: float  # sum of squares


def compress_transform(
    probes: ProbeSet, profile: Profile, *, positions: bool = False, progress: OnProgress | None = None
) -> TransformModel:
    """Compresses a set by a transform over its own places.

    Args:
        probes: The set.
        profile: Of the method "transform".
        positions: Whether the model carries the probes' places.
        progress: Called after each step size that is tried.

    Raises:
        WlmError: A size that nothing fits, or a PSNR that can't be reached.
    """
    search = Search(probes, profile, positions, progress)
    return search.model(search.chosen())


class Search:
    """The size and the error of a set at a step, and the step that is wanted.

    Attributes:
        coding: What the set is turned into before it is rounded.
    """

    def __init__(
        self,
        probes: ProbeSet,
        profile: Profile,
        positions: bool,
        progress: OnProgress | None,
        *,
        tree: Tree | None = None,
        peak: float | None = None,
    ) -> None:
        """Prepares a set.

        Args:
            probes, profile, positions, progress: As for `compress_transform`.
            tree: Of the live probes, where it is known already.
            peak: What PSNR is of, the range of the numbers unless it is given.
        """
        self._probes, self._profile = probes, profile
        self._places = Places.of(probes.position)
        self._stored = self._places if positions else None
        self._dead = np.zeros(0, bool) if probes.live.all() else ~probes.live
        self._values = probes.values[probes.live].astype(np.float64)
        self._peak = peak_of(probes) if peak is None else peak
        self._tree = Tree(self._places.code[probes.live]) if tree is None else tree
        self.coding = Coding(self._tree)
        # What is left of probes that are predicted exactly is zero.
        self._largest = float(np.abs(self._exact()).max()) or self._peak
        self._warm: np.ndarray | None = None
        # A fitted step is finer than a plain one of the same size: directions are chosen again where that is quick.
        self._rounds = 2 if len(self._values) <= _FEW else 1
        self._meter = Meter(progress, "fit", 0)
        self._tried = 0

    def chosen(self) -> Coded:
        """What has the wanted size, or the wanted PSNR."""
        psnr, limit = self._profile.target_psnr, self._profile.max_bytes
        if psnr is not None or limit is None:
            coded = self.smallest(PSNR if psnr is None else psnr)
            if limit is None or self._bytes(coded) <= limit:
                return coded
        return self._best(limit)

    def smallest(self, psnr: float) -> Coded:
        """What reaches a PSNR in the fewest bytes."""
        found = [self._for_psnr(psnr, self._plain, 0.5)]
        for _ in range(self._rounds):
            self._choose_basis(found[-1].step)
            found.append(self._for_psnr(psnr, self._fitted, _CLOSE))
        return min(found[1:], key=lambda coded: len(coded.stream))

    def _best(self, limit: int) -> Coded:
        """What has the least error in a size."""
        self.coding = Coding(self._tree)
        found = [self._for_bytes(limit, self._plain, 0.9)]
        for _ in range(self._rounds):
            self._choose_basis(found[-1].step)
            if self._bytes(self._plain(8.0 * self._largest)) > limit:
                # No room for anything beside the directions.
                self.coding = Coding(self._tree)
            found.append(self._for_bytes(limit, self._fitted, FULL, found[-1].step))
        return min(found, key=lambda coded: coded.error)

    def at_step(self, step: float, coding: Coding | None = None) -> Coded:
        """What is worth most at a step, in a coding that is left in `coding`; None: the one that is worth most."""
        if coding is None:
            self._choose_basis(step)
        else:
            self.coding = coding
        return self._fitted(step)

    def rough_bytes(self, step: float) -> int:
        """About the bytes of the stream at a step."""
        return len(self._plain(step).stream)

    def cost(self, step: float, more: int) -> float:
        """The squared error at a step, with so many bytes more than the stream's at what bytes are worth."""
        return self._choose_basis(step, quick=True) + _BIT * _held(step) ** 2 * 8 * more

    def decoded(self, coded: Coded) -> np.ndarray:
        """The live probes' numbers, float64 [L, D]."""
        return read_values(coded.stream, self._probes.outputs, self._places.code[self._probes.live], self._tree)

    def model(self, coded: Coded) -> TransformModel:
        """The model of what was chosen."""
        probes = self._probes
        return TransformModel(
            name=probes.name,
            source=probes.source,
            probes=probes.probes,
            outputs=probes.outputs,
            dead=self._dead,
            stream=coded.stream,
            places=self._stored,
        )

    def _for_psnr(self, target: float, encode: Callable[[float], Coded], close: float) -> Coded:
        start = self._peak * 10.0 ** (-target / 20.0) * 4.0
        coded, excess = self._solve(
            encode, lambda coded: self._psnr(coded) - target, -5.0, close, start, lambda coded: len(coded.stream)
        )
        if excess < 0:
            name, most = self._probes.name, self._psnr(coded)
            raise WlmError(f"--target-psnr: expected at most {most:.1f} for {name}, got {target:g}")
        return coded

    def _for_bytes(self, limit: int, encode: Callable[[float], Coded], full: float, start: float = 0.0) -> Coded:
        def room(coded: Coded) -> float:
            return math.log2(limit / self._bytes(coded))

        start = start or self._peak * 0.02
        coded, excess = self._solve(encode, room, 0.7, -math.log2(full), start, lambda coded: coded.error)
        if excess < 0:
            raise WlmError(f"--max-bytes: expected at least {self._bytes(coded)} for {self._probes.name}, got {limit}")
        return coded

    def _solve(
        self,
        encode: Callable[[float], Coded],
        excess: Callable[[Coded], float],
        slope: float,
        close: float,
        start: float,
        cost: Callable[[Coded], float],
    ) -> tuple[Coded, float]:
        """What costs least of all tried whose excess isn't negative, with its excess; else what comes nearest.

        `slope` is about what the excess gains where the step doubles. An excess up to `close` is small enough.
        """
        good: list[tuple[Coded, float]] = []
        # From numbers that still have room to a step at which all are 0, whatever the directions.
        low, high = max(math.log2(4.0 * self._largest / LARGEST), _LEAST), math.log2(8.0 * self._largest)
        x = min(max(math.log2(start), low), high)
        ends: dict[bool, tuple[float, float, Coded]] = {}  # by whether it is enough: step, excess
        for trial in range(2 * _TRIES):
            if trial == _TRIES and good:
                break
            coded = encode(2.0**x)
            found = excess(coded)
            self._tried += 1
            if self._meter.due(self._tried):
                self._meter.report(self._tried, PSNR_dB=self._psnr(coded), bytes=self._bytes(coded))
            enough = found >= 0
            if enough:
                good.append((coded, found))
            if enough not in ends or (abs(found) < abs(ends[enough][1])):
                ends[enough] = x, found, coded
            if enough and found <= close:
                break
            if len(ends) == 2:
                (a, at_a, _), (b, at_b, _) = ends[False], ends[True]
                share = (0.5 * close - at_a) / (at_b - at_a)
                x = a + min(max(share, 0.1), 0.9) * (b - a)
                if abs(a - b) < 1e-3:
                    break
            else:
                further = min(max(x + (0.5 * close - found) / slope, x - 6.0), x + 6.0)
                if trial >= _TRIES:
                    # What comes nearer and nearer, and never there.
                    further = x + math.copysign(_FAR, slope)
                further = min(max(further, low), high)
                if further == x:
                    break
                x = further
        if good:
            return min(good, key=lambda pair: cost(pair[0]))
        _, found, coded = ends[False]
        return coded, found

    def _choose_basis(self, step: float, *, quick: bool = False) -> float:
        """Takes the directions, or none, and the prediction, or none, that are worth most at a step.

        Args:
            step: Of the numbers.
            quick: Whether all directions or none will do.

        Returns:
            The squared error, and the stream's bytes at what they are worth.
        """
        outputs, tree = self._probes.outputs, self._tree
        options = [Coding(None, raw=True), Coding(None), Coding(tree)]
        if len(tree.levels) > 1 and 1 < outputs <= _WIDEST:
            inner = np.concatenate(tree.levels[1:])
            change = (tree.coefficients(self._values) @ colours(outputs))[inner]
            vectors = np.linalg.eigh(change.T @ change)[1][:, ::-1].T[:VECTORS]
            # Of many probes the directions are a small part.
            few = len(inner) <= _FEW
            counts = [count for count in _COUNTS if few and count < len(vectors)] + [len(vectors)]
            for fineness in FINENESS if few else FINENESS[-1:]:
                options += [Coding(tree, np.rint(vectors[:n] * fineness) / fineness, fineness) for n in counts]
        if quick:
            options = [options[2], options[-1]]
        self._warm = None
        costs = []
        for self.coding in options:
            coded = self._plain(step)
            costs.append(coded.error + _BIT * coded.step**2 * 8 * len(coded.stream))
        self.coding = options[int(np.argmin(costs))]
        return min(costs)

    def _plain(self, step: float) -> Coded:
        """Each number rounded for itself."""
        return self._coded(step, self._rounded(self._exact() / _held(step)))

    def _fitted(self, step: float) -> Coded:
        """Numbers that are worth their bits together."""
        tree, step = self.coding.tree, _held(step)
        if tree is None:
            return self._plain(step)
        target, reach = self._turned(), tree.reach[:, None]
        bound = _ABOVE * tree.eigenvalue

        def downhill(number: np.ndarray) -> np.ndarray:
            return number - tree.adjoint(tree.values(number / reach) - target) / reach / bound

        price = _PRICE * step / bound

        def shrunk(number: np.ndarray) -> np.ndarray:
            return np.copysign(np.maximum(np.abs(number) - price, 0.0), number)

        # Of many probes another step begins where the last one ended.
        again = self._warm is not None and len(target) > _FEW
        start, rounds = (self._warm, _AGAIN) if again else (self._exact(), _SPARSE)
        number = self._warm = _accelerated(start, lambda x: shrunk(downhill(x)), rounds)
        kept = number != 0.0
        number = _accelerated(number, lambda x: downhill(x) * kept, _FREE)
        q = self._rounded(number / step)
        for _ in range(_MOVES):
            moved = downhill(q * step) / step
            q = np.where((q == 0) & (np.abs(moved) < 1.0 - _ROUND), 0, self._rounded(moved))
        return self._coded(step, q)

    def _turned(self) -> np.ndarray:
        return self._values @ self.coding.basis(self._probes.outputs)

    def _exact(self) -> np.ndarray:
        """The numbers before rounding, in units of the values."""
        turned = self._turned()
        tree = self.coding.tree
        return turned if tree is None else tree.coefficients(turned) * tree.reach[:, None]

    def _rounded(self, number: np.ndarray) -> np.ndarray:
        size = np.minimum(np.floor(np.abs(number) + _ROUND), LARGEST)
        return np.copysign(size, number).astype(np.int64)

    def _coded(self, step: float, q: np.ndarray) -> Coded:
        step = _held(step)
        stream = make_stream(step, self._places.check, self.coding, q)
        decoded = q * step
        if (tree := self.coding.tree) is not None:
            decoded = tree.values(decoded / tree.reach[:, None])
        return Coded(step, stream, float(np.square(decoded - self._turned()).sum()))

    def _psnr(self, coded: Coded) -> float:
        return psnr_from_mse(coded.error / self._probes.values.size, self._peak)

    def _bytes(self, coded: Coded) -> int:
        return self.model(coded).file_bytes()


def peak_of(probes: ProbeSet) -> float:
    """What the PSNR of a set is of: the range of its numbers, or the largest of those that are all alike."""
    return float(probes.values.max()) - float(probes.values.min()) or float(np.abs(probes.values).max())


def _held(step: float) -> float:
    """As the file holds it."""
    return float(np.float32(step))


def _accelerated(first: np.ndarray, step: Callable[[np.ndarray], np.ndarray], rounds: int) -> np.ndarray:
    """FISTA: a step from where the last two point to."""
    current, ahead, weight = first, first, 1.0
    for _ in range(rounds):
        before, current = current, step(ahead)
        following = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * weight * weight))
        ahead = current + (weight - 1.0) / following * (current - before)
        weight = following
    return current
