"""Light probes in a window: balls and Gaussians."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from trimesh import Trimesh, creation

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry
from wlm.probe.gaussian.model import CENTRE, ROTATION, SCALE, Gaussians
from wlm.probe.model import ProbeModel
from wlm.probe.places import ball_exposure, ball_radius, probes_of
from wlm.probe.sphere import irradiance, irradiance_weights, sh_count, unit_or_zero
from wlm.view.canvas import Canvas
from wlm.view.scene import Scene, Slider, State
from wlm.view.surface import compared

_BALLS, _MESH, _GAUSSIANS = "balls", "mesh", "gaussians"
_DETAIL = ((64, 3), (1024, 2), (8192, 1), (10**9, 0))  # number of balls, and subdivisions of an icosahedron for each
_SIGMAS = Slider("sigma", 0.1, 3.0, 1.0, 0.1, views=("gaussians",))
_GREY = 40  # grey level of the mesh in the error panel, which shows only probes


@dataclass(frozen=True, eq=False)
class Probes:
    """The live probes of a model, at positions float64 [N, 3].

    `values`, float32 [N, C, 3] each, are named "decoded" and, if they are known, "original"; `decode` returns light
    float32 [M, 3 C] at points [M, 3]. `model` is the model if it has Gaussians, else None; `note` is for the caption of
    the window.
    """

    position: np.ndarray
    values: dict[str, np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]
    model: ProbeModel | None
    note: str


def model_probes(
    model: ProbeModel, original: str | os.PathLike[str] | None, key: str | None, title: str, time: float | None = None
) -> Probes:
    """Takes the probes of a model of one hour; the other arguments are those of `wlm.probe.places.probes_of`."""
    position, given, live, _ = probes_of(model, original, key, time)
    count = _coefficients(model.outputs, title)
    decoder, places = model.decoder(position=position), position[live]
    values = {"decoded": decoder.decode_probes()[live].reshape(-1, count, 3)}
    if given is not None:
        values["original"] = given[live].reshape(-1, count, 3)
    shapes = model if isinstance(model.content, Gaussians) else None
    gaussians = "" if shapes is None else f"{shapes.content.count:,} Gaussians, "
    note = f"{model.name}, {len(places):,} probes, {gaussians}profile {model.profile.name}"
    return Probes(places, values, decoder.decode, shapes, note)


def probe_scene(probes: Probes, *, title: str, geometry: Geometry | None = None, up: int = 1) -> Scene:
    """Makes the scene of probes, with a mesh that is lit at its vertices."""
    return _ProbeScene(
        title,
        compared("original" in probes.values),
        views=("balls", "gaussians") if probes.model is not None else ("balls",),
        sliders=(_SIGMAS,) if probes.model is not None else (),
        up=up,
        room=geometry is not None and geometry.is_room,
        probes=probes,
        geometry=geometry,
    )


@dataclass(kw_only=True)
class _ProbeScene(Scene):
    probes: Probes
    geometry: Geometry | None

    def __post_init__(self) -> None:
        probes = self.probes
        self._radius = ball_radius(probes.position)
        subdivisions = next(level for most, level in _DETAIL if len(probes.position) <= most)
        self._ball, self._ball_faces = _icosphere(subdivisions)
        points = probes.position[:, None] + self._radius * self._ball
        faces = self._ball_faces + len(self._ball) * np.arange(len(probes.position))[:, None, None]
        self._balls = points.reshape(-1, 3), faces.reshape(-1, 3)
        self._light = {name: _diffuse(values, self._ball) for name, values in probes.values.items()}
        self._brightness = ball_exposure(probes.values.get("original", probes.values["decoded"]))
        self._surface: np.ndarray | None = None
        if self.geometry is not None:
            at_vertices = probes.decode(self.geometry.position.astype(np.float64))
            at_vertices = at_vertices.reshape(len(at_vertices), -1, 3)
            weights = irradiance_weights(_normals(self.geometry), at_vertices.shape[1])
            self._surface = np.maximum(np.einsum("vc,vcd->vd", weights, at_vertices), 0.0) / math.pi

    def draw(self, canvas: Canvas, state: State) -> None:
        display = state.display(self._brightness)
        for panel, name in enumerate(self.panels):
            if name == "error":
                colours = display.error(self._light["decoded"], self._light["original"])
            else:
                colours = display.picture(self._light[name])
            if panel or state.view == "balls":
                canvas.coloured(panel, _BALLS, *self._balls, colours.reshape(-1, 3))
            if self._surface is not None:
                decoded = name == "decoded"
                lit = display.picture(self._surface) if decoded else np.full(self._surface.shape, _GREY, np.uint8)
                place = self.geometry.position, self.geometry.triangle
                canvas.coloured(panel, _MESH, *place, lit, shape=not decoded, one_sided=self.room)
        if state.view == "gaussians":
            canvas.hide(0, _BALLS, _MESH)
            self._draw_gaussians(canvas, state)
        else:
            canvas.hide(0, _GAUSSIANS)

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        points = self.probes.position
        if self.geometry is not None:
            points = np.concatenate([points, *np.stack(self.geometry.box)[:, None]])
        return points.min(0) - self._radius, points.max(0) + self._radius

    def caption(self, state: State) -> str:
        return self.probes.note

    def _draw_gaussians(self, canvas: Canvas, state: State) -> None:
        model = self.probes.model
        rows = model.content.rows().astype(np.float64)
        turn = Rotation.from_quat(np.roll(rows[:, ROTATION], -1, axis=1)).as_matrix()  # scipy has w last
        shape = turn * np.exp(rows[:, SCALE])[:, None, :]
        centre = model.origin + model.extent * rows[:, CENTRE]
        ball, faces = _icosphere(1)
        reach = state.values["sigma"] * model.extent
        points = centre[:, None] + reach * np.einsum("kij,vj->kvi", shape, ball)
        values = self.probes.decode(centre).reshape(len(centre), -1, 3)
        light = np.maximum(values[:, 0] / math.sqrt(4.0 * math.pi), 0.0)
        colours = state.display(self._brightness).picture(light).repeat(len(ball), 0)
        faces = faces + len(ball) * np.arange(len(centre))[:, None, None]
        canvas.coloured(0, _GAUSSIANS, points.reshape(-1, 3), faces.reshape(-1, 3), colours, shape=True)


def _coefficients(outputs: int, title: str) -> int:
    count = sh_count(outputs)
    if count is None:
        raise WlmError(f"{title}: expected probes of RGB spherical harmonics, found {outputs} numbers a probe")
    return count


def _icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    sphere = creation.icosphere(subdivisions=subdivisions)
    return np.array(sphere.vertices), np.array(sphere.faces)


def _diffuse(values: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the radiance of white diffuse surfaces with normals [M, 3] under SH [..., C, 3], float64 [..., M, 3]."""
    return np.maximum(irradiance(values, normals), 0.0) / math.pi


def _normals(geometry: Geometry) -> np.ndarray:
    normals = unit_or_zero(Trimesh(geometry.position, geometry.triangle, process=False).vertex_normals)
    return np.where(normals.any(1, keepdims=True), normals, [0.0, 1.0, 0.0])
