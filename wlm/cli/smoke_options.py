"""What the commands of `wlm smoke` share: options, smoke to be opened, cameras, and lightmaps on their way to files."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from wlm.cli.console import check_output, escape, note, number, progress_bar, show, table
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.baking import SixWay
    from wlm.smoke.camera import Camera
    from wlm.smoke.data import Footage

__all__ = [
    "SHEET",
    "Device",
    "Distance",
    "Emission",
    "Extent",
    "Extinction",
    "Input",
    "Resolution",
    "Toward",
    "Turn",
    "camera_of",
    "cleared",
    "load",
    "made_of",
    "open_smoke",
    "places",
    "vector",
    "volumes",
    "write_lightmaps",
]

Input = Annotated[Path, typer.Argument(metavar="SMOKE", help="A .npz or .nvdb volume, or a folder of simulate.")]
Device = Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')]
Resolution = Annotated[
    int | None, typer.Option(min=1, max=16384, help="Pixels along the image's height; default the scene's, or 512.")
]
Toward = Annotated[
    str | None, typer.Option(metavar="X,Y,Z", help="From the smoke to the camera; default the scene's, or 0,0,1.")
]
Turn = Annotated[float, typer.Option(help="Degrees by which the camera is turned about what is up.")]
Extent = Annotated[float | None, typer.Option(help="Height of the image in the world; default what holds the box.")]
Distance = Annotated[
    float | None, typer.Option(help="Of the camera from its target; what is behind it isn't seen. Default outside.")
]
Extinction = Annotated[float | None, typer.Option(help="Per length, of density 1; default the scene's, or 1.")]
Emission = Annotated[float | None, typer.Option(help="Per length, of temperature 1; default the scene's, or 1.")]

SHEET = "sheet.png"

_T = TypeVar("_T")


def vector(option: str, text: str) -> tuple[float, float, float]:
    """Three finite numbers of an option's text."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise WlmError(f"{option}: expected three numbers such as 0,0.5,1, got {text!r}") from None
    if not all(abs(value) < float("inf") for value in (x, y, z)):
        raise WlmError(f"{option}: expected finite numbers, got {text!r}")
    return x, y, z


def made_of(cls: Any, values: dict[str, Any], options: dict[str, str]) -> Any:
    """Checks settings that options gave, and names the option that is wrong."""
    from pydantic import ValidationError

    try:
        return cls(**values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        field = str(problem["loc"][0]) if problem["loc"] else "settings"
        expected = problem["msg"].replace("Input should be", "expected", 1)
        raise WlmError(f"{options.get(field, '--' + field)}: {expected}, got {problem['input']}") from error


def open_smoke(smoke: Path, extinction: float | None, emission: float | None, device: str) -> "Footage":
    """A volume or a folder of frames, on a device that there is."""
    from wlm.interop import check_device
    from wlm.smoke.data import open_footage

    return open_footage(smoke, extinction=extinction, emission=emission, device=check_device(device))


def places(smoke: Path, numbers: "tuple[int, ...]", single: bool, output: Path, stem: str, suffix: str) -> list[Path]:
    """Where each frame goes: into a file, or numbered into a folder, which is looked at and not changed yet."""
    from wlm.smoke.data import check_folder

    if single:
        check_output(output, suffix)
        return [output]
    if output.resolve() == smoke.resolve():
        raise WlmError(f"{output}: expected another folder than that of the frames")
    folder = check_folder(output, stem, suffix, SHEET)
    return [folder / f"{stem}_{number:04d}{suffix}" for number in numbers]


def cleared(results: Iterator[_T], single: bool, output: Path, stem: str, suffix: str) -> Iterator[_T]:
    """The same results; what an earlier run left in the folder goes when the first is there, and not before."""
    from wlm.smoke.data import clear_folder

    for done, result in enumerate(results):
        if done == 0 and not single:
            clear_folder(output, stem, suffix, SHEET)
        yield result


def volumes(
    footage: "Footage", output: Path, stem: str, suffix: str, view: dict[str, Any], *, flat: bool = False
) -> "Iterator[tuple[Path, DensityVolume, Camera]]":
    """Volumes with where their result goes and their camera; says what was repaired, and how far it is."""
    single = footage.scene is None
    paths = places(footage.path, footage.numbers, single, output, stem, suffix)

    def seen() -> "Iterator[tuple[Path, DensityVolume, Camera]]":
        with progress_bar(stem) as bar:
            for done, (path, frame) in enumerate(zip(paths, footage.numbers, strict=True), 1):
                volume = load(footage, frame)
                yield path, volume, camera_of(footage, volume, view, flat=flat)
                bar(done, len(paths), "")

    return cleared(seen(), single, output, stem, suffix)


def load(footage: "Footage", frame: int) -> "DensityVolume":
    """Reads a frame, and says what was repaired in it."""
    volume = footage.load(frame)
    for warning in volume.warnings:
        note(f"warning: {warning}")
    return volume


def camera_of(footage: "Footage", volume: "DensityVolume", view: dict[str, Any], *, flat: bool = False) -> "Camera":
    """The scene's camera, or one before the volume, as far as the options don't say otherwise."""
    import numpy as np

    from wlm.smoke.scene import CameraSettings, make_camera

    base = CameraSettings() if footage.scene is None else footage.scene.camera
    given = {name: value for name, value in view.items() if value is not None and name != "turn"}
    if "toward" in given:
        given["toward"] = vector("--toward", given["toward"])
    settings = made_of(CameraSettings, base.model_dump() | given, {}).turned(view["turn"])
    if flat and settings.perspective:
        raise WlmError(f"{footage.path}: camera.perspective: expected false for six-way lightmaps, found true")
    return make_camera(settings, volume.origin, volume.voxel * np.asarray(volume.shape))


def write_lightmaps(
    footage: "Footage",
    output: Path,
    view: dict[str, Any],
    make: "Callable[[DensityVolume, Camera], SixWay]",
    *,
    errors: bool = False,
) -> None:
    """Makes lightmaps of each volume, writes them and shows a table; says where they aren't what their names say.

    Args:
        footage: The smoke.
        output: As for `places`.
        view: Options of the camera.
        make: What makes them.
        errors: Whether they come with the error of their step.
    """
    from wlm.smoke.camera import axis_faults
    from wlm.smoke.data import write_six_way

    rows = table(str(footage.path), ["file", "covered", "mean light", *(["largest error", "RMS error"] * errors)])
    for path, volume, camera in volumes(footage, output, "six", ".exr", view, flat=True):
        six = make(volume, camera)
        write_six_way(path, six, camera)
        covered = six.transparency < 0.99
        for fault in axis_faults(six.lightmaps.cpu().numpy()) if covered.any() else ():
            note(f"{path}: note: {fault}")
        told = (f"{six.error.largest:.2g}", f"{six.error.rms:.2g}") if errors else ()
        rows.add_row(
            escape(path.name),
            f"{float(covered.float().mean()):.1%}",
            number(float(six.lightmaps[:, covered].mean()) if covered.any() else None, ".4g"),
            *told,
        )
    show(rows)
