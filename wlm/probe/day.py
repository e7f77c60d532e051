"""Probes of several hours in one model: what an hour is told by others, and the transform of what is left.

Hours are coded one after another. The light of an hour b is predicted from the decoded light of up to two hours a that
come before it in the file, number by number of the same probe, and only what is left is a stream of
`wlm.probe.transform`:

    values_b = left_b + gain_b sum over a of (values_a / gain_a) M_ba / 64

with whole numbers M and the ranges of the hours' numbers as gains. Between two stored times the radiance of both is
mixed linearly; after the last time of a day comes the first of the next.
"""

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from wlm.errors import WlmError
from wlm.formats.deflate import inflate
from wlm.probe.entropy import pack, unpack
from wlm.probe.hours import PERIOD
from wlm.probe.model import live_probes
from wlm.probe.transform import Places, TransformModel, read_head, read_values
from wlm.probe.tree import Tree, flat

REFERENCES = 2
"""Hours that one is predicted from, at most."""

WIDEST = 64
"""Numbers of a probe up to which hours are predicted."""

FINENESS = 64
"""Of the matrices' numbers, which are whole ones over this."""

_HEAD = struct.Struct("<BBHfII")


class Hour(NamedTuple):
    """An hour as it is stored.

    Attributes:
        number: Which of the times it is.
        references: Which times it is predicted from; they come before it in the file.
        gain: Range of its numbers.
        matrix: int64 [R D, D], M of each reference below the other.
        dead: bool [N], its probes that decode to zero; empty if there are none.
        stream: uint8 [B], of what is left.
    """

    number: int
    references: tuple[int, ...]
    gain: float
    matrix: np.ndarray
    dead: np.ndarray
    stream: np.ndarray

    @property
    def bytes(self) -> int:
        """Of the stream and the matrices, in a file."""
        return len(self.stream) + len(pack_matrix(self))


@dataclass(frozen=True, eq=False)
class DayModel(TransformModel):
    """A compressed probe set of several hours, seen at one time.

    What `TransformModel` says of a model is true of the light at `time`; its `stream` is that of the stored hour at or
    before it. A file holds all hours, whatever the time; one that is read is at its first.

    Attributes:
        times: float [T], hours of the day, increasing.
        hours: In the order of the file.
        time: The time that is decoded, in [0, 24).
        held: Decoded hours by number, float32 [N, D]; all views of a model share it.
    """

    DECODER: ClassVar[tuple[str, str]] = ("transform_decode", "TransformDecoder")

    times: tuple[float, ...]
    hours: tuple[Hour, ...]
    time: float
    held: dict[int, np.ndarray]

    @classmethod
    def of(
        cls,
        name: str,
        source: str,
        probes: int,
        outputs: int,
        times: tuple[float, ...],
        hours: Sequence[Hour],
        places: Places | None,
    ) -> "DayModel":
        """The model of some hours, at its first time; arguments as the attributes."""
        empty = np.zeros(0, np.uint8)
        base = cls(name, source, probes, outputs, empty, empty, places, times, tuple(hours), 0.0, {})
        return base.at(times[0])

    def at(self, time: float) -> "DayModel":
        """The same model at another time.

        Args:
            time: In hours, any finite number: it is taken modulo 24.

        Raises:
            WlmError: It isn't finite.
        """
        if not math.isfinite(time):
            raise WlmError(f"{self.name}: time: expected a finite number of hours, got {time}")
        time = math.fmod(time, PERIOD)
        time = time + PERIOD if time < 0 else time
        by_number = {hour.number: hour for hour in self.hours}
        mixed = self._mix(0.0 if time == PERIOD else time)
        # A probe without light at both has none between them.
        dead = ~np.logical_or.reduce([live_probes(by_number[number].dead, self.probes) for number, _ in mixed])
        return replace(
            self,
            time=0.0 if time == PERIOD else time,
            dead=dead if dead.any() else np.zeros(0, bool),
            stream=by_number[mixed[0][0]].stream,
        )

    def values(self, places: Places) -> np.ndarray:
        """The numbers of all probes at the model's time; arguments and errors as of `TransformModel.values`."""
        self.check_places(places)
        mixed = self._mix(self.time)
        if len(mixed) == 1:
            return self._hour(mixed[0][0], places).copy()
        return sum(np.float32(share) * self._hour(number, places) for number, share in mixed)

    def _mix(self, time: float) -> list[tuple[int, float]]:
        """Which stored hours the light at a time is of, and how much of each."""
        after = int(np.searchsorted(self.times, time, side="right"))
        first = self.times[after - 1]
        if first == time or len(self.times) == 1:
            return [((after - 1) % len(self.times), 1.0)]
        second = self.times[after % len(self.times)]
        share = (time - first) % PERIOD / ((second - first) % PERIOD)
        return [((after - 1) % len(self.times), 1.0 - share), (after % len(self.times), share)]

    def _hour(self, number: int, places: Places) -> np.ndarray:
        """A stored hour, float32 [N, D]."""
        if number not in self.held:
            needed = self._needed(number)
            trees: dict[bytes, Tree] = {}
            for hour in self.hours:
                if hour.number in needed and hour.number not in self.held:
                    try:
                        self.held[hour.number] = decode_hour(hour, self.held, self._gains(), places, trees)
                    except ValueError as error:
                        raise WlmError(f"{self.name}: hour {self.times[hour.number]:g}: {error}") from error
        return self.held[number]

    def _needed(self, number: int) -> set[int]:
        needed = {number}
        for hour in reversed(self.hours):
            if hour.number in needed:
                needed.update(hour.references)
        return needed

    def _gains(self) -> dict[int, float]:
        return {hour.number: hour.gain for hour in self.hours}


