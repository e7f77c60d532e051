"""Smoke for engines: few files, shaders that show what `shade` gives, scripts that run through or parse."""

import dataclasses
import json
import os
import re

import numpy as np
import pytest
from builders.checks import error_of
from builders.engine_scripts import Script, assert_csharp_parses, assert_gdscript_parses, node_gives, pixels_of
from builders.shader_runs import compiled, run_glsl, run_hlsl
from builders.smoke_books import IRRADIANCE, SKY, TOWARD, random_book, random_frames, shown
from PIL import Image
from test_folders import as_glsl

from wlm.export import ENGINES, export
from wlm.export.engines import kit
from wlm.inspection import inspect
from wlm.smoke.bundle import bundle

TEXTS = {".md", ".js", ".glsl", ".gd", ".gdshader", ".hlsl", ".shader", ".cs", ".py", ".import"}
STEP = 1.6 / 255
"""Half a step of 8 bits in each of a light's parts, and filters' places of 8 bits between texels."""


def export_smoke(book, folder, engine, name="smoke"):
    return export(bundle(book, name=name), folder, engine)


@pytest.fixture(scope="module")
def frames():
    return random_frames()


def pages_of(folder):
    """The pictures as an engine has them, by the shader's names."""
    found = {}
    for path in folder.glob("*.png"):
        with Image.open(path) as image:
            found[f"wlm_smoke_{path.stem}_map"] = np.asarray(image.convert("RGBA"))
    return found


@pytest.mark.parametrize("engine", ENGINES)
def test_a_folder_has_what_its_index_names(engine, frames, tmp_path):
    book = random_book(frames)
    paths = export_smoke(book, tmp_path / "out", engine, name="the jet")
    assert {path.name for path in paths} == set(os.listdir(tmp_path / "out")) and len(paths) <= 12
    assert paths[-1].name == "bundle.json"
    info = json.loads(paths[-1].read_text())
    assert set(info["textures"]) == set(book.pages) and info["shader"] in {path.name for path in paths}
    assert (info["frames"], info["rate"], info["levels"], info["clipped"]) == (5, 10.0, 2, 0)
    assert info["frame_size"] == [16, 12] and info["extent"] == pytest.approx([2.0 * 16 / 12, 2.0])
    assert info["channels"]["second"][-1] == "emission"
    texts = {path.name: path.read_text() for path in paths if path.suffix in TEXTS}
    assert not re.search(r"@[A-Z]+@", "".join(texts.values()))
    assert 5 <= len(texts["README.md"].splitlines()) <= 20
    assert "5 frames at 10" in texts["README.md"]
    for name, page in pages_of(tmp_path / "out").items():
        np.testing.assert_allclose(page[..., :3] / 255.0, book.pages[name[10:-4]][..., :3], atol=0.51 / 255)
    (finding,) = inspect(tmp_path / "out")
    assert "wlm export wrote" in finding.what


def test_what_cannot_be_exported(frames, tmp_path, monkeypatch):
    book, out = random_book(frames), tmp_path / "deep" / "out"

    bare = [dataclasses.replace(frame, transparency=None, emission=None) for frame in frames]
    assert "jet: the flip book has no opacity" in error_of(export_smoke, random_book(bare), out, "three", name="jet")
    o3de = dataclasses.replace(book, layout="o3de")
    assert "layout: expected unity for unreal" in error_of(export_smoke, o3de, out, "unreal")
    broken = dataclasses.replace(book, second=book.second * np.float32("nan"))
    assert "expected finite light" in error_of(export_smoke, broken, out, "three")
    monkeypatch.setitem(kit._MOST_SIDE, "unreal", 40)
    line = error_of(export_smoke, book, out, "unreal", name="jet")
    assert re.search(r"jet: cannot export for unreal: first.png: expected at most 40 texels along a side", line)
    assert not (tmp_path / "deep").exists()


def test_cold_smoke_of_one_frame(tmp_path):
    """Without emission, which is black; any time shows the one frame."""
    frames = random_frames(1, hot=False)
    book = random_book(frames)
    export_smoke(book, tmp_path, None)
    text = (tmp_path / "smoke.glsl").read_text()
    given = f"0.7, 1.0, vec3{TOWARD}, vec3{IRRADIANCE}, vec3{SKY}"
    main = f"light = wlm_smoke_pixel((vec2(pixel) + 0.5) / vec2(16.0, 12.0), {given});"
    stored = {f"wlm_smoke_{path.stem}_map": read_texels(path) for path in tmp_path.glob("*.dds")}
    found = run_glsl(text, main, (12, 16), stored)
    np.testing.assert_allclose(found, shown(frames, book, 0.0), atol=STEP)


