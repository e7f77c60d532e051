"""`wlm run`: pictures, a film and a report of a scene."""

import json

import pytest
from builders import day_scenes
from builders.running import call, fails, png
from PIL import Image

from wlm.inspection import inspect


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return day_scenes.write_scene(tmp_path_factory.mktemp("room"))


SMALL = ("--width", 64, "--height", 36, "--samples", 1)


def test_run_writes_pictures_a_film_and_a_report(room, tmp_path):
    out = tmp_path / "out"
    text = call("run", room, "-o", out, *SMALL, "--frames", 4, "--hours", "7,18.75")
    assert "milliseconds of a frame" in text and "lightmaps: texture" in text and "PSNR" in text
    assert sorted(path.name for path in out.iterdir()) == [
        "film.webp",
        "report.json",
        "view_07_00h.png",
        "view_18_75h.png",
    ]
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
