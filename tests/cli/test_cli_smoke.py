"""Volumes and frames from the command line: baked, predicted, shaded."""

import json
import os
import re

import numpy as np
import pytest
import torch
from builders.running import call, fails, png
from builders.smoke_plumes import SPHERE, plume, write_frames

from wlm.fluid.volume import load_volume, save_volume
from wlm.formats.exr import read_planes
from wlm.smoke.data import load_frames, read_shaded, read_six_way
from wlm.smoke.frames import _METHODS
from wlm.smoke.lightmaps import axis_faults
from wlm.smoke.march.six_way import bake, with_surface
from wlm.smoke.scene import CameraSettings, LightSettings, make_camera
from wlm.view.pictures import to_bytes
from wlm.view.smoke import picture

LIGHT = LightSettings(toward=(1, 1, 1)).light()
SMALL = ("--resolution", 20, "--step", 1)


@pytest.fixture(scope="session")
def frames(tmp_path_factory):
    """Three frames of a plume with a moving sphere."""
    return write_frames(tmp_path_factory.mktemp("frames") / "a", obstacles=[SPHERE]).path


@pytest.fixture(scope="session")
def baked(frames, tmp_path_factory):
    folder = tmp_path_factory.mktemp("baked") / "six"
    call("smoke", "bake", frames, "-o", folder, *SMALL)
    return folder


def camera_of(volume, **settings):
    size = volume.voxel * np.array(volume.shape)
    return make_camera(CameraSettings(**{"resolution": 20} | settings), volume.origin, size)


@pytest.mark.parametrize(
    ("words", "method", "other"),
    [
        (["bake", "--step", 1], "bake", ["--step", 2]),
        pytest.param(["predict"], "coarse", ["--seed", 7], marks=pytest.mark.slow),
    ],
)
def test_frames_that_were_made_are_not_made_again(words, method, other, frames, tmp_path, monkeypatch):
    words = ["smoke", words[0], frames, *words[1:], "--resolution", 8]
    whole, out = tmp_path / "whole", tmp_path / "out"
    call(*words, "-o", whole)
    make, made = _METHODS[method], []

    def interrupted(*args, **options):
        made.append(1)
        if len(made) == 3:
            raise KeyboardInterrupt
        return make(*args, **options)

    monkeypatch.setitem(_METHODS, method, interrupted)
    call(*words, "-o", out, code=130)
    assert f"stopped at frame 2: repeat the command with --resume to continue from {out}/six.partial" in call.stderr
    names = ["six_0001.exr", "six_0002.exr", "six.partial"]
    assert sorted(os.listdir(out)) == sorted(names)
    before = [(out / name).stat().st_mtime_ns for name in names[:2]]
    turned = (["--camera", "turn=5"], "cannot resume a run with another camera")
    for change, says in ((other, "six.partial: cannot resume a run with another"), turned):
        assert says in fails(*words, *change, "-o", out, "--resume")
    stat = (frames / "frame_0003.npz").stat()
    os.utime(frames / "frame_0003.npz", ns=(0, 0))
    assert "cannot resume a run with another input" in fails(*words, "-o", out, "--resume")
    os.utime(frames / "frame_0003.npz", ns=(stat.st_atime_ns, stat.st_mtime_ns))
    call(*words, "-o", out, "--resume")
    assert len(made) == 4 and "2 frames are finished" in call.stderr
    assert [(out / name).stat().st_mtime_ns for name in names[:2]] == before
    assert sorted(os.listdir(out)) == sorted(os.listdir(whole))
    for path in whole.iterdir():
        assert path.read_bytes() == (out / path.name).read_bytes()
    call(*words, "-o", out, "--resume")
    assert len(made) == 7 and "there is nothing to resume" in call.stderr
    line = fails(*words[:2], frames / "frame_0001.npz", "-o", tmp_path / "a.exr", "--resume")
    assert "--resume: expected a folder of frames" in line


