"""Hands out the independent tasks of long work to workers: in this process, its threads, other processes, or a cluster.

The result of a task does not depend on the worker, so the work has the same result for any number of workers, in any
order of completion, and if workers are lost.
"""

import math
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from wlm.errors import WlmError, one_line
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.parts import Part
from wlm.system import Meter
from wlm.workers import Actors, Here, Lost, Processes, Threads, Workers

CPU_LANES = 2
"""Number of CPU threads that a task may keep busy: a worker on a cluster's CPUs takes as many."""

_SLICE = 0.5  # seconds of work between two answers of another process
_POLL = 0.2  # seconds that a signal waits at most to be handled
_DEATHS = 3  # workers that one task may lose in the same state before the task is considered the cause
_STOPPING = 30.0  # seconds that workers get to return their state before a stop


@dataclass(frozen=True, eq=False)
class Task:
    """An independent part of long work, of so many `steps` in the unit of the progress.

    Its `numbers` are those of the batches in it in a checkpoint; the first is the task's own. `job` returns what a
    worker needs to begin, and is called then. Of the tasks of a `kind`, other than None, the first runs alone until
    their kernels are compiled. `table` has types and shapes of the arrays of a result that `gathered` keeps.
    """

    numbers: tuple[int, ...]
    steps: int
    job: Callable[[], Any]
    kind: Any = None
    table: Mapping[str, Part] | None = None


class Advance(NamedTuple):
    """The progress of a task: steps done, measured values as for `Meter.report`, and the result once it is finished."""

    step: int
    figures: Mapping[str, float] = {}
    finished: bool = False
    result: Any = None


class Whole:
    """Base of workers whose tasks are a single call of `run`, without a state to save. A long call may report the
    finished share of the task by `report`, which has no effect in other processes.

    Workers whose tasks have a state have these methods themselves, but for `run`, and a method `state`, which returns a
    list with the arrays of each batch by name. With an attribute `threads` that is true, those on GPUs of this machine
    are threads of this process, one for each GPU: their Python code must take little time, and load kernels `alone`
    (`wlm.interop`).
    """

    report: Callable[[float], None] = staticmethod(lambda share: None)

    def run(self, job: Any) -> Any:
        """Computes the result of a task."""
        raise NotImplementedError

    def start(self, job: Any, states: list) -> Advance:
        """Begins a task. `states` are those of its batches in the checkpoint, None for each that it does not have."""
        self._job = job
        return Advance(0)

    def advance(self, seconds: float) -> Advance:
        """Works on the task for about some seconds, or to its end."""
        return Advance(0, finished=True, result=self.run(self._job))

    def close(self) -> None:
        """Frees memory and ends threads."""


class Place(NamedTuple):
    """Where tasks run.

    Attributes:
        device: "cpu", "cuda" or "cuda:N". Several workers on "cuda" are spread over the GPUs of this machine.
        workers: Number of workers; None: one, on a cluster as many as have room.
        cluster: Address of a Ray cluster, whose workers take two CPUs or a GPU each; None: processes of this machine,
            or threads for its GPUs, see `Whole`.
    """

    device: str = "cpu"
    workers: int | None = None
    cluster: str | None = None

    def devices(self) -> list[str]:
        """Returns the device of each worker, or that of all on a cluster; there must be one at least."""
        from wlm import interop  # torch and Warp take seconds to import, which small workers need not spend

        if self.workers is not None and self.workers < 1:
            raise WlmError(f"workers: expected at least 1, got {self.workers}")
        if self.cluster is not None:
            if self.device not in ("cpu", "cuda"):
                raise WlmError(f"device '{self.device}': expected cpu or cuda when the work runs on a cluster")
            return [self.device]
        each = [interop.check_device(self.device)]
        if self.device == "cuda":
            each = interop.available_devices()[1:]
        return [each[i % len(each)] for i in range(self.workers or 1)]

    @property
    def here(self) -> str:
        """The device for work beside the tasks; that of a cluster is not on this machine."""
        device = self.devices()[0]
        return "cpu" if self.cluster is not None else device


