"""`wlm smoke flipbook`, and flip books of other programs as inputs of `shade` and `flipbook`."""

import json

import numpy as np
import pytest
import torch
from builders.running import call, fails
from builders.smoke_books import random_frames
from PIL import Image

from wlm.inspection import inspect
from wlm.smoke.camera import Camera
from wlm.smoke.data import write_six_way
from wlm.smoke.flipbook.book import Shot, pack_book, write_book
from wlm.smoke.flipbook.reading import read_flipbook
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import LightSettings, Looks
from wlm.smoke.shading import Light

SIZE = 16


def info_of(folder) -> dict:
    return json.loads((folder / "bundle.json").read_text())


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """Writes five frames of burning smoke at 20 frames a second, like bake."""
    folder = tmp_path_factory.mktemp("jet")
    glow = ((0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.5, 0.0))
    for i, six in enumerate(random_frames(), 1):
        looks = Looks(lights=(LightSettings(toward=(1, 1, 1)),), glow=glow, time=i / 20)
        write_six_way(folder / f"six_{i:04d}.exr", six, looks)
    return folder


@pytest.fixture
def frames() -> list[SixWay]:
    """Makes four frames of smoke in a disc, with premultiplied light."""
    rows, columns = np.mgrid[:SIZE, :SIZE] / (SIZE - 1.0) - 0.5
    opacity = torch.tensor(np.clip(1.2 - 3.0 * np.hypot(rows, columns), 0.0, 1.0), dtype=torch.float32)
    random = np.random.default_rng(0)
    maps = torch.tensor(random.uniform(0.2, 0.9, (4, 6, 1, 1)), dtype=torch.float32)
    camera = Camera.look_at((0.0, 0.0, 1.0), np.zeros(3), extent=1.0, height=SIZE, width=SIZE)
    return [SixWay(one * opacity, 1.0 - opacity, camera=camera) for one in maps]


def write(frames, layout, path):
    book = pack_book([Shot(n, frame) for n, frame in enumerate(frames, 1)], layout, gain=1.0)
    return [*write_book(book, path)[0]]


@pytest.fixture
def straight(frames, tmp_path):
    """Writes the same with straight alpha: two textures, and one of opacity."""
    bare = []
    for frame in frames:
        opacity = 1.0 - frame.transparency
        light = torch.where(opacity > 0, frame.lightmaps / opacity.clamp(min=1e-3), torch.tensor(1.0))
        bare.append(SixWay(light, None))
    first, second = write(bare, "o3de", tmp_path / "a.png")
    paths = first.rename(tmp_path / "puff_RLT_2x2.png"), second.rename(tmp_path / "puff_BBF_2x2.png")
    sheet = (1.0 - torch.stack([frame.transparency for frame in frames])).reshape(2, 2, SIZE, SIZE)
    sheet = sheet.swapaxes(1, 2).reshape(2 * SIZE, 2 * SIZE)
    Image.fromarray(np.rint(255 * sheet.numpy()).astype(np.uint8)).save(tmp_path / "opacity.png")
    return (*paths, tmp_path / "opacity.png")


def light_of(path) -> np.ndarray:
    """Reads the linear light of a picture."""
    code = np.asarray(Image.open(path).convert("RGB")) / 255.0
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def test_folders_of_baked_frames(baked, tmp_path):
    """The rate follows from the times of the chosen frames; the fire has the ramp of the scene."""
    text = call("smoke", "flipbook", baked, "-o", tmp_path / "all", "--engine", "three")
    assert "2 x 3 cells of 16 x 12, padded by 1" in text and "first.png" in text
    info = info_of(tmp_path / "all")
    assert info["rate"] == pytest.approx(20.0) and info["frames"] == 5 and info["name"] == baked.name
    assert info["extent"][1] == 2.0
    assert "vec3(1.0, 0.5, 0.0)" in (tmp_path / "all" / "smoke.glsl").read_text()
    call("smoke", "flipbook", baked, "-o", tmp_path / "some", "--count", 3, "--shader", "wgsl", "--mips", 2)
    info = info_of(tmp_path / "some")
    assert (info["rate"], info["frames"], info["levels"]) == (pytest.approx(10.0), 3, 2)
    assert info["shader"] == "smoke.wgsl" and "@binding" in (tmp_path / "some" / "smoke.wgsl").read_text()
    call("smoke", "flipbook", baked, "-o", tmp_path / "some", "--layout", "o3de", "--rate", 12)
    assert info_of(tmp_path / "some")["rate"] == 12.0 and info_of(tmp_path / "some")["layout"] == "o3de"


