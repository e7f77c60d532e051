"""Obstacles and sources of a scene: meshes from files, turns, sources that move, vary and start several times."""

import copy
import math

import numpy as np
import pytest
import trimesh
import yaml
from builders.checks import error_of
from builders.smoke_plumes import SCENE, plume
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from wlm.errors import WlmError
from wlm.smoke import meshes
from wlm.smoke.data import load_frames, open_frames, read_shaded, write_six_way
from wlm.smoke.march.six_way import bake
from wlm.smoke.meshes import read_surface
from wlm.smoke.scene import CameraSettings, ObstacleSettings, Scene, load_scene, make_camera, obstacle_mesh
from wlm.smoke.simulation import advance, make_solver, sources_at, warnings_of

CELL = 0.05
GRID = {"cells": [14, 14, 14], "cell": CELL, "refine": 2}
BALL = trimesh.creation.icosphere(subdivisions=3)


def _file(folder, name="ball.glb", mesh=BALL):
    mesh.export(folder / name)
    return name


def _part(kept) -> trimesh.Trimesh:
    return trimesh.Trimesh(BALL.vertices, BALL.faces[kept], process=False)


def _scene(folder, obstacles, **changed) -> Scene:
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(SCENE | {"grid": GRID, "obstacles": obstacles} | changed))
    return load_scene(path)


def test_a_scene_that_saves_memory_has_the_same_air(tmp_path):
    flows = []
    for saves in (False, True):
        scene = _scene(tmp_path, [], air={"save_memory": saves})
        solver = make_solver(scene)
        advance(scene, solver, 1)
        flows.append((len(solver.lattice._arrays), solver.lattice.velocity().numpy()))
    assert [arrays for arrays, _ in flows] == [2, 1]
    np.testing.assert_array_equal(flows[0][1], flows[1][1])
    assert flows[0][1].any()


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "stl", "ply", "off"])
def test_a_surface_from_a_file(tmp_path, suffix):
    """Corners at one place are one, and triangles run anticlockwise from outside."""
    inside_out = trimesh.Trimesh(BALL.vertices, BALL.faces[:, ::-1], process=False)
    for mesh in (BALL, inside_out):
        if suffix == "gltf":
            for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
                (tmp_path / name).write_bytes(data)
            name = "model.gltf"
        else:
            name = _file(tmp_path, f"{len(list(tmp_path.iterdir()))}.{suffix}", mesh)
        read = read_surface(tmp_path / name)
        assert (read.points.shape, read.triangles.shape) == (BALL.vertices.shape, BALL.faces.shape)
        again = trimesh.Trimesh(read.points, read.triangles, process=False)
        assert again.is_watertight and again.volume == pytest.approx(BALL.volume, rel=1e-5)
        assert not read.is_open and read.thickness == pytest.approx(2 / 3, rel=0.02)


def test_open_and_closed(tmp_path):
    up = BALL.triangles_center[:, 1]
    for name, mesh, is_open in (
        ("hole", _part(up > -0.95), False),
        ("bowl", _part(up < 0.0), True),
        ("tube", trimesh.Trimesh(*_tube(), process=False), True),
        ("two", trimesh.util.concatenate([BALL, BALL.copy().apply_translation((3, 0, 0))]), False),
    ):
        assert read_surface(tmp_path / _file(tmp_path, f"{name}.stl", mesh)).is_open == is_open


