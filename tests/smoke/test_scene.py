"""Scenes from YAML, cameras, moving obstacles, folders of frames, and files of lightmaps."""

import copy
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
import yaml
from builders.checks import error_of
from builders.random_scenes import random_scene
from builders.smoke_plumes import SCENE, SPHERE, plume, write_frames
from pydantic import ValidationError

from wlm.config import check_settings, profile_names
from wlm.errors import WlmError
from wlm.fluid.black_body import black_body_luminance
from wlm.fluid.faces import FACES
from wlm.fluid.obstacles import Trajectory, cells_of
from wlm.fluid.volume import load_volume
from wlm.formats.exr import read_planes, write_planes
from wlm.smoke import simulation
from wlm.smoke.data import CHECKPOINT, NumberedFiles, load_frames, open_frames, read_six_way, spread, write_six_way
from wlm.smoke.march.six_way import bake
from wlm.smoke.scene import (
    CameraSettings,
    LightSettings,
    Looks,
    ObstacleSettings,
    Scene,
    Smoke,
    SourceSettings,
    load_scene,
    make_camera,
    obstacle_mesh,
)
from wlm.smoke.shading import PointLight
from wlm.smoke.simulation import warnings_of
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import orders_march
from wlm.view.smoke import Drawing

BOX = {"shape": "box"}
QUICK = (*range(5), 111, 121, 129)
"""Random scenes of every run; in the last three an inlet or a body was once without effect or too fast."""
GRID = {"cells": [4, 4, 4], "cell": 1}


RESTING = BOX | {"radius": [0.4, 0.4, 0.4], "path": [[0, 0, 0.5, 0]]}


def _scene(tmp_path, **changed):
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(SCENE | changed))
    return load_scene(path)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, None),
        ({"inlets": []}, "sources, inlets: there are none"),
        ({"sources": [{"centre": [5, 5, 5], "radius": 0.1}]}, "sources.0: it is outside the box from"),
        ({"sources": [{"centre": [0, 0.5, 0.5], "radius": 0.1}]}, None),
        ({"sources": [{"centre": [0, 0.5, 0], "radius": 0.1, "start": 9}]}, "sources.0: it is not active at a step"),
        ({"sources": [{"centre": [0, 0.5, 0], "radius": 0.1, "start": 0.011, "stop": 0.012}]}, "sources.0: it is not"),
        ({"sources": [{"centre": [0, 0.5, 0], "radius": 0.02}]}, "sources.0: it is smaller than a voxel of 0.05 m"),
        ({"sources": [{"centre": [0.52, 0.5, 0.5], "radius": 0.05}]}, "sources.0: it reaches no voxel's centre"),
        ({"sources": [{"centre": [0, 0.5, 0], "radius": 0.1, "density": 0, "temperature": 1}]}, "sources.0: temper"),
        ({"sources": [{"centre": [0, 0.5, 0], "radius": 0.1}], "obstacles": [RESTING]}, "sources.0: it is inside an"),
        ({"sources": [{"centre": [0, 0.5, 0], "radius": 0.1}], "obstacles": [SPHERE | {"radius": 0.3}]}, None),
        ({"obstacles": [RESTING | {"path": [[0, 0, 0, 0]]}]}, "inlets.0: an obstacle covers it"),
        ({"inlets": [SCENE["inlets"][0], copy.deepcopy(SCENE["inlets"][0]) | {"radius": None}]}, "inlets.0: a later"),
        ({"obstacles": [SPHERE | {"radius": 0.18, "path": [[0, 2, 0, 0], [9, 0, 0.6, 0]]}]}, "obstacles.0: it is out"),
        ({"obstacles": [SPHERE]}, "obstacles.0: it is thinner than a cell of 0.2 m"),
        ({"obstacles": [SPHERE | {"radius": 0.18}]}, None),
        ({"obstacles": [SPHERE | {"radius": 0.18, "path": [[0, 2, 0, 0]]}]}, "obstacles.0: it is outside the box"),
        ({"obstacles": [BOX | {"radius": [2, 0.01, 2], "path": [[0, 0, 1.3, 0]]}]}, "obstacles.0: it is outside"),
    ],
)
def test_what_has_no_effect_is_said(tmp_path, changed, words):
    warnings = warnings_of(_scene(tmp_path, **changed))
    assert len(warnings) == (words is not None) and all(f"plume: {words}" in each for each in warnings)


