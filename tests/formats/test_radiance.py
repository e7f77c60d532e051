"""Radiance pictures: every mantissa and exponent, run lengths, orientations, exposures, and refused files."""

from itertools import product

import imagecodecs
import numpy as np
import pytest
from builders.checks import error_of

from wlm.formats.radiance import read_radiance

HEAD = b"#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\n"


def _file(path, texels, head=HEAD, size=None):
    """Writes texels, uint8 [H, W, 4] or the bytes that stand for them."""
    if size is None:
        size = "-Y {} +X {}".format(*texels.shape)
    path.write_bytes(head + b"\n" + size.encode() + b"\n" + (texels if isinstance(texels, bytes) else texels.tobytes()))
    return path


def _noise(height, width, seed=0):
    """Texels that are not mistaken for run lengths: red is above 127."""
    texels = np.random.default_rng(seed).integers(0, 256, (height, width, 4), np.uint8)
    texels[..., 0] |= 128
    return texels


def _values(texels):
    exponent = texels[..., 3:].astype(np.float64)
    return np.where(exponent > 0, texels[..., :3] * 2.0 ** (exponent - 136), 0)


def test_every_code(tmp_path):
    exponent, mantissa = np.mgrid[:256, :256]
    texels = np.stack([np.full_like(mantissa, 200), mantissa, 255 - mantissa, exponent], -1).astype(np.uint8)
    pixels, names = read_radiance(_file(tmp_path / "a.hdr", texels))
    assert (names, pixels.dtype, pixels.shape) == (("R", "G", "B"), np.float32, (256, 256, 3))
    # Exact: the largest is 1.7e38, the smallest a denormal float.
    np.testing.assert_array_equal(pixels, _values(texels))
    assert pixels[1, 1, 1] == 2.0**-135 and not pixels[0].any()


@pytest.mark.parametrize("shape", [(3, 7), (5, 8), (4, 300), (2, 1000)])
def test_runs_are_read_as_another_reader_has_them(tmp_path, shape):
    draw = np.random.default_rng(1)
    light = np.repeat(draw.random((*shape, 3)) ** 8 * 65504, draw.integers(1, 9, shape[1]), axis=1)[:, : shape[1]]
    light[0, :3] = 0
    content = imagecodecs.rgbe_encode(light.astype(np.float32), header=True)
    (tmp_path / "a.hdr").write_bytes(content)
    pixels = read_radiance(tmp_path / "a.hdr")[0]
    np.testing.assert_array_equal(pixels, imagecodecs.rgbe_decode(content))
    assert (abs(pixels - light) <= light.max(-1, keepdims=True) / 128).all()


def test_the_old_run_length_code_is_refused(tmp_path):
    a, b = _noise(1, 2)[0]
    data = bytes(a) + b"\1\1\1\3" + bytes(b)  # a, three times repeated, and b
    for more in (b"", bytes(8), bytes(400)):
        message = error_of(read_radiance, _file(tmp_path / "a.hdr", data + more, size="-Y 1 +X 5"))
        assert "run-length code of before 1991" in message


@pytest.mark.parametrize(("down", "right", "upright"), [*product("+-", "+-", (True, False))])
def test_orientations(tmp_path, down, right, upright):
    texels = _noise(3, 2)
    stored = texels[:: 1 if down == "-" else -1, :: 1 if right == "+" else -1]
    axes = [f"{down}Y 3", f"{right}X 2"]
    if not upright:
        stored, axes = stored.swapaxes(0, 1), axes[::-1]
    pixels = read_radiance(_file(tmp_path / "a.hdr", stored, size=" ".join(axes)))[0]
    assert pixels.flags.c_contiguous
    np.testing.assert_array_equal(pixels, _values(texels))


def test_exposures_and_colours_multiply(tmp_path):
    texels = _noise(2, 2)
    texels[..., 3] = 128
    head = HEAD + b"EXPOSURE=2\nVIEW= -vf x\nEXPOSURE= 4.0\nCOLORCORR= 1 .5 2\nGAMMA=1.0\n"
    notes = []
    pixels = read_radiance(_file(tmp_path / "a.hdr", texels, head), notes)[0]
    np.testing.assert_array_equal(pixels, _values(texels) / [8, 4, 16])
    assert notes == ["divided by the EXPOSURE of its header, 8 4 16, which other readers may ignore"]
    texels[..., 3] = 255
    assert np.isinf(read_radiance(_file(tmp_path / "a.hdr", texels, HEAD + b"EXPOSURE=1e-30\n"))[0]).any()


@pytest.mark.parametrize(
    ("head", "size", "data", "words"),
    [
        (HEAD + b"FORMAT=32-bit_rle_rgb\n", "-Y 1 +X 1", b"", "FORMAT: expected 32-bit_rle_rgbe or 32-bit_rle_xy"),
        (HEAD + b"PRIMARIES=1 0 1 0 1 0 1 0\n", "-Y 1 +X 1", b"abcd", "PRIMARIES: expected the chromaticities"),
        (HEAD + b"GAMMA=2.2\n", "-Y 1 +X 1", b"abcd", "GAMMA: expected 1 (linear light), found 2.2"),
        (HEAD + b"EXPOSURE=0\n", "-Y 1 +X 1", b"abcd", "EXPOSURE: expected 1 finite number(s) above 0, found 0"),
        (HEAD, "-Y 1 -Y 1", b"abcd", "expected a size such as -Y 512 +X 512"),
        (HEAD, "-Y 16384 +X 16384", b"abcd", "expected at most 2048 times its"),
        (HEAD, "-Y 2 +X 1", b"abcd", "cut short or damaged"),
        (HEAD, "-Y 1 +X 8", b"\2\2\0\x08" + b"\x89\1" * 4, "cut short or damaged"),
        (HEAD, "-Y 1 +X 8", b"\2\2\0\x08" + b"\x88\1" * 3 + b"\x08\1\1", "cut short or damaged"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path, head, size, data, words):
    path = _file(tmp_path / "a.hdr", data, head, size)
    message = error_of(read_radiance, path)
    assert message.startswith(f"{path}: ") and words in message


def test_primaries_and_xyz_become_rec_709(tmp_path):
    texels = _noise(3, 4)
    texels[..., 3] = 128
    path, notes = tmp_path / "a.hdr", []
    stored = _values(texels)
    rec709 = b"PRIMARIES=.64 .33 .3 .6 .15 .06 .3127 .329\n"
    np.testing.assert_array_equal(read_radiance(_file(path, texels, HEAD + rec709), notes)[0], stored)
    assert not notes
    ap0 = b"PRIMARIES= 0.7347 0.2653 0 1 0.0001 -0.077 0.32168 0.33767\n"
    pixels = read_radiance(_file(path, texels, HEAD + ap0), notes)[0]
    matrix = [[2.52169, -1.13413, -0.38756], [-0.27648, 1.37272, -0.09624], [-0.01538, -0.15298, 1.16835]]
    np.testing.assert_allclose(pixels, stored @ np.transpose(matrix), atol=2e-3)
    xyz = HEAD.replace(b"rgbe", b"xyze")
    pixels = read_radiance(_file(path, texels, xyz), notes)[0]
    matrix = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    np.testing.assert_allclose(pixels, stored @ np.transpose(matrix), atol=2e-3)
    assert notes[:2] == ["converted to Rec. 709 from ACES AP0", "converted to Rec. 709 from CIE XYZ"]
    assert "179 times the W/(sr m2) of RGB" in notes[2]
