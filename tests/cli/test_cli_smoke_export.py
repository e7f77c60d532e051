"""Flip books for engines from the command line: input, rate, kits, and wrong options."""

import json

import numpy as np
import pytest
from builders.smoke_books import random_frames
from PIL import Image
from typer.testing import CliRunner

from wlm.cli.app import app
from wlm.smoke.data import write_six_way
from wlm.smoke.flipbook.textures import write_flipbook
from wlm.smoke.scene import LightSettings, Looks


def call(*words) -> str:
    result = CliRunner().invoke(app, ["smoke", *map(str, words)])
    assert result.exit_code == 0, result.output
    return result.output


def fails(*words) -> str:
    result = CliRunner().invoke(app, ["smoke", *map(str, words)])
    assert result.exit_code == 2
    return result.output


def info_of(folder) -> dict:
    return json.loads((folder / "bundle.json").read_text())


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """Five frames of a scene of 20 a second, as bake leaves them, of fire with a ramp."""
    folder = tmp_path_factory.mktemp("jet")
    glow = ((0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.5, 0.0))
    for i, six in enumerate(random_frames(), 1):
        looks = Looks(lights=(LightSettings(toward=(1, 1, 1)),), glow=glow, time=i / 20)
        write_six_way(folder / f"six_{i:04d}.exr", six, looks)
    return folder


def test_baked_frames(baked, tmp_path):
    """The rate is that of the scene's frames that are taken; the fire has its ramp."""
    text = call("flipbook", baked, "-o", tmp_path / "all", "--engine", "three")
    assert "2 x 3 cells of 16 x 12, padded by 1" in text and "first.png" in text
    info = info_of(tmp_path / "all")
    assert info["rate"] == pytest.approx(20.0) and info["frames"] == 5 and info["name"] == baked.name
    assert info["extent"][1] == 2.0 and info.get("motion_scale") is None
    assert "vec3(1.0, 0.5, 0.0)" in (tmp_path / "all" / "smoke.glsl").read_text()
    call("flipbook", baked, "-o", tmp_path / "some", "--count", 3, "--shader", "wgsl", "--mips", 2)
    info = info_of(tmp_path / "some")
    assert (info["rate"], info["frames"], info["levels"]) == (pytest.approx(10.0), 3, 2)
    assert info["shader"] == "smoke.wgsl" and "@binding" in (tmp_path / "some" / "smoke.wgsl").read_text()
    call("flipbook", baked, "-o", tmp_path / "some", "--layout", "o3de", "--rate", 12)
    assert info_of(tmp_path / "some")["rate"] == 12.0 and info_of(tmp_path / "some")["layout"] == "o3de"


def test_a_flip_book(tmp_path):
    """A flip book of another layout; its rate and its size in the world are unknown."""
    frames = random_frames(4)
    paths = tmp_path / "a.png", tmp_path / "b.png"
    write_flipbook(paths, frames, "o3de", rows=2, columns=2)
    words = ["flipbook", paths[0], "--with", paths[1], "--cells", "2x2", "--from", "o3de", "--gain", 1]
    call(*words, "-o", tmp_path / "out", "--engine", "unity")
    info = info_of(tmp_path / "out")
    assert (info["rate"], info["extent"][1], info["layout"]) == (25.0, 1.0, "unity")
    with Image.open(tmp_path / "out" / "first.png") as image:
        right = np.asarray(image)[1:13, 1:17, 0] / 255.0
    np.testing.assert_allclose(right, frames[0]["right"], atol=0.51 / 255)


def test_wrong_options_are_one_line(baked, tmp_path):
    book = ["flipbook", baked, "-o", tmp_path / "out"]
    assert "shader and exact have no meaning for a kit" in fails(*book, "--engine", "godot", "--shader", "hlsl")
    assert "layout: expected unity for unity, got o3de" in fails(*book, "--engine", "unity", "--layout", "o3de")
    assert "--layout: expected one of unity, o3de" in fails(*book, "--layout", "godot")
    assert "--rate: expected a number above 0, got 0" in fails(*book, "--rate", 0)
    assert "--gain: expected a number above 0, got nan" in fails(*book, "--gain", "nan")
    textures = ["flipbook", baked, "-o", tmp_path / "a.png"]
    assert "--engine: expected a folder as the output" in fails(*textures, "--engine", "three")
    assert "--shader: expected a folder as the output" in fails(*textures, "--shader", "wgsl")
    assert not list(tmp_path.iterdir())
