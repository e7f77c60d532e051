"""What the commands read and leave: folders of frames with the scene they are of, and pictures of named channels.

A folder of frames holds `scene.json` and `frame_0001.npz`, `frame_0002.npz` and so on, each a volume as
`wlm.fluid.volume.load_volume` reads it. `simulate` writes it, and can be stopped and resumed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume, load_volume
from wlm.formats.atomic import atomic_write
from wlm.formats.exr_planes import read_planes, write_planes
from wlm.smoke.baking import SixWay
from wlm.smoke.camera import DIRECTIONS, EMISSION, Camera
from wlm.smoke.guide import Guide
from wlm.smoke.scene import Scene

__all__ = [
    "CHECKPOINT",
    "SCENE_FILE",
    "Footage",
    "Frames",
    "check_folder",
    "clear_folder",
    "frame_file",
    "numbered",
    "open_footage",
    "open_frames",
    "read_frames",
    "read_six_way",
    "write_guide",
    "write_six_way",
]

SCENE_FILE = "scene.json"
CHECKPOINT = "simulation.partial"
"""In the folder of frames, as long as the simulation isn't done."""

_FORMAT, _VERSION = "wlm-smoke-frames", 1
_FRAME = "frame"
_TRANSPARENCY = "transparency"
_GUIDE = ("light", _TRANSPARENCY, "depth")


@dataclass(frozen=True)
class Frames:
    """A folder of frames.

    Attributes:
        folder: Where.
        scene: What it is of.
        numbers: Of the frames that are there, rising from 1.
    """

    folder: Path
    scene: Scene
    numbers: tuple[int, ...]


def frame_file(number: int) -> str:
    """The name of a frame's file."""
    return f"{_FRAME}_{number:04d}.npz"


def numbered(folder: Path, stem: str, suffix: str) -> dict[int, Path]:
    """Files such as `six_0001.exr`, by their rising number."""
    pattern = re.compile(rf"{re.escape(stem)}_(\d+){re.escape(suffix)}")
    found = {int(match[1]): path for path in folder.iterdir() if (match := pattern.fullmatch(path.name))}
    return dict(sorted(found.items()))


