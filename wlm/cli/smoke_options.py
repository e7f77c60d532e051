"""Options, output files and tables that the commands of `wlm smoke` have in common."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from wlm.cli.console import check_output, note, note_warnings, number, running, show, table
from wlm.cli.options import Device, PlaceOptions, Resume, Trust
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.smoke.data import Frames
    from wlm.smoke.scene import CameraSettings
    from wlm.smoke.shading import AnyLight, Light

SHEET = "sheet.png"
_CAMERA = ("toward", "turn", "extent", "distance", "perspective")
_VOLUME = ("up", "extinction", "emission", "density", "temperature", "kelvin")

White = Annotated[float, typer.Option(help="Radiance that becomes white in a PNG.")]
Background = Annotated[
    str | None, typer.Option(metavar="R,G,B", help="Linear colour behind the smoke; default the scene's, or black.")
]
Lights = Annotated[
    list[str] | None,
    typer.Option(
        "--light",
        metavar="X,Y,Z[:R,G,B]",
        help="Light, repeatable: direction from the smoke to it, and irradiance, one number or three; default 4 pi.",
    ),
]
Network = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help='Network for six-way lightmaps, "fast" or a file of wlm smoke train; default a coarse march.',
    ),
]
VolumeSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--volume",
        metavar="NAME=VALUE",
        help="Volume setting, repeatable: up=x|y|z, the upward axis of the file; extinction=PER_LENGTH at density "
        "1; emission=PER_LENGTH at temperature 1, or 1,500 kelvins; kelvin=yes|no, the unit of temperatures; "
        "density=GRID and temperature=GRID, names of the grids.",
    ),
]
Input = Annotated[
    Path, typer.Argument(metavar="SMOKE", help="A volume (.npz, .nvdb, .vdb) or a folder of numbered volumes.")
]


@dataclass(frozen=True)
class SmokeOptions:
    """Options of a volume, its camera and the device, for `wlm.cli.options.with_options`."""

    resolution: Annotated[
        int | None, typer.Option(min=1, max=16384, help="Height of the image in pixels; default the scene's, or 512.")
    ] = None
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Camera setting, repeatable: toward=X,Y,Z from the smoke to the camera; turn=DEGREES about the upward "
            "axis; extent=HEIGHT of the image in world units; distance=LENGTH to the target; perspective=true.",
        ),
    ] = None
    volume: VolumeSettings = None
    trust: Trust = False
    device: Device = "cpu"

    def open(self, smoke: Path, device: str | None = None) -> "Frames":
        """Opens a volume or a folder of frames, whose volumes are read to a device; None: that of the options."""
        from wlm.interop import check_device
        from wlm.smoke.data import load_frames

        settings = parse_volume(self.volume)
        frames = load_frames(smoke, **settings, trust=self.trust or None, device=check_device(device or self.device))
        note_warnings(frames.warnings)
        return frames

    def view(self, frames: "Frames", *, orthographic: bool = True) -> "CameraSettings":
        """Returns the camera of the scene, or the default one, changed by the options; errors name the option."""
        from wlm.config import check_settings
        from wlm.smoke.scene import CameraSettings

        changes: dict[str, Any] = _pairs("--camera", self.camera, _CAMERA)
        turn = _float("--camera turn", changes.pop("turn", "0"))
        if "toward" in changes:
            changes["toward"] = vector("--camera toward", changes["toward"])
        if self.resolution is not None:
            changes["resolution"] = self.resolution
        settings = check_settings(CameraSettings, frames.camera.model_dump() | changes, "--camera ").turned(turn)
        if orthographic and settings.perspective:
            raise WlmError(f"{frames.path}: camera.perspective: expected false for six-way lightmaps, found true")
        return settings


@dataclass(frozen=True)
class FrameOptions(SmokeOptions, PlaceOptions):
    """Options of work on frames, which workers may share."""

    resume: Resume = False


def parse_volume(texts: Sequence[str] | None) -> dict[str, Any]:
    """Parses the texts of `--volume` to options of `wlm.smoke.data.load_frames`."""
    from wlm.fluid.grids import UPS

    settings: dict[str, Any] = _pairs("--volume", texts, _VOLUME)
    if settings.get("up", "y") not in UPS:
        raise WlmError(f"--volume up: expected one of {', '.join(UPS)}, got {settings['up']!r}")
    for name in ("extinction", "emission"):
        if name in settings:
            settings[name] = _float(f"--volume {name}", settings[name])
    if settings.get("kelvin", "yes") not in ("yes", "no"):
        raise WlmError(f"--volume kelvin: expected yes or no, got {settings['kelvin']!r}")
    if "kelvin" in settings:
        settings["kelvin"] = settings["kelvin"] == "yes"
    return settings


def _pairs(option: str, texts: Sequence[str] | None, names: Sequence[str]) -> dict[str, Any]:
    """Parses a repeatable option NAME=VALUE; returns the values by name. Unknown names are errors."""
    values = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or name not in names:
            raise WlmError(f"{option}: expected NAME=VALUE with a name of {', '.join(names)}, got {text!r}")
        values[name] = value
    return values


def _float(option: str, text: str) -> float:
    with suppress(ValueError):
        if math.isfinite(value := float(text)):
            return value
    raise WlmError(f"{option}: expected a finite number, got {text!r}")


def vector(option: str, text: str) -> tuple[float, float, float]:
    """Parses three finite numbers, such as 0,0.5,1, from the text of an option."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise WlmError(f"{option}: expected three numbers such as 0,0.5,1, got {text!r}") from None
    if not all(abs(value) < float("inf") for value in (x, y, z)):
        raise WlmError(f"{option}: expected finite numbers, got {text!r}")
    return x, y, z