def _tube():
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1)
    k = np.arange(24)
    a, b = k, (k + 1) % 24
    faces = np.concatenate([np.stack([a, a + 24, b], 1), np.stack([b, a + 24, b + 24], 1)])
    return np.concatenate([ring, ring + (0, 2, 0)]), faces


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("none.glb", None, "none.glb: cannot read the mesh: No such file or directory"),
        ("empty.obj", "", "empty.obj: expected triangles, found none"),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "flat.obj: expected triangles, found none with an area"),
        ("bad.ply", "ply\nx", "bad.ply: malformed PLY"),
        ("bad.glb", "x", "bad.glb"),
        ("ball.fbx", "x", "shape: expected sphere, box, cylinder, or a mesh file (.glb, .gltf, .obj"),
        ("cone", "x", "shape: expected sphere, box, cylinder, or a mesh file"),
        ("many.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 9 * "f 1 2 3\n", "expected at most 8 triangles, found 9"),
        ("ball.obj", "v 0 0 nan\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "expected finite positions"),
    ],
)
def test_what_a_mesh_may_not_be(tmp_path, monkeypatch, name, content, said):
    monkeypatch.setattr(meshes, "MOST_TRIANGLES", 8)
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(WlmError) as caught:
        make_solver(_scene(tmp_path, [{"shape": name, "path": [[0, 0, 0, 0]]}]))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_mesh_has_no_radius(tmp_path):
    for body in ({"shape": "a.obj", "radius": 1.0}, {"shape": "box"}, {}):
        with pytest.raises(WlmError, match=r"radius: expected one number for a sphere, .* none for a mesh"):
            _scene(tmp_path, [body | {"path": [[0, 0, 0, 0]]}])
    for extra in ({"scale": 2.0}, {"shell": True}):
        with pytest.raises(WlmError, match=r"expected scale and shell only for a mesh, found a sphere"):
            _scene(tmp_path, [{"radius": 0.1, "path": [[0, 0, 0, 0]]} | extra])


def test_a_mesh_as_a_solid_and_in_pictures(tmp_path):
    """A ball with a hole, in centimetres and off its origin: its cells, its surface, and a source within it."""
    kept = BALL.triangles_center[:, 1] > -0.95
    mesh = trimesh.Trimesh(20.0 * BALL.vertices + (0, 20, 0), BALL.faces[kept], process=False)
    body = {"shape": _file(tmp_path, "holed.ply", mesh), "scale": 0.01, "offset": [0, -0.2, 0]}
    body |= {"path": [[0, 0.35, 0.35, 0.35], [1, 0.4, 0.35, 0.35]]}
    source = {"centre": [0.35, 0.35, 0.35], "radius": 0.05}
    scene = _scene(tmp_path, [body], sources=[source], inlets=[])
    assert warnings_of(scene) == ["plume: sources.0: it is inside an obstacle, and emits no smoke"]
    solver = make_solver(scene)
    solver.step()
    centres = CELL * (np.stack(np.meshgrid(*3 * [np.arange(14) + 0.5], indexing="ij"), -1))
    away = np.linalg.norm(centres - scene.obstacles[0].eased.at(0.0), axis=-1)
    sure = np.abs(away - 0.2) > 0.01
    np.testing.assert_array_equal(solver.solid.numpy()[sure] == 1, (away < 0.2)[sure])
    points, triangles, owner = obstacle_mesh(scene.obstacles, 1.0)
    distance = np.linalg.norm(points - scene.obstacles[0].eased.at(1.0), axis=1)
    np.testing.assert_allclose(distance, 0.2, atol=1e-5)
    assert len(triangles) == kept.sum() and not owner.any()


@pytest.mark.parametrize("thin", ["sheet", "plate"])
def test_a_thin_shell_stops_air(tmp_path, thin):
    """An open sheet, and a closed plate thinner than a cell, slanted across a box in which hot smoke rises."""
    if thin == "sheet":
        mesh = trimesh.Trimesh([[-1, 0.3, -1], [1, 0.5, -1], [1, 0.5, 1], [-1, 0.3, 1]], [[0, 2, 1], [0, 3, 2]])
    else:
        mesh = trimesh.creation.box((3, 0.01, 3))
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.1, (0, 0, 1), (0, 0, 0)))
        mesh.apply_translation((0.35, 0.42, 0.35))
    body = {"shape": _file(tmp_path, "thin.obj", mesh), "path": [[0, 0, 0, 0]]}
    source = {"centre": [0.35, 0.2, 0.35], "radius": 0.1, "temperature": 1.0}
    faces = dict.fromkeys(("-x", "+x", "-y", "+y", "-z", "+z"), "wall")
    more = {"inlets": [], "sources": [source], "smoke": {"buoyancy": 5.0}, "air": {"speed": 1.0}}
    scene = _scene(tmp_path, [body], grid=GRID | {"faces": faces}, **more)
    said = ["plume: obstacles.0: it is thinner than a cell of 0.05 m, and is simulated as a cell thick"]
    assert warnings_of(scene) == said
    solver = make_solver(scene)
    for frame in range(1, 5):
        advance(scene, solver, frame)
    speed = np.linalg.norm(solver.velocity.numpy(), axis=-1)
    heights = CELL * (np.arange(14) + 0.5)
    density = solver.density.numpy()
    assert speed[:, heights < 0.28].max() > 1e-3 and density[:, 21:].max() == 0.0
    assert speed[:, heights > 0.58].max() == 0.0
    free = scene.model_copy(update={"obstacles": ()})
    solver = make_solver(free)
    for frame in range(1, 5):
        advance(free, solver, frame)
    assert np.abs(solver.velocity.numpy()[:, heights > 0.58]).max() > 1e-3


