"""Probes as whole numbers of a transform over their own places: the model and its stream.

With F the fixed colours and Q the basis, coefficients of probe i are c_i = q_i step / reach_i, over the levels of
`wlm.probe.tree`, and its numbers are (values of the tree's transform of c) Q^T F^T. Q's first columns are stored: the
directions in which probes differ most from what coarser ones predict. The others follow from these. Where no probe is
predicted there is no tree, and its numbers are q_i step F^T, or q_i step.
"""

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from wlm.errors import WlmError
from wlm.probe.entropy import Shape, pack, unpack
from wlm.probe.model import Profile, live_probes
from wlm.probe.tree import Tree, flat
from wlm.system import Model

CODES = 65535
"""Whole numbers along the longest side of the probes' box."""

VECTORS = 32
"""Directions that are stored, at most."""

FINENESS = (8, 16, 64)
"""Of the directions' numbers, which are whole ones in 1/8, 1/16 or 1/64."""

SOURCE = 4
"""Digits of the input's hash that a file has."""

NO_POSITIONS = "{}: holds no positions; expected those of its probes, or a fit that stores them"
"""What is said where places are missing."""

_RAW = 8
_FLAGS = (0, 1, 3, 5, _RAW)
_ZERO = 1e-9
_COLOURS = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]])


class Head(NamedTuple):
    """What a stream's numbers are.

    Attributes:
        step: Of the whole numbers.
        check: `Places.check`.
        vectors: Stored directions.
        flags: 1 where probes are predicted from coarser ones; twice the place in `FINENESS` of the directions'; 8 where
            numbers are not turned at all.
        grid: Of the tree of places.
        words: Of 32 bits, in which the directions are coded by themselves, as earlier files have them; None: they are
            coded in front of the numbers.
    """

    step: float
    check: int
    vectors: int
    flags: int
    grid: int = 0
    words: int | None = None

    @property
    def predicted(self) -> bool:
        return bool(self.flags & 1)

    @property
    def fineness(self) -> int:
        return FINENESS[self.flags >> 1 & 3]

    @property
    def raw(self) -> bool:
        return bool(self.flags & _RAW)

    def checked(self, outputs: int, size: int) -> "Head":
        """The head, if it can be one of so many numbers a probe and bytes of a stream.

        Raises:
            ValueError: It can't.
        """
        if not (self.step > 0 and np.isfinite(self.step)):
            raise ValueError(f"part light: expected a positive step, found {self.step:g}")
        if self.vectors > min(VECTORS, outputs) or 4 * (self.words or 0) > size:
            raise ValueError("part light: expected fewer directions, or more bytes")
        if self.flags not in _FLAGS:
            raise ValueError(f"part light: expected flags {', '.join(map(str, _FLAGS))}, found {self.flags}")
        return self


@dataclass(frozen=True, eq=False)
class Places:
    """The places of probes as whole numbers, on which the coding depends.

    Attributes:
        origin: float64 [3], the lowest corner of the box.
        extent: Of the box along its longest axis; positive.
        code: uint16 [N, 3]: position = origin + extent code / 65535.
    """

    origin: np.ndarray
    extent: float
    code: np.ndarray

    @classmethod
    def of(cls, position: np.ndarray) -> "Places":
        """Rounds positions, float64 [N, 3]; those that float32 has held give the same, unless far from the origin."""
        # Beyond float32 the spacing is NaN, and nothing is rounded.
        with np.errstate(over="ignore", invalid="ignore"):
            rounded = position.astype(np.float32).astype(np.float64)
            coarse = np.spacing(np.float32(np.abs(rounded).max())) * 4.0 * CODES
            if coarse < np.ptp(rounded, axis=0).max():
                position = rounded
        origin = position.min(0)
        extent = float((position.max(0) - origin).max())
        if not extent > 0:
            extent = 1.0
        code = np.rint((position - origin) / extent * CODES)
        return cls(origin, extent, np.clip(code, 0, CODES).astype(np.uint16))

    @property
    def check(self) -> int:
        """CRC-32 of the whole numbers: tells other probes, or another order, from these."""
        return zlib.crc32(np.ascontiguousarray(self.code, "<u2").tobytes())

    def position(self) -> np.ndarray:
        """Positions, float64 [N, 3], to 1/65535 of the box."""
        return self.origin + self.extent * (self.code / CODES)


