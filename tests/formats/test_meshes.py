"""Meshes in formats other than glTF: positions, UVs, triangles and fronts, and one line where a file is damaged."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from builders.checks import error_of
from builders.gltf_scene import box

from wlm.formats.geometry import Geometry
from wlm.formats.meshes import MeshArrays, read_mesh

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
POSITION = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0.1]])
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0.25]])


def _read(folder: Path, text: str) -> MeshArrays:
    path = folder / "a.obj"
    path.write_text(text)
    return read_mesh(path)


def _area(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1).sum())


@pytest.mark.parametrize("face", ["f 1/1/1 2/2/1 3/3/1 4/4/1", "f -4/-4 -3/-3 -2/-2 -1/-1"])
def test_a_polygon_is_triangles_and_v_points_down(tmp_path, face):
    mesh = _read(tmp_path, SQUARE + face)
    assert len(mesh.triangle) == 2
    order = np.lexsort(mesh.position.T)
    np.testing.assert_array_equal(mesh.position[order], POSITION[np.lexsort(POSITION.T)])
    np.testing.assert_array_equal(mesh.uv[order], UV[np.lexsort(POSITION.T)])
    assert _area(mesh.uv[mesh.triangle].astype(float) @ np.eye(2, 3)) == pytest.approx(2 * 0.875)
    assert (mesh.position.dtype, mesh.uv.dtype, mesh.triangle.dtype) == (np.float64, np.float64, np.int32)


def test_a_vertex_is_a_pair_of_v_and_vt(tmp_path):
    mesh = _read(tmp_path, SQUARE + "f 1/1 2/2 3/3\nf 1/1 3/2 4/4\nf 3/2 3/3 1/4")
    assert len(mesh.position) == len(mesh.uv) == 6
    seen = mesh.position[mesh.triangle][1:, :, :2]
    np.testing.assert_array_equal(seen, [[[0, 0], [2, 3], [0, 3]], [[2, 3], [2, 3], [0, 0]]])
    seen = mesh.uv[mesh.triangle][1:]
    np.testing.assert_array_equal(seen, [[[0, 1], [1, 1], [0, 0.25]], [[1, 1], [1, 0], [0, 0.25]]])


def test_several_materials_are_one_mesh(tmp_path):
    mesh = _read(tmp_path, SQUARE + "f 1/1 2/2 3/3\nusemtl stone\nf 1/1 3/3 4/4")
    assert len(mesh.triangle) == 2 and mesh.triangle.max() < len(mesh.position) == len(mesh.uv)
    assert _area(mesh.position[mesh.triangle]) == pytest.approx(_area(POSITION[np.array([[0, 1, 2], [0, 2, 3]])]))


@pytest.mark.parametrize("face", ["f 1 2 3", "f 1//1 2//1 3//1"])
def test_no_uvs_at_all(tmp_path, face):
    mesh = _read(tmp_path, SQUARE + face)
    assert mesh.uv is None and len(mesh.triangle) == 1


def test_no_faces(tmp_path):
    mesh = _read(tmp_path, SQUARE)
    assert mesh.triangle.shape == (0, 3) and mesh.position.shape == (0, 3) and mesh.uv is None


@pytest.mark.parametrize("suffix", ["ply", "stl", "off"])
def test_other_formats(tmp_path, suffix):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    (tmp_path / f"a.{suffix}").write_bytes(
        trimesh.exchange.export.export_mesh(box, None, file_type=suffix)
        if suffix != "off"
        else box.export(file_type="off").encode()
    )
    mesh = read_mesh(tmp_path / f"a.{suffix}")
    assert len(mesh.triangle) == 12 and mesh.uv is None
    assert _area(mesh.position[mesh.triangle]) == pytest.approx(2 * 22.0)


def test_uvs_of_a_ply(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text += "property float s\nproperty float t\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(text + "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 0.75\n3 0 1 2\n")
    mesh = read_mesh(tmp_path / "a.ply")
    np.testing.assert_allclose(mesh.uv[mesh.triangle[0]], [[0, 1], [1, 1], [0, 0.25]])


@pytest.mark.parametrize(
    "text",
    ["f 1/1 2/2 5/3", "f 1/1 2/2 -5/3", "f 1/1 2/2 x/3", "v 1 2", "v nan 0 0\nf 1/1 2/2 5/3", "v 1e999 0 0\nf 1 2 5"],
)
def test_a_damaged_file_is_one_line(tmp_path, text):
    line = error_of(_read, tmp_path, SQUARE + text)
    assert line.startswith(f"{tmp_path / 'a.obj'}: malformed OBJ: ")


def test_many_corners_and_materials_are_refused_before_they_are_read(tmp_path):
    for text, words in (
        ("f" + " 1" * 5_000_000, "expected at most 4194304 numbers for the size of the file"),
        ("".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(1025)), r"expected at most 1,024 materials"),
    ):
        assert words in error_of(_read, tmp_path, SQUARE + text)


def test_a_missing_file_and_another_format(tmp_path):
    assert "No such file" in error_of(read_mesh, tmp_path / "a.obj")
    assert "expected a mesh file" in error_of(read_mesh, tmp_path / "a.fbx")


@pytest.mark.parametrize("size", [1.0, 1e-20, 1e18])
def test_a_room_faces_its_middle(size):
    position, triangle, uv = box((-1, -1, -1), (1, 1, 1))
    position = (np.array([5.0, -2.0, 0.5]) + position * [1.0, 2.0, 0.5]) * size
    walls, outside = (Geometry(position.astype(np.float32), faces, uv) for faces in (triangle[:, ::-1], triangle))
    assert walls.is_room and not outside.is_room
    mixed = np.concatenate([walls.triangle[:6], outside.triangle[6:]])
    assert not Geometry(walls.position, mixed, uv).is_room


def test_a_plane_and_nothing_are_no_rooms():
    position, triangle, uv = box((-1, -1, -1), (1, 1, 1))
    assert not Geometry((position * [1, 0, 1]).astype(np.float32), triangle[:, ::-1], uv).is_room
    assert not Geometry(position.astype(np.float32), np.zeros((0, 3), np.uint32), uv).is_room
