"""Choosing the step of a transform, and what its probes are turned into, for a PSNR or a size.

All regions of a set have one step and one basis: a bit is then worth as much in each. They are coded in processes of
their own where there are many probes.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.compact import digest
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.entropy import LARGEST
from wlm.probe.fields import pack_dead
from wlm.probe.model import Profile
from wlm.probe.noise import noise_psnr
from wlm.probe.regions import Piece, RegionModel, Split, members
from wlm.probe.transform import (
    FINENESS,
    SOURCE,
    VECTORS,
    Coding,
    Places,
    Transform,
    TransformModel,
    step_bits,
    step_of,
    stored_step,
)
from wlm.probe.transform_codec import pack_labels, pack_piece
from wlm.probe.transform_coder import BIT, MANY, Coded, Coders, Measured
from wlm.system import Meter, OnProgress
from wlm.workers import Here, Processes, Workers, cores

_COUNTS = (1, 2, 4, 8, 16)  # of stored directions that are tried, and all
_WIDEST = 64  # numbers of a probe up to which directions are looked for
_TINY = 16  # live probes up to which several ways to code are fitted: each byte counts
_WAYS = 5  # so many
_AROUND = np.arange(-6, 7) / 12  # steps round the best that are tried of these, in powers of two
_TRIES = 14
_FAR = 0.25  # octaves of a step that comes nowhere by smaller ones
_LEAST = -133.0  # of the step's logarithm: a file has no less
PSNR, LEAST_PSNR = 50.0, 40.0
"""That is wanted where nothing is said, and at least that where the input is noise."""

_COARSER = 1.2  # about: a step over that of numbers that are rounded each for itself, at the same PSNR
_CLOSE = 0.03  # dB above the wanted PSNR that is near enough
FULL = 0.985
"""Of the largest size that is near enough."""

_ALONE = 1 << 16  # numbers that a process is worth starting for: a second of work


@dataclass(frozen=True, eq=False)
class Tried:
    """All regions at a step.

    Attributes:
        step: As the file holds it.
        coding: Of all regions.
        streams: uint8 [B], of each.
        grids: Of their trees.
        error: The sum of squares.
    """

    step: float
    coding: Coding
    streams: tuple[np.ndarray, ...]
    grids: tuple[int, ...]
    error: float

    @property
    def size(self) -> int:
        return sum(map(len, self.streams))


def compress_transform(
    probes: ProbeSet, profile: Profile, *, positions: bool = False, progress: OnProgress | None = None
) -> Transform:
    """Compresses a set by a transform over its own places.

    Args:
        probes: The set.
        profile: Of the method "transform".
        positions: Whether the model carries the probes' places.
        progress: Called after each step size that is tried.

    Returns:
        A `TransformModel`, or a `RegionModel` where more probes are alive than a region of the profile has.

    Raises:
        WlmError: A size that nothing fits, or a PSNR that can't be reached.
    """
    frame = Frame(probes, positions, profile.region)
    with _team(frame) as team:
        search = Search(probes, profile, frame, team, progress)
        return search.model(search.chosen())


class Frame:
    """What a set's file holds beside its streams."""

    def __init__(self, probes: ProbeSet, positions: bool, most: int) -> None:
        self.probes, self._positions = probes, positions
        self._places = Places.of(probes.position)
        self._dead = np.zeros(0, bool) if probes.live.all() else ~probes.live
        live = self._places.code[probes.live]
        self.split = Split.of(live, most)
        self._labels = self.split.labels(self._places.code)
        self.members = members(self._labels, self.split.regions)
        self._pieces: list[tuple[Places, int, np.ndarray]] = []
        if self.split.regions > 1:
            self._pieces = [self._piece(part) for part in self.members]
        self._beside: dict[Coding, int] = {}

    def model(self, tried: Tried) -> Transform:
        """The model of what was chosen."""
        probes = self.probes
        head = tried.coding.head(tried.step, self._places.check)
        source = probes.source[:SOURCE]
        if self.split.regions == 1:
            stored = self._places if self._positions else None
            shape = (probes.probes, probes.outputs)
            head = head._replace(grid=tried.grids[0])
            return TransformModel(probes.name, source, *shape, self._dead, head, tried.streams[0], stored)
        pieces = []
        parts = zip(self._pieces, self.members, tried.grids, tried.streams, strict=True)
        for (places, check, box), part, grid, stream in parts:
            dead = self._dead[part] if self._dead.size else self._dead
            data = pack_piece(dead, places if self._positions else None, check, grid, stream)
            pieces.append(Piece(np.frombuffer(data, np.uint8), digest(data), len(part), box))
        order = pack_labels(self._labels) if self._positions else pack_dead(self._dead)
        return RegionModel(
            name=probes.name,
            source=source,
            probes=probes.probes,
            outputs=probes.outputs,
            has_positions=self._positions,
            origin=self._places.origin,
            extent=self._places.extent,
            split=self.split,
            head=head._replace(check=0),
            directions=tried.coding.vectors,
            order=order,
            order_digest=digest(order),
            pieces=tuple(pieces),
        )

    def file_bytes(self, tried: Tried) -> int:
        """Size of the file; what isn't a stream is laid out once for each coding."""
        if tried.coding not in self._beside:
            self._beside[tried.coding] = self.model(tried).file_bytes() - tried.size
        return self._beside[tried.coding] + tried.size

    def _piece(self, part: np.ndarray) -> tuple[Places, int, np.ndarray]:
        places = Places.of(self.probes.position[part])
        live = self._places.code[part][self.probes.live[part]]
        return places, places.check, np.stack([live.min(0), live.max(0)])