def start_workers(worker: tuple, place: Place, tasks: int) -> Workers:
    """Starts workers, at most one for each of so many tasks; a single one on this machine is in this process. `worker`
    is a class, from a module that can be imported, and its arguments after the first, a device."""
    make, *arguments = worker
    devices = place.devices()[:tasks]
    if place.cluster is not None:
        share = {"CPU": float(CPU_LANES)} if place.device == "cpu" else {"GPU": 1.0}
        return Actors(make, (place.device, *arguments), place.workers, tasks, place.cluster, share)
    threads = getattr(make, "threads", False) and place.device != "cpu"
    devices = list(dict.fromkeys(devices)) if threads else devices
    if len(devices) == 1:
        return Here(make(devices[0], *arguments))
    if threads:
        return Threads([make(each, *arguments) for each in devices])
    return Processes(make, [(each, *arguments) for each in devices])


def run(
    worker: tuple, tasks: list[Task], meter: Meter, place: Place, checkpoint: Checkpoint | None = None, done: int = 0
) -> Iterator[tuple[Task, Any]]:
    """Runs tasks by workers, see `start_workers`, of a class that has the methods of `Whole`.

    Tasks begin in their order. Those of lost workers begin again, and `meter` reports the progress, with `done` steps
    before. The checkpoint has the states of running tasks; the caller adds results, which are written when the work is
    stopped. Yields each finished task with its result. Raises a WlmError if a task failed, a saved state is wrong, or
    the workers of a task died again and again. Raises the KeyboardInterrupt of the progress callback, once the states
    of running tasks have been saved."""
    if tasks:
        try:
            with closing(start_workers(worker, place, len(tasks))) as pool:
                states = checkpoint if hasattr(worker[0], "state") else None
                yield from _Dispatch(pool, tasks, meter, done, states).run()
        except (WlmError, KeyboardInterrupt):
            if checkpoint is not None:
                checkpoint.flush()
            raise


def gathered(
    worker: tuple, tasks: list[Task], meter: Meter, place: Place, checkpoint: Checkpoint | None = None, done: int = 0
) -> dict[int, Any]:
    """Returns the result of each task by its number: from the checkpoint if it has it, or else by `run`."""
    results, left = {}, []
    for task in tasks:
        kept = None if checkpoint is None else checkpoint.finished(task.numbers[0], task.table)
        if kept is None:
            left.append(task)
        else:
            results[task.numbers[0]], done = kept, done + task.steps
    for task, result in run(worker, left, meter, place, checkpoint, done):
        results[task.numbers[0]] = result
        if checkpoint is not None:
            checkpoint.add_finished(task.numbers[0], result)
    return results


@dataclass(eq=False)
class _Running:
    task: Task
    step: int | None = None
    deaths: int = 0
    saving: bool = False


