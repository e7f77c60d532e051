"""Probes as whole numbers of a transform over their own places: the model and its stream.

With F the fixed colours and Q the basis, coefficients of probe i are c_i = q_i step / reach_i, over the levels of
`wlm.probe.tree`, and its numbers are (values of the tree's transform of c) Q^T F^T. Q's first columns are stored: the
directions in which probes differ most from what coarser ones predict. The others follow from these. Where no probe is
predicted there is no tree, and its numbers are q_i step F^T, or q_i step.
"""

import struct
import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from wlm.errors import WlmError
from wlm.probe.entropy import pack, unpack
from wlm.probe.model import Profile, live_probes
from wlm.probe.tree import Tree, flat
from wlm.system import Model

CODES = 65535
"""Whole numbers along the longest side of the probes' box."""

VECTORS = 32
"""Directions that are stored, at most."""

FINENESS = (8, 16, 64)
"""Of the directions' numbers, which are whole ones in 1/8, 1/16 or 1/64."""

_HEAD = struct.Struct("<fIHBB")
_RAW = 8
_ZERO = 1e-9
_COLOURS = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]])


class Head(NamedTuple):
    """What a stream says of itself.

    Attributes:
        step: Of the whole numbers.
        check: `Places.check`.
        words: Of 32 bits, in which the directions are coded.
        vectors: How many of them there are.
        flags: 1 where probes are predicted from coarser ones; twice the place in `FINENESS` of the directions'; 8 where
            numbers are not turned at all.
    """

    step: float
    check: int
    words: int
    vectors: int
    flags: int

    @property
    def predicted(self) -> bool:
        return bool(self.flags & 1)

    @property
    def fineness(self) -> int:
        return FINENESS[self.flags >> 1 & 3]

    @property
    def raw(self) -> bool:
        return bool(self.flags & _RAW)


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


