"""Output of the commands: tables, notes, progress, and checks of output files."""

import functools
import json
import os
import shutil
import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
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
from wlm.formats.stderr import captured_stderr

if TYPE_CHECKING:
    from wlm.formats.checkpoint import Checkpoint
    from wlm.system import OnProgress, Progress

_PLAIN_WIDTH = 10_000  # characters of a line in a file or a pipe, so that no cell of a table wraps
_PLAIN_REPORTS = 10  # lines of progress in a log
_NO_RESULTS = {"scene.json", "six.partial"}  # files of a sequence without a frame: the scene, the settings of a run
COMPILING = "compiling kernels (first run, up to a minute; later runs start at once)"
_MISSING_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def _console(stderr: bool = False) -> Console:
    # A new object at each use binds the current stream, which a test or a caller may have replaced.
    console = Console(stderr=stderr, highlight=False)
    return console if console.is_terminal else Console(stderr=stderr, highlight=False, width=_PLAIN_WIDTH)


class _Table(Table):
    """A table that replaces control characters in its cells, because names come from files."""

    def add_row(self, *cells: Any, **options: Any) -> None:
        super().add_row(*(printable(cell) if isinstance(cell, str) else cell for cell in cells), **options)


def table(title: str, columns: Sequence[str], text: Sequence[str] = ()) -> Table:
    """Starts a table. The first column and those named in `text` are aligned as text, the others as numbers."""
    rows = _Table(title=title, header_style="bold")
    for i, heading in enumerate(columns):
        rows.add_column(heading, justify="right" if i and heading not in text else "left", overflow="fold")
    return rows


def show(content: Table) -> None:
    """Prints a table to stdout with its title in a line above it."""
    # Rich would wrap the title at the width of the columns.
    title, content.title = content.title, None
    _console().print(printable(str(title)), style="bold", markup=False, soft_wrap=True)
    _console().print(content)


def show_figures(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str | float]], text: Sequence[str] = ()
) -> None:
    """Prints a table of texts and numbers, a cell for each column; `table` explains the other arguments.

    Integers are written in full, floats with four digits.
    """
    content = table(title, columns, text)
    for row in rows:
        content.add_row(*(_figure(value) for value in row))
    show(content)


def _figure(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float) or value is None:
        return number(value, ".4g")
    return ", ".join(map(_figure, value)) if isinstance(value, list | tuple) else escape(str(value))


def show_facts(title: str, facts: Mapping[str, Any]) -> None:
    """Prints facts, JSON values by name, as a table of two columns; underscores in names become spaces.

    A mapping becomes a section of the table, in which each line has the name of the mapping and that of an entry.
    """
    rows = table(title, ["", "value"])
    for name, value in facts.items():
        label = escape(name.replace("_", " "))
        if isinstance(value, Mapping):
            rows.add_section()
            for key, each in value.items():
                rows.add_row(f"{label}: {escape(str(key))}", _figure(each))
        else:
            rows.add_row(label, _figure(value))
    show(rows)


def show_files(title: Path, paths: Iterable[Path]) -> None:
    """Prints a table of written files; paths of files in the folder `title` are relative to it."""
    rows = table(str(title), ["file", "bytes"])
    for path in paths:
        shown = path.relative_to(title) if path.is_relative_to(title) else path
        rows.add_row(escape(str(shown)), f"{path.stat().st_size:,}")
    show(rows)


def note(text: str) -> None:
    """Prints a line to stderr without interpreting markup, which may occur in paths."""
    _console(stderr=True).print(printable(text), markup=False, soft_wrap=True)


def note_warnings(warnings: Iterable[str]) -> None:
    """Prints warnings to stderr, a line each."""
    for warning in warnings:
        note(f"warning: {warning}")


def note_start(checkpoint: "Checkpoint", resume: bool, start: str) -> None:
    """Prints a line if `--resume` was given but there is no checkpoint, so that the work begins at `start`."""
    if resume and not checkpoint.resumed:
        note(f"{checkpoint.path}: there is nothing to resume; starting {start}")


def show_text(text: str) -> None:
    """Prints lines to stdout without colours and without control characters."""
    sys.stdout.write("\n".join(map(printable, text.removesuffix("\n").split("\n"))) + "\n")


def number(value: float | None, form: str) -> str:
    """Formats a number by the format spec `form`; None and NaN become a dash."""
    return "–" if value is None or value != value else format(value, form)


def show_json(value: Any) -> None:
    """Prints JSON to stdout without wrapping and colours."""
    _console().out(json.dumps(value, indent=1, allow_nan=False), highlight=False)


