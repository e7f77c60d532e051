"""Options that several commands have, each spelled out once."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from wlm.errors import WlmError

Device = Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="One seed gives one result on one device.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run of the same output.")]
_EVERY = typer.Option(
    "--checkpoint-every",
    min=0.0,
    metavar="SECONDS",
    show_default=False,
    help="Between two saves of the running work, which --resume goes on from after a crash; default 30.",
)
CheckpointEvery = Annotated[float, _EVERY]
CheckpointEveryIfKept = Annotated[float | None, _EVERY]  # of commands some of whose work isn't kept: None: not given
ReportFile = Annotated[Path | None, typer.Option("--json", metavar="REPORT.json", help="Write a report.")]
PageFile = Annotated[
    Path | None, typer.Option("--html", metavar="REPORT.html", help="Write a page with tables, plots and pictures.")
]
SceneFile = Annotated[
    Path | None, typer.Option("--mesh", metavar="SCENE.glb", help="The scene of the light: .glb, .gltf or .obj.")
]
Original = Annotated[
    Path | None,
    typer.Option(metavar="PATH", help="What was compressed, to compare with: a set, a lightmap or a probe file."),
]
Up = Annotated[Literal["y", "z"], typer.Option(help="The axis that points up in the scene.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Trust = Annotated[
    bool,
    typer.Option("--trust", help="Trust the input's author: it may name files elsewhere, and be as large as it says."),
]
Engine = Annotated[
    Literal["raw", "three", "godot", "unity", "unreal"],
    typer.Option(help="Whose folder: raw is textures, floats and a shader for any."),
]
ShaderLanguage = Annotated[
    Literal["glsl", "glsl-es", "hlsl", "msl", "wgsl"] | None,
    typer.Option(help="Of raw, the shader's language; default glsl."),
]
ExactShader = Annotated[
    bool, typer.Option("--exact", help="Of raw, the shader mixes texels in floats rather than by the filter unit.")
]
ModelFile = Annotated[Path, typer.Argument(metavar="FILE.wlm", help="A file that compress wrote.")]


def shader_of(engine: str, shader: str | None, exact: bool = False) -> str:
    """The language of a raw export's shader.

    Raises:
        WlmError: One is given, or --exact, for an engine that has its own.
    """
    for option, given in (("shader", shader), ("exact", exact)):
        if given and engine != "raw":
            raise WlmError(f"--{option}: means nothing with --engine {engine}, which has its own shaders")
    return shader or "glsl"


def seconds_between(checkpoint_every: float | None) -> float:
    """Seconds between two saves, where none may be given."""
    from wlm.formats.checkpoint import EVERY

    return EVERY if checkpoint_every is None else checkpoint_every


def output_option(metavar: str, help_text: str) -> Any:
    """`--output` or `-o`, for `Annotated[Path, output_option(...)]`."""
    return typer.Option("--output", "-o", metavar=metavar, help=help_text)