class _Dispatch:
    """Hands out tasks, restarts those of lost workers, reports progress and saves the states of running tasks."""

    def __init__(
        self, workers: Workers, tasks: list[Task], meter: Meter, done: int, checkpoint: Checkpoint | None
    ) -> None:
        self._workers, self._meter, self._done, self._checkpoint = workers, meter, done, checkpoint
        self._waiting = deque(tasks)
        self._running: dict[int, _Running] = {}
        self._dead: set[int] = set()
        self._compiled = {task.kind for task in tasks} if isinstance(workers, Threads) else {None}
        self._figures: Mapping[str, float] = {}  # of the task that advanced last
        self._states: dict[int, dict[str, np.ndarray]] | None = None  # the states of a save that is under way
        self._stop: KeyboardInterrupt | None = None
        self._patience = math.inf
        if isinstance(workers, Here):
            workers.worker.report = self._share

    def run(self) -> Iterator[tuple[Task, Any]]:
        free = list(range(self._workers.count))[::-1]
        while self._waiting or self._running:
            while self._waiting and free and self._may_begin(self._waiting[0].kind):
                self._begin(free.pop(), _Running(self._waiting.popleft()))
            answer = self._workers.wait(_POLL)
            if answer is None:
                self._report(moved=False)
            elif isinstance(answer[1], Lost):
                self._restart(*answer)
            elif (finished := self._take(*answer)) is not None:
                free.append(answer[0])
                yield finished
            self._save()

    def _may_begin(self, kind: Any) -> bool:
        """Returns whether a task may start: the first of a kind runs alone until its kernels are compiled."""
        if self._stop is not None:
            return False
        return kind in self._compiled or all(run.task.kind != kind for run in self._running.values())

    def _begin(self, number: int, run: _Running) -> None:
        if number in self._dead:
            self._workers.renew(number)
            self._dead.remove(number)
        run.step, run.saving = None, False
        self._running[number] = run
        job, kept = run.task.job(), self._checkpoint
        states = [None if kept is None else kept.running(each) for each in run.task.numbers]
        try:
            self._workers.call(number, "start", job, states)
        except (TypeError, AttributeError, pickle.PicklingError) as error:
            told = f"{self._meter.stage}: task {run.task.numbers[0]} cannot be sent to a worker: {one_line(error)}"
            raise WlmError(told) from error

    def _restart(self, number: int, why: Lost) -> None:
        self._dead.add(number)
        run = self._running.pop(number, None)
        if run is None or self._stop is not None:
            return
        run.deaths += 1
        if run.deaths == _DEATHS:
            raise WlmError(f"{self._meter.stage}: {_DEATHS} workers died of task {run.task.numbers[0]}: {why}")
        self._begin(number, run)

    def _take(self, number: int, answer: Any) -> tuple[Task, Any] | None:
        """Handles a worker's answer and gives the worker more work. Returns the task and its result if it is done."""
        run = self._running[number]
        if isinstance(answer, BaseException):
            # A wrong state is the checkpoint's fault.
            if isinstance(answer, ValueError) and run.step is None and self._checkpoint is not None:
                raise self._checkpoint.wrong(run.task.numbers[0], answer)
            raise answer
        if isinstance(answer, Advance):
            begun, run.step = run.step is None, answer.step
            if answer.finished:
                del self._running[number]
                self._done += run.task.steps
                for each in run.task.numbers if self._states is not None else ():
                    self._states.pop(each, None)
            if not begun:
                self._compiled.add(run.task.kind)
                self._figures = answer.figures
                self._report(moved=True)
            if answer.finished:
                return run.task, answer.result
        else:
            self._states |= zip(run.task.numbers, answer, strict=True)
            run.saving, run.deaths = False, 0
        if run.saving:
            self._workers.call(number, "state")
        elif self._stop is None:
            self._workers.call(number, "advance", _SLICE if self._workers.remote else 0.0)
        return None

    def _share(self, share: float) -> None:
        """Reports the finished share of the only task, by which this process is occupied."""
        (run,) = self._running.values()
        run.step = int(share * run.task.steps)
        if self._meter.due(done := self._done + run.step):
            self._meter.report(done)

    def _report(self, moved: bool) -> None:
        """Reports progress, and starts saving a checkpoint if one is due or the user has interrupted the work."""
        if self._stop is not None:
            return
        done = self._done + sum(run.step or 0 for run in self._running.values())
        if self._meter.due(done):
            try:
                self._meter.report(done, **self._figures)
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
        """Writes the checkpoint once all workers have sent their states; then stops the work if it was interrupted."""
        late = time.monotonic() > self._patience
        if self._states is not None and (late or not any(run.saving for run in self._running.values())):
            self._checkpoint.save(self._states)
            self._states = None
        if self._stop is not None and self._states is None:
            raise self._stop
