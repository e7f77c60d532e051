"""Settings of a scene to simulate and render, as in its YAML file: box, air, smoke, inlets, obstacles, camera, lights.

Lengths are in metres, times in seconds, directions in the world, with +y up by default. A class is named `...Settings`
if another class has the plain name, such as `Camera`.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Sequence
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field, PlainSerializer, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError
from pydantic_core.core_schema import SerializationInfo
from scipy.spatial.transform import Rotation

from wlm.config import check_settings, load_settings, profile_folders, profile_path
from wlm.fluid.black_body import black_body_colour, black_body_light
from wlm.fluid.faces import FACES
from wlm.fluid.forcing import Fire, Turbulence, Wind
from wlm.fluid.obstacles import Mesh, Trajectory, surface
from wlm.smoke.camera import Camera
from wlm.smoke.meshes import SUFFIXES, Surface, read_surface
from wlm.smoke.shading import BRIGHTEST, AnyLight, Light, PointLight, Ramp
from wlm.system import Checked

_SHORTEST = 1e-12
MOST_STEPS = 1_000_000
"""Largest number of air steps per frame; typical scenes have hundreds."""
FASTEST = 0.2
"""Largest speed of inlets and obstacles in cells per step; a flow with faster ones may blow up."""
# Bounds of a stable step: acceleration in cells per step squared, viscosity in square cells per step.
_ACCELERATION, _VISCOSITY = 0.01, 1.0
# Growth of burning gas and confinement per step, and the peak of turbulence over its root mean square.
_GROWTH, _CONFINEMENT, _PEAK = 0.01, 0.02, 3.0
# Without eddy viscosity, of less than this Smagorinsky constant, the largest Reynolds number of a cell.
_LEAST_EDDIES, _CELL_REYNOLDS = 0.05, 100.0


def _directed(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not math.hypot(*vector) > _SHORTEST:
        raise PydanticCustomError("direction", "expected a direction other than 0, 0, 0")
    return vector


def _rising(path: tuple[tuple[float, float, float, float], ...]) -> tuple[tuple[float, float, float, float], ...]:
    if any(later[0] <= earlier[0] for earlier, later in itertools.pairwise(path)):
        raise PydanticCustomError("path", "expected times that increase")
    return path


def _shape(shape: str, info: ValidationInfo) -> str:
    """Returns the name of a shape, or the absolute path of a mesh, which may be a shipped one."""
    if shape in _SIZES:
        return shape
    if Path(shape).suffix.lower() not in SUFFIXES:
        names = ", ".join(_SIZES)
        raise PydanticCustomError("shape", f"expected {names}, or a mesh file ({', '.join(SUFFIXES)})")
    path = os.path.abspath(os.path.join((info.context or {}).get("folder", ""), shape))
    shipped = (str(folder / shape) for folder in profile_folders() if (folder / shape).is_file())
    return path if os.path.exists(path) else next(shipped, path)


def _named(shape: str, info: SerializationInfo) -> str:
    """Returns the path of a mesh as `_shape` finds it again, also when it is moved with the context's folder."""
    if shape in _SIZES or not info.context:
        return shape
    homes = (*map(str, profile_folders()), os.path.abspath(info.context["folder"]))
    home = next((each for each in homes if Path(shape).is_relative_to(each)), homes[-1])
    return Path(os.path.relpath(shape, home)).as_posix() if Path(shape).drive == Path(home).drive else shape


# Largest angle in degrees between two poses of a path, and largest number of pieces of this size.
_PIECE, _MOST_PIECES = 150, 2000
_SIZES = {"sphere": float, "box": tuple, "cylinder": tuple}
_LARGEST = 1e18  # its square is within float32
_Number = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST)]
_Vector = tuple[_Number, _Number, _Number]
_Direction = Annotated[_Vector, AfterValidator(_directed)]
_Positive = Annotated[float, Field(gt=0.0, le=_LARGEST)]
_NotNegative = Annotated[float, Field(ge=0.0, le=_LARGEST)]
_Keys = Annotated[tuple[tuple[_Number, _Number, _Number, _Number], ...], AfterValidator(_rising)]
_Colour = tuple[_NotNegative, _NotNegative, _NotNegative]
_Brightness = tuple[(Annotated[float, Field(ge=0.0, le=BRIGHTEST)],) * 3]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Albedo = tuple[_Share, _Share, _Share]
_Count = Annotated[int, Field(ge=1, le=4096)]
_Face = Literal["-x", "+x", "-y", "+y", "-z", "+z"]


