"""Fitting several hours of one scene: in which order, from what each is predicted, and at which step.

Which hours tell much of each other is estimated from the hours as they were; the matrices are then fitted to the
decoded ones, so that what is lost of an hour is made up for in the next.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from wlm.errors import WlmError
from wlm.probe.data import ProbeSet
from wlm.probe.day import FINENESS, REFERENCES, WIDEST, DayModel, Hour, Told
from wlm.probe.hours import check_hours, joint_source
from wlm.probe.model import Profile
from wlm.probe.transform import SOURCE, Places
from wlm.probe.transform_coder import Coders
from wlm.probe.transform_fit import FULL, Frame, Search, Team, Tried, peak_of, usual_psnr
from wlm.probe.tree import FIRST, Tree, Trees
from wlm.system import Meter, OnProgress
from wlm.workers import Here

_DARK = 1e-150  # power of an hour that is all alike
_ROWS = 2048  # probes by which hours are put in order
_TRIES = 10
_CLOSE, _NEAR = 0.15, 0.5  # octaves of bytes: for a rough step, and at which hours are told by the same
_SLOPE = 0.7  # about the octaves of bytes that an octave of the step is worth
_SLIGHT = 1e-6  # of the mean square of what is predicted from
_MOST = 1 << 12  # whole numbers of a matrix


def compress_day(
    sets: Sequence[ProbeSet],
    times: Sequence[float],
    profile: str | Profile = "transform",
    *,
    positions: bool = False,
    progress: OnProgress | None = None,
    **overrides: float | int | None,
) -> DayModel:
    """Compresses several hours of one set of probes into one model.

    Args:
        sets: One for each hour, of the same positions and numbers of a probe.
        times: Their hours of the day, in [0, 24), in any order.
        profile: Of the method "transform". `target_psnr` is what each hour reaches, over its own range; with
            `max_bytes` all hours have one step relative to their ranges, which is what has the least error.
        positions: Whether the model carries the probes' places.
        progress: Called after each hour that is coded.
        overrides: Settings that replace the profile's.

    Raises:
        WlmError: Times or sets that don't fit each other, another method, more live probes than the profile's region
            has, a size that nothing fits, or a PSNR that can't be reached.
    """
    profile = Profile.load(profile).override(overrides)
    if profile.method != "transform":
        raise WlmError(f"times: expected a profile of the method transform, found {profile.name}")
    check_hours(sets, times)
    live = max(int(probes.live.sum()) for probes in sets)
    if live > profile.region:
        raise WlmError(f"--region: expected at least {live}: several hours are one region, got {profile.region}")
    order = np.argsort(times)
    fit = _Fit([sets[i] for i in order], tuple(float(times[i]) for i in order), profile, positions, progress)
    return fit.chosen()


class _Way(NamedTuple):
    """Which hours one is predicted from, and whether by fitted matrices or as they are."""

    references: tuple[int, ...]
    fitted: bool


class _Fit:
    """The hours of a set, and what they are coded as."""

    def __init__(
        self,
        sets: Sequence[ProbeSet],
        times: tuple[float, ...],
        profile: Profile,
        positions: bool,
        progress: OnProgress | None,
    ) -> None:
        self._sets, self._times, self._profile = sets, times, profile
        self._places = Places.of(sets[0].position)
        self._stored = self._places if positions else None
        # As the file holds them.
        self._gains = {i: max(float(np.float32(peak_of(probes))), 1e-38) for i, probes in enumerate(sets)}
        self._trees = Trees()
        self._meter = Meter(progress, "fit", 0)
        self._coded = 0
        self._order = self._ordered()
        self._ways: dict[int, _Way] = {}
        self._tried: dict[int, Tried] = {}

    def chosen(self) -> DayModel:
        """The model of the wanted PSNR, or the wanted size."""
        psnr, limit = self._profile.target_psnr, self._profile.max_bytes
        if psnr is not None or limit is None:
            # Where nothing is said each hour ends at its own noise.
            wanted = [usual_psnr(probes) if psnr is None else psnr for probes in self._sets]
            about = 4.0 * 10.0 ** (-float(np.mean(wanted)) / 20.0)
            model, _ = self._day(about, lambda search, number: search.smallest(wanted[number]))
            if limit is None or model.file_bytes() <= limit:
                return model
        return self._best(limit)

    def _best(self, limit: int) -> DayModel:
        """What has the least error in a size: one step for all hours, relative to their ranges."""
        x, good, smallest = self._rough(limit), [], math.inf
        # From one that is too large to one that isn't: the step's logarithm and what room there is.
        ends: dict[bool, tuple[float, float]] = {}
        for _ in range(_TRIES):
            model, error = self._day(2.0**x, functools.partial(self._at_step, 2.0**x))
            size = model.file_bytes()
            smallest, room = min(smallest, size), math.log2(limit / size)
            if room >= 0.0:
                good.append((error, x, model))
                if size >= FULL * limit:
                    break
            if abs(room) > _NEAR:
                # At another step other hours and directions are worth it.
                self._ways, self._tried, ends = {}, {}, {}
            ends[room >= 0.0] = x, room
            x = _next(x, room, ends)
        if not good:
            raise WlmError(f"--max-bytes: expected at least {smallest} for {self._sets[0].name}, got {limit}")
        return min(good, key=lambda found: found[:2])[2]

    def _rough(self, limit: int) -> float:
        """The logarithm of about the step at which the hours fit into a size, each coded for itself."""
        searches = [self._left(number, _Way((), False), {})[1] for number in self._order]
        x, ends = math.log2(0.02), {}
        for _ in range(_TRIES):
            step = 2.0**x
            size = sum(
                search.rough_bytes(step * self._gains[i]) for i, search in zip(self._order, searches, strict=True)
            )
            room = math.log2(limit / size)
            if abs(room) < _CLOSE:
                break
            ends[room >= 0.0] = x, room
            x = _next(x, room, ends)
        return x

    def _at_step(self, step: float, search: Search, number: int) -> Tried:
        tried = self._tried[number] = search.at_step(step * self._gains[number], self._tried.get(number))
        return tried

    def _day(self, step: float, encode: Callable[[Search, int], Tried]) -> tuple[DayModel, float]:
        """All hours, each from what is decoded of those before it, and the sum of their errors over their gains.

        Args:
            step: About what it will be, over an hour's gain.
            encode: From what is left of an hour and its number to what it is coded as.
        """
        decoded: dict[int, np.ndarray] = {}
        hours, total = [], 0.0
        for number in self._order:
            probes, gain = self._sets[number], self._gains[number]
            if number not in self._ways:
                self._ways[number] = self._choose(number, decoded, step)
            told, search = self._left(number, self._ways[number], decoded)
            made = search.model(encode(search, number))
            hour = Hour(number, told, made.dead, made.head, made.stream)
            hours.append(hour)
            decoded[number] = hour.values(decoded, self._gains, self._places, self._trees)
            error = float(np.square(decoded[number].astype(np.float64) - probes.values).mean()) / gain**2
            total += error
            self._coded += 1
            if self._meter.due(self._coded):
                self._meter.report(self._coded, PSNR_dB=-10.0 * math.log10(max(error, 1e-12)))
        first = self._sets[0]
        source = joint_source(self._sets, self._times)[:SOURCE]
        shape = (first.probes, first.outputs)
        return DayModel(first.name, source, *shape, self._stored, self._times, tuple(hours), self._times[0]), total

    def _ordered(self) -> list[int]:
        """Hours such that each is told much by those before it: the middle one first, then the nearest to any."""
        count = len(self._sets)
        light = [probes.values / self._gains[i] for i, probes in enumerate(self._sets)]
        rows = np.linspace(0, len(light[0]) - 1, min(len(light[0]), _ROWS)).astype(int)
        light = [values[rows].astype(np.float64) for values in light]
        centred = np.stack([(values - values.mean(0)).ravel() for values in light])
        square = centred @ centred.T
        power = np.maximum(np.diag(square), _DARK)
        like = np.square(square) / np.outer(power, power)  # how much of one is a multiple of the other
        order = [int(np.argmax(like.sum(1)))]
        while len(order) < count:
            rest = [i for i in range(count) if i not in order]
            order.append(max(rest, key=lambda i: like[i, order].max()))
        return order

    def _choose(self, number: int, decoded: Mapping[int, np.ndarray], step: float) -> _Way:
        """What an hour is told by those that are decoded: what takes the fewest bytes at a step."""
        chosen = _Way((), False)
        if self._sets[number].outputs > WIDEST:
            return chosen
        least = self._cost(number, chosen, decoded, step)
        for count in range(1, REFERENCES + 1):
            rest = [i for i in decoded if i not in chosen.references]
            if len(chosen.references) < count - 1 or not rest:
                break
            options = [_Way((*chosen.references, i), True) for i in rest]
            best = options[int(np.argmin([self._remains(number, way, decoded, step) for way in options]))]
            # The light of the other hour as it is takes next to no bytes for the matrix.
            for way in (best, best._replace(fitted=False))[: 3 - count]:
                cost = self._cost(number, way, decoded, step)
                if cost < least:
                    chosen, least = way, cost
        return chosen

    def _cost(self, number: int, way: _Way, decoded: Mapping[int, np.ndarray], step: float) -> float:
        told, search = self._left(number, way, decoded)
        return search.cost(step * self._gains[number], len(told.packed()))

    def _remains(self, number: int, way: _Way, decoded: Mapping[int, np.ndarray], step: float) -> float:
        """About the bits of what is left of an hour."""
        told, probes = self._told(number, way, decoded), self._sets[number]
        left = probes.values[probes.live] - told.predicted(decoded, self._gains, probes.live)
        tree = self._tree(number)
        size = tree.coefficients(left) * tree.reach[:, None] / (step * self._gains[number])
        return float(np.log2(1.0 + np.square(size)).sum())

    def _left(self, number: int, way: _Way, decoded: Mapping[int, np.ndarray]) -> tuple[Told, Search]:
        """What an hour is told, and the search for what is left of it."""
        told, probes = self._told(number, way, decoded), self._sets[number]
        values = probes.values.copy()
        values[probes.live] -= told.predicted(decoded, self._gains, probes.live).astype(np.float32)
        left = replace(probes, values=values)
        frame, team = Frame(left, False, self._profile.region), Team(Here(Coders(self._trees)), 1)
        return told, Search(left, self._profile, frame, team, None, peak=self._gains[number])

    def _told(self, number: int, way: _Way, decoded: Mapping[int, np.ndarray]) -> Told:
        """What leaves least of an hour."""
        probes, outputs = self._sets[number], self._sets[number].outputs
        matrix = np.zeros((0, outputs), np.int64)
        if way.references and not way.fitted:
            matrix = FINENESS * np.eye(outputs, dtype=np.int64)
        elif way.references:
            tree = self._tree(number)

            def detail(values: np.ndarray, gain: float) -> np.ndarray:
                return tree.coefficients(values[probes.live].astype(np.float64) / gain) * tree.reach[:, None]

            known = np.concatenate([detail(decoded[i], self._gains[i]) for i in way.references], 1)
            square = known.T @ known
            square[np.diag_indices_from(square)] += _SLIGHT * max(np.trace(square) / len(square), 1e-300)
            side = known.T @ detail(probes.values, self._gains[number])
            matrix = np.rint(np.linalg.solve(square, side) * FINENESS)
            matrix = np.clip(matrix, -_MOST, _MOST).astype(np.int64)
        return Told(way.references, self._gains[number], matrix)

    def _tree(self, number: int) -> Tree:
        """Of an hour's live probes."""
        return self._trees(self._places.code[self._sets[number].live], FIRST)


def _next(x: float, room: float, ends: dict[bool, tuple[float, float]]) -> float:
    """The next step's logarithm to try, from the last one's and what room it left, in octaves of bytes."""
    wanted = -0.5 * math.log2(FULL)
    if len(ends) < 2:
        return x - min(max((room - wanted) / _SLOPE, -6.0), 3.0)
    (a, at_a), (b, at_b) = ends[False], ends[True]
    share = (wanted - at_a) / (at_b - at_a)
    return a + min(max(share, 0.1), 0.9) * (b - a)
