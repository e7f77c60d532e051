"""Root of the command line: registers the commands, shows the version, and reports errors.

Exit codes: 0 success; 1 the reader of a pipe closed it; 2 wrong input or an output that cannot be written, with one
line on stderr that starts with `error:`; 130 stopped by Ctrl-C; 143 stopped by SIGTERM. Any other exception is a bug
and shows its traceback.

Modules that take long to import (torch, Warp) are imported by the commands that need them, so that `wlm --version`
answers at once.
"""

import errno
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from wlm import __version__
from wlm.cli import bake, inspect, smoke, verbs, view, web
from wlm.cli import probe_volume as probe
from wlm.cli import run as run_scene
from wlm.cli.signals import exit_code, handled
from wlm.errors import WlmError, broken_package, one_line

BAD_INPUT = 2
_INTERRUPTED = 130  # typer's code for KeyboardInterrupt

# The base class of all errors of the argument parser, of which typer only exports this child.
_UsageError = typer.BadParameter.__base__


class Group(TyperGroup):
    """A group of commands that turns errors meant for the user into one line and an exit code."""

    def main(self, args: Sequence[str] | None = None, **extra: Any) -> Any:
        args = list(sys.argv[1:] if args is None else args)
        extra["standalone_mode"] = False
        try:
            # A returned number is that of an `Exit`, which typer also makes of an interrupt.
            code = super().main(args=args or ["--help"], **extra)
            sys.stdout.flush()
            sys.exit(exit_code() if code == _INTERRUPTED else code)
        except WlmError as error:
            line = str(error)
        except _UsageError as error:
            # pydantic adds "Value error" in front of messages.
            text = one_line(error.format_message()).replace("Value error, ", "")
            line = f"{text} (see {_command_path(error)} --help)"
        except Exception as error:
            if isinstance(error, OSError) and error.errno == errno.EPIPE:
                sys.exit(1)
            if package := broken_package(error):
                reason = f"{type(error).__name__}: {error}"
                line = one_line(f"the package {package} cannot be imported: {reason}; install it again")
            elif isinstance(error, OSError) and error.errno is not None:
                line = one_line(f"{error.filename or 'the system'}: {error.strerror}{_cache_hint(error)}")
            elif isinstance(error, RuntimeError) and str(error).startswith("Symlink loop"):
                line = one_line(str(error))  # Python before 3.13 raises this where it follows symbolic links
            else:
                raise
        sys.stderr.write(f"error: {line}\n")
        sys.exit(BAD_INPUT)


_STREAMS = {"stdout": 1, "stderr": 2}


class _Stream:
    """A standard stream. Errors of stdout name it, those of stderr are ignored, as when it is closed."""

    def __init__(self, name: str) -> None:
        self._name, self._stream = name, getattr(sys, name)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with self._checked():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._checked():
            self._stream.flush()

    @contextmanager
    def _checked(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # What Python still buffers must not fail again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), _STREAMS[self._name])
            if self._name == "stdout":
                error.filename = self._name
                raise


def _cache_hint(error: OSError) -> str:
    """Returns words for an error message on how to move the cache of compiled kernels; "" if it is not the cause."""
    if "warp" not in sys.modules or error.errno not in (errno.ENOSPC, errno.EROFS, errno.EACCES):
        return ""
    import warp as wp

    cache = str(wp.config.kernel_cache_dir or "")
    if not cache or (error.filename and not str(error.filename).startswith(cache)):
        return ""
    return f"; compiled kernels are kept in {cache}: WARP_CACHE_PATH names another folder"


app = typer.Typer(
    cls=Group,
    # The traceback of a bug is meant for a report: plain, whole, without the values of local variables.
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _input_system(path: Path) -> str:
    from wlm.inspection import input_system

    return input_system(path)


verbs.register(
    app,
    "compress",
    "Compress lightmaps over time, lightmaps of a mesh, or light probes into one .wlm file.\n\n"
    "The kind of the input chooses the system. wlm compress INPUT --help lists the options of that system, "
    "wlm compress --system probe --help those of probes without an input.",
    metavar="INPUT",
    argument_help="A lightmap set or a folder of lightmaps; a mesh, followed by its lightmaps; or a probe file.",
    detect=_input_system,
)
for _name, _about in (
    ("evaluate", "Compare a compressed file with its original and report the error."),
    ("decode", "Decode a compressed file: a lightmap at a time, the lightmap of a mesh, or probes."),
    (
        "export",
        "Write a compressed file as a folder for an engine: textures, buffers, and a shader or an engine's kit.",
    ),
    ("info", "Show what a compressed file contains: settings, sizes on disk and on a device."),
):
    _more = f"wlm {_name} FILE.wlm --help lists the options of the file's system."
    verbs.register(app, _name, f"{_about}\n\n{_more}")
app.command()(inspect.inspect)
app.command()(view.view)
app.command()(web.web)
app.command()(run_scene.run)
app.add_typer(probe.app, name="probe")
app.add_typer(smoke.app, name="smoke")
app.add_typer(bake.app, name="bake")


def main() -> None:
    """Runs the command line; the entry point of `wlm`."""
    run(app)


def _open_streams() -> None:
    """Makes stdout and stderr usable: the null device takes the place of one that is closed, and errors name them."""
    for name, number in _STREAMS.items():
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_WRONLY)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            setattr(sys, name, open(number, "w"))  # noqa: SIM115
        setattr(sys, name, _Stream(name))


def run(command: Callable[[], Any]) -> None:
    """Runs a command line; after Ctrl-C or SIGTERM the process ends with exit code 130 or 143."""
    _open_streams()
    try:
        # At the end everything is written. A late signal can stop nothing and must not change the exit code.
        with handled(after=signal.SIG_IGN):
            command()
    except KeyboardInterrupt:
        sys.exit(exit_code())


def _show_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"wlm {__version__}\n")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Compressed precomputed lighting on NVIDIA Warp kernels.

    Start with wlm inspect PATH: it says what a file or folder contains and which command reads it.
    """


def _command_path(error: Any) -> str:
    return error.ctx.command_path if error.ctx is not None else "wlm"