def open_frames(folder: str | os.PathLike[str], scene: Scene, *, resume: bool = False) -> Frames:
    """Gets a folder ready for a simulation's frames.

    Args:
        folder: Where; it is made if its parent is there.
        scene: What is simulated.
        resume: Whether to go on with a simulation of the same scene. Otherwise an earlier one's frames are removed.

    Raises:
        WlmError: It holds other files, it is of another scene and is to be resumed, or it can't be written.
    """
    folder = Path(folder)
    ours = (folder / SCENE_FILE).is_file()
    try:
        if folder.exists() and not ours and any(folder.iterdir()):
            raise WlmError(f"{folder}: expected an empty folder or one of an earlier simulation, found other files")
        if ours and resume:
            earlier = read_frames(folder, needed=False)
            # More frames of the same scene are no other scene.
            if (field := _difference(_settings(earlier.scene), _settings(scene))) is not None:
                raise WlmError(f"{folder}: frames of another scene, whose {field} differs; start anew without --resume")
        elif ours:
            _read_scene(folder)
            for path in (*numbered(folder, _FRAME, ".npz").values(), folder / CHECKPOINT):
                path.unlink(missing_ok=True)
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
    content = {"format": _FORMAT, "version": _VERSION, "scene": scene.model_dump(mode="json")}
    atomic_write(folder / SCENE_FILE, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    return Frames(folder, scene, tuple(numbered(folder, _FRAME, ".npz")))


def read_frames(folder: str | os.PathLike[str], *, needed: bool = True) -> Frames:
    """Reads what a simulation left, but for the frames themselves.

    Args:
        folder: Where.
        needed: Whether a folder without frames is an error.

    Raises:
        WlmError: It isn't such a folder, `scene.json` is damaged, or there is no frame.
    """
    folder = Path(folder)
    if not (folder / SCENE_FILE).is_file():
        raise WlmError(f"{folder}: expected a folder that simulate wrote, found no {SCENE_FILE}")
    scene = _read_scene(folder)
    numbers = tuple(numbered(folder, _FRAME, ".npz"))
    if needed and not numbers:
        raise WlmError(f"{folder}: expected frames such as {frame_file(1)}, found none")
    return Frames(folder, scene, numbers)


@dataclass(frozen=True)
class Footage:
    """One volume or many frames, read one at a time.

    Attributes:
        path: The volume's file, or the folder.
        scene: Of frames; None: a single volume.
        numbers: Of the frames, (1,) of a single volume.
        device: Where volumes go.
        extinction, emission: In place of the scene's, or of 1; None: those.
    """

    path: Path
    scene: Scene | None
    numbers: tuple[int, ...]
    device: str = "cpu"
    extinction: float | None = None
    emission: float | None = None

    def load(self, number: int) -> DensityVolume:
        """Reads a frame.

        Raises:
            WlmError: It is missing or damaged.
        """
        path = self.path if self.scene is None else self.path / frame_file(number)
        smoke = self.scene.smoke if self.scene is not None else None
        factors = {}
        for name in ("extinction", "emission"):
            given = getattr(self, name)
            factors[name] = given if given is not None else getattr(smoke, name, 1.0)
        return load_volume(path, **factors, device=self.device)

    def time(self, number: int) -> float:
        """When a frame is, in seconds; 0 of a single volume."""
        return 0.0 if self.scene is None else self.scene.time(number)


def open_footage(
    path: str | os.PathLike[str],
    *,
    extinction: float | None = None,
    emission: float | None = None,
    device: str = "cpu",
) -> Footage:
    """Opens a volume, `.npz` or `.nvdb`, or a folder that `simulate` wrote.

    Raises:
        WlmError: There is no such thing.
    """
    path = Path(path)
    if path.is_dir():
        frames = read_frames(path)
        return Footage(path, frames.scene, frames.numbers, device, extinction, emission)
    return Footage(path, None, (1,), device, extinction, emission)


def check_folder(folder: str | os.PathLike[str], stem: str, suffix: str, *others: str) -> Path:
    """Makes a folder for numbered files, or looks that it holds none but those of an earlier run.

    Args:
        folder: Where; it is made if its parent is there.
        stem, suffix: Of the files, as for `numbered`.
        others: Names that such a run leaves beside them.

    Raises:
        WlmError: It holds other files, or can't be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(exist_ok=True)
        mine = _earlier(folder, stem, suffix, others)
        if other := next((path for path in sorted(folder.iterdir()) if path not in mine), None):
            raise WlmError(f"{folder}: expected an empty folder or one of an earlier run, found {other.name}")
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
    return folder


def clear_folder(folder: str | os.PathLike[str], stem: str, suffix: str, *others: str) -> None:
    """Removes the files of an earlier run, once the first of the new ones is sure; arguments as for `check_folder`.

    Raises:
        WlmError: They can't be removed.
    """
    folder = Path(folder)
    try:
        for path in _earlier(folder, stem, suffix, others):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error


def write_guide(path: str | os.PathLike[str], found: Guide) -> None:
    """Writes a guiding map as an EXR of the channels light, transparency and depth, all float32.

    Raises:
        WlmError: The file can't be written.
    """
    planes = dict(zip(_GUIDE, found.maps.cpu().numpy(), strict=True))
    write_planes(path, planes, {"camera": asdict(found.camera)}, whole=_GUIDE)


def write_six_way(path: str | os.PathLike[str], six: SixWay, camera: Camera) -> None:
    """Writes lightmaps as an EXR of half floats: a channel a direction, `transparency` and, of hot smoke, `emission`.

    Raises:
        WlmError: The file can't be written.
    """
    planes = dict(zip(DIRECTIONS, six.lightmaps.cpu().numpy(), strict=True))
    for name, plane in ((_TRANSPARENCY, six.transparency), (EMISSION, six.emission)):
        if plane is not None:
            planes[name] = plane.cpu().numpy()
    write_planes(path, planes, {"camera": asdict(camera)})


def read_six_way(path: str | os.PathLike[str], device: str = "cpu") -> tuple[SixWay, Camera]:
    """Reads what `write_six_way` wrote.

    Raises:
        WlmError: The file is missing or damaged, lacks a channel or its camera, or holds a number that isn't finite.
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
        given = {key: tuple(value) if isinstance(value, list) else value for key, value in note["camera"].items()}
        camera = Camera(**given)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise WlmError(f"{path}: header attribute wlm: camera: expected that of bake: {error}") from error
    size = next(iter(planes.values())).shape
    if size != (camera.height, camera.width):
        raise WlmError(f"{path}: expected the camera's {camera.height} x {camera.width} pixels, found {size}")
    tensors = {name: torch.from_numpy(plane).to(device) for name, plane in planes.items()}
    six = SixWay(torch.stack([tensors[name] for name in DIRECTIONS]), tensors[_TRANSPARENCY], tensors.get(EMISSION))
    return six, camera


def _earlier(folder: Path, stem: str, suffix: str, others: tuple[str, ...]) -> list[Path]:
    return [*numbered(folder, stem, suffix).values(), *(folder / name for name in others)]


def _read_scene(folder: Path) -> Scene:
    path = folder / SCENE_FILE
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise WlmError(f"{path}: cannot read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise WlmError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise WlmError(f"{path}: expected a scene of a simulation's frames, found other content")
    if content.get("version") != _VERSION:
        raise WlmError(f"{path}: version: expected {_VERSION}, found {content.get('version')}")
    try:
        return Scene.model_validate(content.get("scene"))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        field = ".".join(map(str, ("scene", *problem["loc"])))
        raise WlmError(f"{path}: {field}: {problem['msg']}") from error


def _settings(scene: Scene) -> dict[str, Any]:
    """What a simulation's frames depend on: neither how many there are nor how they are looked at."""
    looks = {"smoke": {"extinction", "glow"}, "obstacles": {"__all__": {"colour"}}}
    others = dict.fromkeys(("name", "frames", "camera", "lights", "background"), True)
    return json.loads(scene.model_dump_json(exclude=others | looks))


def _difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> str | None:
    return next((key for key in other if one.get(key) != other[key]), None)
