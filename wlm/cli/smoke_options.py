"""What the commands of `wlm smoke` share: options of the smoke and its camera, output files, tables of lightmaps."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import check_output, escape, note, number, running, show, table
from wlm.cli.options import Device, Trust
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.camera import Camera
    from wlm.smoke.data import Frames
    from wlm.smoke.lightmaps import SixWay
    from wlm.smoke.scene import CameraSettings

SHEET = "sheet.png"

SceneName = Annotated[
    str, typer.Argument(metavar="SCENE", help="jet-sphere, jet-moving, explosion, chimney, or a YAML.")
]
Albedo = Annotated[
    str | None,
    typer.Option(metavar="R,G,B", help="Share of light that a scattering leaves, or one number; default the scene's."),
]
Input = Annotated[Path, typer.Argument(metavar="SMOKE", help="A .npz, .nvdb or .vdb volume, or a folder of frames.")]


@dataclass(frozen=True)
class SmokeOptions:
    """Options of the smoke, its camera and the device, each spelled out once for all commands `with_smoke`."""

    resolution: Annotated[
        int | None, typer.Option(min=1, max=16384, help="Pixels along the image's height; default the scene's, or 512.")
    ] = None
    toward: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="From the smoke to the camera; default the scene's, or 0,0,1.")
    ] = None
    turn: Annotated[float, typer.Option(help="Degrees by which the camera is turned about the upward direction.")] = 0.0
    extent: Annotated[
        float | None, typer.Option(help="Height of the image in the world; default such that the box fits.")
    ] = None
    distance: Annotated[
        float | None, typer.Option(help="Of the camera from its target; what is behind it isn't seen. Default outside.")
    ] = None
    extinction: Annotated[float | None, typer.Option(help="Per length of density 1; default the scene's, or 1.")] = None
    emission: Annotated[float | None, typer.Option(help="Per length of temperature 1; default the scene's, or 1.")] = (
        None
    )
    up: Annotated[
        str | None, typer.Option(metavar="AXIS", help="x, y or z: upwards in the file, +y here; default y.")
    ] = None
    density: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of the grid of density; default density, else the first.")
    ] = None
    temperature: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of the grid of temperature; default temperature, if any.")
    ] = None
    trust: Trust = False
    device: Device = "cpu"

    def given(self) -> dict[str, Any]:
        """The options that differ from their defaults, but for those of any input."""
        names = [field.name for field in fields(self) if field.name not in ("device", "trust")]
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value != getattr(SmokeOptions, name)}

    def open(self, smoke: Path) -> "Frames":
        """Opens a volume or a folder of frames, on a device that there is."""
        from wlm.fluid.grids import UPS
        from wlm.interop import check_device
        from wlm.smoke.data import load_frames

        device = check_device(self.device)
        names = {"up": self.up, "density": self.density, "temperature": self.temperature}
        factors = {"extinction": self.extinction, "emission": self.emission}
        if self.up is not None and self.up not in UPS:
            raise WlmError(f"--up: expected one of {', '.join(UPS)}, got {self.up!r}")
        return load_frames(smoke, **factors, **names, trust=self.trust or None, device=device)

    def camera(self, frames: "Frames", *, orthographic: bool = True, perspective: bool = False) -> "CameraSettings":
        """The scene's camera, or the default one, changed by the options.

        Raises:
            WlmError: An option is out of its range, or lightmaps are to be made in perspective.
        """
        from wlm.config import check_settings
        from wlm.smoke.scene import CameraSettings

        names = ("resolution", "toward", "extent", "distance")
        changes = {name: value for name, value in self.given().items() if name in names}
        if self.toward is not None:
            changes["toward"] = vector("--toward", self.toward)
        if perspective:
            changes["perspective"] = True
        settings = check_settings(CameraSettings, frames.camera.model_dump() | changes, "--").turned(self.turn)
        if orthographic and settings.perspective:
            raise WlmError(f"{frames.path}: camera.perspective: expected false for six-way lightmaps, found true")
        return settings


def with_smoke(command: Callable[..., None]) -> Callable[..., None]:
    """Gives a command the options of `SmokeOptions`, which it takes as its parameter `options`."""
    signature = inspect.signature(command)
    names = [field.name for field in fields(SmokeOptions)]

    @functools.wraps(command)
    def run(**values: Any) -> None:
        command(options=SmokeOptions(**{name: values.pop(name) for name in names}), **values)

    own = [parameter for name, parameter in signature.parameters.items() if name != "options"]
    shared = [
        inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type)
        for field in fields(SmokeOptions)
    ]
    # typer reads both.
    run.__signature__ = signature.replace(parameters=[*own, *shared])  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *shared)}
    return run


def vector(option: str, text: str) -> tuple[float, float, float]:
    """Three finite numbers of an option's text."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise WlmError(f"{option}: expected three numbers such as 0,0.5,1, got {text!r}") from None
    if not all(abs(value) < float("inf") for value in (x, y, z)):
        raise WlmError(f"{option}: expected finite numbers, got {text!r}")
    return x, y, z


