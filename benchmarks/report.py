"""Writes results as Markdown: tables of rows, and pages of whole result files."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.figures import FIGURES, TABLES, Figure
from benchmarks.rows import MEAN, Row, Run, read_runs

_WIDTH = 140  # characters of a line that a screen shows
_ROWS = 60  # of a page


@dataclass(frozen=True)
class _Shown:
    """A table of a page: rows of a scene that have the first of the figures.

    Attributes:
        scene: The rows' scene.
        figures: Names of the columns.
        which: Regular expression of method and option, with a space between them.
        last: Whether to show only the last row of each method.
        notes: Whether to show the rows' notes.
    """

    scene: str
    figures: str
    which: str = ".*"
    last: bool = False
    notes: bool = False


_QUALITY = "bytes bpp psnr seen between border view_psnr"
_PROBES = "share_of_float32 bytes psnr relative_error held_out_psnr volume_psnr view_psnr"
_ORDERS = "psnr psnr_min flip flicker time_ms"
_PAGES = {
    "scene": [_Shown("street", "frame_ms frame_ms_p95 frame_ms_max view_psnr view_flip memory")],
    "lightmap": [
        _Shown("city", _QUALITY),
        _Shown("livingroom", _QUALITY),
        _Shown("4096 x 4096 x 26 x 4", "frame_ms frame_ms_p95 frame_ms_max memory current"),
    ],
    "atlas": [
        _Shown(f"{MEAN} 18 lightmaps", "compression_ratio bpp psnr texel_psnr tone_psnr flip seam_ratio"),
        _Shown("city 256, 93 objects, 26 states", "compression_ratio psnr psnr_worst gain"),
    ],
    "probe": [
        _Shown("livingroom 12.00", _PROBES, "(?!ours, ).* (2%|5%|10%|standard)"),
        _Shown("city 12.00", _PROBES, "(?!ours, ).* (5%|standard)"),
        _Shown("1,000,000 random probes", "encode_seconds"),
        _Shown("1,000,000 random probes", "update_ms update_ms_p95 update_ms_max memory"),
    ],
    "smoke": [
        _Shown("jet-sphere", "time_ms"),
        _Shown("plumes, albedo 0.9", _ORDERS),
        _Shown("jet, albedo 1", _ORDERS),
        _Shown("unseen smoke, 400³, 512² pixels", "time_ms psnr call_ms"),
        _Shown("plume, 128³, 256² pixels", "time_ms psnr"),
    ],
    "kernels": [
        _Shown("cuda", "time_ms size floor_ms of_floor slope launches", last=True),
        _Shown("cuda, profile", "share_of_time memory_busy l2_busy issue_busy warps_active", notes=True),
    ],
    "growth": [_Shown("city of lightmaps", "hours storage_busy cores_busy gpus_busy repeated")],
}


def pages(paths: Sequence[str | os.PathLike[str]], index: str | os.PathLike[str] = "results.md") -> dict[str, str]:
    """Makes pages of result files: one page for each system with its most telling rows, and an index of them.

    Args:
        paths: Files that `write_json` wrote. Of rows of one method and option, that with most figures is shown.
        index: Path of the index. The pages are in a folder beside it, named like the index without its suffix.

    Returns:
        The text of the index and of each page, by paths relative to the index's folder. A page shows the plots
        `images/bench-SYSTEM*.png`, tables, and the commands that measure their rows.

    Raises:
        WlmError: A file is missing or is no result file.
    """
    index = Path(index)
    head = f"`python -m benchmarks report {' '.join(map(str, paths))} -o {index}` makes this page."
    runs = [(Path(path), run) for path in paths for run in read_runs(path)]
    contents, links = {}, []
    for system, shown in _PAGES.items():
        measured = [(path, run, row) for path, run in runs for row in run.rows if _system(row) == system]
        parts, commands = [], {}
        for table in shown:
            parts += _page_table(table, measured, commands, _ROWS - sum(_cells(part) for part in parts))
        if not parts:
            continue
        pictures = sorted((index.parent / "images").glob(f"bench-{system}*.png"))
        plots = [f"![{picture.stem}](../images/{picture.name})\n" for picture in pictures]
        rest = f"This page has some of {len(measured)} rows. `python -m benchmarks report FILE` prints all rows.\n"
        runs_shown = ["## Measured by\n", *(f"- {command}" for command in commands), ""]
        page = f"{index.stem}/{system}.md"
        contents[page] = "\n".join([f"# Results: {system}\n", f"{head}\n", *plots, rest, *parts, *runs_shown])
        links.append(f"- [{system}]({page})")
    foot = "Each page has the commands that measure its rows again; `python -m benchmarks plots` draws the plots.\n"
    return {index.name: "\n".join(["# Results\n", f"{head}\n", *links, "", foot]), **contents}


def _system(row: Row) -> str:
    return row.system.partition("-")[0]


def _cells(line: str) -> bool:
    """Whether a line is a row of a table, and no head."""
    return line.startswith("| ") and not line.startswith(("| ---", "| method"))


def _known(names: Sequence[str], row: Row) -> int:
    return sum(name in row.figures for name in names)


def _page_table(
    shown: _Shown, measured: Sequence[tuple[Path, Run, Row]], commands: dict[str, None], most: int
) -> list[str]:
    """Returns the lines of a table of at most so many rows, with its heading; adds the commands that measured them."""
    names = shown.figures.split()
    rows: dict[tuple[str, ...], tuple[Path, Run, Row]] = {}
    for path, run, row in measured:
        if (
            row.scene == shown.scene
            and names[0] in row.figures
            and re.fullmatch(shown.which, f"{row.method} {row.option}")
        ):
            key = (row.method,) if shown.last else (row.method, row.option)
            if shown.last or key not in rows or _known(names, row) > _known(names, rows[key][2]):
                rows[key] = path, run, row
    methods = list(dict.fromkeys(row.method for _, _, row in rows.values()))
    chosen = sorted(rows.values(), key=lambda each: (methods.index(each[2].method), each[2][names[0]]))[: max(0, most)]
    if not chosen:
        return []
    for path, run, _ in chosen:
        about = run.environment
        machine = f"{about['device_name'] or about['device']}, {about['threads']} threads"
        versions = f"Python {about['python']}, Warp {about['warp']}, torch {about['torch']}"
        commands[f"`{about['command']} --json {path}`: {machine}, {versions}, {about['date'][:10]}"] = None
    labels = [[row.method, row.option, path.stem] for path, _, row in chosen]
    figures = {name: FIGURES[name] for name in names}
    notes = [row.notes if shown.notes else "" for _, _, row in chosen]
    lines = _table(figures, "", [row for _, _, row in chosen], labels, notes)
    lines[0] = lines[0].replace("|  |  |  |", "| method | option | file |", 1)
    return [f"## {shown.scene}\n", *lines, ""]


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
