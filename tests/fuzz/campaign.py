"""Many cases on worker processes that are started again after a crash, and the table of what came of them."""

import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count
from threading import local
from typing import Any, Self

from .limits import Limits
from .worker import FAILURES, ROOT, Outcome

_START = 600.0  # seconds in which a worker must have imported and compiled what a reader needs
_CHUNK = 500  # cases of a job


class Worker:
    """A process that runs cases, started when it is first needed and again after a case that ended it."""

    def __init__(self, limits: Limits | None = None, module: str = "tests.fuzz.readers", number: int = 0) -> None:
        """Takes the limits of a case, the module whose `READERS` are run, and a number among workers."""
        self.limits, self.module, self.number = limits or Limits(), module, number
        self._process: subprocess.Popen[bytes] | None = None
        self._folder: str | None = None
        self._pending, self._ended = b"", False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def run(self, reader: str, first: int, count: int) -> Iterator[Outcome]:
        """Runs the cases `first` to `first + count - 1` of a reader."""
        end = first + count
        while first < end:
            for outcome in self._job({"reader": reader, "first": first, "count": end - first}, first, end):
                yield outcome
                first = outcome.index + 1

    def _job(self, job: dict[str, Any], first: int, end: int) -> Iterator[Outcome]:
        """The outcomes of a job, the last of which may be that of a case that ended the process."""
        process = self._process or self._start()
        process.stdin.write(json.dumps(job).encode() + b"\n")
        process.stdin.flush()
        answer = self._answer(_START)
        if answer != "ready":
            reason = answer["error"] if isinstance(answer, dict) else "the worker did not start"
            self.close()
            raise RuntimeError(f"{job['reader']}: {reason}")
        for index in range(first, end):
            answer = self._answer(self.limits.wait)
            if isinstance(answer, dict):
                raise RuntimeError(f"{job['reader']}: case {index}: {answer['error']}")
            if answer is None:
                yield Outcome(index, *self._end())
                return
            yield Outcome(*answer)

    def _start(self) -> subprocess.Popen[bytes]:
        limits = self.limits
        words = [self.module, str(limits.seconds), str(limits.wait), str(limits.memory)]
        # One thread: workers are as many as there are cores. No GPU: its driver isn't what is looked at.
        self._folder = tempfile.mkdtemp(prefix="wlm-fuzz-")
        environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "TMPDIR": self._folder}
        cache = environment.get("WARP_CACHE_PATH", str(ROOT / ".cache" / "warp"))
        # Two that compile one kernel at once would race for its files.
        environment["WARP_CACHE_PATH"] = f"{cache}-{self.number}" if self.number else cache
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.worker", *words],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._pending, self._ended = b"", False
        return self._process

    def _answer(self, seconds: float) -> Any:
        """The next line; None where the process ended or said nothing in time."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while b"\n" not in self._pending:
                if not selector.select(seconds):
                    return None
                piece = os.read(self._process.stdout.fileno(), 1 << 16)
                if not piece:
                    self._ended = True
                    return None
                self._pending += piece
        line, _, self._pending = self._pending.partition(b"\n")
        return json.loads(line)

    def _end(self) -> tuple[str, str]:
        """Ends a process that gave no answer, and says why it didn't."""
        try:
            code = self._process.wait(10.0 if self._ended else 0.0)
        except subprocess.TimeoutExpired:
            code = None
        self.close()
        if code is None:
            return "time", f"no answer in {self.limits.wait:g} s"
        if code == -signal.SIGPROF:
            return "time", f"{self.limits.seconds:g} s of the processor"
        return "crash", signal.Signals(-code).name if code < 0 else f"exit {code}"


@dataclass
class Tally:
    """The outcomes of a reader's cases."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[Outcome] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        self.counts[outcome.kind] += 1
        if outcome.failed:
            self.failures.append(outcome)

    @property
    def failed(self) -> int:
        return sum(self.counts[kind] for kind in FAILURES)

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
            "failed": self.failed,
            "failures": list(shown.values())[:100],
        }


def campaign(
    counts: dict[str, int],
    workers: int,
    limits: Limits | None = None,
    done: Callable[[str, Tally], None] | None = None,
) -> dict[str, Tally]:
    """Runs cases of several readers."""
    own, all_workers, numbers = local(), [], count()

    def job(reader: str, begin: int, size: int) -> Sequence[Outcome]:
        if not hasattr(own, "worker"):
            own.worker = Worker(limits, number=next(numbers))
            all_workers.append(own.worker)
        return list(own.worker.run(reader, begin, size))

    tallies = {}
    with ThreadPoolExecutor(workers) as pool:
        try:
            futures = {
                reader: [
                    pool.submit(job, reader, begin, min(_CHUNK, cases - begin)) for begin in range(0, cases, _CHUNK)
                ]
                for reader, cases in counts.items()
            }
            for reader, pieces in futures.items():
                tallies[reader] = Tally()
                for piece in pieces:
                    for outcome in piece.result():
                        tallies[reader].add(outcome)
                if done is not None:
                    done(reader, tallies[reader])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            for worker in all_workers:
                worker.close()
    return tallies
