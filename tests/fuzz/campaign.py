"""Many cases on worker processes that are started again after a crash, and the table of what came of them."""

import os
import re
import signal
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Any
from unittest.mock import patch

from wlm.workers import Lost, Processes

from .worker import FAILURES, Alone, Limits, Outcome

_START = 600.0  # seconds in which a worker must have imported and compiled what a reader needs


@dataclass
class Tally:
    """The outcomes of a reader's cases."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[Outcome] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        self.counts[outcome.kind] += 1
        if outcome.failed:
            self.failures.append(outcome)

    def to_json(self) -> dict[str, Any]:
        """Counts, and one failure of each kind and place."""
        shown: dict[tuple[str, str], dict[str, Any]] = {}
        for each in sorted(self.failures, key=lambda each: each.index):
            entry = {"index": each.index, "kind": each.kind, "detail": each.detail, "count": 0}
            shown.setdefault((each.kind, each.detail[:60]), entry)["count"] += 1
        return {
            "cases": self.counts.total(),
            "refused": self.counts["refused"],
            "accepted": self.counts["accepted"],
            "failed": sum(self.counts[kind] for kind in FAILURES),
            "failures": list(shown.values())[:100],
        }


def campaign(
    cases: Mapping[str, range],
    workers: int,
    limits: Limits | None = None,
    module: str = "tests.fuzz.readers",
    done: Callable[[str, Tally], None] | None = None,
) -> dict[str, Tally]:
    """Runs cases of several readers, given by their indices; calls `done` after the last one of each reader."""
    limits, tallies = limits or Limits(), {name: Tally() for name in cases}
    waiting = deque((name, index) for name, indices in cases.items() for index in indices)
    busy: dict[int, tuple[str, int, float, bool]] = {}  # by worker: a case, the end of its time, whether it is prepared
    ready: list[set[str]] = [set() for _ in range(workers)]

    def start(number: int, name: str, index: int) -> None:
        prepared = name in ready[number]
        pool.call(number, *(("run", name, index) if prepared else ("prepare", name)))
        busy[number] = name, index, monotonic() + (limits.wait if prepared else _START), prepared

    # One thread: workers are as many as there are cores. No GPU: its driver isn't what is looked at.
    environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    with tempfile.TemporaryDirectory(prefix="wlm-fuzz-") as root, patch.dict(os.environ, environment):
        pool = Processes(Alone, [(root, number, limits, module) for number in range(workers)])
        try:
            while waiting or busy:
                for number in set(range(workers)) - set(busy):
                    if waiting:
                        start(number, *waiting.popleft())
                answer = pool.wait(max(min(end for _, _, end, _ in busy.values()) - monotonic(), 0.0))
                if answer is None:
                    for number, (_, _, end, _) in busy.items():
                        if end <= monotonic():
                            pool.kill(number)
                    continue
                number, result = answer
                name, index, end, prepared = busy.pop(number)
                if isinstance(result, Lost) and prepared:
                    result = Outcome(index, *_reason(str(result), end <= monotonic(), limits))
                    ready[number].clear()
                    pool.renew(number)
                if isinstance(result, Exception):
                    raise RuntimeError(f"{name}: {result!r}") from result
                if prepared:
                    tallies[name].add(result)
                    if done is not None and tallies[name].counts.total() == len(cases[name]):
                        done(name, tallies[name])
                else:
                    ready[number].add(name)
                    start(number, name, index)
        finally:
            pool.close()
    return tallies


def _reason(text: str, late: bool, limits: Limits) -> tuple[str, str]:
    """Returns the outcome and the detail of a case that ended its process."""
    ended = re.match(r"it was ended by signal (\d+)", text)
    if ended is None:
        return "crash", text
    number = int(ended[1])
    if number == signal.SIGPROF:
        return "time", f"{limits.seconds:g} s of the processor"
    if number == signal.SIGKILL and late:
        return "time", f"no answer in {limits.wait:g} s"
    return "crash", f"{signal.Signals(number).name}: {text}"
