"""The YAML file of a scene as checked settings; docs/scene.md describes its keys."""

from __future__ import annotations

import itertools
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from wlm.formats.hours import DAY
from wlm.system import Checked

FIELDS = (1.0, 150.0)
"""Smallest and largest vertical field of view, degrees."""

_FARTHEST = 1e6
_Number = Annotated[float, Field(ge=-_FARTHEST, le=_FARTHEST)]
_Vector = tuple[_Number, _Number, _Number]
_Radiance = Annotated[float, Field(ge=0.0, le=_FARTHEST)]
_Hour = Annotated[float, Field(ge=0.0, lt=DAY)]
_Seconds = Annotated[float, Field(gt=0.0, le=3600.0)]
_Name = Annotated[str, Field(min_length=1)]


class Sky(Checked):
    """The background at an hour, linear R, G, B radiance, and the exposure in stops."""

    hour: _Hour
    colour: tuple[_Radiance, _Radiance, _Radiance]
    exposure: float = Field(ge=-32.0, le=32.0)


def _not_still(path: tuple[_Vector, ...]) -> tuple[_Vector, ...]:
    if any(one == other for one, other in itertools.pairwise((*path, path[0]))):
        raise PydanticCustomError("path", "expected points that differ from the next one, and the last from the first")
    return path


class MovingObject(Checked):
    """A mesh on a closed path of straight lines, which takes `seconds`."""

    mesh: _Name
    path: Annotated[tuple[_Vector, ...], Field(min_length=2, max_length=1000), AfterValidator(_not_still)]
    seconds: _Seconds


class Smoke(Checked):
    """A folder of six-way lightmaps, played at `rate` frames a second on a square of the side `size`."""

    files: _Name
    position: _Vector
    size: float = Field(gt=0.0, le=_FARTHEST)
    rate: float = Field(gt=0.0, le=1000.0)


class CameraRow(Checked):
    """The camera at a second of the film; `fov` is the vertical field of view in degrees."""

    second: float = Field(ge=0.0, le=3600.0)
    eye: _Vector
    target: _Vector
    fov: float = Field(50.0, ge=FIELDS[0], le=FIELDS[1])

    @model_validator(mode="after")
    def _looks(self) -> CameraRow:
        across, along = (abs(self.eye[k] - self.target[k]) for k in (0, 2))
        if across + along == 0.0:
            raise PydanticCustomError("target", "expected a target that is not above, below or at the eye")
        return self


class Day(Checked):
    """The hours of the film, which may end on the next day, and its length."""

    first: float = Field(0.0, ge=0.0, le=DAY)
    last: float = Field(DAY, ge=0.0, le=2 * DAY)
    seconds: _Seconds = 24.0

    @model_validator(mode="after")
    def _forward(self) -> Day:
        if self.last <= self.first:
            raise PydanticCustomError("last", "expected a later hour than first; hours of the next day are 24 and more")
        return self


def _rising(name: str):
    def check(rows: tuple) -> tuple:
        if any(getattr(b, name) <= getattr(a, name) for a, b in itertools.pairwise(rows)):
            raise PydanticCustomError("order", f"expected rows of rising {name}")
        return rows

    return AfterValidator(check)


class SceneFile(Checked):
    """All keys of the file. File names are relative to its folder."""

    title: str = Field(max_length=200)
    mesh: _Name
    light: _Name
    probes: _Name | None = None
    sky: Annotated[tuple[Sky, ...], Field(min_length=1, max_length=1000), _rising("hour")]
    moving: Annotated[tuple[MovingObject, ...], Field(max_length=100)] = ()
    smoke: Annotated[tuple[Smoke, ...], Field(max_length=100)] = ()
    camera: Annotated[tuple[CameraRow, ...], Field(min_length=1, max_length=1000), _rising("second")]
    day: Day = Day()
    originals: Annotated[tuple[_Name, ...], Field(max_length=100)] = ()

    @model_validator(mode="after")
    def _lit(self) -> SceneFile:
        if (self.moving or self.smoke) and self.probes is None:
            raise PydanticCustomError("probes", "expected a file of probes, since they light moving and smoke")
        return self
