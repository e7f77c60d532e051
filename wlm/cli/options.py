"""Options that several commands have, each spelled out once."""

from pathlib import Path
from typing import Annotated, Any

import typer

Device = Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="One seed gives one result on one device.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run of the same output.")]
CheckpointEvery = Annotated[
    float,
    typer.Option(
        "--checkpoint-every",
        min=0.0,
        metavar="SECONDS",
        help="Between two saves of the running work, which --resume goes on from after a crash.",
    ),
]
ReportFile = Annotated[Path | None, typer.Option("--json", metavar="REPORT.json", help="Write a report.")]
PageFile = Annotated[
    Path | None, typer.Option("--html", metavar="REPORT.html", help="Write a page with tables, plots and pictures.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Trust = Annotated[
    bool,
    typer.Option("--trust", help="Trust the input's author: it may name files elsewhere, and be as large as it says."),
]
ModelFile = Annotated[Path, typer.Argument(metavar="FILE.wlm", help="A file that compress wrote.")]


def output_option(metavar: str, help_text: str) -> Any:
    """`--output` or `-o`, for `Annotated[Path, output_option(...)]`."""
    return typer.Option("--output", "-o", metavar=metavar, help=help_text)