class Transform(Model):
    """Base of models that are read at the places of their own probes: of one region or of many, of one hour or more.

    Attributes:
        profile: The method alone.
    """

    SYSTEM: ClassVar[str] = "probe"
    # What was asked for is no part of what it became.
    profile: ClassVar[Profile] = Profile(name="transform", method="transform")


class Placed(Transform, ABC):
    """Base of transforms whose probes are one region.

    Attributes:
        name: The set's name.
        probes: N.
        places: Of all probes, where they are stored with the model; else None.
        check: `Places.check` of the model's own probes.
    """

    DECODER: ClassVar[tuple[str, str]] = ("transform_decode", "TransformDecoder")

    name: str
    probes: int
    places: Places | None
    check: int

    @property
    def has_positions(self) -> bool:
        """Whether the probes' positions are stored."""
        return self.places is not None

    def stored_positions(self) -> np.ndarray:
        """The positions stored with the model, float64 [N, 3], to 1/65535 of the box.

        Raises:
            WlmError: None are stored.
        """
        if self.places is None:
            raise WlmError(NO_POSITIONS.format(self.name))
        return self.places.position()

    def without_places(self) -> Self:
        """The model as its file would be without the positions."""
        return replace(self, places=None)

    def has_probes_at(self, position: np.ndarray) -> bool:
        """Whether positions, float64 [M, 3], are those of the model's own probes, in their order."""
        return len(position) == self.probes and Places.of(position).check == self.check

    def values_at(self, position: np.ndarray) -> np.ndarray:
        """The numbers of all probes at their own positions, float64 [N, 3]; as `values`."""
        return self.values(Places.of(position))

    @cached_property
    def stored_values(self) -> np.ndarray:
        """The numbers of all probes at the places that are stored, read-only; errors as of `values`."""
        values = self.values(self.places)
        values.flags.writeable = False
        return values

    def values(self, places: Places) -> np.ndarray:
        """The numbers of all probes, float32 [N, D], zero where one is dead.

        Args:
            places: Of the model's own probes.

        Raises:
            WlmError: They are other places, or the model is none of theirs.
        """
        if len(places.code) != self.probes or places.check != self.check:
            raise WlmError(f"{self.name}: expected the positions of its own {self.probes} probes, in their order")
        return self._values(places)

    @abstractmethod
    def _values(self, places: Places) -> np.ndarray:
        """`values` at places that are the model's own."""


@dataclass(frozen=True, eq=False)
class TransformModel(Placed):
    """A compressed probe set of N probes of D numbers, read at the places of the set.

    Attributes:
        name: The set's name.
        source: The first digits of the hash of the input, all of them in earlier files.
        probes: N.
        outputs: D, 27 for L2 in RGB.
        dead: bool [N], probes that decode to zero; empty if there are none.
        head: What the stream's numbers are.
        stream: uint8 [B], the coded numbers, see `docs/formats.md`.
        places: Of all probes, where they are stored with the model; else None.
        directions: float64 [V, D], where the stream lacks them: those of a set of many regions.
    """

    name: str
    source: str
    probes: int
    outputs: int
    dead: np.ndarray
    head: Head
    stream: np.ndarray
    places: Places | None
    directions: np.ndarray | None = None

    @property
    def check(self) -> int:
        return self.head.check

    def _values(self, places: Places) -> np.ndarray:
        live = live_probes(self.dead, self.probes)
        result = np.zeros((self.probes, self.outputs), np.float32)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                result[live] = read_values(
                    self.head, self.stream, self.outputs, places.code[live], directions=self.directions
                )
        except ValueError as error:
            raise WlmError(f"{self.name}: part light: {error}") from error
        if not np.isfinite(result).all():
            raise WlmError(f"{self.name}: part light: expected values that float32 holds")
        return result


@dataclass(frozen=True, eq=False)
class Coding:
    """What probes are turned into before they are rounded.

    Attributes:
        predicted: Whether probes are predicted from coarser ones.
        vectors: float64 [V, D], the directions, whole numbers over the fineness; None: none is stored.
        fineness: One of `FINENESS`.
        raw: Whether numbers are not turned at all; without prediction and directions.
        apart: Whether the directions are stored apart from the numbers, for many regions.
    """

    predicted: bool
    vectors: np.ndarray | None = None
    fineness: int = FINENESS[0]
    raw: bool = False
    apart: bool = False

    def basis(self, outputs: int) -> np.ndarray:
        """What numbers are multiplied with, float64 [D, D]."""
        return np.eye(outputs) if self.raw else basis(outputs, self.vectors)

    def block(self) -> tuple[np.ndarray, Shape]:
        """The directions as whole numbers, int64 [V, D], with their shape."""
        vectors = np.rint(self.vectors * self.fineness).astype(np.int64)
        return vectors, Shape(vectors.shape[1], flat(len(vectors)))

    def head(self, step: float, check: int) -> Head:
        """The head of a model that is coded so."""
        flags = self.predicted | FINENESS.index(self.fineness) << 1 | _RAW * self.raw
        return Head(stored_step(step), check, 0 if self.vectors is None else len(self.vectors), flags)


