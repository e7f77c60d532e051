"""Copies of glTF files with one more UV set: what changes, what stays, and the format's rules."""

import copy
import io
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of
from builders.gltf_maker import GltfMaker

from wlm.formats.gltf import GltfDocument, components, document_from_meshes, read_gltf
from wlm.formats.gltf_writer import Replacement, write_glb

POINTS = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [2, 3, 1], [9, 9, 9]], np.float32)
PLACES = np.array([[0, 0], [0.5, 0], [0, 0.75], [0.5, 0.75], [1, 1]], np.float32)
TRIANGLES = np.array([[1, 2, 3], [3, 2, 4]], np.uint16)
ROWS = np.array([1, 2, 3, 4])  # those that the triangles use
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [1, 2, 3], [4, 5, 6]], np.uint8)
GATHER = np.array([2, 0, 1, 3, 1, 2])
CORNERS = np.array([[1, 2, 0], [5, 4, 3]])
NEW_UV = np.arange(12).reshape(6, 2) / 16
BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}


def _document(folder: Path) -> GltfDocument:
    """A file with most of what glTF has: attributes of several encodings, morphs, a skin, an animation, an image."""
    maker = GltfMaker()
    content, add = maker.content, maker.add
    content["asset"]["generator"] = "test"
    maker.view(b"\x89PNG, say")
    primitive = {
        "attributes": {
            "POSITION": add(POINTS, min=[0, 0, 0], max=[9, 9, 9]),
            "NORMAL": add(POINTS[::-1].copy()),
            "COLOR_0": add(COLOURS, normalized=True),
            "TEXCOORD_0": add(PLACES),
            "_WEIGHT": add(np.arange(5, dtype=np.float32)),
        },
        "targets": [{"POSITION": add(POINTS * 2, min=[0, 0, 0], max=[18, 18, 18])}],
        "indices": add(TRIANGLES.reshape(-1)),
        "material": 0,
        "extras": {"keep": [1, {"me": None}]},
        "extensions": {"CESIUM_primitive_outline": {"indices": 6}, "KHR_materials_variants": {"mappings": []}},
    }
    dots = {"attributes": {"POSITION": primitive["attributes"]["POSITION"]}, "mode": 0}
    content |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}, {"nodes": [2]}],
        "nodes": [{"mesh": 0, "skin": 0}, {"mesh": 0, "translation": [1, 0, 0]}, {"mesh": 0, "name": "elsewhere"}],
        "meshes": [{"primitives": [dots, primitive], "weights": [0.5], "name": "mêsh"}],
        "materials": [{"alphaMode": "BLEND", "extensions": {"KHR_materials_unlit": {}}}],
        "images": [{"bufferView": 0, "mimeType": "image/png"}, {"uri": "a%20b.png"}, {"uri": "gone.jpg"}],
        "skins": [{"joints": [2], "inverseBindMatrices": add(np.eye(4, dtype=np.float32).reshape(1, 16))}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}],
                "samplers": [
                    {
                        "input": add(np.array([0, 1], np.float32), min=[0], max=[1]),
                        "output": add(np.ones((2, 3), np.float32)),
                    }
                ],
            }
        ],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}],
        "extensionsUsed": ["KHR_materials_unlit", "KHR_materials_variants"],
        "buffers": [{"byteLength": len(maker.blob), "uri": "a.bin"}],
    }
    (folder / "a.bin").write_bytes(maker.blob)
    (folder / "a b.png").write_bytes(b"\x89PNG\r\n\x1a\n a picture")
    (folder / "in.gltf").write_text(json.dumps(content))
    return read_gltf(folder / "in.gltf")[0]


def _replacements(folder: Path) -> list[Replacement]:
    found = read_gltf(folder / "in.gltf")[1]
    return [Replacement(each, GATHER, CORNERS, NEW_UV + i * 0.001) for i, each in enumerate(found)]


