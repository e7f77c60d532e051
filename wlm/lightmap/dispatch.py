"""Handing batches of tiles out to workers, in whatever order they get done: the result is the same."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint, CheckpointRange
from wlm.lightmap.tiles import TileKind
from wlm.lightmap.worker import Advance, Piece
from wlm.metrics.tiled import nanmean
from wlm.system import Meter
from wlm.workers import Lost, Workers

_SLICE = 0.5  # seconds of work between two answers of another process
_POLL = 0.2  # seconds: how long a signal waits at most to be heard
_DEATHS = 3  # of workers of one batch from the same state; then the batch is to blame
_STOPPING = 30.0  # seconds that workers get to give their state before a stop

Parts = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Batch:
    """Tiles of one kind that are fitted together.

    Attributes:
        number: Of the batch, from 0.
        kind: STATIC or DYNAMIC.
        rows: int [n], their places among the fit's tiles.
        first: Number of tiles of that kind in earlier batches.
    """

    number: int
    kind: TileKind
    rows: np.ndarray
    first: int


@dataclass(eq=False)
class _Job:
    """A batch that a worker is at.

    Attributes:
        batch: The batch.
        step: Steps done; None until the worker has begun.
        deaths: Workers that it has lost since its state was last kept.
        saving: Whether its state is asked for before it goes on.
    """

    batch: Batch
    step: int | None = None
    deaths: int = 0
    saving: bool = False


class Dispatch:
    """Hands out batches, starts again what is lost, reports progress and keeps the checkpoint."""

    def __init__(
        self,
        workers: Workers,
        piece: Callable[[np.ndarray], Piece],
        steps: int,
        done: int,
        meter: Meter,
        checkpoint: Checkpoint | CheckpointRange | None,
    ) -> None:
        """Takes what all batches share.

        Args:
            workers: Of `wlm.lightmap.worker.Fitter`.
            piece: From the rows of tiles to what a worker gets of them.
            steps: Of a batch.
            done: Batches that are done already.
            meter: Of the steps of all batches.
            checkpoint: Where states and results are kept; None: nowhere.
        """
        self._workers, self._piece, self._steps, self._done = workers, piece, steps, done
        self._meter, self._checkpoint = meter, checkpoint
        self._jobs: dict[int, _Job] = {}
        self._dead: set[int] = set()
        self._warm: set[TileKind] = set()
        self._figures: dict[int, tuple[float, float]] = {}
        self._states: dict[int, Parts] | None = None  # those of a save that is under way
        self._stop: KeyboardInterrupt | None = None
        self._patience = math.inf

    def run(self, batches: Sequence[Batch]) -> Iterator[tuple[Batch, Parts, float]]:
        """Fits batches.

        Yields:
            Each with its parts and its PSNR, see `Advance`, as they get done.

        Raises:
            WlmError: A fit diverged, a kept state is wrong, or the workers of a batch died again and again.
            KeyboardInterrupt: Raised by the progress; the checkpoint has been written.
        """
        waiting, free = deque(batches), list(range(self._workers.count))[::-1]
        while waiting or self._jobs:
            while waiting and free and self._may_begin(waiting[0].kind):
                self._begin(free.pop(), _Job(waiting.popleft()))
            answer, finished = self._workers.wait(_POLL), None
            if answer is None:
                self._look_up(moved=False)
            elif isinstance(answer[1], Lost):
                self._lost(*answer)
            elif (finished := self._take(*answer)) is not None:
                free.append(answer[0])
            self._save()
            if finished is not None:
                yield finished

    def _may_begin(self, kind: TileKind) -> bool:
        """Whether a batch may be handed out: the first of a kind goes alone until its kernels have been compiled, and
        the others find them in the cache."""
        if self._stop is not None:
            return False
        return kind in self._warm or all(job.batch.kind != kind for job in self._jobs.values())

    def _begin(self, number: int, job: _Job) -> None:
        if number in self._dead:
            self._workers.renew(number)
            self._dead.remove(number)
        job.step, job.saving = None, False
        self._jobs[number] = job
        state = None if self._checkpoint is None else self._checkpoint.running(job.batch.number)
        self._workers.call(number, "start", self._piece(job.batch.rows), job.batch.kind == TileKind.DYNAMIC, state)

    def _lost(self, number: int, why: Lost) -> None:
        """Takes note of a worker's end, and begins its batch again from what was kept of it."""
        self._dead.add(number)
        job = self._jobs.pop(number, None)
        if job is None or self._stop is not None:
            return
        job.deaths += 1
        if job.deaths == _DEATHS:
            raise WlmError(f"fit: batch {job.batch.number} has lost {_DEATHS} workers: {why}")
        self._begin(number, job)

    def _take(self, number: int, said: Any) -> tuple[Batch, Parts, float] | None:
        """Takes a worker's answer and has it go on; returns a batch that is done."""
        job = self._jobs[number]
        if isinstance(said, BaseException):
            raise self._told(job, said)
        finished = None
        if isinstance(said, Advance):
            begun, job.step = job.step is None, said.step
            if said.parts is not None:
                finished = job.batch, said.parts, said.psnr
                self._finish(number, said.parts)
            if not begun:
                self._warm.add(job.batch.kind)
                self._figures[number] = said.loss, said.psnr
                self._look_up(moved=True)
        else:
            self._states[job.batch.number] = said
            job.saving, job.deaths = False, 0
        if finished is not None:
            return finished
        if job.saving:
            self._workers.call(number, "state")
        elif self._stop is None:
            self._workers.call(number, "advance", _SLICE if self._workers.remote else 0.0)
        return None

    def _told(self, job: _Job, error: BaseException) -> BaseException:
        """The error of a worker, as it is to be raised: a wrong state is the checkpoint's."""
        if isinstance(error, ValueError) and job.step is None and self._checkpoint is not None:
            return self._checkpoint.wrong(job.batch.number, error)
        return error

    def _finish(self, number: int, parts: Parts) -> None:
        batch = self._jobs.pop(number).batch
        self._done += 1
        if self._states is not None:
            self._states.pop(batch.number, None)
        if self._checkpoint is not None:
            self._checkpoint.add_finished(batch.number, parts)

    def _look_up(self, moved: bool) -> None:
        """Reports progress, and begins a save where one is due or the work is to stop."""
        if self._stop is not None:
            return
        done = self._done * self._steps + sum(job.step or 0 for job in self._jobs.values())
        if self._meter.due(done):
            figures = np.array([*self._figures.values()]).reshape(-1, 2)
            loss, psnr = (nanmean(column) for column in figures.T)
            try:
                self._meter.report(done, loss=float(loss), PSNR_dB=float(psnr))
            except KeyboardInterrupt as stop:
                # Between two steps the states are whole; anywhere else an interrupt keeps nothing.
                self._stop, self._patience = stop, time.monotonic() + _STOPPING
        if self._checkpoint is None or self._states is not None:
            return
        if self._stop is not None or (moved and self._checkpoint.due()):
            self._states = {}
            for job in self._jobs.values():
                job.saving = True

    def _save(self) -> None:
        """Ends a save once all states have come, and then the work where it is to stop."""
        late = time.monotonic() > self._patience
        if self._states is not None and (late or not any(job.saving for job in self._jobs.values())):
            self._checkpoint.save(self._states)
            self._states = None
        if self._stop is not None and self._states is None:
            raise self._stop
