"""Long commands in processes of their own, killed at random moments and run again until they end."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
EARLY = 0.15  # share of the kills before the work begins
LONGEST = 600.0  # seconds that a process may take


@dataclass(frozen=True)
class Command:
    """A command whose output has to outlast kills."""

    words: tuple[Any, ...]
    output: str
    earlier: Callable[[Path], None]
    content: Callable[[Path], dict[str, Any]]
    state: Callable[[Path, dict[str, Any], dict[str, Any]], None]
    partial: Callable[[Path], Path] | None


@dataclass
class Counts:
    """Kills of one command by signal, and runs that came to an end."""

    kills: dict[str, int] = field(default_factory=lambda: {"SIGKILL": 0, "SIGTERM": 0})
    runs: int = 0


def drive(command: Command, folder: Path, *, kills: int, seed: int) -> Counts:
    """Runs a command, kills it, runs it again until it ends, and all that until it was killed often enough."""
    chance, counts = random.Random(seed), Counts()
    (folder / "whole").mkdir()
    whole = folder / "whole" / command.output
    run = Run(command, whole, False)
    begin = run.wait_for_work()
    assert run.wait() == 0, run.errors()
    span = time.monotonic() - run.start - begin
    expected = command.content(whole)
    while sum(counts.kills.values()) < kills:
        place = folder / f"run{counts.runs}"
        place.mkdir()
        output = place / command.output
        command.earlier(output)
        earlier, resume = command.content(output), False
        while True:
            run = Run(command, output, resume)
            count = sum(counts.kills.values())
            if count < kills:
                number = chance.choice([signal.SIGKILL, signal.SIGTERM])
                if chance.random() < EARLY:
                    run.sleep(chance.uniform(0.0, begin))
                else:
                    run.wait_for_work()
                    run.sleep(chance.uniform(0.0, 0.7 * span))
                if run.process.poll() is None:
                    run.kill(number, counts)
            code = run.wait()
            # Ended by itself; or nothing was left to stop.
            if code == 0:
                break
            # Before Python has come to its handler the signal itself ends the process.
            assert code in (-run.number, 128 + run.number), (code, run.errors())
            assert "Traceback" not in run.errors(), run.errors()
            command.state(output, earlier, expected)
            resume = command.partial is not None and command.partial(output).exists()
        assert command.content(output) == expected
        left = set(os.listdir(place)) - set(os.listdir(whole.parent))
        assert not left, left
        counts.runs += 1
        shutil.rmtree(place)
    return counts


class Run:
    """A process that runs a command."""

    def __init__(self, command: Command, output: Path, resume: bool) -> None:
        self.command, self.output = command, output
        words = [*command.words, "-o", output, *["--resume"] * resume]
        self._errors = output.parent.parent / "stderr"
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        with open(self._errors, "wb") as errors:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "wlm", *map(str, words)],
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=environment,
            )
        self.start, self.number = time.monotonic(), 0

    def wait_for_work(self) -> float:
        """Waits for a sign of work; returns the seconds since the start."""
        while self.process.poll() is None and not self._works():
            time.sleep(0.002)
        return time.monotonic() - self.start

    def _works(self) -> bool:
        if self.command.partial is None:
            # An export has begun when it writes temporary files.
            return any(name.startswith(".wlm-") for name in os.listdir(self.output.parent))
        return any(line.split(":")[0] in _WORKS for line in self.errors().splitlines())

    def sleep(self, seconds: float) -> None:
        """Waits, but not past the end."""
        end = time.monotonic() + seconds
        while self.process.poll() is None and time.monotonic() < end:
            time.sleep(0.002)

    def kill(self, number: int, counts: Counts) -> None:
        """Sends a signal, and counts it if the process is stopped by it."""
        self.number = number
        self.process.send_signal(number)
        if self.wait() != 0:
            counts.kills[signal.Signals(number).name] += 1

    def wait(self) -> int:
        return self.process.wait(LONGEST)

    def errors(self) -> str:
        return self._errors.read_text(encoding="utf-8")


_WORKS = ("fit", "train", "simulate", "compress", "six", "guide")  # the first word of a report


def file_bytes(path: Path) -> dict[str, Any]:
    """The bytes of a file, or of each file in a folder."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return {file.name: file.read_bytes() for file in files}