def vectors(option: str, text: str) -> list[tuple[float, float, float]]:
    """Parses `X,Y,Z`, `X,Y,Z:R,G,B` or, for white light, `X,Y,Z:E`. Returns one or two triples."""
    place, colon, colour = text.partition(":")
    values = [vector(option, place)]
    if colon:
        values.append(vector(option, colour if "," in colour else ",".join([colour] * 3)))
    return values


def parse_lights(
    directions: Sequence[str] | None, places: Sequence[str] | None = None, sky: tuple[float, float, float] | None = None
) -> "tuple[list[AnyLight], tuple[Light, ...]]":
    """Parses the texts of `--light` and `--point`; returns these lights, and those that stand for a sky."""
    from wlm.config import check_settings
    from wlm.smoke.scene import LightSettings
    from wlm.smoke.shading import PointLight, sky_lights

    made: list[AnyLight] = []
    for text in directions or ():
        values = dict(zip(("toward", "irradiance"), vectors("--light", text), strict=False))
        made.append(check_settings(LightSettings, values, "--light: ").light())
    option = "--point"
    try:
        made += [PointLight(*vectors(option, text)) for text in places or ()]
        option = "--sky"
        return made, () if sky is None else sky_lights(sky)
    except ValueError as error:
        raise WlmError(f"{option}: {error}") from error


def check_positive(**options: float | None) -> None:
    """Checks values of options by name, which must be finite and above 0, or None."""
    for name, value in options.items():
        if value is not None and not 0 < value < float("inf"):
            raise WlmError(f"--{name.replace('_', '-')}: expected a number above 0, got {value}")


def outputs(smoke: Path, single: bool, output: Path, stem: str, suffix: str, *others: str) -> Callable[[int], Path]:
    """Checks the output and returns a function that gives the path of the file for a frame number.

    With `single` the output is a file with one of the suffixes, otherwise a folder of files such as light_0001.png.
    """
    from wlm.smoke.data import NumberedFiles

    if single:
        check_output(output, suffix, *others)
        return lambda number: output
    _check_folder(smoke, output)
    return NumberedFiles(output, stem, suffix, SHEET).file


def _check_folder(smoke: Path, output: Path) -> None:
    if output.resolve() == smoke.resolve():
        raise WlmError(f"{output}: expected another folder than that of the frames, which are the input")


