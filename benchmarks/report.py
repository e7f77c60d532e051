"""Writes results as Markdown: tables of rows, and pages of whole result files."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.figures import TABLES, Figure
from benchmarks.rows import MEAN, Row, Run, read_runs

_WIDTH = 140  # characters of a line that a screen shows
_SYSTEMS = ("scene", "lightmap", "atlas", "probe", "smoke", "kernels", "growth")


def pages(paths: Sequence[str | os.PathLike[str]], index: str | os.PathLike[str] = "results.md") -> dict[str, str]:
    """Makes pages of result files: one page for each system, and an index of them.

    Args:
        paths: Files that `write_json` wrote.
        index: Path of the index. The pages are in a folder beside it, named like the index without its suffix.

    Returns:
        The text of the index and of each page, by paths relative to the index's folder. A page shows the plots
        `images/bench-SYSTEM*.png` and, for each run, its date, machine, versions, command and tables.

    Raises:
        WlmError: A file is missing or is no result file.
    """
    index = Path(index)
    head = f"Made by `python -m benchmarks report {' '.join(map(str, paths))} -o {index}`; changes by hand are lost."
    files = {path: read_runs(path) for path in paths}
    contents, links = {}, []
    for system in _SYSTEMS:
        parts, machines = [], []
        for path, runs in files.items():
            measured = [run for run in runs if any(row.system.partition("-")[0] == system for row in run.rows)]
            if measured:
                environment = measured[0].environment
                machines.append(str(environment["device_name"] or environment["device"]))
                parts.append(f"## {machines[-1]}: `{Path(path).name}`\n")
                parts += [_section(run, path) for run in sorted(measured, key=_order)]
        if parts:
            pictures = sorted((index.parent / "images").glob(f"bench-{system}*.png"))
            plots = [f"![{picture.stem}](../images/{picture.name})\n" for picture in pictures]
            page = f"{index.stem}/{system}.md"
            contents[page] = "\n".join([f"# Results: {system}\n", f"{head}\n", *plots, *parts])
            links.append(f"- [{system}]({page}): {', '.join(machines)}")
    foot = "Each page has the commands that measure its runs again; `python -m benchmarks plot` draws the plots.\n"
    return {index.name: "\n".join(["# Results\n", f"{head}\n", *links, "", foot]), **contents}


def tables(rows: Sequence[Row]) -> str:
    """Writes rows as Markdown tables: one for each scene, and for smoke one for each method and scene.

    Args:
        rows: The results, in the order to print.

    Returns:
        The Markdown text, with a final newline; empty if there are no rows.
    """
    groups: dict[str, list[Row]] = {}
    for row in rows:
        title = f"{row.method}: {row.scene}" if row.system.startswith("smoke") else row.scene
        groups.setdefault(title, []).append(row)
    means_first = sorted(groups.items(), key=lambda group: not group[0].startswith(MEAN))
    return "\n".join(f"#### {title}\n\n{_group(group)}" for title, group in means_first)


def _group(rows: list[Row]) -> str:
    """Returns rows as one Markdown table, or as several narrower ones with numbered notes if one would be too wide."""
    labels = [[row.method, row.option] if len({row.method for row in rows}) > 1 else [row.option] for row in rows]
    figures = {name: figure for table in TABLES.values() for name, figure in table.items()}
    whole = _table(figures, "notes", rows, labels, [row.notes for row in rows])
    if max(map(len, whole)) <= _WIDTH:
        return "\n".join([*whole, ""])
    notes = list(dict.fromkeys(row.notes for row in rows if row.notes))
    numbers = [str(notes.index(row.notes) + 1) if row.notes else "" for row in rows]
    parts = []
    for title, table in TABLES.items():
        measured = [i for i, row in enumerate(rows) if not table.keys().isdisjoint(row.figures)]
        if measured:
            columns = ([values[i] for i in measured] for values in (rows, labels, numbers))
            parts += [f"{title}:\n", *_table(table, "note", *columns), ""]
    return "\n".join([*parts, *(f"{number}. {note}" for number, note in enumerate(notes, 1)), ""])


def _table(
    figures: Mapping[str, Figure], last: str, rows: Sequence[Row], labels: Sequence[list[str]], notes: Sequence[str]
) -> list[str]:
    """Returns the lines of a Markdown table, without columns in which no row has a value."""
    figures = {name: figure for name, figure in figures.items() if any(name in row.figures for row in rows)}
    heads = [""] * len(labels[0])
    lines = [[*heads, *(figure.heading for figure in figures.values())]]
    lines.append(["---"] * len(heads) + ["---:"] * len(figures))
    for row, label in zip(rows, labels, strict=True):
        cells = (figure.text(row[name]) if name in row.figures else "" for name, figure in figures.items())
        lines.append([*label, *cells])
    if any(notes):
        for line, cell in zip(lines, [last, "---", *notes], strict=True):
            line.append(" ".join(cell.split()).replace("|", "\\|"))
    return [f"| {' | '.join(line)} |" for line in lines]


def _section(run: Run, path: str | os.PathLike[str]) -> str:
    """Returns the Markdown section of a run: the command that repeats it, versions and machine, and its tables."""
    environment = run.environment
    cuda = f", CUDA {environment['cuda']}" if environment.get("cuda") else ""
    return (
        f"### {run.rows[0].system}, {environment['date'][:10]}\n\n"
        f"`{environment['command']} --json {path}`; {environment['threads']} threads, Python "
        f"{environment['python']}, Warp {environment['warp']}, torch {environment['torch']}{cuda}.\n\n"
    ) + tables(run.rows)


def _order(run: Run) -> tuple[str, list[str]]:
    """Returns a sort key made of system and scenes, so that a run measured again keeps its position on the page."""
    return run.rows[0].system, sorted({row.scene for row in run.rows})
