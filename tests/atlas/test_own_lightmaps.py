"""Lightmaps that a glTF file names itself, texture transforms of their UVs, and UVs that don't fit the light."""

import base64
import io
import json
from contextlib import contextmanager

import imagecodecs
import numpy as np
import OpenEXR
import pytest
from builders.checks import error_of
from builders.gltf_maker import GltfMaker
from builders.gltf_scene import Thing, box, write_scene
from PIL import Image

from wlm.atlas.data import from_arrays, load
from wlm.atlas.stored import store, with_uvs
from wlm.formats.exr import write_exr
from wlm.formats.geometry import read_geometry
from wlm.formats.gltf import parse_gltf, read_gltf
from wlm.inspection import inspect

SIDE = 64
POSITION, TRIANGLE, UV = box((0, 0, 0), (1, 1, 1))
PNG_8, EXR = "images of 8 bits are read as", "a.exr"


def light(uv: np.ndarray = UV, dilated: bool = False, rows: float = 2.0) -> np.ndarray:
    """A light in [0, 1] that is smooth in each chart of UVs; black gaps, or that of the nearest texel."""
    sheet = from_arrays(POSITION, TRIANGLE, uv, np.ones((SIDE, SIDE, 3))).sheets[0]
    row, column = np.mgrid[:SIDE, :SIDE] / SIDE
    level = 0.1 + 0.9 * ((np.floor(3 * column) + 3 * np.floor(rows * row)) * 0.618 % 1.0)
    values = (level * (0.9 + 0.1 * np.sin(5 * column)))[..., None] * [1.0, 0.8, 0.6]
    values = values if dilated else values * sheet.mask[..., None]
    return values.astype(np.float16).astype(np.float32)


OTHER = box((0, 0, 0), (1, 1, 1))[2][:, ::-1] * [0.93, 1.0]
"""UVs of another layout, for the base colour."""


def scene(folder, slot, sets=(OTHER, UV), images=({"uri": EXR},), textures=({"source": 0},), **more):
    """Writes a box whose material has a slot, and a lightmap beside it."""
    write_exr(folder / EXR, light())
    things = [Thing("crate", POSITION, TRIANGLE, list(sets), material=slot)]
    return write_scene(folder / "a.gltf", things, {"images": list(images), "textures": list(textures)} | more)


@contextmanager
def changed(path):
    """The JSON content of a file, which is written at the end of the block."""
    content = json.loads(path.read_text())
    yield content
    path.write_text(json.dumps(content))


def listed(folder, file, *objects, **more):
    """Writes a list of one lightmap."""
    content = {"sheets": [{"files": [file]}], "objects": objects} | more
    (folder / "lights.json").write_text(json.dumps(content))
    return folder / "lights.json"


def moz(**more):
    return {"extensions": {"MOZ_lightmap": {"index": 0} | more}}


def assert_lit(found, expected=None, atol=2e-3):
    (sheet,) = found.sheets
    expected = light() if expected is None else expected
    np.testing.assert_allclose(sheet.lightmap[sheet.mask], expected[sheet.mask], atol=atol)
    np.testing.assert_allclose(np.sort(sheet.uv, axis=0), np.sort(UV, axis=0), atol=1e-4)


def srgb(values):
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)


def png(values, mode="RGB"):
    stream = io.BytesIO()
    Image.fromarray((255 * values + 0.5).astype(np.uint8), mode).save(stream, "PNG")
    return stream.getvalue()


@pytest.mark.parametrize("stated", [{}, {"texCoord": 1}])
def test_the_uv_set_without_texcoord_is_the_second(tmp_path, stated):
    found = load(scene(tmp_path, moz(**stated)))
    assert found.uv_set == 1
    assert any("TEXCOORD_1 is read (see --uv-set)" in line for line in found.warnings) == (not stated)
    assert_lit(found)
    assert load(scene(tmp_path, moz(), sets=[UV])).uv_set == 0
    assert load(scene(tmp_path, moz(texCoord=1), sets=[UV, OTHER]), uv_set=0).uv_set == 0


