"""`wlm web`: writes an HTML page that shows a compressed file."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from wlm.cli.console import begin, running, show, table
from wlm.cli.options import Key, Original, SceneFile, Time, Up, output_option
from wlm.cli.smoke_options import Network, VolumeSettings, parse_volume
from wlm.errors import WlmError


def web(
    output: Annotated[Path, output_option("PAGE.html", "The page to write.")],
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[FILE...]",
            help="A .wlm of lightmaps, meshes or probes; six-way lightmaps (.exr, one per frame, or a folder); smoke "
            "(.npz, .nvdb or .vdb, or a folder of frames), lit in the browser; or a scene (.yaml). Without a file, the "
            "page is a viewer that opens models and six-way lightmaps in the browser.",
        ),
    ] = None,
    mesh: SceneFile = None,
    original: Original = None,
    key: Key = None,
    time: Time = None,
    hours: Annotated[
        int | None, typer.Option(min=1, help="Most original lightmaps in the page, at evenly spread times; default 6.")
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Frames per second at which smoke is played; default 30.")] = None,
    network: Network = None,
    volume: VolumeSettings = None,
    up: Up = "y",
) -> None:
    """Write one HTML file that decodes and shows the light on the GPU of a browser. It works without a network."""
    begin(output, ".html")
    from wlm.export import write_page, write_viewer

    options = {"mesh": mesh, "original": original, "key": key, "time": time, "hours": hours, "rate": rate}
    options |= {"network": network, "volume": parse_volume(volume) or None}
    if files:
        with running("page") as progress:
            size = write_page(output, files, **options, up=up, progress=progress)
    elif given := [name for name, value in options.items() if value is not None]:
        raise WlmError(f"--{given[0]}: has no meaning for a viewer: expected a file, found none")
    else:
        size = write_viewer(output)
    rows = table(str(files[0]) if files else "viewer", ["page", "bytes"])
    rows.add_row(escape(str(output)), f"{size:,}")
    show(rows)
