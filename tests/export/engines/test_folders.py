"""Folders for engines: few files, whose shaders and scripts compile or parse by what pip and Debian have."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from builders.atlas_meshes import charts, sheet
from builders.atlas_models import KINDS, MIXED, off_borders
from builders.atlas_models import random_model as random_atlas
from builders.checks import error_of
from builders.engine_scripts import Script, assert_csharp_parses, assert_gdscript_parses, node_gives, pixels_of
from builders.layered_sets import random_layers
from builders.light_groups import random_groups
from builders.shader_runs import compiled, run_glsl, run_hlsl
from builders.synthetic import random_model as random_lightmap

from benchmarks.atlas_exact import decode64
from wlm.export import ENGINES, export
from wlm.export.engines import kit
from wlm.export.engines.kit import asset_name
from wlm.export.files import decode_texture
from wlm.formats.light import read_light
from wlm.inspection import inspect
from wlm.lightmap.bundle import sheet_bundle
from wlm.lightmap.decode import Decoder

ALL = (4, 3, 3, 1, 4, 0)


def atlas_model(kind, stored="half", mesh=None):
    return random_atlas(sheet() if mesh is None else mesh, kind, stored)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_large_lightmap_has_few_files(engine, tmp_path):
    model = random_lightmap((3, 4) * 32, columns=8, times=(0.0, 12.0))
    paths = export(model, tmp_path / "out", engine)
    assert {path.name for path in paths} == set(os.listdir(tmp_path / "out")) and len(paths) <= 12
    assert paths[-1].name == "bundle.json"
    assert 5 <= len((tmp_path / "out" / "README.md").read_text().splitlines()) <= 20
    assert not re.search(r"@[A-Z]+@", "".join(path.read_text() for path in paths if path.suffix in TEXTS))


TEXTS = {".md", ".js", ".glsl", ".gd", ".gdshader", ".hlsl", ".shader", ".cs", ".py"}


def test_a_shader_reads_the_textures_beside_it_and_no_others(tmp_path):
    model = random_atlas(sheet(), MIXED)
    for engine in (*ENGINES, None):
        paths = export(model, tmp_path / "out", engine)
        info = json.loads(paths[-1].read_text())
        text = "".join(path.read_text() for path in paths if path.suffix in TEXTS - {".md", ".cs"})
        assert set(re.findall(r"\bwlm_atlas_(colour|lut|blocks)\b", text)) == set(info["textures"])


def test_sheets_of_light_have_a_folder_each(tmp_path):
    """What a project can have only once is written once, and assets named after the model have the sheet's name."""
    model, out = random_layers(), tmp_path / "out"
    places = set()
    for engine in ("unity", "three", "unreal", "godot"):
        paths = export(model, out, engine)
        assert {path for path in out.rglob("*") if path.is_file()} == set(paths) and paths[-1] == out / "bundle.json"
        index = json.loads(paths[-1].read_text())
        assert index["parts"] == ["sheet_00", "sheet_03"]
        atlases = {each["part"]: each["atlas"] for each in index["sheets"]}
        assert [atlases[part] for part in index["parts"]] == ["a", "b"]
        shared = [path.relative_to(out).as_posix() for path in paths if path.suffix == ".cs"]
        assert shared == (["WlmLightmap.cs"] if engine == "unity" else [])
        for part in index["parts"]:
            sheet = next(each for each in model.sheets if each.atlas == atlases[part] and not each.linear)
            light = sheet_bundle(sheet, model.sheets[sheet], model.name, model.source)
            alone = {path.name: path for path in export(light, tmp_path / f"alone-{engine}", engine)}
            same = [name for name in alone if Path(name).suffix in (".bytes", ".dds", ".bin", ".tga", ".exr")]
            for name in same:
                assert (out / part / name).read_bytes() == alone[name].read_bytes(), name
            assert same
            for name in ("WlmLightmap.shader", "wlm_lightmap.py"):
                if name in alone:
                    text = (out / part / name).read_text()
                    places.add(re.search(r'^(Shader|PLACE =) "(.*)"', text, re.MULTILINE)[0])
    assert len(places) == 4
    (finding,) = inspect(out)
    assert "wlm export wrote" in finding.what


