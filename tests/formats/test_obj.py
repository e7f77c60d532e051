"""OBJ files read: every stated behaviour of `wlm.formats.obj`."""

from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of

from wlm.errors import WlmError
from wlm.formats.obj import ObjMesh, read_obj

SQUARE = """# a square
mtllib a.mtl
o thing
v 0 0 0
v 2 0 0 1.0
v 2 3 0 0.5 0.5 0.5
v 0 3 1e-1
vt 0 0
vt 1 0 0
vt 1 1
vt 0 0.75
vn 0 0 1
usemtl wood
s off
"""


def _read(folder: Path, text: str) -> ObjMesh:
    path = folder / "a.obj"
    path.write_text(text)
    return read_obj(path)


def _message(folder: Path, text: str) -> str:
    line = error_of(_read, folder, text)
    assert line.startswith(str(folder / "a.obj"))
    return line


@pytest.mark.parametrize(
    "face", ["f 1/1/1 2/2/1 3/3/1 4/4/1", "f -4/-4 -3/-3 -2/-2 -1/-1", "f 1/1 2/2 \\\n 3/3 4/4 # on"]
)
def test_a_polygon_is_a_fan_and_v_points_down(tmp_path, face):
    mesh = _read(tmp_path, SQUARE + face)
    np.testing.assert_array_equal(mesh.triangle, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(mesh.position, [[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0.1]])
    np.testing.assert_array_equal(mesh.uv, [[0, 1], [1, 1], [1, 0], [0, 0.25]])
    assert (mesh.position.dtype, mesh.uv.dtype, mesh.triangle.dtype) == (np.float64, np.float64, np.int32)


def test_a_vertex_is_a_pair_of_v_and_vt(tmp_path):
    mesh = _read(tmp_path, SQUARE + "f 1/1 2/2 3/3\nf 1/1 3/2 4/4\nf 3/2 3/3 1/4")
    assert len(mesh.position) == len(mesh.uv) == 6
    np.testing.assert_array_equal(
        mesh.position[mesh.triangle][1:, :, :2], [[[0, 0], [2, 3], [0, 3]], [[2, 3], [2, 3], [0, 0]]]
    )
    np.testing.assert_array_equal(
        mesh.uv[mesh.triangle][1:], [[[0, 1], [1, 1], [0, 0.25]], [[1, 1], [1, 0], [0, 0.25]]]
    )


@pytest.mark.parametrize("face", ["f 1 2 3", "f 1//1 2//1 3//1"])
def test_no_uvs_at_all(tmp_path, face):
    mesh = _read(tmp_path, SQUARE + face)
    assert mesh.uv is None and len(mesh.triangle) == 1


def test_no_faces_and_one_coordinate(tmp_path):
    mesh = _read(tmp_path, SQUARE)
    assert mesh.triangle.shape == (0, 3) and mesh.position.shape == (0, 3) and mesh.uv is None
    mesh = _read(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.5\nf 1/1 2/1 3/1")
    np.testing.assert_array_equal(mesh.uv, [[0.5, 1]] * 3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("f 1/1 2/2 5/3", "line 15: malformed f: f 1/1 2/2 5/3"),
        ("f 1/1 2/2 0/3", "line 15: malformed f"),
        ("f 1/1 2/2 -5/3", "line 15: malformed f"),
        ("f 1/1 2/2 3/5", "line 15: malformed f"),
        ("f 1/1 2/2 x/3", "line 15: malformed f"),
        ("f 1/1 2/2", "line 15: expected three corners or more, found 2"),
        ("v 1 2", "line 15: malformed v: v 1 2"),
        ("vt", "line 15: malformed vt"),
        ("f 1/1 2/2 3/3\nf 1 3 4", "line 16: expected v/vt as other faces have"),
        ("f 1/1 2/2 3", "line 15: expected v/vt as other faces have"),
    ],
)
def test_a_wrong_line_is_named(tmp_path, text, words):
    assert words in _message(tmp_path, SQUARE + text)


def test_a_missing_file(tmp_path):
    with pytest.raises(WlmError, match="No such file"):
        read_obj(tmp_path / "a.obj")
