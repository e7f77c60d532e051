"""The command's root: its groups, its version, and what becomes of an error.

Exit codes: 0 done; 1 the reader of our output went away; 2 bad input or an unwritable output, with one line on
stderr that starts with `error:`; 130 stopped by Ctrl-C; 143 stopped by SIGTERM. Any other exception is a bug and shows
its traceback.

What takes long to import (torch, Warp) is imported by the commands that need it, so that `wlm --version` answers at
once.
"""

import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from wlm import __version__
from wlm.cli import atlas, bake, compare, doctor, inspect, lightmap, probe, smoke, view, web
from wlm.cli.signals import exit_code, handled
from wlm.errors import WlmError, one_line

BAD_INPUT = 2
_INTERRUPTED = 130  # what typer makes of KeyboardInterrupt

# The base of all that the parser says of an argument; typer names only this child of it.
_UsageError = typer.BadParameter.__base__


class Group(TyperGroup):
    """Turns errors that are meant for the user into one line and an exit code."""

    def main(self, args: Sequence[str] | None = None, **extra: Any) -> Any:
        args = list(sys.argv[1:] if args is None else args)
        extra["standalone_mode"] = False
        try:
            # A returned number is that of an `Exit`, which an interrupt becomes too.
            code = super().main(args=args or ["--help"], **extra)
            sys.exit(exit_code() if code == _INTERRUPTED else code)
        except WlmError as error:
            line = str(error)
        except _UsageError as error:
            # "Value error" is the checker's own word.
            text = one_line(error.format_message()).replace("Value error, ", "")
            line = f"{text} ({_command_path(error)} --help tells more)"
        except OSError as error:
            if error.errno == errno.EPIPE:
                # What Python still holds for the closed pipe must not fail again when it ends.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                sys.exit(1)
            if error.errno is None:
                raise
            line = one_line(f"{error.filename or 'the system'}: {error.strerror}")
        sys.stderr.write(f"error: {line}\n")
        sys.exit(BAD_INPUT)


app = typer.Typer(
    cls=Group,
    # A bug's traceback is for a report: plain, whole, without the values of locals.
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(lightmap.app, name="lightmap")
app.add_typer(atlas.app, name="atlas")
app.add_typer(probe.app, name="probe")
app.add_typer(smoke.app, name="smoke")
app.add_typer(bake.app, name="bake")
app.command()(compare.compare)
app.command()(inspect.inspect)
app.command()(view.view)
app.command()(web.web)
app.command()(doctor.doctor)


def main() -> None:
    """Runs the command line; the entry point of `wlm`."""
    run(app)


def run(command: Callable[[], Any]) -> None:
    """Runs a command line with the signals and exit codes above."""
    try:
        # All is written when it ends: a signal then comes too late to stop anything, and must not change its exit code.
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
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Compressed precomputed lighting on NVIDIA Warp kernels.

    Begin with wlm inspect PATH: it says what a file or a folder holds, and which command takes it.
    """


def _command_path(error: Any) -> str:
    return error.ctx.command_path if error.ctx is not None else "wlm"
