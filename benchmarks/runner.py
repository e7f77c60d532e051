"""The base of all benchmarks: it reports progress, fits and stores models, times calls in turns, and makes rows."""

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
    """A model that was fitted, written and read back.

    Attributes:
        option: The option of its row.
        model: The model as loaded from the file.
        fitted: The model before it was written.
        bytes: Size of the file.
        fit_seconds, write_seconds: Wall-clock times.
    """

    option: str
    model: Any
    fitted: Any
    bytes: int
    fit_seconds: float
    write_seconds: float

    @property
    def seconds(self) -> float:
        """Seconds of the fit and the writing."""
        return self.fit_seconds + self.write_seconds


class Bench:
    """A benchmark of one system on one device and one scene.

    Attributes:
        system, scene: System and scene of the rows.
        device: "cpu" or "cuda:0".
        mode: How a replayed call runs on this device, for the notes of a row.
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
        """Checks the device.

        Args:
            system: System of the rows.
            device: "cpu" or "cuda:0".
            progress: None for no lines of progress.
            scene: Scene of the rows; lines of progress begin with it.
            clock: Name of the figure of a timing.
            warmup: Calls before the first that is timed; None: 1 on the CPU, 5 on CUDA.
            repeats: Samples of each time; None: 5 on the CPU, where a sample is long, 30 on CUDA.
            few: Samples of long calls.

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
        """Reports what is done next."""
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
        """Makes a row.

        Args:
            method, option, notes: As in `Row`.
            scene: A scene in place of the scene of the benchmark.
            timing, calls: As for `Row.with_timing`.
            figures: Figures by name.
        """
        row = Row(self.system, self.scene if scene is None else scene, method, option, figures, notes)
        return row if timing is None else row.with_timing(timing, self._clock, calls)

    def missing_row(self, method: str, option: str, error: Exception) -> Row:
        """Makes the row of a case that cannot be measured: a package is not installed, or nothing fits the size."""
        return self.row(method, option, f"not measured: {error}")

    def fit(self, option: str, compress: Callable[[], Model]) -> Fit:
        """Fits a model, saves it and loads it again.

        Args:
            option: The option of its row.
            compress: Fits the model; its kernels must be compiled already.
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
        """Captures a call in a graph on CUDA, so that gaps between launches do not count."""
        return StepGraph(call, self.device, warmup=1)

    def time(self, calls: Mapping[Any, Callable[[], object]], *, few: bool = False) -> dict[Any, Timing]:
        """Times calls in turns."""
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
        option: The option that was given.
        others: Whether each of the others was given, by its name.
    """
    if any(others.values()):
        raise WlmError(f"{option}: expected without {' and '.join(others)}")


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

    Rounding can move a point across the border of a tile or of the support of a Gaussian; the error of such a point is
    far above all others.

    Args:
        decoded: [N, C].
        exact: float64 [N, C].

    Returns:
        The figures `max_error` and `error_999`, the error that 99.9% of the points stay within.
    """
    error = np.abs(decoded - exact).max(1)
    return {"max_error": float(error.max()), "error_999": float(np.percentile(error, 99.9))}


def demo_data(name: str, option: str) -> Path:
    """Finds data of the demos.

    Args:
        name: Its path in `demos/data`.
        option: The command line option that names other data.

    Raises:
        WlmError: The data are missing, because the package is not in a checkout.
    """
    path = Path(wlm.__file__).resolve().parents[1] / "demos" / "data" / name
    if not path.exists():
        raise WlmError(f"the demo data {name} exist only in a checkout: expected {option}")
    return path
