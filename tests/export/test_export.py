"""Raw folders of a bundle: their index, files and errors."""

import dataclasses
import json
import os

import numpy as np
import pytest
from builders.checks import error_of

from wlm.bundle import RESERVED, Bundle, Texture
from wlm.export import ENGINES, LANGUAGES, export
from wlm.export.engines.kit import filled
from wlm.export.files import decode_texture
from wlm.formats.exr import read_exr
from wlm.formats.light import read_light
from wlm.formats.shared_exponent import pack_rgb9e5, unpack_rgb9e5

SHADER = """\
// Reads a colour. For GLSL 3.30, GLSL ES 3.00 and later; include it below #version.
uniform sampler2D wlm_atlas_colour;

vec3 wlm_colour(vec2 uv)
{
#ifdef WLM_ATLAS_EXACT
    return texelFetch(wlm_atlas_colour, ivec2(uv), 0).rgb;
#else
    return textureLod(wlm_atlas_colour, uv, 0.0).rgb;
#endif
}
"""


def random_bundle(**changes):
    random = np.random.default_rng(0)
    texels = random.random((3, 5, 4)).astype("<f2")
    made = Bundle(
        "atlas",
        "a name",
        SHADER,
        {"about": "A sentence.", "states": ["noon"]},
        {
            "colour": Texture.from_texels(texels, "R16G16B16A16_FLOAT"),
            "pages": Texture.from_texels(
                pack_rgb9e5(random.random((2, 4, 4, 3))).astype("<u4"), "R9G9B9E5_SHAREDEXP", layered=True
            ),
            "blocks": Texture(
                random.integers(0, 256, (2, 2, 16), np.uint8), "ASTC_4x4_SFLOAT_BLOCK", 7, 8, image=np.ones((8, 7, 3))
            ),
        },
        {"numbers": np.arange(6, dtype=">i4").reshape(2, 3)},
        {"frame": random.random((4, 6, 3)).astype(np.float32), "values": np.arange(5.0)},
        {"mesh.glb": b"glb"},
        exact="WLM_ATLAS_EXACT",
    )
    return dataclasses.replace(made, **changes)


def test_a_raw_folder_has_what_its_index_says(tmp_path):
    bundle = random_bundle()
    paths = export(bundle, tmp_path / "deep" / "out")
    folder = tmp_path / "deep" / "out"
    assert {path.name for path in paths} == set(os.listdir(folder)) and paths[-1].name == "bundle.json"
    index = json.loads(paths[-1].read_text())
    assert set(index) == RESERVED | {"about", "states"}
    assert (index["format"], index["system"], index["name"], index["engine"]) == ("wlm-bundle", "atlas", "a name", None)
    assert index["shader"] == "atlas.glsl" and (folder / "atlas.glsl").read_text() == SHADER
    assert index["textures"]["colour"] == {
        "file": "colour.dds", "format": "R16G16B16A16_FLOAT", "width": 5, "height": 3, "layers": 0, "mips": 0
    }  # fmt: skip
    assert index["textures"]["pages"]["layers"] == 2 and index["textures"]["blocks"]["file"] == "blocks.ktx2"
    np.testing.assert_array_equal(read_light(folder / "colour.dds")[0], decode_texture(bundle.textures["colour"]))
    numbers = np.fromfile(folder / index["buffers"]["numbers"]["file"], "<i4")
    np.testing.assert_array_equal(numbers.reshape(index["buffers"]["numbers"]["shape"]), bundle.buffers["numbers"])
    assert index["buffers"]["numbers"]["dtype"] == "int32"
    np.testing.assert_array_equal(read_exr(folder / "frame.exr")[0], bundle.reference["frame"])
    np.testing.assert_array_equal(np.fromfile(folder / "values.bin"), bundle.reference["values"])
    assert (folder / "mesh.glb").read_bytes() == b"glb"
    assert index["files"] == sorted(set(os.listdir(folder)) - {"bundle.json"})


