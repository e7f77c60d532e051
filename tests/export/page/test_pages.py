"""Pages: what they carry, what a page can't be made of, and those of three.js that tutorials print, in Chromium."""

import base64
import dataclasses
import hashlib
import io
import json
import re
import shlex
import zlib

import numpy as np
import pytest
import torch
import yaml
from builders import atlas_meshes, day_scenes, probe_models, small_sets
from builders.checks import error_of
from builders.contract import FILES
from builders.running import call
from PIL import Image
from typer.testing import CliRunner

import wlm
from demos.tutorials import ROOT, steps
from wlm.cli.app import app
from wlm.errors import WlmError
from wlm.export.page.html import Page
from wlm.export.page.pages import make_page, write_page
from wlm.formats.exr import write_exr
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.smoke.camera import Camera
from wlm.smoke.data import write_six_way
from wlm.smoke.lightmaps import SixWay


def parts(path) -> tuple[dict, bytes]:
    """The manifest of a page and its unpacked content."""
    text = path.read_text(encoding="utf-8")
    manifest, content = re.findall(r'<script id="(?:manifest|content)" type="[a-z/]+">(.*?)</script>', text, re.S)
    return json.loads(manifest), zlib.decompress(base64.b64decode(content))


def test_a_page_carries_its_arrays_whole(tmp_path):
    arrays = {"a": np.arange(5, dtype=np.uint8), "b": np.linspace(0, 1, 7, dtype=np.float32), "none": np.zeros(0, "u1")}
    page = Page("smoke", "a name", "", [("file", "5 bytes")], {"width": 3}, arrays)
    assert page.write(tmp_path / "page.html") == (tmp_path / "page.html").stat().st_size
    manifest, content = parts(tmp_path / "page.html")
    assert manifest["width"] == 3 and manifest["bytes"] == len(content)
    for name, values in arrays.items():
        start, length = manifest["arrays"][name]
        assert start % 16 == 0
        np.testing.assert_array_equal(np.frombuffer(content[start : start + length], values.dtype), values)


def test_a_name_is_text_and_never_a_script(tmp_path):
    name = "</script><script>alert(1)</script> @CONTENT@ \u202e"
    Page("smoke", name, name, [(name, name)], {}).write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text
    assert parts(tmp_path / "page.html")[0]["title"] == name
    script = re.search("<script>(.*?)</script>", text, re.S)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; script-src 'sha256-{digest}'" in text, "no other script runs"