KEY = """
import { readFile } from "node:fs/promises";
globalThis.document = { baseURI: import.meta.url };
globalThis.fetch = async (url) => {
  const bytes = await readFile(new URL(url)).catch(() => null);
  if (bytes === null) return { ok: false, status: 404 };
  const arrayBuffer = () => bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
  return { ok: true, arrayBuffer, text: () => bytes.toString(), json: () => JSON.parse(bytes) };
};
const { loadAtlas } = await import("./atlas.mjs"), material = {};
(await loadAtlas("bundle.json", { DataTexture: class {} })).apply(material);
console.log(material.customProgramCacheKey());
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node: install nodejs")
def test_atlases_of_one_lightmap_share_no_program_of_three(tmp_path):
    """three.js compiles once for each key: under one key one atlas would be drawn with the other's shader."""
    keys, sources = set(), set()
    for kind in ("tiles", "plain"):
        folder, model = tmp_path / f"out-{kind}", atlas_model(kind)
        export(model, folder, "three")
        shutil.copy(folder / "atlas.js", folder / "atlas.mjs")
        (folder / "key.mjs").write_text(KEY)
        done = subprocess.run(["node", "key.mjs"], cwd=folder, capture_output=True, text=True, check=True)
        keys.add(done.stdout)
        sources.add(model.source)
    assert len(sources) == 1 and len(keys) == 2


@pytest.mark.skipif(shutil.which("node") is None, reason="no node: install nodejs")
def test_a_file_that_three_cannot_load_is_named(tmp_path):
    export(atlas_model("plain"), tmp_path / "out", "three")
    (tmp_path / "out" / "atlas.js").rename(tmp_path / "out" / "atlas.mjs")
    (tmp_path / "out" / "atlas.glsl").unlink()
    (tmp_path / "out" / "key.mjs").write_text(KEY)
    done = subprocess.run(["node", "key.mjs"], cwd=tmp_path / "out", capture_output=True, text=True)
    assert done.returncode and "atlas.glsl: 404" in done.stderr


def test_what_cannot_be_exported_for_an_engine(tmp_path):

    layers = random_layers()
    layers.sheets = {sheet: model for sheet, model in layers.sheets.items() if sheet.linear}
    assert "expected a layer of light" in error_of(export, layers, tmp_path / "a", "three")
    model = atlas_model("plain", "astc")
    assert "a DDS file cannot hold ASTC" in error_of(export, model, tmp_path / "a", "three")
    assert {path.name for path in export(model, tmp_path / "a", "godot")} > {"colour.exr"}
    assert {path.name for path in export(model, tmp_path / "a")} > {"colour.ktx2"}
    assert sorted(os.listdir(tmp_path)) == ["a"]


def test_blocks_that_do_not_fill_their_texture_become_half_floats(tmp_path):
    model = atlas_model("plain", "bc6h")
    assert model.texels.shape == (1, 18, 23, 3)
    export(model, tmp_path / "out", "three")
    np.testing.assert_array_equal(read_light(tmp_path / "out" / "colour.dds")[0][..., :3], model.texels[0])
    export(model, tmp_path / "out")
    assert (tmp_path / "out" / "colour.dds").read_bytes().endswith(model.blocks.tobytes())


def as_glsl(text):
    """A shader of Godot as GLSL: without its hints, its render modes, its own names and stages."""
    text = re.sub(r"^(shader_type|render_mode) .*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(uniform [^:;]*?) : [^;=]*?( =[^;]*)?;", r"\1\2;", text, flags=re.MULTILINE)
    text = re.sub(r"^varying ", "", text, flags=re.MULTILINE)
    names = "vec3 ALBEDO, EMISSION, LIGHT, LIGHT_COLOR, DIFFUSE_LIGHT; float ALPHA, ATTENUATION; vec2 UV, UV2;\n"
    names += "const bool OUTPUT_IS_SRGB = false; vec4 COLOR;\n"
    names += "mat4 MODEL_MATRIX, VIEW_MATRIX, MODELVIEW_MATRIX; mat3 MODELVIEW_NORMAL_MATRIX;\n"
    return names + text.replace("void light()", "void light_of()")


