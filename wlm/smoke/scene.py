"""Settings of a scene to simulate and render, a YAML file: box, air, smoke, inlets, obstacles, camera, lights.

Lengths are in metres, times in seconds, directions in the world, with +y up by default. A class is named `...Settings`
if the object that is made from it has the plain name.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from wlm.config import check_settings, load_settings, profile_path
from wlm.fluid.faces import FACES
from wlm.fluid.obstacles import box, cylinder, sphere
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Light, Ramp

_SHORTEST = 1e-12
_MOST_STEPS = 1_000_000  # largest number of steps per frame; typical scenes have hundreds


def _directed(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not math.hypot(*vector) > _SHORTEST:
        raise PydanticCustomError("direction", "expected a direction of some length")
    return vector


def _rising(path: tuple[tuple[float, float, float, float], ...]) -> tuple[tuple[float, float, float, float], ...]:
    if any(later[0] <= earlier[0] for earlier, later in itertools.pairwise(path)):
        raise PydanticCustomError("path", "expected times that rise")
    return path


_LARGEST = 1e18  # its square is within float32
_Number = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST)]
_Vector = tuple[_Number, _Number, _Number]
_Direction = Annotated[_Vector, AfterValidator(_directed)]
_Positive = Annotated[float, Field(gt=0.0, le=_LARGEST)]
_NotNegative = Annotated[float, Field(ge=0.0, le=_LARGEST)]
_Colour = tuple[_NotNegative, _NotNegative, _NotNegative]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Albedo = tuple[_Share, _Share, _Share]
_Count = Annotated[int, Field(ge=1, le=4096)]
_Face = Literal["-x", "+x", "-y", "+y", "-z", "+z"]


def _stops(glow: tuple[tuple[float, float, float, float], ...]) -> tuple[tuple[float, float, float, float], ...]:
    if len(glow) == 1 or any(b[0] <= a[0] for a, b in itertools.pairwise(glow)):
        raise PydanticCustomError("glow", "expected no stops of glow, or at least two that rise")
    return glow


_Glow = Annotated[tuple[tuple[_Number, _NotNegative, _NotNegative, _NotNegative], ...], AfterValidator(_stops)]


def _ramp(glow: tuple[tuple[float, float, float, float], ...]) -> Ramp | None:
    return Ramp(tuple(stop[0] for stop in glow), tuple(stop[1:] for stop in glow)) if glow else None


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Grid(_Settings):
    """The box and its faces.

    Attributes:
        cells: X, Y, Z, cells of the velocity grid.
        cell: Edge of a cell in metres.
        refine: Voxels of density along the edge of a cell; 4 in the paper.
        origin: Corner of the box.
        faces: Boundary condition of each face: "wall", "slip" (a wall without friction), "open" (the default), or
            "periodic", which the opposite face must then be too. A face with an inlet is a wall for the air around the
            inlet, and is open as a whole for the smoke.
    """

    cells: tuple[_Count, _Count, _Count]
    cell: float = Field(ge=1e-9, le=1e9)
    refine: int = Field(4, ge=1, le=16)
    origin: _Vector = (0.0, 0.0, 0.0)
    faces: dict[_Face, Literal["wall", "slip", "open", "periodic"]] = {}

    @model_validator(mode="after")
    def _pairs(self) -> Grid:
        for axis in "xyz":
            ends = [self.face(f"{sign}{axis}") for sign in "-+"]
            if ends.count("periodic") == 1:
                raise PydanticCustomError("faces", "expected both faces of an axis to be periodic, or none")
        return self

    def face(self, name: str) -> str:
        """Returns the boundary condition of a face."""
        return self.faces.get(name, "open")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels of density along x, y, z."""
        return tuple(self.refine * n for n in self.cells)

    @property
    def voxel(self) -> float:
        """Edge of a voxel of density in metres."""
        return self.cell / self.refine

    @property
    def size(self) -> np.ndarray:
        """Edges of the box in metres, float64 [3]."""
        return self.cell * np.asarray(self.cells, np.float64)