def test_a_resumed_scene_knows_its_mesh(tmp_path):
    """The content of the file counts, not its name; frames and lightmaps name meshes relative to their folder, and
    shipped ones by the name that a scene gives."""
    (home := tmp_path / "old").mkdir()
    body = {"shape": _file(home), "scale": 0.1, "path": [[0, 0.3, 0.3, 0.3]]}
    rabbit = {"shape": "meshes/rabbit.ply", "centre": [0, 0, 0]}
    scene = _scene(home, [body, rabbit])
    open_frames(home / "a", scene).file(1).write_bytes(b"")
    copied = _scene(home, [body | {"shape": _file(home, "copy.glb")}, rabbit])
    open_frames(home / "a", copy.deepcopy(copied), resume=True)
    other = _scene(home, [body | {"shape": _file(home, "other.glb", _part(slice(9, None)))}, rabbit])
    assert "cannot resume: its frames have another obstacles" in error_of(open_frames, home / "a", other, resume=True)
    six = bake(plume(), make_camera(CameraSettings(resolution=4), scene.grid.origin, scene.grid.size))
    write_six_way(home / "six.exr", six, copied.looks(1))
    home = home.rename(tmp_path / "new")
    for moved in (load_frames(home / "a").scene, read_shaded(home / "six.exr")[1]):
        assert [each.shape for each in moved.obstacles] == [str(home / "copy.glb"), scene.obstacles[1].shape]


def test_a_body_turns_as_its_rows_say():
    """About x, then y, then z, by several turns at once; it starts and stops gently, and its tips are the fastest."""
    turn = [[1, 0, 0, 0], [5, 0, 0, 1440]]
    body = ObstacleSettings(shape="box", radius=(0.3, 0.1, 0.1), offset=(0.3, 0, 0), centre=(1, 2, 3), turn=turn)
    for time, degrees in ((0.0, 0.0), (2.0, 360.0), (3.05, 738.0), (9.0, 1440.0)):
        turned = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        np.testing.assert_allclose(body.eased.turn(time), turned, atol=1e-9)
    points = obstacle_mesh([body], 3.25)[0]
    np.testing.assert_allclose((points.min(0), points.max(0)), ((0.9, 2.0, 2.9), (1.1, 2.6, 3.1)), atol=1e-5)
    assert body.fastest == pytest.approx(2 * np.pi * math.hypot(0.6, 0.1, 0.1), rel=1e-6)
    angles = [Rotation.from_matrix(body.eased.turn(time)).magnitude() for time in (0.8, 0.86, 0.87, 1.0)]
    assert angles[0] == 0.0 < angles[2] - angles[1] < 0.2 * 2 * np.pi * 0.01 and angles[3] > 0.1
    both = ObstacleSettings(radius=0.1, path=((0, 0, 0, 0), (2, 2, 0, 0)), turn=((0, 90, 0, 0), (1, 90, 30, 40)))
    expected = Rotation.from_euler("xyz", (90, 30, 40), degrees=True).as_matrix()
    np.testing.assert_allclose(both.eased.turn(1.9), expected, atol=1e-9)
    np.testing.assert_allclose(both.eased.at(1.0), (1, 0, 0), atol=1e-9)
    with pytest.raises(ValidationError, match="expected at most 300,000 degrees in all"):
        ObstacleSettings(radius=0.1, centre=(0, 0, 0), turn=((0, 0, 0, 0), (1, 0, 0, 1e17)))