@pytest.mark.parametrize("shape", ["sphere", "box", "cylinder"])
def test_a_thin_obstacle_covers_a_cell_wherever_it_is(tmp_path, shape):
    radius = 0.01 if shape == "sphere" else [0.01, 0.01, 0.01]
    scene = _scene(tmp_path, obstacles=[{"shape": shape, "radius": radius, "path": [[0, 0, 0.6, 0]]}])
    (obstacle,) = simulation._obstacles(scene)
    for position in [[2.0, 3.0, 2.0], *np.random.default_rng(2).uniform(1, 4, (40, 3))]:
        solid = cells_of([replace(obstacle, path=Trajectory.of(position))], scene.grid.cells)
        assert 1 <= solid.numpy().sum() <= 8
    # A wall through the box has no hole.
    wall = {"shape": "box", "radius": [1, 0.004, 1], "path": [[0, 0, 0.6, 0]]}
    (obstacle,) = simulation._obstacles(_scene(tmp_path, obstacles=[wall]))
    for height in np.linspace(1, 4, 31):
        moved = replace(obstacle, path=Trajectory.of((2.5, height, 2.5)))
        assert cells_of([moved], scene.grid.cells).numpy().any(1).all()


def test_a_source_smaller_than_a_voxel_emits_its_amount(tmp_path):
    """Wherever it is, it reaches a voxel, with the density of the share of it that the source fills."""
    for centre in [[0.0, 0.5, 0.0], *np.random.default_rng(1).uniform([-0.5, 0, -0.5], [0.5, 1.2, 0.5], (9, 3))]:
        source = {"centre": list(map(float, centre)), "radius": 0.02, "density": 5.0}
        solver = simulation.make_solver(_scene(tmp_path, inlets=[], sources=[source]))
        solver.step()
        density = solver.density.numpy()
        assert 1 <= np.count_nonzero(density) <= 8
        assert density.max() == pytest.approx(5.0 * (0.02 / (0.505 * math.sqrt(3) * 0.05)) ** 3)


@pytest.mark.parametrize("seed", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in range(200)])
def test_random_scenes(seed, tmp_path):
    """Each runs to its end with finite values, or is refused in one line before its first frame."""
    try:
        scene = check_settings(Scene, random_scene(seed, tmp_path), "")
        solver = simulation.make_solver(scene)
    except WlmError as error:
        assert "\n" not in str(error)
        return
    warnings, smoke, bodies = simulation.warnings_of(scene), False, set()
    for frame in range(1, scene.frames + 1):
        simulation.advance(scene, solver, frame)
        solver.check()
        assert np.isfinite(solver.velocity.numpy()).all()
        density = solver.density.numpy()
        assert np.isfinite(density).all() and density.min() >= 0.0
        smoke, bodies = smoke or density.any(), bodies | set(np.unique(solver.solid.numpy()).tolist())
    emitters = sum(bool(each.density) for each in (*scene.sources, *scene.inlets))
    assert smoke or emitters <= sum("sources" in each or "inlets" in each for each in warnings)
    for k, body in enumerate(scene.obstacles):
        assert k + 1 in bodies or body.eased.moves or any(f"obstacles.{k}:" in each for each in warnings)
    volume = simulation.volume_of(scene, solver)
    camera = make_camera(CameraSettings(resolution=6), scene.grid.origin, scene.grid.size)
    lights = [light.light() for light in scene.lights]
    drawing = Drawing(camera, lights, obstacles=scene.obstacles)
    drawing.move(scene.time(scene.frames))
    assert torch.isfinite(drawing(light_smoke(drawing.among(volume), camera, lights, orders_march(volume)))).all()


