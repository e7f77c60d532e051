"""Checkpoints of a fit, from which it continues exactly after an interruption.

A fit works in batches (independent parts of the work). A checkpoint has the results of finished batches, and the exact
states of unfinished ones, such as parameters and optimizer state.

A checkpoint is one file beside the output, in the format of `wlm.formats.artifact`: it is written atomically, and every
byte is checked when it is read. It records the inputs of the fit and refuses to resume any other fit.
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
from wlm.formats.reading import system_errors

SUFFIX = ".partial"
EVERY = 30.0
"""Seconds between two saves of running work, and so the most that a killed process loses besides its current step."""

_SHARE = 0.05  # the largest fraction of the time spent on saving

_FINISHED, _RUNNING = "finished", "running"


class Pace:
    """Schedules saves: at a fixed interval, or less often where saving would take over a twentieth of the time."""

    def __init__(self, every: float) -> None:
        """Starts the clock; `every` is the number of seconds between two saves, 0 to save at each request."""
        self._every = self._wait = every
        self._last = time.monotonic()
        self._took = 0.0

    def due(self) -> bool:
        """Returns whether the time of the next save has come."""
        return time.monotonic() - self._last >= self._wait

    def affordable(self) -> bool:
        """Returns whether an extra save now would stay within the time budget, a twentieth of the time."""
        return not self._every or time.monotonic() - self._last >= self._took * (1.0 / _SHARE - 1.0)

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Measures how long the save inside the `with` block takes; the next interval starts at its end."""
        begin = time.monotonic()
        yield
        self._last = time.monotonic()
        self._took = self._last - begin
        if self._every:
            self._wait = max(self._every, self._took * (1.0 / _SHARE - 1.0))