def test_pictures_inside_the_file(tmp_path):
    """In a buffer view and as a data: URI; PNG in sRGB, Radiance and EXR."""
    path = scene(tmp_path, moz(texCoord=1))
    radiance, exr = imagecodecs.rgbe_encode(light(), header=True), (tmp_path / EXR).read_bytes()
    for data, atol in ((png(srgb(light())), 0.02), (radiance, 0.02), (exr, 2e-3)):
        uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        content = json.loads(scene(tmp_path, moz(texCoord=1), images=[{"uri": uri}]).read_text())
        inside = load(tmp_path / "a.gltf")
        assert_lit(inside, atol=atol)
        assert any(PNG_8 in line for line in inside.warnings) == (data[:4] == b"\x89PNG")
        maker = GltfMaker()
        maker.content |= {key: content[key] for key in content.keys() - {"accessors", "bufferViews", "buffers"}}
        attributes = {"POSITION": maker.add(np.float32(POSITION)), "TEXCOORD_1": maker.add(np.float32(UV))}
        corners = maker.add(np.uint32(TRIANGLE).reshape(-1))
        maker.content["meshes"] = [{"primitives": [{"attributes": attributes, "indices": corners, "material": 0}]}]
        maker.content["images"] = [{"bufferView": maker.view(data), "mimeType": "image/png"}]
        assert_lit(load(maker.save(tmp_path / "a.glb")), atol=atol)
    maker.content["images"] = [{"bufferView": maker.view(b"\x89PNG nothing")}]
    text = error_of(load, maker.save(tmp_path / "a.glb"))
    assert text.startswith(f"{tmp_path / 'a.glb'}: bufferViews[") and "/proc" not in text
    assert path.exists()


def test_images_by_percent_encoding_and_extension(tmp_path):
    write_exr(tmp_path / "my lm#1%.exr", light())
    assert_lit(load(scene(tmp_path, moz(), images=[{"uri": "my%20lm%231%25.exr"}])))
    write_exr(tmp_path / "100%.exr", light())
    assert_lit(load(scene(tmp_path, moz(), images=[{"uri": "100%.exr"}])))
    for name in ("EXT_texture_webp", "EXT_texture_exr", "KHR_texture_basisu"):
        assert_lit(load(scene(tmp_path, moz(), textures=[{"extensions": {name: {"source": 0}}}])))
    assert "expected an image that can be read, found EXT_texture_avif" in error_of(
        load, scene(tmp_path, moz(), textures=[{"extensions": {"EXT_texture_avif": {"source": 0}}}])
    )
    images = [{"uri": "https://example.org/a.exr"}]
    assert "a path relative to the document" in error_of(load, scene(tmp_path, moz(), images=images))


NODE = {"MX_lightmap": {"lightMapTexture": {"index": 0}, "scale": [0.5, 0.5], "offset": [0.5, 0.0], "intensity": 2}}
NEEDLE = {"name": "MeshRenderer", "lightmapIndex": 0, "lightmapScaleOffset": {"x": 0.5, "y": 0.5, "z": 0.5, "w": 0.5}}
SECOND = {"index": 0, "texCoord": 1}
WRITERS = {
    "XR3": ({"XR3_lightmap": {"index": 0, "texCoord": 1, "intensity": 2.0}}, {}, {}),
    "FB": ({"FB_materials_lightmap": {"lightmapTexture": SECOND, "lightmapFactor": [2, 2, 2]}}, {}, {}),
    "WEBGI": ({"WEBGI_materials_lightmap": {"lightMapTexture": SECOND, "lightMapIntensity": 2}}, {}, {}),
    "MX": ({}, NODE, {}),
    "NEEDLE": (
        {},
        {"NEEDLE_components": {"builtin_components": [NEEDLE]}},
        {"NEEDLE_lightmaps": {"textures": [{"pointer": "textures/0", "type": 0, "index": 0}]}},
    ),
    "EPIC": (
        {},
        {"EPIC_lightmap_textures": {"lightmap": 0}},
        {"EPIC_lightmap_textures": {"lightmaps": [{"texture": SECOND, "coordinateScaleBias": [0.5, 0.5, 0.5, 0]}]}},
    ),
}


