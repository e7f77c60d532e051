import json
import os
import re

import numpy as np
import pytest
import yaml
from builders.atlas_meshes import sheet, write_files
from builders.contract import FILES
from builders.gltf_scene import Thing, box, write_scene
from builders.running import call, fails
from PIL import Image

import wlm.atlas.codec
import wlm.atlas.fit
from wlm.atlas.data import load
from wlm.atlas.evaluation import evaluate
from wlm.atlas.fit import compress
from wlm.formats.exr import read_exr, write_exr

CASCADE = {"name": "short", "method": "cascade", "fallback": False, "steps": 20, "resolution": 64}
QUICK = ("--views", 2)


@pytest.fixture(scope="session")
def inputs(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("inputs"), sheet())


@pytest.fixture(scope="session")
def tiles(inputs, tmp_path_factory):
    """The file of the profile `standard` with few views."""
    path = tmp_path_factory.mktemp("tiles") / "a.wlm"
    call("compress", *inputs, "-o", path, *QUICK)
    return path


@pytest.fixture(scope="session")
def cascade(inputs, tmp_path_factory):
    """The file of the paper's method with few steps."""
    folder = tmp_path_factory.mktemp("cascade")
    (folder / "short.yaml").write_text(yaml.safe_dump(CASCADE))
    call("compress", *inputs, "-o", folder / "a.wlm", "--profile", folder / "short.yaml")
    return folder / "a.wlm"


