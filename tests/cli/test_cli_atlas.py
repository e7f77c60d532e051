import dataclasses
import json
import os
import re

import numpy as np
import pytest
import yaml
from builders.atlas_meshes import charts, sheet, write_files
from builders.gltf_scene import Thing, box, write_scene
from builders.running import call, fails
from PIL import Image

import wlm.atlas.colour
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
    """The output of the profile `standard` with few views."""
    folder = tmp_path_factory.mktemp("tiles") / "out"
    call("atlas", "compress", *inputs, "-o", folder, *QUICK)
    return folder


@pytest.fixture(scope="session")
def cascade(inputs, tmp_path_factory):
    """The output of the paper's method with few steps."""
    folder = tmp_path_factory.mktemp("cascade")
    (folder / "short.yaml").write_text(yaml.safe_dump(CASCADE))
    call("atlas", "compress", *inputs, "-o", folder / "out", "--profile", folder / "short.yaml")
    return folder / "out"


def test_compress_prints_one_table(inputs, tmp_path):
    out = tmp_path / "out"
    text = call("atlas", "compress", *inputs, "-o", out, *QUICK)
    model = wlm.load(out / "atlas.wlm")
    for path in out.iterdir():
        assert re.search(rf"│ {re.escape(path.name)} +│ +{path.stat().st_size:,} │", text)
    size = (out / "atlas.wlm").stat().st_size
    for ratio in (model.compression_ratio, 1 - size * 8 / (40 * 48 * 48)):
        assert f"{ratio:.2%}" in text
    assert "compress: weights" in call.stderr and os.listdir(tmp_path) == ["out"]
    report = json.loads((out / "report.json").read_text())
    files = {"mesh": str(inputs[0]), "lightmap": str(inputs[1]), "mask": None}
    assert report["inputs"] == files | {"node": None, "encoding": None, "flip": False}
    assert (report["seed"], report["device"]) == (0, "cpu") and report["seconds"]["weights"] > 0