def read_texels(path):
    """The texels of an uncompressed DDS of 4 bytes a texel."""
    data = path.read_bytes()
    height, width = (int.from_bytes(data[at : at + 4], "little") for at in (12, 16))
    return np.frombuffer(data, np.uint8, offset=148).reshape(height, width, 4)


TIMES = (0.0, 1.5, 3.25, 4.9)


def test_godots_billboard_shows_the_smoke(frames, tmp_path):
    """Run as GLSL: what fragment() and, of one light, light() write, put together as Godot does."""
    book = random_book(frames)
    export_smoke(book, tmp_path, "godot")
    text = as_glsl((tmp_path / "smoke.gdshader").read_text())
    main = f"""UV = (vec2(pixel) + 0.5) / vec2(16.0, 12.0); fragment();
    LIGHT = vec3{TOWARD}; LIGHT_COLOR = vec3{IRRADIANCE} / 0.5; ATTENUATION = 0.5; DIFFUSE_LIGHT = vec3(0.0);
    light_of(); light = vec4(DIFFUSE_LIGHT * ALBEDO + EMISSION, ALPHA);"""
    for time in TIMES:
        uniforms = {"wlm_frame": time, "wlm_sky": (*SKY, 1.0)}
        found = run_glsl(text, main, (12, 16), pages_of(tmp_path), uniforms=uniforms)
        np.testing.assert_allclose(found, shown(frames, book, time), atol=STEP)


def test_godots_billboard_faces_the_viewer(frames, tmp_path):
    export_smoke(random_book(frames), tmp_path, "godot")
    text = as_glsl((tmp_path / "smoke.gdshader").read_text())
    # A node scaled by 2 and 3, turned about z by a right angle, at (5, 6, 7); the viewer 10 before the origin.
    main = """MODEL_MATRIX = mat4(0., 2., 0., 0., -3., 0., 0., 0., 0., 0., 1., 0., 5., 6., 7., 1.);
    VIEW_MATRIX = mat4(1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., -10., 1.);
    vertex(); light = MODELVIEW_MATRIX * vec4(0.5, 0.5, 0.0, 1.0);"""
    np.testing.assert_allclose(run_glsl(text, main, (1, 1), {})[0, 0], [6.0, 7.5, -3.0, 1.0], atol=1e-6)


def test_godots_script_and_imports_parse(frames, tmp_path):
    for padding, mips in ((2, "true"), (0, "false")):
        export_smoke(random_book(frames, padding=padding), tmp_path, "godot")
        settings = (tmp_path / "first.png.import").read_text()
        assert f"mipmaps/generate={mips}\n" in settings and "process/fix_alpha_border=false" in settings
        shader = (tmp_path / "smoke.gdshader").read_text()
        assert ("filter_linear_mipmap" in shader) == (padding == 2)
    assert_gdscript_parses(tmp_path / "wlm_smoke.gd")


UNITY = """
#define unity_ObjectToWorld WlmModel()
#define UNITY_MATRIX_V WlmView()
#define UNITY_MATRIX_P float4x4(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)
#define ddx(a) float2(0, 0)
#define ddy(a) float2(0, 0)
float4x4 WlmModel() { return float4x4(0, -3, 0, 5, 2, 0, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1); }
// The viewer turned by a right angle about y, so that its x is the world's -z.
float4x4 WlmView() { return float4x4(0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, -10, 0, 0, 0, 1); }
"""


def unity_pass(folder):
    shader = (folder / "WlmSmoke.shader").read_text()
    text = re.search(r"HLSLPROGRAM(.*?)ENDHLSL", shader, re.DOTALL)[1]
    text = re.sub(r"^ *(#pragma|#include \"UnityCG).*$", "", text, flags=re.MULTILINE)
    return text.replace('#include "WlmSmoke.hlsl"', "\n" + (folder / "WlmSmoke.hlsl").read_text())


