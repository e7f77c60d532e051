"""`wlm smoke run`."""

import os
import sys

import numpy as np
import pytest
import yaml
from builders.running import call, fails, png
from builders.smoke_plumes import SCENE, SPHERE

from wlm.formats.film import film
from wlm.smoke.codec import shipped

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
    call("smoke", "run", scene, "-o", tmp_path / "a.mp4", "--frames", 1, code=2)
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
