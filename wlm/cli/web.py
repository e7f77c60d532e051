"""`wlm web`: a page that shows a file in any browser."""

from pathlib import Path
from typing import Annotated

import typer

from wlm.cli.console import check_output, escape, quiet_warp, running, show, table
from wlm.cli.options import Original, SceneFile, Up, output_option


def web(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="A .wlm of lightmaps or probes, the folder of wlm atlas compress, or six-way EXRs or their folder.",
        ),
    ],
    output: Annotated[Path, output_option("PAGE.html", "The page to write.")],
    mesh: SceneFile = None,
    original: Original = None,
    key: Annotated[str | None, typer.Option(help="Which of the original's arrays of probes.")] = None,
    hours: Annotated[int, typer.Option(min=1, help="Most frames of the original set that the page carries.")] = 6,
    rate: Annotated[float, typer.Option(help="Of smoke: frames a second.")] = 30.0,
    up: Up = "y",
) -> None:
    """Write one HTML file that shows the light, decoded by the browser's GPU; it needs no network."""
    check_output(output, ".html")
    quiet_warp()
    from wlm.export import write_page

    options = {"mesh": mesh, "original": original, "key": key, "hours": hours, "rate": rate, "up": up}
    with running("page") as progress:
        size = write_page(output, files, **options, progress=progress)
    rows = table(str(files[0]), ["page", "bytes"])
    rows.add_row(escape(str(output)), f"{size:,}")
    show(rows)