@pytest.mark.parametrize("kinds", [ALL, (3, 1, 0, 3)], ids=str)
def test_godots_viewports_decode_an_hour_and_fill_its_gaps(kinds, tmp_path):
    """Run as GLSL, with the textures that the script's viewports give the shader; a lit surface mixes both hours."""
    mask = np.ones((128 * len(kinds) // 2 - 20, 247), bool)
    mask[40:42, 60:62] = False
    model = random_lightmap(kinds, mask=mask)
    export(model, tmp_path, "godot")
    script, text = ((tmp_path / name).read_text() for name in ("wlm_lightmap.gd", "lightmap.gdshader"))
    content = model.bundle()
    maps = {name: decode_texture(each) for name, each in content.textures.items()}
    rows = {name: content.buffers[name] for name in {"networks"} & content.buffers.keys()}
    names = json.loads(re.search(r"NAMES: Array\[String\] = (.*)", script)[1])
    assert set(names) == {"hour", *maps, *rows}
    shown = {"albedo": np.full((1, 1, 4), 51, np.uint8)}
    for number, part in ((0, "early"), (2, "late")):
        tables = rows | {"hour": content.buffers["hours"][number]}
        fours = {name: np.pad(v, ((0, -len(v) % 1024), (0, 0))).reshape(-1, 1024, 4) for name, v in tables.items()}
        bound = {f"wlm_lightmap_{name}": each for name, each in (maps | fours).items()}
        main = f"UV = (vec2(pixel) + 0.5) / vec2({mask.shape[1]}, {mask.shape[0]}); fragment(); light = COLOR;"
        bound["wlm_decoded"] = run_glsl(as_glsl(text), main, mask.shape, bound, uniforms={"wlm_filling": False})
        found = run_glsl(as_glsl(text), main, mask.shape, bound, uniforms={"wlm_filling": True})
        want = Decoder(model).frame(float(model.times[number]))
        np.testing.assert_allclose(found[..., :3], want, rtol=0, atol=want.max() / 200)
        shown[f"wlm_{part}"] = found
    text, main = as_glsl((tmp_path / "lit.gdshader").read_text()), f"UV2 = {main[:-6]}vec4(EMISSION, 1.0);"
    lit = run_glsl(text, main, mask.shape, shown, uniforms={"wlm_share": 0.25})
    expected = 0.2 * (0.75 * shown["wlm_early"] + 0.25 * shown["wlm_late"])
    np.testing.assert_allclose(lit[..., :3], expected[..., :3], atol=want.max() / 500)
    assert_gdscript_parses(tmp_path / "wlm_lightmap.gd")


@pytest.mark.parametrize("kind", [*KINDS, MIXED])
def test_godots_atlas_shows_its_light(kind, tmp_path):
    """Run as GLSL, with the EXRs as Godot imports them: in floats."""
    model = atlas_model(kind, mesh=charts())
    export(model, tmp_path / "out", "godot")
    text = as_glsl((tmp_path / "out" / "atlas.gdshader").read_text())
    uv = off_borders(model, np.random.default_rng(0).random((1000, 2)).astype(np.float32))
    bound = {path.stem: read_light(path)[0] for path in (tmp_path / "out").glob("*.exr")}
    bound = {f"wlm_atlas_{name}": np.float32(np.pad(v[..., :3], ((0, 0), (0, 0), (0, 1)))) for name, v in bound.items()}
    bound |= {"u_points": np.pad(uv, ((0, 0), (0, 2)))[None], "albedo": np.full((1, 1, 4), 255, np.uint8)}
    main = "UV = vec2(0.5); UV2 = texelFetch(u_points, pixel, 0).xy; fragment(); light = vec4(EMISSION, 1.0);"
    found = run_glsl(f"uniform sampler2D u_points;\n{text}", main, (1, len(uv)), bound)[0, :, :3]
    allowed = 3.0 / 512 * 2 * (1 + 22 * (model.method == "cascade"))
    np.testing.assert_allclose(found, decode64(model, uv), rtol=0, atol=allowed)


@pytest.mark.parametrize("kinds", [ALL, (3, 1, 0, 3)], ids=str)
def test_unitys_passes_compile(kinds, tmp_path):
    model = random_lightmap(kinds)
    export(model, tmp_path / "unity", "unity")
    shader = (tmp_path / "unity" / "WlmLightmap.shader").read_text()
    shared = re.search(r"HLSLINCLUDE(.*?)ENDHLSL", shader, re.DOTALL)[1]
    included = (tmp_path / "unity" / "WlmLightmap.hlsl").read_text()
    shared = re.sub(r"^ *#pragma.*$", "", shared, flags=re.MULTILINE).replace('#include "WlmLightmap.hlsl"', included)
    passes = re.findall(r"HLSLPROGRAM(.*?)ENDHLSL", shader, re.DOTALL)
    assert len(passes) == 3
    for each in passes:
        compiled(shared + each, tmp_path, "-D", "-S", "frag", "-e", "frag", "--auto-map-bindings")
    compiled(shared + passes[0], tmp_path, "-D", "-S", "vert", "-e", "vert", "--auto-map-bindings")
    assert_csharp_parses(tmp_path / "unity" / "WlmLightmap.cs")


# Constants and functions of Unity, to run a pass as a function.
RUN = """
static const float4 _MainTex_ST = float4(1, 1, 0, 0), _Color = float4(1, 1, 1, 1);
static const float _WlmShare = 0.25, _WlmDown = WLM_DOWN;
float4 UnityObjectToClipPos(float4 p) { return p; }
#define TRANSFORM_TEX(uv, name) (uv * name##_ST.xy + name##_ST.zw)
#define tex2D(s, uv) float4(0.5, 0.5, 0.5, 1.0)
"""


@pytest.mark.parametrize("down", [0, 1])
def test_unitys_light_has_its_top_where_unity_has_it(down, tmp_path):
    """The picture's top row at v = 1, the last row of a texture of Unity; or at v = 0."""
    export(random_lightmap(), tmp_path, "unity")
    text = re.findall(r"HLSLPROGRAM(.*?)ENDHLSL", (tmp_path / "WlmLightmap.shader").read_text(), re.DOTALL)[2]
    named = "Texture2D<float4> _WlmEarly;\nTexture2D<float4> _WlmLate;\n"
    text = f"#define WLM_DOWN {down}\n{named}{RUN}{text}"
    early, late = np.random.default_rng(0).random((2, 5, 4, 4)).astype(np.float32)
    maps = {"_WlmEarly": early, "_WlmLate": late}
    found = run_hlsl(text, "frag(float4(float2(pixel) + 0.5, 0.0, 1.0))", (5, 4), maps, tmp_path)
    expected = 0.75 * early + 0.25 * late
    np.testing.assert_allclose(found, expected if down else expected[::-1], atol=1e-6)


@pytest.mark.parametrize("down", [0, 1])
def test_unitys_surface_shows_its_light(down, tmp_path):
    """At UVs whose v an importer turned round, and at glTF's own."""
    model = atlas_model("plain", mesh=charts())
    export(model, tmp_path / "out", "unity")
    text = re.search(r"HLSLPROGRAM(.*?)ENDHLSL", (tmp_path / "out" / "WlmAtlas.shader").read_text(), re.DOTALL)[1]
    text = re.sub(r"^ *(#pragma|#include \"UnityCG|sampler2D|float4 _MainTex_ST).*$", "", text, flags=re.MULTILINE)
    text = text.replace('#include "WlmAtlas.hlsl"', "\n" + (tmp_path / "out" / "WlmAtlas.hlsl").read_text())
    head = "#define WLM_DOWN 0\n" + "#define WLM_V_DOWN\n" * down + "Texture2D<float4> u_points;\n"
    uv = np.random.default_rng(0).random((500, 2)).astype(np.float32)
    given = uv if down else np.float32([0, 1]) + np.float32([1, -1]) * uv
    colour = np.concatenate([model.texels[0], np.ones_like(model.texels[0, ..., :1])], 2).astype(np.float16)
    bound = {"u_points": np.pad(given, ((0, 0), (0, 2)))[None], "wlm_atlas_colour": colour}
    place = "u_points.Load(int3(pixel, 0)).xy"
    shown = f"frag(vert(float4(0, 0, 0, 1), float2(0.5, 0.5), {place}))"
    found = run_hlsl(head + RUN + text, shown, (1, len(uv)), bound, tmp_path)[0, :, :3]
    np.testing.assert_allclose(found, 0.5 * decode64(model, uv), atol=3.0 / 512)


UNITY = """
cbuffer unity { float4x4 unity_all; };
float4 UnityObjectToClipPos(float4 p) { return mul(unity_all, p); }
#define TRANSFORM_TEX(uv, name) (uv * name##_ST.xy + name##_ST.zw)
Texture2D _MainTexture; SamplerState sampler_MainTexture;
#define tex2D(s, uv) _MainTexture.Sample(sampler_MainTexture, uv)
"""


def surface_compiles(folder, name, defines=("",)):
    """Compiles the stages of the surface shader of a kit for Unity, after each of the `defines`."""
    text = re.search(r"HLSLPROGRAM(.*?)ENDHLSL", (folder / f"{name}.shader").read_text(), re.DOTALL)[1]
    text = re.sub(r"^ *#pragma.*$", "", text, flags=re.MULTILINE).replace("sampler2D _MainTex;", "")
    text = text.replace(f'#include "{name}.hlsl"', (folder / f"{name}.hlsl").read_text())
    for first in defines:
        for stage in ("frag", "vert"):
            own = first + UNITY + text.replace('#include "UnityCG.cginc"', "")
            compiled(own, folder, "-D", "-S", stage, "-e", stage, "--auto-map-bindings")


@pytest.mark.parametrize("kind", ["cascade", "plain with uv", MIXED])
def test_unitys_surface_compiles(kind, tmp_path):
    export(atlas_model(kind), tmp_path, "unity")
    surface_compiles(tmp_path, "WlmAtlas", ("", "#define WLM_FIRST_UV\n"))
    assert_csharp_parses(tmp_path / "WlmAtlas.cs")


@pytest.mark.parametrize("kind", [*KINDS, MIXED])
def test_an_atlas_node_gives_its_light(kind, tmp_path, monkeypatch):
    model = random_atlas(charts(), kind)
    export(model, tmp_path / "out", "unreal")
    script = Script(tmp_path / "out" / "wlm_atlas.py", monkeypatch)
    files = json.loads((tmp_path / "out" / "bundle.json").read_text())["textures"]
    assert set(script.settings) == {each["file"] for each in files.values()} and script.slots == [0]
    ((code, inputs),) = script.customs()
    uv = off_borders(model, np.random.default_rng(0).random((1000, 2)).astype(np.float32))
    bound = {f"wlm_atlas_{name}": pixels_of(str(tmp_path / "out" / each["file"])) for name, each in files.items()}
    # What is filtered are halves there; a table of coordinates is floats, which WebGPU doesn't filter.
    bound = {
        name: v.astype(np.float16) if model.method == "cascade" or "lut" not in name else v for name, v in bound.items()
    }
    bound["points"] = np.pad(uv, ((0, 0), (0, 2)))[None]
    found = node_gives(code, inputs, (1, len(uv)), "points.Load(int3(pixel, 0)).xy", bound, tmp_path)[0]
    allowed = 3.0 / 512 * 2 * (1 + 22 * (model.method == "cascade"))
    np.testing.assert_allclose(found, decode64(model, uv), rtol=0, atol=allowed)


@pytest.mark.parametrize("kinds", [ALL, (3, 1, 0, 3)], ids=str)
def test_lightmap_nodes_decode_an_hour_and_fill_its_gaps(kinds, tmp_path, monkeypatch):
    mask = np.ones((128 * len(kinds) // 2 - 20, 247), bool)
    mask[40:42, 60:62] = False
    model = random_lightmap(kinds, mask=mask)
    export(model, tmp_path, "unreal")
    script = Script(tmp_path / "wlm_lightmap.py", monkeypatch)
    decode, fill = script.customs()
    pictures = {path.stem: pixels_of(str(path)) for path in tmp_path.iterdir() if path.suffix in (".tga", ".exr")}
    assert set(script.settings) == {path.name for path in tmp_path.iterdir() if path.suffix in (".tga", ".exr")}
    bound = {f"wlm_lightmap_{name}": values for name, values in pictures.items()}
    size = mask.shape
    place = f"(float2(pixel) + 0.5) / float2({size[1]}, {size[0]})"
    for number in (0, 2):
        found = node_gives(*decode, size, place, bound, tmp_path, {"wlm_hour": f"float wlm_hour = {number}.0"})
        filled = bound | {"Decoded": np.pad(found, ((0, 0), (0, 0), (0, 1)))}
        found = node_gives(*fill, size, place, filled, tmp_path)
        want = Decoder(model).frame(float(model.times[number]))
        np.testing.assert_allclose(found, want, rtol=0, atol=want.max() / 200)
    for time in (0.0, 3.0, 7.5, 12.9, 23.0):
        assert script.names["neighbours"](time) == pytest.approx(model.light.axis.neighbours(time))
    script.names["set_hour"](12.9)
    values = script.unreal.MaterialLibrary.set_scalar_parameter_value.call_args.args
    assert values[2:] == ("Share", pytest.approx(model.light.axis.neighbours(12.9)[2]))


def test_times_without_a_day(tmp_path, monkeypatch):
    model = random_lightmap((3, 1), period=None)
    export(model, tmp_path, "unreal")
    neighbours = Script(tmp_path / "wlm_lightmap.py", monkeypatch).names["neighbours"]
    for time in (0.0, 7.5, 10.0, 19.0):
        early, late, share = model.light.axis.neighbours(time)
        found = neighbours(time)
        mixed = lambda pair: (1 - pair[2]) * pair[0] + pair[2] * pair[1]  # noqa: E731
        assert mixed(found) == pytest.approx(mixed((early, late, share)))
    assert neighbours(-5.0) == (0, 1, 0.0) and neighbours(50.0)[2] == 1.0


def test_what_unreal_does_not_import(tmp_path, monkeypatch):
    monkeypatch.setitem(kit._MOST_SIDE, "unreal", 127)
    line = error_of(export, random_lightmap(), tmp_path / "deep" / "out", "unreal")
    assert re.search(r"cannot export for unreal: uv: expected at most 127 texels along a side, found \d+x\d+", line)
    assert not (tmp_path / "deep").exists()
    assert asset_name("a b/ç.1") == "a_b___1"


def test_light_groups_are_added_by_three_alone(tmp_path):
    model = random_groups()
    paths = export(model, tmp_path / "three", "three")
    assert {"groups.js", "README.md"} <= {path.name for path in paths}
    assert "from './sheet_00/lightmap.js'" in (tmp_path / "three" / "groups.js").read_text()
    for engine in set(ENGINES) - {"three"}:
        assert "does not add light groups" in error_of(export, model, tmp_path / engine, engine)
        assert not (tmp_path / engine).exists()
    export(model, tmp_path / "raw")
    sheets = json.loads((tmp_path / "raw" / "bundle.json").read_text())["sheets"]
    assert [sheet["group"] for sheet in sheets] == list(model.groups)
