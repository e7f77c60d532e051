"""Output for engines: textures that read back exactly, a mesh with both UVs, a shader that gives the same light."""

import json
import os
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from builders.atlas_meshes import charts, sheet
from builders.atlas_models import KINDS, MIXED, random_model
from builders.textures import open_dds, open_ktx2

import wlm
from wlm.atlas import colour, exporter
from wlm.atlas.data import from_arrays
from wlm.atlas.decode import Decoder
from wlm.atlas.shader import atlas_glsl
from wlm.errors import WlmError
from wlm.formats.exr import read_exr
from wlm.formats.gltf import read_gltf
from wlm.formats.light import read_light
from wlm.formats.shared_exponent import unpack_rgb9e5

ALWAYS = {"atlas.wlm", "mesh.glb", "colour.exr", "colour.ktx2", "atlas.glsl", "report.json"}
LUT = {"lut.exr", "lut.ktx2", "lut.dds"}


def written(folder, kind, stored="half", mesh=None, **facts):
    mesh = sheet() if mesh is None else mesh
    model = random_model(mesh, kind, stored)
    return model, mesh, exporter.export(model, folder, mesh, facts)


STORED = [(kind, stored) for kind in KINDS for stored in ("half", "rgb9e5", "bc6h", "astc")] + [(MIXED, "mixed")]


@pytest.mark.parametrize(("kind", "stored"), STORED)
def test_what_is_written(kind, stored, tmp_path):
    model, mesh, paths = written(tmp_path / "out", kind, stored, seed=3)
    expected = ALWAYS | (set() if model.method == "plain" else LUT) | (set() if stored == "astc" else {"colour.dds"})
    expected |= {"blocks.exr", "blocks.ktx2", "blocks.dds"} if stored == "mixed" else set()
    assert {path.name for path in paths} == expected == set(os.listdir(tmp_path / "out"))
    assert paths[-1].name == "report.json" and os.listdir(tmp_path) == ["out"]
    report = json.loads(paths[-1].read_text())
    assert report["bytes"] == {path.name: path.stat().st_size for path in paths[:-1]}
    assert (report["method"], report["source"], report["size"]) == (model.method, mesh.source, [48, 40])
    assert report["cr"] == model.compression_ratio and report["seed"] == 3
    assert report["cr_disk"] == 1 - report["bytes"]["atlas.wlm"] * 8 / (40 * 48 * 48)
    assert (report["seconds"], report["found"]) == ({"fit": 1.5}, {"tiles": 4})
    np.testing.assert_array_equal(wlm.load(tmp_path / "out" / "atlas.wlm").texels, model.texels)


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_the_table_is_exact_in_every_format(kind, tmp_path):
    model, _, _ = written(tmp_path, kind)
    height, width = model.lut.shape[:2]
    ktx2, dds = open_ktx2(tmp_path / "lut.ktx2"), open_dds(tmp_path / "lut.dds")
    exr, _ = read_exr(tmp_path / "lut.exr")
    assert (ktx2.fmt, dds.fmt) == (("R16G16_UINT",) * 2 if kind == "tiles" else ("R32G32_SFLOAT", "R16G16_UNORM"))
    assert (ktx2.width, ktx2.height, dds.width, dds.height) == (width, height) * 2
    np.testing.assert_array_equal(np.frombuffer(dds.data, "<u2").reshape(model.lut.shape), model.lut)
    stored = np.frombuffer(ktx2.data, "<u2" if kind == "tiles" else "<f4").reshape(model.lut.shape).astype(np.float64)
    np.testing.assert_array_equal(np.rint(stored * (1 if kind == "tiles" else 65535)), model.lut)
    scale = 1 if kind == "tiles" else 65535
    np.testing.assert_array_equal(np.rint(exr[..., :2].astype(np.float64) * scale), model.lut)
    assert not exr[..., 2].any()


def test_both_textures_are_exact_in_every_format(tmp_path):
    model, _, _ = written(tmp_path, MIXED)
    for name, texels in (("colour", model.texels), ("blocks", model.block_texels)):
        assert texels.any()
        for suffix in ("exr", "ktx2", "dds"):
            light, _ = read_light(tmp_path / f"{name}.{suffix}")
            np.testing.assert_array_equal(light[..., :3], texels.astype(np.float32))


