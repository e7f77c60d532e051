"""`wlm inspect`: what a file or a folder holds, and which command takes it."""

from pathlib import Path
from typing import Annotated

import typer

from wlm.cli.console import quiet_warp, show_json, show_text
from wlm.cli.options import AsJson


def inspect(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Any file or folder.")], as_json: AsJson = False
) -> None:
    """Say what a file or a folder holds, which command takes it, and what looks wrong with it.

    Nothing is written, and what can't be read is said to be so: the exit status is 0 wherever there is such a path.
    """
    quiet_warp()
    from wlm.inspection import inspect

    findings = inspect(path)
    if as_json:
        show_json([finding.to_json() for finding in findings])
        return
    lines = []
    for finding in findings:
        lines.append(f"{finding.path}: {finding.what}" + (f" -> {finding.command}" if finding.command else ""))
        lines += [f"  ! {problem}" for problem in finding.problems]
    show_text("\n".join(lines))
