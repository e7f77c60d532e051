"""Whole numbers of probes as bytes: asymmetric numeral systems, with odds that follow from what is decoded already.

Numbers q [N, K] are coded level by level (`wlm.probe.tree`), in a level one column after the other. What a number is
expected to be in size, its class of odds, follows from the sizes of its parents' numbers in the same column and of its
own in the two columns before. A magnitude below 8 is a symbol; a larger one is one of two symbols for each power of
two, and the bits that the symbol leaves open, whose odds are even. The odds of a class begin as those of a geometric
distribution and follow the counts; those of a column's signs begin even. Counts are whole numbers, which have one sum
in any order, and odds their quotients in IEEE doubles, so that every machine has the same. The coder is that of
constriction (Bamler, Understanding Entropy Coding With Asymmetric Numeral Systems, 2022).
"""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import constriction
import numpy as np

LARGEST = (1 << 24) - 1
"""The largest magnitude."""

_DIRECT = 8  # magnitudes that are symbols of their own
_SYMBOLS = _DIRECT + 2 * 21  # up to LARGEST
_CLASSES = 43
_PRIOR = 6.0  # numbers that the first odds of a class are worth
_EVEN = 8.0  # the same of a sign
_HALVED = 4096  # a class's numbers at which its counts are halved: columns and levels differ
_UNIT = 1 << 20  # of the counts of a class: what one number counts
_FEWEST, _MOST = 8, 2048  # rows that are coded with the same odds
_CHUNK = 12  # bits that are coded at once

models, AnsCoder = constriction.stream.model, constriction.stream.stack.AnsCoder


class Shape(NamedTuple):
    """Of some coded numbers.

    Attributes:
        columns: K.
        levels: int64 [n] each, the rows in their order of coding.
        parents: int64 [n, P] each, of the levels but the first: rows of earlier ones.
    """

    columns: int
    levels: Sequence[np.ndarray]
    parents: Sequence[np.ndarray] = ()


def pack(*blocks: tuple[np.ndarray, Shape]) -> bytes:
    """Codes numbers.

    Args:
        blocks: Numbers, int64 [N, K] with magnitudes up to `LARGEST`, each with their shape; one follows the other.

    Returns:
        The bytes, without the zeros at their end.
    """
    steps = [step for q, shape in blocks for step in _steps(q, shape)]
    coder = AnsCoder()
    for symbols, model in reversed(steps):
        coder.encode_reverse(symbols, model)
    return coder.get_compressed().astype("<u4").tobytes().rstrip(b"\0")


def _steps(q: np.ndarray, shape: Shape) -> Iterator[tuple[np.ndarray, object]]:
    """Symbols, and the model that they are coded with."""
    q = np.ascontiguousarray(q[_order(shape)].T)
    size = np.abs(q)
    symbols, extras, bits = _split(size)
    odds = _Odds(shape.columns)
    for column, rows, classes in _batches(size, shape):
        symbol = symbols[column, rows]
        kinds, coded = odds.of(classes)
        for kind, model in zip(kinds, coded, strict=True):
            yield (symbol[classes == kind] if len(kinds) > 1 else symbol), model
        odds.count(classes, symbol)
        sign = q[column, rows][symbol > 0] < 0
        if len(sign):
            yield sign.astype(np.int32), odds.sign_model(column)
            odds.count_signs(column, sign)
        if symbol.max() < _DIRECT:
            continue
        width = bits[column, rows]
        for most in _present(width[width > 0]):
            left = extras[column, rows][width == most]
            for low in range(0, most, _CHUNK):
                part = min(_CHUNK, most - low)
                yield ((left >> low) & ((1 << part) - 1)).astype(np.int32), _uniform(part)


def unpack(data: bytes, *shapes: Shape) -> list[np.ndarray]:
    """Undoes `pack`, int64 [N, K] for each shape.

    Raises:
        ValueError: The bytes are none that `pack` makes of so many rows and columns.
    """
    words = data + bytes(-len(data) % 4)
    coder = AnsCoder(np.frombuffer(words, "<u4").astype(np.uint32))
    blocks = [_unpack(coder, shape) for shape in shapes]
    if not coder.is_empty():
        raise ValueError("found more than the numbers of its probes")
    return blocks


def _unpack(coder: AnsCoder, shape: Shape) -> np.ndarray:
    """int64 [N, K]."""
    order = _order(shape)
    q, size = (np.zeros((shape.columns, len(order)), np.int64) for _ in range(2))
    odds = _Odds(shape.columns)
    for column, rows, classes in _batches(size, shape):
        symbol = np.empty(len(classes), np.int64)
        kinds, coded = odds.of(classes)
        for kind, model in zip(kinds, coded, strict=True):
            chosen = classes == kind
            symbol[chosen] = coder.decode(model, np.count_nonzero(chosen))
        odds.count(classes, symbol)
        nonzero = np.flatnonzero(symbol)
        if not len(nonzero):
            continue
        sign = coder.decode(odds.sign_model(column), len(nonzero)) > 0
        odds.count_signs(column, sign)
        symbol = symbol[nonzero]
        low, width = _START[symbol], _BITS[symbol]
        for most in _present(width[width > 0]):
            chosen = np.flatnonzero(width == most)
            for first in range(0, most, _CHUNK):
                part = min(_CHUNK, most - first)
                low[chosen] += coder.decode(_uniform(part), len(chosen)).astype(np.int64) << first
        size[column, rows][nonzero] = low
        q[column, rows][nonzero] = np.where(sign, -low, low)
    result = np.empty((len(order), shape.columns), np.int64)
    result[order] = q.T
    return result