def given_albedo(text: str | None) -> tuple[float, float, float] | None:
    """The numbers of `--albedo`, one for all colours or three; None: it isn't given."""
    if text is None:
        return None
    values = vector("--albedo", text if "," in text else ",".join([text] * 3))
    if not all(0 <= value <= 1 for value in values):
        raise WlmError(f"--albedo: expected numbers of 0 to 1, got {text!r}")
    return values


def outputs(smoke: Path, single: bool, output: Path, stem: str, suffix: str) -> Callable[[int], Path]:
    """Checks where results go, a file or for frames a folder; returns the file of a frame, ready to be written."""
    from wlm.smoke.data import NumberedFiles

    if single:
        check_output(output, suffix)
        return lambda number: output
    _check_folder(smoke, output)
    return NumberedFiles(output, stem, suffix, SHEET).file


def _check_folder(smoke: Path, output: Path) -> None:
    if output.resolve() == smoke.resolve():
        raise WlmError(f"{output}: expected another folder than that of the frames")


def place_and_colour(option: str, text: str) -> list[tuple[float, float, float]]:
    """The numbers of `X,Y,Z[:R,G,B]`, or of `X,Y,Z[:E]` for a white light: one or two triples, not checked.

    Raises:
        WlmError: They aren't numbers.
    """
    place, colon, colour = text.partition(":")
    values = [vector(option, place)]
    if colon:
        values.append(vector(option, colour if "," in colour else ",".join([colour] * 3)))
    return values


def march_frames(
    frames: "Frames",
    camera: "CameraSettings",
    output: Path,
    stem: str,
    make: "Callable[[int, Callable[[], Path], DensityVolume, Camera], None]",
    settings: dict[str, Any],
    *,
    resume: bool,
) -> None:
    """Makes an EXR of each frame.

    Args:
        frames: The smoke.
        camera: Before each frame.
        output: A file, or for frames a folder.
        stem: Of the folder's files.
        make: Makes one, of a frame's number, a volume and a camera; it gets the path from a function when there is
            something to write.
        settings: What results depend on beside smoke and camera, as JSON values.
        resume: Whether to leave out the frames that an interrupted run of the same settings has made.
    """
    from wlm.smoke.data import NumberedFiles

    if frames.single:
        if resume:
            raise WlmError(f"--resume: expected a folder of frames, {frames.path} is one volume")
        check_output(output, ".exr")
        file, numbers, partial = (lambda number: output), frames.numbers, None
    else:
        _check_folder(frames.path, output)
        smoke = {"extinction": frames.extinction, "emission": frames.emission, "device": frames.device[:4]}
        scene = dict(frames.options) if frames.scene is None else frames.scene.model_dump(mode="json")
        views = {"scene": scene, "camera": camera.model_dump(mode="json")}
        files = NumberedFiles(output, stem, ".exr", SHEET, run=settings | smoke | views, resume=resume)
        file, numbers, partial = files.file, [each for each in frames.numbers if each not in files.done], files.partial
        if resume:
            done = len(files.done)
            note(f"{output}: {done} frames are there" if done else f"{partial}: there is nothing to resume")
    with running(stem, partial, "frame", whole=False) as progress:
        for frame, volume in frames.volumes(numbers, progress):
            for warning in volume.warnings:
                note(f"warning: {warning}")
            make(frame, functools.partial(file, frame), volume, frames.view(camera, volume))
    if partial is not None:
        files.finish()


def write_lightmaps(
    frames: "Frames",
    camera: "CameraSettings",
    output: Path,
    make: "Callable[[DensityVolume, Camera], SixWay]",
    settings: dict[str, Any],
    *,
    resume: bool,
    errors: bool = False,
) -> None:
    """Makes lightmaps of each frame, writes them and shows a table; notes lightmaps that aren't bright where named.

    Args:
        frames: The smoke.
        camera: Before each.
        output: A file, or for frames a folder.
        make: Makes the lightmaps.
        settings, resume: As for `march_frames`; with an "albedo" that isn't None the lightmaps have it already.
        errors: Whether they come with the error of their step.
    """
    from wlm.smoke.camera import axis_faults
    from wlm.smoke.data import write_six_way
    from wlm.smoke.flipbook.shots import with_surface

    rows = table(str(frames.path), ["file", "covered", "mean light", *(["largest error", "RMS error"] * errors)])

    def write(frame: int, file: Callable[[], Path], volume: "DensityVolume", view: "Camera") -> None:
        looks = frames.looks(frame)
        if looks is not None and settings.get("albedo") is not None:
            looks = looks.model_copy(update={"albedo": (1.0, 1.0, 1.0)})
        six = with_surface(make(volume, view), volume, looks)
        path = file()
        write_six_way(path, six, looks)
        covered = six.transparency < 0.99
        for fault in axis_faults(six.lightmaps.cpu().numpy()) if covered.any() else ():
            note(f"{path}: note: {fault}")
        rows.add_row(
            escape(path.name),
            f"{float(covered.float().mean()):.1%}",
            number(float(six.lightmaps[:, covered].mean()) if covered.any() else None, ".4g"),
            *((f"{six.error.largest:.2g}", f"{six.error.rms:.2g}") if errors else ()),
        )

    march_frames(frames, camera, output, "six", write, settings, resume=resume)
    show(rows)
