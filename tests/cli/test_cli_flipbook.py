"""Flip books as inputs of `shade` and `flipbook`: premultiplied or straight, of two textures or three."""

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from wlm.cli.app import app
from wlm.inspection import inspect
from wlm.smoke.camera import Camera
from wlm.smoke.flipbook.textures import is_straight, read_flipbook, write_flipbook
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.shading import Light

SIZE = 16


def call(*words) -> str:
    result = CliRunner().invoke(app, ["smoke", *map(str, words)])
    assert result.exit_code == 0, result.output
    return result.output


def fails(*words) -> str:
    result = CliRunner().invoke(app, ["smoke", *map(str, words)])
    assert result.exit_code == 2
    return result.output


@pytest.fixture
def frames() -> list[SixWay]:
    """Four frames whose smoke is a disc; its light is premultiplied."""
    rows, columns = np.mgrid[:SIZE, :SIZE] / (SIZE - 1.0) - 0.5
    opacity = torch.tensor(np.clip(1.2 - 3.0 * np.hypot(rows, columns), 0.0, 1.0), dtype=torch.float32)
    random = np.random.default_rng(0)
    maps = torch.tensor(random.uniform(0.2, 0.9, (4, 6, 1, 1)), dtype=torch.float32)
    return [SixWay(one * opacity, 1.0 - opacity) for one in maps]


@pytest.fixture
def straight(frames, tmp_path):
    """The same as an engine has it that multiplies: two textures, and one of opacity."""
    bare = []
    for frame in frames:
        opacity = 1.0 - frame.transparency
        bare.append(
            SixWay(torch.where(opacity > 0, frame.lightmaps / opacity.clamp(min=1e-3), torch.tensor(1.0)), None)
        )
    paths = tmp_path / "puff_RLT_2x2.png", tmp_path / "puff_BBF_2x2.png"
    write_flipbook(paths, bare, "o3de", rows=2, columns=2)
    sheet = (1.0 - torch.stack([frame.transparency for frame in frames])).reshape(2, 2, SIZE, SIZE)
    sheet = sheet.swapaxes(1, 2).reshape(2 * SIZE, 2 * SIZE)
    Image.fromarray(np.rint(255 * sheet.numpy()).astype(np.uint8)).save(tmp_path / "opacity.png")
    return (*paths, tmp_path / "opacity.png")


def light_of(path) -> np.ndarray:
    """A picture's linear light."""
    code = np.asarray(Image.open(path).convert("RGB")) / 255.0
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("suffix", ["png", "tga", "exr"])
def test_premultiplied_light_is_shaded_and_repacked(frames, tmp_path, suffix):
    paths = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    write_flipbook(paths, frames, "embergen", rows=2, columns=2)
    book = [paths[0], "--with", paths[1], "--from", "embergen", "--cells", "2x2"]
    call("shade", *book, "-o", tmp_path / "out", "--light", "1,0.5,0.3", "--background", "0,0.3,0")
    camera = Camera.look_at((0.0, 0.0, 1.0), np.zeros(3), extent=1.0, height=SIZE, width=SIZE)
    for number, frame in enumerate(frames, 1):
        six = dataclasses.replace(frame, camera=camera)
        expected = six.shade([Light((1.0, 0.5, 0.3))], background=(0.0, 0.3, 0.0)).numpy().clip(0, 1)
        seen = light_of(tmp_path / "out" / f"shade_{number:04d}.png")
        assert np.abs(seen - expected).max() < 0.02
    call("flipbook", *book, "-o", tmp_path / "c.exr", "--layout", "unity")
    again = read_flipbook((tmp_path / "c_1.exr", tmp_path / "c_2.exr"), "unity", rows=2, columns=2)
    for one, frame in zip(again, frames, strict=True):
        np.testing.assert_allclose(one.lightmaps, frame.lightmaps, atol=0.005)
        np.testing.assert_allclose(one.transparency, frame.transparency, atol=0.005)


def test_straight_light_with_a_texture_of_opacity(frames, straight, tmp_path):
    first, second, opacity = straight
    read = read_flipbook(straight, "o3de", rows=2, columns=2, straight=True)
    for one, frame in zip(read, frames, strict=True):
        np.testing.assert_allclose(one.lightmaps, frame.lightmaps, atol=0.01)
        np.testing.assert_allclose(one.transparency, frame.transparency, atol=0.003)
    assert not is_straight(read) and is_straight(read_flipbook(straight, "o3de", rows=2, columns=2))
    words = ["shade", first, "--with", second, "--with", opacity, "--from", "o3de", "--cells", "2x2", "-o"]
    assert "is it straight (--straight)?" in call(*words, tmp_path / "white")
    assert "is it straight" not in call(*words, tmp_path / "out", "--straight", "--background", "0,0,1")
    corner = light_of(tmp_path / "out" / "shade_0001.png")[0, 0]
    np.testing.assert_allclose(corner, [0, 0, 1], atol=1e-6)
    found = next(each for each in inspect(tmp_path) if each.path == first)
    # What is printed for it is taken: without the third texture it can be repacked, not shaded.
    book = f"{first} --with {second} --from o3de --cells 2x2"
    assert found.command == f"wlm smoke flipbook {book} -o OUT.png" and "no opacity" in found.problems[0]
    Image.open(first).convert("RGBA").save(first)
    found = next(each for each in inspect(tmp_path) if each.path == first)
    assert found.command == f"wlm smoke shade {book} -o DIR" and not found.problems


def test_what_is_refused(straight, tmp_path):
    first, second, opacity = straight
    words, out = ["shade", first, "--with", second, "--from", "o3de"], ["-o", tmp_path / "out"]
    assert "no opacity" in fails(*words, "--cells", "2x2", *out)
    assert "expected opacity" in fails(*words, "--cells", "2x2", "--straight", *out)
    assert "--cells: expected rows and columns" in fails(*words, *out)
    assert "--cells: expected rows and columns" in fails(*words, "--cells", "0x2", *out)
    assert "expected 3 x 3 cells of whole pixels" in fails(*words, "--cells", "3x3", *out)
    assert "--from: expected one of" in fails(*words[:-1], "unreal", "--cells", "2x2", *out)
    assert "got 3" in fails(*words, *["--with", opacity] * 2, "--cells", "2x2", *out)
    assert "--straight: has no meaning without --with" in fails("shade", first, "--straight", *out)
    Image.new("L", (8, 8)).save(tmp_path / "small.png")
    assert "of one size" in fails(*words, "--with", tmp_path / "small.png", "--cells", "2x2", *out)
    assert not list((tmp_path / "out").glob("*"))