class Team:
    """The coders of all regions, wherever they are."""

    def __init__(self, workers: Workers, regions: int) -> None:
        self._workers, self._regions = workers, regions

    def add(self, frame: Frame) -> list[Measured]:
        """Gives each region to one of the workers; as they have time for it, for regions differ."""
        probes, waiting = frame.probes, list(range(self._regions))
        found: dict[int, Measured] = {}
        given: dict[int, int] = {}

        def give(worker: int) -> None:
            number = given[worker] = waiting.pop(0)
            part = frame.members[number]
            arrays = (probes.position[part], np.asarray(probes.values[part]), probes.live[part])
            self._workers.call(worker, "add", number, *arrays)

        for worker in range(self._workers.count):
            give(worker)
        while len(found) < self._regions:
            worker, answer = self._answer()
            found[given[worker]] = answer
            if waiting:
                give(worker)
        return [found[number] for number in range(self._regions)]

    def run(self, method: str, *arguments: Any) -> list[Any]:
        """Calls a method of all coders; what they return, region by region."""
        for worker in range(self._workers.count):
            self._workers.call(worker, "run", method, *arguments)
        found: dict[int, Any] = {}
        for _ in range(self._workers.count):
            found |= self._answer()[1]
        return [found[number] for number in range(self._regions)]

    def _answer(self) -> tuple[int, Any]:
        while (answer := self._workers.wait(1.0)) is None:
            continue
        if isinstance(answer[1], WlmError):
            raise answer[1]
        if isinstance(answer[1], Exception):
            raise WlmError(f"a process of the fit was lost: {answer[1]}") from answer[1]
        return answer


