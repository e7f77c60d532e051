"""The rows of results that every benchmark reports, and the JSON files that store them.

A row has the figures of one method with one option on one scene. A result file has the runs on one
machine; each run measured one system on some scenes. Its JSON: ``{"format": "wlm-bench", "version": 3, "runs":
[{"environment": {...}, "rows": [{"system": ..., "figures": {"psnr": 45.98, ...}, "notes": "..."}, ...]}, ...]}``.
"""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from benchmarks.figures import FIGURES
from benchmarks.timing import Timing
from wlm import __version__
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.reading import read_json_file

MEAN = "mean over"
"""How the scene of a row begins that has means over several scenes."""

_FORMAT = "wlm-bench"
_VERSION = 3
_PACKAGES = {"numpy": "numpy", "torch": "torch", "warp": "warp-lang"}


@dataclass(frozen=True)
class Row:
    """A row of results: the measured figures of one method with one option on one scene.

    Attributes:
        system: `scene`, `lightmap`, `atlas`, `probe`, `smoke`, `smoke-network` or `ops`.
        scene: Name of the measured data.
        method: Name of what was measured, such as "ours" or a rival's name.
        option: Profile or setting that tells rows of one method apart; may be empty.
        figures: Measured values, by the names of `benchmarks.figures`. Values that are None, NaN or infinite are left
            out: they were not measured, or have no meaning.
        notes: Free text with further information for a reader of the table.
    """

    system: str
    scene: str
    method: str
    option: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    notes: str = ""

    def __post_init__(self) -> None:
        """Checks the names of the figures, and leaves out figures without a finite value.

        Raises:
            ValueError: A name is unknown.
        """
        for name in self.figures:
            if name not in FIGURES:
                raise ValueError(f"unknown measured quantity {name!r}: see FIGURES in benchmarks/figures.py")
        measured = {name: value for name, value in self.figures.items() if value is not None and math.isfinite(value)}
        # NumPy's numbers don't fit JSON.
        plain = {name: value if isinstance(value, int) else float(value) for name, value in measured.items()}
        object.__setattr__(self, "figures", plain)

    def __getitem__(self, name: str) -> float:
        """Returns the value of a figure; a `KeyError` if the row has no such figure."""
        return self.figures[name]

    def get(self, name: str) -> float | None:
        """Returns the value of a figure, or None if the row has no such figure."""
        return self.figures.get(name)

    def with_figures(self, **figures: float | None) -> Row:
        """Returns a copy of the row with further figures."""
        return replace(self, figures={**self.figures, **figures})

    def with_timing(self, timing: Timing, name: str = "decode_ms", calls: int = 1) -> Row:
        """Returns a copy with a median time, and its 10th and 90th percentiles if there are several samples.

        Args:
            timing: Times of a call.
            name: Name of the figure of the median.
            calls: Number of repetitions, such as steps, in one timed call; times are divided by it.
        """
        spread = (timing.p90_ms - timing.p10_ms) / calls if timing.n > 1 else None
        return self.with_figures(**{name: timing.median_ms / calls, f"{name}_spread": spread})


@dataclass(frozen=True)
class Run:
    """Rows of results that one command measured together.

    Attributes:
        environment: Machine, versions and command, as `describe_environment` returns them.
        rows: The results.
    """

    environment: dict[str, object]
    rows: list[Row]


def describe_environment(device: str, command: str) -> dict[str, object]:
    """Describes the machine and the software on which measured figures depend.

    Args:
        device: "cpu" or "cuda:0".
        command: The command line that measures the same rows again.

    Returns:
        Values for JSON: `date` (UTC), `command`, `device`, `device_name`, versions of `python`, `numpy`,
        `torch`, `warp`, `wlm` and, on CUDA, `cuda`; `threads` (torch's) and `omp_num_threads` (the
        variable, or null).

    Raises:
        WlmError: No such device.
    """
    import torch

    from wlm import interop

    device = interop.check_device(device)
    cuda = {"cuda": torch.version.cuda} if device != "cpu" else {}
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "device": device,
        "device_name": torch.cuda.get_device_name(device) if cuda else _cpu_name(),
        "python": platform.python_version(),
        "wlm": __version__,
        **{key: metadata.version(name) for key, name in _PACKAGES.items()},
        "threads": torch.get_num_threads(),
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS"),
        **cuda,
    }


