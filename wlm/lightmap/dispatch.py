"""Distributes batches of tiles to worker processes. The result does not depend on the order in which they finish."""

import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.lightmap.trainer import CPU_LANES, Advance, Fitter
from wlm.metrics import nanmean
from wlm.system import Meter
from wlm.workers import Actors, Here, Lost, Processes, Workers, cores

_SLICE = 0.5  # seconds of work between two answers of another process
_POLL = 0.2  # seconds that a signal waits at most to be handled
_DEATHS = 3  # workers that one batch may lose in the same state before the batch is considered the cause
_STOPPING = 30.0  # seconds that workers get to return their state before a stop
_WORTHWHILE = 20_000_000  # samples that take two cores about 20 s: a process takes 3 s to start

Parts = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Batch:
    """Dynamic tiles of one sheet (three channels), which are fitted together; `rows` are theirs in the arrays of the
    sheet's model. Batches are numbered from 0."""

    number: int
    rows: range
    fit: Any


@dataclass(eq=False)
class _Running:
    batch: Batch
    step: int | None = None
    deaths: int = 0
    saving: bool = False


def worker_devices(device: str, workers: int | None, cluster: str | None, samples: int = 0) -> list[str]:
    """Returns the device of each worker; the first three arguments are those of `wlm.lightmap.compress`.

    A short fit gets fewer workers; `samples` is the number of training samples of the whole fit.
    """
    if workers is not None and workers < 1:
        raise WlmError(f"workers: expected at least 1, got {workers}")
    if cluster is not None:
        if device not in ("cpu", "cuda"):
            raise WlmError(f"device '{device}': expected cpu or cuda when the fit runs on a cluster")
        return [device]
    checked = interop.check_device(device)
    if device == "cpu":
        return ["cpu"] * (workers or max(1, min(cores() // CPU_LANES, samples // _WORTHWHILE)))
    gpus = interop.available_devices()[1:] if device == "cuda" else [checked]
    return [gpus[i % len(gpus)] for i in range(workers or 1)]


def start_workers(
    devices: list[str], workers: int | None, cluster: str | None, batches: int, seed: int, track: bool
) -> Workers:
    """Starts a `Fitter` for each device, or on a cluster at most one for each batch; with `track` they measure PSNR."""
    if cluster is not None:
        share = {"CPU": float(CPU_LANES)} if devices[0] == "cpu" else {"GPU": 1.0}
        return Actors(Fitter, (seed, devices[0], track), workers, batches, cluster, share)
    if len(devices) == 1:
        return Here(Fitter(seed, devices[0], track))
    return Processes(Fitter, [(seed, device, track) for device in devices])


class Dispatch:
    """Hands out batches, restarts batches of lost workers, reports progress and writes the checkpoint."""

    def __init__(
        self,
        workers: Workers,
        batches: Sequence[Batch],
        steps: int,
        done: int,
        meter: Meter,
        checkpoint: Checkpoint | None,
    ) -> None:
        """Prepares the fit of `batches`, each of `steps` training steps; nothing starts before `run`. `done` is the
        number of batches that an earlier run finished; `checkpoint`, which may be None, stores states and results."""
        self._workers, self._steps, self._done = workers, steps, done
        self._meter, self._checkpoint = meter, checkpoint
        self._waiting = deque(batches)
        self._running: dict[int, _Running] = {}
        self._dead: set[int] = set()
        self._compiled = False
        self._figures: dict[int, tuple[float, float]] = {}
        self._states: dict[int, Parts] | None = None  # the states of a save that is under way
        self._stop: KeyboardInterrupt | None = None
        self._patience = math.inf

    def run(self) -> Iterator[tuple[Batch, Parts]]:
        """Fits the batches.

        Yields:
            Each finished batch with its trained maps and networks.

        Raises:
            WlmError: A fit diverged, a saved state is wrong, or the workers of a batch died again and again.
            KeyboardInterrupt: Raised by the progress callback; the checkpoint has been written.
        """
        free = list(range(self._workers.count))[::-1]
        while self._waiting or self._running:
            while self._waiting and free and self._may_begin():
                self._begin(free.pop(), _Running(self._waiting.popleft()))
            answer, finished = self._workers.wait(_POLL), None
            if answer is None:
                self._report(moved=False)
            elif isinstance(answer[1], Lost):
                self._restart(*answer)
            elif (finished := self._take(*answer)) is not None:
                free.append(answer[0])
            self._save()
            if finished is not None:
                yield finished

    def _may_begin(self) -> bool:
        """Returns whether a batch may start: the first batch runs alone until its kernels are compiled."""
        return self._stop is None and (self._compiled or not self._running)

    def _begin(self, number: int, run: _Running) -> None:
        if number in self._dead:
            self._workers.renew(number)
            self._dead.remove(number)
        run.step, run.saving = None, False
        self._running[number] = run
        state = None if self._checkpoint is None else self._checkpoint.running(run.batch.number)
        self._workers.call(number, "start", run.batch.fit.job(run.batch), state)

    def _restart(self, number: int, why: Lost) -> None:
        self._dead.add(number)
        run = self._running.pop(number, None)
        if run is None or self._stop is not None:
            return
        run.deaths += 1
        if run.deaths == _DEATHS:
            raise WlmError(f"fit: {_DEATHS} workers died while fitting batch {run.batch.number}: {why}")
        self._begin(number, run)

    def _take(self, number: int, answer: Any) -> tuple[Batch, Parts] | None:
        """Handles a worker's answer and gives the worker more work. Returns the batch and its result if it is done."""
        run = self._running[number]
        if isinstance(answer, BaseException):
            # A wrong state is the checkpoint's fault.
            if isinstance(answer, ValueError) and run.step is None and self._checkpoint is not None:
                raise self._checkpoint.wrong(run.batch.number, answer)
            raise answer
        finished = None
        if isinstance(answer, Advance):
            begun, run.step = run.step is None, answer.step
            if answer.parts is not None:
                finished = run.batch, answer.parts
                self._finish(number, answer.parts)
            if not begun:
                self._compiled = True
                self._figures[number] = answer.loss, answer.psnr
                self._report(moved=True)
        else:
            self._states[run.batch.number] = answer
            run.saving, run.deaths = False, 0
        if finished is not None:
            return finished
        if run.saving:
            self._workers.call(number, "state")
        elif self._stop is None:
            self._workers.call(number, "advance", _SLICE if self._workers.remote else 0.0)
        return None

    def _finish(self, number: int, parts: Parts) -> None:
        batch = self._running.pop(number).batch
        self._done += 1
        if self._states is not None:
            self._states.pop(batch.number, None)
        if self._checkpoint is not None:
            self._checkpoint.add_finished(batch.number, parts)

    def _report(self, moved: bool) -> None:
        """Reports progress, and starts saving a checkpoint if one is due or the user has interrupted the fit."""
        if self._stop is not None:
            return
        done = self._done * self._steps + sum(run.step or 0 for run in self._running.values())
        if self._meter.due(done):
            figures = np.array([*self._figures.values()]).reshape(-1, 2)
            loss, psnr = (nanmean(column) for column in figures.T)
            try:
                self._meter.report(done, loss=float(loss), PSNR_dB=float(psnr))
            except KeyboardInterrupt as stop:
                # Between two steps the states are complete; an interrupt anywhere else saves nothing.
                self._stop, self._patience = stop, time.monotonic() + _STOPPING
        if self._checkpoint is None or self._states is not None:
            return
        if self._stop is not None or (moved and self._checkpoint.due()):
            self._states = {}
            for run in self._running.values():
                run.saving = True

    def _save(self) -> None:
        """Writes the checkpoint once all workers have sent their states; then stops the fit if it was interrupted."""
        late = time.monotonic() > self._patience
        if self._states is not None and (late or not any(run.saving for run in self._running.values())):
            self._checkpoint.save(self._states)
            self._states = None
        if self._stop is not None and self._states is None:
            raise self._stop
