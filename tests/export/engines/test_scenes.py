"""Kits of scenes: each object reads its part of a sheet, as far as the compilers and players here can tell."""

import dataclasses
import json
import os
import re

import numpy as np
import pytest
from builders.checks import error_of
from builders.engine_scripts import Script, assert_csharp_parses, assert_gdscript_parses, node_gives, pixels_of
from builders.scene_folders import expected_picture, scene_folder
from builders.shader_runs import run_glsl
from test_folders import TEXTS, as_glsl, surface_compiles

from wlm.atlas.model import SHORT_ENTRY
from wlm.export import ENGINES, export
from wlm.formats.shared_exponent import unpack_rgb9e5

SIZE = 64


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return scene_folder(tmp_path_factory.mktemp("scene") / "scene")


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("rgb9e5", "apart")]


@pytest.fixture(scope="module", params=["mixed", "short", *SLOW])
def each_form(request, tmp_path_factory):
    """The same of each way of storing colours; of one state, which has short entries, with mips; of states apart."""
    if request.param == "mixed":
        return request.getfixturevalue("made")
    folder = tmp_path_factory.mktemp(request.param) / "scene"
    settings = {"short": {"states": ("noon",), "mips": True, "budget": 0.4}, "apart": {"budget": 0.4}}
    model = scene_folder(folder, colour="rgb9e5", **settings.get(request.param, {}))
    assert bool(model.levels) == (request.param == "short") and bool(model.later) == (request.param == "apart")
    assert (model.lut.shape[2] == SHORT_ENTRY) == (request.param in settings)
    return model


def squares(info):
    """Corner and size in pixels of a picture, rectangle and sheet of each object."""
    place = {"left": (0, 0, 32, 64), "above": (32, 0, 32, 32), "below": (32, 32, 32, 32)}
    for each in info["objects"]:
        yield place[each["label"]], each["scale_offset"], each["sheet"]


def textures_of(folder, info):
    """A folder's EXRs as an editor has them, in halves where they are filtered, by the shader's names."""
    found = {name: pixels_of(str(folder / each["file"])) for name, each in info["textures"].items()}
    filtered = info["layer_heights"]
    return {f"wlm_scene_{n}": np.float16(v) if n in filtered else np.float32(v) for n, v in found.items()}


def check(found, model, state):
    expected, inside = expected_picture(model, SIZE, float(np.clip(state, 0, len(model.states) - 1)))
    np.testing.assert_allclose(found[inside], expected[inside], rtol=0, atol=expected.max() / 255)


def test_each_engines_files_take_the_place_of_anothers(made, tmp_path):
    model = made
    for engine in (*ENGINES, "raw"):
        paths = export(model, tmp_path / "out", None if engine == "raw" else engine)
        assert set(os.listdir(tmp_path / "out")) == {path.name for path in paths} and len(paths) <= 12
        text = "".join(path.read_text() for path in paths if path.suffix in TEXTS)
        assert "wlm_object" in text and not re.search(r"@[A-Z]+@", text)
        info = json.loads(paths[-1].read_text())
        assert info["uv_set"] == 1 and info["states"] == list(model.states) and len(info["objects"]) == 3
        assert set(info["textures"]) == {"sheets", "lut", "factors", "colour", "blocks"}
        assert {each["file"] for each in info["textures"].values()} < set(os.listdir(tmp_path / "out"))
    paths = export(model, tmp_path / "out", shader="wgsl")
    assert "fn wlm_object" in (tmp_path / "out" / "atlas.wgsl").read_text() and paths[-1].name == "bundle.json"