@pytest.mark.parametrize("suffix", ["png", "tga", "exr"])
def test_premultiplied_light_is_shaded_and_repacked(frames, tmp_path, suffix):
    paths = write(frames, "embergen", tmp_path / f"a.{suffix}")
    book = [paths[0], "--with", paths[1], "--from", "embergen", "--cells", "2x2"]
    call("smoke", "shade", *book, "-o", tmp_path / "out", "--light", "1,0.5,0.3", "--background", "0,0.3,0")
    for number, frame in enumerate(frames, 1):
        expected = frame.shade([Light((1.0, 0.5, 0.3))], background=(0.0, 0.3, 0.0)).numpy().clip(0, 1)
        seen = light_of(tmp_path / "out" / f"shade_{number:04d}.png")
        assert np.abs(seen - expected).max() < 0.02
    call("smoke", "flipbook", *book, "-o", tmp_path / "c.exr")
    again = read_flipbook((tmp_path / "c_1.exr", tmp_path / "c_2.exr"), "unity", rows=2, columns=2)
    for one, frame in zip(again, frames, strict=True):
        np.testing.assert_allclose(one.lightmaps, frame.lightmaps, atol=0.005)
        np.testing.assert_allclose(one.transparency, frame.transparency, atol=0.005)
    if suffix == "png":
        # The rate and the size in the world are unknown; 8 bits use the whole range.
        text = call("smoke", "flipbook", *book, "-o", tmp_path / "kit", "--engine", "unity")
        info = info_of(tmp_path / "kit")
        assert (info["rate"], info["extent"][1], info["layout"]) == (25.0, 1.0, "unity")
        assert info["gain"] == pytest.approx(1 / max(float(frame.lightmaps.max()) for frame in frames), rel=0.01)
        assert " 0 values clipped" in text and f"{info['gain']:.4g}" in text
        text = call("smoke", "flipbook", *book, "-o", tmp_path / "g.tga", "--count", 2, "--gain", 9)
        assert "1 x 2 cells of 16 x 16" in text and " 0 values clipped" not in text


def test_straight_light_with_a_texture_of_opacity(straight, tmp_path):
    first, second, opacity = straight
    words = ["smoke", "shade", first, "--with", second, "--with", opacity, "--from", "o3de", "--cells", "2x2", "-o"]
    call(*words, tmp_path / "white")
    assert "the light suggests straight alpha (--straight)" in call.stderr
    call(*words, tmp_path / "out", "--straight", "--background", "0,0,1")
    assert "suggests" not in call.stderr
    np.testing.assert_allclose(light_of(tmp_path / "out" / "shade_0001.png")[0, 0], [0, 0, 1], atol=1e-6)
    found = next(each for each in inspect(tmp_path) if each.path == first)
    # The printed command is accepted: without the third texture the book can be repacked, not shaded.
    book = f"{first} --with {second} --from o3de"
    assert found.command == f"wlm smoke flipbook {book} -o OUT.png" and "no opacity" in found.problems[-1]
    Image.open(first).convert("RGBA").save(first)
    found = next(each for each in inspect(tmp_path) if each.path == first)
    assert found.command == f"wlm smoke shade {book} -o DIR" and len(found.problems) == 1


def test_wrong_flip_books(straight, tmp_path):
    first, second, opacity = straight
    words, out = ["smoke", "shade", first, "--with", second, "--from", "o3de"], ["-o", tmp_path / "out"]
    for extra, line in (
        (["--cells", "2x2"], "no opacity"),
        (["--cells", "2x2", "--straight"], "for straight alpha, found none"),
        (["--cells", "3x3"], "expected textures that divide into 3 rows and 3 columns"),
    ):
        assert call(*words, *extra, *out, code=2) == "" and line in call.stderr.splitlines()[-1]
    assert "--straight: has no meaning without --with" in fails("smoke", "shade", first, "--straight", *out)
    assert not (tmp_path / "out").exists()


def test_wrong_options_are_one_line(baked, tmp_path):
    book = ["smoke", "flipbook", baked, "-o", tmp_path / "out"]
    textures = ["smoke", "flipbook", baked, "-o", tmp_path / "a.png"]
    for words, line in (
        ([*book, "--engine", "godot", "--shader", "hlsl"], "shader and exact have no meaning for a kit"),
        ([*book, "--engine", "unity", "--layout", "o3de"], "layout: expected unity for unity, got o3de"),
        ([*book, "--rate", 0], "--rate: expected a number above 0, got 0"),
        ([*textures, "--engine", "three"], "--engine needs a folder as the output"),
        ([*textures, "--rate", 12], "--rate needs a folder as the output"),
        ([*textures[:-1], tmp_path / "a.jpg"], "ends in .exr or .png or .tga"),
    ):
        assert call(*words, code=2) == "" and line in call.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())