class Air(_Settings):
    """The air's flow.

    Attributes:
        viscosity: Kinematic viscosity in square metres per second; 1.5e-5 for air.
        speed: Speed in metres per second that equals `lattice_speed`; null: that of the fastest inlet or obstacle.
        lattice_speed: Cells per step. Errors grow with its square, the number of steps with its inverse.
        operator, smagorinsky, storage: As for `wlm.fluid.lattice.Lattice`.
    """

    viscosity: _Positive = 1.5e-5
    speed: _Positive | None = None
    lattice_speed: float = Field(0.1, gt=0.0, le=0.3)
    operator: Literal["bgk", "regularised"] = "regularised"
    smagorinsky: _NotNegative = 0.17
    storage: Literal["float32", "float16"] = "float32"


class Smoke(_Settings):
    """Motion and appearance of the smoke.

    Attributes:
        extinction: Extinction per metre at density 1.
        albedo: R, G, B, share of light that survives a scattering.
        emission: Light emitted per metre at temperature 1.
        dissipation, cooling: Rates of decay of density and temperature per second: exp(-rate t) remains.
        buoyancy: Upward acceleration at temperature 1, metres per second squared.
        weight: Downward acceleration at density 1, metres per second squared.
        up: Direction opposite to gravity.
        scheme, storage, bricks, substeps: Advection, as for `wlm.fluid.solver.Solver`.
        glow: Colour ramp of the emission, a list of stops (emission, R, G, B); empty: grey.
    """

    extinction: _Positive = 10.0
    albedo: _Albedo = (1.0, 1.0, 1.0)
    emission: _NotNegative = 0.0
    dissipation: _NotNegative = 0.0
    cooling: _NotNegative = 0.0
    buoyancy: _NotNegative = 0.0
    weight: _NotNegative = 0.0
    up: _Direction = (0.0, 1.0, 0.0)
    scheme: Literal["maccormack", "semi-lagrangian"] = "maccormack"
    storage: Literal["float32", "float16"] = "float32"
    bricks: bool = False
    substeps: int = Field(2, ge=1, le=16)
    glow: _Glow = ()

    @property
    def hot(self) -> bool:
        """Whether the temperature has any effect."""
        return self.emission > 0.0 or self.buoyancy > 0.0


class _Timed(_Settings):
    start: _Number = 0.0
    stop: _Number | None = None

    @model_validator(mode="after")
    def _order(self) -> _Timed:
        if self.stop is not None and self.stop <= self.start:
            raise PydanticCustomError("stop", "expected to stop after it starts")
        return self

    def active(self, time: float) -> bool:
        """Returns whether the source is active at a time in seconds."""
        return self.start <= time and (self.stop is None or time < self.stop)


class Inlet(_Settings):
    """A steady inflow of air and smoke through a face.

    Attributes:
        face: Face of the box.
        centre, radius: Circular opening in the face; radius null: the whole face.
        velocity: Velocity in metres per second, into the box.
        density, temperature: Values of the incoming smoke.
    """

    face: _Face
    velocity: _Vector
    centre: _Vector = (0.0, 0.0, 0.0)
    radius: _Positive | None = None
    density: _NotNegative = 1.0
    temperature: _NotNegative = 0.0

    @model_validator(mode="after")
    def _inwards(self) -> Inlet:
        axis, high = divmod(FACES.index(self.face), 2)
        if not (self.velocity[axis] < 0.0 if high else self.velocity[axis] > 0.0):
            raise PydanticCustomError("velocity", "expected a velocity into the box")
        return self


class SourceSettings(_Timed):
    """A ball within the box that emits smoke.

    Attributes:
        centre, radius: Centre and radius of the ball.
        density, temperature: Values that are set in the ball while the source is active.
        start, stop: Times in seconds; stop null: until the end.
    """

    centre: _Vector
    radius: _Positive
    density: _NotNegative = 1.0
    temperature: _NotNegative = 0.0


