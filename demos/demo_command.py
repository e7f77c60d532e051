"""`run_demo`: the command line of the demos that have one table of figures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from wlm.cli.console import quiet_warp, show_figures
from wlm.errors import WlmError
from wlm.interop import check_device


def run_demo(about: str, run: Callable[[Path, str], Mapping[str, float]], title: Callable[[Path], str]) -> None:
    """Reads the command line, runs a demo and prints a table.

    Args:
        about: The demo's docstring, whose first line describes the command.
        run: Runs the demo, with the folder to write to and the device, and returns its figures.
        title: Returns the table's title for the folder.
    """
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out", help="the folder to write to")
    parser.add_argument("--device", default="cpu", help='"cpu" or "cuda:0"')
    args = parser.parse_args()
    quiet_warp()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        figures = run(args.out, check_device(args.device))
    except (WlmError, OSError) as error:
        sys.exit(f"error: {error}")
    show_figures(title(args.out), ["", "value"], figures.items())
