"""The command line of the demos, which name a folder and a device."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from wlm.cli.console import quiet_warp, show_figures
from wlm.errors import WlmError
from wlm.interop import check_device


def run_command(
    about: str, run: Callable[[Path, str], Mapping[str, Any]], folder: str = ""
) -> tuple[Path, Mapping[str, Any]]:
    """Reads the command line and runs a demo; an error ends the process with one line.

    Args:
        about: The demo's docstring, whose first line describes the command.
        run: Runs the demo, with the folder to write to and the device, and returns its figures.
        folder: Default of the folder, below `out`.

    Returns:
        The folder and the figures.
    """
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    default = Path(__file__).parent / "out" / folder
    parser.add_argument("--out", type=Path, default=default, help="the folder to write to")
    parser.add_argument("--device", default="cpu", help='"cpu" or "cuda:0"')
    args = parser.parse_args()
    quiet_warp()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        return args.out, run(args.out, check_device(args.device))
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")


def run_demo(about: str, run: Callable[[Path, str], Mapping[str, float]], title: Callable[[Path], str]) -> None:
    """Runs a demo that has one table of figures and prints it; `title` returns the table's title for the folder."""
    out, figures = run_command(about, run)
    show_figures(title(out), ["", "value"], figures.items())
