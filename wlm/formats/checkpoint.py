"""Where a fit is kept while it runs: finished batches as they will be stored, and the running ones' exact states.

One file beside the output, an artifact of its own system, so that it is written whole or not at all and every byte
of it is checked when it is read. It names what the fit depends on, and goes on with no other fit.
"""

import json
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from wlm import __version__
from wlm.errors import WlmError, one_line
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.lock import sweep
from wlm.formats.parts import Part, check_parts

SUFFIX = ".partial"
EVERY = 30.0
"""Seconds between two saves of running work: what a killed process loses at most, beside the step that it was in."""

_SHARE = 0.05  # of the time that saving may take

_FINISHED, _RUNNING = "finished", "running"


class Pace:
    """When running work is saved: every so many seconds, or so seldom that it takes a twentieth of the time."""

    def __init__(self, every: float) -> None:
        """Starts the clock.

        Args:
            every: Seconds from one save to the next; 0: always, whatever it takes.
        """
        self._every = self._wait = every
        self._last = time.monotonic()
        self._took = 0.0

    def due(self) -> bool:
        """Whether it is time for a save."""
        return time.monotonic() - self._last >= self._wait

    def affordable(self) -> bool:
        """Whether a save now keeps to its share of the time, before one is due."""
        return not self._every or time.monotonic() - self._last >= self._took * (1.0 / _SHARE - 1.0)

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Times a save, from whose end the wait for the next one counts."""
        begin = time.monotonic()
        yield
        self._last = time.monotonic()
        self._took = self._last - begin
        if self._every:
            self._wait = max(self._every, self._took * (1.0 / _SHARE - 1.0))


class Checkpoint:
    """The state of one fit, in the file `OUTPUT.partial`.

    Made for a system's fit, which asks it for what is done already and hands it what gets done. Batches are
    numbered from 0; several may be running. A fit of one batch calls it number 0.

    Attributes:
        path: The file.
        system: The artifact's system, "lightmap-checkpoint" for example.
        resumed: Whether anything was read from it.
    """

    def __init__(
        self,
        output: str | os.PathLike[str],
        system: str,
        fit: Mapping[str, Any],
        source: str,
        *,
        resume: bool = False,
        every: float = EVERY,
    ) -> None:
        """Opens the checkpoint of a fit.

        Args:
            output: The file that the fit is for; the checkpoint lies beside it.
            system: The system whose fit it is, "lightmap" for example.
            fit: What the fit depends on, each by the name that a message gives it: the input's hash, the settings,
                the seed. JSON values; the version of this package is added.
            source: A hash of the input, one ASCII word.
            resume: Whether to go on from the file, if there is one. Otherwise it is ignored, and replaced at the
                first save.
            every: Seconds between two saves of a running batch, as `Pace` has it.

        Raises:
            WlmError: With `resume`: the file is damaged, or of another fit; the line names what differs.
            ValueError: `fit` holds NaN or Inf, which JSON has not.
        """
        self.path = Path(f"{os.fspath(output)}{SUFFIX}")
        self.system = f"{system}-checkpoint"
        self.resumed = False
        self._source = source
        # Compared with what JSON gives back, which has no tuples.
        self._key: dict[str, Any] = json.loads(json.dumps({**fit, "wlm": __version__}, allow_nan=False))
        self._finished: dict[int, dict[str, np.ndarray]] = {}
        self._running: dict[int, dict[str, np.ndarray]] = {}
        self._unwritten = False
        self._pace = Pace(every)
        # The run that goes on may end before it saves anything.
        sweep(Path(os.path.realpath(self.path)))
        if resume and self.path.exists():
            self._read()
            self.resumed = True

    def finished(self, number: int, table: Mapping[str, Part]) -> dict[str, np.ndarray] | None:
        """The stored parts of a finished batch, or None if it isn't finished.

        Raises:
            WlmError: They are not what the table says.
        """
        if (parts := self._finished.get(number)) is None:
            return None
        try:
            return check_parts(parts, table)
        except ValueError as error:
            raise WlmError(f"{self.path}: finished batch {number}: {error}") from error

    def running(self, number: int) -> dict[str, np.ndarray] | None:
        """The state of a batch that was running when it was last saved, or None if it wasn't."""
        return self._running.get(number)

    def restore(self, number: int, load: Callable[[dict[str, np.ndarray]], None]) -> bool:
        """Hands the state of batch `number`, if it was running, to the fit.

        Args:
            number: The batch.
            load: Goes back to a state; checks it, and raises ValueError before anything is changed by a wrong one.

        Returns:
            Whether there was one.

        Raises:
            WlmError: The state is wrong.
        """
        if (state := self.running(number)) is None:
            return False
        try:
            load(state)
        except ValueError as error:
            raise self.wrong(number, error) from error
        return True

    def wrong(self, number: int, error: ValueError) -> WlmError:
        """The line that says that the state of batch `number` is wrong."""
        return WlmError(f"{self.path}: state of batch {number}: {error}")

    def due(self) -> bool:
        """Whether it is time to save what is running."""
        return self._pace.due()

    def save_running(self, number: int, state: Mapping[str, np.ndarray]) -> None:
        """Writes the state of a running batch, in place of an older one.

        Raises:
            WlmError: The file can't be written; what was there before stays.
        """
        self.save({number: state})

    def save(self, states: Mapping[int, Mapping[str, np.ndarray]]) -> None:
        """Writes the states of running batches by number, in place of older ones of these batches.

        Raises:
            WlmError: The file can't be written; what was there before stays.
        """
        self._running |= {number: dict(state) for number, state in states.items()}
        self._write()

    def add_finished(self, number: int, result: Mapping[str, np.ndarray]) -> None:
        """Keeps the parts of a finished batch; its running state is dropped.

        The whole file is written, at once where that takes a twentieth of the time at most, as it does unless batches
        come fast; otherwise at the next save.

        Raises:
            WlmError: The file can't be written; what was there before stays.
        """
        self._finished[number] = dict(result)
        self._running.pop(number, None)
        self._unwritten = True
        if self._pace.affordable():
            self._write()

    def flush(self) -> None:
        """Writes what has been kept and isn't written.

        Raises:
            WlmError: The file can't be written; what was there before stays.
        """
        if self._unwritten:
            self._write()

    def remove(self) -> None:
        """Removes the file, if there is one: the output has been written.

        Raises:
            WlmError: It can't be removed.
        """
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            raise WlmError(f"{self.path}: cannot remove: {error.strerror or error}") from error

    def _write(self) -> None:
        tensors = {
            f"{_FINISHED}.{number}.{key}": value
            for number, parts in self._finished.items()
            for key, value in parts.items()
        }
        for number, state in self._running.items():
            tensors |= {f"{_RUNNING}.{number}.{key}": value for key, value in state.items()}
        with self._pace.saving():
            write_artifact(self.path, self.system, {"fit": self._key}, tensors, self._source)
        self._unwritten = False

    def _read(self) -> None:
        artifact = read_artifact(self.path, self.system)
        stored = artifact.settings.get("fit")
        if not isinstance(stored, dict):
            raise WlmError(f"{self.path}: the checkpoint does not say which fit it is of")
        if difference := _difference(stored, self._key):
            raise WlmError(
                f"{self.path}: a checkpoint of another fit: {difference}; resume with what it was started with, or "
                "start anew without --resume"
            )
        for name, value in artifact.tensors.items():
            state, number, key = (*name.split(".", 2), "", "")[:3]
            # Nine digits: a longer number is no batch, and int() refuses very long ones in its own words.
            if state not in (_FINISHED, _RUNNING) or not re.fullmatch("[0-9]{1,9}", number) or not key:
                raise WlmError(
                    f"{self.path}: part {one_line(repr(name), 60)}: expected one of a finished or a running batch"
                )
            # A copy: the file is replaced at the next save, and a mapped one would stay on the disk.
            kept = self._finished if state == _FINISHED else self._running
            kept.setdefault(int(number), {})[key] = np.array(value)


def _difference(stored: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    """Names the first thing in which two fits differ; empty if they are one."""
    for key, value in expected.items():
        before = stored.get(key)
        if isinstance(value, dict) and isinstance(before, dict):
            for name in sorted({*value, *before}):
                if value.get(name) != before.get(name):
                    return f"it was made with {key} {name}={before.get(name)}, not {value.get(name)}"
        elif value != before:
            return f"it was made with {key} {before}, not {value}"
    return ""