def test_a_new_export_replaces_an_old_one_and_nothing_else(tmp_path):
    export(random_bundle(), tmp_path)
    (tmp_path / "mine.txt").write_text("x")
    parts = {"sheet_00": random_bundle(), "sheet_01": random_bundle(textures={})}
    paths = export(random_bundle(shader="", textures={}, parts=parts), tmp_path)
    assert {path.relative_to(tmp_path).as_posix() for path in paths} >= {"sheet_00/bundle.json", "sheet_01/atlas.glsl"}
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == {*paths, tmp_path / "mine.txt"}
    assert json.loads(paths[-1].read_text())["parts"] == ["sheet_00", "sheet_01"]
    paths = export(random_bundle(), tmp_path)
    assert set(tmp_path.iterdir()) == {*paths, tmp_path / "mine.txt"}


def test_a_shader_in_each_language_filters_or_fetches(tmp_path):
    for language in LANGUAGES:
        for exact in (False, True):
            export(random_bundle(), tmp_path, shader=language, exact=exact)
            index = json.loads((tmp_path / "bundle.json").read_text())
            text = (tmp_path / index["shader"]).read_text()
            if language.startswith("glsl"):
                assert text.endswith(SHADER) and ("#define WLM_ATLAS_EXACT" in text) == exact
            else:
                assert any(word in text for word in ("Load(", ".read(", "textureLoad(")) == exact


def test_what_cannot_be_exported(tmp_path):
    out, bundle = tmp_path / "deep" / "out", random_bundle()
    assert "engine: expected one of three" in error_of(export, bundle, out, "cry")
    assert "shader: expected one of glsl" in error_of(export, bundle, out, shader="cg")
    assert "engine three: shader and exact" in error_of(export, bundle, out, "three", exact=True)
    assert "exact has no meaning here" in error_of(export, random_bundle(exact=""), out, exact=True)
    assert "cells: has no meaning for a raw folder" in error_of(export, bundle, out, cells=3)
    assert "a number is NaN or infinite" in error_of(export, random_bundle(document={"a": float("nan")}), out)
    broken = random_bundle(buffers={"numbers": np.array([np.inf])})
    assert "numbers: cannot export: a number is NaN or infinite" in error_of(export, broken, out)
    wide = Texture(np.zeros(16385, np.uint8), "R8_UNORM", 16385, 1)
    assert "expected at most 16384 texels" in error_of(export, random_bundle(textures={"wide": wide}), out)
    unknown = random_bundle(system="other")
    for engine in ENGINES:
        assert "there is no kit for" in error_of(export, unknown, out, engine)
    assert not (tmp_path / "deep").exists()
    (tmp_path / "mine.txt").write_text("x")
    assert "expected an empty folder" in error_of(export, bundle, tmp_path)


@pytest.mark.parametrize(
    ("fmt", "kind", "channels"), [("R16G16_UINT", "<u2", 2), ("R32G32B32A32_FLOAT", "<f4", 4), ("R8_UNORM", "u1", 1)]
)
def test_textures_decode_to_their_texels(fmt, kind, channels):
    texels = np.arange(2 * 3 * 4 * channels).reshape(2, 3, 4, channels).astype(kind)
    np.testing.assert_array_equal(decode_texture(Texture.from_texels(texels, fmt, layered=True)), texels)
    np.testing.assert_array_equal(decode_texture(Texture.from_texels(texels[0], fmt)), texels[0])


def test_textures_of_shared_exponents_and_coordinates_decode_to_floats():
    words = pack_rgb9e5(np.random.default_rng(1).random((3, 4, 3))).astype("<u4")
    decoded = decode_texture(Texture.from_texels(words, "R9G9B9E5_SHAREDEXP"))
    np.testing.assert_array_equal(decoded, unpack_rgb9e5(words))
    places = decode_texture(Texture.from_texels(np.array([[[0, 65535]]], "<u2"), "R16G16_UNORM"))
    assert places.tolist() == [[[0.0, 1.0]]] and places.dtype == np.float32


def test_a_name_is_text_in_a_readme():
    text = filled("three_atlas.md", NAME="<b>a_1</b> [x](y)\n`", PLACE="")
    assert text.startswith(r"# \<b\>a_1\</b\> \[x\](y)\\x0a\` for three.js" + "\n")
