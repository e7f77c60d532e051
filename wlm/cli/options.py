"""Options that several commands share, each defined once."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

Device = Annotated[str, typer.Option(help='Device to compute on: "cpu", "cuda" or "cuda:N".')]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Random seed; fixes the result on one device.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an interrupted run that wrote to the same output.")]
CheckpointEvery = Annotated[
    float,
    typer.Option(
        "--checkpoint-every",
        min=0.0,
        metavar="SECONDS",
        help="Seconds between two checkpoints (saved states), from which --resume continues after a crash.",
    ),
]
ReportFile = Annotated[
    Path | None, typer.Option("--json", metavar="REPORT.json", help="Also write the scores to this file, as JSON.")
]
SceneFile = Annotated[
    Path | None,
    typer.Option(
        "--mesh", metavar="SCENE.glb", help="File with the mesh of the scene: .glb, .gltf, .obj, .ply, .stl or .off."
    ),
]
Original = Annotated[
    Path | None,
    typer.Option(metavar="PATH", help="The uncompressed input to compare with: a set, a lightmap or a probe file."),
]
Up = Annotated[Literal["y", "z"], typer.Option(help="Axis of the scene that points up.")]
Encoding = Annotated[
    str | None,
    typer.Option(
        metavar="ENCODING",
        help="Encoding of light in a PNG, JPEG, WebP, TGA or TIFF of integers: linear, srgb, rgbm (of Unity in linear "
        "colour space), rgbm:RANGE:GAMMA, that is (RANGE x alpha x colour)^GAMMA, rgbd (of Babylon.js), "
        "rgbd:RANGE:GAMMA, dldr or rgbe; or layer:NAME, the layer of an EXR that has several.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
Trust = Annotated[
    bool, typer.Option("--trust", help="Trust the input file: it may name files in other folders and have any size.")
]
Profile = Annotated[str, typer.Option(metavar="NAME|FILE.yaml", help="Name of a settings profile, or a YAML file.")]
Engine = Annotated[
    Literal["three", "godot", "unity", "unreal", "bevy"] | None,
    typer.Option(
        help="Write a kit for this engine (bevy: probes only). Default: textures, buffers and a shader for any program."
    ),
]
ShaderLanguage = Annotated[
    Literal["glsl", "glsl-es", "hlsl", "wgsl"] | None,
    typer.Option(help="Language of the shader without --engine; default glsl."),
]
ExactShader = Annotated[
    bool,
    typer.Option(
        "--exact", help="Write a shader that interpolates texels itself, in 32-bit floats; not with --engine."
    ),
]
ModelFile = Annotated[Path, typer.Argument(metavar="FILE.wlm", help="Compressed file that wlm compress wrote.")]
Key = Annotated[
    str | None,
    typer.Option(help="Name of the array of light to read from a probe file with several, such as one an hour."),
]
Time = Annotated[
    float | None,
    typer.Option(metavar="HOUR", help="Hour of the day of light probes that have several; may be between two of them."),
]

Weights = Annotated[
    list[str] | None,
    typer.Option(
        "--weight", metavar="GROUP=NUMBER", help="Factor of a light group, 0: off; default 1. May be repeated."
    ),
]
Colours = Annotated[
    list[str] | None,
    typer.Option(
        "--colour",
        metavar="GROUP=R,G,B",
        help="Factors of red, green and blue of a light group, besides its weight. May be repeated.",
    ),
]


def output_option(metavar: str, help_text: str) -> Any:
    """Returns the typer option `--output` (`-o`) for the annotation of a path."""
    return typer.Option("--output", "-o", metavar=metavar, help=help_text)


@dataclass(frozen=True)
class PlaceOptions:
    """Options that state where long work runs, see `wlm.dispatch.Place`."""

    device: Device = "cpu"
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Workers that share the work; with --device cuda on all GPUs of this machine."
        ),
    ] = None
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help='Share the work on a Ray cluster (extra `cluster`): ray://HOST:10001, or "auto".'
        ),
    ] = None


@dataclass(frozen=True)
class FitOptions(PlaceOptions):
    """Options of a fit."""

    seed: Seed = 0
    resume: Resume = False
    checkpoint_every: CheckpointEvery = 30.0


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Gives a command an option for each field of the dataclasses that are types of its parameters."""
    signature = inspect.signature(command)
    kinds = {name: each.annotation for name, each in signature.parameters.items() if is_dataclass(each.annotation)}

    @functools.wraps(command)
    def run(**values: Any) -> None:
        made = {
            name: kind(**{each.name: values.pop(each.name) for each in fields(kind)}) for name, kind in kinds.items()
        }
        command(**made, **values)

    own = [parameter for name, parameter in signature.parameters.items() if name not in kinds]
    shared = [
        inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type)
        for kind in kinds.values()
        for field in fields(kind)
    ]
    # typer reads both.
    run.__signature__ = signature.replace(parameters=[*own, *shared])  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *shared)}
    return run
