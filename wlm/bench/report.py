"""Benchmark files as one page of tables."""

import os
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from wlm.bench.runner import Row, Run, read_runs, table

__all__ = ["figures", "report", "tables"]

_SMOKE = ("smoke", "smoke-network")
# Field, heading and format of what smoke's tables have besides the figures of their own.
_SMOKE_COLUMNS = (
    ("decode_ms", "ms", ".3g"),
    ("decode_ms_spread", "p90−p10 ms", ".2g"),
    ("psnr", "PSNR dB", ".2f"),
    ("max_error", "largest error", ".2g"),
)


def report(paths: Sequence[str | os.PathLike[str]]) -> str:
    """Makes a Markdown page of benchmark files, a section each; of a file with several runs, a part each.

    Args:
        paths: Files that ``write_json`` wrote.

    Returns:
        The page: where and with what each run was measured, the command that measures it again, and its rows.

    Raises:
        WlmError: A file is missing or is no benchmark.
    """
    parts = ["# Results\n", "Made from the files under `benchmarks/` by `wlm bench report`.\n"]
    for path in paths:
        # By name, so that a part stays in its place when it is measured again.
        runs = sorted(read_runs(path), key=lambda run: (_systems(run), _scenes(run)))
        first = runs[0].environment
        parts.append(f"## {first['device_name'] or first['device']}: `{Path(path).name}`\n")
        for run in runs:
            environment = run.environment
            if len(runs) > 1:
                parts.append(f"### {', '.join(_systems(run))}: {', '.join(_scenes(run))}\n")
            cuda = f", CUDA {environment['cuda']}" if environment.get("cuda") else ""
            parts.append(
                f"`{environment['command']}`, {environment['date'][:10]}; {environment['threads']} threads, Python "
                f"{environment['python']}, Warp {environment['warp']}, torch {environment['torch']}{cuda}.\n"
            )
            parts.append(tables(run.rows))
    return "\n".join(parts)


def figures(row: Row) -> dict[str, str]:
    """What a row's notes have as "title: figure", by title; the parts of notes are parted by semicolons."""
    return dict(part.split(": ", 1) for part in row.notes.split("; ") if ": " in part)


def tables(rows: Sequence[Row]) -> str:
    """Rows as Markdown: one table, but of the smoke systems, whose methods have columns of their own, one a method.

    Args:
        rows: The results, in the order to print.

    Returns:
        Lines with a final newline; empty for no rows.
    """
    others = [row for row in rows if row.system not in _SMOKE]
    parts = [table(others)] if others else []
    smoke = [row for row in rows if row.system in _SMOKE]
    for (method, scene), group in groupby(smoke, key=lambda row: (row.method, row.scene)):
        parts.append(f"#### {method}: {scene}\n")
        parts.append(_smoke_table(list(group)))
    return "\n".join(parts)


def _smoke_table(rows: list[Row]) -> str:
    lines = []
    for row in rows:
        cells = {"": row.option} | figures(row)
        for field, heading, form in _SMOKE_COLUMNS:
            if (value := getattr(row, field)) is not None:
                cells[heading] = format(value, form)
        if notes := "; ".join(part for part in row.notes.split("; ") if ": " not in part):
            cells["notes"] = notes
        lines.append(cells)
    titles = list(dict.fromkeys(title for cells in lines for title in cells if title != "notes"))
    if any("notes" in cells for cells in lines):
        titles.append("notes")
    made = ["| " + " | ".join(titles) + " |"]
    made.append("|" + "|".join("---" if title in ("", "notes") else "---:" for title in titles) + "|")
    made += ["| " + " | ".join(cells.get(title, "") for title in titles) + " |" for cells in lines]
    return "\n".join(made) + "\n"


def _scenes(run: Run) -> list[str]:
    return sorted({row.scene for row in run.rows})


def _systems(run: Run) -> list[str]:
    return sorted({row.system for row in run.rows})