def _order(shape: Shape) -> np.ndarray:
    """The rows in their order of coding, int64 [N]."""
    return np.concatenate(shape.levels).astype(np.int64)


def _batches(size: np.ndarray, shape: Shape) -> Iterator[tuple[int, slice, np.ndarray]]:
    """A column, some rows in their order of coding, and the class of odds of each there.

    `size`, [K, N], is read up to the batch before.
    """
    for rows, above in _pieces(shape):
        # Coarser probes are coded with all of their numbers before.
        start = np.zeros((len(size), rows.stop - rows.start), np.int64)
        if above is not None:
            for parent in above.T:
                start += size[:, parent]
            start = 32 * start // above.shape[1]
        for column, expected in enumerate(start):
            for back, share in ((1, 22), (2, 16)):
                if column >= back:
                    expected += share * size[column - back, rows]
            yield column, rows, np.searchsorted(_EDGES, expected, side="right")


def _pieces(shape: Shape) -> Iterator[tuple[slice, np.ndarray | None]]:
    """Rows of a level, and their parents: as many as there were before, within limits, so that the odds keep up."""
    order, seen = _order(shape), 0
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    for number, level in enumerate(shape.levels):
        start, end = seen, seen + len(level)
        while seen < end:
            rows = slice(seen, min(seen + min(max(seen, _FEWEST), _MOST), end))
            yield rows, place[shape.parents[number - 1][rows.start - start : rows.stop - start]] if number else None
            seen = rows.stop


def _split(size: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symbols of magnitudes, int32, and the bits that they leave open with their number."""
    symbol = np.searchsorted(_START, size, side="right") - 1
    return symbol.astype(np.int32), size - _START[symbol], _BITS[symbol]


def _present(numbers: np.ndarray) -> list[int]:
    """The different ones of whole numbers from 0, rising."""
    return np.flatnonzero(np.bincount(numbers)).tolist()


@cache
def _uniform(bits: int) -> models.Uniform:
    return models.Uniform(1 << bits)


# The first magnitude of each symbol, and how many bits tell its magnitudes apart.
_START = np.array([*range(_DIRECT), *((2 + half) << (power - 1) for power in range(3, 24) for half in (0, 1))])
_BITS = np.array([0] * _DIRECT + [power - 1 for power in range(3, 24) for half in (0, 1)])
# Classes of odds, by what is expected in 1/32: two for each power of two.
_EDGES = np.array([1, 2, 4, 6, *((2 + half) << power for power in range(2, 22) for half in (0, 1))])[: _CLASSES - 1]


class _Odds:
    """Counts of the symbols of each class, and of the signs of each column."""

    def __init__(self, columns: int) -> None:
        self._count = np.rint(_first_odds() * _PRIOR * _UNIT).astype(np.int64)
        self._signs = np.full((columns, 2), _EVEN)

    def of(self, classes: np.ndarray) -> tuple[list[int], list[models.Categorical]]:
        """The classes that there are, rising, and the model of each."""
        kinds = _present(classes)
        count = self._count[kinds]
        odds = count / count.sum(1, keepdims=True)
        return kinds, [models.Categorical(each, perfect=False) for each in odds]

    def count(self, classes: np.ndarray, symbols: np.ndarray) -> None:
        counts = np.bincount(classes * _SYMBOLS + symbols, minlength=_CLASSES * _SYMBOLS)
        self._count += _UNIT * counts.reshape(_CLASSES, _SYMBOLS)
        many = self._count.sum(1) > _HALVED * _UNIT
        if many.any():
            self._count[many] = (self._count[many] + 1) // 2

    def sign_model(self, column: int) -> models.Categorical:
        count = self._signs[column]
        return models.Categorical(count / count.sum(), perfect=False)

    def count_signs(self, column: int, negative: np.ndarray) -> None:
        self._signs[column] += np.bincount(negative.astype(np.int64), minlength=2)


def _first_odds() -> np.ndarray:
    """Geometric distributions, one for each class; products alone, whose rounding is the same everywhere."""
    middle = np.concatenate([[0.5], 0.5 * (_EDGES[1:] + _EDGES[:-1]), [1.5 * _EDGES[-1]]]) / 32.0
    mean = 0.01 + 0.55 * middle
    powers = [mean / (1.0 + mean)]  # of the ratio: to 1, 2, 4, 8 ...
    for _ in range(24):
        powers.append(powers[-1] * powers[-1])
    survive = np.ones((len(mean), _SYMBOLS + 1))
    for symbol, start in enumerate([*_START.tolist(), LARGEST + 1]):
        for bit in range(25):
            if start >> bit & 1:
                survive[:, symbol] *= powers[bit]
    odds = survive[:, :-1] - survive[:, 1:]
    return odds + 3e-5
