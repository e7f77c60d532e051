"""A scene to simulate and to look at, as its YAML file says it: the box, its air and smoke, what moves, camera, lights.

Lengths are metres, times seconds, directions the world's, +y up unless the scene says otherwise. What smoke comes in
as, without a scene, is `volume`; what a simulation leaves is `frames`. The stated behaviours:

=======================================  =============================================================
a number NaN or infinite                 error that names the field
an unknown or a repeated key             error
a path whose times don't rise            error
an inlet's or a source's end before      error
its start
no inlet, no source                      fine: the box stays empty
an obstacle over an inlet                fine: nothing comes in where it lies
a camera or a light along an axis        fine, along the vertical too
a light of no direction                  error
a box of one cell                        fine
a time step that would be too long for   error when it is simulated: it names the obstacle or the inlet
a fast obstacle
=======================================  =============================================================
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from wlm.config import load_settings, profile_path
from wlm.fluid.faces import FACES
from wlm.fluid.shapes import box, cylinder, sphere
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Light, Ramp

__all__ = [
    "Air",
    "CameraSettings",
    "Smoke",
    "Grid",
    "Inlet",
    "LightSettings",
    "Obstacle",
    "Scene",
    "Source",
    "load_scene",
    "make_camera",
    "obstacle_mesh",
]

_SHORTEST = 1e-12
_MARGIN = 1.05  # of an image's height over the box's, so that no smoke touches the edge


def _directed(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not math.hypot(*vector) > _SHORTEST:
        raise PydanticCustomError("direction", "expected a direction of some length")
    return vector


def _rising(path: tuple[tuple[float, float, float, float], ...]) -> tuple[tuple[float, float, float, float], ...]:
    if any(later[0] <= earlier[0] for earlier, later in zip(path, path[1:], strict=False)):
        raise PydanticCustomError("path", "expected times that rise")
    return path


_Vector = tuple[float, float, float]
_Direction = Annotated[_Vector, AfterValidator(_directed)]
_Colour = tuple[
    Annotated[float, Field(ge=0.0)],
    Annotated[float, Field(ge=0.0)],
    Annotated[float, Field(ge=0.0)],
]
_Positive = Annotated[float, Field(gt=0.0)]
_NotNegative = Annotated[float, Field(ge=0.0)]
_Count = Annotated[int, Field(ge=1, le=4096)]
_Face = Literal["-x", "+x", "-y", "+y", "-z", "+z"]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Grid(_Part):
    """The box and what closes it.

    Attributes:
        cells: X, Y, Z of the velocity's grid.
        cell: Metres along a cell's edge.
        refine: Voxels of density along a cell's edge; the paper's 400 over 100.
        origin: The box's corner.
        faces: What each face is: a "wall", a wall without friction ("slip"), "open", or "periodic" like the one
            opposite, which has to be too. A face with an inlet is a wall around it to the air, and lets smoke out as a
            whole. Faces that aren't named are open.
    """

    cells: tuple[_Count, _Count, _Count]
    cell: _Positive
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
        """What a face is."""
        return self.faces.get(name, "open")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels of density along x, y, z."""
        return tuple(self.refine * n for n in self.cells)

    @property
    def voxel(self) -> float:
        """Metres along an edge of a voxel of density."""
        return self.cell / self.refine

    @property
    def size(self) -> np.ndarray:
        """Of the box, float64 [3]."""
        return self.cell * np.asarray(self.cells, np.float64)


class Air(_Part):
    """How the air moves.

    Attributes:
        viscosity: Kinematic, square metres a second; air's is 1.5e-5.
        speed: Metres a second that are `lattice_speed` cells a step; null: the fastest inlet or obstacle.
        lattice_speed: Cells a step. Errors grow with its square, the number of steps with its inverse.
        operator, smagorinsky, storage: As for `wlm.fluid.lattice.Lattice`.
    """

    viscosity: _Positive = 1.5e-5
    speed: _Positive | None = None
    lattice_speed: float = Field(0.1, gt=0.0, le=0.3)
    operator: Literal["bgk", "regularised", "recursive"] = "regularised"
    smagorinsky: _NotNegative = 0.17
    storage: Literal["float32", "float16"] = "float32"


class Smoke(_Part):
    """What the smoke itself does and how it looks.

    Attributes:
        extinction: Per metre, of density 1.
        emission: Light given off per metre at temperature 1.
        dissipation, cooling: Rates at which density and temperature decay, a second: exp(-rate t) is left.
        buoyancy: Metres a second squared, upwards, at temperature 1.
        weight: Metres a second squared, downwards, at density 1.
        up: The direction that is up.
        scheme, storage, bricks, substeps: How smoke is carried, as for `wlm.fluid.solver.Solver`.
        glow: Colours of the emission: stops of emission, R, G, B; none: grey, as it is.
    """

    extinction: _Positive = 10.0
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
    glow: tuple[tuple[float, _NotNegative, _NotNegative, _NotNegative], ...] = ()

    @model_validator(mode="after")
    def _stops(self) -> Smoke:
        if len(self.glow) == 1 or any(b[0] <= a[0] for a, b in zip(self.glow, self.glow[1:], strict=False)):
            raise PydanticCustomError("glow", "expected no stops of glow, or at least two that rise")
        return self

    @property
    def hot(self) -> bool:
        """Whether temperature shows or moves anything."""
        return self.emission > 0.0 or self.buoyancy > 0.0

    @property
    def ramp(self) -> Ramp | None:
        """The glow's colours as shading takes them."""
        if not self.glow:
            return None
        return Ramp(tuple(stop[0] for stop in self.glow), tuple(stop[1:] for stop in self.glow))


