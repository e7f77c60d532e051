"""Engine folders of scenes: each object reads its part, as far as what runs here tells."""

import json
import os
import re

import numpy as np
import pytest
from builders.checks import error_of
from builders.engine_scripts import Script, node_gives, pixels_of
from builders.scene_folders import expected_picture, scene_folder
from builders.shader_runs import run_glsl
from test_folders import TEXTS, UNITY, as_glsl, compiled

from wlm.atlas.scene.decode import Decoder
from wlm.engines import ENGINES, export_scene
from wlm.formats.light import read_light
from wlm.inspection import inspect

SIZE = 64


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder of the compression, and its model."""
    folder = tmp_path_factory.mktemp("scene") / "scene"
    return folder / "made", scene_folder(folder)


def squares(info):
    """Corner, size in pixels of a picture, and the numbers of each object."""
    place = {"left": (0, 0, 32, 64), "above": (32, 0, 32, 32), "below": (32, 32, 32, 32)}
    for each in info["objects"]:
        sheet = info["sheets"][each["sheet"]]
        numbers = each["scale_offset"], [sheet[name] for name in ("width", "height", "column", "row")]
        yield place[each["label"]], *numbers, [sheet["columns"], sheet["rows"], sheet["page"]]


def check(found, model, state):
    expected, inside = expected_picture(model, SIZE, state)
    np.testing.assert_allclose(found[inside], expected[inside], rtol=0, atol=expected.max() / 255)


def test_each_engines_files_take_the_place_of_anothers(made, tmp_path):
    source, model = made
    for engine in (*ENGINES, "raw"):
        paths = export_scene(source, tmp_path / "out", engine)
        assert set(os.listdir(tmp_path / "out")) == {path.name for path in paths} and len(paths) <= 12
        text = "".join(path.read_text() for path in paths if path.suffix in TEXTS)
        assert "wlm_object" in text and not re.search(r"@[A-Z]+@", text)
        info = json.loads(paths[-1].read_text())
        assert info["uv_set"] == 1 and info["states"] == list(model.states) and len(info["objects"]) == 3
    paths = export_scene(source, tmp_path / "out", "raw", shader="wgsl")
    assert "fn wlm_object" in (tmp_path / "out" / "scene.wgsl").read_text() and paths[-1].name == "scene.json"


def test_inspect_names_a_scenes_folders(made, tmp_path):
    """Their pictures are no lightmaps to compress, the file no network."""
    source, _ = made
    ((folder,), (file,)) = inspect(source), inspect(source / "scene.wlm")
    assert folder.what.startswith("the compressed lightmaps of a scene") and not folder.command
    assert file.what.startswith("the lightmaps of a scene, compressed") and not file.command
    for engine in (*ENGINES, "raw"):
        export_scene(source, tmp_path / engine, engine)
        (found,) = inspect(tmp_path / engine)
        assert "of a scene for one engine" in found.what and not found.command


def test_what_cannot_be_exported(made, tmp_path):
    source, _ = made
    assert "engine: expected one of raw" in error_of(export_scene, source, tmp_path / "a", "cry")
    assert "another folder" in error_of(export_scene, source, source, "three")
    assert "expected a folder that compress wrote of a scene" in error_of(export_scene, tmp_path, tmp_path / "a", "raw")
    other = scene_folder(tmp_path / "other", 2)
    line = error_of(export_scene, tmp_path / "other" / "made", tmp_path / "deep" / "a", "godot")
    assert line.startswith(f"{other.name}: cannot export for godot: its shaders read TEXCOORD_0 and 1")
    (tmp_path / "other" / "made" / "scene.glb").unlink()
    assert "scene.glb: no such file" in error_of(export_scene, tmp_path / "other" / "made", tmp_path / "a", "three")
    assert os.listdir(tmp_path) == ["other"]


@pytest.mark.parametrize("state", [0.0, 1.5, 2.0])
def test_unreals_node_reads_each_objects_part(state, made, tmp_path, monkeypatch):
    source, model = made
    export_scene(source, tmp_path, "unreal")
    script = Script(tmp_path / "wlm_scene.py", monkeypatch, ["left", "above", "floor"])
    # One of the level's actors has no light, one object no actor.
    assert script.slots == [("left", 0), ("above", 0)] and "below" in script.unreal.log_warning.call_args.args[0]
    ((code, inputs),) = script.customs()
    files = {"wlm_scene_lut": "lut.exr", "wlm_scene_colour": "colour.exr", "wlm_factors": "factors.exr"}
    bound = {name: pixels_of(str(tmp_path / file)) for name, file in files.items()}
    bound["wlm_scene_colour"] = bound["wlm_scene_colour"].astype(np.float16)
    picture = np.zeros((SIZE, SIZE, 3))
    for (x, y, width, height), *numbers in squares(json.loads((tmp_path / "scene.json").read_text())):
        given = {
            name: f"float4 {name} = float4({', '.join(map(repr, map(float, [*values, 0.0][:4])))})"
            for name, values in zip(("Place", "Sheet", "Tiles"), numbers, strict=True)
        }
        given["wlm_state"] = f"float wlm_state = {state}"
        uv = f"(float2(pixel) + 0.5) / float2({width}, {height})"
        picture[y : y + height, x : x + width] = node_gives(code, inputs, (height, width), uv, bound, tmp_path, given)
    check(picture, model, state)


def test_godots_shader_reads_each_objects_part(made, tmp_path):
    source, model = made
    export_scene(source, tmp_path, "godot")
    text = as_glsl((tmp_path / "scene.gdshader").read_text())
    info = json.loads((tmp_path / "scene.json").read_text())
    colour = np.pad(read_light(tmp_path / "colour.exr")[0], ((0, 0), (0, 0), (0, 1))).astype(np.float16)
    bound = {
        "wlm_scene_colour": colour.reshape(-1, info["layer_height"], *colour.shape[1:]),
        "wlm_scene_lut": np.pad(read_light(tmp_path / "lut.exr")[0], ((0, 0), (0, 0), (0, 1))).astype(np.float32),
        "albedo": np.full((1, 1, 4), 255, np.uint8),
    }
    picture = np.zeros((SIZE, SIZE, 3))
    for (x, y, width, height), place, sheet, tiles in squares(info):
        main = f"UV = vec2(0.5); UV2 = (vec2(pixel) + 0.5) / vec2({width}.0, {height}.0); fragment(); "
        main += "light = vec4(EMISSION, 1.0);"
        own = {"wlm_place": tuple(place), "wlm_sheet": tuple(sheet), "wlm_tiles": tuple(tiles)}
        own["wlm_scene_factor"] = [tuple(row) for row in Decoder(model).factors(0.5).tolist()]
        own["colour"] = (1.0, 1.0, 1.0, 1.0)
        picture[y : y + height, x : x + width] = run_glsl(text, main, (height, width), bound, uniforms=own)[..., :3]
    check(picture, model, 0.5)
    pytest.importorskip("gdtoolkit", reason="gdtoolkit is not installed (pip, extra test)")
    from gdtoolkit.parser import parser

    parser.parse((tmp_path / "wlm_scene.gd").read_text())


def test_unitys_surface_compiles_and_its_component_parses(made, tmp_path):
    source, model = made
    export_scene(source, tmp_path, "unity")
    assert (tmp_path / "factors.bytes").stat().st_size == 16 * len(model.states) * model.factor.shape[1]
    text = re.search(r"HLSLPROGRAM(.*?)ENDHLSL", (tmp_path / "WlmScene.shader").read_text(), re.DOTALL)[1]
    text = re.sub(r"^ *#pragma.*$", "", text, flags=re.MULTILINE).replace("sampler2D _MainTex;", "")
    text = text.replace('#include "WlmScene.hlsl"', (tmp_path / "WlmScene.hlsl").read_text())
    for stage in ("frag", "vert"):
        own = UNITY + text.replace('#include "UnityCG.cginc"', "")
        compiled(own, tmp_path, "-D", "-S", stage, "-e", stage, "--auto-map-bindings")
    sharp = pytest.importorskip("tree_sitter_c_sharp", reason="tree-sitter-c-sharp is not installed (pip, extra test)")
    from tree_sitter import Language, Parser

    tree = Parser(Language(sharp.language())).parse((tmp_path / "WlmScene.cs").read_bytes())
    assert not tree.root_node.has_error
