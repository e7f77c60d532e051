"""`Scene`: the content of a scene's file, and what it shows at a second of the film or an hour of the day."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from wlm.config import load_settings
from wlm.errors import WlmError
from wlm.formats.hours import DAY, hours_of_names
from wlm.formats.reading import named_file
from wlm.lightmap.model import LightmapModel
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import irradiance, unit_or_zero
from wlm.scene.file import FIELDS, Day, SceneFile
from wlm.scene.mesh import Mesh, read_mesh
from wlm.smoke.data import six_way_files
from wlm.system import load as load_model

_SH = 27  # numbers of a probe: nine coefficients in three colours


@dataclass(frozen=True, eq=False)
class Moving:
    """A mesh on a closed path of straight lines at constant speed; +z of the mesh points ahead, +y up.

    Attributes:
        mesh: The mesh, around its own origin.
        path: float64 [N, 3], corners of the path; it returns from the last to the first.
        seconds: Time for the path.
    """

    mesh: Mesh
    path: np.ndarray
    seconds: float

    def pose(self, second: float) -> np.ndarray:
        """Returns the transform from the mesh to the scene at a second of the film, float64 [4, 4]. The mesh turns at
        once at a corner of the path, and stays upright on a slope."""
        steps = np.roll(self.path, -1, 0) - self.path
        ends = np.cumsum(np.linalg.norm(steps, axis=1))
        at = second / self.seconds % 1.0 * ends[-1]
        i = min(int(np.searchsorted(ends, at, side="right")), len(ends) - 1)
        length = float(np.linalg.norm(steps[i]))
        pose = np.eye(4)
        pose[:3, 3] = self.path[i] + steps[i] * (1.0 - (ends[i] - at) / length)
        across = math.hypot(steps[i, 0], steps[i, 2])
        if across > 0.0:  # on a vertical line it keeps the axes of its file
            z = np.array([steps[i, 0], 0.0, steps[i, 2]]) / across
            pose[:3, :3] = np.stack([np.cross([0.0, 1.0, 0.0], z), [0.0, 1.0, 0.0], z], 1)
        return pose

    def centre(self, pose: np.ndarray) -> np.ndarray:
        """Returns the centre of the mesh's bounding box in a pose, float64 [3], where probes are read for it."""
        position = self.mesh.position.astype(np.float64)
        return pose[:3, :3] @ (0.5 * (position.min(0) + position.max(0))) + pose[:3, 3]

    def lit(self, pose: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the vertices in a pose, and their radiance by base colour / pi times irradiance, float32 [V, 3] each.

        Args:
            pose: [4, 4].
            coefficients: [9, 3], SH of radiance at the centre.
        """
        normal = unit_or_zero(self.mesh.normal @ pose[:3, :3].T)
        normal[~normal.any(1)] = [0.0, 1.0, 0.0]  # of triangles without area, which are not drawn
        light = np.maximum(irradiance(coefficients, normal), 0.0)
        position = self.mesh.position @ pose[:3, :3].T + pose[:3, 3]
        return position.astype(np.float32), (self.mesh.colour / math.pi * light).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Puff:
    """Six-way lightmaps of smoke on a square that faces the camera, played again and again.

    Attributes:
        files: One EXR for each frame, in order.
        position: float64 [3], the middle of the square's lower edge.
        size: Side of the square.
        rate: Frames a second.
    """

    files: tuple[Path, ...]
    position: np.ndarray
    size: float
    rate: float

    def frame(self, second: float) -> int:
        """Returns the index of the frame that is shown at a second of the film."""
        return math.floor(self.rate * second) % len(self.files)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene; it may be used in a `with` statement, which closes the file of its lightmaps.

    Attributes:
        path: The YAML file.
        title: Title.
        mesh: The mesh under the lightmaps.
        light: Lightmaps over time, of one atlas, with any number of light groups.
        probes: Probes of L2 radiance over the day, with their positions; None if nothing needs them.
        moving, smoke: Moving objects, and smoke.
        sky: float64 [S, 5], rows of hour, R, G, B radiance of the background, and exposure in stops.
        camera: float64 [C, 8], rows of second, eye, target, and vertical field of view in degrees.
        day: The hours of the film and its length.
        originals: The original lightmaps, by hour; empty if there are none.
    """

    path: Path
    title: str
    mesh: Mesh
    light: LightmapModel
    probes: ProbeModel | None
    moving: tuple[Moving, ...]
    smoke: tuple[Puff, ...]
    sky: np.ndarray
    camera: np.ndarray
    day: Day
    originals: dict[float, Path]

    @property
    def probe_hours(self) -> np.ndarray:
        """The hours of the probes, float64 [T]; 0 for probes of one unnamed hour, none without probes."""
        if self.probes is None:
            return np.zeros(0)
        return self.probes.times if len(self.probes.times) else np.zeros(1)

    def hour_at(self, second: float) -> float:
        """Returns the hour of a second of the film, from `day.first`; hours of the next day are 24 and more."""
        return self.day.first + (self.day.last - self.day.first) * second / self.day.seconds

    def second_at(self, hour: float) -> float:
        """Returns the first second of the film at which it is an hour of the day; 0 if the film has no such hour."""
        later = (hour - self.day.first) % DAY
        length = self.day.last - self.day.first
        return self.day.seconds * later / length if later <= length else 0.0

    def sky_at(self, hour: float) -> tuple[np.ndarray, float]:
        """Returns the radiance of the background, float64 [3], and the exposure in stops at an hour: linear between the
        rows of `sky`, and from the last row to the first of the next day."""
        *colour, exposure = (np.interp(hour, self.sky[:, 0], column, period=DAY) for column in self.sky[:, 1:].T)
        return np.array(colour), float(exposure)

    def camera_at(self, second: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Returns eye [3], target [3], and vertical field of view in degrees at a second of the film.

        Between the rows of `camera` a cubic curve passes through them (Catmull-Rom: the slope at a row is that of the
        line between its neighbours); before the first and after the last the camera stands still.
        """
        times, rows = self.camera[:, 0], self.camera[:, 1:]
        row = rows[0]
        if len(times) > 1:
            slopes = np.empty_like(rows)
            slopes[1:-1] = (rows[2:] - rows[:-2]) / (times[2:] - times[:-2])[:, None]
            slopes[[0, -1]] = np.diff(rows, axis=0)[[0, -1]] / np.diff(times)[[0, -1], None]
            row = CubicHermiteSpline(times, rows, slopes)(np.clip(second, times[0], times[-1]))
        return row[:3], row[3:6], float(np.clip(row[6], *FIELDS))  # the curve may swing beyond its rows

    def close(self) -> None:
        """Closes the file of the lightmaps."""
        self.light.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def load(path: str | os.PathLike[str]) -> Scene:
    """Reads a scene: its YAML file, meshes and probes, and the indices of its lightmaps and of its smoke.

    Files that the YAML file names must be in its folder or below. docs/scene.md describes its keys.

    Raises:
        WlmError: One line with the file and the key: a file is missing, damaged, outside the folder or of another kind;
            or a value is wrong.
    """
    path = Path(path)
    given = load_settings(SceneFile, path)

    def file(key: str, name: str) -> Path:
        found = named_file(path, name, f"{path}: {key}", None)
        if not found.exists():
            raise WlmError(f"{path}: {key}: there is no file or folder {found}")
        return found

    moving = [
        Moving(read_mesh(file(f"moving.{i}.mesh", row.mesh)), np.array(row.path), row.seconds)
        for i, row in enumerate(given.moving)
    ]
    smoke = []
    for i, puff in enumerate(given.smoke):
        files = tuple(six_way_files(file(f"smoke.{i}.files", puff.files)).values())
        if not files:
            raise WlmError(
                f"{path}: smoke.{i}.files: expected a folder of six-way lightmaps, found none in {puff.files}"
            )
        smoke.append(Puff(files, np.array(puff.position), puff.size, puff.rate))
    originals = [file(f"originals.{i}", name) for i, name in enumerate(given.originals)]
    return Scene(
        path=path,
        title=given.title,
        mesh=read_mesh(file("mesh", given.mesh), with_uv=True),
        probes=None if given.probes is None else _probes(file("probes", given.probes)),
        moving=tuple(moving),
        smoke=tuple(smoke),
        sky=np.array([(row.hour, *row.colour, row.exposure) for row in given.sky]),
        camera=np.array([(row.second, *row.eye, *row.target, row.fov) for row in given.camera]),
        day=given.day,
        originals=_by_hour(path, originals),
        light=_light(file("light", given.light)),
    )


def _light(path: Path) -> LightmapModel:
    model: Any = load_model(path, "lightmap")
    atlases = {(sheet.atlas, sheet.layer) for sheet in model.sheets}
    if len(atlases) != 1:
        model.close()
        raise WlmError(f"{path}: expected the light of one atlas, found {len(atlases)} layers of atlases")
    return model


def _probes(path: Path) -> ProbeModel:
    model: Any = load_model(path, "probe")
    if model.outputs != _SH or not model.has_positions:
        positions = "with" if model.has_positions else "without"
        raise WlmError(
            f"{path}: expected probes of {_SH} numbers (L2) with their positions, found {model.outputs} numbers "
            f"{positions} positions"
        )
    return model


def _by_hour(path: Path, files: Sequence[Path]) -> dict[float, Path]:
    hours, _ = hours_of_names([file.stem for file in files])
    found: dict[float, Path] = {}
    for i, (hour, file) in enumerate(zip(hours, files, strict=True)):
        if hour is None or not 0.0 <= hour < DAY or hour in found:
            expected = "another hour than in the names before it" if hour in found else "an hour such as _18_50h"
            raise WlmError(f"{path}: originals.{i}: expected {expected} at the end of the name, found {file.name}")
        found[hour] = file
    return found