def test_fire_of_a_scene(tmp_path):
    """Its frames have kelvins, its picture the light and the colours of black bodies; it needs room and short steps."""
    smoke = {"emission": 2.0, "fire": {"rate": 1.0, "expansion": 0.1, "flame": 2000.0}}
    source = {"centre": [0, 0.6, 0], "radius": 0.2, "density": 0, "temperature": 1.0, "fuel": 1.0}
    scene = _scene(tmp_path, inlets=[], sources=[source], smoke=smoke, frames=1)
    assert warnings_of(scene) == []
    assert scene.steps * scene.rate >= 0.1 * (2000 / 293 - 1) / 0.01
    frames = open_frames(tmp_path / "fire", scene)
    assert simulation.simulate(frames) == 1
    assert load_volume(frames.file(1), kelvin=False).temperature.max() == pytest.approx(2000.0, rel=0.01)
    volume = load_frames(tmp_path / "fire").load(1)
    hot = float(black_body_luminance(2000.0) / black_body_luminance(1500.0))
    assert volume.kelvin and volume.temperature.max() == pytest.approx(hot, rel=0.02)
    solver = simulation.make_solver(scene)
    simulation.advance(scene, solver, 1)
    heat = simulation.volume_of(scene, solver).temperature
    torch.testing.assert_close(heat, volume.temperature, rtol=2e-3, atol=1e-6)
    # A flame as thick as the source is white where it is 2,000 K, in the light of a black body.
    (red, green, blue), light = scene.looks(1).ramp(torch.tensor([2.0 * 0.2 * hot]))[0].tolist(), 2.0 * 0.2 * hot
    assert 0.2126 * red + 0.7152 * green + 0.0722 * blue == pytest.approx(light, rel=0.01) and red > green > 4 * blue
    assert "only together" in warnings_of(_scene(tmp_path, sources=[source]))[-1]
    with pytest.raises(WlmError, match="for the gas to expand"):
        _scene(tmp_path, smoke=smoke, grid=GRID | {"faces": dict.fromkeys(FACES, "wall")}, inlets=[])


def test_wind_of_a_scene(tmp_path):
    """It takes the open faces through which it ever enters, bounds the step, and needs a way out."""
    air = {"wind": {"keys": [[0, 1, 0, 0.5], [1, 4, 0, -0.5]], "gusts": 0.5}}
    scene = _scene(tmp_path, inlets=[], air=air)
    assert scene.windy == ["-x", "-z", "+z"] and scene.fastest == pytest.approx(1.5 * math.hypot(4, 0.5))
    assert _scene(tmp_path, inlets=[], air={"confinement": 50.0}).steps >= 50 / 0.02 / scene.rate
    stirred = _scene(tmp_path, air={"turbulence": {"strength": 1.0, "size": 0.1}})
    assert [each.split(": ")[1] for each in simulation.warnings_of(stirred)] == ["air.turbulence"]
    for wind, words in (([[0, 0, -1, 0]], "through which the wind enters"), ([[0, 1, 0, 0]], "for the air to leave")):
        with pytest.raises(WlmError, match=words):
            walls = GRID | {"faces": dict.fromkeys(FACES[1:], "wall")}
            _scene(tmp_path, inlets=[], air={"wind": {"keys": wind}}, grid=walls)


def test_a_scene_from_a_file(tmp_path):
    scene = _scene(tmp_path, obstacles=[SPHERE])
    assert (scene.grid.shape, scene.grid.voxel) == ((20, 24, 20), 0.05)
    np.testing.assert_allclose(scene.grid.size, [1.0, 1.2, 1.0])
    assert (scene.grid.face("+x"), scene.time(3)) == ("open", pytest.approx(0.3))
    # 1 m/s is 5 cells a second, at most 0.1 cells a step; the sphere moves 0.8 m in 0.4 s, twice as fast.
    assert (scene.fastest, scene.steps) == (pytest.approx(2.0), 10)
    assert scene.step == pytest.approx(0.01) and scene.fastest * scene.step / scene.grid.cell <= 0.1 + 1e-9
    assert _scene(tmp_path, inlets=[]).fastest == 1.0


