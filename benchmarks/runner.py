"""The base class of all benchmarks: reports progress, fits and stores models, times calls and makes result rows."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import wlm
from benchmarks.rows import Row
from benchmarks.timing import Timing, time_together
from wlm.errors import WlmError
from wlm.interop import StepGraph, check_device
from wlm.system import Model, load

Note = Callable[[str], None]
"""Called with a line before each part of the work."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A model that was fitted, written to a file and loaded again.

    Attributes:
        option: Name of the profile or setting, as the results table prints it.
        model: The model as loaded from the file.
        fitted: The model before it was written.
        bytes: Size of the file in bytes.
        fit_seconds, write_seconds: Wall-clock times of fitting and of writing.
    """

    option: str
    model: Any
    fitted: Any
    bytes: int
    fit_seconds: float
    write_seconds: float

    @property
    def seconds(self) -> float:
        """The time of fitting and writing together, in seconds."""
        return self.fit_seconds + self.write_seconds


class Bench:
    """A benchmark of one system on one device and one scene.

    Attributes:
        system, scene: System and scene that the rows state.
        device: "cpu" or "cuda:0".
        mode: Text for the notes of a row: how a call that `replay` returns runs on this device.
    """

    def __init__(
        self,
        system: str,
        device: str,
        progress: Note | None = None,
        *,
        scene: str = "",
        clock: str = "decode_ms",
        warmup: int | None = None,
        repeats: int | None = None,
        few: int = 1,
    ) -> None:
        """Checks that the device exists, and stores the settings of the benchmark.

        Args:
            system: System that the rows state.
            device: "cpu" or "cuda:0".
            progress: Called with each line of progress; None: no progress is reported.
            scene: Scene that the rows state; lines of progress begin with it.
            clock: Name of the figure that holds a measured time.
            warmup: Number of calls before the first timed call; None: 1 on the CPU, 5 on CUDA.
            repeats: Number of samples of each time; None: 5 on the CPU, where a sample is long, 30 on CUDA.
            few: Number of samples of calls that take long.

        Raises:
            WlmError: The device does not exist.
        """
        self.system, self.scene, self.device = system, scene, check_device(device)
        self._progress, self._clock = progress, clock
        slow = self.device == "cpu"
        self._warmup = warmup if warmup is not None else 1 if slow else 5
        self._repeats = repeats if repeats is not None else 5 if slow else 30
        self._few = few
        self.mode = "one thread" if slow else "replayed as a graph"

    def note(self, line: str) -> None:
        """Reports a line of progress that says which work comes next."""
        if self._progress is not None:
            self._progress(f"{self.scene}: {line}" if self.scene else line)

    def row(
        self,
        method: str,
        option: str = "",
        notes: str = "",
        *,
        scene: str | None = None,
        timing: Timing | None = None,
        calls: int = 1,
        **figures: float | None,
    ) -> Row:
        """Makes a row of results.

        Args:
            method, option, notes: As in `Row`.
            scene: Name of the scene; None: the scene of the benchmark.
            timing, calls: As for `Row.with_timing`.
            figures: Measured values, by the names of `benchmarks.figures`.
        """
        row = Row(self.system, self.scene if scene is None else scene, method, option, figures, notes)
        return row if timing is None else row.with_timing(timing, self._clock, calls)

    def missing_row(self, method: str, option: str, error: Exception) -> Row:
        """Makes a row without figures for a case that cannot be measured; the error becomes its note."""
        return self.row(method, option, f"not measured: {error}")

    def fit(self, option: str, compress: Callable[[], Model]) -> Fit:
        """Fits a model, saves it and loads it again.

        Args:
            option: Name of the profile or setting, as the results table prints it.
            compress: Function that fits the model; its kernels must be compiled already.
        """
        start = time.perf_counter()
        model = compress()
        fitted = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.wlm"
            writing = time.perf_counter()
            size = model.save(path)
            written = time.perf_counter()
            return Fit(option, load(path, model.SYSTEM), model, size, fitted - start, written - writing)

    def replay(self, call: Callable[[], object]) -> StepGraph:
        """Wraps a call so that on CUDA it is captured once and replayed as a CUDA graph; on a CPU it is just called."""
        return StepGraph(call, self.device, warmup=1)

    def time(self, calls: Mapping[Any, Callable[[], object]], *, few: bool = False) -> dict[Any, Timing]:
        """Times calls in turns and returns the `Timing` of each by its name; `few`: with fewer samples of each call."""
        warmup, repeats = (1, self._few) if few else (self._warmup, self._repeats)
        return time_together(calls, self.device, warmup, repeats)

    def time_rows(self, peers: Sequence[tuple[Row, Callable[[], object]]]) -> list[Row]:
        """Times the calls of several rows in turns, and returns the rows with their times."""
        self.note("timing the decoders, in turns")
        timings = self.time({index: call for index, (_, call) in enumerate(peers)})
        return [row.with_timing(timings[index], self._clock) for index, (row, _) in enumerate(peers)]


def expect_alone(option: str, others: Mapping[str, object]) -> None:
    """Raises a `WlmError` if an option was given together with others that have no meaning beside it.

    Args:
        option: Name of the option that was given.
        others: For each other option, by name, a value that is true if the option was given.
    """
    if any(others.values()):
        raise WlmError(f"{option}: cannot be combined with {' and '.join(others)}")


def check_only(only: Sequence[str], names: Sequence[str]) -> None:
    """Raises a `WlmError` if `--only` names a row that an ablation does not have.

    Args:
        only: The requested names.
        names: The names of all rows.
    """
    for name in only:
        if name not in names:
            raise WlmError(f"--only: expected one of {', '.join(names)}; found '{name}'")


def exact_errors(decoded: np.ndarray, exact: np.ndarray) -> dict[str, float]:
    """Compares a decode with the float64 decode of the same model.

    Rounding can move a point across the border of a tile or out of the reach of a Gaussian; the error of such a point
    is far above all others, so a percentile is returned too.

    Args:
        decoded: Decoded values of N points, [N, C].
        exact: Values of the same points decoded in float64, [N, C].

    Returns:
        The figures `max_error`, the largest error, and `error_999`, the 99.9th percentile of the points' errors.
    """
    error = np.abs(decoded - exact).max(1)
    return {"max_error": float(error.max()), "error_999": float(np.percentile(error, 99.9))}


def demo_data(name: str, option: str) -> Path:
    """Returns the path of a file or folder of demo data.

    Args:
        name: Path inside `demos/data`.
        option: The command line option with which a user can choose other data, for the error message.

    Raises:
        WlmError: The data are missing, because wlm does not run from a checkout of the repository.
    """
    path = Path(wlm.__file__).resolve().parents[1] / "demos" / "data" / name
    if not path.exists():
        raise WlmError(f"the demo data {name} exist only in a checkout of the repository: give {option}")
    return path