def test_the_command_is_the_library(inputs, tiles, tmp_path):
    """Also byte for byte: one seed gives one file."""
    mesh = load(*inputs)
    assert compress(mesh, views=2).save(tmp_path / "a.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == (tiles / "atlas.wlm").read_bytes()


def test_the_options_of_compress_reach_the_fit(inputs, tmp_path):
    mask = np.zeros((40, 48), np.uint8)
    mask[:30] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    options = ["--budget", 0.4, "--colour", "bc6h", "--views", 1, "--uv-set", 0, "--mask", tmp_path / "mask.png"]
    call("atlas", "compress", *inputs, "-o", tmp_path / "out", *options, "--seed", 5)
    # The sheet reaches beyond the mask.
    assert re.search(r"^warning: .*outside the mask", call.stderr, re.MULTILINE)
    mesh = load(*inputs, mask_path=tmp_path / "mask.png")
    compress(mesh, seed=5, budget=0.4, colour="bc6h", views=1).save(tmp_path / "a.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "out" / "atlas.wlm").read_bytes()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert len(report["warnings"]) == 1 and report["inputs"]["mask"] == str(tmp_path / "mask.png")
    # evaluate reads the mask again, and decode needs no inputs.
    call("atlas", "evaluate", tmp_path / "out", "--views", 2, "--resolution", 64)
    (tmp_path / "mask.png").unlink()
    call("atlas", "decode", tmp_path / "out", "-o", tmp_path / "a.exr")
    decoded, _ = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(decoded.any(axis=2), mask > 0)


def test_wrong_words_are_one_line(inputs, tmp_path):
    out = ["-o", tmp_path / "out"]
    words = ["atlas", "compress", *inputs, *out]
    assert "--budget: expected greater than 0, got 0" in fails(*words, "--budget", 0).replace("should be ", "")
    assert "--colour: expected 'half', 'rgb9e5', 'bc6h', 'astc' or 'mixed', got 'png'" in fails(
        *words, "--colour", "png"
    )
    assert "--budget: profiles of the cascade" in fails(*words, "--profile", "paper", "--budget", 0.1)
    assert "'none'" in fails(*words, "--profile", "none")
    assert "TEXCOORD_3" in fails(*words, "--uv-set", 3)
    assert "device 'tpu'" in fails(*words, "--device", "tpu")
    assert "cannot read the mask" in fails(*words, "--mask", tmp_path / "a.png")
    assert "gone.glb" in fails("atlas", "compress", tmp_path / "gone.glb", inputs[1], *out)
    assert "gone.exr" in fails("atlas", "compress", inputs[0], tmp_path / "gone.exr", *out)
    assert "none does not exist" in fails("atlas", "compress", *inputs, "-o", tmp_path / "none" / "out")
    assert os.listdir(tmp_path) == []


def test_other_files_are_not_replaced(inputs, tmp_path, monkeypatch):
    (tmp_path / "a.txt").write_text("x")
    # It says so before it computes.
    monkeypatch.setattr(wlm.atlas.fit, "compress", None)
    assert "found other files" in fails("atlas", "compress", *inputs, "-o", tmp_path)
    assert "Not a directory" in fails("atlas", "compress", *inputs, "-o", tmp_path / "a.txt")
    assert os.listdir(tmp_path) == ["a.txt"]


def test_an_interrupt_leaves_nothing(inputs, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(wlm.atlas.fit, "compress", interrupted)
    call("atlas", "compress", *inputs, "-o", tmp_path / "out", code=130)
    assert os.listdir(tmp_path) == []


def test_a_mesh_of_another_format(inputs, tmp_path):
    mesh = load(*inputs)
    lines = ["v {} {} {}".format(*place) for place in mesh.position]
    # v of an .obj goes up.
    lines += [f"vt {u} {1 - v}" for u, v in mesh.uv]
    lines += ["f " + " ".join(f"{i}/{i}" for i in corner) for corner in mesh.triangle + 1]
    (tmp_path / "mesh.obj").write_text("\n".join(lines))
    call("atlas", "compress", tmp_path / "mesh.obj", inputs[1], "-o", tmp_path / "out", *QUICK)
    call("atlas", "decode", tmp_path / "out", "-o", tmp_path / "a.exr")
    decoded, _ = read_exr(tmp_path / "a.exr")
    written = load(tmp_path / "out" / "mesh.glb", inputs[1])
    np.testing.assert_allclose(written.uv[written.triangle], mesh.uv[mesh.triangle], atol=1e-6)
    assert np.abs(decoded - mesh.lightmap)[mesh.mask].mean() < 0.1
    call("atlas", "evaluate", tmp_path / "out", "--views", 1, "--resolution", 32)


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_evaluate(kind, inputs, request, tmp_path):
    """The report of the library."""
    folder, options = request.getfixturevalue(kind), {"views": 3, "resolution": 64}
    words = ["--views", 3, "--resolution", 64, "--json", tmp_path / "a.json"]
    text = call("atlas", "evaluate", folder, *words)
    report = json.loads((tmp_path / "a.json").read_text())
    mesh, model = load(*inputs), wlm.load(folder / "atlas.wlm")
    expected = evaluate(model, mesh, **options).to_json()
    assert report.items() >= expected.items() and f"{report['psnr']:.2f}" in text
    assert report["cameras"] == 3 and "evaluate: 3 of 3" in call.stderr
    # One chart has no seam.
    assert (report["seam_ratio"] is None) == (kind == "tiles")


def test_seams_are_the_borders_of_charts(tmp_path):
    """A model with an error at the borders of the lightmap's charts alone."""
    out = tmp_path / "out"
    call("atlas", "compress", *write_files(tmp_path, charts(height=64, width=64)), "-o", out, *QUICK)
    options = ["--views", 3, "--resolution", 256, "--json", tmp_path / "a.json"]
    call("atlas", "evaluate", out, *options)
    before = json.loads((tmp_path / "a.json").read_text())
    assert before["seam_error"] / before["rest_error"] == pytest.approx(before["seam_ratio"])
    model = wlm.load(out / "atlas.wlm")
    assert model.method == "tiles"
    # All becomes brighter by one amount: seams no longer stand out.
    dataclasses.replace(model, texels=model.texels + np.float16(0.5)).save(out / "atlas.wlm")
    call("atlas", "evaluate", out, *options)
    after = json.loads((tmp_path / "a.json").read_text())
    assert after["seam_ratio"] == pytest.approx(1.0, abs=0.05) and after["psnr"] < before["psnr"]


def test_evaluate_looks_for_its_inputs(inputs, tmp_path):
    mesh = charts()
    (tmp_path / "in").mkdir()
    paths = write_files(tmp_path / "in", mesh)
    out = tmp_path / "out"
    call("atlas", "compress", *paths, "-o", out, *QUICK)
    words = ["atlas", "evaluate", out, "--views", 1, "--resolution", 32]
    expected = call(*words)
    os.rename(tmp_path / "in", tmp_path / "moved")
    assert "no such mesh; if it has moved, give --mesh" in fails(*words)
    moved = ["--mesh", tmp_path / "moved" / "mesh.glb"]
    assert "no such lightmap; if it has moved, give --lightmap" in fails(*words, *moved)
    moved += ["--lightmap", tmp_path / "moved" / "light.exr"]
    assert call(*words, *moved) == expected
    # A changed input is refused.
    changed = mesh.lightmap.copy()
    changed[tuple(np.argwhere(mesh.mask)[0])] += 1.0
    write_exr(tmp_path / "moved" / "light.exr", changed)
    assert re.search("made of other inputs than .*light.exr: expected source [0-9a-f]{16}", fails(*words, *moved))
    assert "made of other inputs" in fails(*words, "--mesh", inputs[0], "--lightmap", inputs[1])
    report = json.loads((out / "report.json").read_text())
    del report["inputs"]
    (out / "report.json").write_text(json.dumps(report))
    assert "inputs.mesh: expected a path, found none; give --mesh" in fails(*words)
    assert "expected a name that ends in .json" in fails(*words, "--json", tmp_path / "a.txt")


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_decode_the_lightmap(kind, inputs, request, tmp_path):
    folder, mesh = request.getfixturevalue(kind), load(*inputs)
    text = call("atlas", "decode", folder, "-o", tmp_path / "a.exr")
    expected = wlm.load(folder / "atlas.wlm").decoder().lightmap(mesh)
    decoded, _ = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(decoded, expected.astype(np.float16))
    assert "48x40" in text and np.abs(decoded - mesh.lightmap)[mesh.mask].mean() < 0.1


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_decode_a_view(kind, request, tmp_path):
    folder = request.getfixturevalue(kind)
    words = ["atlas", "decode", folder, "--view", 2, "--views", 5, "--resolution", 48]
    text = call(*words, "-o", tmp_path / "a.exr")
    assert "48x48" in text
    call(*words, "-o", tmp_path / "a.png")
    light, _ = read_exr(tmp_path / "a.exr")
    with Image.open(tmp_path / "a.png") as image:
        picture = np.asarray(image)
    assert picture.shape == (48, 48, 3)
    hit = light.any(axis=2)
    assert 0.02 < hit.mean() < 0.9 and (picture[~hit] == 128).all()
    # Brighter light is a brighter pixel, up to a level: the EXR's halves are rounded, the picture's light isn't.
    order = np.argsort(light[hit][:, 0])
    assert (np.diff(picture[hit][order, 0].astype(int)) >= -1).all()


def test_wrong_words_of_decode(tiles, tmp_path):
    words = ["atlas", "decode", tiles, "-o"]
    assert "a lightmap is written as .exr" in fails(*words, tmp_path / "a.png")
    assert "expected a name that ends in .exr or .png" in fails(*words, tmp_path / "a.dds")
    for option, value in (("--views", 50), ("--resolution", 512)):
        # Also where it is the default of a view.
        text = fails(*words, tmp_path / "a.exr", option, value)
        assert f"{option}: expected with --view alone" in text
    assert "--view: expected 0 to 49, got 50" in fails(*words, tmp_path / "a.exr", "--view", 50)
    assert "--view: expected 0 to 4, got 5" in fails(*words, tmp_path / "a.png", "--view", 5, "--views", 5)
    assert "expected a folder that compress wrote" in fails("atlas", "decode", tmp_path, "-o", tmp_path / "a.exr")
    assert "device 'tpu'" in fails(*words, tmp_path / "a.exr", "--device", "tpu")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", ["tiles", "cascade"])
def test_info(kind, request):
    folder = request.getfixturevalue(kind)
    model, size = wlm.load(folder / "atlas.wlm"), (folder / "atlas.wlm").stat().st_size
    for path in (folder, folder / "atlas.wlm"):
        facts = json.loads(call("atlas", "info", path, "--json"))
        assert (facts["name"], facts["method"], facts["bytes"], facts["size"]) == ("mesh", kind, size, [48, 40])
        assert facts["new_uvs"] == len(model.uv) and facts["profile"]["method"] == kind
    text = call("atlas", "info", folder)
    assert f"{size:,}" in text and f"{model.compression_ratio:.2%}" in text and "48x40" in text
    assert ("the mesh's own" in text) is (kind == "tiles")


def test_info_decodes_nothing(inputs, tmp_path, monkeypatch):
    """No package of an extra is needed; a damaged folder is refused all the same."""
    out = tmp_path / "out"
    call("atlas", "compress", *inputs, "-o", out, *QUICK, "--colour", "astc", "--budget", 0.3)
    monkeypatch.setattr(wlm.atlas.colour, "decode", None)
    assert json.loads(call("atlas", "info", out, "--json"))["colour"] == "astc"
    report = json.loads((out / "report.json").read_text())
    (out / "report.json").write_text(json.dumps(report | {"source": "0" * 16}))
    assert "are not of one run" in fails("atlas", "info", out)
    (out / "report.json").unlink()
    assert "found no report.json of it" in fails("atlas", "info", out)


def test_info_of_a_plain_model(inputs, tmp_path):
    (tmp_path / "plain.yaml").write_text(yaml.safe_dump(CASCADE | {"lut_scale": 0.0, "threshold": 0.0}))
    call("atlas", "compress", *inputs, "-o", tmp_path / "out", "--profile", tmp_path / "plain.yaml")
    assert not list((tmp_path / "out").glob("lut.*"))
    text = call("atlas", "info", tmp_path / "out")
    assert re.search(r"│ table +│ +none │", text) and re.search(r"│ method +│ +plain │", text)
    call("atlas", "evaluate", tmp_path / "out", "--views", 1, "--resolution", 32)
    assert "gone.wlm" in fails("atlas", "info", tmp_path / "gone.wlm")


def test_a_scene_is_one_command(tmp_path):
    """The lightmaps of all its nodes and states become one output, which is then scored."""
    position, triangle, uv = box((0, 0, 0), (6, 3, 5), inward=True)
    path = write_scene(tmp_path / "room.gltf", [Thing("room", position, triangle, [uv])])
    row, column = np.mgrid[:32, :32] / 32
    for name, share in (("day", 1.0), ("night", 0.2)):
        write_exr(tmp_path / f"{name}.exr", (share * (1 + row * column) + (1 - share) * row)[..., None] * [1, 0.9, 0.8])
    (tmp_path / "lights.json").write_text(json.dumps({"sheets": [{"files": ["day.exr", "night.exr"]}]}))
    out = tmp_path / "out"
    text = call("atlas", "compress", path, tmp_path / "lights.json", "-o", out, "--budget", "0.3", "--views", "1")
    assert "scene.glb" in text and "colour_0.dds" in text and wlm.load(out / "scene.wlm").states == ("0", "1")
    text = call("atlas", "evaluate", out, "--views", "2", "--resolution", "32", "--json", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["inside_views"] == 2 and report["psnr"] > 35.0 and "PSNR dB, from inside" in text
    assert "CR of all textures" in call("atlas", "info", out)
    for place in (out, out / "scene.wlm"):
        facts = json.loads(call("atlas", "info", place, "--json"))
        assert facts["states"] == ["0", "1"] and facts["cr"] >= 0.7 and not facts["levels"]
    assert "scene.js" in call("atlas", "export", out, "-o", tmp_path / "three", "--engine", "three")
    assert "--exact: expected with one lightmap" in fails("atlas", "export", out, "-o", tmp_path / "a", "--exact")
    words = ("atlas", "compress", path, tmp_path / "lights.json", "-o", out)
    assert "--colour: expected 'rgb9e5' or 'mixed', got 'half'" in fails(*words, "--colour", "half")
    words += ("--flip",)
    assert "--flip: expected with one lightmap alone" in fails(*words)
    for option in (["--resume"], ["--checkpoint-every", "5"]):
        assert f"{option[0]}: expected with one lightmap alone; a scene's" in fails(*words[:-1], *option)
    assert "the lightmaps of a scene" in fails("atlas", "decode", out, "-o", tmp_path / "a.exr")
    assert "1 page\n" in call("atlas", "info", out).replace(" │", "")


def test_export_for_an_engine_and_in_a_language(tiles, tmp_path):
    out = ["atlas", "export", tiles, "-o", tmp_path / "out"]
    assert "atlas.gdshader" in call(*out, "--engine", "godot")
    assert "atlas.metal" in call(*out, "--shader", "msl")
    assert not (tmp_path / "out" / "atlas.gdshader").exists()
    assert "float3 wlm_atlas(float2 uv) const" in (tmp_path / "out" / "atlas.metal").read_text()
    assert "--shader: means nothing with --engine three" in fails(*out, "--engine", "three", "--shader", "wgsl")
    assert "another folder" in fails("atlas", "export", tiles, "-o", tiles)
