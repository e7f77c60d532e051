"""Very many probes: regions that are coded each for itself, with one step and one set of directions.

Planes across the axes divide the probes by halves, until no region has more than the profile's `region` of them alive.
Where a region lies, how many probes it has and where its bytes are is in the head of the file, so that one is decoded
without the others.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from wlm.errors import WlmError
from wlm.formats.compact import digest
from wlm.probe.fields import pack_dead, unpack_dead
from wlm.probe.transform import CODES, NO_POSITIONS, Head, Places, Transform, TransformModel
from wlm.probe.transform_codec import pack_piece, parse_piece, unpack_labels

LEAF = 3
"""In place of an axis: a region."""


@dataclass(frozen=True, eq=False)
class Split:
    """Planes between regions.

    Attributes:
        axis: uint8 [2 R - 1], of each plane, or `LEAF`; after a plane all that is below it, then all that isn't.
        plane: uint16 [R - 1]: a code below it is on the first side.
    """

    axis: np.ndarray
    plane: np.ndarray

    @classmethod
    def of(cls, code: np.ndarray, most: int) -> "Split":
        """Divides places, uint16 [N, 3], into regions of at most so many, but for places that are alike."""
        axes: list[int] = []
        planes: list[int] = []

        def divide(part: np.ndarray, regions: int) -> None:
            low, high = part.min(0), part.max(0)
            axis = int(np.argmax(high.astype(int) - low))
            if regions == 1 or high[axis] == low[axis]:
                axes.append(LEAF)
                return
            first = regions // 2
            ordered = np.sort(part[:, axis])
            wanted = ordered[len(part) * first // regions]
            plane = max(int(wanted), int(low[axis]) + 1)
            axes.append(axis)
            planes.append(plane)
            below = part[:, axis] < plane
            divide(part[below], first)
            divide(part[~below], regions - first)

        divide(code, -(-len(code) // most))
        return cls(np.array(axes, np.uint8), np.array(planes, np.uint16))

    @property
    def regions(self) -> int:
        """R."""
        return len(self.plane) + 1

    def labels(self, code: np.ndarray) -> np.ndarray:
        """The region of each place, uint16 [N, 3]; int64 [N]."""
        result = np.empty(len(code), np.int64)
        waiting, region, plane = [np.arange(len(code))], 0, 0
        for axis in self.axis:
            part = waiting.pop()
            if axis == LEAF:
                result[part] = region
                region += 1
                continue
            below = code[part, axis] < self.plane[plane]
            waiting += [part[~below], part[below]]
            plane += 1
        return result

    def is_whole(self) -> bool:
        """Whether every plane has its two sides, and nothing is left over."""
        open_ends = 1
        for axis in self.axis:
            if not open_ends or axis > LEAF:
                return False
            open_ends += -1 if axis == LEAF else 1
        return open_ends == 0 and int((self.axis < LEAF).sum()) == len(self.plane)


class Piece(NamedTuple):
    """A region's bytes.

    Attributes:
        data: uint8 [B].
        digest: Of these.
        probes: In the region.
        box: uint16 [2, 3], codes of the lowest and the highest corner of its live probes.
    """

    data: np.ndarray
    digest: bytes
    probes: int
    box: np.ndarray


def members(labels: np.ndarray, regions: int) -> list[np.ndarray]:
    """The probes of each region, in their order."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(1, regions)))