def write_json(
    path: str | Path, rows: Sequence[Row], environment: Mapping[str, object], *, partial: bool = False
) -> None:
    """Writes a run to a result file, atomically: a reader sees the old file or the whole new one.

    The new rows replace all rows of the same system and scene in the file; its other rows stay.

    Args:
        path: File to write; its folder must exist.
        rows: The results.
        environment: Machine, versions and command, as `describe_environment` returns them.
        partial: Whether to replace only rows that also have the same method and option.

    Raises:
        WlmError: The environment does not fit JSON, the file can't be written, or exists and is no result file.
    """
    path = Path(path)

    def key(row: Row) -> tuple[str, ...]:
        return (row.system, row.scene, row.method, row.option) if partial else (row.system, row.scene)

    measured = set(map(key, rows))
    runs = []
    for run in read_runs(path) if path.exists() else []:
        others = [row for row in run.rows if key(row) not in measured]
        if others:
            runs.append(Run(run.environment, others))
    runs.append(Run(dict(environment), list(rows)))
    document = {"format": _FORMAT, "version": _VERSION, "runs": [asdict(run) for run in runs]}
    try:
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise WlmError(f"{path}: the environment does not fit JSON: {error}") from error
    atomic_write(path, text.encode())


def read_runs(path: str | Path) -> list[Run]:
    """Reads a result file.

    Args:
        path: File that `write_json` wrote.

    Returns:
        The runs of the file, from the oldest to the newest; at least one.

    Raises:
        WlmError: The file can't be read, is no result file of this version, or a row has an unknown, missing or
            mistyped field or figure; the message names it.
    """
    document = read_json_file(path, "the results")
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise WlmError(f"{path}: not a result file, expected format {_FORMAT!r}")
    if document.get("version") != _VERSION:
        raise WlmError(
            f"{path}: version: expected {_VERSION}, got {document.get('version')!r}: "
            "files of another version of wlm have to be measured again"
        )
    runs = document.get("runs")
    if not isinstance(runs, list) or not runs:
        raise WlmError(f"{path}: expected a list 'runs' of at least one run")
    return [_read_run(run, f"{path}: run {number}") for number, run in enumerate(runs)]


def read_json(path: str | Path) -> tuple[list[Row], dict[str, object]]:
    """Reads the rows of all runs of a result file, and the environment of the newest.

    Raises:
        WlmError: As `read_runs`.
    """
    runs = read_runs(path)
    return [row for run in runs for row in run.rows], runs[-1].environment


def _read_run(run: object, where: str) -> Run:
    rows, environment = (run.get("rows"), run.get("environment")) if isinstance(run, dict) else (None, None)
    if not isinstance(rows, list) or not isinstance(environment, dict):
        raise WlmError(f"{where}: expected a list 'rows' and an object 'environment'")
    return Run(environment, [_read_row(values, f"{where}: row {index}") for index, values in enumerate(rows)])


def _read_row(values: object, where: str) -> Row:
    if not isinstance(values, dict):
        raise WlmError(f"{where}: expected an object")
    for name in values:
        if name not in Row.__dataclass_fields__:
            raise WlmError(f"{where}: unknown field {name!r}")
    for name in Row.__dataclass_fields__:
        value, kind = values.get(name), dict if name == "figures" else str
        if not isinstance(value, kind):
            raise WlmError(f"{where}: field {name!r}: expected {kind.__name__}, got {value!r}")
    for name, value in values["figures"].items():
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise WlmError(f"{where}: measured quantity {name!r}: expected a number, got {value!r}")
    try:
        return Row(**values)
    except (ValueError, OverflowError) as error:
        raise WlmError(f"{where}: {error}") from error


def _cpu_name() -> str:
    # platform.processor() is empty or just the architecture on Linux.
    if sys.platform.startswith("linux"):
        try:
            lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        except OSError:
            lines = []
        for line in lines:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
