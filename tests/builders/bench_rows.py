"""Checks of the rows of any benchmark: a result file, tables, a plot, and the command that measures them."""

from pathlib import Path

from typer.testing import CliRunner

from benchmarks import plot, read_json, tables, write_json
from benchmarks.app import app

ENVIRONMENT = {
    "device": "cpu",
    "device_name": "a CPU",
    "command": "python -m benchmarks",
    "date": "2026-01-02T03:04:05",
    "threads": 1,
    "python": "3",
    "warp": "1",
    "torch": "2",
}


def by_option(rows, method: str) -> dict:
    """The rows of a method."""
    return {row.option: row for row in rows if row.method == method}


def keys(rows) -> list[tuple[str, str]]:
    """Methods and options, in their order."""
    return [(row.method, row.option) for row in rows]


def check_outputs(rows, folder: Path, panels, plotted=None) -> None:
    """Writes rows to a file and reads them back, prints each in a table, and draws them."""
    write_json(folder / "rows.json", rows, ENVIRONMENT)
    assert read_json(folder / "rows.json") == (list(rows), ENVIRONMENT)
    lines = tables(rows).splitlines()
    for row in rows:
        label = f"| {row.method} | {row.option} |", f"| {row.option} |"
        assert not row.figures or any(line.startswith(label) for line in lines), label
    plot(rows if plotted is None else plotted, folder / "rows.png", panels)
    assert (folder / "rows.png").stat().st_size > 10_000


def check_command(monkeypatch, rows, words: list, folder: Path) -> tuple[str, dict]:
    """Runs `python -m benchmarks` with a `run` that gives these rows; checks what it writes and prints."""
    calls = []

    def run(**options):
        calls.append(options)
        if "done" in options:
            options["done"](rows)
        return rows

    monkeypatch.setattr(f"benchmarks.{words[0].replace('-', '_')}.run", run)
    path = folder / "command.json"
    result = CliRunner().invoke(app, [*map(str, words), "--json", str(path)])
    assert result.exit_code == 0, result.output
    written, environment = read_json(path)
    assert written == list(rows) and f"| {rows[0].option} |" in result.output
    return environment["command"], calls[-1]
