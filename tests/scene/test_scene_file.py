"""The file of a scene: what it shows at a time, and one line about what is wrong in it."""

import math
import shlex
from pathlib import Path

import numpy as np
import pytest
from builders import day_scenes
from builders.checks import error_of
from builders.gltf_maker import GltfMaker

import wlm
from wlm.errors import WlmError
from wlm.formats.gltf import read_gltf, vertex_colours
from wlm.inspection import inspect
from wlm.scene.mesh import read_mesh


def edited(room: Path, old: str, new: str) -> Path:
    text = room.read_text()
    assert old in text
    path = room.with_name("changed.yaml")
    path.write_text(text.replace(old, new, 1))
    return path


def test_the_content_is_that_of_the_files(scene):
    assert scene.title == "a room" and scene.light.groups == ("sky", "sun")
    assert scene.probe_hours.tolist() == [0.0, 12.0] and list(scene.originals) == [12.0, 22.0]
    assert [len(puff.files) for puff in scene.smoke] == [2]
    np.testing.assert_array_equal(scene.mesh.colour, np.repeat([day_scenes.FLOOR, day_scenes.WALL], 4, 0).astype("f4"))
    np.testing.assert_allclose(scene.mesh.normal, np.repeat([[0, 1, 0], [0, 0, 1]], 4, 0))


def test_hours_and_seconds_of_the_film(scene):
    assert scene.hour_at(0.0) == 5.0 and scene.hour_at(4.0) == 29.0
    assert scene.second_at(5.0) == 0.0 and scene.second_at(11.0) == 1.0 and scene.second_at(4.0) == 23 / 6


def test_the_sky_wraps_after_a_day(scene):
    colour, exposure = scene.sky_at(18.0 + 24.0)
    np.testing.assert_allclose(colour, [0.25, 0.3, 0.45])
    assert exposure == 0.0


def test_the_camera_is_a_catmull_rom_curve(scene):
    eye, target, fov = scene.camera_at(1.0)
    # Half-way, a cubic with the slopes m is the mean of the ends plus an eighth of the difference of the slopes.
    slopes = np.array([[0.25, 0.0, 0.0], [0.0, 0.0, -0.125]])
    np.testing.assert_allclose(eye, [0.25, 1.5, 4.0] + 2.0 / 8.0 * (slopes[0] - slopes[1]))
    np.testing.assert_allclose(target, [0, 1, 0])
    assert fov == 60.0
    np.testing.assert_array_equal(scene.camera_at(-1.0)[0], [0, 1.5, 4])
    np.testing.assert_array_equal(scene.camera_at(9.0)[0], [0, 1.5, 3.5])


def test_the_field_of_view_does_not_swing_beyond_its_range(changed):
    fields = (1, 150, 150, 1)
    rows = [{"second": s, "fov": fov, "eye": [0, 1, 5], "target": [0, 1, 0]} for s, fov in enumerate(fields)]
    with wlm.scene.load(changed(camera=rows)) as scene:
        assert scene.camera_at(1.5)[2] == 150.0 and scene.camera_at(0.0)[2] == 1.0


def test_a_moving_object_goes_round_and_looks_ahead(scene):
    (car,) = scene.moving
    np.testing.assert_allclose(car.pose(1.0)[:3, 3], [-0.6, 0.2, 0], atol=1e-12)
    np.testing.assert_allclose(car.pose(1.0)[:3, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(car.pose(7.0)[:3, 3], [-0.6, 0.2, 0], atol=1e-12)
    np.testing.assert_allclose(car.pose(7.0)[:3, 2], [0, 0, -1], atol=1e-12)
    assert math.isclose(np.linalg.det(car.pose(7.0)[:3, :3]), 1.0)


def test_smoke_plays_again(scene):
    assert [scene.smoke[0].frame(second) for second in (0.0, 0.5, 1.0)] == [0, 1, 0]


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("light: room.wlm", "light: none.wlm", "light: there is no file or folder"),
        ("mesh: room.glb", "mesh: ../room.glb", "mesh: expected a file within"),
        ("mesh: room.glb", "mesh: car.glb", "expected lightmap UVs in TEXCOORD_0, found none"),
        ("smoke:\n", "smok:\n", "unknown key 'smok'; did you mean 'smoke'"),
        ("second: 2", "second: 9", "camera: expected rows of rising second"),
        ("last: 29", "last: 5", "day.last: expected a later hour"),
        ("probes: probes.wlm", "probes: room.wlm", "expected an artifact of probe"),
        ("smoke\n", "car.glb\n", "smoke.0.files: expected a folder of six-way lightmaps"),
        ("original_12.00h.exr", "room.glb", "originals.0: expected an hour"),
    ],
)
def test_one_line_names_the_key(room, old, new, line):
    with pytest.raises(WlmError) as error:
        wlm.scene.load(edited(room, old, new))
    assert line in str(error.value) and "\n" not in str(error.value) and str(room.parent) in str(error.value)
    assert "--trust" not in str(error.value)  # which no command of scenes has


def test_probes_are_needed_by_what_they_light(room):
    assert "probes: expected a file of probes" in error_of(wlm.scene.load, edited(room, "probes: probes.wlm\n", ""))


def test_inspect_describes_the_scene_and_names_the_command(room):
    (found,) = inspect(room)
    assert shlex.split(found.command) == ["wlm", "run", str(room), "-o", "DIR"]
    said = "a scene over 4 s, from 5 h to 29 h: 4 triangles, 2 light groups, probes of 2 hours, 1 moving object, "
    assert found.what == said + "smoke at 1 place"


def glb(path: Path, colours: np.ndarray, **extra) -> Path:
    maker = GltfMaker()
    attributes = {"POSITION": maker.add(np.eye(3, dtype="f4")), "COLOR_0": maker.add(colours, **extra)}
    maker.content |= {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 1.0, 1.0, 1.0]}}],
    }
    return maker.save(path)


def test_base_colours_are_those_of_vertices_times_the_factor(tmp_path):
    path = glb(tmp_path / "a.glb", np.full((3, 4), 51, np.uint8), normalized=True)
    np.testing.assert_allclose(read_mesh(path).colour, np.tile([0.1, 0.2, 0.2], (3, 1)), atol=1e-7)
    path = glb(tmp_path / "a.glb", np.full((3, 3), 0.25, np.float32))
    np.testing.assert_allclose(vertex_colours(*read_gltf(path))[0], np.tile([0.125, 0.25, 0.25], (3, 1)))
    with pytest.raises(WlmError, match="expected 3 colours or more, found 2"):
        read_mesh(glb(tmp_path / "a.glb", np.full((2, 3), 0.25, np.float32)))