class ObstacleSettings(_Settings):
    """A solid obstacle.

    Attributes:
        shape: "sphere", "box" or "cylinder", whose axis is y.
        radius: Radius of a sphere; for the other shapes half the extents along x, y and z.
        path: Keys of the centre: time, x, y, z. It moves linearly between them, and rests before and after.
        colour: Albedo in pictures.
    """

    shape: Literal["sphere", "box", "cylinder"] = "sphere"
    radius: _Positive | tuple[_Positive, _Positive, _Positive]
    path: Annotated[tuple[tuple[_Number, _Number, _Number, _Number], ...], Field(min_length=1), AfterValidator(_rising)]
    colour: _Colour = (0.12, 0.12, 0.13)

    @model_validator(mode="after")
    def _sizes(self) -> ObstacleSettings:
        if (self.shape == "sphere") == isinstance(self.radius, tuple):
            raise PydanticCustomError("radius", "expected one radius of a sphere, three half extents of another body")
        return self

    def centre(self, time: float) -> np.ndarray:
        """Returns the position at a time, float64 [3]."""
        keys = np.array(self.path)
        return np.array([np.interp(time, keys[:, 0], keys[:, axis]) for axis in (1, 2, 3)])

    @property
    def fastest(self) -> float:
        """Greatest speed in metres per second."""
        keys = np.array(self.path)
        distance = np.linalg.norm(np.diff(keys[:, 1:], axis=0), axis=1)
        return float((distance / np.diff(keys[:, 0])).max(initial=0.0))

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the surface relative to the centre: corners float64 [V, 3], triangles int64 [F, 3]."""
        points, triangles = {"sphere": sphere, "box": box, "cylinder": cylinder}[self.shape]()
        return points * np.asarray(self.radius), triangles


class CameraSettings(_Settings):
    """Settings of a camera.

    Attributes:
        toward, target, extent, distance, up, aspect, perspective: As for `Camera.around`; lengths in metres.
        resolution: Height of the image in pixels.
    """

    toward: _Direction = (0.0, 0.0, 1.0)
    target: _Vector | None = None
    extent: _Positive | None = None
    distance: _Positive | None = None
    up: _Direction = (0.0, 1.0, 0.0)
    resolution: int = Field(512, ge=1, le=16384)
    aspect: float = Field(1.0, gt=0.0, le=16.0)
    perspective: bool = False

    def turned(self, degrees: float) -> CameraSettings:
        """Returns the camera turned about `up`: the paper's references have 9 views, 10 degrees apart."""
        axis = np.array(self.up) / np.linalg.norm(self.up)
        toward, angle = np.array(self.toward), math.radians(degrees)
        along = axis * (axis @ toward)
        across = toward - along
        turned = along + math.cos(angle) * across + math.sin(angle) * np.cross(axis, across)
        return self.model_copy(update={"toward": tuple(map(float, turned))})


class LightSettings(_Settings):
    """A directional light.

    Attributes:
        toward: Direction from the smoke to the light.
        irradiance: R, G, B on a surface that faces the light; at 4 pi (12.57) lightmaps have their stored values.
    """

    toward: _Direction
    irradiance: _Colour = (4 * math.pi,) * 3

    def light(self) -> Light:
        """Returns the light."""
        return Light(self.toward, self.irradiance)


class Looks(_Settings):
    """Settings with which a frame's smoke is rendered: lights, colours and obstacles.

    Attributes:
        lights, background, obstacles: As in a scene.
        albedo, glow: As for a scene's smoke; lightmaps with light of all orders already include their albedo.
        time: Time of the obstacles in seconds.
    """

    lights: tuple[LightSettings, ...]
    background: _Colour = (0.0, 0.0, 0.0)
    albedo: _Albedo = (1.0, 1.0, 1.0)
    glow: _Glow = ()
    obstacles: tuple[ObstacleSettings, ...] = Field((), max_length=255)
    time: _Number = 0.0

    @property
    def ramp(self) -> Ramp | None:
        """Colours of the emission; None: grey."""
        return _ramp(self.glow)