@pytest.mark.parametrize("name", ["jet-sphere", "jet-moving", "explosion", "chimney"])
def test_the_scenes_that_there_are(name):
    scene, cells = load_scene(name), (140, 100, 60) if name == "chimney" else (100, 100, 100)
    assert name in profile_names("smoke")
    # Nothing begins out of the box, and the paper's grids are meant.
    assert scene.grid.cells == cells and scene.grid.shape == tuple(4 * n for n in cells)
    box = scene.grid.origin + scene.grid.size
    for time in np.linspace(0, scene.time(scene.frames), 9):
        for obstacle in scene.obstacles:
            assert (np.abs(obstacle.eased.at(time) - 0.5 * box) + obstacle.radius <= 0.5 * box).all()
    assert scene.inlets or scene.sources
    small = scene.scaled(0.2)
    assert small.grid.cells == tuple(n // 5 for n in cells)
    np.testing.assert_allclose(small.grid.size, scene.grid.size)
    # The growth of fire is the same in any cells.
    assert small.steps * 5 < scene.steps * 2 or scene.smoke.fire


def test_scaling_keeps_one_cell(tmp_path):
    scene = _scene(tmp_path, grid={"cells": [8, 1, 2], "cell": 1.0})
    small = scene.scaled(0.25)
    assert small.grid.cells == (2, 1, 1) and small.grid.cell == 4.0
    assert _scene(tmp_path, grid={"cells": [1, 1, 1], "cell": 1.0}).scaled(0.01).grid.cells == (1, 1, 1)
    assert "plume: grid.cells.0: expected less than or equal to 4096, got 8000" in error_of(scene.scaled, 1000)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"grid": GRID | {"faces": {"-x": "periodic"}}}, "both faces of an axis"),
        ({"smoke": {"glow": [[0, 1, 1, 1]]}}, "smoke.glow: expected no stops, or at least two whose emission"),
        ({"sources": [{"centre": [0, 0, 0], "radius": 1, "start": 2, "stop": 1}]}, "expected for each start a time"),
        ({"obstacles": [SPHERE | {"path": [[0, 0, 0, 0], [0, 1, 1, 1]]}]}, "0.path: expected times that increase"),
        ({"inlets": [{"face": "+y", "velocity": [0, 1, 0]}]}, "inlets.0.velocity: expected a velocity that points"),
        ({"grid": GRID | {"faces": dict.fromkeys(FACES, "wall")}}, "expected an open face"),
        ({"grid": GRID | {"faces": dict.fromkeys(("-y", "+y"), "periodic")}}, "inlets on faces that aren't periodic"),
        ({"air": {"wind": {"keys": [[0, 1, 0]]}}}, "air.wind.keys"),
        ({"air": {"wind": {"keys": [[0, 1e300, 0, 0]]}}}, "of numbers up to 1e+18"),
        ({"air": {"wind": {"keys": [[0, 1, 0, 0]], "gust": 1}}}, "air.wind.gust"),
        ({"air": {"wind": {"keys": [[0, 1, 0, 0]], "gusts": 2}}}, "expected 0 to 1"),
        ({"air": {"turbulence": {"strength": ".nan", "size": 1}}}, "air.turbulence.strength"),
        ({"air": {"speed": 0.3}}, "a wind or an obstacle of 1 m/s, 0.25 cells per step: leave air.speed null or"),
        ({"air": {"lattice_speed": 0.21}}, "air.lattice_speed: expected less than or equal to 0.2"),
        ({"air": {"smagorinsky": 0, "viscosity": 0}}, "expected air.viscosity of at least 0.002 m2/s at 1 m/s"),
        ({"air": {"viscosity": 1e9}}, "expected at most 1,000,000 steps per frame, found 2.5e+09"),
        ({"smoke": {"weight": 1e18}}, "expected at most 1,000,000 steps per frame"),
        ({"camara": {}}, "unknown key 'camara'; did you mean 'camera'?"),
    ],
)
def test_what_a_scene_may_not_be(tmp_path, changed, said):
    with pytest.raises(WlmError, match="scene.yaml") as caught:
        _scene(tmp_path, **changed)
    assert said in str(caught.value) and "\n" not in str(caught.value) and "{" not in str(caught.value)


def test_an_obstacle_on_its_path():
    there = ObstacleSettings(radius=1.0, path=((1.0, 0, 0, 0), (3.0, 4, 0, 0), (4.0, 4, 2, 0)))
    for time, centre in ((0.0, (0, 0, 0)), (2.0, (2, 0, 0)), (3.5, (4, 1, 0)), (9.0, (4, 2, 0))):
        np.testing.assert_allclose(there.eased.at(time), centre)
    assert there.fastest == 2.0 and ObstacleSettings(radius=1.0, path=((0.0, 1, 2, 3),)).fastest == 0.0
    with pytest.raises(ValidationError):
        ObstacleSettings(radius=(1.0, 1.0, 1.0), path=((0.0, 0, 0, 0),))


