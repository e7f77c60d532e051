"""`wlm inspect`: describes a file or a folder and names the command that reads it."""

from pathlib import Path
from typing import Annotated

import typer

from wlm.cli.console import quiet_warp, show_json, show_text
from wlm.cli.options import AsJson
from wlm.errors import printable


def inspect(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Any file or folder.")], as_json: AsJson = False
) -> None:
    """Describe a file or a folder: its content, the command that reads it, and possible problems.

    Nothing is written. Unreadable files are reported like others, and the exit status is 0 if the path exists.
    """
    quiet_warp()
    from wlm.inspection import inspect

    findings = inspect(path)
    if as_json:
        show_json([finding.to_json() for finding in findings])
        return
    lines = []
    for finding in findings:
        command = f" -> {finding.command}" if finding.command else ""
        lines.append(f"{printable(str(finding.path))}: {finding.what}{command}")
        lines += [f"  ! {problem}" for problem in finding.problems]
    show_text("\n".join(lines))