def test_a_page_loads_nothing_from_elsewhere(tmp_path):
    write_page(tmp_path / "page.html", [FILES / "lightmap.wlm"])
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|import\s|fetch\(|XMLHttp| src=", text)


def test_shared_exponents_are_within_half_a_step():
    random = np.random.default_rng(0)
    light = random.random((4000, 3)) * 2.0 ** random.integers(-18, 16, (4000, 1))
    light[:4] = [[0, 0, 0], [1e9, 0, 1], [65408, 65408, 65408], [1e-12, 0, 0]]
    codes = pack_rgb9e5(light).astype(np.int64)
    exponent = codes >> 27
    back = np.stack([codes >> shift & 511 for shift in (0, 9, 18)], 1) * 2.0 ** (exponent - 24)[:, None]
    expected = np.minimum(light, 65408.0)
    assert (np.abs(back - expected) <= expected.max(1, keepdims=True) / 512 + 2.0**-25).all()


def test_frames_of_the_original_are_spread_over_the_day(tmp_path):
    lightmaps = small_sets.moving_light()
    wlm.lightmap.compress(lightmaps, small_sets.tiny_profile()).save(tmp_path / "city.wlm")
    folder = tmp_path / "set"
    small_sets.write_set(folder, lightmaps)
    reports = []
    page = make_page([tmp_path / "city.wlm"], original=folder, hours=3, progress=reports.append)
    assert page.manifest["reference"]["times"] == [lightmaps.times[i] for i in (0, 2, 4)]
    assert page.manifest["time"] == lightmaps.times[2] and reports[-1].done == reports[-1].total == 3
    assert ((page.arrays["mask"] > 0) == lightmaps.light.mask).all()
    assert sorted(name for name in page.arrays if name.startswith("original")) == [f"original_{i}" for i in range(3)]


def test_what_has_no_page_is_said_in_one_line(tmp_path):
    probe_models.whole_model(positions=False).save(tmp_path / "probe.wlm")
    probe_models.whole_model(outputs=5, positions=True).save(tmp_path / "five.wlm")
    write_exr(tmp_path / "day.exr", np.ones((4, 4, 3), np.float32))
    for files, options, said in (
        ([FILES / "smoke.wlm"], {}, "no picture of its own"),
        ([FILES / "lightmap.wlm"], {"key": "sh"}, "--key"),
        ([FILES / "lightmap.wlm"], {"rate": 20.0}, "--rate has no meaning for this file"),
        ([tmp_path / "probe.wlm"], {}, "--original"),
        ([tmp_path / "five.wlm"], {}, "spherical harmonics"),
        ([tmp_path], {}, "expected a .wlm file"),
        ([tmp_path / "day.exr"], {}, "day.exr: expected a .wlm"),
    ):
        with pytest.raises(WlmError, match=re.escape(said)) as caught:
            make_page(files, **options)
        assert "\n" not in str(caught.value)


def test_the_scores_of_a_page_are_those_of_evaluate(tmp_path):
    lightmaps = small_sets.moving_light()
    model = wlm.lightmap.compress(lightmaps, small_sets.tiny_profile())
    model.save(tmp_path / "city.wlm")
    small_sets.write_set(tmp_path / "set", lightmaps)
    page = make_page([tmp_path / "city.wlm"], original=tmp_path / "set", hours=3)
    expected = wlm.lightmap.evaluate(model, lightmaps, metrics=("psnr",)).light.psnr_by_time[[0, 2, 4]]
    np.testing.assert_allclose(page.manifest["reference"]["psnr"], expected)
    probes = probe_models.whole_model(positions=True)
    probes.save(tmp_path / "probe.wlm")
    values = np.random.default_rng(0).random((probes.probes, 9, 3), np.float32)
    values[probes.dead] = 0.0
    np.savez(tmp_path / "probes.npz", position=probes.stored_positions(), sh=values)
    page = make_page([tmp_path / "probe.wlm"], original=tmp_path / "probes.npz")
    score = wlm.probe.evaluate(probes, wlm.probe.load(tmp_path / "probes.npz")).psnr
    assert dict(page.figures)["PSNR of coefficients"] == f"{score:.2f} dB"
    mesh = atlas_meshes.charts()
    baked = wlm.atlas.compress(mesh, wlm.atlas.Profile(name="tiny", views=2))
    baked.save(tmp_path / "room.wlm")
    page = make_page([tmp_path / "room.wlm"], original=atlas_meshes.write_files(tmp_path, mesh)[1])
    score = wlm.atlas.evaluate(baked, mesh, views=4, resolution=64).texel_psnr  # its peak is that of the views
    assert abs(float(dict(page.figures)["PSNR of texels"].split()[0]) - score) < 0.2


def test_a_dark_hour_has_no_score_and_its_page_is_made(tmp_path):
    lightmaps = small_sets.moving_light(hours=(0.0, 6.0))
    model = wlm.lightmap.compress(lightmaps, small_sets.tiny_profile())
    model.save(tmp_path / "city.wlm")
    lightmaps.light.frames[1] = 0.0
    small_sets.write_set(tmp_path / "set", lightmaps)
    write_page(tmp_path / "page.html", [tmp_path / "city.wlm"], original=tmp_path / "set")
    scores = parts(tmp_path / "page.html")[0]["reference"]["psnr"]
    assert scores[0] > 0 and scores[1] is None


def test_frames_of_smoke_are_of_one_size(tmp_path):
    for name, size in (("a_1", 8), ("a_2", 4)):
        camera = Camera.look_at((0.0, 0.0, 1.0), np.zeros(3), extent=1.0, height=size, width=size)
        planes = torch.rand(7, size, size)
        write_six_way(tmp_path / f"{name}.exr", SixWay(planes[:6], planes[6], camera=camera))
    with pytest.raises(WlmError, match="expected 8x8 pixels as the first frame, found 4x4"):
        make_page([tmp_path / "a_1.exr", tmp_path / "a_2.exr"])
    assert "--rate" in error_of(make_page, [tmp_path / "a_1.exr"], rate=0.0)
    assert make_page([tmp_path / "a_1.exr"]).title == "a_1"
    (tmp_path / "a_2.exr").write_bytes((tmp_path / "a_1.exr").read_bytes())
    folder, files = make_page([tmp_path]), make_page([tmp_path / "a_1.exr", tmp_path / "a_2.exr"])
    assert folder.manifest == files.manifest and folder.title == files.title == tmp_path.name


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return day_scenes.write_scene(tmp_path_factory.mktemp("room"))


def test_a_scene_carries_the_light_where_it_is_used(room, tmp_path):
    page = make_page([room])
    scene, arrays = page.manifest["scene"], page.arrays
    assert (page.kind, page.title, page.manifest["time"]) == ("scene", "a room", 12.0)
    for group in page.manifest["groups"]:
        np.testing.assert_allclose(group["lightmap"]["switches"], [[18.45, 18.55]], atol=1e-6)
    assert scene["probe_hours"] == [0.0, 12.0] and page.manifest["reference"]["times"] == [12.0, 22.0]
    assert min(page.manifest["reference"]["psnr"]) > 50, "the groups are added"
    # Even light: the first coefficient alone, at all places.
    for name, places in (("moving_0_light", scene["moving"][0]["places"]), ("smoke_0_light", 1)):
        light = arrays[name].reshape(2, places, 9, 3)
        expected = np.sqrt(4 * np.pi) * np.array(list(day_scenes.LIGHT.values()))
        np.testing.assert_allclose(light[:, :, 0], np.broadcast_to(expected[:, None, None], (2, places, 3)), rtol=0.01)
        assert np.abs(light[:, :, 1:]).max() < 0.01
    codes = arrays["first"][[50, 50], [20, 200]].astype(np.int64)
    back = np.stack([codes >> shift & 511 for shift in (0, 9, 18)], 1) * 2.0 ** ((codes >> 27) - 24)[:, None]
    np.testing.assert_allclose(back, (day_scenes.SKY + day_scenes.SUN)[:, 2], rtol=0.01)
    with wlm.scene.load(room) as loaded:
        at = scene["path_rate"] * 3
        np.testing.assert_allclose(arrays["path"][at], np.hstack(loaded.camera_at(3.0)), rtol=1e-6)
    arrays = page.arrays | {f"again_{name}": values for name, values in page.arrays.items()}
    size = page.write(tmp_path / "page.html")
    dataclasses.replace(page, arrays=arrays).write(tmp_path / "twice.html")
    assert (tmp_path / "twice.html").stat().st_size < 1.1 * size, "equal arrays are stored once"


def test_a_scene_without_objects_and_originals_has_a_page(room, tmp_path):
    path = room.with_name("bare.yaml")
    text = yaml.safe_load(room.read_text())
    path.write_text(yaml.safe_dump({k: v for k, v in text.items() if k in ("title", "mesh", "light", "sky", "camera")}))
    result = CliRunner().invoke(app, ["web", str(path), "-o", str(tmp_path / "page.html")])
    assert result.exit_code == 0, result.output
    manifest, _ = parts(tmp_path / "page.html")
    assert manifest["scene"]["moving"] == manifest["scene"]["smoke"] == manifest["scene"]["probe_hours"] == []
    assert "reference" not in manifest


def test_what_a_scene_lacks_is_said_in_one_line(room, tmp_path):
    small = room.with_name("small_12.00h.exr")
    write_exr(small, np.ones((4, 4, 3), np.float32))
    for changes, said in (
        ({"originals": [small.name]}, "small_12.00h.exr: expected a lightmap of 247x108, found 4x4"),
        ({"mesh": "absent.glb"}, "mesh: there is no file"),
        ({"speed": 2}, "speed"),
    ):
        path = room.with_name("changed.yaml")
        path.write_text(yaml.safe_dump(yaml.safe_load(room.read_text()) | changes))
        with pytest.raises(WlmError, match=re.escape(said)) as caught:
            write_page(tmp_path / "page.html", [path])
        assert "\n" not in str(caught.value) and not (tmp_path / "page.html").exists()
    assert "--mesh has no meaning" in error_of(make_page, [room], mesh=room.with_name("room.glb"))


def test_the_command_writes_a_page_of_a_folder(tmp_path):
    mesh = atlas_meshes.sheet()
    model = wlm.atlas.compress(mesh, wlm.atlas.Profile(name="tiny", views=2))
    model.save(tmp_path / "sheet.wlm")
    result = CliRunner().invoke(app, ["web", str(tmp_path / "sheet.wlm"), "-o", str(tmp_path / "page.html")])
    assert result.exit_code == 0, result.output
    manifest, _ = parts(tmp_path / "page.html")
    assert manifest["kind"] == "atlas" and dict(manifest["figures"])["profile"] == "tiny"


def test_the_command_without_files_writes_a_viewer(tmp_path):
    said = CliRunner().invoke(app, ["web", "--time", "12", "-o", str(tmp_path / "viewer.html")])
    assert said.exit_code and "--time: has no meaning for a viewer" in said.output
    assert not (tmp_path / "viewer.html").exists()
    result = CliRunner().invoke(app, ["web", "-o", str(tmp_path / "viewer.html")])
    assert result.exit_code == 0, result.output
    assert parts(tmp_path / "viewer.html")[0]["kind"] == "viewer"


NEEDED = {
    "bake": ("wlm compress demos/data/cornell", "wlm export room.wlm -o room-three"),
    "smoke": ("wlm smoke simulate", "wlm smoke bake", "wlm smoke flipbook six -o puff-three"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NEEDED)
def test_the_page_shows_light(name, tmp_path, monkeypatch, visit):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    for kind, text in steps(ROOT / "docs" / "tutorials" / f"{name}.md"):
        if text.startswith(NEEDED[name]):
            call(*shlex.split(text)[1:])
        elif kind not in ("command", "python"):
            (tmp_path / kind).write_text(text, encoding="utf-8")
    page = visit(tmp_path, "document.querySelector('canvas')", viewport={"width": 320, "height": 240})
    page.wait_for_timeout(4000)
    shown = np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=200_000))).convert("L"), np.float32)
    # Without light, below the slider, the pages have one colour.
    assert shown[60:].std() > 5.0