@pytest.mark.parametrize("shape", ["sphere", "box", "cylinder", "mesh"])
def test_a_source_that_moves_and_turns(tmp_path, shape):
    """Density where the source is, twice, with a pause between, in voxels that the same surface in NumPy contains."""
    body = {"path": [[0, 0.2, 0.3, 0.3], [0.4, 0.5, 0.4, 0.4]], "turn": [[0, 0, 0, 0], [0.4, 50, 70, 0]]}
    body |= {"shape": _file(tmp_path), "scale": 0.15} if shape == "mesh" else {"shape": shape, "radius": 0.15}
    if shape in ("box", "cylinder"):
        body["radius"] = [0.1, 0.2, 0.1]
    source = body | {"start": [0, 0.3], "stop": [0.2, None], "density": 0.75}
    scene = _scene(tmp_path, [], sources=[source], inlets=[], smoke={"bricks": shape == "mesh"})
    assert warnings_of(scene) == []
    assert [len(sources_at(scene, time)) for time in (0.1, 0.2, 0.25, 0.3, 9.0)] == [1, 0, 0, 1, 1]
    surface = scene.sources[0]
    for time in (0.1, 0.35):
        solver = make_solver(scene)
        solver.sources = sources_at(scene, time)
        solver.step()
        centres = 0.5 * CELL * np.stack(np.meshgrid(*3 * [np.arange(28) + 0.5], indexing="ij"), -1)
        corners, triangles = surface.mesh()
        mesh = trimesh.Trimesh(corners @ surface.eased.turn(time).T + surface.eased.at(time), triangles, process=False)
        inside = _inside(mesh, centres)
        density = solver.density.numpy()
        assert inside.sum() > 300 and set(np.unique(density)) == {0.0, 0.75}
        assert (density > 0).sum() == pytest.approx(inside.sum(), rel=0.06)
        assert ((density > 0) & inside).sum() > 0.94 * inside.sum()


def _inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Tests points against the planes of a convex mesh."""
    planes = (mesh.face_normals * mesh.triangles[:, 0]).sum(1)
    return (points @ mesh.face_normals.T < planes).all(-1)


def test_noise_of_a_scene_is_of_its_time(tmp_path):
    """The same after a resumption; its phase follows the scene's time."""
    source = {"centre": [0.35, 0.35, 0.35], "radius": 0.3, "noise": {"size": 0.1, "duration": 0.2, "seed": 3}}
    scene = _scene(tmp_path, [], sources=[source], inlets=[], frames=2)
    noise = [sources_at(scene, time)[0].noise for time in (0.0, 0.1, 0.2 * 4096.5)]
    assert [each.phase for each in noise] == pytest.approx([0.0, 0.5, 0.5]) and noise[0].size == pytest.approx(2.0)
    first, again = make_solver(scene), make_solver(scene)
    advance(scene, first, 1)
    first.save(tmp_path / "state")
    advance(scene, first, 2)
    again.load(tmp_path / "state")
    advance(scene, again, 2)
    np.testing.assert_array_equal(first.density.numpy(), again.density.numpy())
    assert first.density.numpy().std() > 0.05


def test_what_a_source_may_not_be(tmp_path):
    where = {"centre": [0.3, 0.3, 0.3], "radius": 0.1}
    for changed, said in (
        ({"path": [[0, 0, 0, 0]]}, "path: expected a centre, or positions with their times"),
        ({"centre": None}, "path: expected a centre, or positions with their times"),
        ({"start": [0, 2], "stop": [1]}, "stop: expected for each start a time after it, or null"),
        ({"start": [0, 2], "stop": [1, 2]}, "stop: expected for each start a time after it, or null"),
        ({"start": []}, "stop: expected for each start a time after it, or null"),
        ({"noise": {"size": 0}}, "noise.size: expected greater than 0"),
        ({"turn": [[1, 0, 0, 0], [1, 0, 0, 9]]}, "turn: expected times that increase"),
    ):
        with pytest.raises(WlmError) as caught:
            _scene(tmp_path, [], sources=[where | changed])
        assert said in str(caught.value) and "\n" not in str(caught.value)
