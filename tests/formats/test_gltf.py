"""glTF files read: every stated behaviour of `wlm.formats.gltf`."""

import base64
import copy
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of
from builders.gltf_maker import GltfMaker
from scipy.spatial.transform import Rotation

from wlm.formats.gltf import GltfPrimitive, read_gltf

POINTS = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [2, 3, 1], [9, 9, 9]], np.float32)
PLACES = np.array([[0, 0], [0.5, 0], [0, 0.75], [0.5, 0.75], [1, 1]], np.float32)
TRIANGLES = np.array([[0, 1, 2], [2, 1, 3]])


class Maker(GltfMaker):
    """A glTF file of one node, one mesh and one primitive."""

    def __init__(self, index_type: str = "uint16") -> None:
        super().__init__()
        attributes = {"POSITION": self.add(POINTS, min=[0, 0, 0], max=[9, 9, 9]), "TEXCOORD_0": self.add(PLACES)}
        self.primitive = {"attributes": attributes, "indices": self.add(TRIANGLES.reshape(-1).astype(index_type))}
        self.content |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        self.content["meshes"] = [{"primitives": [self.primitive]}]


def _read(maker: Maker, path: Path) -> list[GltfPrimitive]:
    return read_gltf(maker.save(path / "a.glb"))[1]


@pytest.mark.parametrize("index_type", ["uint8", "uint16", "uint32"])
def test_a_primitive_and_the_vertices_that_it_uses(tmp_path, index_type):
    (found,) = _read(Maker(index_type), tmp_path)
    assert (found.node, found.mesh, found.primitive) == (0, 0, 0)
    np.testing.assert_array_equal(found.triangle, TRIANGLES)
    np.testing.assert_array_equal(found.position, POINTS[:4])
    np.testing.assert_array_equal(found.uv[0], PLACES[:4])
    np.testing.assert_array_equal(found.row, [0, 1, 2, 3])
    assert (found.position.dtype, found.uv[0].dtype, found.triangle.dtype) == (np.float64, np.float32, np.int32)
    assert list(found.uv) == [0]


@pytest.mark.parametrize("where", ["file", "base64", "percent"])
def test_buffers_outside_of_the_file(tmp_path, where):
    maker = Maker()
    if where == "file":
        (tmp_path / "b ü.bin").write_bytes(maker.blob)
        uri = "b%20%C3%BC.bin"
    elif where == "base64":
        uri = "data:application/octet-stream;base64," + base64.b64encode(maker.blob).decode()
    else:
        uri = "data:," + "".join(f"%{byte:02x}" for byte in maker.blob)
    maker.content["buffers"] = [{"byteLength": len(maker.blob), "uri": uri}]
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(maker.content))
    (found,) = read_gltf(path)[1]
    np.testing.assert_array_equal(found.position, POINTS[:4])
    np.testing.assert_array_equal(found.triangle, TRIANGLES)


def test_nested_and_mirrored_nodes(tmp_path):
    maker = Maker()
    turn = Rotation.from_euler("xyz", [0.3, -1.1, 2.0])
    upper = np.array([[0, 2, 0, 5], [1, 0, 0, -6], [0, 0, -3, 7], [0, 0, 0, 1.0]])
    maker.content["nodes"] = [
        {"matrix": upper.T.ravel().tolist(), "children": [1]},
        {"translation": [1, 2, 3], "rotation": (1.0001 * turn.as_quat()).tolist(), "scale": [1, -2, 0.5], "mesh": 0},
    ]
    (found,) = _read(maker, tmp_path)
    local = turn.apply(POINTS[:4] * [1, -2, 0.5]) + [1, 2, 3]
    np.testing.assert_allclose(found.position, local @ upper[:3, :3].T + upper[:3, 3], atol=1e-12)
    # The node mirrors, which turns the winding.
    assert found.mirrored
    np.testing.assert_array_equal(found.triangle, np.array(TRIANGLES)[:, ::-1])
    assert found.node == 1


