"""What the commands share: tables, notes, and progress."""

import functools
import json
import os
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

from wlm.cli.signals import deferred_interrupt
from wlm.errors import WlmError, printable
from wlm.formats.lock import locked

if TYPE_CHECKING:
    from wlm.formats.checkpoint import Checkpoint
    from wlm.system import OnProgress, Progress

__all__ = [
    "check_output",
    "escape",
    "exclusive",
    "note",
    "note_start",
    "number",
    "progress_bar",
    "quiet_warp",
    "running",
    "show",
    "show_figures",
    "show_json",
    "show_text",
    "table",
    "write_json",
]

_PLAIN_WIDTH = 10_000  # characters: no cell of a table that goes to a file or a pipe wraps, names of files stay whole
_PLAIN_REPORTS = 10  # lines of progress that a log gets in all
_STDERR = 2
_MISSING_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def _console(stderr: bool = False) -> Console:
    # Made at each use: it binds the stream that is there now, which a test or a caller may have replaced.
    console = Console(stderr=stderr, highlight=False)
    return console if console.is_terminal else Console(stderr=stderr, highlight=False, width=_PLAIN_WIDTH)


class _Table(Table):
    """A table whose cells can't obey a terminal: names come from files."""

    def add_row(self, *cells: Any, **options: Any) -> None:
        super().add_row(*(printable(cell) if isinstance(cell, str) else cell for cell in cells), **options)


def table(title: str, columns: Sequence[str], text: Sequence[str] = ()) -> Table:
    """Starts a table: the first column and those named in `text` hold text, the others numbers."""
    rows = _Table(title=title, header_style="bold")
    for i, heading in enumerate(columns):
        rows.add_column(heading, justify="right" if i and heading not in text else "left", overflow="fold")
    return rows


def show(content: Table) -> None:
    """Prints a table to stdout, its title in a line above it, which wraps at no width but the terminal's."""
    # Rich would wrap it at the width of the columns.
    title, content.title = content.title, None
    _console().print(printable(str(title)), style="bold", markup=False, soft_wrap=True)
    _console().print(content)


def show_figures(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str | float]], text: Sequence[str] = ()
) -> None:
    """Prints a table of words and figures, which are whole numbers in full, others to four digits.

    Args:
        title, columns, text: As for `table`.
        rows: A cell for each column.
    """
    content = table(title, columns, text)
    for row in rows:
        content.add_row(*(_figure(value) for value in row))
    show(content)


def _figure(value: str | float) -> str:
    if isinstance(value, str):
        return value
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def note(text: str) -> None:
    """Prints a line to stderr, as it is: paths may hold what rich takes for markup."""
    _console(stderr=True).print(printable(text), markup=False, soft_wrap=True)


def note_start(checkpoint: "Checkpoint", resume: bool, start: str) -> None:
    """Says where work begins, at `start`, that was to be resumed and of which nothing is kept."""
    if resume and not checkpoint.resumed:
        note(f"{checkpoint.path}: there is nothing to resume; starting {start}")


def show_text(text: str) -> None:
    """Prints lines to stdout as they are, uncoloured, but for what a terminal would obey, and ends the last."""
    sys.stdout.write("\n".join(map(printable, text.removesuffix("\n").split("\n"))) + "\n")


def number(value: float | None, form: str) -> str:
    """Formats a number; a dash where there is none (None or NaN)."""
    return "–" if value is None or value != value else format(value, form)


def show_json(value: Any) -> None:
    """Prints JSON to stdout, unwrapped and uncoloured."""
    _console().out(json.dumps(value, indent=1, allow_nan=False), highlight=False)