@contextmanager
def _team(frame: Frame):
    """Coders in this process, or in as many as there is work for."""
    regions = frame.split.regions
    numbers = int(frame.probes.live.sum()) * frame.probes.outputs
    count = min(cores(), regions, numbers // _ALONE)
    workers = Processes(Coders, [()] * count) if count > 1 else Here(Coders())
    try:
        yield Team(workers, regions)
    finally:
        workers.close()


class Search:
    """The size and the error of a set at a step, and the step that is wanted."""

    def __init__(
        self,
        probes: ProbeSet,
        profile: Profile,
        frame: Frame,
        team: Team,
        progress: OnProgress | None,
        *,
        peak: float | None = None,
    ) -> None:
        """Gives a set to its coders.

        Args:
            probes: The set.
            profile: What is wanted of it.
            frame, team: Of the set.
            progress: Called after each step size that is tried.
            peak: What PSNR is of; None: that of the set.
        """
        self._probes, self._profile, self._frame, self._team = probes, profile, frame, team
        self._peak = peak_of(probes) if peak is None else peak
        measured = team.add(frame)
        # What is left of probes that are predicted exactly is zero.
        self._largest = max(each.largest for each in measured) or self._peak
        self._inner = sum(each.inner for each in measured)
        self._change = np.sum([each.change for each in measured], axis=0)
        self._live = int(probes.live.sum())
        self._choose(Coding(True))
        # A fitted step is finer than a plain one of the same size: directions are chosen again where that is quick.
        self._rounds = 2 if self._live <= MANY else 1
        self._meter = Meter(progress, "fit", 0)
        self._tried = 0

    def chosen(self) -> Tried:
        """What has the wanted size, or the wanted PSNR."""
        psnr, limit = self._profile.target_psnr, self._profile.max_bytes
        if psnr is not None or limit is None:
            tried = self.smallest(usual_psnr(self._probes) if psnr is None else psnr)
            if limit is None or self._frame.file_bytes(tried) <= limit:
                return tried
        return self._best(limit)

    def model(self, tried: Tried) -> Transform:
        """The model of what was tried."""
        return self._frame.model(tried)

    def at_step(self, step: float, like: Tried | None = None) -> Tried:
        """What is worth most at a step, for a set of one region.

        Args:
            step: The step.
            like: What was tried at another step, to be coded the same way; None: the way that is worth most.
        """
        if like is None:
            self._choose_basis(step)
        else:
            self._choose(like.coding)
            self._team.run("plant", like.grids[0])
        return self._fitted(step)

    def rough_bytes(self, step: float) -> int:
        """About the bytes of the streams at a step."""
        return self._plain(step).size

    def cost(self, step: float, more: int) -> float:
        """About the squared error at a step, and what the file is worth with so many bytes more."""
        # All directions, or none.
        options = self._codings()[2:]
        return min(self._costs([options[0], options[-1]], step, more).values())

    def smallest(self, psnr: float) -> Tried:
        """What reaches a PSNR in the fewest bytes."""
        # Of the first search the step alone is of use.
        found, coarser = [self._for_psnr(psnr, self._uncoded, 0.5)], _COARSER
        for _ in range(self._rounds):
            self._choose_basis(found[-1].step)
            found.append(self._for_psnr(psnr, self._fitted, _CLOSE, found[-1].step * coarser))
            coarser = 1.0
        return min(found[1:], key=lambda tried: tried.size)

    def _best(self, limit: int) -> Tried:
        """What has the least error in a size."""
        self._choose(Coding(True))
        found = [self._for_bytes(limit, self._plain, 0.9)]
        for _ in range(self._rounds):
            self._choose_basis(found[-1].step)
            if self._frame.file_bytes(self._plain(8.0 * self._largest)) > limit:
                # No room for anything beside the directions.
                self._choose(Coding(True))
            found.append(self._for_bytes(limit, self._fitted, FULL, found[-1].step))
        if self._live <= _TINY:
            found += self._several(limit, found[-1].step)
        return min(found, key=lambda tried: tried.error)

    def _several(self, limit: int, step: float) -> list[Tried]:
        """What fits into a size of the ways to code that cost least at a step, each at many steps round it."""
        found = []
        for coding in self._ranked(step)[:_WAYS]:
            self._choose(coding)
            self._team.run("settle", step)
            tries = [encode(step * 2.0**x) for x in _AROUND for encode in (self._plain, self._fitted)]
            found += [tried for tried in tries if self._frame.file_bytes(tried) <= limit]
        return found

    def _for_psnr(self, target: float, encode: Callable[[float], Tried], close: float, start: float = 0.0) -> Tried:
        start = start or self._peak * 10.0 ** (-target / 20.0) * 4.0
        tried, excess = self._solve(
            encode,
            lambda tried: self._psnr(tried) - target,
            -4.0,
            close,
            start,
            lambda tried: (tried.size, -tried.step),
        )
        if excess < 0:
            name, most = self._probes.name, self._psnr(tried)
            raise WlmError(f"--target-psnr: expected at most {most:.1f} for {name}, got {target:g}")
        return tried

    def _for_bytes(self, limit: int, encode: Callable[[float], Tried], full: float, start: float = 0.0) -> Tried:
        def room(tried: Tried) -> float:
            return math.log2(limit / self._frame.file_bytes(tried))

        start = start or self._peak * 0.02
        tried, excess = self._solve(encode, room, 0.7, -math.log2(full), start, lambda tried: tried.error)
        if excess < 0:
            least = self._frame.file_bytes(tried)
            raise WlmError(f"--max-bytes: expected at least {least} for {self._probes.name}, got {limit}")
        return tried

    def _solve(
        self,
        encode: Callable[[float], Tried],
        excess: Callable[[Tried], float],
        slope: float,
        close: float,
        start: float,
        cost: Callable[[Tried], Any],
    ) -> tuple[Tried, float]:
        """What costs least of all tried whose excess isn't negative, with its excess; else what comes nearest.

        `slope` is about what the excess gains where the step doubles. An excess up to `close` is small enough.
        """
        good: list[tuple[Tried, float]] = []
        # From numbers that still have room to a step at which all are 0, whatever the directions.
        low, high = max(math.log2(4.0 * self._largest / LARGEST), _LEAST), math.log2(8.0 * self._largest)
        x = min(max(math.log2(start), low), high)
        ends: dict[bool, tuple[float, float, Tried]] = {}  # by whether it is enough: step, excess
        seen: set[int] = set()
        for trial in range(2 * _TRIES):
            if trial == _TRIES and good:
                break
            seen.add(_bits(x))
            tried = encode(2.0**x)
            found = excess(tried)
            self._tried += 1
            if self._meter.due(self._tried):
                size = {"bytes": self._frame.file_bytes(tried)} if tried.size else {}
                self._meter.report(self._tried, PSNR_dB=self._psnr(tried), **size)
            enough = found >= 0
            if enough:
                good.append((tried, found))
            # Between both ends x is nearer than either, whatever was found there.
            if len(ends) == 2 or enough not in ends or abs(found) < abs(ends[enough][1]):
                ends[enough] = x, found, tried
            if enough and found <= close:
                break
            if len(ends) == 2:
                (a, at_a, _), (b, at_b, _) = ends[False], ends[True]
                share = (0.5 * close - at_a) / (at_b - at_a)
                x = a + min(max(share, 0.1), 0.9) * (b - a)
                between = range(min(map(_bits, (a, b))) + 1, max(map(_bits, (a, b))))
                if not between:
                    break
                if _bits(x) not in between:
                    x = math.log2(step_of(between[len(between) // 2]))
            else:
                further = min(max(x + (0.5 * close - found) / slope, x - 6.0), x + 6.0)
                if trial >= _TRIES:
                    # What comes nearer and nearer, and never there.
                    further = x + math.copysign(_FAR, slope)
                further = min(max(further, low), high)
                if further == x:
                    break
                if _bits(further) in seen:
                    # The file has no step so near: the next one that it has.
                    further = math.log2(step_of(max(_bits(x) + (1 if further > x else -1), 1)))
                x = further
        if good:
            return min(good, key=lambda pair: cost(pair[0]))
        _, found, tried = ends[False]
        return tried, found

    def _codings(self) -> list[Coding]:
        """All ways to code that are tried."""
        outputs = self._probes.outputs
        options = [Coding(False, raw=True), Coding(False), Coding(True)]
        if self._inner and 1 < outputs <= _WIDEST:
            vectors = np.linalg.eigh(self._change)[1][:, ::-1].T[:VECTORS]
            # Of many probes the directions are a small part.
            few, apart = self._inner <= MANY, self._frame.split.regions > 1
            counts = [count for count in _COUNTS if few and count < len(vectors)] + [len(vectors)]
            for fineness in FINENESS if few else FINENESS[-1:]:
                rounded = np.rint(vectors * fineness) / fineness
                options += [Coding(True, rounded[:count], fineness, apart=apart) for count in counts]
        return options

    def _ranked(self, step: float) -> list[Coding]:
        """All ways to code, the one that is worth most at a step first."""
        costs = self._costs(self._codings(), step)
        return sorted(costs, key=costs.get)

    def _costs(self, options: Sequence[Coding], step: float, more: int = 0) -> dict[Coding, float]:
        """The squared error of ways to code, with what the file is worth, of so many bytes more."""
        costs = {}
        for coding in options:
            self._choose(coding)
            tried = self._plain(step)
            costs[coding] = tried.error + BIT * tried.step**2 * 8 * (self._frame.file_bytes(tried) + more)
        return costs

    def _choose_basis(self, step: float) -> None:
        """Takes the directions, or none, and the prediction, or none, that are worth most at a step."""
        self._choose(self._ranked(step)[0])
        self._team.run("settle", step)

    def _choose(self, coding: Coding) -> None:
        self._coding = coding
        self._team.run("choose", coding)

    def _plain(self, step: float) -> Tried:
        return self._all("plain", step)

    def _uncoded(self, step: float) -> Tried:
        return self._all("uncoded", step)

    def _fitted(self, step: float) -> Tried:
        return self._all("fitted", step)

    def _all(self, method: str, step: float) -> Tried:
        coded: list[Coded] = self._team.run(method, step)
        error = sum(each.error for each in coded)
        streams, grids = tuple(each.stream for each in coded), tuple(each.grid for each in coded)
        return Tried(stored_step(step), self._coding, streams, grids, error)

    def _psnr(self, tried: Tried) -> float:
        return psnr_from_mse(tried.error / self._probes.values.size, self._peak)


def _bits(x: float) -> int:
    """What a file holds of a step of so many octaves."""
    return step_bits(2.0**x)


def usual_psnr(probes: ProbeSet) -> float:
    """What is wanted of a set where nothing is said: no more than tells its light from its noise."""
    noise = noise_psnr(probes)
    return PSNR if noise is None else min(max(noise, LEAST_PSNR), PSNR)


def peak_of(probes: ProbeSet) -> float:
    """What the PSNR of a set is of: the range of its numbers, or the largest of those that are all alike."""
    return float(probes.values.max()) - float(probes.values.min()) or float(np.abs(probes.values).max())