def _check_rules(path: Path) -> GltfDocument:
    """Holds a written file to the format's rules on sizes, alignment, ranges and bounds."""
    data = path.read_bytes()
    magic, version, length, text_length, kind = struct.unpack_from("<4s4I", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    assert text_length % 4 == 0 and len(data) % 4 == 0
    blob_length, kind = struct.unpack_from("<2I", data, 20 + text_length)
    assert kind == 0x004E4942 and 28 + text_length + blob_length == len(data)
    document, _ = read_gltf(path)
    content = document.content
    assert [set(each) for each in content["buffers"]] == [{"byteLength"}]
    assert blob_length - 3 <= content["buffers"][0]["byteLength"] <= blob_length
    for i, accessor in enumerate(content["accessors"]):
        view = content["bufferViews"][accessor["bufferView"]]
        size = BYTES[accessor["componentType"]]
        start = view["byteOffset"] + accessor.get("byteOffset", 0)
        assert start % size == 0 and view["byteOffset"] + view["byteLength"] <= blob_length
        if view.get("target") == 34962:
            assert start % 4 == 0 and view["byteStride"] % 4 == 0 and 4 <= view["byteStride"] <= 252
        else:
            assert view.get("target") == 34963 or "target" not in view
        if "min" in accessor:
            values = components(document, i, accessor["type"])
            assert accessor["min"] == values.min(axis=0).tolist() and accessor["max"] == values.max(axis=0).tolist()
    for mesh in content["meshes"]:
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            counts = {content["accessors"][number]["count"] for number in attributes.values()}
            sets = sorted(name for name in attributes if name.startswith("TEXCOORD_"))
            assert len(counts) == 1 and sets == [f"TEXCOORD_{n}" for n in range(len(sets))]
            assert {"min", "max"} <= set(content["accessors"][attributes["POSITION"]])
            if "indices" in primitive:
                accessor = content["accessors"][primitive["indices"]]
                corners = components(document, primitive["indices"], "SCALAR")
                assert corners.max() < min(counts) and corners.max() < 2 ** (8 * BYTES[accessor["componentType"]]) - 1
                assert content["bufferViews"][accessor["bufferView"]].get("target", 34963) == 34963
    return document


def test_vertices_are_gathered_and_all_else_stays(tmp_path):
    before = _document(tmp_path)
    original = copy.deepcopy(before.content)
    written = write_glb(tmp_path / "out.glb", before, _replacements(tmp_path), 1)
    assert written == (tmp_path / "out.glb").stat().st_size and before.content == original
    after = _check_rules(tmp_path / "out.glb")
    old, new = before.content, after.content
    for key in ("asset", "scene", "scenes", "materials", "cameras", "extensionsUsed"):
        assert new[key] == old[key]
    primitive = new["meshes"][new["nodes"][0]["mesh"]]["primitives"][1]
    expected = {
        "POSITION": ("VEC3", POINTS),
        "NORMAL": ("VEC3", POINTS[::-1]),
        "COLOR_0": ("VEC3", COLOURS),
        "TEXCOORD_0": ("VEC2", PLACES),
        "_WEIGHT": ("SCALAR", np.arange(5.0)[:, None]),
    }
    assert sorted(primitive["attributes"]) == sorted([*expected, "TEXCOORD_1"])
    for name, (kind, values) in expected.items():
        found = components(after, primitive["attributes"][name], kind)
        np.testing.assert_array_equal(found, values[ROWS[GATHER]], err_msg=name)
    colour = new["accessors"][primitive["attributes"]["COLOR_0"]]
    assert colour["normalized"] is True and colour["componentType"] == 5121
    np.testing.assert_array_equal(components(after, primitive["attributes"]["TEXCOORD_1"], "VEC2"), NEW_UV)
    moved = components(after, primitive["targets"][0]["POSITION"], "VEC3")
    np.testing.assert_array_equal(moved, POINTS[ROWS[GATHER]] * 2)
    np.testing.assert_array_equal(components(after, primitive["indices"], "SCALAR").reshape(-1, 3), CORNERS)
    assert (primitive["material"], primitive["mode"]) == (0, 4)
    assert primitive["extras"] == {"keep": [1, {"me": None}]}
    assert primitive["extensions"] == {"KHR_materials_variants": {"mappings": []}}


def test_each_node_has_its_own_uvs_and_equal_data_is_stored_once(tmp_path):
    document = _document(tmp_path)
    write_glb(tmp_path / "out.glb", document, _replacements(tmp_path), 1)
    content = _check_rules(tmp_path / "out.glb").content
    meshes = [node["mesh"] for node in content["nodes"]]
    # The node of the other scene keeps the mesh as it was.
    assert len(set(meshes)) == 3 and content["meshes"][meshes[2]]["name"] == "mêsh"
    assert "TEXCOORD_1" not in content["meshes"][meshes[2]]["primitives"][1]["attributes"]
    first, second = (content["meshes"][meshes[i]]["primitives"][1] for i in (0, 1))
    assert first["attributes"].pop("TEXCOORD_1") != second["attributes"].pop("TEXCOORD_1")
    assert first == second
    found = read_gltf(tmp_path / "out.glb")[1]
    for i, each in enumerate(found):
        np.testing.assert_array_equal(each.uv[1][each.triangle], (NEW_UV + i * 0.001).astype(np.float32)[CORNERS])
        np.testing.assert_array_equal(each.position[each.triangle], POINTS[ROWS[GATHER]][CORNERS] + [i, 0, 0])


def test_skins_animations_and_images_find_their_data(tmp_path):
    before = _document(tmp_path)
    write_glb(tmp_path / "out.glb", before, _replacements(tmp_path), 1)
    after = _check_rules(tmp_path / "out.glb")
    content = after.content
    matrices = components(after, content["skins"][0]["inverseBindMatrices"], "MAT4")
    np.testing.assert_array_equal(matrices, np.eye(4).reshape(1, 16))
    sampler = content["animations"][0]["samplers"][0]
    np.testing.assert_array_equal(components(after, sampler["input"], "SCALAR"), [[0], [1]])
    np.testing.assert_array_equal(components(after, sampler["output"], "VEC3"), np.ones((2, 3)))

    def payload(image: dict) -> bytes:
        view = content["bufferViews"][image["bufferView"]]
        return after.buffers[0][view["byteOffset"] :][: view["byteLength"]]

    images = content["images"]
    assert payload(images[0]) == b"\x89PNG, say"
    assert payload(images[1]) == b"\x89PNG\r\n\x1a\n a picture"
    assert images[1]["mimeType"] == "image/png" and "uri" not in images[1]
    assert images[2] == {"uri": "gone.jpg"}


def test_unused_data_is_left_out_unless_an_extension_may_use_it(tmp_path):
    document = _document(tmp_path)
    document.content["nodes"][2].pop("mesh")  # now the old vertices serve the points alone
    replaced = _replacements(tmp_path)
    write_glb(tmp_path / "out.glb", document, replaced, 1)
    small = _check_rules(tmp_path / "out.glb")
    document.content["extensionsUsed"].append("EXT_structural_metadata")
    document.content["extensions"] = {"EXT_structural_metadata": {"propertyTables": [{"values": 3}]}}
    write_glb(tmp_path / "all.glb", document, replaced, 1)
    whole = _check_rules(tmp_path / "all.glb")
    assert whole.content["extensions"] == document.content["extensions"]
    old = len(document.content["accessors"])
    for number in range(old):
        kind = document.content["accessors"][number]["type"]
        np.testing.assert_array_equal(components(whole, number, kind), components(document, number, kind))
    # Six accessors of the primitive and its indices are no longer used; its positions are, by the points.
    assert len(whole.content["accessors"]) - len(small.content["accessors"]) == 6
    assert (tmp_path / "all.glb").stat().st_size > (tmp_path / "out.glb").stat().st_size


@pytest.mark.parametrize(("count", "component"), [(65535, 5123), (65536, 5125)])
def test_indices_are_as_wide_as_they_must_be(tmp_path, count, component):
    points = np.zeros((count, 3))
    points[:, 0] = np.arange(count)
    triangle = np.arange(count // 3 * 3).reshape(-1, 3)
    document, (primitive,) = document_from_meshes([("many", points, triangle, points[:, :2])], "many")
    replacement = Replacement(primitive, np.arange(count), np.vstack([triangle, [[0, 1, count - 1]]]), points[:, 1:])
    write_glb(tmp_path / "out.glb", document, [replacement], 1)
    after = _check_rules(tmp_path / "out.glb")
    number = after.content["meshes"][0]["primitives"][0]["indices"]
    assert after.content["accessors"][number]["componentType"] == component
    assert components(after, number, "SCALAR").max() == count - 1


def test_sets_that_are_missing_between_are_filled(tmp_path):
    document, (primitive,) = document_from_meshes([("few", POINTS, TRIANGLES, PLACES)], "few")
    write_glb(tmp_path / "out.glb", document, [Replacement(primitive, GATHER, CORNERS, NEW_UV)], 3)
    _check_rules(tmp_path / "out.glb")
    (found,) = read_gltf(tmp_path / "out.glb")[1]
    assert list(found.uv) == [0, 1, 2, 3]
    for number in (1, 2, 3):
        np.testing.assert_array_equal(found.uv[number][found.triangle], NEW_UV[CORNERS].astype(np.float32))
    np.testing.assert_array_equal(found.uv[0][found.triangle], PLACES[GATHER][CORNERS])


def test_what_is_malformed_beside_the_scene_is_one_line(tmp_path):
    document = _document(tmp_path)
    document.content["meshes"].append({"primitives": [{"attributes": {"POSITION": 99}}]})
    assert "malformed glTF" in error_of(write_glb, tmp_path / "out.glb", document, _replacements(tmp_path), 1)
    assert "out.glb" not in os.listdir(tmp_path)


def test_another_reader_finds_the_same_geometry(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_glb(tmp_path / "out.glb", _document(tmp_path), _replacements(tmp_path), 1)
    scene = trimesh.load(io.BytesIO((tmp_path / "out.glb").read_bytes()), file_type="glb")
    drawn = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh)]
    corners = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in drawn])
    ours = np.concatenate([each.position[each.triangle].reshape(-1, 9) for each in read_gltf(tmp_path / "out.glb")[1]])
    assert np.array_equal(np.unique(corners, axis=0), np.unique(ours, axis=0))
