"""Light in the levels of pictures of integers, and what is said about it."""

import io

import imagecodecs
import numpy as np
import pytest
from builders.checks import error_of
from PIL import Image

from wlm.formats.channels import ENCODINGS, read_encoded
from wlm.formats.exr import write_exr
from wlm.formats.light import read_light

BYTES = np.array([[[0, 128, 255, 255], [255, 64, 10, 128]]], np.uint8)


def linear(level: float) -> float:
    return level / 12.92 if level <= 0.04045 else ((level + 0.055) / 1.055) ** 2.4


EXPECTED = {
    "linear": lambda p, a: p / 255,
    "srgb": lambda p, a: linear(p / 255),
    "rgbm": lambda p, a: 34.493242 * (a / 255) ** 2.2 * linear(p / 255),
    "rgbm:16:1": lambda p, a: 16 * (a / 255) * (p / 255),
    "rgbm:7": lambda p, a: 7 * (a / 255) * (p / 255),
    "rgbm:8:2": lambda p, a: (8 * (a / 255) * (p / 255)) ** 2,
    "rgbd": lambda p, a: (p / 255) ** 2.2 / (a / 255),
    "rgbd:256:1": lambda p, a: p / 255 * (256 / 255) / (a / 255),
    "dldr": lambda p, a: 4.594794 * linear(p / 255),
    "rgbe": lambda p, a: p * 2.0 ** (a - 136),
}


@pytest.mark.parametrize("encoding", EXPECTED)
def test_every_encoding(tmp_path, encoding):
    path = tmp_path / "a.png"
    Image.fromarray(BYTES).save(path)
    light = read_encoded(path, encoding)
    expected = [[EXPECTED[encoding](float(p), float(texel[3])) for p in texel[:3]] for texel in BYTES[0]]
    assert light.dtype == np.float32
    np.testing.assert_allclose(light[0], expected, rtol=1e-5)
    assert {name.split(":")[0] for name in EXPECTED} == set(ENCODINGS)


def test_what_no_encoding_says(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(BYTES[..., :3]).save(path)
    assert read_encoded(path, "srgb").shape == (1, 2, 3)
    assert "rgbm: expected a picture with alpha, found the channels RGB" in error_of(read_encoded, path, "rgbm")
    for wrong in ("logluv", "rgbm:0", "rgbm:x", "rgbm:8:2:1", "srgb:2", "rgbm:nan", "layer:", ""):
        assert "encoding: expected linear, srgb, rgbm, rgbm:RANGE:GAMMA" in error_of(read_encoded, path, wrong)
    assert "found a PNG: state what light its numbers stand for with --encoding" in error_of(read_light, path)
    write_exr(tmp_path / "a.exr", np.ones((2, 2, 3)))
    assert "expected a PNG, JPEG, WebP, TGA or TIFF of integers" in error_of(read_encoded, tmp_path / "a.exr", "srgb")


def _picture(path, image, **options):
    image.save(path, **options)
    return path


def _read(path, encoding="linear"):
    notes = []
    return read_encoded(path, encoding, notes), notes


def test_grey_and_palettes(tmp_path):
    levels = np.array([[0, 51, 255]], np.uint8)
    path, expected = tmp_path / "a.png", np.repeat(levels[..., None] / np.float32(255), 3, 2)
    for image in map(Image.fromarray, (levels, np.stack([levels, levels], -1), levels > 99)):
        light, notes = _read(_picture(path, image))
        wanted = expected if image.mode != "1" else np.round(expected)
        np.testing.assert_allclose(light, wanted, rtol=1e-6)
        assert notes == ["its grey is taken as grey light"]
    image = Image.fromarray(levels).convert("P")
    image.putpalette([i for level in range(256) for i in (level, 255 - level, 7)])
    light, notes = _read(_picture(path, image))
    np.testing.assert_allclose(light[0] * 255, [[0, 255, 7], [51, 204, 7], [255, 0, 7]], rtol=1e-6)
    assert not notes
    np.testing.assert_array_equal(_read(_picture(path, image, transparency=1))[0], light)
    assert "found the channels RGB" in error_of(read_encoded, _picture(path, image), "rgbm")


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".tga", ".png", ".exr"])
def test_other_files_of_levels_whatever_their_suffix(tmp_path, suffix):
    y, x = np.mgrid[:16, :24]
    levels = np.stack([8 * x, 12 * y, 100 + 0 * x], -1).astype(np.uint8)
    form = {".jpg": "JPEG", ".webp": "WEBP", ".tga": "TGA", ".png": "PNG", ".exr": "JPEG"}[suffix]
    path = tmp_path / f"a{suffix}"
    light, notes = _read(_picture(path, Image.fromarray(levels), format=form))
    assert light.shape == (16, 24, 3) and not notes
    assert abs(light * 255 - levels).max() < (0.01 if form in ("TGA", "PNG") else 40)
    assert f"found a {'WebP' if form == 'WEBP' else form}" in error_of(read_light, path)


