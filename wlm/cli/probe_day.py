"""Several hours of probes in one file: the options and the tables that only they need."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import escape, note, number, running, show, table, write_json
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.probe import DayModel, ProbeModel, ProbeSet, Report, Transform

Time = Annotated[
    float | None, typer.Option(metavar="HOUR", help="Of a file of several hours: when; between them light is mixed.")
]


def read_times(text: str) -> list[float]:
    """The hours of `--times`."""
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise WlmError(f"--times: expected hours as 9,12,21.5, got {text}") from None


def read_hours(
    paths: Sequence[Path], times: Sequence[float], key: str | None, convention: str | None
) -> "list[ProbeSet]":
    """Reads the hours of a set and notes what was repaired in them."""
    from wlm.probe.hours import load_hours

    sets = load_hours(paths, times, key=key, convention=convention)
    for time, probes in zip(times, sets, strict=True):
        for warning in probes.warnings:
            note(f"warning: {time:g} h: {warning}")
    return sets


def joined(sets: "Sequence[ProbeSet]", times: Sequence[float]) -> "ProbeSet":
    """The first hour under the name of all of them: what a checkpoint asks of its input."""
    from dataclasses import replace

    from wlm.probe.hours import joint_source

    return replace(sets[0], source=joint_source(sets, times))


def only_path(paths: Sequence[Path]) -> Path:
    """The one file of a single set."""
    if len(paths) > 1:
        raise WlmError(f"{paths[1]}: expected one file of probes, or --times with an hour for each")
    return paths[0]


def at_time(model: "ProbeModel | Transform", time: float | None) -> "ProbeModel | Transform":
    """A model at `--time`, which one of several hours must have and others can't."""
    from wlm.probe import DayModel

    if not isinstance(model, DayModel):
        if time is not None:
            raise WlmError(f"--time: expected a file of several hours, {model.name} has one")
        return model
    if time is None:
        if len(model.times) == 1:
            return model
        raise WlmError(f"{model.name}: expected --time, the file holds {_listed(model)}")
    return model.at(time)


def evaluate_hours(
    file: Path,
    model: "DayModel",
    sets: "Sequence[ProbeSet]",
    json_path: Path | None,
    hold_out: bool,
    device: str,
) -> None:
    """Scores all hours of a file."""
    from wlm.probe import evaluate_day
    from wlm.probe.hours import joint_source

    size = file.stat().st_size
    with running("evaluate") as progress:
        reports = evaluate_day(model, sets, device=device, progress=progress, file_bytes=size, hold_out=hold_out)
    if not is_source(model, joint_source(sets, model.times)):
        note(f"warning: {sets[0].name}: not what {file} was made of; another key, convention or file?")
    if json_path is not None:
        content: dict[str, Any] = {"name": model.name, "bytes": size, "times": list(model.times)}
        write_json(json_path, content | {"hours": [report.to_json() for report in reports]})
    for report in reports:
        for warning in report.warnings:
            note(f"warning: {warning}")
    _show(file, model, reports, size)


def is_source(model: "ProbeModel | Transform", source: str) -> bool:
    """Whether a model was made of an input of that hash, as far as the file tells."""
    return bool(model.source) and source.startswith(model.source)


def stored_time(model: "DayModel", time: float) -> None:
    """Checks that there is an input for a time."""
    if time not in model.times:
        raise WlmError(f"--time: expected one of the file's hours to compare with, {_listed(model)}, got {time:g}")


def _listed(model: "DayModel") -> str:
    return ", ".join(f"{time:g}" for time in model.times)


def _show(file: Path, model: "DayModel", reports: "Sequence[Report]", size: int) -> None:
    share = size / sum(report.probes * report.outputs * 4 for report in reports)
    title = f"{file}: {size:,} bytes, {share:.2%} of float32, {size * 8 / reports[0].probes / len(reports):.2f} bits"
    columns = ["hour", "PSNR dB", "live dB", "irradiance dB", "between dB", "noise dB"]
    held = reports[0].held_out is not None
    rows = table(f"{escape(title)} a probe and hour", [*columns, *(["held out dB", "lossless there"] if held else [])])
    for time, report in zip(model.times, reports, strict=True):
        figures = [report.psnr, report.psnr_live, report.irradiance_psnr, report.between_psnr, report.noise_psnr]
        if report.held_out is not None:
            figures += [report.held_out.psnr, report.held_out.kriging]
        rows.add_row(f"{time:g}", *(number(figure, ".2f") for figure in figures))
    show(rows)