class Scene(_Settings):
    """A scene.

    Attributes:
        name: Shown in reports.
        grid, air, smoke: The box and its contents.
        inlets, sources, obstacles: Objects in the box.
        camera, lights, background: Settings of pictures; the background is a linear colour.
        frames: Number of frames.
        rate: Frames per second; the first frame is one interval after the start.
    """

    name: str
    grid: Grid
    air: Air = Air()
    smoke: Smoke = Smoke()
    inlets: tuple[Inlet, ...] = ()
    sources: tuple[SourceSettings, ...] = ()
    obstacles: tuple[ObstacleSettings, ...] = Field((), max_length=255)
    camera: CameraSettings = CameraSettings()
    lights: tuple[LightSettings, ...] = (LightSettings(toward=(1.0, 1.0, 1.0)),)
    background: _Colour = (0.0, 0.0, 0.0)
    frames: int = Field(100, ge=1, le=9999)
    rate: float = Field(25.0, ge=1e-6, le=1e6)

    @model_validator(mode="after")
    def _flow(self) -> Scene:
        faces = {inlet.face for inlet in self.inlets}
        if any(self.grid.face(face) == "periodic" for face in faces):
            raise PydanticCustomError("inlets", "expected inlets on faces that aren't periodic")
        if faces and all(face in faces or self.grid.face(face) != "open" for face in FACES):
            raise PydanticCustomError("inlets", "expected an open face for the air that the inlets let in")
        if not self.fastest <= _MOST_STEPS * self._speed_of_one_step:
            raise PydanticCustomError(
                "steps",
                f"expected at most {_MOST_STEPS:,} steps a frame, found a speed of {self.fastest:g} m/s over cells of "
                f"{self.grid.cell:g} m at {self.rate:g} frames a second",
            )
        return self

    def time(self, frame: int) -> float:
        """Returns the time of a frame in seconds; frames count from 1."""
        return frame / self.rate

    def looks(self, frame: int) -> Looks:
        """Returns the settings of a frame's picture."""
        parts = {"lights": self.lights, "background": self.background, "obstacles": self.obstacles}
        return Looks(**parts, albedo=self.smoke.albedo, glow=self.smoke.glow, time=self.time(frame))

    def scaled(self, factor: float) -> Scene:
        """Returns the scene with its number of cells multiplied by a factor along each axis, rounded, at least one.

        The longest axis keeps its length, the others keep theirs to half a cell.

        Raises:
            ValueError: The factor is not above 0.
            WlmError: There are too many cells.
        """
        if not 0 < factor < math.inf:
            raise ValueError(f"factor: expected a number above 0, got {factor}")
        cells = tuple(max(round(n * factor), 1) for n in self.grid.cells)
        longest = int(np.argmax(self.grid.cells))
        cell = self.grid.cell * self.grid.cells[longest] / cells[longest]
        grid = check_settings(Grid, self.grid.model_dump() | {"cells": cells, "cell": cell}, f"{self.name}: grid.")
        return self.model_copy(update={"grid": grid})

    @property
    def fastest(self) -> float:
        """Speed in metres per second that equals `air.lattice_speed`; 1 if nothing moves."""
        if self.air.speed is not None:
            return self.air.speed
        speeds = [float(np.linalg.norm(inlet.velocity)) for inlet in self.inlets]
        return max([*speeds, *(obstacle.fastest for obstacle in self.obstacles)], default=0.0) or 1.0

    @property
    def _speed_of_one_step(self) -> float:
        """Speed in metres per second that equals `air.lattice_speed` with one air step per frame."""
        return self.rate * self.air.lattice_speed * self.grid.cell

    @property
    def steps(self) -> int:
        """Air steps per frame: the smallest multiple of the substeps limiting `fastest` to `air.lattice_speed`."""
        least = self.fastest / self._speed_of_one_step
        return max(math.ceil(least / self.smoke.substeps - 1e-9), 1) * self.smoke.substeps

    @property
    def step(self) -> float:
        """Duration of an air step in seconds."""
        return 1.0 / (self.rate * self.steps)


def load_scene(name: str | os.PathLike[str]) -> Scene:
    """Loads `configs/smoke-NAME.yaml`, or any YAML file.

    Raises:
        WlmError: The scene is unknown, the file cannot be read, or a setting is wrong.
    """
    name = os.fspath(name)
    return load_settings(Scene, name if name.endswith((".yaml", ".yml")) else profile_path("smoke", name))


def make_camera(
    settings: CameraSettings, origin: Sequence[float] | np.ndarray, size: Sequence[float] | np.ndarray
) -> Camera:
    """Places a camera in front of a box in the world, of the corner `origin` [3] and the edges `size` [3]."""
    values = settings.model_dump()
    return Camera.around((origin, size), pixels=values.pop("resolution"), **values)


def obstacle_mesh(obstacles: Sequence[ObstacleSettings], time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the surfaces of obstacles as triangles, for their pictures and shadows.

    Returns:
        Corners float32 [V, 3] in the world, triangles int32 [F, 3], index of each triangle's obstacle int32 [F].
    """
    corners, triangles, owner = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    first = 0
    for number, obstacle in enumerate(obstacles):
        points, faces = obstacle.mesh()
        corners.append(points + obstacle.centre(time))
        triangles.append(faces + first)
        owner.append(np.full(len(faces), number))
        first += len(points)
    joined = np.concatenate(corners), np.concatenate(triangles), np.concatenate(owner)
    return joined[0].astype(np.float32), joined[1].astype(np.int32), joined[2].astype(np.int32)