def write_lightmaps(
    options: FrameOptions,
    smoke: Path,
    output: Path,
    arguments: tuple[Any, Mapping[str, Any]],
    settings: Mapping[str, Any],
    errors: bool = False,
) -> None:
    """Makes and writes the lightmaps of each frame, and shows a table.

    Args:
        options: The options of the command. With `resume` the frames are kept that an interrupted run of the same
            settings has made.
        smoke: A volume or a folder of frames.
        output: A file, or for frames a folder.
        arguments: Method and settings of `wlm.smoke.frames.FrameMaker`.
        settings: JSON values that the results depend on, besides smoke and camera. An "albedo" other than None means
            that the lightmaps already include it.
        errors: Whether the lightmaps state the error due to the step length.
    """
    from wlm.dispatch import Place, Task, run
    from wlm.formats.reading import system_errors
    from wlm.smoke.data import NumberedFiles, write_six_way
    from wlm.smoke.frames import FrameMaker
    from wlm.smoke.lightmaps import axis_faults
    from wlm.system import Meter

    where, resume = Place(options.device, options.workers, options.cluster), options.resume
    # What is sent to other processes is in the host's memory.
    frames = options.open(smoke, where.here if len(where.devices()) == 1 else "cpu")
    camera, files = options.view(frames), None
    if frames.single:
        if resume:
            raise WlmError(f"--resume: expected a folder of frames, but {frames.path} is one volume")
        check_output(output, ".exr")
    else:
        _check_folder(frames.path, output)
        factors = {"extinction": frames.extinction, "emission": frames.emission, "device": where.device[:4]}
        scene = dict(frames.options) if frames.scene is None else frames.scene.stored(frames.path)
        with system_errors(f"{frames.path}: cannot read the frames"):
            stats = [(each.name, each.stat()) for each in frames.files.values()]
        read = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
        key = {**settings, **factors, "scene": scene, "camera": camera.model_dump(mode="json"), "input": read}
        files = NumberedFiles(output, "six", ".exr", SHEET, run=key, resume=resume)
        if resume:
            done = len(files.done)
            note(f"{output}: {done} frames are finished" if done else f"{files.partial}: there is nothing to resume")
    columns = ["file", "method", "pixels with smoke", "their mean light", *(["largest error", "RMS error"] * errors)]
    rows = table(str(frames.path), columns)
    numbers = [each for each in frames.numbers if files is None or each not in files.done]
    made: dict[int, tuple[str, ...]] = {}
    thickness = [0.0]

    def job(frame: int) -> tuple[Any, ...]:
        volume, looks = frames.load(frame), frames.looks(frame)
        note_warnings(volume.warnings)
        thickness[0] = max(thickness[0], volume.thickness)
        if looks is not None and settings.get("albedo") is not None:
            looks = looks.model_copy(update={"albedo": (1.0, 1.0, 1.0)})
        return str(frames.file(frame)), volume, frames.view(camera, volume), looks

    tasks = [Task((frame,), 1, partial(job, frame)) for frame in numbers]
    with running("six", None if files is None else files.partial, "frame", whole=False) as progress:
        meter = Meter(progress, "frames", len(tasks), every=0.0)
        for task, (six, looks) in run((FrameMaker, *arguments), tasks, meter, where):
            (frame,) = task.numbers
            path = output if files is None else files.file(frame)
            for fault in axis_faults(six.lightmaps):
                note(f"{path}: {fault}")
            write_six_way(path, six, looks)
            covered = six.transparency < 0.99
            mean = float(six.lightmaps[:, covered].mean()) if covered.any() else None
            row = [escape(path.name), six.method, f"{float(covered.float().mean()):.1%}", number(mean, ".4g")]
            made[frame] = *row, *((f"{six.error.largest:.2g}", f"{six.error.rms:.2g}") if errors else ())
    for frame in sorted(made):
        rows.add_row(*made[frame])
    if files is not None:
        files.finish()
    show(rows)
    note_thickness(frames, thickness[0])


def note_thickness(frames: "Frames", thickness: float) -> None:
    """Prints a warning if the largest optical thickness of all frames is so low or high that smoke looks wrong."""
    from wlm.fluid.volume import thickness_hint

    if hint := thickness_hint(thickness, frames.extinction_used):
        note_warnings([f"{frames.path}: {hint}"])