class _Timed(_Part):
    start: float = 0.0
    stop: float | None = None

    @model_validator(mode="after")
    def _order(self) -> _Timed:
        if self.stop is not None and self.stop <= self.start:
            raise PydanticCustomError("stop", "expected to stop after it starts")
        return self

    def active(self, time: float) -> bool:
        """Whether it works at a time."""
        return self.start <= time and (self.stop is None or time < self.stop)


class Inlet(_Part):
    """Where air and smoke come in through a face, all the time.

    Attributes:
        face: Of the box.
        centre, radius: The round part of the face that lets air in; radius null: the whole face.
        velocity: Metres a second, into the box.
        density, temperature: Of what comes in.
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


class Source(_Timed):
    """Where smoke arises within the box.

    Attributes:
        centre, radius: A ball.
        density, temperature: What the ball is held at, while the source works.
        start, stop: Seconds; stop null: to the end.
    """

    centre: _Vector
    radius: _Positive
    density: _NotNegative = 1.0
    temperature: _NotNegative = 0.0


class Obstacle(_Part):
    """A solid body.

    Attributes:
        shape: "sphere", "box" or "cylinder", which stands along y.
        radius: Of a sphere; of the others half their extents along x, y and z.
        path: Where its centre is: time, x, y, z. In between it moves evenly, before and after it rests.
        colour: What it reflects, in pictures.
    """

    shape: Literal["sphere", "box", "cylinder"] = "sphere"
    radius: _Positive | tuple[_Positive, _Positive, _Positive]
    path: Annotated[tuple[tuple[float, float, float, float], ...], Field(min_length=1), AfterValidator(_rising)]
    colour: _Colour = (0.12, 0.12, 0.13)

    @model_validator(mode="after")
    def _sizes(self) -> Obstacle:
        if (self.shape == "sphere") == isinstance(self.radius, tuple):
            raise PydanticCustomError("radius", "expected one radius of a sphere, three half extents of another body")
        return self

    def centre(self, time: float) -> np.ndarray:
        """Where it is, float64 [3]."""
        keys = np.array(self.path)
        return np.array([np.interp(time, keys[:, 0], keys[:, axis]) for axis in (1, 2, 3)])

    @property
    def fastest(self) -> float:
        """Metres a second."""
        keys = np.array(self.path)
        distance = np.linalg.norm(np.diff(keys[:, 1:], axis=0), axis=1)
        return float((distance / np.diff(keys[:, 0])).max(initial=0.0))

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Its surface about its centre: corners float64 [V, 3], triangles int64 [F, 3], anticlockwise from outside."""
        points, triangles = {"sphere": sphere, "box": box, "cylinder": cylinder}[self.shape]()
        return points * np.asarray(self.radius), triangles


class CameraSettings(_Part):
    """From where smoke is seen.

    Attributes:
        toward: From the smoke to the camera.
        target: What is in the image's middle; null: the box's centre.
        extent: Height of the image in metres, in perspective at distance 1; null: as much as holds the box.
        distance: Of the camera from its target; null: outside the box. What is behind the camera isn't seen.
        up: What is up in the image, as far as it can be.
        resolution: Pixels along the height.
        aspect: Width over height.
        perspective: For guiding maps; six-way lightmaps are orthographic.
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
        """The same camera, turned about what is up: the paper's references are seen from 9 sides, 10 degrees apart."""
        axis = np.array(self.up) / np.linalg.norm(self.up)
        toward, angle = np.array(self.toward), math.radians(degrees)
        along = axis * (axis @ toward)
        across = toward - along
        turned = along + math.cos(angle) * across + math.sin(angle) * np.cross(axis, across)
        return self.model_copy(update={"toward": tuple(map(float, turned))})


class LightSettings(_Part):
    """A directional light.

    Attributes:
        toward: From the smoke to the light.
        irradiance: R, G, B on a surface that faces it; 4 pi (12.57) shows a lightmap as it is.
    """

    toward: _Direction
    irradiance: _Colour = (4 * math.pi,) * 3

    def light(self) -> Light:
        """As shading takes it."""
        return Light(self.toward, self.irradiance)