@dataclass(frozen=True, eq=False)
class RegionModel(Transform):
    """A compressed set of N probes of D numbers, in R regions. Bytes are looked at when a region is asked for.

    Attributes:
        name, source, probes, outputs: As of `TransformModel`.
        has_positions: Whether each region has its places.
        origin: float64 [3], and
        extent: of the whole set's places.
        split: The regions.
        head: Of all regions; their checks are their own.
        directions: float64 [V, D], of all regions; None: none is stored.
        order: uint8 [B]: with places the region of each probe, else which probes are dead.
        order_digest: Of these.
        pieces: The regions.
    """

    DECODER: ClassVar[tuple[str, str]] = ("region_decode", "RegionDecoder")

    name: str
    source: str
    probes: int
    outputs: int
    has_positions: bool
    origin: np.ndarray
    extent: float
    split: Split
    head: Head
    directions: np.ndarray | None
    order: np.ndarray
    order_digest: bytes
    pieces: tuple[Piece, ...]

    def region(self, number: int, dead: np.ndarray | None = None) -> TransformModel:
        """A region as a model of its own.

        Args:
            number: 0 to R - 1.
            dead: bool, which of its probes are dead, where the file has no places.

        Raises:
            WlmError: It is damaged.
        """
        piece, name = self.pieces[number], f"{self.name}, region {number}"
        _check_digest(name, piece.data, piece.digest)
        try:
            own, places, check, grid, stream = parse_piece(piece.data, piece.probes, self.outputs, dead)
        except ValueError as error:
            raise WlmError(f"{name}: {error}") from error
        if self.has_positions != (places is not None):
            raise WlmError(f"{name}: expected places in all regions or in none")
        head = self.head._replace(check=check, grid=grid)
        return TransformModel(name, self.source, piece.probes, self.outputs, own, head, stream, places, self.directions)

    def check_pieces(self) -> None:
        """Compares all bytes with their digests.

        Raises:
            WlmError: Some are damaged.
        """
        _check_digest(self.name, self.order, self.order_digest)
        for number, piece in enumerate(self.pieces):
            _check_digest(f"{self.name}, region {number}", piece.data, piece.digest)

    def boxes(self) -> np.ndarray:
        """float64 [R, 2, 3], round the live probes of each region, in the unit of the positions."""
        codes = np.array([piece.box for piece in self.pieces], np.float64) + np.array([[-1.0], [1.0]])
        return self.origin + self.extent * (codes / CODES)

    def labels_of(self, position: np.ndarray | None) -> np.ndarray:
        """The region of each of the model's own probes, int64 [N].

        Args:
            position: float64 [N, 3], which count where the file doesn't state the regions; None: it must.

        Raises:
            WlmError: None are stored, the file is damaged, or these are others than the model's.
        """
        if self.has_positions:
            # A stored position next to a plane may be rounded to its other side.
            labels = self._labels
        elif position is None:
            raise WlmError(NO_POSITIONS.format(self.name))
        else:
            labels = self.split.labels(Places.of(position).code)
        given = self.probes if position is None else len(position)
        counts = np.bincount(labels, minlength=self.split.regions)
        if not given == len(labels) == self.probes or counts.tolist() != [piece.probes for piece in self.pieces]:
            raise WlmError(f"{self.name}: expected the positions of its own {self.probes} probes, in their order")
        return labels

    @cached_property
    def dead(self) -> np.ndarray:
        """bool [N], probes that decode to zero; empty if there are none."""
        if not self.has_positions:
            return self._stated(lambda: unpack_dead(self.order, self.probes))
        dead = np.zeros(self.probes, bool)
        for number, part in enumerate(members(self.labels_of(None), self.split.regions)):
            own = self.region(number).dead
            dead[part] = own if own.size else False
        return dead if dead.any() else np.zeros(0, bool)

    def stored_positions(self) -> np.ndarray:
        """The positions stored with the model, float64 [N, 3], to 1/65535 of their region's box.

        Raises:
            WlmError: None are stored.
        """
        result = np.empty((self.probes, 3))
        for _, part, model in self._regions(None):
            result[part] = model.stored_positions()
        return result

    def without_places(self) -> "RegionModel":
        """The model as its file would be without the positions."""
        if not self.has_positions:
            return self
        pieces = []
        for number, piece in enumerate(self.pieces):
            model = self.region(number)
            data = pack_piece(model.dead, None, model.head.check, model.head.grid, model.stream)
            pieces.append(piece._replace(data=np.frombuffer(data, np.uint8), digest=digest(data)))
        order = pack_dead(self.dead)
        return replace(self, has_positions=False, order=order, order_digest=digest(order), pieces=tuple(pieces))

    def has_probes_at(self, position: np.ndarray) -> bool:
        """Whether positions, float64 [M, 3], are those of the model's own probes, in their order.

        Raises:
            WlmError: A region is damaged.
        """
        if len(position) != self.probes:
            return False
        if not self.has_positions:
            counts = np.bincount(self.split.labels(Places.of(position).code), minlength=self.split.regions)
            if counts.tolist() != [piece.probes for piece in self.pieces]:
                return False
        return all(model.has_probes_at(position[part]) for _, part, model in self._regions(position))

    @property
    def stored_values(self) -> np.ndarray:
        """The numbers of all probes at the places that are stored."""
        result = np.empty((self.probes, self.outputs), np.float32)
        for _, part, model in self._regions(None):
            result[part] = model.stored_values
        return result

    def values_at(self, position: np.ndarray) -> np.ndarray:
        """The numbers of all probes at their own positions, float64 [N, 3]; float32 [N, D].

        Raises:
            WlmError: They are other positions, or a region is damaged.
        """
        result = np.empty((self.probes, self.outputs), np.float32)
        for _, part, model in self._regions(position):
            result[part] = model.values_at(position[part])
        return result

    def _regions(self, position: np.ndarray | None) -> Iterator[tuple[int, np.ndarray, TransformModel]]:
        """Number, probes and model of each region."""
        dead = np.zeros(0, bool) if self.has_positions else self.dead
        for number, part in enumerate(members(self.labels_of(position), self.split.regions)):
            yield number, part, self.region(number, dead[part] if dead.size else dead)

    @cached_property
    def _labels(self) -> np.ndarray:
        return self._stated(lambda: unpack_labels(self.order, self.probes))

    def _stated(self, unpacked: Callable[[], np.ndarray]) -> np.ndarray:
        """What the part `order` says."""
        _check_digest(self.name, self.order, self.order_digest)
        try:
            return unpacked()
        except ValueError as error:
            raise WlmError(f"{self.name}: {error}") from error


def _check_digest(name: str, data: np.ndarray, expected: bytes) -> None:
    if digest(data) != expected:
        raise WlmError(f"{name}: damaged: its content does not match its digest")
