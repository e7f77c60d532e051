"""`wlm run` and `wlm smoke run`: pictures, a film and a report of a scene."""

import json
import os
import sys

import numpy as np
import pytest
import yaml
from builders import day_scenes
from builders.running import call, fails, png
from builders.smoke_plumes import SCENE, SPHERE
from PIL import Image

import wlm
from wlm.formats.film import film
from wlm.inspection import inspect
from wlm.smoke.codec import shipped
from wlm.view import scene_run


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return day_scenes.write_scene(tmp_path_factory.mktemp("room"))


SMALL = ("--width", 64, "--height", 36, "--samples", 1)


def test_run_writes_pictures_a_film_and_a_report(room, tmp_path):
    out = tmp_path / "out"
    text = call("run", room, "-o", out, *SMALL, "--frames", 4, "--hours", "7,18.75")
    assert "milliseconds of a frame" in text and "lightmaps: texture" in text and "PSNR" in text
    assert {path.name for path in out.iterdir()} == set("film.webp report.json view_07_00h.png view_18_75h.png".split())
    assert png(out / "view_07_00h.png").shape == (36, 64, 3)
    with Image.open(out / "film.webp") as film:
        assert 1 < film.n_frames <= 4 and film.size == (64, 36)
    report = json.loads((out / "report.json").read_text())
    assert report["film"] == {"file": "film.webp", "frames": 4, "rate": 1.0}
    assert [view["hour"] for view in report["views"]] == [12.0, 22.0]
    assert all(view["psnr"] > 38.0 and view["flip"] < 0.03 for view in report["views"])
    assert report["current"]["least"] == 1.0 and report["frame_ms"]["total"]["most"] > 0.0
    assert report["decoded"]["most"] >= 1 and report["memory"]["probes: volume"] > 0
    assert "that wlm run wrote" in inspect(out)[0].what + inspect(out / "report.json")[0].what


def test_a_second_run_replaces_the_first_and_weights_change_it(room, tmp_path):
    out = tmp_path / "out"
    call("run", room, "-o", out, *SMALL, "--frames", 1, "--hours", "12")
    first = png(out / "view_12_00h.png").astype(int)
    call("run", room, "-o", out, *SMALL, "--frames", 0, "--hours", "12", "--weight", "sun=0", "--colour", "sky=1,0,0")
    second = png(out / "view_12_00h.png").astype(int)
    assert sorted(path.name for path in out.iterdir()) == ["report.json", "view_12_00h.png"]
    assert (second[-3, 32] < first[-3, 32] - 20).all() and (second[-3, 32, 1:] == 0).all() and second[-3, 32, 0] > 40
    assert json.loads((out / "report.json").read_text())["views"][0]["psnr"] < 30.0


def test_errors_are_one_line_and_leave_no_folder(room, tmp_path):
    out = tmp_path / "out"
    assert "expected --output DIR, or --window" in fails("run", room)
    assert "--samples has no meaning with --window" in fails("run", room, "--window", "--samples", 1)
    assert "expected a group among sky, sun" in fails("run", room, "-o", out, "--weight", "lamp=1")
    assert "hours: expected hours that differ" in fails("run", room, "-o", out, "--hours", "7.001,12,7.004")
    missing = day_scenes.write_file(room.with_name("missing.yaml"), light="none.wlm")
    assert "light: there is no file" in fails("run", missing, "-o", out)
    (room.parent / "smoke" / "bad").mkdir()
    bad = room.parent / "smoke" / "bad" / "six_0001.exr"
    bad.write_bytes((room.parent / "smoke" / "six_0001.exr").read_bytes()[:-40])
    smoke = [{"files": "smoke/bad", "position": [0, 0, 0], "size": 1, "rate": 1}]
    assert str(bad) in fails("run", day_scenes.write_file(room.with_name("bad.yaml"), smoke=smoke), "-o", out)
    assert not out.exists()
    out.mkdir()
    (out / "mine.txt").touch()
    assert "found other files" in fails("run", room, "-o", out, *SMALL)


def test_the_report_of_a_stopped_run_says_so(room, tmp_path):
    def stop(_):
        raise KeyboardInterrupt

    with wlm.scene.load(room) as scene, pytest.raises(KeyboardInterrupt):
        scene_run.run(scene, tmp_path / "out", height=36, width=64, samples=1, frames=0, hours=[7.0], progress=stop)
    assert json.loads((tmp_path / "out" / "report.json").read_text())["unfinished"]


HOT = {"extinction": 8.0, "albedo": [0.9, 0.8, 0.6], "emission": 3.0, "glow": [[0, 0, 0, 0], [0.5, 2, 0.5, 0]]}