@pytest.mark.parametrize("stored", ["half", "rgb9e5", "bc6h", "astc"])
def test_the_colours_are_exact_in_every_format(stored, tmp_path):
    model, _, _ = written(tmp_path, "plain", stored)
    np.testing.assert_array_equal(read_exr(tmp_path / "colour.exr")[0], model.texels.astype(np.float32))
    ktx2 = open_ktx2(tmp_path / "colour.ktx2")
    dds = None if stored == "astc" else open_dds(tmp_path / "colour.dds")
    assert (ktx2.width, ktx2.height) == (23, 18)
    if stored == "half":
        assert (ktx2.fmt, dds.fmt) == ("R16G16B16A16_SFLOAT", "R16G16B16A16_FLOAT") and ktx2.data == dds.data
        whole = np.frombuffer(dds.data, "<f2").reshape(18, 23, 4)
        np.testing.assert_array_equal(whole[..., :3], model.texels)
        assert (whole[..., 3] == 1).all()
        return
    if stored == "rgb9e5":
        assert (ktx2.fmt, dds.fmt) == ("E5B9G9R9_UFLOAT_PACK32", "R9G9B9E5_SHAREDEXP") and ktx2.data == dds.data
        words = np.frombuffer(ktx2.data, "<u4").reshape(18, 23)
        np.testing.assert_array_equal(unpack_rgb9e5(words), model.texels.astype(np.float32))
        return
    assert ktx2.fmt == {"bc6h": "BC6H_UFLOAT_BLOCK", "astc": "ASTC_4x4_SFLOAT_BLOCK"}[stored]
    blocks = np.frombuffer(ktx2.data, np.uint8).reshape(-1, 16)
    np.testing.assert_array_equal(colour.decode(blocks, 18, 23, stored), model.texels.astype(np.float32))
    assert dds is None or (dds.fmt == "BC6H_UF16" and dds.data == ktx2.data)


@pytest.mark.parametrize("kind", KINDS)
def test_the_mesh_keeps_its_uvs_and_gets_new_ones(kind, tmp_path):
    model, mesh, _ = written(tmp_path, kind)
    (primitive,) = read_gltf(tmp_path / "mesh.glb")[1]
    np.testing.assert_array_equal(primitive.position[primitive.triangle], mesh.position[mesh.triangle])
    np.testing.assert_array_equal(primitive.uv[0][primitive.triangle], mesh.uv[mesh.triangle].astype(np.float32))
    number = json.loads((tmp_path / "report.json").read_text())["new_uv_set"]
    if len(model.uv):
        assert set(primitive.uv) == {0, 1} and number == 1
        np.testing.assert_array_equal(primitive.uv[1][primitive.triangle], model.uv)
    else:
        assert set(primitive.uv) == {0} and number is None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mesh", [sheet(), charts()], ids=["sheet", "charts"])
def test_the_folder_alone_gives_the_lightmap(kind, mesh, tmp_path):
    model, _, _ = written(tmp_path, kind, mesh=mesh)
    output = exporter.read_folder(tmp_path)
    geometry = exporter.geometry(output)
    np.testing.assert_array_equal(geometry.position[geometry.triangle], mesh.position[mesh.triangle])
    np.testing.assert_array_equal(geometry.uv[geometry.triangle], mesh.uv[mesh.triangle])
    np.testing.assert_array_equal(geometry.mask, mesh.mask)
    assert geometry.source == model.source and output.model_bytes == (tmp_path / "atlas.wlm").stat().st_size
    decoded = Decoder(output.model).lightmap(geometry)
    np.testing.assert_array_equal(decoded, Decoder(model).lightmap(mesh))
    assert decoded.any()