def writers_scene(folder, writer):
    material, node, root = WRITERS[writer]
    with changed(scene(folder, {"extensions": material}, extensions=root)) as content:
        content["nodes"][0]["extensions"] = node
    return folder / "a.gltf"


@pytest.mark.parametrize("writer", WRITERS)
def test_lightmaps_of_other_extensions(tmp_path, writer):
    found = load(writers_scene(tmp_path, writer))
    (place,) = found.objects
    rectangle = (0.5, 0.5, 0.5, 0.0) if writer in ("MX", "EPIC", "NEEDLE") else (1.0, 1.0, 0.0, 0.0)
    assert place.scale_offset == rectangle and found.uv_set == 1
    extension = next(iter(WRITERS[writer][0] or WRITERS[writer][2] or NODE))
    assert any(line.endswith(f"1 lightmap of {extension}") for line in found.warnings)
    sheet, factor = found.sheets[0], 1.0 if writer in ("EPIC", "NEEDLE") else 2.0
    lit = (light()[sheet.mask] > 0).all(axis=1)
    np.testing.assert_allclose(sheet.lightmap[sheet.mask][lit], factor * light()[sheet.mask][lit], rtol=1e-3)


def test_the_renderer_of_several_materials_is_above_its_meshes(tmp_path):
    with changed(writers_scene(tmp_path, "NEEDLE")) as content:
        above = content["nodes"][0].pop("extensions")
        content["nodes"].append({"children": [0], "extensions": above})
        content["scenes"][0]["nodes"] = [1]
    (place,) = load(tmp_path / "a.gltf").objects
    assert (place.node, place.scale_offset) == (0, (0.5, 0.5, 0.5, 0.0))


def test_a_factor_for_each_channel(tmp_path):
    factor = {"lightmapTexture": SECOND, "lightmapFactor": [2.0, 1.0, 0.5]}
    assert_lit(load(scene(tmp_path, {"extensions": {"FB_materials_lightmap": factor}})), light() * [2.0, 1.0, 0.5])
    factor["lightmapFactor"] = [2.0, -1.0, 0.5]
    text = error_of(load, scene(tmp_path, {"extensions": {"FB_materials_lightmap": factor}}))
    assert "expected a factor of the light, one number or three, of 0 or more" in text


def test_lightmaps_that_are_named_and_cannot_be_read(tmp_path):
    path = writers_scene(tmp_path, "EPIC")
    with changed(path) as content:
        content["extensions"]["EPIC_lightmap_textures"]["lightmaps"][0]["lightmapAdd"] = [0, 0, 0, -4]
    assert "EPIC_lightmap_textures holds Unreal's encoded lightmap" in error_of(load, path)
    (tmp_path / "a.png").write_bytes(png(light()))
    with changed(writers_scene(tmp_path, "NEEDLE")) as content:
        content["images"][0]["uri"] = "a.png"
    assert "NEEDLE_lightmaps: an image of 8 bits in Needle's RGBM" in error_of(load, path)
    with changed(path) as content:
        content["nodes"][0]["extensions"]["NEEDLE_components"]["builtin_components"][0]["lightmapIndex"] = 65535
    assert "NEEDLE_lightmaps: no mesh of the scene has such" in error_of(load, path)
    assert "its extension A_lightmap is not known" in error_of(load, scene(tmp_path, {}, extensionsUsed=["A_lightmap"]))
    assert "texCoord" not in error_of(load, scene(tmp_path, moz(index=3)))
    assert "textures[3]" in error_of(load, tmp_path / "a.gltf")