def test_scenes_that_cannot_be_exported(made, tmp_path):
    bundle = made.bundle()
    other = dataclasses.replace(bundle, document={**bundle.document, "uv_set": 2})
    line = error_of(export, other, tmp_path / "deep" / "a", "godot")
    assert line.startswith(f"{other.name}: cannot export for godot: its shaders read TEXCOORD_0 and 1")
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("state", [pytest.param(-0.5, marks=pytest.mark.slow), 1.5])
def test_the_shader_alone_reads_each_objects_part(state, each_form, tmp_path):
    """With the textures as they lie in their files; of the blocks the bytes are compared, and their texels bound."""
    model = each_form
    export(model, tmp_path)
    info = json.loads((tmp_path / "bundle.json").read_text())
    assert ("blocks" in info["textures"]) == (model.colour == "mixed")

    def texels(name, kind):
        data = (tmp_path / info["textures"][name]["file"]).read_bytes()
        height, width, layers = (int.from_bytes(data[at : at + 4], "little") for at in (12, 16, 140))
        return np.frombuffer(data, kind, offset=148).reshape(layers, height, width, -1)

    bound = {f"wlm_scene_{name}": texels(name, "<u2")[0] for name in ("sheets", "lut")}
    bound["wlm_scene_factors"] = texels("factors", "<f4")[0]
    colour = unpack_rgb9e5(texels("colour", "<u4")[..., 0])
    bound["wlm_scene_colour"] = np.pad(colour, [(0, 0)] * 3 + [(0, 1)]).astype(np.float16)
    if model.colour == "mixed":
        data = (tmp_path / info["textures"]["blocks"]["file"]).read_bytes()
        assert data[148:] == model.blocks.tobytes()
        bound["wlm_scene_blocks"] = np.pad(model.block_texels, [(0, 0)] * 3 + [(0, 1)])
    text = (tmp_path / "atlas.glsl").read_text()
    assert ("wlm_scene_grad" in text) == bool(model.levels)
    picture = np.zeros((SIZE, SIZE, 3))
    for (x, y, width, height), place, sheet in squares(info):
        uv = f"(vec2(pixel) + 0.5) / vec2({width}.0, {height}.0)"
        numbers = ", ".join(map(repr, map(float, place)))
        main = f"light = vec4(wlm_object({uv}, vec4({numbers}), {sheet}, {state}), 1.0);"
        picture[y : y + height, x : x + width] = run_glsl(text, main, (height, width), bound)[..., :3]
    check(picture, model, state)


@pytest.mark.parametrize("state", [1.5, *(pytest.param(state, marks=pytest.mark.slow) for state in (0.0, 2.0))])
def test_unreals_node_reads_each_objects_part(state, each_form, tmp_path, monkeypatch):
    model = each_form
    export(model, tmp_path, "unreal")
    script = Script(tmp_path / "wlm_scene.py", monkeypatch, ["left", "above", "floor"])
    # One of the level's actors has no light, one object no actor.
    assert script.slots == [("left", 0), ("above", 0)] and "below" in script.unreal.log_warning.call_args.args[0]
    ((code, inputs),) = script.customs()
    info = json.loads((tmp_path / "bundle.json").read_text())
    bound = textures_of(tmp_path, info)
    picture = np.zeros((SIZE, SIZE, 3))
    for (x, y, width, height), place, sheet in squares(info):
        given = {
            "Place": f"float4 Place = float4({', '.join(map(repr, map(float, place)))})",
            "Sheet": f"float Sheet = {float(sheet)}",
            "State": f"float State = {state}",
        }
        uv = f"(float2(pixel) + 0.5) / float2({width}, {height})"
        picture[y : y + height, x : x + width] = node_gives(code, inputs, (height, width), uv, bound, tmp_path, given)
    check(picture, model, state)


def test_godots_shader_reads_each_objects_part(each_form, tmp_path):
    model = each_form
    export(model, tmp_path, "godot")
    text = as_glsl((tmp_path / "scene.gdshader").read_text())
    info = json.loads((tmp_path / "bundle.json").read_text())
    bound = textures_of(tmp_path, info)
    for name, height in info["layer_heights"].items():
        pages = bound[f"wlm_scene_{name}"]
        bound[f"wlm_scene_{name}"] = pages.reshape(-1, height, *pages.shape[1:])
    bound["albedo"] = np.full((1, 1, 4), 255, np.uint8)
    picture = np.zeros((SIZE, SIZE, 3))
    for (x, y, width, height), place, sheet in squares(info):
        main = f"UV = vec2(0.5); UV2 = (vec2(pixel) + 0.5) / vec2({width}.0, {height}.0); fragment(); "
        main += "light = vec4(EMISSION, 1.0);"
        own = {"wlm_place": tuple(place), "wlm_sheet": sheet, "wlm_state": 0.5, "colour": (1.0, 1.0, 1.0, 1.0)}
        picture[y : y + height, x : x + width] = run_glsl(text, main, (height, width), bound, uniforms=own)[..., :3]
    check(picture, model, 0.5)
    assert_gdscript_parses(tmp_path / "wlm_scene.gd")


def test_unitys_surface_compiles_and_its_component_parses(each_form, tmp_path):
    model = each_form
    export(model, tmp_path, "unity")
    assert (tmp_path / "factors.bytes").stat().st_size == 148 + 16 * len(model.states) * model.factor.shape[1]
    surface_compiles(tmp_path, "WlmScene")
    assert_csharp_parses(tmp_path / "WlmScene.cs")
