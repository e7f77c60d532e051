"""Hands out the independent tasks of long work to workers: in this process, in other processes, or on a Ray cluster.

The result of a task does not depend on the worker, so the work has the same result for any number of workers, in any
order of completion, and if workers are lost.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.metrics import nanmean
from wlm.system import Meter
from wlm.workers import Actors, Here, Lost, Processes, Workers

CPU_LANES = 2
"""Number of CPU threads that a task may keep busy: a worker on a cluster's CPUs takes as many."""

_SLICE = 0.5  # seconds of work between two answers of another process
_POLL = 0.2  # seconds that a signal waits at most to be handled
_DEATHS = 3  # workers that one task may lose in the same state before the task is considered the cause
_STOPPING = 30.0  # seconds that workers get to return their state before a stop


@dataclass(frozen=True, eq=False)
class Task:
    """An independent part of long work.

    Attributes:
        numbers: Numbers of the batches in it, which a checkpoint keeps separately; the first is the task's own.
        steps: Its share of the work, in the unit of the progress.
        job: Returns what a worker needs to begin; called then.
        kind: Tasks of one kind use the same kernels: the first runs alone until these are compiled. None: no such kind.
    """

    numbers: tuple[int, ...]
    steps: int
    job: Callable[[], Any]
    kind: Any = None


@dataclass(frozen=True, eq=False)
class Advance:
    """The progress of a task: steps done, measured values as for `wlm.system.Meter.report`, and the result once the
    task is `finished`."""

    step: int
    figures: Mapping[str, float] = field(default_factory=dict)
    finished: bool = False
    result: Any = None


class Whole:
    """Base of workers whose tasks are a single call of `run`, without a state to save.

    Within a long call, `run` may report the finished share of the task by `report`, which has no effect in other
    processes. Workers whose tasks can be interrupted have these methods themselves, and a method `state`, which returns
    a list with the arrays of each batch by name.
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


def worker_devices(device: str, workers: int | None, cluster: str | None, usual: int = 1) -> list[str]:
    """Returns the device of each worker, or that of all on a cluster; `usual` is the number on a CPU by default.

    Args:
        device: "cpu", "cuda" or "cuda:N". Several workers on "cuda" are spread over the GPUs of this machine.
        workers: Number of workers, None for the default: on a GPU one, on a cluster as many as it has room for.
        cluster: Address of a Ray cluster; None: this machine.

    Raises:
        WlmError: There are no workers, or no such device.
    """
    if workers is not None and workers < 1:
        raise WlmError(f"workers: expected at least 1, got {workers}")
    if cluster is not None:
        if device not in ("cpu", "cuda"):
            raise WlmError(f"device '{device}': expected cpu or cuda when the work runs on a cluster")
        return [device]
    checked = interop.check_device(device)
    if device == "cpu":
        return ["cpu"] * (workers or usual)
    gpus = interop.available_devices()[1:] if device == "cuda" else [checked]
    return [gpus[i % len(gpus)] for i in range(workers or 1)]


def start_workers(
    make: type,
    arguments: tuple[Any, ...],
    device: str,
    workers: int | None,
    cluster: str | None,
    tasks: int,
    usual: int = 1,
) -> Workers:
    """Starts workers of a class, at most one for each of so many tasks.

    `make`, from a module that can be imported, is called with a device and the `arguments`; the other arguments are
    those of `worker_devices`. One worker on this machine is in this process.
    """
    devices = worker_devices(device, workers, cluster, usual)[: max(tasks, 1)]
    if cluster is not None:
        share = {"CPU": float(CPU_LANES)} if device == "cpu" else {"GPU": 1.0}
        return Actors(make, (device, *arguments), workers, max(tasks, 1), cluster, share)
    if len(devices) == 1:
        return Here(make(devices[0], *arguments))
    return Processes(make, [(each, *arguments) for each in devices])


@dataclass(eq=False)
class _Running:
    task: Task
    step: int | None = None
    deaths: int = 0
    saving: bool = False


class Dispatch:
    """Hands out tasks, restarts those of lost workers, reports progress and saves the states of running tasks."""

    def __init__(
        self,
        workers: Workers,
        tasks: Sequence[Task],
        meter: Meter,
        done: int = 0,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        """Prepares the tasks; nothing starts before `run`.

        Args:
            workers: From `start_workers`, of a class with the methods of `Whole`.
            tasks: The tasks, which begin in this order.
            meter: Reports the progress.
            done: Steps that are finished already.
            checkpoint: Keeps the states of running tasks, and has those of an earlier run; None: they have none.
        """
        self._workers, self._meter, self._done, self._checkpoint = workers, meter, done, checkpoint
        self._waiting = deque(tasks)
        self._running: dict[int, _Running] = {}
        self._dead: set[int] = set()
        self._compiled: set[Any] = {None}
        self._figures: dict[int, Mapping[str, float]] = {}
        self._states: dict[int, dict[str, np.ndarray]] | None = None  # the states of a save that is under way
        self._stop: KeyboardInterrupt | None = None
        self._patience = math.inf
        workers.on_share(self._share)

    def run(self) -> Iterator[tuple[int, Any]]:
        """Runs the tasks.

        Yields:
            The number and the result of each finished task. The caller adds results to the checkpoint.

        Raises:
            WlmError: A task failed, a saved state is wrong, or the workers of a task died again and again.
            KeyboardInterrupt: Raised by the progress callback; the states of running tasks have been saved.
        """
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
        kept = self._checkpoint
        states = [None if kept is None else kept.running(each) for each in run.task.numbers]
        self._workers.call(number, "start", run.task.job(), states)

    def _restart(self, number: int, why: Lost) -> None:
        self._dead.add(number)
        run = self._running.pop(number, None)
        if run is None or self._stop is not None:
            return
        run.deaths += 1
        if run.deaths == _DEATHS:
            raise WlmError(f"{self._meter.stage}: {_DEATHS} workers died of task {run.task.numbers[0]}: {why}")
        self._begin(number, run)

    def _take(self, number: int, answer: Any) -> tuple[int, Any] | None:
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
                self._figures[number] = answer.figures
                self._report(moved=True)
            if answer.finished:
                return run.task.numbers[0], answer.result
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
            names = dict.fromkeys(name for each in self._figures.values() for name in each)
            known = ((name, [each[name] for each in self._figures.values() if name in each]) for name in names)
            try:
                self._meter.report(done, **{name: float(nanmean(np.array(values))) for name, values in known})
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
