"""Smoke in files: one volume or a folder of a scene's frames, guiding maps and lightmaps as EXR, numbered results.

A folder of a scene's frames holds `scene.json` and `frame_0001.npz`, `frame_0002.npz` and so on, each a volume as
`wlm.smoke.load` reads it. `simulate` writes it, and can be stopped and resumed. A folder of another program's frames
holds volumes whose names are alike but for a number before their suffix.
"""

import functools
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wlm import __version__
from wlm.config import check_settings
from wlm.errors import WlmError
from wlm.fluid.volume import SUFFIXES, DensityVolume, load_volume
from wlm.formats.atomic import atomic_write
from wlm.formats.exr import read_part, read_planes, write_planes
from wlm.formats.folder import claim, read_index, write_index
from wlm.formats.lock import is_passing
from wlm.smoke.camera import DIRECTIONS, EMISSION, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.coarse import Guide
from wlm.smoke.scene import CameraSettings, Looks, Scene, make_camera
from wlm.system import Meter, OnProgress

SCENE_FILE = "scene.json"
CHECKPOINT = "simulation.partial"
"""In the folder of frames, as long as the simulation isn't done."""

# The name of every system's reader.
load = load_volume

_FORMAT, _VERSION = "wlm-smoke-frames", 1
_NUMBERED = re.compile(r"(.*?)(\d{1,9})(\.[^.\d]+)")  # what is before the last number, it, and the suffix
_TRANSPARENCY = "transparency"
_DEPTH = "depth"
_GUIDE = ("light", _TRANSPARENCY, _DEPTH)


@dataclass(frozen=True)
class Frames:
    """Smoke over time, one volume in memory at a time: the file of a single volume, or a folder of frames.

    Attributes:
        path: The file or the folder.
        scene: Of a folder that `simulate` wrote; None: a single volume, or another program's frames.
        files: Those that are there, by their rising number; that of a single volume is 1.
        device: Where volumes go.
        extinction, emission: In place of the scene's, or of 1; None: those.
        options: Of `load` for files of other programs: trust, up, density, temperature.
    """

    path: Path
    scene: Scene | None
    files: Mapping[int, Path]
    device: str = "cpu"
    extinction: float | None = None
    emission: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def single(self) -> bool:
        """Whether it is one file and not a folder."""
        return self.files.get(1) == self.path

    @property
    def numbers(self) -> tuple[int, ...]:
        """Of the frames that are there, rising."""
        return tuple(self.files)

    @property
    def camera(self) -> CameraSettings:
        """The scene's camera, or the default one."""
        return CameraSettings() if self.scene is None else self.scene.camera

    def view(self, settings: CameraSettings, volume: DensityVolume) -> Camera:
        """Places a camera before a frame: that of a sequence stays where it is, before the boxes of all frames.

        Raises:
            WlmError: A frame is missing or damaged.
        """
        box = (volume.origin, volume.size) if self.scene is not None or self.single else self._box
        return make_camera(settings, *box)

    @functools.cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        """The corner and the edges of the boxes of all frames together, which are read for it."""
        boxes = []
        for number in self.files:
            volume = replace(self, device="cpu").load(number)
            begin = np.asarray(volume.origin)
            boxes.append((bool(volume.density.any()), begin, begin + volume.size))
        # A frame without smoke may have its box anywhere.
        smoky = [box for box in boxes if box[0]] or boxes
        low = np.min([box[1] for box in smoky], axis=0)
        return low, np.max([box[2] for box in smoky], axis=0) - low

    def file(self, number: int) -> Path:
        """The file of a frame, which `simulate` may yet have to write."""
        return self.files.get(number, self.path / f"frame_{number:04d}.npz")

    def time(self, number: int) -> float:
        """The time of a frame in seconds; 0 without a scene."""
        return 0.0 if self.scene is None else self.scene.time(number)

    def looks(self, number: int) -> Looks | None:
        """What a picture of a frame shows; None without a scene."""
        return None if self.scene is None else self.scene.looks(number)

    def load(self, number: int) -> DensityVolume:
        """Reads a frame.

        Raises:
            WlmError: It is missing or damaged.
        """
        smoke = None if self.scene is None else self.scene.smoke
        factors = {}
        for name in ("extinction", "emission"):
            override = getattr(self, name)
            factors[name] = override if override is not None else getattr(smoke, name, 1.0)
        return load_volume(self.file(number), **factors, device=self.device, **self.options)

    def volumes(
        self, numbers: Sequence[int] | None = None, progress: OnProgress | None = None
    ) -> Iterator[tuple[int, DensityVolume]]:
        """Yields frames with their numbers; `progress` is called after each has been dealt with.

        Raises:
            WlmError: A frame is missing or damaged.
        """
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
    """Opens a volume, or a folder of frames: of `simulate`, or of volumes that another program numbered.

    Args:
        path: The file or the folder.
        extinction, emission, device: As in `Frames`.
        options: As in `Frames`; those that are None aren't given.

    Raises:
        WlmError: A folder without frames, of several sequences, or with a damaged `scene.json`; frames of `simulate`
            need no option but trust.
    """
    path = Path(path)
    options = {name: value for name, value in options.items() if value is not None}
    given = (device, extinction, emission, options)
    if not path.is_dir():
        return Frames(path, None, {1: path}, *given)
    if not (path / SCENE_FILE).is_file():
        return Frames(path, None, _sequence(path), *given)
    if (name := next((name for name in options if name != "trust"), None)) is not None:
        raise WlmError(f"{path}: expected no {name} for the frames of a scene")
    frames = Frames(path, _read_scene(path), numbered(path, "frame", ".npz"), *given)
    if not frames.files:
        raise WlmError(f"{path}: expected frames such as {frames.file(1).name}, found none")
    return frames


