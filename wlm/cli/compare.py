"""`wlm compare`: compares two compressed files of the same input."""

from pathlib import Path
from typing import Annotated

import typer

from wlm.cli.console import check_output, escape, quiet_warp, running, show, table
from wlm.cli.options import Device, Key, Original, PageFile


def compare(
    first: Annotated[Path, typer.Argument(metavar="A.wlm", help="A compressed file.")],
    second: Annotated[Path, typer.Argument(metavar="B.wlm", help="Another compressed file of the same input.")],
    original: Original = None,
    key: Key = None,
    html_path: PageFile = None,
    device: Device = "cpu",
) -> None:
    """Compare two compressed files of the same input: sizes, settings, scores, and the difference of their light."""
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.view.compare import compare

    device = check_device(device)
    with running("compare") as progress:
        comparison = compare(first, second, original=original, key=key, device=device, progress=progress)
    if html_path is not None:
        comparison.write(html_path)
    rows = table(comparison.system, ["", *comparison.headings])
    for row in comparison.rows():
        rows.add_row(*map(escape, row))
    show(rows)