def test_a_tga_of_either_orientation_has_its_top_row_first(tmp_path):
    levels = np.arange(36, dtype=np.uint8).reshape(4, 3, 3)
    for orientation in (1, -1):
        path = _picture(tmp_path / "a.tga", Image.fromarray(levels), orientation=orientation)
        np.testing.assert_allclose(_read(path)[0] * 255, levels, rtol=1e-5)


def test_sixteen_bits_of_colour_are_kept(tmp_path):
    levels = np.arange(48, dtype=np.uint16).reshape(4, 3, 4) * 1000 + 77
    for channels in (1, 2, 3, 4):
        stored = levels[..., :channels] if channels > 1 else levels[..., 0]
        (tmp_path / "a.png").write_bytes(imagecodecs.png_encode(np.ascontiguousarray(stored)))
        light = _read(tmp_path / "a.png")[0]
        colour = levels[..., :3] if channels > 2 else levels[..., :1].repeat(3, 2)
        np.testing.assert_allclose(light, colour / 65535, rtol=1e-5)


def test_what_a_picture_of_levels_leaves_open_is_said(tmp_path):
    path = tmp_path / "a.png"
    drawn = np.random.default_rng(0).random((32, 32, 4))
    scaled = np.concatenate([drawn[..., :3] / drawn[..., :3].max(-1, keepdims=True), 0.1 + 0.8 * drawn[..., 3:]], -1)
    _picture(path, Image.fromarray((255 * scaled).astype(np.uint8)))
    assert "as in RGBM: is its encoding rgbm, not srgb?" in _read(path, "srgb")[1][0]
    assert "rgbm is taken to be that of Unity in linear colour space" in _read(path, "rgbm")[1][0]
    assert "rgbd is taken to be that of Babylon.js" in _read(path, "rgbd")[1][0]
    assert not _read(path, "rgbm:8:2")[1]
    scaled[..., 3] = 1
    _picture(path, Image.fromarray((255 * scaled).astype(np.uint8)))
    assert not _read(path, "srgb")[1]
    assert "alpha is 1 everywhere, which rgbm hardly writes" in _read(path, "rgbm:8:2")[1][0]
    image, exif = Image.fromarray((255 * scaled[..., :3]).astype(np.uint8)), Image.Exif()
    exif[0x0112] = 6
    assert "EXIF orientation, 6, is ignored" in _read(_picture(tmp_path / "a.jpg", image, exif=exif))[1][0]


def test_levels_that_are_no_light_are_refused(tmp_path):
    frames = [Image.new("RGB", (8, 8), (200 * i, 0, 0)) for i in range(2)]
    path = _picture(tmp_path / "a.webp", frames[0], save_all=True, append_images=frames[1:])
    assert "expected one picture, found an animation of 2" in error_of(read_encoded, path, "srgb")
    path = _picture(tmp_path / "a.jpg", Image.new("CMYK", (4, 4)))
    assert "of grey, RGB or a palette, with alpha or without, found mode CMYK" in error_of(read_encoded, path, "srgb")
    for suffix, form in ((".png", "PNG"), (".jpg", "JPEG"), (".webp", "WEBP"), (".tga", "TGA")):
        data = io.BytesIO()
        Image.new("RGB", (64, 64)).save(data, form)
        path = tmp_path / f"cut{suffix}"
        path.write_bytes(data.getvalue()[: len(data.getvalue()) // 2])
        assert error_of(read_encoded, path, "srgb").startswith(f"{path}: ")