def numbers_shape(tree: Tree | None, count: int, outputs: int) -> Shape:
    """How the numbers of so many live probes are coded."""
    return Shape(outputs, tree.levels, tree.parents) if tree else Shape(outputs, flat(count))


def make_stream(coding: Coding, tree: Tree | None, q: np.ndarray) -> np.ndarray:
    """The stream of a model, uint8 [B].

    Args:
        coding: What they are numbers of.
        tree: Of the live probes, where they are predicted.
        q: int64 [L, D], the live probes' numbers.
    """
    blocks = [(q, numbers_shape(tree, len(q), q.shape[1]))]
    if coding.vectors is not None and not coding.apart:
        blocks.insert(0, coding.block())
    return np.frombuffer(pack(*blocks), np.uint8)


def read_values(
    head: Head,
    stream: np.ndarray,
    outputs: int,
    code: np.ndarray,
    trees: Callable[[np.ndarray, int], Tree] = Tree,
    *,
    directions: np.ndarray | None = None,
) -> np.ndarray:
    """The numbers of live probes, float64 [L, D]: undoes `make_stream`.

    Args:
        head: What the stream's numbers are.
        stream: uint8 [B].
        outputs: D.
        code: uint16 [L, 3], the probes' places.
        trees: What makes a tree of these.
        directions: float64 [V, D], where the stream lacks them.

    Raises:
        ValueError: The stream is none of so many probes.
    """
    tree = trees(code, head.grid) if head.predicted else None
    shape, data = numbers_shape(tree, len(code), outputs), stream.tobytes()
    if directions is not None or not head.vectors:
        (q,) = unpack(data, shape)
    else:
        front = Shape(outputs, flat(head.vectors))
        if head.words is None:
            vectors, q = unpack(data, front, shape)
        else:
            end = 4 * head.words
            (vectors,), (q,) = unpack(data[:end], front), unpack(data[end:], shape)
        directions = vectors / head.fineness
    turned = q * head.step
    if tree:
        turned = tree.values(turned / tree.reach[:, None])
    return turned if head.raw else turned @ basis(outputs, directions).T


def step_bits(step: float) -> int:
    """The 16 bits of the nearest step that a file holds, the upper half of a float32; they grow with the step."""
    return max(int(np.array(step, np.float32).view(np.uint32)) + 0x8000 >> 16, 1)


def stored_step(step: float) -> float:
    """The nearest step that a file holds."""
    return step_of(step_bits(step))


def step_of(bits: int) -> float:
    """The step of a file's 16 bits."""
    return float(np.array(bits << 16, np.uint32).view(np.float32))


def colours(outputs: int) -> np.ndarray:
    """F, float64 [D, D]: brightness and two differences of each coefficient's colours, or the numbers as they are."""
    if outputs % 3:
        return np.eye(outputs)
    return np.kron(np.eye(outputs // 3), (_COLOURS / np.linalg.norm(_COLOURS, axis=1, keepdims=True)).T)


def basis(outputs: int, vectors: np.ndarray | None) -> np.ndarray:
    """F Q, float64 [D, D], orthonormal: a column for each of the coded numbers.

    Q is the product of the reflections that turn the first unit vectors into the stored directions, one by one.

    Args:
        outputs: D.
        vectors: float64 [V, D], in terms of F; None: Q is the identity.
    """
    fixed = colours(outputs)
    if vectors is None:
        return fixed
    rest = vectors.T  # what is left of the directions, reflected so far
    q = np.eye(outputs)
    for i in range(rest.shape[1]):
        mirror = rest[:, i].copy()
        mirror[:i] = 0.0
        # Rounding may leave either sign of a zero, which must not decide.
        mirror[i] += np.linalg.norm(mirror) * (-1.0 if mirror[i] < -_ZERO else 1.0)
        square = mirror @ mirror
        if square > 0.0:
            rest = rest - np.outer(mirror, (2.0 / square) * (mirror @ rest))
            q = q - np.outer((2.0 / square) * (q @ mirror), mirror)
    return fixed @ q