class Checkpoint:
    """The state of one fit, in the file `OUTPUT.partial`; `resumed` tells whether it was read from there.

    Batches are numbered from 0, and several may be unfinished at a time. `split` is the number of workers for which the
    work was split into batches, which a resumed fit keeps; 0 if the fit has not set it.
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
            output: The output file of the fit; the checkpoint is written beside it.
            system: The system of the fit, for example "lightmap".
            fit: The inputs that determine the fit (hash of the data, settings, seed) as JSON values; messages use their
                keys as names. The version of this package is added.
            source: A hash of the input, without spaces.
            resume: Whether to continue from an existing file. Otherwise the file is ignored, and replaced at the first
                save.
            every: Seconds between two saves of a running batch; see `Pace`.

        Raises:
            WlmError: With `resume`: the file is damaged or belongs to another fit; the line names the difference.
            ValueError: `fit` contains NaN or infinity, which JSON cannot represent.
        """
        self.path = Path(f"{os.fspath(output)}{SUFFIX}")
        self.system = f"{system}-checkpoint"
        self.resumed, self.split = False, 0
        self._source = source
        # The round trip through JSON makes the key comparable with a stored one: JSON has no tuples.
        self._key: dict[str, Any] = json.loads(json.dumps({**fit, "wlm": __version__}, allow_nan=False))
        self._finished: dict[int, dict[str, np.ndarray]] = {}
        self._running: dict[int, dict[str, np.ndarray]] = {}
        self._unwritten = False
        self._pace = Pace(every)
        # The resumed run may end before its first save.
        sweep(Path(os.path.realpath(self.path)))
        if resume and self.path.exists():
            self._read()
            self.resumed = True

    def finished(self, number: int, table: Mapping[str, Part]) -> dict[str, np.ndarray] | None:
        """Returns the stored parts of a finished batch, checked against `table`, or None if it is not finished."""
        if (parts := self._finished.get(number)) is None:
            return None
        try:
            return check_parts(parts, table)
        except ValueError as error:
            raise WlmError(f"{self.path}: finished batch {number}: {error}") from error

    def running(self, number: int) -> dict[str, np.ndarray] | None:
        """Returns the arrays of a batch that was unfinished at the last save, by name, or None."""
        return self._running.get(number)

    def restore(self, number: int, load: Callable[[dict[str, np.ndarray]], None]) -> bool:
        """Restores the state of an unfinished batch, and returns whether the checkpoint has one. `load` restores a
        state; for an invalid one it raises ValueError before it changes anything."""
        if (state := self.running(number)) is None:
            return False
        try:
            load(state)
        except ValueError as error:
            raise self.wrong(number, error) from error
        return True

    def wrong(self, number: int, error: ValueError) -> WlmError:
        """Returns the error for an invalid state of batch `number`."""
        return WlmError(f"{self.path}: state of batch {number}: {error}")

    def due(self) -> bool:
        """Returns whether the time of the next save has come."""
        return self._pace.due()

    def save(self, states: Mapping[int, Mapping[str, np.ndarray]]) -> None:
        """Writes the states of unfinished batches, by number, in place of their older states."""
        self._running |= {number: dict(state) for number, state in states.items()}
        self._write()

    def add_finished(self, number: int, result: Mapping[str, np.ndarray]) -> None:
        """Adds the results of a finished batch, by name, and removes the state of its unfinished work. The file is
        written at once if that takes at most a twentieth of the time, otherwise at the next save."""
        self._finished[number] = dict(result)
        self._running.pop(number, None)
        self._unwritten = True
        if self._pace.affordable():
            self._write()

    def flush(self) -> None:
        """Writes finished batches that are not written yet."""
        if self._unwritten:
            self._write()

    def remove(self) -> None:
        """Removes the file, if it exists, once the output has been written."""
        with system_errors(f"{self.path}: cannot remove"):
            self.path.unlink(missing_ok=True)

    def _write(self) -> None:
        tensors = {
            f"{_FINISHED}.{number}.{key}": value
            for number, parts in self._finished.items()
            for key, value in parts.items()
        }
        for number, state in self._running.items():
            tensors |= {f"{_RUNNING}.{number}.{key}": value for key, value in state.items()}
        with self._pace.saving():
            write_artifact(self.path, self.system, {"fit": self._key, "split": self.split}, tensors, self._source)
        self._unwritten = False

    def _read(self) -> None:
        artifact = read_artifact(self.path, self.system)
        stored = artifact.settings.get("fit")
        if not isinstance(stored, dict):
            raise WlmError(f"{self.path}: the checkpoint is damaged: it does not state the inputs of its fit")
        if difference := _difference(stored, self._key):
            raise WlmError(
                f"{self.path}: the checkpoint is of another fit: {difference}; resume with the original inputs, or "
                "start again without --resume"
            )
        self.split = artifact.settings.get("split", 0)
        if type(self.split) is not int or self.split < 0:
            raise WlmError(f"{self.path}: split: expected an integer of at least 0, found {self.split!r:.60}")
        for name, value in artifact.tensors.items():
            state, number, key = (*name.split(".", 2), "", "")[:3]
            # At most nine digits: int() refuses very long numbers with its own message.
            if state not in (_FINISHED, _RUNNING) or not re.fullmatch("[0-9]{1,9}", number) or not key:
                raise WlmError(
                    f"{self.path}: part {one_line(repr(name), 60)}: is of neither a finished nor a running batch"
                )
            # A copy, since the next save replaces the file, and a mapped one would stay on the disk.
            kept = self._finished if state == _FINISHED else self._running
            kept.setdefault(int(number), {})[key] = np.array(value)


def _difference(stored: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    """Returns text that names the first difference between the inputs of two fits; empty if there is none."""
    for key, value in expected.items():
        before = stored.get(key)
        if isinstance(value, dict) and isinstance(before, dict):
            for name in sorted({*value, *before}):
                if value.get(name) != before.get(name):
                    return f"it was made with {key} {name}={before.get(name)}, not {value.get(name)}"
        elif value != before:
            return f"it was made with {key} {before}, not {value}"
    return ""
