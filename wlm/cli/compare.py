"""`wlm compare`: two models of one input beside each other."""

from pathlib import Path
from typing import Annotated

import typer

from wlm.cli.console import check_output, escape, quiet_warp, running, show, table
from wlm.cli.options import Device, PageFile


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="A .wlm, or a folder of wlm atlas compress.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another of the same input.")],
    original: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="What was compressed, for scores: a set, a probe file or a lightmap."),
    ] = None,
    key: Annotated[str | None, typer.Option(help="Which of the original's arrays of probes.")] = None,
    html_path: PageFile = None,
    device: Device = "cpu",
) -> None:
    """Compare two models of one input: bytes by part, settings that differ, scores, and how far apart they decode."""
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
