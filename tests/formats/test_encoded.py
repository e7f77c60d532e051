"""Light in the bytes of a PNG."""

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
    "dldr": lambda p, a: 4.594794 * linear(p / 255),
    "rgbe": lambda p, a: p * 2.0 ** (a - 136),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding(tmp_path, encoding):
    path = tmp_path / "a.png"
    Image.fromarray(BYTES).save(path)
    light = read_encoded(path, encoding)
    expected = [[EXPECTED[encoding](float(p), float(texel[3])) for p in texel[:3]] for texel in BYTES[0]]
    assert light.dtype == np.float32
    np.testing.assert_allclose(light[0], expected, rtol=1e-5)


def test_what_no_encoding_says(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(BYTES[..., :3]).save(path)
    assert read_encoded(path, "srgb").shape == (1, 2, 3)
    assert "encoding rgbm: expected a PNG of RGB with alpha, found RGB" in error_of(read_encoded, path, "rgbm")
    assert "encoding: expected one of linear, srgb" in error_of(read_encoded, path, "logluv")
    assert "whose encoding of light is unknown" in error_of(read_light, path)
    write_exr(tmp_path / "a.exr", np.ones((2, 2, 3)))
    assert "encoding: expected a PNG" in error_of(read_encoded, tmp_path / "a.exr", "srgb")