def _stops(glow: tuple[tuple[float, float, float, float], ...]) -> tuple[tuple[float, float, float, float], ...]:
    if len(glow) == 1 or any(b[0] <= a[0] for a, b in itertools.pairwise(glow)):
        raise PydanticCustomError("glow", "expected no stops, or at least two whose emission increases")
    return glow


_Glow = Annotated[tuple[tuple[_Number, _NotNegative, _NotNegative, _NotNegative], ...], AfterValidator(_stops)]


class _Settings(Checked):
    def stored(self, folder: str | os.PathLike[str]) -> dict[str, Any]:
        """Returns JSON values for a file in a folder, which names meshes relative to itself."""
        return self.model_dump(mode="json", context={"folder": folder})


class Grid(_Settings):
    """The simulated box: its grid and its faces.

    Attributes:
        cells: Numbers of cells of the velocity grid along x, y and z.
        cell: Edge of a cell in metres.
        refine: Number of density voxels along the edge of a cell; 4 in the paper.
        origin: Corner of the box with the smallest x, y and z.
        faces: Boundary condition of each face: "wall", "slip" (a wall without friction), "open" (the default), or
            "periodic", which needs a periodic opposite face. A face with an inlet is a wall for the air around the
            inlet, but smoke can leave through the whole face.
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
                raise PydanticCustomError("faces", "expected both faces of an axis to be periodic, or neither of them")
        return self

    def face(self, name: str) -> str:
        """Returns the boundary condition of a face."""
        return self.faces.get(name, "open")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of density voxels along x, y and z."""
        return tuple(self.refine * n for n in self.cells)

    @property
    def voxel(self) -> float:
        """Edge of a density voxel in metres."""
        return self.cell / self.refine

    @property
    def size(self) -> np.ndarray:
        """Edges of the box along x, y and z in metres, float64 [3]."""
        return self.cell * np.asarray(self.cells, np.float64)


class Air(_Settings):
    """Settings of the flow of the air.

    Attributes:
        viscosity: Kinematic viscosity in square metres per second; 1.5e-5 for air.
        speed: Speed in metres per second that equals `lattice_speed`; null: that of the fastest inlet or obstacle.
        lattice_speed: Speed in cells per step. Errors grow with its square, the number of steps with its inverse.
        smagorinsky, storage, save_memory: As for `wlm.fluid.lattice.Lattice`.
        wind: Wind, in metres and seconds, through the faces `Scene.windy`; null: none.
        confinement: Strength per second of the vorticity confinement (Fedkiw et al. 2001: eps), which keeps small
            eddies; 0: none.
        turbulence: A stirring of all air, in metres and seconds; null: none.
    """

    viscosity: _NotNegative = 1.5e-5
    speed: _Positive | None = None
    lattice_speed: float = Field(0.1, gt=0.0, le=FASTEST)
    smagorinsky: _NotNegative = 0.17
    storage: Literal["float32", "float16"] = "float32"
    save_memory: bool = False
    wind: Wind | None = None
    confinement: _NotNegative = 0.0
    turbulence: Turbulence | None = None