def test_a_new_output_takes_the_place_of_an_old_one(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    written(folder, "tiles")
    (folder / "mine.txt").write_text("x")
    model, _, paths = written(folder, "plain", "astc")
    assert set(os.listdir(folder)) == ALWAYS | {"mine.txt"} == {path.name for path in paths} | {"mine.txt"}
    assert exporter.read_folder(folder).model.method == "plain"


def test_a_mask_that_triangles_do_not_imply_is_written(tmp_path):
    """Decoded without the inputs, the lightmap has the texels of the mask and no others."""
    whole = charts()
    mask = whole.mask & (np.arange(64) < 40)
    mesh = from_arrays(whole.position, whole.triangle, whole.uv, whole.lightmap, mask)
    model, _, paths = written(tmp_path, "tiles", mesh=mesh)
    assert "mask.png" in {path.name for path in paths}
    geometry = exporter.geometry(exporter.read_folder(tmp_path))
    np.testing.assert_array_equal(geometry.mask, mask)
    np.testing.assert_array_equal(Decoder(model).lightmap(geometry), Decoder(model).lightmap(mesh))
    (tmp_path / "mask.png").unlink()
    with pytest.raises(WlmError, match="mask.png: cannot read the mask .*: No such file"):
        exporter.geometry(exporter.read_folder(tmp_path))
    # An output that needs none takes an old one away.
    written(tmp_path, "tiles", mesh=whole)
    assert not (tmp_path / "mask.png").exists()


def test_another_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected the mesh that was compressed"):
        exporter.export(random_model(charts(), "tiles"), tmp_path / "new", sheet())
    assert os.listdir(tmp_path) == []


def test_a_texture_beyond_a_gpu(tmp_path):
    mesh = sheet()
    model = replace(random_model(mesh, "plain"), texels=np.zeros((1, 16385, 3), np.float16))
    with pytest.raises(WlmError, match="sheet: T_p: expected at most 16384 texels along a side, found 16385"):
        exporter.export(model, tmp_path / "out", mesh)
    assert os.listdir(tmp_path) == []


def test_a_folder_of_something_else(tmp_path):
    for place, words in ((tmp_path / "none", "expected a folder"), (tmp_path, "found no report.json of it")):
        with pytest.raises(WlmError, match=words):
            exporter.read_folder(place)
    written(tmp_path, "tiles")
    report = json.loads((tmp_path / "report.json").read_text())
    changes = (
        ({"version": 2}, "version: expected 1, found 2"),
        ({"source": "0" * 16}, "are not of one run"),
        ({"unfinished": True}, "expected all files of a run; writing them was stopped half-way, so compress again"),
    )
    for change, words in changes:
        (tmp_path / "report.json").write_text(json.dumps(report | change))
        with pytest.raises(WlmError, match=words):
            exporter.read_folder(tmp_path)
    for change, words in (
        ({"triangles": 7}, "expected 7 triangles"),
        ({"uv_set": 4}, "TEXCOORD_4, found 0"),
        ({"uv_set": 4, "triangles": 0}, "TEXCOORD_4, found 0"),
        ({"uv_set": [0]}, r"uv_set: expected a whole number, found \[0\]"),
    ):
        (tmp_path / "report.json").write_text(json.dumps(report | change))
        with pytest.raises(WlmError, match=words):
            exporter.geometry(exporter.read_folder(tmp_path))


CALLER = """
{layout}in vec2 place;
{layout}out vec4 light;
void main() {{ light = vec4(wlm_atlas(place), 1.0); }}
"""
BOUND = "#define WLM_ATLAS_COLOUR_BINDING 0\n#define WLM_ATLAS_LUT_BINDING 1\n"


@pytest.mark.skipif(shutil.which("glslangValidator") is None, reason="glslangValidator is not installed")
@pytest.mark.parametrize("exact", ["", "#define WLM_ATLAS_EXACT\n"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_shader_compiles(kind, exact, tmp_path):
    text = atlas_glsl(random_model(sheet(), kind))
    for version, options, layout, defined in (
        (330, [], "", ""),
        (450, ["-V", "-o", "shader.spv"], "layout(location = 0) ", BOUND),
    ):
        shader = f"#version {version}\n{defined}{exact}{text}{CALLER.format(layout=layout)}"
        (tmp_path / "shader.frag").write_text(shader)
        words = ["glslangValidator", *options, "shader.frag"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0 and "WARNING" not in done.stdout, done.stdout


def test_the_shader_names_the_uvs_that_it_takes():
    assert "the new UVs of mesh.glb" in atlas_glsl(random_model(sheet(), "cascade"))
    assert "the mesh's own lightmap UVs" in atlas_glsl(random_model(sheet(), "tiles"))
    assert "usampler2D" in atlas_glsl(random_model(sheet(), "tiles"))
    assert "lut" not in atlas_glsl(random_model(sheet(), "plain")).lower()
