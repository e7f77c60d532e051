"""Files of smoke: volumes, folders of frames, six-way lightmaps as EXR, and numbered results.

The folder of a simulated scene contains `scene.json` and `frame_0001.npz`, `frame_0002.npz` and so on, each a volume
that `wlm.smoke.load` reads. `simulate` writes it, and can be stopped and resumed. A folder of another program's frames
contains volumes whose names differ in a number only.
"""

import functools
import itertools
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wlm import __version__
from wlm.config import check_settings
from wlm.errors import WlmError
from wlm.fluid.grids import choose
from wlm.fluid.volume import SUFFIXES, DensityVolume, from_array, grid_heads, load_volume
from wlm.formats.atomic import atomic_write
from wlm.formats.compact import digest
from wlm.formats.exr import read_header, read_planes, write_planes
from wlm.formats.exr_header import check_header
from wlm.formats.folder import claim, read_index, write_index
from wlm.formats.lock import is_passing
from wlm.formats.reading import system_errors
from wlm.smoke.camera import DIRECTIONS, EMISSION, Camera
from wlm.smoke.flipbook.naming import six_way_channels
from wlm.smoke.flipbook.reading import NOTE, read_flipbook
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import CameraSettings, Looks, ObstacleSettings, Scene, SourceSettings, make_camera
from wlm.system import Meter, OnProgress

SCENE_FILE = "scene.json"
CHECKPOINT = "simulation.partial"
"""File in the folder of frames while the simulation is not finished."""

# Every system's reader has this name.
load = load_volume

_FORMAT, _VERSION = "wlm-smoke-frames", 1
# A number in a file name, with its sign: a minus that follows no word.
_NUMBER = re.compile(r"((?<![^._ -])-(?=\d)|(?<!\d))(\d{1,9})(?!\d)")
_PLACES = 65  # on a path, by which obstacles of two scenes are compared
_TRANSPARENCY = "transparency"
_DEPTH = "depth"