class Scene(_Part):
    """All of it.

    Attributes:
        name: Shown in reports.
        grid, air, smoke: The box and what fills it.
        inlets, sources, obstacles: What acts on it.
        camera, lights, background: How it is seen; the background is a linear colour.
        frames: How many.
        rate: Frames a second; the first is one interval after the start.
    """

    name: str
    grid: Grid
    air: Air = Air()
    smoke: Smoke = Smoke()
    inlets: tuple[Inlet, ...] = ()
    sources: tuple[Source, ...] = ()
    obstacles: tuple[Obstacle, ...] = Field((), max_length=255)
    camera: CameraSettings = CameraSettings()
    lights: tuple[LightSettings, ...] = (LightSettings(toward=(1.0, 1.0, 1.0)),)
    background: _Colour = (0.0, 0.0, 0.0)
    frames: int = Field(100, ge=1, le=9999)
    rate: _Positive = 25.0

    @model_validator(mode="after")
    def _flow(self) -> Scene:
        taken = {inlet.face for inlet in self.inlets}
        if any(self.grid.face(face) == "periodic" for face in taken):
            raise PydanticCustomError("inlets", "expected inlets on faces that aren't periodic")
        if taken and all(face in taken or self.grid.face(face) != "open" for face in FACES):
            raise PydanticCustomError("inlets", "expected an open face for what the inlets let in")
        return self

    def time(self, frame: int) -> float:
        """When a frame is, which count from 1."""
        return frame / self.rate

    def scaled(self, factor: float) -> Scene:
        """The same scene on a grid of a multiple of its cells along each axis, rounded; no axis gets fewer than one.

        The longest axis keeps its length, the others keep theirs to half a cell.
        """
        if not 0 < factor < math.inf:
            raise ValueError(f"factor: expected a number above 0, got {factor}")
        cells = tuple(max(round(n * factor), 1) for n in self.grid.cells)
        longest = int(np.argmax(self.grid.cells))
        cell = self.grid.cell * self.grid.cells[longest] / cells[longest]
        grid = self.grid.model_dump() | {"cells": cells, "cell": cell}
        return self.model_copy(update={"grid": Grid(**grid)})

    @property
    def fastest(self) -> float:
        """Metres a second that make `air.lattice_speed`; 1 where nothing says."""
        if self.air.speed is not None:
            return self.air.speed
        speeds = [float(np.linalg.norm(inlet.velocity)) for inlet in self.inlets]
        return max([*speeds, *(obstacle.fastest for obstacle in self.obstacles)], default=0.0) or 1.0

    @property
    def steps(self) -> int:
        """Steps of the air in a frame, as many as keep `fastest` at or below `air.lattice_speed`, in whole substeps."""
        least = self.fastest / (self.rate * self.air.lattice_speed * self.grid.cell)
        return max(math.ceil(least / self.smoke.substeps - 1e-9), 1) * self.smoke.substeps

    @property
    def step(self) -> float:
        """Seconds of a step."""
        return 1.0 / (self.rate * self.steps)


def load_scene(name: str | os.PathLike[str]) -> Scene:
    """Loads ``configs/smoke-NAME.yaml``, or a YAML file of one's own.

    Raises:
        WlmError: Unknown scene, unreadable file, or a wrong setting.
    """
    name = os.fspath(name)
    return load_settings(Scene, name if name.endswith((".yaml", ".yml")) else profile_path("smoke", name))


def make_camera(
    settings: CameraSettings, origin: Sequence[float] | np.ndarray, size: Sequence[float] | np.ndarray
) -> Camera:
    """Places a camera before a box.

    Args:
        settings: The camera.
        origin, size: The box's corner and edges in the world, [3].
    """
    origin, size = np.asarray(origin, np.float64), np.asarray(size, np.float64)
    target = origin + 0.5 * size if settings.target is None else np.array(settings.target)
    toward = np.array(settings.toward) / np.linalg.norm(settings.toward)
    corners = origin + size * np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)]) - target
    distance = settings.distance
    if distance is None:
        # In perspective as far off as the box is large, so that it isn't seen through a keyhole.
        distance = float((corners @ toward).max()) + float(np.linalg.norm(size))
    height = settings.resolution
    width = max(round(height * settings.aspect), 1)
    shape = {"height": height, "width": width, "world_up": settings.up, "perspective": settings.perspective}
    camera = Camera.look_at(target + distance * toward, target, extent=1.0, **shape)
    extent = settings.extent
    if extent is None:
        right, up, _ = np.abs(corners @ camera.axes.T).max(axis=0)
        extent = 2.0 * _MARGIN * max(float(up), float(right) * height / width)
        if settings.perspective:
            # Of the box's nearest side, or of the sphere round it where the camera is inside.
            nearest = distance - float((corners @ toward).max())
            extent /= nearest if nearest > 0.0 else distance
    return Camera.look_at(target + distance * toward, target, extent=extent, **shape)


def obstacle_mesh(obstacles: Sequence[Obstacle], time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surfaces of obstacles as triangles, for their pictures and shadows.

    Returns:
        Corners float32 [V, 3] in the world, triangles int32 [F, 3], and which obstacle each is of, int32 [F].
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