def write_json(path: Path, value: Any) -> None:
    """Writes JSON to a file, whole or not at all.

    Raises:
        WlmError: The file can't be written.
    """
    from wlm.formats.atomic import atomic_write

    atomic_write(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def check_output(path: Path, *suffixes: str) -> None:
    """Checks, before long work, that a file can be written at its end.

    Args:
        path: The file.
        suffixes: What its name may end in: a slip between input and output must not replace an input.

    Raises:
        WlmError: The name ends otherwise, the folder is missing or read-only, or something else is in its place.
    """
    if path.suffix.lower() not in suffixes:
        raise WlmError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
    folder = path.resolve().parent
    if not folder.is_dir():
        raise WlmError(f"{path}: cannot write: the folder {folder} does not exist")
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        raise WlmError(f"{path}: cannot write: it exists and is not a regular file")
    if not os.access(folder, os.W_OK):
        raise WlmError(f"{path}: cannot write: the folder {folder} is read-only")


def exclusive(command: Callable[..., None]) -> Callable[..., None]:
    """Keeps other processes from writing a command's `output` while it runs, and removes what killed ones left of it.

    Raises:
        WlmError: Another process is writing it.
    """

    @functools.wraps(command)
    def run(**values: Any) -> None:
        with locked(values["output"]):
            command(**values)

    return run


def quiet_warp() -> None:
    """Starts Warp without its banner, its notes on compiling, and its line on a missing GPU driver.

    That the driver is missing is no news to who computes on the CPU, and `--device cuda` has an error of its own.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    # Its C library writes to the process's stderr, past any setting.
    with tempfile.TemporaryFile() as sink:
        sys.stderr.flush()
        saved = os.dup(_STDERR)
        os.dup2(sink.fileno(), _STDERR)
        try:
            wp.init()
        finally:
            os.dup2(saved, _STDERR)
            sink.seek(0)
            for line in sink.read().splitlines(keepends=True):
                if _MISSING_DRIVER not in line:
                    os.write(saved, line)
            os.close(saved)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int, str], None]]:
    """Shows progress on stderr: a bar on a terminal, else a plain line about every tenth of the work.

    Of work without a known number of steps there is one line, at its beginning.

    Args:
        what: The work, in a word or two.

    Yields:
        A function to call with what is done, what there is in all, and a text to show with it.
    """
    console = _console(stderr=True)
    start = time.perf_counter()
    if not console.is_terminal:
        reported = 0

        def line(done: int, total: int, text: str) -> None:
            nonlocal reported
            if not done and not total:
                note(what)
            if (part := done * _PLAIN_REPORTS // max(total, 1)) > reported:
                reported = part
                count = f"{done} of {total}" if total else f"{done}"
                note(", ".join(filter(None, (f"{what}: {count}", text, _left(start, done, total)))))

        yield line
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=None, note="")

        def update(done: int, total: int, text: str) -> None:
            fields = ", ".join(filter(None, (text, _left(start, done, total))))
            bar.update(task, completed=done, total=total or None, note=fields)

        yield update


@contextmanager
def running(
    what: str, checkpoint: Path | None = None, unit: str = "step", *, whole: bool = True
) -> "Iterator[OnProgress]":
    """Shows the progress of long work and, where it has a checkpoint, lets a signal stop it between two steps.

    What has to be whole once the work is done, its output above all, is written inside the block too.

    Each stage that isn't `what` has a bar of its own, named `what: stage`.

    Args:
        what: The work, in a word or two.
        checkpoint: The file that keeps an interrupted run; None: Ctrl-C and SIGTERM end the work at once.
        unit: What the work's progress counts.
        whole: Whether a signal waits for the end of a step; what is written at the end of each can do without.

    Yields:
        A callback for the work. Once it has been called and a signal stopped the work, a line says how to go on.
    """
    last: Any = None
    hold = checkpoint is not None and whole
    with deferred_interrupt() if hold else nullcontext(lambda: None) as check_interrupt:
        try:
            with ExitStack() as bars:
                bar = bars.enter_context(progress_bar(what))

                def report(progress: "Progress") -> None:
                    nonlocal bar, last
                    if progress.stage != (what if last is None else last.stage):
                        bars.close()
                        bar = bars.enter_context(
                            progress_bar(what if progress.stage == what else f"{what}: {progress.stage}")
                        )
                    last = progress
                    figures = ", ".join(_named_figure(*item) for item in progress.figures.items())
                    bar(progress.done, progress.total, figures)
                    check_interrupt()

                yield report
            check_interrupt()
        except KeyboardInterrupt:
            if checkpoint is not None and checkpoint.exists():
                place = ""
                if last is not None:
                    place = f" at {unit} {last.done}" if last.stage in (what, f"{unit}s") else f" in {last.stage}"
                note(f"stopped{place}: the same command with --resume goes on from {checkpoint}")
            raise


def _named_figure(name: str, value: float) -> str:
    """`PSNR dB` of 41.2 is written "PSNR 41.2 dB"."""
    label, _, unit = name.partition(" ")
    return " ".join(filter(None, (label, number(value, ".4g"), unit)))


def _left(start: float, done: int, total: int) -> str:
    """Writes the time left, if the rest goes as the work so far did; nothing where the total is unknown."""
    if done <= 0 or not total:
        return ""
    seconds = round((time.perf_counter() - start) * (total - done) / done)
    minutes, seconds = divmod(seconds, 60)
    return f"{minutes}:{seconds:02d} left"
