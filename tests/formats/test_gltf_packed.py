"""Meshes that Draco and meshopt compress."""

import importlib

import numpy as np
import pytest
from builders.checks import error_of
from builders.gltf_maker import GltfMaker
from builders.gltf_scene import box

from wlm.formats import gltf_packed
from wlm.formats.gltf import read_gltf
from wlm.formats.gltf_writer import encode_glb

POSITION, TRIANGLE, UV = box((0, 0, 0), (2, 1, 3))
DRACO, MESHOPT = "KHR_draco_mesh_compression", "EXT_meshopt_compression"


def scene(maker, primitive, *used):
    maker.content |= {
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0, "scale": [1, 2, 1]}],
        "extensionsUsed": list(used),
        "extensionsRequired": list(used),
    }
    return maker


def meshopt_scene():
    """As gltfpack writes it: quantised, with a buffer that has no bytes as the fallback."""
    meshopt = pytest.importorskip("meshopt")
    maker = GltfMaker()
    places = np.zeros((len(POSITION), 4), "<u2")
    places[:, :3] = np.round(POSITION * 1000)
    uvs = np.round(UV * 65535).astype("<u2")
    corners = TRIANGLE.astype("<u2").reshape(-1)
    accessors, start = [], 0
    parts = (places, "ATTRIBUTES", "VEC3"), (uvs, "ATTRIBUTES", "VEC2"), (corners, "TRIANGLES", "SCALAR")
    for data, mode, kind in parts:
        packed = meshopt.encode_gltf_buffer(data, mode)
        view = maker.content["bufferViews"][maker.view(packed)]
        stride = data.nbytes // len(data)
        extension = {**view, "byteStride": stride, "count": len(data), "mode": mode}
        view |= {"buffer": 1, "byteOffset": start, "byteLength": data.nbytes, "extensions": {MESHOPT: extension}}
        view |= {"byteStride": stride} if mode == "ATTRIBUTES" else {}
        start += data.nbytes
        entry = {"componentType": 5123, "count": len(data), "type": kind, "bufferView": len(accessors)}
        accessors.append(entry | ({"normalized": True} if kind == "VEC2" else {}))
    maker.content["accessors"] = accessors
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2}
    return scene(maker, primitive, MESHOPT, "KHR_mesh_quantization"), start


def meshopt_file(folder, **changes):
    maker, size = meshopt_scene()
    maker.content["bufferViews"][2]["extensions"][MESHOPT] |= changes
    fallback = {"byteLength": size, "extensions": {MESHOPT: {"fallback": True}}}
    maker.content["buffers"] = [{"byteLength": len(maker.blob)}, fallback]
    return maker.save(folder / "a.glb")


def draco_file(folder, cut=0, **changes):
    draco = pytest.importorskip("DracoPy")
    maker = GltfMaker()
    data = draco.encode(POSITION.astype("f4"), TRIANGLE.astype("u4"), tex_coord=UV, preserve_order=True)
    ids = {each["attribute_type"]: each["unique_id"] for each in draco.decode(data).attributes}
    kinds = {"POSITION": draco.AttributeType.POSITION, "TEXCOORD_0": draco.AttributeType.TEX_COORD}
    maker.content["accessors"] = [
        {"componentType": 5126, "count": len(POSITION), "type": "VEC3"},
        {"componentType": 5126, "count": len(UV), "type": "VEC2"},
        {"componentType": 5123, "count": TRIANGLE.size, "type": "SCALAR"},
    ]
    maker.content["accessors"][0] |= changes
    attributes = {name: ids[kinds[name]] for name in kinds}
    packed = {"bufferView": maker.view(data[: len(data) - cut]), "attributes": attributes}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "extensions": {DRACO: packed}}
    return scene(maker, primitive, DRACO).save(folder / "a.glb")


@pytest.mark.parametrize(
    ("make", "extension", "scale", "atol"),
    [(meshopt_file, MESHOPT, [1000, 2000, 1000], 1e-9), (draco_file, DRACO, [1, 2, 1], 1e-3)],
)
def test_a_compressed_box(tmp_path, make, extension, scale, atol):
    """A copy has no extension and the same triangles."""
    document, (primitive,) = read_gltf(make(tmp_path))
    np.testing.assert_allclose(primitive.position, POSITION * scale, atol=atol)
    np.testing.assert_array_equal(np.sort(primitive.triangle, axis=1), np.sort(TRIANGLE, axis=1))
    np.testing.assert_allclose(primitive.uv[0], UV, atol=1e-4)
    (tmp_path / "b.glb").write_bytes(b"".join(encode_glb(document)))
    again, (same,) = read_gltf(tmp_path / "b.glb")
    np.testing.assert_array_equal(same.position, primitive.position)
    assert extension not in str(again.content)


def test_damage(tmp_path, monkeypatch):
    assert f"{DRACO}: damaged" in error_of(read_gltf, draco_file(tmp_path, cut=40))
    assert "POSITION: expected 25 elements, found 24" in error_of(read_gltf, draco_file(tmp_path, count=25))
    data = meshopt_file(tmp_path).read_bytes()
    (tmp_path / "a.glb").write_bytes(data[:-100] + bytes(100))
    assert f"{MESHOPT}: damaged" in error_of(read_gltf, tmp_path / "a.glb")
    text = error_of(read_gltf, meshopt_file(tmp_path, count=10**12))
    assert f"bufferViews[2].{MESHOPT}: expected at most 256 times its" in text
    monkeypatch.setattr(gltf_packed, "SURE_BYTES", 0)
    monkeypatch.setattr(gltf_packed, "GROWTH", 0)
    assert "the meshes have more than 0 bytes" in error_of(read_gltf, draco_file(tmp_path))


@pytest.mark.parametrize("name", [DRACO, MESHOPT, "KHR_meshopt_compression"])
def test_a_missing_package_is_named(tmp_path, monkeypatch, name):
    def missing(package):
        raise ModuleNotFoundError(package, name=package)

    monkeypatch.setattr(importlib, "import_module", missing)
    maker = GltfMaker()
    view = maker.view(bytes(32))
    maker.content["bufferViews"].append({"buffer": 0, "byteLength": 8, "extensions": {name: {"buffer": 0}}})
    primitive = {"attributes": {}, "extensions": {DRACO: {"bufferView": view, "attributes": {}}}}
    text = error_of(read_gltf, scene(maker, primitive, name).save(tmp_path / "a.glb"))
    assert f"uses the extension {name}" in text and "pip install 'wlm[gltf]'" in text