@dataclass(frozen=True, eq=False)
class TransformModel(Model):
    """A compressed probe set of N probes of D numbers, read at the places of the set.

    Attributes:
        profile: The method alone.
        name: The set's name.
        source: Hash of the input.
        probes: N.
        outputs: D, 27 for L2 in RGB.
        dead: bool [N], probes that decode to zero; empty if there are none.
        stream: uint8 [B], see `docs/formats.md`.
        places: Of all probes, where they are stored with the model; else None.
    """

    SYSTEM: ClassVar[str] = "probe"
    DECODER: ClassVar[tuple[str, str]] = ("transform_decode", "TransformDecoder")
    # What was asked for is no part of what it became.
    profile: ClassVar[Profile] = Profile(name="transform", method="transform")

    name: str
    source: str
    probes: int
    outputs: int
    dead: np.ndarray
    stream: np.ndarray
    places: Places | None

    @property
    def has_positions(self) -> bool:
        """Whether the probes' positions are stored."""
        return self.places is not None

    @cached_property
    def head(self) -> Head:
        """What the stream begins with.

        Raises:
            ValueError: They can't be.
        """
        return read_head(self.stream, self.outputs)

    def stored_positions(self) -> np.ndarray:
        """The positions stored with the model, float64 [N, 3], to 1/65535 of the box.

        Raises:
            WlmError: None are stored.
        """
        if self.places is None:
            raise WlmError(f"{self.name}: holds no positions; expected those of its probes, or a fit that stores them")
        return self.places.position()

    def has_probes_at(self, position: np.ndarray) -> bool:
        """Whether positions, float64 [M, 3], are those of the model's own probes, in their order."""
        return len(position) == self.probes and Places.of(position).check == self.head.check

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
            WlmError: They are other places, or the stream is none of theirs.
        """
        self.check_places(places)
        live = live_probes(self.dead, self.probes)
        result = np.zeros((self.probes, self.outputs), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                result[live] = read_values(self.stream, self.outputs, places.code[live])
            except ValueError as error:
                raise WlmError(f"{self.name}: {error}") from error
        if not np.isfinite(result).all():
            raise WlmError(f"{self.name}: part light: expected values that float32 holds")
        return result

    def check_places(self, places: Places) -> None:
        """Checks that places are those of the model's own probes.

        Raises:
            WlmError: They aren't.
        """
        if len(places.code) != self.probes or places.check != self.head.check:
            raise WlmError(f"{self.name}: expected the positions of its own {self.probes} probes, in their order")


@dataclass(frozen=True, eq=False)
class Coding:
    """What probes are turned into before they are rounded.

    Attributes:
        tree: Of the live probes; None: none is predicted.
        vectors: float64 [V, D], the directions, whole numbers over the fineness; None: none is stored.
        fineness: One of `FINENESS`.
        raw: Whether numbers are not turned at all; without a tree and directions.
    """

    tree: Tree | None
    vectors: np.ndarray | None = None
    fineness: int = FINENESS[0]
    raw: bool = False

    def basis(self, outputs: int) -> np.ndarray:
        """What numbers are multiplied with, float64 [D, D]."""
        return np.eye(outputs) if self.raw else basis(outputs, self.vectors)


def make_stream(step: float, check: int, coding: Coding, q: np.ndarray) -> np.ndarray:
    """The part `light` of a model, uint8 [B].

    Args:
        step: Of the whole numbers, as float32 holds it.
        check: Of all places.
        coding: What they are numbers of.
        q: int64 [L, D], the live probes' numbers.
    """
    code, count, tree = b"", 0, coding.tree
    if coding.vectors is not None:
        vectors = np.rint(coding.vectors * coding.fineness).astype(np.int64)
        code, count = pack(vectors, flat(len(vectors)), []), len(vectors)
    levels, parents = (tree.levels, tree.parents) if tree else (flat(len(q)), [])
    flags = (tree is not None) | FINENESS.index(coding.fineness) << 1 | _RAW * coding.raw
    head = _HEAD.pack(step, check, len(code) // 4, count, flags)
    return np.frombuffer(head + code + pack(q, levels, parents), np.uint8)


def read_head(stream: np.ndarray, outputs: int) -> Head:
    """What a stream of probes of so many numbers begins with.

    Raises:
        ValueError: It can't be one.
    """
    if len(stream) < _HEAD.size:
        raise ValueError(f"part light: expected at least {_HEAD.size} bytes, found {len(stream)}")
    head = Head(*_HEAD.unpack_from(stream[: _HEAD.size].tobytes()))
    if not (head.step > 0 and np.isfinite(head.step)):
        raise ValueError(f"part light: expected a positive step, found {head.step:g}")
    if head.vectors > min(VECTORS, outputs) or _HEAD.size + 4 * head.words > len(stream):
        raise ValueError("part light: expected fewer directions, or more bytes")
    if head.flags not in (0, 1, 3, 5, _RAW):
        raise ValueError(f"part light: expected flags 0, 1, 3, 5 or {_RAW}, found {head.flags}")
    return head


def read_values(stream: np.ndarray, outputs: int, code: np.ndarray, tree: Tree | None = None) -> np.ndarray:
    """The numbers of live probes, float64 [L, D]: undoes `make_stream`.

    Args:
        stream: uint8 [B].
        outputs: D.
        code: uint16 [L, 3], their places.
        tree: Of these places, where it is known already.

    Raises:
        ValueError: The stream is none of so many probes.
    """
    head, data = read_head(stream, outputs), stream.tobytes()
    start = _HEAD.size + 4 * head.words
    vectors = None
    try:
        if head.vectors:
            vectors = unpack(data[_HEAD.size : start], outputs, flat(head.vectors), []) / head.fineness
        tree = (tree or Tree(code)) if head.predicted else None
        levels, parents = (tree.levels, tree.parents) if tree else (flat(len(code)), [])
        q = unpack(data[start:], outputs, levels, parents)
    except ValueError as error:
        raise ValueError(f"part light: {error}") from error
    turned = q * head.step
    if tree:
        turned = tree.values(turned / tree.reach[:, None])
    return turned if head.raw else turned @ basis(outputs, vectors).T


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
