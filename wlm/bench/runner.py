"""The rows that every system reports, how peers are run into them, and how they are kept.

A row is one method with one option on one scene: what it weighs, how long it takes, how wrong it is. A result
file is of one machine, and its runs are of different systems or scenes. It is JSON: `{"format": "wlm-bench",
"version": 2, "runs": [{"environment": {...}, "rows": [{...}, ...]}, ...]}`, with null for what was not measured. In
version 1 the environment and the rows of the one run stood in the place of the runs.
"""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from wlm import __version__
from wlm.bench.timing import Timing, time_together
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write

__all__ = ["Row", "Run", "describe_environment", "read_json", "read_runs", "run_peers", "table", "write_json"]

_FORMAT = "wlm-bench"
_VERSION = 2


@dataclass(frozen=True)
class Row:
    """One method with one option on one scene; None where something was not measured or has no meaning.

    Attributes:
        system: `lightmap`, `atlas`, `probe`, `smoke` or `smoke-network`.
        scene: Name of the data.
        method: What was run, ours or a baseline.
        option: Profile or setting that tells rows of one method apart; may be empty.
        bytes: Size on disk.
        bpp: Bits for each texel (or probe, or voxel) and lightmap.
        encode_seconds: Wall-clock time to fit and write.
        decode_ms: Median time to decode, in milliseconds.
        decode_ms_spread: 90th less 10th percentile of it, in milliseconds.
        psnr: Decibels.
        ssim: Mean SSIM.
        flip: Mean FLIP error.
        max_error: Largest absolute difference from the float64 path of the same model, in the output's units.
        notes: Anything that a reader of the table must know.
    """

    system: str
    scene: str
    method: str
    option: str = ""
    bytes: int | None = None
    bpp: float | None = None
    encode_seconds: float | None = None
    decode_ms: float | None = None
    decode_ms_spread: float | None = None
    psnr: float | None = None
    ssim: float | None = None
    flip: float | None = None
    max_error: float | None = None
    notes: str = ""

    def with_timing(self, timing: Timing) -> Row:
        """A copy with the decode time filled in."""
        return replace(self, decode_ms=timing.median_ms, decode_ms_spread=timing.p90_ms - timing.p10_ms)


@dataclass(frozen=True)
class Run:
    """Rows that were measured together.

    Attributes:
        environment: As `describe_environment` gives it.
        rows: The results.
    """

    environment: dict[str, object]
    rows: list[Row]


def run_peers(
    peers: Sequence[tuple[Row, Callable[[], object]]], device: str = "cpu", warmup: int = 5, repeats: int = 30
) -> list[Row]:
    """Time the decoders of several rows in one run, in turns, and fill in their times.

    Args:
        peers: Rows without a decode time, each with the function that decodes it.
        device: `"cpu"` or `"cuda:0"`, where all of them run.
        warmup: Calls of each before the first that is timed, at least 1.
        repeats: Samples of each, at least 1.

    Returns:
        The rows in their order, with `decode_ms` and `decode_ms_spread`.

    Raises:
        WlmError: As `time_together`.
    """
    calls = {str(index): call for index, (_, call) in enumerate(peers)}
    timings = time_together(calls, device, warmup, repeats)
    return [row.with_timing(timings[str(index)]) for index, (row, _) in enumerate(peers)]


def describe_environment(device: str, command: str) -> dict[str, object]:
    """What a number depends on besides the code.

    Args:
        device: `"cpu"` or `"cuda:0"`.
        command: The command that made the rows, as a reader would repeat it.

    Returns:
        Values for JSON: `date` (UTC), `command`, `device`, `device_name`, versions of `python`, `numpy`,
        `torch`, `warp`, `wlm` and, on CUDA, `cuda`; `threads` (torch's) and `omp_num_threads` (the variable,
        or null).

    Raises:
        WlmError: No such device.
    """
    import torch

    from wlm import interop

    device = interop.check_device(device)
    versions = {key: metadata.version(name) for key, name in _PACKAGES.items()}
    result: dict[str, object] = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "device": device,
        "device_name": _cpu_name(),
        "python": platform.python_version(),
        "wlm": __version__,
        **versions,
        "threads": torch.get_num_threads(),
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS"),
    }
    if device != "cpu":
        result["device_name"] = torch.cuda.get_device_name(device)
        result["cuda"] = torch.version.cuda
    return result


_PACKAGES = {"numpy": "numpy", "torch": "torch", "warp": "warp-lang"}