@dataclass(frozen=True)
class Frames:
    """Smoke over time, with one volume in memory at a time: a single file, or a folder of frames, by number in rising
    order.

    `scene` is that of a folder that `simulate` wrote; None: a single volume, number 1, or another program's frames.
    `extinction` and `emission` replace the scene's; None: the scene's, or 1 without a scene. `options` are those of
    `load` for the files of other programs, and `warnings` the assumptions about these, one line each.
    """

    path: Path
    scene: Scene | None
    files: Mapping[int, Path]
    device: str = "cpu"
    extinction: float | None = None
    emission: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def single(self) -> bool:
        """Whether `path` is a single file instead of a folder."""
        return self.files.get(1) == self.path

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the existing frames, in rising order."""
        return tuple(self.files)

    @property
    def camera(self) -> CameraSettings:
        """The scene's camera, or the default camera."""
        return CameraSettings() if self.scene is None else self.scene.camera

    def view(self, settings: CameraSettings, volume: DensityVolume) -> Camera:
        """Places a camera in front of a frame; in a sequence it rests, and looks at the box around all frames."""
        box = (volume.origin, volume.size) if self.scene is not None or self.single else self._survey[:2]
        return make_camera(settings, *box)

    @functools.cached_property
    def _survey(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Lowest corner [3] and edges [3] of the bounding box of all frames with smoke, and whether a frame is in
        kelvin, so that all are; every file is read for it."""
        boxes, kelvin = [], False
        for number in self.files:
            volume = replace(self, device="cpu", options={"kelvin": None, **self.options}).load(number)
            kelvin |= volume.kelvin
            begin = np.asarray(volume.origin)
            boxes.append((bool(volume.density.any()), begin, begin + volume.size))
        # The box of a frame without smoke may be anywhere.
        smoky = [box for box in boxes if box[0]] or boxes
        low = np.min([box[1] for box in smoky], axis=0)
        return low, np.max([box[2] for box in smoky], axis=0) - low, kelvin

    @property
    def extinction_used(self) -> float:
        """Extinction per unit of length at density 1."""
        return self._factors["extinction"]

    @property
    def _factors(self) -> dict[str, float]:
        """Extinction and emission: those given, or the scene's, or 1."""
        smoke = None if self.scene is None else self.scene.smoke
        given = {name: getattr(self, name) for name in ("extinction", "emission")}
        return {name: getattr(smoke, name, 1.0) if value is None else value for name, value in given.items()}

    def file(self, number: int) -> Path:
        """Returns the file of a frame, which may not exist yet."""
        return self.files.get(number, self.path / f"frame_{number:04d}.npz")

    def time(self, number: int) -> float:
        """Returns the time of a frame in seconds; 0 without a scene."""
        return 0.0 if self.scene is None else self.scene.time(number)

    def looks(self, number: int) -> Looks | None:
        """Returns the lights, colours and obstacles with which a frame is rendered; None without a scene."""
        return None if self.scene is None else self.scene.looks(number)

    def _refuse_kelvin(self) -> None:
        if self.options.get("kelvin"):
            raise WlmError(f"{self.path}: kelvin: expected temperatures, whose unit it is, found none")

    def load(self, number: int) -> DensityVolume:
        """Reads the volume of a frame."""
        factors = self._factors
        options = dict(self.options)
        if self.scene is not None and self.scene.smoke.fire is not None:
            options.setdefault("kelvin", True)
        if self.scene is not None or self.single:
            volume = load_volume(self.file(number), **factors, device=self.device, **options)
            if volume.temperature is None:
                self._refuse_kelvin()
            return volume
        if heads := grid_heads(self.file(number)):
            # All frames have the same grids; files from before the smoke or the fire may lack them.
            names = {head.name for head in heads}
            if options["density"] not in names:
                return from_array(np.zeros((1, 1, 1), np.float32), **factors, device=self.device)
            if options.get("temperature") not in names:
                options.pop("temperature", None)
        assumed = "kelvin" not in options and (not heads or "temperature" in options) and self._survey[2]
        if assumed:
            # A frame before the fire may have no temperature that tells the unit.
            options["kelvin"] = True
        volume = load_volume(self.file(number), **factors, device=self.device, **options)
        if assumed and number == self.numbers[0]:
            warning = f"{self.path}: temperatures are read as kelvins; --volume kelvin=no takes them for light"
            volume = replace(volume, warnings=(*volume.warnings, warning))
        return volume

    def volumes(
        self, numbers: Sequence[int] | None = None, progress: OnProgress | None = None
    ) -> Iterator[tuple[int, DensityVolume]]:
        """Yields the number and the volume of each frame; calls `progress` when the caller has processed a frame."""
        numbers = self.numbers if numbers is None else numbers
        meter = Meter(progress, "frames", len(numbers))
        for done, number in enumerate(numbers, 1):
            yield number, self.load(number)
            meter.report(done)


def load_frames(
    path: str | os.PathLike[str],
    *,
    extinction: float | None = None,
    emission: float | None = None,
    device: str = "cpu",
    **options: Any,
) -> Frames:
    """Opens a volume, a folder of frames that `simulate` wrote, or a folder of numbered volumes of another program.

    Args:
        path: The file or the folder.
        extinction, emission, device: As in `Frames`.
        options: As in `Frames`; None values are ignored.

    Raises:
        WlmError: The folder has no frames, frames of several sequences, or a damaged `scene.json`; or an option other
            than `trust` is given for frames that `simulate` wrote.
    """
    path = Path(path)
    options = {name: value for name, value in options.items() if value is not None}
    given = (device, extinction, emission, options)
    if not path.is_dir():
        return Frames(path, None, {1: path}, *given)
    if not (path / SCENE_FILE).is_file():
        return _frames_of_others(path, *given)
    if (name := next((name for name in options if name != "trust"), None)) is not None:
        raise WlmError(
            f"{path}: option {name}: applies only to files of other programs, not to frames of wlm smoke simulate"
        )
    frames = Frames(path, _read_scene(path), numbered(path, "frame", ".npz"), *given)
    if not frames.files:
        raise WlmError(f"{path}: expected files of frames, such as {frames.file(1).name}, found none")
    return frames


def _frames_of_others(
    folder: Path, device: str, extinction: float | None, emission: float | None, options: dict
) -> Frames:
    """Opens a folder of another program's frames, with one choice of grids for all of them."""
    files, warnings = _sequence(folder)
    heads = {number: grid_heads(file) for number, file in files.items()}
    if some := list(dict.fromkeys(head for each in heads.values() for head in each)):
        density, hot, chosen = choose(str(folder), some, options.get("density"), options.get("temperature"))
        options = options | {"density": density} | ({} if hot is None else {"temperature": hot})
        without = [files[number].name for number, each in heads.items() if density not in {head.name for head in each}]
        if without:
            count = f"{len(without)} of {len(files)} frames"
            chosen.append(f"{folder}: {count} have no grid {density} and thus no smoke, the first is {without[0]}")
        warnings += chosen
    frames = Frames(folder, None, files, device, extinction, emission, options, tuple(warnings))
    if some and hot is None:
        frames._refuse_kelvin()
    return frames


def _sequence(folder: Path) -> tuple[dict[int, Path], list[str]]:
    """Returns a folder's volumes by the number in their names that differs between them, and warnings."""
    found: dict[tuple[str, ...], list[tuple[list[int], Path]]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in SUFFIXES and path.name[0] != "." and path.is_file():
            parts = _NUMBER.split(path.stem)
            if numbers := [int(sign + digits) for sign, digits in zip(parts[1::3], parts[2::3], strict=True)]:
                found.setdefault((*parts[::3], path.suffix), []).append((numbers, path))
    sequences = {}
    for texts, files in found.items():
        columns = list(zip(*(numbers for numbers, _ in files), strict=True))
        varying = [i for i, column in enumerate(columns) if len(set(column)) > 1] or [len(columns) - 1]
        shown = ["*" if i in varying else f"{column[0]}" for i, column in enumerate(columns)]
        name = "".join(f"{text}{number}" for text, number in zip(texts, [*shown, texts[-1]], strict=False))
        # Several numbers may differ, such as frame and time, if each of them sorts the files in the same way.
        orders = {
            tuple(sorted(range(len(files)), key=lambda i: (column[i], files[i][1].name)))
            for column in (columns[i] for i in varying)
            if len(varying) == 1 or len(set(column)) == len(column)
        }
        sequences[name] = (columns[varying[0]], files, orders)
    if len(sequences) != 1 or len(next(iter(sequences.values()))[2]) != 1:
        kinds = ", ".join(sequences) or f"neither {SCENE_FILE} nor any"
        raise WlmError(
            f"{folder}: expected frames of simulate, or one sequence of volumes such as smoke_0001.vdb, found {kinds}"
        )
    numbers, files, orders = next(iter(sequences.values()))
    ordered = [(numbers[i], files[i][1]) for i in next(iter(orders))]
    twice = next((pair for pair in itertools.pairwise(ordered) if pair[0][0] == pair[1][0]), None)
    if twice is None:
        return dict(ordered), []
    both = " and ".join(path.name for _, path in twice)
    warning = f"{folder}: {both} have the same number: the frames are numbered from 1 in the order of number and name"
    return dict(enumerate((path for _, path in ordered), 1)), [warning]


def open_frames(folder: str | os.PathLike[str], scene: Scene, *, resume: bool = False) -> Frames:
    """Prepares a folder for the frames of a simulation.

    Args:
        folder: The folder; created if its parent exists.
        scene: The scene to simulate.
        resume: Whether to continue a simulation of the same scene, in which only looks, accuracy, time steps and what
            happens after the finished frames may differ; otherwise frames of an earlier one are removed.

    Raises:
        WlmError: The folder contains other files, has frames of another scene although `resume` is set, or cannot be
            written.
    """
    folder = Path(folder)
    claim(folder, SCENE_FILE, _FORMAT)
    if resume and (folder / SCENE_FILE).is_file():
        until = scene.time(len(numbered(folder, "frame", ".npz")) + 1)
        earlier, later = _simulated(_read_scene(folder), until), _simulated(scene, until)
        if (field := next((key for key in later if earlier.get(key) != later[key]), None)) is not None:
            raise WlmError(
                f"{folder}: cannot resume: its frames have another {field} than the scene; start anew without --resume"
            )
    with system_errors(f"{folder}: cannot write into the folder"):
        folder.mkdir(exist_ok=True)
        if not resume:
            made = (path for suffix in SUFFIXES for path in numbered(folder, "frame", suffix).values())
            for path in (*made, folder / CHECKPOINT):
                path.unlink(missing_ok=True)
    content = {"format": _FORMAT, "version": _VERSION, "scene": scene.stored(folder)}
    atomic_write(folder / SCENE_FILE, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    return Frames(folder, scene, numbered(folder, "frame", ".npz"))


def numbered(folder: Path, stem: str, suffix: str) -> dict[int, Path]:
    """Returns a folder's files by number, in rising order: `six_0001.exr` has stem `six` and suffix `.exr`."""
    pattern = re.compile(rf"{re.escape(stem)}_(-?\d+){re.escape(suffix)}")
    files = {int(match[1]): path for path in folder.iterdir() if (match := pattern.fullmatch(path.name))}
    return dict(sorted(files.items()))


def spread(numbers: Sequence[int], count: int | None) -> tuple[int, ...]:
    """Returns at most `count` frame numbers, evenly spread from the first to the last; if `count` is None, all."""
    if count is None or count >= len(numbers):
        return tuple(numbers)
    last = len(numbers) - 1
    return tuple(numbers[round(i * last / max(count - 1, 1))] for i in range(count))


class NumberedFiles:
    """A folder of results with one file per frame, which replace the files of an earlier run.

    The files of the earlier run are removed when the first new file is about to be written, so that a run that fails
    before keeps them. Until a resumable run is finished, `STEM.partial` stores its settings. `done` are the numbers of
    the frames whose results exist already, if a run is resumed.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        stem: str,
        suffix: str,
        *others: str,
        run: Mapping[str, Any] | None = None,
        resume: bool = False,
    ) -> None:
        """Checks that the folder, whose parent must exist, can be made, or that an existing one contains only files of
        an earlier run. It is made for the first file; `stem` and `suffix` are as for `numbered`.

        A run may also write `others` into the folder. `run` are settings on which the results depend, as JSON values;
        None: the run cannot be resumed. `resume` keeps the files of an interrupted run.
        """
        self.folder, self._stem, self._suffix, self._others = Path(folder), stem, suffix, others
        self._cleared = False
        self.done: frozenset[int] = frozenset()
        self.partial = self.folder / f"{stem}.partial"
        # In JSON's types, which have no tuples, as they are read back.
        self._run = None if run is None else json.loads(json.dumps({**run, "wlm": __version__}))
        with system_errors(f"{self.folder}: cannot write into the folder"):
            made = not self.folder.exists()
            self.folder.mkdir(exist_ok=True)
            earlier = self._earlier()
            others = (path for path in sorted(self.folder.iterdir()) if path not in earlier)
            foreign = next((path for path in others if not is_passing(path.name)), None)
            if made:
                self.folder.rmdir()
        if foreign is not None:
            raise WlmError(f"{folder}: expected an empty folder or results of an earlier run, found {foreign.name}")
        if resume and self.partial.is_file():
            earlier = read_index(self.partial)
            if (field := next((key for key in self._run if earlier.get(key) != self._run[key]), None)) is not None:
                raise WlmError(
                    f"{self.partial}: cannot resume a run with another {field} than before; start anew without --resume"
                )
            self._cleared = True
            self.done = frozenset(numbered(self.folder, stem, suffix))

    def finish(self) -> None:
        """Ends the run: removes `partial`, so that the run can no longer be resumed."""
        with system_errors(f"{self.folder}: cannot write into the folder"):
            self.partial.unlink(missing_ok=True)

    def file(self, number: int) -> Path:
        """Returns the path of a frame's result; the first call makes the folder or removes an earlier run's files."""
        if not self._cleared:
            with system_errors(f"{self.folder}: cannot write into the folder"):
                self.folder.mkdir(exist_ok=True)
                for path in self._earlier():
                    path.unlink(missing_ok=True)
            if self._run is not None:
                write_index(self.partial, self._run)
            self._cleared = True
        return self.folder / f"{self._stem}_{number:04d}{self._suffix}"

    def _earlier(self) -> list[Path]:
        files = numbered(self.folder, self._stem, self._suffix).values()
        return [*files, self.partial, *(self.folder / name for name in self._others)]


def write_six_way(path: str | os.PathLike[str], six: SixWay, looks: Looks | None = None) -> None:
    """Writes six-way lightmaps as an EXR file: a half float channel per direction, `transparency`, `emission` of hot
    smoke, and `depth` as float32 if it is known. Its header stores the camera and `looks`: lights, colours, obstacles.

    Raises:
        ValueError: The camera is unknown.
        WlmError: The file cannot be written.
    """
    if six.camera is None:
        raise ValueError("camera: the lightmaps have no camera, which the file must store")
    planes = dict(zip(DIRECTIONS, six.lightmaps.cpu().numpy(), strict=True))
    for name, plane in ((_TRANSPARENCY, six.transparency), (EMISSION, six.emission), (_DEPTH, six.depth)):
        if plane is not None:
            planes[name] = plane.cpu().numpy()
    note = {"camera": asdict(six.camera)} | ({} if looks is None else {"looks": looks.stored(Path(path).parent)})
    write_planes(path, planes, note, whole=(_DEPTH,))


def is_six_way(path: Path) -> bool:
    """Returns whether a file is an EXR image with a channel, a layer or a part for each of the six directions."""
    if path.suffix.lower() != ".exr" or not path.is_file():
        return False
    return bool(six_way_channels(read_header(path)[2]))


def is_foreign(path: Path) -> bool:
    """Returns whether a file is an EXR image of six-way lightmaps of another program."""
    return is_six_way(path) and NOTE not in check_header(path)[0].attributes


def six_way_files(folder: Path) -> dict[int, Path]:
    """Returns the files of six-way lightmaps in a folder by frame number; empty if it has none."""
    if not folder.is_dir():
        return {}
    if files := numbered(folder, "six", ".exr"):
        return files
    others = [path for path in folder.glob("*.exr") if path.name[0] != "." and is_six_way(path)]
    stems = sorted({re.sub(r"\d+", "#", path.name) for path in others})
    if len(stems) > 1:
        raise WlmError(f"{folder}: expected six-way lightmaps of one sequence, found {', '.join(stems[:8])}")
    # Numbers in names are compared as numbers.
    others.sort(key=lambda path: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)])
    return dict(enumerate(others, 1))


def read_six_way(path: str | os.PathLike[str], device: str = "cpu") -> SixWay:
    """Reads six-way lightmaps from a file that `write_six_way` wrote.

    Raises:
        WlmError: The file is missing or damaged, lacks a channel or its camera, or has a number that is not finite.
    """
    return read_shaded(path, device)[0]


def read_shaded(
    path: str | os.PathLike[str], device: str = "cpu", notes: list[str] | None = None
) -> tuple[SixWay, Looks | None]:
    """Reads the lightmaps that `write_six_way` wrote and, if present, the scene's lights, colours and obstacles. A file
    of another program is read as by `read_flipbook`, which adds its assumptions to `notes`."""
    if is_foreign(Path(path)):
        (six,) = read_flipbook([path], notes=notes, device=device)
        return six, None
    planes, note = read_planes(path)
    for name in (*DIRECTIONS, _TRANSPARENCY):
        if name not in planes:
            raise WlmError(
                f"{path}: expected a channel {name}, as wlm smoke bake writes, found only {', '.join(planes)}"
            )
    for name, plane in planes.items():
        if not np.isfinite(plane).all():
            raise WlmError(f"{path}: channel {name}: expected finite numbers, found NaN or infinity")
    try:
        # JSON has lists instead of tuples.
        fields = {key: tuple(value) if isinstance(value, list) else value for key, value in note["camera"].items()}
        camera = Camera(**fields)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise WlmError(f"{path}: header attribute wlm: expected a camera, as wlm smoke bake writes: {error}") from error
    size = next(iter(planes.values())).shape
    if size != (camera.height, camera.width):
        raise WlmError(
            f"{path}: expected images of its camera's height and width, {camera.height} x {camera.width} pixels, found "
            f"{size[0]} x {size[1]}"
        )
    tensors = {name: torch.from_numpy(plane).to(device) for name, plane in planes.items()}
    lightmaps = torch.stack([tensors[name] for name in DIRECTIONS])
    six = SixWay(lightmaps, tensors[_TRANSPARENCY], tensors.get(EMISSION), camera, tensors.get(_DEPTH))
    if "looks" not in note:
        return six, None
    return six, check_settings(Looks, note["looks"], f"{path}: header attribute wlm: looks.", folder=Path(path).parent)


def _read_scene(folder: Path) -> Scene:
    path = folder / SCENE_FILE
    content = read_index(path)
    if content.get("format") != _FORMAT:
        raise WlmError(f"{path}: expected a scene file that simulate wrote, found other content")
    if content.get("version") != _VERSION:
        raise WlmError(f"{path}: file version: expected {_VERSION}, found {content.get('version')}")
    return check_settings(Scene, content.get("scene"), f"{path}: scene.", folder=folder)


def _simulated(scene: Scene, until: float) -> dict[str, Any]:
    """Returns the settings on which the smoke up to a time in seconds depends, by their names; but not those that only
    change the accuracy of the flow or the looks."""
    free = {
        "smoke": {"extinction", "albedo", "glow", "scheme", "bricks"},
        "air": {"speed", "lattice_speed", "smagorinsky"},
    }
    others = dict.fromkeys(("name", "frames", "camera", "lights", "background", "obstacles", "sources"), True)
    settings = json.loads(scene.model_dump_json(exclude=others | free))
    settings["sources"] = [
        _moved(each, scene, until)
        + [each.density, each.temperature, each.fuel, each.noise]
        + [(start, None if stop is None or stop >= until else stop) for start, stop in each.spans if start < until]
        for each in scene.sources
        if min(start for start, _ in each.spans) < until
    ]
    settings["obstacles"] = [_moved(each, scene, until) for each in scene.obstacles]
    smoke, air = settings.pop("smoke"), settings.pop("air")
    return settings | {f"smoke.{k}": v for k, v in smoke.items()} | {f"air.{k}": v for k, v in air.items()}


def _moved(body: ObstacleSettings | SourceSettings, scene: Scene, until: float) -> list[Any]:
    """Returns the form of a body, that of a mesh by its file's content, and its poses up to a time in seconds."""
    poses = [
        np.append(body.eased.at(time) / scene.grid.cell, body.eased.turn(time))
        for time in np.linspace(0.0, until, _PLACES)
    ]
    return [digest(*body.mesh()), body.shell, np.round(poses, 6).tolist()]