class Smoke(_Settings):
    """Settings of the motion and appearance of the smoke.

    Attributes:
        extinction: Extinction per metre at density 1.
        albedo: R, G, B, share of light that survives a scattering, 0 to 1.
        emission: Radiance emitted per metre at temperature 1; with fire at 1,500 kelvin, as by black bodies.
        dissipation, cooling: Rates of decay of density and temperature per second: a share exp(-rate t) remains.
        buoyancy: Upward acceleration at temperature 1, metres per second squared.
        weight: Downward acceleration at density 1, metres per second squared.
        up: Direction opposite to gravity.
        scheme, storage, bricks, substeps: Settings of the advection, as for `wlm.fluid.solver.Solver`.
        glow: Colour ramp of the emission, a list of stops (emission, R, G, B); empty: grey, or that of black bodies if
            there is fire (`Scene.glow`).
        fire: How the fuel of sources burns, in seconds; null: there is none.
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
    fire: Fire | None = None

    @property
    def hot(self) -> bool:
        """Whether the temperature has any effect."""
        return self.emission > 0.0 or self.buoyancy > 0.0 or self.fire is not None


class Inlet(_Settings):
    """A steady inflow of air and smoke through a face of the box.

    Attributes:
        face: Name of the face, such as "-y".
        centre, radius: Centre and radius in metres of a circular opening; radius null: the whole face is open.
        velocity: Velocity of the air in metres per second; it must point into the box.
        density, temperature, fuel: Density, temperature and fuel of the incoming smoke.
    """

    face: _Face
    velocity: _Vector
    centre: _Vector = (0.0, 0.0, 0.0)
    radius: _Positive | None = None
    density: _NotNegative = 1.0
    temperature: _NotNegative = 0.0
    fuel: _NotNegative = 0.0

    @model_validator(mode="after")
    def _inwards(self) -> Inlet:
        axis, high = divmod(FACES.index(self.face), 2)
        if not (self.velocity[axis] < 0.0 if high else self.velocity[axis] > 0.0):
            raise PydanticCustomError("velocity", "expected a velocity that points into the box")
        return self


class Noise(_Settings):
    """Variation of a source in space and time (`wlm.fluid.solver.Noise`).

    Attributes:
        amount: Largest change, relative to the source's density and temperature; they stay at least 0.
        size: Distance in metres, and `duration` time in seconds, over which it changes.
        seed: Number of the pattern.
    """

    amount: float = Field(1.0, ge=0.0, le=100.0)
    size: _Positive
    duration: _Positive = 1.0
    seed: int = Field(0, ge=0, le=2**31 - 1)


class Body(_Settings):
    """The form and the path of an obstacle or of a source, as `ObstacleSettings` describes them."""

    shape: Annotated[str, AfterValidator(_shape), PlainSerializer(_named)] = "sphere"
    radius: _Positive | tuple[_Positive, _Positive, _Positive] | None = None
    scale: _Positive = 1.0
    offset: _Vector = (0.0, 0.0, 0.0)
    centre: _Vector | None = None
    path: _Keys = ()
    turn: _Keys = ()
    shell: bool | None = None

    @model_validator(mode="after")
    def _sizes(self) -> Body:
        if not isinstance(self.radius, _SIZES.get(self.shape, NoneType)):
            text = "expected one number for a sphere, three for a box or cylinder, none for a mesh"
            raise PydanticCustomError("radius", text)
        if self.shape in _SIZES and (self.scale != 1.0 or self.shell is not None):
            raise PydanticCustomError("scale", f"expected scale and shell only for a mesh, found a {self.shape}")
        if (self.centre is None) == (not self.path):
            raise PydanticCustomError("path", "expected a centre, or positions with their times")
        if self._pieces.sum() > _MOST_PIECES:
            raise PydanticCustomError("turn", f"expected at most {_PIECE * _MOST_PIECES:,} degrees in all")
        return self

    @property
    def _pieces(self) -> np.ndarray:
        """Numbers of pieces of the rows of `turn` after the first, of less than half a turn each, int64 [K - 1]."""
        turned = np.abs(np.diff(np.array(self.turn).reshape(-1, 4)[:, 1:], axis=0)).sum(1)
        return np.ceil(np.maximum(turned / _PIECE, 1.0))

    @functools.cached_property
    def _keyed(self) -> Trajectory:
        """The path without ramps; positions in metres, times in seconds."""
        places = np.array(self.path or ((0.0, *(self.centre or ())),))
        angles = np.array(self.turn or ((0.0,) * 4,))
        rows = np.concatenate([[0], *(k + np.arange(1, n + 1) / n for k, n in enumerate(self._pieces.astype(int)))])
        angles = np.stack([np.interp(rows, np.arange(len(angles)), column) for column in angles.T], 1)
        if not self.turn:
            return Trajectory.of(places[:, 1:], places[:, 0])
        times = np.union1d(places[:, 0], angles[:, 0])
        at, turned = (np.stack([np.interp(times, k[:, 0], k[:, a]) for a in (1, 2, 3)], 1) for k in (places, angles))
        return Trajectory.of(at, times, Rotation.from_euler("xyz", turned, degrees=True).as_quat())

    @functools.cached_property
    def eased(self) -> Trajectory:
        """The path with ramps; positions in metres, times in seconds."""
        return self._keyed.eased(2.0 * float(np.abs(self.bounds).max()))

    @property
    def fastest(self) -> float:
        """Largest speed along the path, of a body that turns on its surface, in metres per second."""
        return self.fastest_in(0.0)

    def fastest_in(self, edge: float) -> float:
        """Returns `fastest` of the body as it is simulated in cells of an edge in metres."""
        speeds, spins = (np.linalg.norm(rates, axis=1) for rates in self._keyed.rates)
        reach = float(np.linalg.norm(self.mesh(edge)[0], axis=1).max()) if spins.any() else 0.0
        return float((speeds + reach * spins).max())

    @property
    def surface(self) -> Surface | None:
        """The surface in the mesh file; None for other shapes. Raises a WlmError if the file cannot be read."""
        return None if self.shape in _SIZES else read_surface(self.shape)

    def half_extents(self, edge: float) -> np.ndarray:
        """Returns those, (3,) in metres, of a sphere, box or cylinder as it is simulated in cells of an edge: enough to
        cover the centre of a cell wherever it is, so that a thin obstacle stops the air."""
        round_axes = {"sphere": (3, 3, 3), "cylinder": (2, 1, 2), "box": (1, 1, 1)}[self.shape]
        if self.turn:
            round_axes = (3, 3, 3)
        # The sides of a cylinder are segments, slightly inside the circle.
        least = 0.5 * edge * np.sqrt(round_axes) * np.where(np.array(round_axes) == 1, 1.0 + 1e-4, 1.01)
        return np.maximum(np.broadcast_to(np.asarray(self.radius, np.float64), 3), least)

    def mesh(self, edge: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Returns the surface relative to the origin, of a shape as thick as it is simulated in cells of an edge:
        corners, float64 [V, 3], and triangles, int64 [F, 3]."""
        if (read := self.surface) is not None:
            return read.points * self.scale + self.offset, read.triangles
        points, triangles = surface(self.shape)
        return points * self.half_extents(edge) + self.offset, triangles

    @functools.cached_property
    def solid(self) -> Mesh:
        """The surface in metres, at rest at the origin."""
        points, triangles = self.mesh()
        return Mesh(Trajectory.of((0.0, 0.0, 0.0)), points.astype(np.float32), triangles.astype(np.int32))

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the box around the surface, relative to the origin, float64 [2, 3]."""
        points = self.mesh()[0]
        return np.stack([points.min(0), points.max(0)])


class SourceSettings(Body):
    """A region within the box that emits smoke.

    Attributes:
        shape, radius, scale, offset, centre, path, turn, shell: As for `ObstacleSettings`.
        density, temperature, fuel: Values that are set in the region while the source is active.
        start, stop: Times in seconds between which the source is active, or as many of each; stop null: until the end.
        noise: Variation of density and temperature; null: none.
    """

    density: _NotNegative = 1.0
    temperature: _NotNegative = 0.0
    fuel: _NotNegative = 0.0
    start: _Number | tuple[_Number, ...] = 0.0
    stop: _Number | tuple[_Number | None, ...] | None = None
    noise: Noise | None = None

    @model_validator(mode="after")
    def _order(self) -> SourceSettings:
        count = {len(each) if isinstance(each, tuple) else 1 for each in (self.start, self.stop)}
        ends = [math.inf if time is None else time for span in self.spans for time in span]
        if len(count) > 1 or any(b <= a for a, b in zip(ends[::2], ends[1::2], strict=True)):
            raise PydanticCustomError("stop", "expected for each start a time after it, or null")
        return self

    @property
    def spans(self) -> list[tuple[float, float | None]]:
        """Times in seconds between which the source is active."""
        start, stop = (each if isinstance(each, tuple) else (each,) for each in (self.start, self.stop))
        return list(zip(start, stop, strict=False))

    def active(self, time: float) -> bool:
        """Returns whether the source is active at a time in seconds."""
        return any(start <= time and (stop is None or time < stop) for start, stop in self.spans)


class ObstacleSettings(Body):
    """A solid obstacle.

    Attributes:
        shape: "sphere", "box", "cylinder", whose axis is y, or the path of a mesh, relative to the scene's file.
        radius: Radius of a sphere in metres; for a box or cylinder half of its extents along x, y and z; null for a
            mesh.
        scale: Metres per unit of the mesh.
        offset: Place of the shape's centre, or of the mesh's origin, relative to the obstacle's own, in metres.
        centre: Position of the origin of an obstacle at rest, instead of `path`.
        path: Positions (time, x, y, z) between which the origin moves linearly; before and after them it rests. It
            starts, turns and stops while it moves by its largest diameter (`Trajectory.eased`).
        turn: Angles (time, x, y, z) in degrees, also of several turns, likewise: the obstacle is turned about its
            origin, first about the world's x, then about y, then about z.
        shell: Whether only the surface of a mesh is solid; null: if its holes are more than 5% of it, or if it is
            thinner than a cell.
        colour: Albedo R, G, B of the obstacle in pictures.
    """

    colour: _Colour = (0.12, 0.12, 0.13)


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
        """Returns the camera turned about `up` around its target; the paper uses 9 views, 10 degrees apart."""
        axis = np.array(self.up) / np.linalg.norm(self.up)
        toward, angle = np.array(self.toward), math.radians(degrees)
        along = axis * (axis @ toward)
        across = toward - along
        turned = along + math.cos(angle) * across + math.sin(angle) * np.cross(axis, across)
        return self.model_copy(update={"toward": tuple(map(float, turned))})


class LightSettings(_Settings):
    """A directional light, or a point light: either `toward` or `position` is given.

    Attributes:
        toward: Direction from the smoke to the light.
        irradiance: R, G, B on a surface that faces the light; lightmaps store the light for 4 pi, the default.
        position, intensity, radius: As for `wlm.smoke.shading.PointLight`, in metres.
    """

    toward: _Direction | None = None
    irradiance: _Brightness = (4 * math.pi,) * 3
    position: _Vector | None = None
    intensity: _Brightness = (1.0, 1.0, 1.0)
    radius: _NotNegative = 0.0

    @model_validator(mode="after")
    def _place(self) -> LightSettings:
        if (self.toward is None) == (self.position is None):
            raise PydanticCustomError("toward", "expected either a direction, toward, or a position")
        return self

    def light(self) -> AnyLight:
        """Returns the light that marches through smoke take."""
        if self.position is not None:
            return PointLight(self.position, self.intensity, self.radius)
        return Light(self.toward or (0.0, 1.0, 0.0), self.irradiance)

    def at(self, place: np.ndarray, least: float) -> LightSettings:
        """Returns the directional light that a light is at a place in metres, a point light from at least `least`
        metres away."""
        if self.position is None:
            return self
        away = np.asarray(self.position) - place
        length = float(np.linalg.norm(away))
        toward = away / length if length > _SHORTEST else np.array([0.0, 1.0, 0.0])
        irradiance = np.minimum(np.asarray(self.intensity) / max(length, least) ** 2, BRIGHTEST)
        return LightSettings(toward=tuple(toward.tolist()), irradiance=tuple(irradiance.tolist()))


class Looks(_Settings):
    """Settings for the picture of one frame of smoke: lights, colours and obstacles.

    Attributes:
        lights, background, obstacles: As in `Scene`.
        albedo, glow: As in `Smoke`; lightmaps with light of all orders of scattering already include the albedo.
        time: Time in seconds for which obstacles are placed on their paths.
    """

    lights: tuple[LightSettings, ...]
    background: _Colour = (0.0, 0.0, 0.0)
    albedo: _Albedo = (1.0, 1.0, 1.0)
    glow: _Glow = ()
    obstacles: tuple[ObstacleSettings, ...] = Field((), max_length=255)
    time: _Number = 0.0

    @property
    def ramp(self) -> Ramp | None:
        """Colour ramp of the emission; None: grey."""
        return Ramp(tuple(s[0] for s in self.glow), tuple(s[1:] for s in self.glow)) if self.glow else None


class Scene(_Settings):
    """All settings of a scene: its simulation and its pictures.

    Attributes:
        name: Name that reports show.
        grid, air, smoke: The box and its contents.
        inlets, sources, obstacles: Objects in the box.
        camera, lights, background: Settings of pictures; the background is a linear colour R, G, B.
        frames: Number of frames.
        rate: Frames per second; frame 1 shows the smoke 1 / rate seconds after the start.
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
        if self.air.wind and not self.windy:
            raise PydanticCustomError("wind", "expected an open face without an inlet, through which the wind enters")
        faces |= set(self.windy)
        if faces and all(face in faces or self.grid.face(face) != "open" for face in FACES):
            raise PydanticCustomError("inlets", "expected an open face without inlet or wind, for the air to leave")
        if self._growth and not set(self._free) - set(self.windy):
            raise PydanticCustomError("fire", "expected an open face without inlet or wind, for the gas to expand")
        if not self._least_steps <= MOST_STEPS:
            raise PydanticCustomError(
                "steps",
                f"expected at most {MOST_STEPS:,} steps per frame, found {self._least_steps:.3g}, for a speed of "
                f"{self.fastest:g} m/s, an acceleration of {self._acceleration:g} m/s2, a confinement of "
                f"{self.air.confinement:g} and a growth of {self._growth:g} per second and a viscosity of "
                f"{self.air.viscosity:g} m2/s in cells of {self.grid.cell:g} m at {self.rate:g} frames per second",
            )
        speed = max(self._speeds, default=0.0)
        if not speed * self.step <= FASTEST * self.grid.cell * (1.0 + 1e-9):
            raise PydanticCustomError(
                "speed",
                f"expected at most {FASTEST} cells per step, found an inlet, a wind or an obstacle of {speed:g} m/s, "
                f"{speed * self.step / self.grid.cell:.3g} cells per step: leave air.speed null or at least {speed:g}",
            )
        speed = max(self.fastest, math.sqrt(self._acceleration * float(self.grid.size.max())))
        least = speed * self.grid.cell / _CELL_REYNOLDS
        if self.air.smagorinsky < _LEAST_EDDIES and self.air.viscosity < least:
            raise PydanticCustomError(
                "viscosity",
                f"expected air.viscosity of at least {least:.3g} m2/s at {speed:.3g} m/s and air.smagorinsky below "
                f"{_LEAST_EDDIES}, found {self.air.viscosity:g}: the flow would blow up",
            )
        return self

    def time(self, frame: int) -> float:
        """Returns the time of a frame in seconds; frames count from 1."""
        return frame / self.rate

    def looks(self, frame: int) -> Looks:
        """Returns the settings for the picture of a frame; frames count from 1. Point lights become directional
        ones from the box's centre, since lightmaps know no others."""
        size = self.grid.size
        lights = tuple(light.at(self.grid.origin + 0.5 * size, 0.5 * float(size.min())) for light in self.lights)
        parts = {"lights": lights, "background": self.background, "obstacles": self.obstacles}
        return Looks(**parts, albedo=self.smoke.albedo, glow=self.glow, time=self.time(frame))

    def scaled(self, factor: float) -> Scene:
        """Returns the scene with its number of cells along each axis multiplied by a factor and rounded, at least 1.

        The length of the longest axis stays the same; other axes change by at most half a cell. Raises a ValueError if
        the factor is not above 0. Raises a WlmError if there are too many cells."""
        if not 0 < factor < math.inf:
            raise ValueError(f"factor: expected a number above 0, got {factor}")
        cells = tuple(max(round(n * factor), 1) for n in self.grid.cells)
        longest = int(np.argmax(self.grid.cells))
        cell = self.grid.cell * self.grid.cells[longest] / cells[longest]
        grid = check_settings(Grid, self.grid.model_dump() | {"cells": cells, "cell": cell}, f"{self.name}: grid.")
        return self.model_copy(update={"grid": grid})

    @property
    def windy(self) -> list[str]:
        """The faces through which the wind comes: open ones without an inlet through which it ever enters the box."""
        keys = np.zeros((0, 4)) if self.air.wind is None else np.array(self.air.wind.keys)
        entering = {face: (keys[:, 1 + k // 2] * (1 - 2 * (k % 2)) > 0.0).any() for k, face in enumerate(FACES)}
        return [face for face in self._free if entering[face]]

    @property
    def _free(self) -> list[str]:
        """The open faces without an inlet."""
        taken = {inlet.face for inlet in self.inlets}
        return [face for face in FACES if self.grid.face(face) == "open" and face not in taken]

    @property
    def fastest(self) -> float:
        """Speed in metres per second that moves air by `air.lattice_speed` cells in a step; 1 if nothing moves."""
        return self.air.speed or max(self._speeds, default=0.0) or 1.0

    @property
    def _speeds(self) -> list[float]:
        """Speeds of inlets, wind and obstacles in metres per second."""
        inlets = [float(np.linalg.norm(inlet.velocity)) for inlet in self.inlets]
        if self.air.wind is not None:
            inlets.append(self.air.wind.fastest)
        return [*inlets, *(obstacle.fastest_in(self.grid.cell) for obstacle in self.obstacles)]

    @property
    def _growth(self) -> float:
        """Largest growth of burning gas per second, as a share."""
        return 0.0 if self.smoke.fire is None else self.smoke.fire.growth

    @property
    def _flame(self) -> float:
        """Radius of the largest source of fuel in metres, at most that of the box."""
        radii = [float(np.max(each.radius or math.inf)) for each in (*self.inlets, *self.sources) if each.fuel]
        return min(max(radii, default=0.0), 0.5 * float(self.grid.size.max()))

    @property
    def glow(self) -> _Glow:
        """Colour ramp of the emission: the smoke's own, or else, of fire, that of black bodies. A ray has
        the colour of a flame of one temperature, as thick as the radius of the largest source of fuel."""
        fire, thick = self.smoke.fire, self.smoke.emission * (self._flame or self.grid.cell)
        if self.smoke.glow or fire is None or not thick:
            return self.smoke.glow
        kelvin = np.geomspace(900.0, max(2.0 * fire.flame, 4000.0), 24)
        light = thick * black_body_light(torch.from_numpy(kelvin)).numpy()
        stops = np.concatenate([light[:, None], light[:, None] * black_body_colour(kelvin)], 1)
        return ((0.0, 0.0, 0.0, 0.0), *map(tuple, stops.tolist()))

    @property
    def _outflow(self) -> float:
        """An upper bound of the speed in metres per second at which what comes in leaves through the open faces."""
        area = {face: float(np.prod(np.delete(self.grid.size, k // 2))) for k, face in enumerate(FACES)}
        out = sum(area[face] for face in self._free if face not in self.windy)
        flux = 0.0 if self.air.wind is None else sum(self.air.wind.fastest * area[face] for face in self.windy)
        for inlet in self.inlets:
            opening = area[inlet.face] if inlet.radius is None else math.pi * inlet.radius**2
            flux += abs(inlet.velocity[FACES.index(inlet.face) // 2]) * min(opening, area[inlet.face])
        return flux / out if out else 0.0

    @property
    def _acceleration(self) -> float:
        """Largest acceleration of air by smoke or turbulence, in metres per second squared."""
        emitters = [*self.inlets, *self.sources]
        burning = self.smoke.fire is not None  # up to a temperature of 1
        pulls = [
            (self.smoke.buoyancy * max(each.temperature, burning), self.smoke.weight * each.density)
            for each in emitters
        ]
        noise = max((each.noise.amount for each in self.sources if each.noise), default=0.0)
        stirring = 0.0 if self.air.turbulence is None else _PEAK * self.air.turbulence.strength
        return (1.0 + noise) * max(itertools.chain.from_iterable(pulls), default=0.0) + stirring

    @property
    def _least_steps(self) -> float:
        """Air steps per frame for which speed, acceleration, confinement and viscosity stay within their bounds."""
        cell = self.grid.cell
        outflow = max(self._outflow, self._growth * self._flame / 3.0)
        by_speed = max(self.fastest / self.air.lattice_speed, outflow / FASTEST) / (self.rate * cell)
        by_acceleration = math.sqrt(self._acceleration / (_ACCELERATION * cell)) / self.rate
        by_confinement = max(self.air.confinement / _CONFINEMENT, self._growth / _GROWTH) / self.rate
        by_viscosity = self.air.viscosity / (_VISCOSITY * cell * cell * self.rate)
        return max(by_speed, by_acceleration, by_confinement, by_viscosity)

    @property
    def steps(self) -> int:
        """Number of air steps per frame at the start, a multiple of `smoke.substeps`: the fewest that obey
        `air.lattice_speed` and the bounds of acceleration and viscosity. A simulation doubles it while air is faster.
        """
        return max(math.ceil(self._least_steps / self.smoke.substeps - 1e-9), 1) * self.smoke.substeps

    @property
    def step(self) -> float:
        """Duration of an air step in seconds."""
        return 1.0 / (self.rate * self.steps)


def load_scene(name: str | os.PathLike[str]) -> Scene:
    """Loads a scene by its name, from `configs/smoke-NAME.yaml`, or from any YAML file.

    Raises:
        WlmError: The scene is unknown, the file cannot be read, or a setting is wrong.
    """
    name = os.fspath(name)
    return load_settings(Scene, name if name.endswith((".yaml", ".yml")) else profile_path("smoke", name))


def make_camera(
    settings: CameraSettings, origin: Sequence[float] | np.ndarray, size: Sequence[float] | np.ndarray
) -> Camera:
    """Makes a camera in front of a box in the world with the lowest corner `origin` [3] and edges `size` [3]."""
    values = settings.model_dump()
    return Camera.around((origin, size), pixels=values.pop("resolution"), **values)


def obstacle_mesh(obstacles: Sequence[ObstacleSettings], time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the surfaces of obstacles at a time in seconds as triangles, for their pictures and shadows. These are
    corners, float32 [V, 3] in the world, triangles, int32 [F, 3], and the index of each triangle's obstacle, int32 [F].
    """
    corners, triangles, owner = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    first = 0
    for number, obstacle in enumerate(obstacles):
        points, faces = obstacle.mesh()
        corners.append(points @ obstacle.eased.turn(time).T + obstacle.eased.at(time))
        triangles.append(faces + first)
        owner.append(np.full(len(faces), number))
        first += len(points)
    joined = np.concatenate(corners), np.concatenate(triangles), np.concatenate(owner)
    return joined[0].astype(np.float32), joined[1].astype(np.int32), joined[2].astype(np.int32)