def write_json(path: str | Path, rows: Sequence[Row], environment: Mapping[str, object]) -> None:
    """Write a run to a result file, atomically: a reader sees the old file or the whole new one.

    What the file holds of other systems and scenes is kept; what it holds of a system's scene is replaced.

    Args:
        path: File to write; its folder must exist.
        rows: The results. NaN is written as null.
        environment: As `describe_environment` gives it.

    Raises:
        WlmError: A number is infinite, the environment does not fit JSON, the file can't be written, or what is
            there is no result file.
    """
    path = Path(path)
    new = Run(dict(environment), list(rows))
    measured = {(row.system, row.scene) for row in rows}
    kept = []
    for run in read_runs(path) if path.exists() else []:
        others = [row for row in run.rows if (row.system, row.scene) not in measured]
        if others:
            kept.append(Run(run.environment, others))
    document = {
        "format": _FORMAT,
        "version": _VERSION,
        "runs": [
            {"environment": run.environment, "rows": [_row_values(row) for row in run.rows]} for run in [*kept, new]
        ],
    }
    try:
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise WlmError(f"{path}: the environment does not fit JSON: {error}") from error
    atomic_write(path, text.encode())


def read_runs(path: str | Path) -> list[Run]:
    """Read a result file.

    Args:
        path: File that `write_json` wrote, in this version or the one before.

    Returns:
        Its runs, from the oldest; at least one.

    Raises:
        WlmError: The file can't be read, is no result file of these versions, or a row has an unknown, missing
            or mistyped field; the message names it.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WlmError(f"{path}: can't read the results: {error}") from error
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise WlmError(f"{path}: not a result file, expected format {_FORMAT!r}")
    version = document.get("version")
    if version not in (1, _VERSION):
        raise WlmError(f"{path}: expected version 1 or {_VERSION}, got {version!r}")
    runs = [document] if version == 1 else document.get("runs")
    if not isinstance(runs, list) or not runs:
        raise WlmError(f"{path}: expected a list 'runs' of at least one run")
    result = []
    for number, run in enumerate(runs):
        where = f"{path}: " + (f"run {number}: " if len(runs) > 1 else "")
        rows, environment = (run.get("rows"), run.get("environment")) if isinstance(run, dict) else (None, None)
        if not isinstance(rows, list) or not isinstance(environment, dict):
            raise WlmError(f"{where}expected a list 'rows' and an object 'environment'")
        result.append(Run(environment, [_row_from(values, f"{where}row {index}") for index, values in enumerate(rows)]))
    return result


def read_json(path: str | Path) -> tuple[list[Row], dict[str, object]]:
    """Read the rows of all runs of a result file, and the environment of the newest.

    Args:
        path: As for `read_runs`.

    Raises:
        WlmError: As `read_runs`.
    """
    runs = read_runs(path)
    return [row for run in runs for row in run.rows], runs[-1].environment


def table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table, without the columns that no row fills.

    Args:
        rows: The results, in the order to print.

    Returns:
        Lines with a final newline; empty for no rows.
    """
    if not rows:
        return ""
    columns = [column for column in _COLUMNS if any(_known(getattr(row, column[0])) for row in rows)]
    lines = [
        "| " + " | ".join(title for _, title, _ in columns) + " |",
        "|" + "|".join("---" if form is None else "---:" for _, _, form in columns) + "|",
    ]
    for row in rows:
        cells = (_cell(getattr(row, name), form) for name, _, form in columns)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


# Field, heading, and the number's format (None for text).
_COLUMNS: tuple[tuple[str, str, str | None], ...] = (
    ("system", "system", None),
    ("scene", "scene", None),
    ("method", "method", None),
    ("option", "option", None),
    ("bytes", "bytes", ",d"),
    ("bpp", "bpp", ".3f"),
    ("encode_seconds", "encode s", ".3g"),
    ("decode_ms", "decode ms", ".3g"),
    ("decode_ms_spread", "p90−p10 ms", ".2g"),
    ("psnr", "PSNR dB", ".2f"),
    ("ssim", "SSIM", ".4f"),
    ("flip", "FLIP", ".4f"),
    ("max_error", "max error", ".2g"),
    ("notes", "notes", None),
)


def _known(value: object) -> bool:
    return value is not None and value != "" and not (isinstance(value, float) and math.isnan(value))


def _cell(value: object, form: str | None) -> str:
    if not _known(value):
        return ""
    if form is None:
        return " ".join(str(value).split()).replace("|", "\\|")
    return format(value, form)


def _row_values(row: Row) -> dict[str, object]:
    values = asdict(row)
    for name, value in values.items():
        if isinstance(value, float) and not math.isfinite(value):
            if math.isinf(value):
                raise WlmError(f"bench: {row.method} on {row.scene}: {name} is infinite")
            values[name] = None
    return values


def _row_from(values: object, where: str) -> Row:
    if not isinstance(values, dict):
        raise WlmError(f"{where}: expected an object")
    known = {field.name: field for field in fields(Row)}
    for name, value in values.items():
        if name not in known:
            raise WlmError(f"{where}: unknown field {name!r}")
        kind = known[name].type
        if kind == "str":
            fits = isinstance(value, str)
        else:
            number = int if kind == "int | None" else (int, float)
            fits = value is None or (isinstance(value, number) and not isinstance(value, bool))
        if not fits:
            raise WlmError(f"{where}: field {name!r}: expected {kind}, got {value!r}")
    missing = [name for name in ("system", "scene", "method") if name not in values]
    if missing:
        raise WlmError(f"{where}: field {missing[0]!r} is missing")
    return Row(**values)


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