def test_the_options_of_compress_reach_the_fit(inputs, tmp_path):
    mask = np.zeros((40, 48), np.uint8)
    mask[:30] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    reading = ["--uv-set", 0, "--mask", tmp_path / "mask.png"]
    options = ["--budget", 0.4, "--colour", "bc6h", "--views", 1, *reading]
    call("compress", *inputs, "-o", tmp_path / "b.wlm", *options, "--seed", 5)
    # The sheet reaches beyond the mask.
    assert re.search(r"^warning: .*outside the mask", call.stderr, re.MULTILINE)
    mesh = load(*inputs, mask_path=tmp_path / "mask.png")
    compress(mesh, seed=5, budget=0.4, colour="bc6h", views=1).save(tmp_path / "a.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "b.wlm").read_bytes()
    # evaluate reads the mask again, and decode needs no inputs.
    call("evaluate", tmp_path / "b.wlm", *inputs, *reading, "--views", 2, "--resolution", 64)
    (tmp_path / "mask.png").unlink()
    call("decode", tmp_path / "b.wlm", "-o", tmp_path / "a.exr")
    decoded, _ = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(decoded.any(axis=2), mask > 0)


def test_lightmaps_of_a_material_slot(tmp_path):
    """Compressed, evaluated and decoded; the transform of the second material makes a new UV set."""
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    turned = {"KHR_texture_transform": {"rotation": np.pi / 2, "offset": [0.0, 1.0]}}  # (v, 1 - u)
    slots = [{"index": 0}, {"index": 0, "extensions": turned}]
    right = np.stack([1 - uv[:, 1], 0.5 + uv[:, 0] / 2], 1)
    things = [
        Thing(name, position + 2 * i, triangle, [places], material={"emissiveTexture": slot})
        for i, (name, slot, places) in enumerate(zip("ab", slots, (uv * [0.5, 1], right), strict=True))
    ]
    row, column = np.mgrid[:48, :64] / 64
    light = np.stack([0.2 + column, 0.3 + row, 0.5 + 0 * row], 2)
    write_exr(tmp_path / "lm.exr", light)
    pictures = {"textures": [{"source": 0}], "images": [{"uri": "lm.exr"}]}
    path = write_scene(tmp_path / "a.gltf", things, pictures)
    assert "--slot emissive" in fails("compress", path, "-o", tmp_path / "a.wlm")
    call("compress", path, "-o", tmp_path / "a.wlm", "--slot", "emissive", *QUICK)
    assert "warning: " in call.stderr and "1 lightmap of the slot emissive" in call.stderr
    assert wlm.load(tmp_path / "a.wlm").stored.uv_set == 1
    call("evaluate", tmp_path / "a.wlm", path, "--slot", "emissive", *QUICK, "--resolution", 64)
    call("decode", tmp_path / "a.wlm", "-o", tmp_path / "out.exr")
    decoded = read_exr(tmp_path / "out.exr")[0]
    covered = decoded.any(axis=2)
    assert covered.mean() > 0.7
    np.testing.assert_allclose(decoded[covered], light[covered], atol=0.05)


def test_wrong_words_are_one_line(inputs, tmp_path):
    out = ["-o", tmp_path / "a.wlm"]
    words = ["compress", *inputs, *out]
    assert "--budget: expected greater than 0, got '0'" in fails(*words, "--budget", 0).replace("should be ", "")
    assert "--colour: expected 'half', 'rgb9e5', 'bc6h', 'astc' or 'mixed', got" in fails(*words, "--colour", "png")
    assert "budget: " in fails(*words, "--profile", "paper", "--budget", 0.1)
    assert "TEXCOORD_3" in fails(*words, "--uv-set", 3)
    assert "cannot read the mask" in fails(*words, "--mask", tmp_path / "a.png")
    assert "gone.glb" in fails("compress", tmp_path / "gone.glb", inputs[1], *out)
    assert "gone.exr" in fails("compress", inputs[0], tmp_path / "gone.exr", *out)
    assert os.listdir(tmp_path) == []


def test_evaluate(tiles, inputs, tmp_path):
    """The report of the library."""
    options = {"views": 3, "resolution": 64}
    words = ["--views", 3, "--resolution", 64, "--json", tmp_path / "a.json"]
    text = call("evaluate", tiles, *inputs, *words)
    report = json.loads((tmp_path / "a.json").read_text())
    expected = evaluate(wlm.load(tiles), load(*inputs), **options).to_json()
    assert report.items() >= (expected | {"views": 3}).items() and f"{report['psnr']:.2f}" in text
    assert "evaluate: 3 of 3" in call.stderr
    assert report["seam_ratio"] is None, "one chart has no seam"


def test_evaluate_refuses_other_inputs(inputs, tiles, tmp_path):
    mesh = load(*inputs).sheets[0]
    words = ["evaluate", tiles, inputs[0]]
    changed = mesh.lightmap.copy()
    changed[tuple(np.argwhere(mesh.mask)[0])] += 1.0
    write_exr(tmp_path / "light.exr", changed)
    assert re.search("expected the mesh and lightmaps .*[0-9a-f]{16}", fails(*words, tmp_path / "light.exr"))
    assert "expected a name that ends in .json" in fails(*words, inputs[1], "--json", tmp_path / "a.txt")


def test_wrong_words_of_decode(tiles, tmp_path):
    words = ["decode", tiles, "-o"]
    assert "expected a name that ends in .exr" in fails(*words, tmp_path / "a.png")
    assert "--sheet: expected 0 to 0, got 1" in fails(*words, tmp_path / "a.exr", "--sheet", 1)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_info(kind, request):
    path = request.getfixturevalue(kind)
    model, size = wlm.load(path), path.stat().st_size
    facts = json.loads(call("info", path, "--json"))
    assert (facts["name"], facts["method"], facts["bytes_on_disk"]) == ("mesh", kind, size)
    assert facts["lightmaps"] == ["48x40"] and facts["GPU_bytes"] == -(-model.bits // 8)
    assert facts["profile"]["method"] == kind
    text = call("info", path)
    assert f"{size:,}" in text and f"{model.compression_ratio:.2%}" in text and "48x40" in text
    assert ("those of the mesh" in text) is (kind == "tiles")
    plain = call("info", FILES / "atlas-plain.wlm")
    assert re.search(r"│ lookup texture +│ +none │", plain) and re.search(r"│ method +│ +plain │", plain)


def test_a_scene_is_one_command(tmp_path):
    """The lightmaps of all its nodes and states become one file, which is then scored."""
    position, triangle, uv = box((0, 0, 0), (6, 3, 5), inward=True)
    path = write_scene(tmp_path / "room.gltf", [Thing("room", position, triangle, [uv])])
    row, column = np.mgrid[:32, :32] / 32
    for name, share in (("day", 1.0), ("night", 0.2)):
        write_exr(tmp_path / f"{name}.exr", (share * (1 + row * column) + (1 - share) * row)[..., None] * [1, 0.9, 0.8])
    (tmp_path / "lights.json").write_text(json.dumps({"sheets": [{"files": ["day.exr", "night.exr"]}]}))
    out, words = tmp_path / "a.wlm", ("compress", path, tmp_path / "lights.json", "-o", tmp_path / "a.wlm")
    text = call(*words, "--budget", "0.3", "--views", "1")
    assert re.search(r"states +│ +0, 1 │", text) and wlm.load(out).states == ("0", "1")
    scoring = ("--views", "2", "--resolution", "32", "--json", tmp_path / "r.json")
    text = call("evaluate", out, path, tmp_path / "lights.json", *scoring)
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["inside_views"] == 2 and report["psnr"] > 35.0 and "from inside, dB" in text
    assert "saved GPU bytes" in call("info", out)
    facts = json.loads(call("info", out, "--json"))
    assert facts["states"] == ["0", "1"] and not facts["smaller_levels"]
    assert "scene.js" in call("export", out, "-o", tmp_path / "three", "--engine", "three")
    assert "exact has no meaning here" in fails("export", out, "-o", tmp_path / "a", "--exact")
    assert "rgb9e5" in fails(*words, "--colour", "half")
    for number in (0, 1, 0.5):
        call("decode", out, "--state", number, "-o", tmp_path / f"{number}.exr")
    first, second, between = (read_exr(tmp_path / f"{number}.exr")[0].astype(np.float64) for number in (0, 1, 0.5))
    np.testing.assert_allclose(between, (first + second) / 2, rtol=0.01, atol=0.01)


def test_export_for_an_engine_and_in_a_language(tiles, tmp_path):
    out = ["export", tiles, "-o", tmp_path / "out"]
    assert "atlas.gdshader" in call(*out, "--engine", "godot")
    assert "atlas.hlsl" in call(*out, "--shader", "hlsl")
    assert not (tmp_path / "out" / "atlas.gdshader").exists()
    assert "float3 wlm_atlas(float2 uv)" in (tmp_path / "out" / "atlas.hlsl").read_text()
    assert "--shader: has no meaning with --engine three" in fails(*out, "--engine", "three", "--shader", "wgsl")