def decode_hour(
    hour: Hour, decoded: dict[int, np.ndarray], gains: dict[int, float], places: Places, trees: dict[bytes, Tree]
) -> np.ndarray:
    """The numbers of an hour's probes, float32 [N, D].

    Args:
        hour: The hour.
        decoded: Its references, float32 [N, D], by number.
        gains: Of these, by number.
        places: Of all probes.
        trees: By the bytes of which probes are live; where one is missing it is added.

    Raises:
        ValueError: The stream is none of the hour's probes.
    """
    live = live_probes(hour.dead, len(places.code))
    outputs = hour.matrix.shape[1]
    tree = None
    if read_head(hour.stream, outputs).predicted:
        tree = tree_of(live, places, trees)
    with np.errstate(over="ignore", invalid="ignore"):
        result = np.zeros((len(live), outputs), np.float32)
        left = read_values(hour.stream, outputs, places.code[live], tree)
        result[live] = left + predicted(hour, decoded, gains, live)
    if not np.isfinite(result).all():
        raise ValueError("part hours: expected values that float32 holds")
    return result


def predicted(hour: Hour, decoded: dict[int, np.ndarray], gains: dict[int, float], live: np.ndarray) -> np.ndarray:
    """What the live probes of an hour are told by its references, float64 [L, D]; arguments as of `decode_hour`."""
    total = np.zeros((int(live.sum()), hour.matrix.shape[1]))
    outputs = total.shape[1]
    for i, number in enumerate(hour.references):
        matrix = hour.matrix[i * outputs : (i + 1) * outputs] * (hour.gain / FINENESS)
        total += decoded[number][live].astype(np.float64) / gains[number] @ matrix
    return total


def tree_of(live: np.ndarray, places: Places, trees: dict[bytes, Tree]) -> Tree:
    """The tree of live probes, from `trees` or made and put there."""
    key = np.packbits(live).tobytes()
    if key not in trees:
        trees[key] = Tree(places.code[live])
    return trees[key]


def pack_matrix(hour: Hour) -> bytes:
    """An hour's matrices as bytes, none where it has no references."""
    return pack(hour.matrix, flat(len(hour.matrix)), []) if hour.references else b""


def pack_hours(hours: Sequence[Hour], probes: int) -> np.ndarray:
    """The part `hours` of a file, uint8 [B]."""
    content, before = [], np.zeros(probes, bool)
    for hour in hours:
        matrix = pack_matrix(hour)
        dead = ~live_probes(hour.dead, probes)
        change, before = dead ^ before, dead
        packed = zlib.compress(np.packbits(change).tobytes(), 9) if change.any() else b""
        sizes = (len(matrix) // 4, hour.gain, len(packed), len(hour.stream))
        content += [_HEAD.pack(hour.number, len(hour.references), *sizes), bytes(hour.references), matrix, packed]
        content.append(hour.stream.tobytes())
    return np.frombuffer(b"".join(content), np.uint8)


def unpack_hours(part: np.ndarray, times: int, probes: int, outputs: int) -> list[Hour]:
    """Undoes `pack_hours`.

    Args:
        part: uint8 [B].
        times: How many hours there are.
        probes, outputs: N and D.

    Raises:
        ValueError: It can't be a part of so many hours.
    """
    data, at = part.tobytes(), 0

    def take(count: int) -> bytes:
        nonlocal at
        if at + count > len(data):
            raise ValueError(f"part hours: expected at least {at + count} bytes, found {len(data)}")
        at += count
        return data[at - count : at]

    hours: list[Hour] = []
    before, known = np.zeros(probes, bool), set()
    for _ in range(times):
        number, count, words, gain, dead, stream = _HEAD.unpack(take(_HEAD.size))
        references = tuple(take(count))
        if number >= times or number in known or not known.issuperset(references) or len(set(references)) != count:
            raise ValueError(f"part hours: expected each hour once, and after those it is predicted from, at {number}")
        if count > (REFERENCES if outputs <= WIDEST else 0):
            raise ValueError(f"part hours: expected at most {REFERENCES} references, found {count}")
        if not 0.0 < gain < math.inf:
            raise ValueError(f"part hours: expected a positive gain, found {gain:g}")
        matrix = np.zeros((0, outputs), np.int64)
        if count:
            try:
                matrix = unpack(take(4 * words), outputs, flat(count * outputs), [])
            except ValueError as error:
                raise ValueError(f"part hours: {error}") from error
        elif words:
            raise ValueError("part hours: expected no matrix without references")
        if dead:
            bits = inflate(take(dead), -(-probes // 8), "part hours", f"a bit for each of {probes} probes")
            before = before ^ np.unpackbits(np.frombuffer(bits, np.uint8), count=probes).astype(bool)
        known.add(number)
        mask = before if before.any() else np.zeros(0, bool)
        hour = Hour(number, references, gain, matrix, mask, np.frombuffer(take(stream), np.uint8))
        read_head(hour.stream, outputs)
        hours.append(hour)
    if at != len(data):
        raise ValueError(f"part hours: expected {at} bytes, found {len(data)}")
    return hours