def write_json(path: Path, value: Any) -> None:
    """Writes JSON to a file, whole or not at all. Raises a WlmError if the file can't be written."""
    from wlm.formats.atomic import atomic_write

    atomic_write(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def check_output(path: Path, *suffixes: str) -> None:
    """Checks before long work that its output file can be written. Raises a WlmError if the name has none of the
    suffixes, which guards against an input given as the output; the folder is missing or read-only; or the path is no
    regular file."""
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
    """Locks the `output` of a command while it runs, and removes temporary files that killed processes left there.

    A folder that the command makes is removed if the command fails before it has a result. Raises a WlmError if another
    process is writing that output."""

    @functools.wraps(command)
    def run(**values: Any) -> None:
        output = values["output"]
        with locked(output):
            existed = os.path.lexists(output)
            try:
                command(**values)
            except WlmError:
                if not existed:
                    _remove_without_result(output)
                raise

    return run


def _remove_without_result(folder: Path) -> None:
    with suppress(OSError):
        if set(os.listdir(folder)) <= _NO_RESULTS:
            shutil.rmtree(folder)


def quiet_warp() -> None:
    """Starts Warp without its banner, its notes on modules, and its line about a missing GPU driver.

    A missing driver does not matter on the CPU, and `--device cuda` raises an error about it anyway. One line says that
    kernels are compiled, once some are.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    # Warp's C library writes to the stderr of the process, whatever the settings are.
    with captured_stderr(lambda line: _MISSING_DRIVER in line):
        wp.init()
    _announce_compilation()


def begin(output: Path | None, *suffixes: str, inputs: Sequence[Path | None] = ()) -> None:
    """Checks the output file of a command, if it has one, see `check_output`: it is none of the files in `inputs`. Then
    starts Warp, see `quiet_warp`."""
    if output is not None:
        check_output(output, *suffixes)
        if output.exists() and any(path and path.exists() and path.samefile(output) for path in inputs):
            raise WlmError(f"{output}: expected another file than the input, which would be replaced")
    quiet_warp()


@functools.cache
def _announce_compilation() -> None:
    from warp._src.context import Module

    generate, announce = Module._run_codegen, functools.cache(lambda: note(COMPILING))

    def run(self: Module, *arguments: Any) -> Any:
        announce()
        return generate(self, *arguments)  # which Warp calls only for a module that its cache does not hold

    Module._run_codegen = run


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int, str], None]]:
    """Shows progress on stderr: a bar on a terminal, otherwise a plain line after about every tenth of the work.

    Work without a known number of steps gets one line at its beginning. Yields a function to call with the finished
    steps, the total, and a text to show with them.
    """
    console = _console(stderr=True)
    clock = _Clock()
    if not console.is_terminal:
        reported = 0

        def line(done: int, total: int, text: str) -> None:
            nonlocal reported
            if not done and not total:
                note(what)
            if (part := done * _PLAIN_REPORTS // max(total, 1)) > reported:
                reported = part
                count = f"{done} of {total}" if total else f"{done}"
                note(", ".join(filter(None, (f"{what}: {count}", text, clock.left(done, total)))))
            else:
                clock.left(done, total)

        yield line
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[note]}"))
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=None, note="")

        def update(done: int, total: int, text: str) -> None:
            fields = ", ".join(filter(None, (text, clock.left(done, total))))
            bar.update(task, completed=done, total=total or None, note=fields)

        yield update


@contextmanager
def running(
    what: str, checkpoint: Path | None = None, unit: str = "step", *, whole: bool = True
) -> "Iterator[OnProgress]":
    """Shows the progress of long work and, if it has a checkpoint, lets a signal stop it between two steps.

    The output of the work must be written inside the block, so that a signal cannot interrupt it. A stage whose name
    differs from `what` gets its own bar, named `what: stage`. Without a checkpoint Ctrl-C and SIGTERM end the work at
    once; `unit` is the name of a step, such as "frame", and `whole` tells whether a signal waits for its end, not so
    for steps that write their results by themselves. Yields a function to call with a `Progress`. If a signal stops the
    work later, a line says how to continue.
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
                note(f"stopped{place}: repeat the command with --resume to continue from {checkpoint}")
            raise


def _named_figure(name: str, value: float) -> str:
    label, _, unit = name.partition(" ")
    return " ".join(filter(None, (label, number(value, ".4g"), unit)))


class _Clock:
    """Estimates the time left from the pace since the first finished step, which may have compiled kernels."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None

    def left(self, done: int, total: int) -> str:
        """Returns the estimated time left as text; empty at the first finished step, or if the total is unknown."""
        if done <= 0 or not total:
            return ""
        now = time.perf_counter()
        if self._first is None:
            self._first = done, now
        steps, start = done - self._first[0], self._first[1]
        if steps <= 0:
            return ""
        minutes, seconds = divmod(round((now - start) * (total - done) / steps), 60)
        return f"{minutes}:{seconds:02d} left"