def _sequence(folder: Path) -> dict[int, Path]:
    """The volumes of a folder by the last number in their names, which are alike but for it.

    Raises:
        WlmError: It has none, those of several sequences, or two of one number.
    """
    found: dict[tuple[str, str], dict[int, Path]] = {}
    for path in sorted(folder.iterdir()):
        match = _NUMBERED.fullmatch(path.name)
        if match and match[3].lower() in SUFFIXES and path.is_file():
            files = found.setdefault((match[1], match[3]), {})
            number = int(match[2])
            if number in files:
                raise WlmError(
                    f"{folder}: expected frames of different numbers, found {files[number].name}, {path.name}"
                )
            files[number] = path
    if len(found) != 1:
        kinds = ", ".join(f"{stem}*{suffix}" for stem, suffix in found) or f"neither {SCENE_FILE} nor any"
        raise WlmError(
            f"{folder}: expected a folder of simulate, or one sequence of volumes such as smoke_0001.vdb, found {kinds}"
        )
    return dict(sorted(next(iter(found.values())).items()))


def open_frames(folder: str | os.PathLike[str], scene: Scene, *, resume: bool = False) -> Frames:
    """Prepares a folder for a simulation's frames.

    Frames appear one by one beside the checkpoint, so they aren't staged as `wlm.formats.folder` does for files that
    are only of use together.

    Args:
        folder: Made if its parent is there.
        scene: The scene to simulate.
        resume: Whether to go on with a simulation of the same scene. Otherwise an earlier one's frames are removed.

    Raises:
        WlmError: It holds other files, is of another scene and is to be resumed, or can't be written.
    """
    folder = Path(folder)
    claim(folder, SCENE_FILE, _FORMAT)
    if resume and (folder / SCENE_FILE).is_file():
        earlier, later = _simulated(_read_scene(folder)), _simulated(scene)
        if (field := next((key for key in later if earlier.get(key) != later[key]), None)) is not None:
            raise WlmError(f"{folder}: frames of another scene, whose {field} differs; start anew without --resume")
    with _writing(folder):
        folder.mkdir(exist_ok=True)
        if not resume:
            earlier = [path for stem in ("frame", "velocity") for path in numbered(folder, stem, ".npz").values()]
            for path in (*earlier, folder / CHECKPOINT):
                path.unlink(missing_ok=True)
    content = {"format": _FORMAT, "version": _VERSION, "scene": scene.model_dump(mode="json")}
    atomic_write(folder / SCENE_FILE, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    return Frames(folder, scene, numbered(folder, "frame", ".npz"))


def numbered(folder: Path, stem: str, suffix: str) -> dict[int, Path]:
    """Files such as `six_0001.exr`, by their rising number."""
    pattern = re.compile(rf"{re.escape(stem)}_(\d+){re.escape(suffix)}")
    files = {int(match[1]): path for path in folder.iterdir() if (match := pattern.fullmatch(path.name))}
    return dict(sorted(files.items()))


def spread(numbers: Sequence[int], count: int | None) -> tuple[int, ...]:
    """At most `count` of some frames, evenly spread, the first and the last among them; None: all."""
    if count is None or count >= len(numbers):
        return tuple(numbers)
    last = len(numbers) - 1
    return tuple(numbers[round(i * last / max(count - 1, 1))] for i in range(count))


class NumberedFiles:
    """A run's results in a folder, one file per frame, in place of those of an earlier run.

    The earlier files are removed when the first new one is about to be written: a run that fails before loses none.
    Each file is of use by itself, so there is no index, and nothing is staged. As long as it isn't done, a run that can
    be resumed says in `STEM.partial` what it is.

    Attributes:
        folder: The folder.
        partial: The file that says what an unfinished run is.
        done: Numbers of the results that the run which is resumed has already.
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
        """Makes the folder, or checks that it holds nothing but files of an earlier run.

        Args:
            folder: Made if its parent is there.
            stem, suffix: Of the files, as for `numbered`.
            others: Names of files that such a run writes beside them.
            run: What the results depend on, as JSON values; None: such a run isn't resumed.
            resume: Whether to keep the files of an interrupted run, if there was one.

        Raises:
            WlmError: It holds other files, can't be written, or is of a run that depends on something else.
        """
        self.folder, self._stem, self._suffix, self._others = Path(folder), stem, suffix, others
        self._cleared = False
        self.done: frozenset[int] = frozenset()
        self.partial = self.folder / f"{stem}.partial"
        # Compared with what JSON gives back, which has no tuples.
        self._run = None if run is None else json.loads(json.dumps({**run, "wlm": __version__}))
        with _writing(self.folder):
            self.folder.mkdir(exist_ok=True)
            earlier = self._earlier()
            others = (path for path in sorted(self.folder.iterdir()) if path not in earlier)
            foreign = next((path for path in others if not is_passing(path.name)), None)
        if foreign is not None:
            raise WlmError(f"{folder}: expected an empty folder or one of an earlier run, found {foreign.name}")
        if resume and self.partial.is_file():
            earlier = read_index(self.partial)
            if (field := next((key for key in self._run if earlier.get(key) != self._run[key]), None)) is not None:
                raise WlmError(f"{self.partial}: of another run, whose {field} differs; start anew without --resume")
            self._cleared = True
            self.done = frozenset(numbered(self.folder, stem, suffix))

    def finish(self) -> None:
        """Ends the run: there is nothing to resume."""
        with _writing(self.folder):
            self.partial.unlink(missing_ok=True)

    def file(self, number: int) -> Path:
        """The file for a frame's result, which is ready to be written.

        Raises:
            WlmError: The earlier files can't be removed.
        """
        if not self._cleared:
            with _writing(self.folder):
                for path in self._earlier():
                    path.unlink(missing_ok=True)
            if self._run is not None:
                write_index(self.partial, self._run)
            self._cleared = True
        return self.folder / f"{self._stem}_{number:04d}{self._suffix}"

    def _earlier(self) -> list[Path]:
        files = numbered(self.folder, self._stem, self._suffix).values()
        return [*files, self.partial, *(self.folder / name for name in self._others)]


def write_guide(path: str | os.PathLike[str], guide: Guide) -> None:
    """Writes a guiding map as an EXR of the channels light, transparency and depth, all float32.

    Raises:
        WlmError: The file can't be written.
    """
    planes = dict(zip(_GUIDE, guide.maps.cpu().numpy(), strict=True))
    write_planes(path, planes, {"camera": asdict(guide.camera)}, whole=_GUIDE)


def write_six_way(path: str | os.PathLike[str], six: SixWay, looks: Looks | None = None) -> None:
    """Writes lightmaps as an EXR of half floats: a channel for each direction, `transparency`, of hot smoke `emission`,
    and where it is known the surface's `depth`, a float; the camera and the looks are in its header.

    Raises:
        ValueError: The camera isn't known.
        WlmError: The file can't be written.
    """
    if six.camera is None:
        raise ValueError("camera: expected that of the lightmaps, found none")
    planes = dict(zip(DIRECTIONS, six.lightmaps.cpu().numpy(), strict=True))
    for name, plane in ((_TRANSPARENCY, six.transparency), (EMISSION, six.emission), (_DEPTH, six.depth)):
        if plane is not None:
            planes[name] = plane.cpu().numpy()
    note = {"camera": asdict(six.camera)} | ({} if looks is None else {"looks": looks.model_dump(mode="json")})
    write_planes(path, planes, note, whole=(_DEPTH,))


def is_six_way(path: Path) -> bool:
    """Whether a file is an EXR with a channel for each direction.

    Raises:
        WlmError: It is called an EXR and can't be read.
    """
    if path.suffix.lower() != ".exr" or not path.is_file():
        return False
    return all(name in read_part(path).channels for name in DIRECTIONS)


def six_way_files(folder: Path) -> list[Path]:
    """The six-way lightmaps in a folder, one a frame, by name; empty where its EXR files are something else.

    Raises:
        WlmError: The first EXR file can't be read.
    """
    files = sorted(path for path in folder.glob("*.exr") if path.name[0] != ".")
    return files if files and is_six_way(files[0]) else []


def read_six_way(path: str | os.PathLike[str], device: str = "cpu") -> SixWay:
    """Reads the lightmaps of a file of `write_six_way`.

    Raises:
        WlmError: The file is missing or damaged, lacks a channel or its camera, or holds a number that isn't finite.
    """
    return read_shaded(path, device)[0]


def read_shaded(path: str | os.PathLike[str], device: str = "cpu") -> tuple[SixWay, Looks | None]:
    """Reads what `write_six_way` wrote: the lightmaps, and the looks that were given with them.

    Raises:
        WlmError: As `read_six_way`, or the looks are wrong.
    """
    planes, note = read_planes(path)
    for name in (*DIRECTIONS, _TRANSPARENCY):
        if name not in planes:
            raise WlmError(f"{path}: channel {name}: expected it beside {', '.join(planes)}; is it of bake?")
    for name, plane in planes.items():
        if not np.isfinite(plane).all():
            raise WlmError(f"{path}: channel {name}: expected finite numbers, found NaN or infinity")
    try:
        # JSON has lists for tuples.
        fields = {key: tuple(value) if isinstance(value, list) else value for key, value in note["camera"].items()}
        camera = Camera(**fields)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise WlmError(f"{path}: header attribute wlm: camera: expected that of bake: {error}") from error
    size = next(iter(planes.values())).shape
    if size != (camera.height, camera.width):
        raise WlmError(f"{path}: expected the camera's {camera.height} x {camera.width} pixels, found {size}")
    tensors = {name: torch.from_numpy(plane).to(device) for name, plane in planes.items()}
    lightmaps = torch.stack([tensors[name] for name in DIRECTIONS])
    six = SixWay(lightmaps, tensors[_TRANSPARENCY], tensors.get(EMISSION), camera, tensors.get(_DEPTH))
    if "looks" not in note:
        return six, None
    return six, check_settings(Looks, note["looks"], f"{path}: header attribute wlm: looks.")


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Turns errors of the file system into one line that names the folder."""
    try:
        yield
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error


def _read_scene(folder: Path) -> Scene:
    path = folder / SCENE_FILE
    content = read_index(path)
    if content.get("format") != _FORMAT:
        raise WlmError(f"{path}: expected the scene of a simulation's frames, found other content")
    if content.get("version") != _VERSION:
        raise WlmError(f"{path}: version: expected {_VERSION}, found {content.get('version')}")
    return check_settings(Scene, content.get("scene"), f"{path}: scene.")


def _simulated(scene: Scene) -> dict[str, Any]:
    """The settings that a simulation's frames depend on: neither their number nor those of pictures."""
    appearance = {"smoke": {"extinction", "glow"}, "obstacles": {"__all__": {"colour"}}}
    others = dict.fromkeys(("name", "frames", "camera", "lights", "background"), True)
    return json.loads(scene.model_dump_json(exclude=others | appearance))
