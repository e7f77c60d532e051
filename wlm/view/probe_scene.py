"""Light probes in a window: balls, Gaussians, and the cascaded volume around a moving viewer."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh, creation

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry
from wlm.probe.data import ProbeSet
from wlm.probe.gaussian.model import CENTRE, ROTATION, SCALE, Gaussians
from wlm.probe.model import ProbeModel
from wlm.probe.places import ball_exposure, ball_radius, probes_of
from wlm.probe.sphere import irradiance, irradiance_weights, sh_count, unit_or_zero
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import camera_path, settle
from wlm.view.canvas import Canvas
from wlm.view.scene import Scene, Slider, State, frame_slider
from wlm.view.surface import compared

_BALLS, _MESH, _GAUSSIANS, _BLOCKS, _PATH, _VIEWER = "balls", "mesh", "gaussians", "blocks", "path", "viewer"
_DETAIL = ((64, 3), (1024, 2), (8192, 1), (10**9, 0))  # number of balls, and subdivisions of an icosahedron for each
_LOOP = 120  # frames of the default walk
_SIGMAS = Slider("sigma", 0.1, 3.0, 1.0, 0.1, views=("gaussians",))
_GREY = 40  # grey level of the mesh in the error panel, which shows only probes
# Colours of the levels' windows, the finest first.
_WINDOWS = ((1.0, 1.0, 1.0), (1.0, 0.8, 0.3), (1.0, 0.5, 0.3), (0.8, 0.3, 0.9))
_SHRUNK = 0.8  # drawn size of a block, so that neighbours stay apart


@dataclass(frozen=True, eq=False)
class Probes:
    """The live probes of a file, at positions float64 [N, 3].

    `values`, float32 [N, C, 3] each, are named "decoded" or "original" or both; `decode` returns light float32 [M, 3 C]
    at points [M, 3]. `model` is the model if it has Gaussians, else None; `note` is for the caption of the window.
    """

    position: np.ndarray
    values: dict[str, np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]
    model: ProbeModel | None
    note: str


def model_probes(
    model: ProbeModel,
    original: str | os.PathLike[str] | None,
    key: str | None,
    title: str,
    time: float | None = None,
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


def set_probes(probes: ProbeSet, title: str) -> Probes:
    """Takes the probes of an input file; the light between probes is that of the nearest one."""
    count = _coefficients(probes.outputs, title)
    places, values = probes.position[probes.live], probes.values[probes.live]
    tree = cKDTree(places)

    def nearest(points: np.ndarray) -> np.ndarray:
        return values[tree.query(points)[1]]

    shown = {"original": values.reshape(-1, count, 3)}
    note = f"{probes.name}, {len(places):,} live probes, {probes.key}"
    return Probes(places, shown, nearest, None, note)


def probe_scene(
    probes: Probes,
    *,
    title: str,
    geometry: Geometry | None = None,
    walk: np.ndarray | None = None,
    block: float | None = None,
    up: int = 1,
) -> Scene:
    """Makes the scene of probes, with a mesh that is lit at its vertices.

    `walk`, [F, 3], are viewpoints of the cascaded volume, None for a loop through the scene, and `block` the side of
    its finest blocks, None to derive it from the probes' spacing.
    """
    light = StoredLight(next(iter(probes.values.values())))  # the decoded light, or else the original
    volume = Volume(probes.position, light, block=block)
    path = walk if walk is not None else camera_path(volume.position, _LOOP, up=up)
    views = ("balls", "gaussians", "volume") if probes.model is not None else ("balls", "volume")
    sliders = frame_slider(len(path), ("volume",)) + (_SIGMAS,) * (probes.model is not None)
    return _ProbeScene(
        title,
        compared("decoded" in probes.values, "original" in probes.values),
        views=views,
        sliders=sliders,
        plays="frame" if len(path) > 1 else None,
        up=up,
        room=geometry is not None and geometry.is_room,
        probes=probes,
        geometry=geometry,
        path=path,
        volume=volume,
    )


@dataclass(kw_only=True)
class _ProbeScene(Scene):
    probes: Probes
    geometry: Geometry | None
    path: np.ndarray
    volume: Volume

    def __post_init__(self) -> None:
        probes = self.probes
        self._frame, self._stats = None, None
        self._radius = ball_radius(probes.position)
        subdivisions = next(level for most, level in _DETAIL if len(probes.position) <= most)
        self._ball, self._ball_faces = _icosphere(subdivisions)
        points = probes.position[:, None] + self._radius * self._ball
        faces = self._ball_faces + len(self._ball) * np.arange(len(probes.position))[:, None, None]
        self._balls = points.reshape(-1, 3), faces.reshape(-1, 3)
        self._light = {name: _diffuse(values, self._ball) for name, values in probes.values.items()}
        self._brightness = ball_exposure(probes.values.get("original", next(iter(probes.values.values()))))
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
                decoded = name != "error" and (name == "decoded" or "decoded" not in self.panels)
                lit = display.picture(self._surface) if decoded else np.full(self._surface.shape, _GREY, np.uint8)
                place = self.geometry.position, self.geometry.triangle
                canvas.coloured(panel, _MESH, *place, lit, shape=not decoded, one_sided=self.room)
        windows = [f"window {level}" for level in range(len(self.volume.sizes))]
        if state.view != "balls":
            canvas.hide(0, _BALLS, _MESH)
        if state.view != "gaussians":
            canvas.hide(0, _GAUSSIANS)
        if state.view != "volume":
            canvas.hide(0, _BLOCKS, _PATH, _VIEWER, *windows)
        if state.view == "gaussians":
            self._draw_gaussians(canvas, state)
        elif state.view == "volume":
            self._draw_volume(canvas, state, windows)

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        points = self.probes.position
        if self.geometry is not None:
            points = np.concatenate([points, *np.stack(self.geometry.box)[:, None]])
        return points.min(0) - self._radius, points.max(0) + self._radius

    def caption(self, state: State) -> str:
        text = self.probes.note
        if state.view == "volume" and self._stats is not None:
            held, waiting = sum(valid.sum() for valid in self.volume.unscroll()[1]), self._stats.left
            size = self.volume.sizes[0]
            text += f"; {held:,} blocks, the finest {size:.3g} wide, {self._stats.updated} new, {waiting:,} waiting"
        return text

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

    def _draw_volume(self, canvas: Canvas, state: State, windows: list[str]) -> None:
        frame = state.frame
        if frame != self._frame:
            # After a jump the volume is filled completely; the next frame fills one frame's budget.
            if self._frame is None or frame != self._frame + 1:
                settle(self.volume, self.path[frame])
            self._stats = self.volume.update(self.path[frame])
            self._frame = frame
        values, valid = self.volume.unscroll()
        centres, sides, light = [], [], []
        inner = None
        for level, size in enumerate(self.volume.sizes):
            place = np.argwhere(valid[level])
            centre = (self.volume.base[level] + place + 0.5) * size
            # Blocks that a finer window covers are not read.
            seen = np.ones(len(centre), bool)
            if inner is not None:
                seen = ((centre < inner[0]) | (centre > inner[1])).any(1)
            low = self.volume.base[level] * size
            inner = low, low + self.volume.sides[level] * size
            canvas.box(0, windows[level], *inner, _WINDOWS[level % len(_WINDOWS)])
            centres.append(centre[seen])
            sides.append(np.full(seen.sum(), _SHRUNK * size))
            light.append(values[level][tuple(place[seen].T)])
        centre, size, values = np.concatenate(centres), np.concatenate(sides), np.concatenate(light)
        cube = creation.box()  # of side 1; its triangles share no corners, so that each face has its own colour
        points = centre[:, None] + size[:, None, None] * cube.triangles.reshape(-1, 3)
        shown = _diffuse(values.reshape(len(values), -1, 3), cube.face_normals.repeat(3, 0))
        colours = state.display(self._brightness).picture(shown).reshape(-1, 3)
        canvas.coloured(0, _BLOCKS, points.reshape(-1, 3), np.arange(len(colours)).reshape(-1, 3), colours)
        if len(self.path) > 1:
            canvas.line(0, _PATH, self.path, "#ff4040")
        ball, faces = _icosphere(2)
        viewer = self.path[frame] + self.volume.sizes[0] * ball
        canvas.coloured(0, _VIEWER, viewer, faces, np.full(ball.shape, (255, 60, 60), np.uint8), shape=True)


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