def test_unitys_billboard_shows_the_smoke(frames, tmp_path):
    """One light in two halves, a black one, and one that is left out by its irradiance."""
    book = random_book(frames)
    export_smoke(book, tmp_path, "unity")
    text = unity_pass(tmp_path)
    # From the view's axes to the world's.
    toward = f"float4({TOWARD[2]}, {TOWARD[1]}, {-TOWARD[0]}, 0)"
    half = f"float4({', '.join(str(0.5 * each) for each in IRRADIANCE)}, 0)"
    given = f"static const float4 _WlmToward[4] = {{{toward}, {toward}, float4(0, 1, 0, 0), float4(0, 0, 0, 0)}};\n"
    given += f"static const float4 _WlmIrradiance[4] = {{{half}, {half}, float4(0, 0, 0, 0), float4(0, 0, 0, 0)}};\n"
    given += f"static const float4 _WlmSky = float4({', '.join(map(str, SKY))}, 1);\n"
    text = re.sub(r"^ *float4? _Wlm.*;$", "", text, flags=re.MULTILINE)
    uv = "float2((pixel.x + 0.5) / 16.0, 1.0 - (pixel.y + 0.5) / 12.0)"
    for time in TIMES[1:3]:
        head = f"{UNITY}{given}static const float _WlmFrame = {time};\n"
        shown_by = f"frag(vert(float4(0, 0, 0, 1), {uv}))"
        found = run_hlsl(head + text, shown_by, (12, 16), pages_of(tmp_path), tmp_path)
        np.testing.assert_allclose(found, shown(frames, book, time), atol=STEP)
    # Textures that nothing reads can't be bound.
    place = f"pixel.x == 0 ? vert(float4(0.5, 0.5, 0, 1), float2(0, 0)).position : {shown_by}"
    found = run_hlsl(head + text, place, (1, 2), pages_of(tmp_path), tmp_path)
    np.testing.assert_allclose(found[0, 0], [-7.0 + 1.0, 6.0 + 1.5, 5.0 - 10.0, 1.0], atol=1e-5)


def test_unitys_stages_compile_and_its_component_parses(frames, tmp_path):
    export_smoke(random_book(frames), tmp_path, "unity")
    named = "cbuffer unity { float4x4 unity_ObjectToWorld, UNITY_MATRIX_V, UNITY_MATRIX_P; };\n"
    for stage in ("vert", "frag"):
        compiled(named + unity_pass(tmp_path), tmp_path, "-D", "-S", stage, "-e", stage, "--auto-map-bindings")
    assert_csharp_parses(tmp_path / "WlmSmoke.cs")


def test_unreals_node_shows_the_smoke(frames, tmp_path, monkeypatch):
    """Also after the last frame, when it begins again."""
    book = random_book(frames)
    export_smoke(book, tmp_path, "unreal", name="a b")
    script = Script(tmp_path / "wlm_smoke.py", monkeypatch)
    assert 'PLACE = "/Game/Wlm/a_b"' in (tmp_path / "wlm_smoke.py").read_text()
    assert set(script.settings) == {path.name for path in tmp_path.glob("*.png")}
    levels = script.unreal.TextureMipGenSettings
    assert {each["mip_gen_settings"] for each in script.settings.values()} == {levels.TMGS_SIMPLE_AVERAGE}
    assert not any(each["srgb"] for each in script.settings.values())
    joined = [call.args[2] for call in script.unreal.MaterialEditingLibrary.connect_material_property.call_args_list]
    assert joined == [script.unreal.MaterialProperty.MP_EMISSIVE_COLOR, script.unreal.MaterialProperty.MP_OPACITY]
    ((code, inputs),) = script.customs()
    bound = {f"wlm_smoke_{path.stem}_map": pixels_of(str(path)) for path in tmp_path.glob("*.png")}
    place = "(float2(pixel) + 0.5) / float2(16.0, 12.0)"
    numbers = {"Toward": f"float3 Toward = float3({TOWARD[0]}, {TOWARD[1]}, {-TOWARD[2]})"}
    for name, values in (("Irradiance", IRRADIANCE), ("Sky", SKY)):
        numbers[name] = f"float3 {name} = float3({', '.join(map(str, values))})"
    for time in (1.5, 8.25):
        numbers["Frame"] = f"float Frame = {time}"
        found = node_gives(code, inputs, (12, 16), place, bound, tmp_path, numbers, channels=4)
        np.testing.assert_allclose(found, shown(frames, book, time % 5), atol=STEP)