def test_a_material_slot_as_a_choice(tmp_path):
    (tmp_path / "a.png").write_bytes(png(srgb(light())))
    slots = {"emissiveTexture": {"index": 0, "texCoord": 1}, "emissiveFactor": [0.5, 0.5, 0.5]}
    path = scene(tmp_path, slots, images=[{"uri": "a.png"}])
    assert "or read that of a material slot: --slot emissive" in error_of(load, path)
    assert_lit(load(path, slot="emissive"), 0.5 * light(), atol=0.02)
    assert "occlusion: no mesh of the scene has such" in error_of(load, path, slot="occlusion")
    assert "slot: expected one of occlusion, emissive, got 'base'" in error_of(load, path, slot="base")
    assert "slot: only allowed without lightmaps" in error_of(load, path, tmp_path / EXR, slot="emissive")
    linear = load(path, slot="emissive", encoding="linear")
    assert any("read as linear" in line for line in linear.warnings)


def two_materials(folder, first, second, uvs=(OTHER, UV)):
    """A box whose halves have a material each, in one mesh."""
    path = scene(folder, first, sets=uvs, textures=[{"source": 0}, {"source": 0, "sampler": 0}], samplers=[{}])
    with changed(path) as content:
        (whole,) = content["meshes"][0]["primitives"]
        index = content["accessors"][whole["indices"]]
        half = {**index, "count": index["count"] // 2}
        size = len(content["accessors"])
        content["accessors"] += [half, {**half, "byteOffset": 2 * index["count"]}]
        content["materials"].append(second)
        content["meshes"][0]["primitives"] = [{**whole, "indices": size + i, "material": i} for i in range(2)]
    return path


def test_one_image_in_two_textures(tmp_path):
    assert_lit(load(two_materials(tmp_path, moz(), moz(index=1))))
    other = moz(index=1, intensity=2.0)
    assert "expected one lightmap for all of its materials" in error_of(load, two_materials(tmp_path, moz(), other))


def moved(uv, scale, offset):
    """UVs that a transform brings back, and the transform."""
    return (uv - offset) / scale, {"KHR_texture_transform": {"scale": list(scale), "offset": list(offset)}}


def test_transforms_that_differ_between_materials_become_a_uv_set(tmp_path):
    """One turns, one scales, and only one of three primitives' materials is lit by the other set."""
    stored, transform = moved(UV, (2.0, 3.0), (0.1, 0.2))
    turn = {"KHR_texture_transform": {"rotation": np.pi / 2, "offset": [0.0, 1.0], "texCoord": 0}}
    turned = np.stack([1.0 - UV[:, 1], UV[:, 0]], axis=1)  # (v', 1 - u') = UV
    path = two_materials(tmp_path, moz(extensions=transform), moz(index=1, extensions=turn), (turned, stored))
    found = load(path)
    assert found.uv_set == 2 and [each.scale_offset for each in found.objects] == [(1, 1, 0, 0)]
    assert_lit(found)
    again = load(path, uv_set=2)  # as evaluation reads it, by the UV set of the model
    assert again.source == found.source
    kept = store(found)
    uvs = [each.uv[2] for each in parse_gltf("kept", kept.glb)[1]]
    np.testing.assert_allclose(np.concatenate(uvs), found.sheets[0].uv, atol=1e-6)


@pytest.mark.parametrize("kind", ["quantised", "float", "tiling", "unlit"])
def test_a_transform_of_the_slot_that_reads_the_uvs(tmp_path, kind):
    stored, transform = moved(UV, (16.0, 8.0), (0.01, 0.02))
    slot = {"index": 0, "texCoord": 1, "extensions": transform}
    base = {"index": 1, "texCoord": 1, "extensions": {"KHR_texture_transform": {"scale": [7.0, 7.0]}}}
    material = {"emissiveTexture": slot, "pbrMetallicRoughness": {"baseColorTexture": base}}
    if kind == "tiling":  # the transform of a colour is none of the lightmap
        stored, material = UV, {"pbrMetallicRoughness": {"baseColorTexture": base}}
    elif kind == "unlit":  # quantised UVs need that of whatever reads them
        material = {"pbrMetallicRoughness": {"baseColorTexture": slot}}
    maker = GltfMaker()
    write_exr(tmp_path / "bake.exr", light())
    whole = kind in ("quantised", "unlit")
    codes = np.round(stored * 65535).astype(np.uint16) if whole else np.float32(stored)
    attributes = {
        "POSITION": maker.add(np.float32(POSITION)),
        "TEXCOORD_0": maker.add(np.float32(OTHER)),
        "TEXCOORD_1": maker.add(codes, **({"normalized": True} if whole else {})),
    }
    primitive = {"attributes": attributes, "indices": maker.add(np.uint32(TRIANGLE).reshape(-1)), "material": 0}
    maker.content |= {
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "materials": [material],
        "textures": [{"source": 0}, {"source": 1}],
        "images": [{"uri": "bake.png"}, {"uri": "tile.png"}],
    }
    found = load(maker.save(tmp_path / "a.glb"), tmp_path / "bake.exr")
    assert_lit(found)
    assert any("TEXCOORD_1 is moved by KHR_texture_transform" in line for line in found.warnings) == (kind != "tiling")
    np.testing.assert_allclose(np.sort(read_geometry(tmp_path / "a.glb").uv, axis=0), np.sort(UV, axis=0), atol=1e-4)
    lists = listed(tmp_path, "bake.exr", {"node": "0", "sheet": 0, "scale_offset": [0.5, 1, 0.5, 0]})
    (sheet,) = load(tmp_path / "a.glb", lists).sheets
    np.testing.assert_allclose(np.sort(sheet.uv, axis=0), np.sort(UV * [0.5, 1] + [0.5, 0], axis=0), atol=1e-4)


def test_materials_with_a_range_each(tmp_path):
    """The UVs of each material have their own range, as a quantiser writes them; they become one new set."""
    halves = np.arange(len(UV))[:, None] < 12
    first, transform = moved(UV, (2.0, 3.0), (0.01, 0.02))
    second, other = moved(UV, (4.0, 1.0), (-0.1, 0.01))
    slots = [{"occlusionTexture": {"index": 0, "texCoord": 1, "extensions": each}} for each in (transform, other)]
    path = two_materials(tmp_path, *slots, (OTHER, np.where(halves, first, second)))
    found = load(path, tmp_path / EXR)
    assert found.uv_set == 2
    assert_lit(found)
    assert load(path, tmp_path / EXR, uv_set=2).source == found.source


@pytest.mark.parametrize("dilated", [False, True])
def test_uvs_that_the_light_does_not_fit(tmp_path, dilated):
    """Another UV set fits better, or the same UVs at another scale; a right set raises no doubt."""
    write_exr(tmp_path / "b.exr", light(dilated=dilated))

    def doubts(*sets):
        path = scene(tmp_path, {}, sets=sets)
        return [line for line in load(path, tmp_path / "b.exr").warnings if "smoother" in line or "belong" in line]

    assert doubts(OTHER, UV) == [] and doubts(UV) == []
    assert "the light is smoother in the charts of TEXCOORD_0 (--uv-set 0)" in doubts(UV, OTHER)[0]
    assert "of its UVs scaled by 1.33 and 1.33 than in those of TEXCOORD_0" in doubts(0.75 * UV)[0]
    assert "its UVs, about scaled by 1." in doubts(UV * [0.6, 1.0] + [0.35, 0.0])[0]
    low = UV * [1, 0.6]
    write_exr(tmp_path / "b.exr", light(low, dilated, 2 / 0.6))
    assert "TEXCOORD_0 (--uv-set 0) with the lightmap upside down (--flip)" in doubts([0, 1] + low * [1, -1], OTHER)[0]


@pytest.mark.parametrize("corner", [0, 4])
def test_texels_that_a_data_window_leaves_out_say_nothing_about_uvs(tmp_path, corner):
    whole, low, high = light(dilated=True), corner, SIDE - (corner or SIDE // 2)
    part = {name: np.ascontiguousarray(whole[corner : SIDE - corner, low:high, i]) for i, name in enumerate("RGB")}
    window = (low, corner), (high - 1, SIDE - corner - 1)
    header = {"displayWindow": ((0, 0), (SIDE - 1, SIDE - 1)), "dataWindow": window}
    OpenEXR.File(header, part).write(str(tmp_path / "b.exr"))
    warnings = load(scene(tmp_path, {}, sets=[UV]), tmp_path / "b.exr").warnings
    assert any("texels outside it are 0" in line for line in warnings)
    assert not [line for line in warnings if "smoother" in line or "belong" in line]


def test_rectangles_counted_from_the_other_side(tmp_path):
    path = scene(tmp_path, {}, sets=[UV])
    write_exr(tmp_path / "b.exr", np.concatenate([light(), 0 * light()]))
    lists = listed(tmp_path, "b.exr", {"node": "crate", "sheet": 0, "scale_offset": [1, 0.5, 0, 0.5]})
    assert "rectangles that are counted from the bottom (convention unity)" in load(path, lists).warnings[0]


def test_charts_outside_the_square_are_refused(tmp_path):
    def told(uv, *others):
        return error_of(load, scene(tmp_path, {}, sets=[*others, uv]), tmp_path / EXR)

    assert "are they in texels?" in told(UV * SIDE + 1)
    assert "whole numbers of KHR_mesh_quantization need the KHR_texture_transform" in told(np.round(UV * 4095))
    assert "all UVs lie outside [0, 1] in TEXCOORD_0" in told(UV - [1, 0])
    assert "those of TEXCOORD_0 (--uv-set 0) lie within it" in told(UV + [0, 2], UV)
    shifted = UV + np.where(np.arange(len(UV)) < 4, 1.0, 0.0)[:, None] * [1, 0]
    assert "1 of 6 charts lie wholly outside [0, 1]" in told(shifted)
    scene(tmp_path, {}, sets=[UV + [0.001, 0]])
    assert load(tmp_path / "a.gltf", tmp_path / EXR).sheets


def test_udim_tiles(tmp_path):
    """Tiles count u to the right and v up; a mesh in two tiles becomes two sheets."""
    (tmp_path / "bakes").mkdir()
    corner = np.arange(len(UV))[:, None] // 12
    for tile, step in ((1001, 0), (1011, 1)):
        write_exr(tmp_path / f"bakes/wall.{tile}.exr", light() * (0.25 + 0.5 * step))
    path = scene(tmp_path, {}, sets=[OTHER, UV - corner * [0, 1]])
    found = load(path, tmp_path / "bakes")
    assert [len(sheet.triangle) for sheet in found.sheets] == [6, 6] and found.uv_set == 1
    assert [each.label for each in found.objects] == ["crate.1001", "crate.1011"]
    for sheet, factor, half in zip(found.sheets, (0.25, 0.75), (UV[:12], UV[12:]), strict=True):
        np.testing.assert_allclose(sheet.lightmap[sheet.mask], factor * light()[sheet.mask], atol=2e-3)
        np.testing.assert_allclose(sheet.uv.min(0), half.min(0), atol=1e-5)
    assert load(path, tmp_path / "bakes", uv_set=1).source == found.source
    lost = scene(tmp_path, {}, sets=[OTHER, UV + corner * [2, 0]])
    assert "expected UDIM tiles 1001, 1011" in error_of(load, lost, tmp_path / "bakes")
    assert "Tiles need a folder of lightmaps NAME.1001.exr" in error_of(load, path, tmp_path / "bakes/wall.1001.exr")


def test_bakes_named_after_their_mesh(tmp_path):
    """The names decide where the light can't, for nodes that share a mesh too."""
    names = ("Floor", POSITION, TRIANGLE, [UV]), ("Big Wall", POSITION, TRIANGLE, [UV])
    things = [Thing(*names[0]), Thing("Floor.001", like=0), Thing(*names[1])]
    path = write_scene(tmp_path / "room.gltf", things)
    folder = tmp_path / "Lightmaps"
    folder.mkdir()
    for factor, name in enumerate(("Floor_baked", "Floor_001_baked", "big-wall_baked")):
        write_exr(folder / f"{name}.exr", light() * 0.25 * (1 + factor))
    found = load(path, folder)
    assert sorted((found.sheets[each.sheet].name, each.label) for each in found.objects) == [
        ("Floor_001_baked.exr", "Floor.001"),
        ("Floor_baked.exr", "Floor"),
        ("big-wall_baked.exr", "Big Wall"),
    ]
    assert "each lightmap belongs to the mesh of its name" in found.warnings[0]
    (folder / "big-wall_baked.exr").rename(folder / "other.exr")
    text = error_of(load, path, folder)
    assert "--node" not in text and "in the lightmap's file name, or a .json list" in text
    half = UV * [0.5, 1]
    things = [Thing(name, POSITION, TRIANGLE, [half + [x, 0]]) for name, x in (("Floor", 0), ("Wall", 0.5))]
    text = error_of(load, write_scene(path, things), folder)
    assert "are both lightmaps of Floor" in text


def test_bakes_named_like_their_mesh_with_a_suffix(tmp_path):
    """The longest name wins: a wall's bake is not that of the big wall, nor that of a copy."""
    labels = ("Wall", "Wall_Big", "Wall.001", "Wall2")
    path = write_scene(tmp_path / "room.gltf", [Thing(label, POSITION, TRIANGLE, [UV]) for label in labels])
    (tmp_path / "b").mkdir()
    for label in labels:
        write_exr(tmp_path / f"b/LM_{label}_denoised.exr", light())
    found = load(path, tmp_path / "b")
    assert {f"LM_{each.label}_denoised.exr": found.sheets[each.sheet].name for each in found.objects} == {
        name: name for name in (f"LM_{label}_denoised.exr" for label in labels)
    }


def test_lightmaps_of_material_variants_are_not_read_in_silence(tmp_path):
    path = scene(tmp_path, moz(), images=({"uri": EXR}, {"uri": "night.exr"}), textures=({"source": 0}, {"source": 1}))
    with changed(path) as content:
        content["materials"].append({"extensions": {"MOZ_lightmap": {"index": 1}}})
        variants = {"mappings": [{"material": 1, "variants": [0]}]}
        content["meshes"][0]["primitives"][0]["extensions"] = {"KHR_materials_variants": variants}
    found = load(path)
    assert_lit(found)
    assert any("the lightmaps of the default materials are read alone" in line for line in found.warnings)


@pytest.mark.parametrize(("angle", "scale"), [(0.5, (1.0, 1.0)), (np.pi / 2, (-1.0, 2.0)), (np.pi, (1.0, 1.0))])
def test_a_turned_and_mirrored_transform(tmp_path, angle, scale):
    cosine, sine, offset = np.cos(angle), np.sin(angle), np.array([0.3, 0.1])
    stored = (UV - offset) @ np.linalg.inv(np.array([[cosine, sine], [-sine, cosine]]) * scale).T
    transform = {"rotation": angle, "offset": offset.tolist(), "scale": list(scale)}
    for slot in ({"occlusionTexture": {"index": 0, "texCoord": 1}}, moz(texCoord=1)):
        info = slot.get("occlusionTexture") or slot["extensions"]["MOZ_lightmap"]
        info["extensions"] = {"KHR_texture_transform": transform}
        path = scene(tmp_path, slot, sets=(OTHER, stored))
        assert_lit(load(path, tmp_path / EXR if "occlusionTexture" in slot else None))


@pytest.mark.parametrize("kind", ["uint8", "int16"])
def test_quantised_geometry_under_a_mirroring_node(tmp_path, kind):
    most = np.iinfo(kind).max
    write_exr(tmp_path / EXR, light())
    maker = GltfMaker()
    attributes = {
        "POSITION": maker.add(np.round((2 * POSITION - 1) * 127).astype(np.int8), normalized=True),
        "TEXCOORD_0": maker.add(np.round(UV * most).astype(kind), normalized=True),
    }
    primitive = {"attributes": attributes, "indices": maker.add(np.uint32(TRIANGLE).reshape(-1))}
    nodes = [{"mesh": 0, "scale": [-1, 1, 1]}, {"children": [0], "scale": [1, 2, 1]}]
    maker.content |= {"meshes": [{"primitives": [primitive]}], "nodes": nodes, "scenes": [{"nodes": [1]}]}
    (sheet,) = load(maker.save(tmp_path / "a.glb"), tmp_path / EXR).sheets
    corner = sheet.position[sheet.triangle]
    volume = np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6
    assert volume == pytest.approx(16, rel=1e-5)  # fronts outside
    np.testing.assert_allclose(np.sort(sheet.uv, axis=0), np.sort(UV, axis=0), atol=1 / most)


@pytest.mark.parametrize("number", [-1, 65534, 65535])
def test_renderers_without_a_lightmap(tmp_path, number):
    things = [Thing("crate", POSITION, TRIANGLE, [UV]), Thing("lamp", like=0, translation=(3, 0, 0))]
    path = write_scene(tmp_path / "a.gltf", things)
    write_exr(tmp_path / EXR, light())
    for convention, key in (("unity", "lightmapIndex"), ("godot", "slice_index")):
        objects = {"node": "crate", key: 0}, {"node": "lamp", key: number}
        found = load(path, listed(tmp_path, EXR, *objects, convention=convention))
        assert [each.label for each in found.objects] == ["crate"] and len(found.blocker) == 12
        assert "1 objects have no lightmap" in found.warnings[0]


def test_a_mirrored_node_keeps_its_front(tmp_path):
    """Also in copies: their winding in the file is that of the input."""
    inward = box((0, 0, 0), (4, 3, 4), inward=True)
    path = write_scene(tmp_path / "a.gltf", [Thing("room", *inward[:2], [UV])])
    write_exr(tmp_path / EXR, light())
    plain = load(path, tmp_path / EXR)
    with changed(path) as content:
        content["nodes"][0]["scale"] = [-1, 1, 1]
    mirrored = load(path, tmp_path / EXR)
    assert volume(mirrored) == pytest.approx(volume(plain)) and volume(plain) < 0
    sheet = mirrored.sheets[0]
    glb, number = with_uvs(mirrored, sheet.uv[sheet.triangle])
    (copy,) = parse_gltf("copy", glb)[1]
    np.testing.assert_array_equal(copy.uv[number][copy.triangle], np.float32(sheet.uv[sheet.triangle]))
    np.testing.assert_array_equal(copy.position[copy.triangle], read_gltf(path)[1][0].position[sheet.triangle])


def volume(found):
    (sheet,) = found.sheets
    a, b, c = sheet.position[sheet.triangle].transpose(1, 0, 2)
    return float(np.einsum("fk,fk->", a - sheet.position.mean(0), np.cross(b - a, c - a))) / 6


def test_lightmaps_are_bounded_together(tmp_path, monkeypatch):
    """Many materials that read one image with different factors decode it as often."""
    monkeypatch.setattr("wlm.atlas.data.FRAMES", 3 * 12 * SIDE * SIDE)
    monkeypatch.setattr("wlm.atlas.data.PICTURE_GROWTH", 1)
    material = [moz(texCoord=0, intensity=1.0 + i) for i in range(4)]
    things = [Thing(f"b{i}", POSITION + i, TRIANGLE, [UV], material=each) for i, each in enumerate(material)]
    write_exr(tmp_path / EXR, light())
    path = write_scene(tmp_path / "a.gltf", things, {"images": [{"uri": EXR}], "textures": [{"source": 0}]})
    assert "its lightmaps: expected at most" in error_of(load, path)
    assert len(load(path, trust=True).sheets) == 4


def test_what_inspect_says_of_them(tmp_path):
    """The command that it prints reads them as they are; a picture beside the mesh is no second lightmap."""
    path = writers_scene(tmp_path, "MX")
    (found,) = inspect(tmp_path)
    assert found.path == path and found.command == f"wlm compress {path} -o OUT.wlm"
    assert "with 1 lightmap of MX_lightmap" in found.what
    (found,) = inspect(scene(tmp_path, moz()))
    assert "TEXCOORD_1 is read (see --uv-set)" in found.problems[0]
    (found,) = inspect(scene(tmp_path, {"occlusionTexture": {"index": 0}}))
    assert "or with that of a material slot (--slot occlusion)" in found.what and not found.command
    (found,) = inspect(scene(tmp_path, moz(index=7)))
    assert not found.command and "textures[7]" in found.problems[0]