@pytest.fixture
def scene(tmp_path):
    inlet = SCENE["inlets"][0] | {"temperature": 1.0}
    path = tmp_path / "scene.yaml"
    camera = {"resolution": 24, "aspect": 1.25}
    changed = {"smoke": HOT, "inlets": [inlet], "obstacles": [SPHERE], "camera": camera, "background": [0, 0.1, 0]}
    path.write_text(yaml.safe_dump(SCENE | changed))
    return path


def test_run_is_what_its_stages_are_one_by_one(scene, tmp_path):
    text = call("smoke", "run", scene, "-o", tmp_path / "run", "--orders", "single")
    assert sorted(os.listdir(tmp_path / "run")) == [f"run_{n:04d}.png" for n in (1, 2, 3)]
    for stage in ("simulation", "lightmaps", "shadows and picture", "bytes", "writing"):
        assert stage in text
    call("smoke", "simulate", scene, "-o", tmp_path / "frames")
    call("smoke", "predict", tmp_path / "frames", "-o", tmp_path / "six")
    call("smoke", "shade", tmp_path / "six", "-o", tmp_path / "shaded")
    for number in (1, 2, 3):
        made = png(tmp_path / "run" / f"run_{number:04d}.png")
        staged = png(tmp_path / "shaded" / f"shade_{number:04d}.png")
        assert made.shape == (24, 30, 3) and made.max() > 100
        # Half floats; and at a few pixels the surface's depth, in jittered steps, on another side of an obstacle.
        error = np.abs(made - staged)
        assert (error > 2).mean() < 0.02, number
    call("smoke", "run", scene, "-o", tmp_path / "net", "--network", shipped(), "--frames", 1)
    assert np.abs(png(tmp_path / "net" / "run_0001.png") - png(tmp_path / "run" / "run_0001.png")).mean() < 10


@pytest.mark.slow
def test_run_has_light_of_all_orders(scene, tmp_path):
    """The pictures equal those of `light` and are brighter than single scattering."""
    two = ("--frames", 2)
    text = call("smoke", "run", scene, "-o", tmp_path / "run", *two)
    assert "light of all orders" in text and "shadows and picture" in text
    call("smoke", "simulate", scene, "-o", tmp_path / "frames", *two)
    call("smoke", "light", tmp_path / "frames", "-o", tmp_path / "lit")
    for number in (1, 2):
        made, staged = (png(tmp_path / f"{name}_{number:04d}.png") for name in ("run/run", "lit/light"))
        # Frames on disk are half floats.
        assert np.abs(made - staged).max() <= 3, number
    call("smoke", "run", scene, "-o", tmp_path / "once", "--orders", "single", *two)
    call("smoke", "run", scene, "-o", tmp_path / "dark", "--albedo", "0.2", "--resolution", 10, *two)
    once, dark = (png(tmp_path / name / "run_0002.png") for name in ("once", "dark"))
    assert made.mean() > once.mean() + 1 and dark.shape == (10, 12, 3) and dark.mean() < once.mean()


def test_what_run_refuses(scene, tmp_path, monkeypatch):
    out = tmp_path / "a"
    assert "--white: expected a number above 0" in fails("smoke", "run", scene, "-o", out, "--white", 0)
    for words, line in (
        (("--orders", "two"), "--orders"),
        (("--orders", "all", "--network", "a.safetensors"), "--network: expected --orders single"),
        (("--albedo", "0.5,2,1"), "--albedo: expected numbers of 0 to 1"),
    ):
        assert line in fails("smoke", "run", scene, "-o", out, *words)
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(SCENE | {"camera": {"perspective": True}}))
    single = ("--orders", "single")
    assert "expected false for six-way lightmaps" in fails("smoke", "run", tmp_path / "b.yaml", "-o", out, *single)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    call("smoke", "run", scene, "-o", tmp_path / "a.mp4", "--frames", 1, "--resolution", 14, code=2)  # 17 wide
    *warnings, last = call.stderr.splitlines()
    assert "pip install 'wlm[film]'" in last and all("thinner than a cell" in line for line in warnings)
    odd = ("--resolution", 9)
    call("smoke", "run", scene, "-o", tmp_path / "a.mp4", *odd, code=2)
    assert "expected frames of even width and height" in call.stderr.splitlines()[-1]
    assert sorted(os.listdir(tmp_path)) == ["b.yaml", "scene.yaml"]


def test_film(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "a.mp4"
    with film(path, 32, 48, 25.0) as add:
        for level in (0, 120, 240):
            add(np.full((32, 48, 3), level, np.uint8))
    frames = ffmpeg.read_frames(str(path))
    facts = next(frames)
    assert facts["size"] == (48, 32) and facts["fps"] == 25.0
    levels = [np.frombuffer(frame, np.uint8).mean() for frame in frames]
    np.testing.assert_allclose(levels, [0, 120, 240], atol=6)
    before = path.read_bytes()
    with pytest.raises(KeyError), film(path, 32, 48, 25.0):
        raise KeyError
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.mp4"]