def test_the_surfaces_of_obstacles():
    ball = ObstacleSettings(radius=0.5, path=((0.0, 1, 2, 3),))
    box = ObstacleSettings(shape="box", radius=(1.0, 2.0, 3.0), path=((0.0, 0, 0, 0),))
    drum = ObstacleSettings(shape="cylinder", radius=(0.5, 2.0, 1.0), path=((0.0, 1, 2, 3),))
    for body, volume in ((ball, 4 / 3 * math.pi * 0.125), (box, 48.0), (drum, 2 * math.pi)):
        points, triangles, owner = obstacle_mesh([body], 0.0)
        assert points.dtype == np.float32 and triangles.dtype == np.int32 and not owner.any()
        a, b, c = (points[triangles[:, i]].astype(np.float64) - body.eased.at(0.0) for i in range(3))
        # Each triangle and the centre make a tetrahedron; those of a closed surface fill the body once, and where the
        # corners run anticlockwise from outside each counts as positive.
        parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
        assert (parts > 0).all() and parts.sum() == pytest.approx(volume, rel=0.02)
    distance = np.linalg.norm(obstacle_mesh([ball], 0.0)[0] - [1, 2, 3], axis=1)
    np.testing.assert_allclose(distance, 0.5, rtol=1e-5)
    points, triangles, owner = obstacle_mesh([box, ball], 0.0)
    assert triangles.max() == len(points) - 1 and (owner[:12] == 0).all() and (owner[12:] == 1).all()
    assert [len(part) for part in obstacle_mesh([], 0.0)] == [0, 0, 0]


def test_a_source_works_for_its_time():
    source = SourceSettings(centre=(0, 0, 0), radius=1, start=1, stop=2)
    assert [source.active(time) for time in (0.9, 1.0, 1.9, 2.0)] == [False, True, True, False]
    assert SourceSettings(centre=(0, 0, 0), radius=1).active(1e9)


@pytest.mark.parametrize("toward", [(0, 0, 1), (0, 1, 0), (-1, 0, 0), (1, 2, -3)])
def test_a_camera_holds_the_box(toward):
    """All corners are in the image, the longest side nearly fills it, and the box is in front of the camera."""
    origin, size = np.array([3.0, -1.0, 2.0]), np.array([1.0, 4.0, 2.0])
    corners = origin + size * np.array([[i >> 2, i >> 1 & 1, i & 1] for i in range(8)])
    for aspect in (1.0, 0.5, 3.0):
        camera = make_camera(CameraSettings(toward=toward, aspect=aspect, resolution=40), origin, size)
        assert (camera.height, camera.width) == (40, round(40 * aspect))
        seen = (corners - camera.position) @ camera.axes.T
        half = 0.5 * camera.extent * np.array([aspect, 1.0])
        share = (np.abs(seen[:, :2]) / half).max()
        assert share == pytest.approx(1 / 1.05) and (seen[:, 2] < 0).all()
        eye = make_camera(CameraSettings(toward=toward, aspect=aspect, resolution=40, perspective=True), origin, size)
        seen = (corners - eye.position) @ eye.axes.T
        assert (np.abs(seen[:, :2] / seen[:, 2:]) < 0.5 * eye.extent * np.array([aspect, 1.0])).all()


def test_a_camera_as_it_is_told():
    settings = CameraSettings(toward=(0, 0, 2), target=(1, 2, 3), extent=5, distance=7)
    camera = make_camera(settings, (0, 0, 0), (1, 1, 1))
    np.testing.assert_allclose(camera.position, (1, 2, 10))
    assert camera.extent == 5
    turned = settings.turned(90)
    np.testing.assert_allclose(turned.toward, (2, 0, 0), atol=1e-12)
    np.testing.assert_allclose(settings.turned(360).toward, settings.toward, atol=1e-12)
    assert CameraSettings(toward=(0, 1, 0)).turned(30).toward == pytest.approx((0, 1, 0))
    # From within, in perspective: the extent is that of a view, not infinite.
    inside = make_camera(CameraSettings(distance=0.1, perspective=True), (0, 0, 0), (1, 1, 1))
    assert np.isfinite(inside.extent) and inside.position[2] == pytest.approx(0.6)


