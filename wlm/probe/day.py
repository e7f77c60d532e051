"""Probes of several hours in one model: what an hour is told by others, and the transform of what is left.

Hours are coded one after another. The light of an hour b is predicted from the decoded light of up to two hours a that
come before it in the file, number by number of the same probe, and only what is left is a stream of
`wlm.probe.transform`:

    values_b = left_b + gain_b sum over a of (values_a / gain_a) M_ba / 64

with whole numbers M and the ranges of the hours' numbers as gains. Between two stored times the radiance of both is
mixed linearly; after the last time of a day comes the first of the next.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from wlm.errors import WlmError
from wlm.probe.entropy import Shape, pack
from wlm.probe.hours import PERIOD
from wlm.probe.model import live_probes
from wlm.probe.transform import Head, Placed, Places, read_values
from wlm.probe.tree import Tree, Trees, flat

REFERENCES = 2
"""Hours that one is predicted from, at most."""

WIDEST = 64
"""Numbers of a probe up to which hours are predicted."""

FINENESS = 64
"""Of the matrices' numbers, which are whole ones over this."""


class Told(NamedTuple):
    """What an hour is told by others.

    Attributes:
        references: Which times it is predicted from; they come before it in the file.
        gain: Range of its numbers.
        matrix: int64 [R D, D], M of each reference below the other.
    """

    references: tuple[int, ...]
    gain: float
    matrix: np.ndarray

    def packed(self) -> bytes:
        """The matrices as bytes, none where there are no references."""
        return pack((self.matrix, matrix_shape(len(self.references), self.matrix.shape[1]))) if self.references else b""

    def predicted(self, decoded: Mapping[int, np.ndarray], gains: Mapping[int, float], live: np.ndarray) -> np.ndarray:
        """What the live probes of the hour are told, float64 [L, D].

        Args:
            decoded: The references' numbers, float32 [N, D], by number.
            gains: Of these, by number.
            live: bool [N], of the hour.
        """
        outputs = self.matrix.shape[1]
        total = np.zeros((int(live.sum()), outputs))
        for i, number in enumerate(self.references):
            matrix = self.matrix[i * outputs : (i + 1) * outputs] * (self.gain / FINENESS)
            total += decoded[number][live].astype(np.float64) / gains[number] @ matrix
        return total


class Hour(NamedTuple):
    """An hour as it is stored.

    Attributes:
        number: Which of the times it is.
        told: By hours before it in the file.
        dead: bool [N], its probes that decode to zero; empty if there are none.
        head: What the stream's numbers are.
        stream: uint8 [B], of what is left.
    """

    number: int
    told: Told
    dead: np.ndarray
    head: Head
    stream: np.ndarray

    @property
    def bytes(self) -> int:
        """Of the stream and the matrices, in a file."""
        return len(self.stream) + len(self.told.packed())

    def values(
        self,
        decoded: Mapping[int, np.ndarray],
        gains: Mapping[int, float],
        places: Places,
        trees: Callable[[np.ndarray, int], Tree],
    ) -> np.ndarray:
        """The numbers of all probes, float32 [N, D].

        Args:
            decoded, gains: As of `Told.predicted`.
            places: Of all probes.
            trees: What makes a tree of these.

        Raises:
            ValueError: The stream is none of the hour's probes.
        """
        live = live_probes(self.dead, len(places.code))
        outputs = self.told.matrix.shape[1]
        result = np.zeros((len(live), outputs), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            left = read_values(self.head, self.stream, outputs, places.code[live], trees)
            result[live] = left + self.told.predicted(decoded, gains, live)
        if not np.isfinite(result).all():
            raise ValueError("expected values that float32 holds")
        return result


def matrix_shape(references: int, outputs: int) -> Shape:
    """How the matrices of so many references are coded."""
    return Shape(outputs, flat(references * outputs))


@dataclass(frozen=True, eq=False)
class DayModel(Placed):
    """A compressed probe set of several hours, seen at one time.

    A file holds all hours, whatever the time; one that is read is at its first.

    Attributes:
        name: The set's name.
        source: The first digits of the hash of the hours' inputs.
        probes: N.
        outputs: D.
        places: Of all probes, where they are stored with the model; else None.
        times: float [T], hours of the day, increasing.
        hours: In the order of the file.
        time: The time that is decoded, in [0, 24).
        held: Decoded hours by number, float32 [N, D]; all views of a model share it.
    """

    name: str
    source: str
    probes: int
    outputs: int
    places: Places | None
    times: tuple[float, ...]
    hours: tuple[Hour, ...]
    time: float
    held: dict[int, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def check(self) -> int:
        return self.hours[0].head.check

    @cached_property
    def dead(self) -> np.ndarray:
        """bool [N], probes that decode to zero at the model's time; empty if there are none."""
        by_number = {hour.number: hour for hour in self.hours}
        # A probe without light at both has none between them.
        lives = [live_probes(by_number[number].dead, self.probes) for number, _ in self._mix()]
        dead = ~np.logical_or.reduce(lives)
        return dead if dead.any() else np.zeros(0, bool)

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
        return replace(self, time=0.0 if time == PERIOD else time)

    def _values(self, places: Places) -> np.ndarray:
        mixed = self._mix()
        if len(mixed) == 1:
            return self._hour(mixed[0][0], places).copy()
        return sum(np.float32(share) * self._hour(number, places) for number, share in mixed)

    def _mix(self) -> list[tuple[int, float]]:
        """Which stored hours the light is of, and how much of each."""
        after = int(np.searchsorted(self.times, self.time, side="right"))
        first = self.times[after - 1]
        if first == self.time or len(self.times) == 1:
            return [((after - 1) % len(self.times), 1.0)]
        second = self.times[after % len(self.times)]
        share = (self.time - first) % PERIOD / ((second - first) % PERIOD)
        return [((after - 1) % len(self.times), 1.0 - share), (after % len(self.times), share)]

    def _hour(self, number: int, places: Places) -> np.ndarray:
        """A stored hour, float32 [N, D]."""
        if number not in self.held:
            needed, trees = self._needed(number), Trees()
            gains = {hour.number: hour.told.gain for hour in self.hours}
            for hour in self.hours:
                if hour.number in needed and hour.number not in self.held:
                    try:
                        self.held[hour.number] = hour.values(self.held, gains, places, trees)
                    except ValueError as error:
                        raise WlmError(f"{self.name}: hour {self.times[hour.number]:g}: {error}") from error
        return self.held[number]

    def _needed(self, number: int) -> set[int]:
        needed = {number}
        for hour in reversed(self.hours):
            if hour.number in needed:
                needed.update(hour.told.references)
        return needed