def test_bake(volume, tmp_path):
    out = tmp_path / "b.exr"
    text = call("smoke", "bake", volume, "-o", out, *SMALL, "--supersample", 2, "--g", 0.3, "--volume", "emission=2")
    loaded = load_volume(volume, emission=2.0)
    camera = camera_of(loaded)
    expected = bake(loaded, camera, step=1.0, supersample=2, g=0.3)
    result = read_six_way(out)
    assert result.camera == camera
    for name in ("lightmaps", "transparency", "emission"):
        torch.testing.assert_close(getattr(result, name), getattr(expected, name).half().float(), rtol=0, atol=0)
    assert f"{expected.error.largest:.2g}" in text and f"{expected.error.rms:.2g}" in text
    settings = ("toward=1,0,0", "turn=90", "distance=0.1", "extent=0.5")
    words = [word for setting in settings for word in ("--camera", setting)]
    call("smoke", "bake", volume, "-o", out, *words, "--resolution", 8)
    camera = read_planes(out)[1]["camera"]
    assert (camera["height"], camera["extent"]) == (8, 0.5)
    np.testing.assert_allclose(camera["toward"], [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(camera["position"], [0, 0.6, -0.1], atol=1e-9)


def test_bake_of_frames(frames, baked, tmp_path):
    assert sorted(os.listdir(baked)) == [f"six_{i:04d}.exr" for i in (1, 2, 3)]
    six = read_six_way(baked / "six_0003.exr")
    assert axis_faults(six.lightmaps) == () and six.emission is None
    (tmp_path / "other.txt").write_text("x")
    assert "found other.txt" in fails("smoke", "bake", frames, "-o", tmp_path)
    assert "another folder than that of the frames" in fails("smoke", "bake", frames, "-o", frames)


def test_every_route_keeps_the_scene(tmp_path):
    """Lights, background, glow, obstacles and shadows are those of the scene, however the lightmaps were made."""
    lights = [{"toward": [1, 0, 1], "irradiance": [20, 2, 2]}, {"toward": [-1, 1, 0], "irradiance": [0, 0, 30]}]
    looks = {"lights": lights, "background": [0.0, 0.2, 0.0], "obstacles": [SPHERE | {"colour": [0.5, 0.5, 0.1]}]}
    smoke = {"extinction": 8.0, "emission": 2.0, "glow": [[0, 0, 0, 0], [1, 3, 1, 0]], "albedo": [0.9, 0.5, 0.7]}
    folder, small = write_frames(tmp_path / "a", smoke=smoke, frames=2, **looks).path, CameraSettings(resolution=20)
    for number in (1, 2):
        save_volume(folder / f"frame_{number:04d}.npz", plume(number + 1, hot=True))
    for name, words in {"bake": ["bake", "--step", 1], "coarse": ["predict"]}.items():
        call("smoke", *words, folder, "-o", tmp_path / name, "--resolution", 20)
        call("smoke", "shade", tmp_path / name, "-o", tmp_path / f"{name}_s")
    scene = load_frames(folder)
    for number in (1, 2):
        volume, looks = scene.load(number), scene.looks(number)
        six = with_surface(bake(volume, scene.view(small, volume), step=1.0, estimate=False), volume, looks)
        extra = {"obstacles": looks.obstacles, "time": looks.time, "ramp": looks.ramp, "albedo": looks.albedo}
        given = [settings.light() for settings in looks.lights]
        expected = np.int32(to_bytes(picture(six, given, background=looks.background, **extra)))
        for name in ("bake", "coarse"):
            # Half floats, and for `predict` the steps of its march.
            error = np.abs(np.int32(png(tmp_path / f"{name}_s" / f"shade_{number:04d}.png")) - expected)
            assert error.max() <= 1 if name == "bake" else (error.mean() < 2 and error.max() < 40), name
    # One file has them too.
    call("smoke", "shade", tmp_path / "bake" / "six_0002.exr", "-o", tmp_path / "one.png")
    np.testing.assert_array_equal(png(tmp_path / "one.png"), png(tmp_path / "bake_s" / "shade_0002.png"))
    call("smoke", "predict", folder, "-o", tmp_path / "network", "--resolution", 20)
    six, kept = read_shaded(tmp_path / "network" / "six_0002.exr")
    assert kept == load_frames(folder).scene.looks(2) and bool((six.depth > 0).any())
    assert kept.albedo == (0.9, 0.5, 0.7)
    # What has light of all orders has its albedo.
    words = ("--fit", "sphere", "--albedo", 0.8, "--step", 4, "--resolution", 8)
    call("smoke", "bake", folder, "-o", tmp_path / "sphere", *words)
    assert read_shaded(tmp_path / "sphere" / "six_0002.exr")[1] == kept.model_copy(update={"albedo": (1.0, 1.0, 1.0)})


def test_wrong_words_are_one_line(volume, frames, baked, tmp_path):
    out = tmp_path / "a.exr"
    made = ("smoke", "bake", volume, "-o", out)
    for text, line in (
        ("toward=0,0,0", "--camera toward: expected a direction other than 0, 0, 0"),
        ("resolution=8", "--camera: expected NAME=VALUE with a name of toward"),
    ):
        assert line in fails(*made, "--camera", text)
    line = fails("smoke", "bake", frames, "-o", out, "--volume", "up=z")
    assert "option up: applies only to files of other programs" in line
    shaded = ("smoke", "shade", baked / "six_0001.exr", "-o", tmp_path / "a.png")
    assert "--light: irradiance.0: expected greater than or equal to 0" in fails(*shaded, "--light", "0,0,1:-1")
    for smoke in (volume, frames, tmp_path):
        assert "wlm smoke bake or predict makes them" in fails("smoke", "shade", smoke, "-o", tmp_path / "x")
    assert os.listdir(tmp_path) == []


def test_a_scenes_camera_in_perspective(tmp_path):
    folder = write_frames(tmp_path / "a", camera={"resolution": 8, "perspective": True}).path
    assert "perspective: expected false for six-way" in fails("smoke", "bake", folder, "-o", tmp_path / "b")


def test_a_damaged_frame_is_named(tmp_path):
    folder = write_frames(tmp_path / "a").path
    (folder / "frame_0002.npz").write_bytes(b"x")
    call("smoke", "bake", folder, "-o", tmp_path / "g", "--resolution", 4, code=2)
    assert re.search(r"^error: .*frame_0002.npz: cannot read", call.stderr, re.MULTILINE)
    content = json.loads((folder / "scene.json").read_text())
    (folder / "scene.json").write_text(json.dumps(content | {"version": 2}))
    assert "version: expected 1, found 2" in fails("smoke", "bake", folder, "-o", tmp_path / "g")