def test_lights_and_glow():
    light = LightSettings(toward=(0, 3, 0)).light()
    assert light.toward == (0, 3, 0) and light.irradiance == pytest.approx((4 * math.pi,) * 3)
    assert Looks(lights=()).ramp is None and not Smoke().hot and Smoke(emission=1.0).hot
    scene = Scene.model_validate(SCENE | {"smoke": {"glow": ((0, 0, 0, 0), (2, 4, 2, 0))}, "obstacles": [SPHERE]})
    looks = scene.looks(2)
    np.testing.assert_allclose(looks.ramp(torch.tensor([1.0])), [[2, 1, 0]])
    place = {"position": [0.0, 3.0, 0.0], "intensity": [4.0, 2.0, 0.0], "radius": 0.1}
    lit = Scene.model_validate(SCENE | {"lights": [place]})
    assert lit.lights[0].light() == PointLight((0.0, 3.0, 0.0), (4.0, 2.0, 0.0), 0.1)
    # From the box's centre; within half of its shortest edge a light is as bright as from there.
    centre = np.asarray(lit.grid.origin) + 0.5 * lit.grid.size
    away = np.array([0.0, 3.0, 0.0]) - centre
    (seen,) = lit.looks(1).lights
    np.testing.assert_allclose(seen.irradiance, np.array([4.0, 2.0, 0.0]) / (away @ away))
    np.testing.assert_allclose(seen.toward, away / np.linalg.norm(away))
    (near,) = Scene.model_validate(SCENE | {"lights": [place | {"position": centre.tolist()}]}).looks(1).lights
    np.testing.assert_allclose(near.irradiance, np.array([4.0, 2.0, 0.0]) / (0.5 * lit.grid.size.min()) ** 2)
    bright = place | {"position": centre.tolist(), "intensity": [1e12] * 3}
    assert Scene.model_validate(SCENE | {"lights": [bright]}).looks(1).lights[0].irradiance == (1e12,) * 3
    for wrong in ({}, place | {"toward": [0, 1, 0]}):
        with pytest.raises(ValidationError, match="expected either a direction"):
            LightSettings.model_validate(wrong)
    assert (looks.time, looks.lights, looks.obstacles) == (pytest.approx(0.2), scene.lights, scene.obstacles)


def test_a_folder_of_frames(tmp_path):
    frames = write_frames(tmp_path / "a", obstacles=[SPHERE])
    assert frames.numbers == (1, 2, 3) and frames.scene.obstacles[0].radius == 0.15
    footage = load_frames(tmp_path / "a")
    assert (footage.numbers, footage.time(2)) == ((1, 2, 3), pytest.approx(0.2))
    assert footage.camera == frames.scene.camera
    for number, volume in footage.volumes():
        expected = plume(number)
        assert torch.equal(volume.density, expected.density) and volume.warnings == ()
        assert (volume.voxel, volume.origin, volume.extinction) == (0.05, (-0.5, 0.0, -0.5), 8.0)
    assert load_frames(tmp_path / "a", extinction=3.0).load(1).extinction == 3.0
    single = load_frames(tmp_path / "a" / "frame_0002.npz")
    assert (single.scene, single.numbers, single.load(1).extinction, single.time(1)) == (None, (1,), 1.0, 0.0)


def test_a_folder_is_begun_anew_or_resumed(tmp_path):
    folder = tmp_path / "a"
    scene = write_frames(folder).scene
    (folder / CHECKPOINT).write_bytes(b"x")
    assert open_frames(folder, scene, resume=True).numbers == (1, 2, 3)
    # How it is looked at, and for how long, is no other simulation; how the air moves is.
    looks = scene.model_copy(update={"frames": 9, "camera": CameraSettings(resolution=7), "name": "b"})
    assert open_frames(folder, looks, resume=True).numbers == (1, 2, 3)
    assert load_frames(folder).scene.frames == 9
    other = Scene.model_validate(SCENE | {"air": {"viscosity": 1.0}})
    assert "cannot resume: its frames have another air" in error_of(open_frames, folder, other, resume=True)
    assert open_frames(folder, other).numbers == () and sorted(p.name for p in folder.iterdir()) == ["scene.json"]
    assert "expected files of frames, such as frame_0001.npz, found none" in error_of(load_frames, folder)
    assert open_frames(tmp_path / "new", scene, resume=True).numbers == ()


def test_folders_that_are_none(tmp_path):
    scene = Scene.model_validate(SCENE)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "notes.txt").write_text("x")
    assert "found other files" in error_of(open_frames, tmp_path / "a", scene)
    with pytest.raises(WlmError, match=r"or one sequence of volumes .*, found neither scene.json nor any"):
        load_frames(tmp_path / "a")
    for content, said in (
        ("{", "found other content"),
        ('{"format": "wlm-smoke-frames", "version": 9}', "version: expected 1, found 9"),
        ('{"format": "wlm-smoke-frames", "version": 1, "scene": {}}', "scene.name: expected a value, found none"),
    ):
        folder = tmp_path / "b"
        folder.mkdir(exist_ok=True)
        (folder / "scene.json").write_text(content)
        assert re.search(said, error_of(load_frames, folder))