def test_a_scene_draws_its_own_nodes_only(tmp_path):
    maker = Maker()
    maker.content["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [1, 0, 0]}, {"children": [1]}, {}]
    maker.content |= {"scenes": [{"nodes": [0]}, {"nodes": [3, 2, 0]}], "scene": 1}
    assert [each.node for each in _read(maker, tmp_path)] == [1, 0]
    del maker.content["scene"]
    assert [each.node for each in _read(maker, tmp_path)] == [0]
    del maker.content["scenes"]
    assert [each.node for each in _read(maker, tmp_path)] == [0, 1]
    maker.content = {"asset": {"version": "2.0"}}
    assert _read(maker, tmp_path) == []


SCALES = [("uint8", 255), ("uint16", 65535), ("int8", 127), ("int16", 32767), ("uint16", None)]


@pytest.mark.parametrize("name, scale", SCALES)
def test_integer_uvs(tmp_path, name, scale):
    maker = Maker()
    info = np.iinfo(name)
    numbers = np.array([[0, info.max], [1, 7], [100, 3], [info.min, 5], [0, 0]], name)
    maker.primitive["attributes"]["TEXCOORD_1"] = maker.add(numbers, **({"normalized": True} if scale else {}))
    (found,) = _read(maker, tmp_path)
    assert list(found.uv) == [0, 1]
    expected = np.maximum(numbers[:4] / (scale or 1), -1.0 if scale else -np.inf)
    np.testing.assert_allclose(found.uv[1], expected, rtol=1e-7)


def test_interleaved_vertices(tmp_path):
    maker = Maker()
    view = maker.view(np.hstack([POINTS + 1, PLACES * 0.5]).tobytes(), byteStride=20)
    position, uv = maker.content["accessors"][:2]
    position["bufferView"], uv["bufferView"], uv["byteOffset"] = view, view, 12
    (found,) = _read(maker, tmp_path)
    np.testing.assert_array_equal(found.position, POINTS[:4] + 1)
    np.testing.assert_array_equal(found.uv[0], PLACES[:4] * 0.5)


@pytest.mark.parametrize("base", [True, False])
def test_sparse_and_absent_data(tmp_path, base):
    maker = Maker()
    accessor = maker.content["accessors"][maker.primitive["attributes"]["TEXCOORD_0"]]
    at, values = np.array([1, 3], np.uint8), np.array([[0.1, 0.2], [0.3, 0.4]], np.float32)
    accessor["sparse"] = {
        "count": 2,
        "indices": {"bufferView": maker.view(at.tobytes()), "componentType": 5121},
        "values": {"bufferView": maker.view(values.tobytes())},
    }
    expected = PLACES.copy() if base else np.zeros_like(PLACES)
    expected[at] = values
    if not base:
        del accessor["bufferView"]
    (found,) = _read(maker, tmp_path)
    np.testing.assert_array_equal(found.uv[0], expected[:4])


def test_strips_fans_and_vertices_in_their_order(tmp_path):
    maker = Maker()
    maker.primitive["mode"] = 5
    maker.primitive["indices"] = maker.add(np.array([0, 1, 2, 3, 4], np.uint16))
    (strip,) = _read(maker, tmp_path)
    np.testing.assert_array_equal(strip.triangle, [[0, 1, 2], [1, 3, 2], [2, 3, 4]])
    maker.primitive["mode"] = 6
    (fan,) = _read(maker, tmp_path)
    np.testing.assert_array_equal(fan.triangle, [[1, 2, 0], [2, 3, 0], [3, 4, 0]])
    del maker.primitive["indices"]
    (bare,) = _read(maker, tmp_path)
    np.testing.assert_array_equal(bare.triangle, fan.triangle)
    maker.primitive["indices"] = maker.add(np.array([0, 1], np.uint16))
    assert _read(maker, tmp_path) == []


def test_what_has_no_triangles_is_left_out(tmp_path):
    maker = Maker()
    attributes = maker.primitive["attributes"]
    maker.content["meshes"][0]["primitives"] = [
        {"attributes": attributes, "mode": 0},
        {"attributes": attributes, "mode": 3},
        {"attributes": {"TEXCOORD_0": attributes["TEXCOORD_0"]}},
        maker.primitive,
    ]
    (found,) = _read(maker, tmp_path)
    assert found.primitive == 3


def test_primitives_that_share_accessors(tmp_path):
    maker = Maker()
    second = {**maker.primitive, "indices": maker.add(np.array([4, 3, 1], np.uint8))}
    maker.content["meshes"][0]["primitives"].append(second)
    maker.content["nodes"].append({"mesh": 0, "translation": [0, 0, 1]})
    maker.content["scenes"][0]["nodes"] = [0, 1]
    found = _read(maker, tmp_path)
    assert [(each.node, each.primitive) for each in found] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    np.testing.assert_array_equal(found[3].position, POINTS[[1, 3, 4]] + [0, 0, 1])
    np.testing.assert_array_equal(found[3].triangle, [[2, 1, 0]])
    np.testing.assert_array_equal(found[3].row, [1, 3, 4])


@pytest.mark.parametrize("key", ["extensionsUsed", "extensionsRequired"])
def test_instances_are_refused_by_name(tmp_path, key):
    maker = Maker()
    maker.content[key] = ["KHR_materials_unlit", "EXT_mesh_gpu_instancing"]
    text = error_of(read_gltf, maker.save(tmp_path / "a.glb"))
    assert "uses the extension EXT_mesh_gpu_instancing" in text and "gltf-transform uninstance" in text


WRONG = [
    (["asset", "version", "1.0"], "asset.version: expected 2.0, found 1.0"),
    (["scene", 7], "scenes[7]: the file has 1 scenes"),
    (["nodes", 0, "mesh", 3], "meshes[3]: the file has 1 meshes"),
    (["nodes", 0, "children", [0]], "nodes[0]: expected one parent"),
    (["nodes", 0, "rotation", "up"], "malformed glTF"),
    (["meshes", 0, "primitives", 0, "attributes", "POSITION", 9], "accessors[9]: the file has 3 accessors"),
    (["meshes", 0, "primitives", 0, "attributes", "TEXCOORD_0", 0], "accessors[0].type: expected VEC2, found VEC3"),
    (["accessors", 0, "count", 0], "accessors[0]: count: expected at least 1, found 0"),
    (["accessors", 0, "byteOffset", 4], "accessors[0]: needs 64 bytes"),
    (["accessors", 0, "componentType", 5124], "accessors[0]: expected a componentType"),
    (["accessors", 1, "count", 4], "TEXCOORD_0: expected 5 UVs, like POSITION, found 4"),
    (["accessors", 2, "count", 5], "expected three corners per triangle, found 5"),
    (["accessors", 2, "componentType", 5122], "indices: expected unsigned integers"),
    (["accessors", 0, "sparse", {"count": 1}], "malformed glTF: the field 'indices' is missing"),
    (["bufferViews", 0, "byteLength", 10**9], "bufferViews[0]: needs 1000000000 bytes of buffers[0]"),
    (["bufferViews", 0, "byteOffset", -1], "bufferViews[0]: expected whole numbers"),
]


@pytest.mark.parametrize(("change", "words"), WRONG)
def test_a_wrong_field_is_named(tmp_path, change, words):
    maker = Maker()
    *route, key, value = copy.deepcopy(change)
    place = maker.content
    for step in route:
        place = place[step]
    place[key] = value
    text = error_of(read_gltf, maker.save(tmp_path / "a.glb"))
    assert words in text and text.startswith(str(tmp_path / "a.glb"))


def test_an_index_beyond_the_vertices(tmp_path):
    maker = Maker()
    maker.primitive["indices"] = maker.add(np.array([0, 1, 5], np.uint8))
    assert "indices: expected numbers below 5, found 5" in error_of(read_gltf, maker.save(tmp_path / "a.glb"))
    maker = Maker()
    maker.content["accessors"][1] |= {
        "sparse": {
            "count": 1,
            "indices": {"bufferView": maker.view(b"\5"), "componentType": 5121},
            "values": {"bufferView": maker.view(bytes(8))},
        }
    }
    assert "sparse.indices: expected numbers below 5, found 5" in error_of(read_gltf, maker.save(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("gone.bin", "gone.bin: cannot read buffers[0] of "),
        ("http://a.example/b.bin", "buffers[0].uri: expected a path relative to the document, found http"),
        ("data:;base64,?", "buffers[0].uri: expected base64"),
        ("data:;base64,AAAA", "buffers[0]: expected 500 bytes, found 3"),
        (None, "buffers[0]: expected a uri; only buffers[0] of a .glb with a binary chunk has none"),
    ],
)
def test_a_buffer_that_cannot_be_read(tmp_path, uri, words):
    content = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 500, "uri": uri}]}
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(content))
    assert words in error_of(read_gltf, path)


def test_other_and_damaged_files_are_refused(tmp_path):
    path = tmp_path / "a.glb"
    assert "No such file" in error_of(read_gltf, path)
    for text in ("", "[]", "{}", '{"asset": 1}', '{"asset": {"version": "2.0"', "[" * 100_000):
        path.write_text(text)
        error_of(read_gltf, path)
    whole = Maker().glb()
    for length in range(0, len(whole), 3):
        path.write_bytes(whole[:length])
        error_of(read_gltf, path)
    path.write_bytes(whole[:4] + struct.pack("<I", 1) + whole[8:])
    assert "expected version 2 of the .glb format, found 1" in error_of(read_gltf, path)
    path.write_bytes(whole[:12] + struct.pack("<I", 2**31) + whole[16:])
    assert "bytes at byte 12 exceeds the file of" in error_of(read_gltf, path)
    path.write_bytes(struct.pack("<4s2I", b"glTF", 2, 12))
    assert "no JSON chunk" in error_of(read_gltf, path)