def test_numbered_files_replace_those_of_an_earlier_run(tmp_path):
    folder = tmp_path / "a"
    assert NumberedFiles(folder, "six", ".exr").file(12) == folder / "six_0012.exr"
    for name in ("six_0001.exr", "six_0002.exr", "sheet.png"):
        (folder / name).write_text("x")
    files = NumberedFiles(folder, "six", ".exr", "sheet.png")
    assert len(list(folder.iterdir())) == 3, "not before the first result"
    files.file(1).write_text("y")
    files.file(2)
    assert [path.read_text() for path in folder.iterdir()] == ["y"]
    with pytest.raises(WlmError, match="expected an empty folder or results of an earlier run, found six_0001.exr"):
        NumberedFiles(folder, "guide", ".exr")


def test_frames_evenly_spread():
    numbers = (2, 3, 5, 8, 13)
    assert [spread(numbers, n) for n in (None, 9, 1, 2, 3)] == [numbers, numbers, (2,), (2, 13), (2, 5, 13)]


@pytest.mark.parametrize("hot", [False, True])
def test_lightmaps_in_a_file(tmp_path, hot, device):
    volume = plume(hot=hot, device=device)
    camera = make_camera(CameraSettings(resolution=16, aspect=0.75), volume.origin, (1, 1.2, 1))
    six = bake(volume, camera, step=1.0, estimate=False)
    write_six_way(tmp_path / "a.exr", six)
    planes, _ = read_planes(tmp_path / "a.exr")
    names = ["right", "left", "top", "bottom", "front", "back", "transparency", *(["emission"] if hot else [])]
    assert sorted(planes) == sorted(names)
    result = read_six_way(tmp_path / "a.exr", device)
    assert result.camera == camera and (result.emission is not None) == hot
    torch.testing.assert_close(result.lightmaps, six.lightmaps.half().float(), rtol=0, atol=0)
    torch.testing.assert_close(result.transparency, six.transparency.half().float(), rtol=0, atol=0)


def test_files_that_are_no_lightmaps(tmp_path):
    volume = plume()
    camera = make_camera(CameraSettings(resolution=8), volume.origin, (1, 1.2, 1))
    six = bake(volume, camera, step=2.0, estimate=False)
    path = tmp_path / "a.exr"
    write_six_way(path, six)
    planes, note = read_planes(path)

    def refused(planes, note, said):
        write_planes(path, planes, note)
        assert re.search(said, error_of(read_six_way, path))

    refused({k: v for k, v in planes.items() if k != "top"}, note, "expected a channel top, as wlm smoke bake writes")
    refused(planes | {"top": planes["top"] * np.nan}, note, "channel top: expected finite numbers")
    write_planes(path, planes, None)
    assert read_six_way(path).camera.extent == 1.0, "another program's lightmaps get a camera of unit extent"
    for camera in ({"extent": 1}, note["camera"] | {"up": [0, 10**400, 0]}):
        refused(planes, {"camera": camera}, "header attribute wlm: expected a camera, as wlm smoke bake writes")
    refused({k: v[:4] for k, v in planes.items()}, note, "expected images of its camera's height and width, 8 x 8")
    damaged = path.read_bytes()
    path.write_bytes(damaged[: len(damaged) // 2])
    assert "a.exr" in error_of(read_six_way, path)
    OpenEXR.File({"type": OpenEXR.scanlineimage, "wlm": "{"}, {"a": np.ones((2, 2), np.float32)}).write(str(path))
    assert "header attribute wlm: expected a JSON object" in error_of(read_planes, path)


def test_the_scene_in_the_document(tmp_path):
    """The complete scene of the documentation loads and names every setting."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "smoke-scenes.md").read_text(encoding="utf-8")
    block = page[page.index("    name: jet\n") : page.index("A row of `path`")]
    path = tmp_path / "scene.yaml"
    path.write_text("\n".join(line[4:] for line in block.splitlines()))
    scene = load_scene(path)
    given = yaml.safe_load(path.read_text())
    for name, part in (("grid", scene.grid), ("air", scene.air), ("smoke", scene.smoke), ("camera", scene.camera)):
        assert set(type(part).model_fields) - {"perspective"} == set(given[name])
    assert set(Scene.model_fields) == set(given)
    for body, kind in (("sources", SourceSettings), ("obstacles", ObstacleSettings)):
        assert set(kind.model_fields) == set().union(*given[body])
