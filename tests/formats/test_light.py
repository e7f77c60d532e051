"""Light in KTX2 and DDS files: every code of every format, orientations, supercompression, and what is refused."""

import struct
import sys

import imagecodecs
import numpy as np
import pytest
import texture2ddecoder
import tifffile
from builders.checks import error_of
from builders.textures import make_dds, make_ktx2

from benchmarks.rivals import astcenc
from benchmarks.rivals.lightmap_blocks import ispc_bc6h
from wlm.formats.channels import read_encoded
from wlm.formats.exr import write_exr
from wlm.formats.hdr_blocks import ASTC_BLOCKS
from wlm.formats.light import read_light

RGB, RGBA, PNG = ("R", "G", "B"), ("R", "G", "B", "A"), b"\x89PNG\r\n\x1a\n"
# Byte offsets, from the specifications.
FORMAT, HEIGHT, LAYERS, FACES, SCHEME, DESCRIPTOR_AT, LEVEL, TRANSFER = 12, 24, 32, 36, 44, 48, 80, 118
DDS_SIZE, DDS_HEIGHT, DDS_FLAGS, DDS_CODE, DDS_CAPS2 = 4, 12, 80, 84, 112
DXGI, MISC, ARRAY = 128, 136, 140


def _read(path, content):
    path.write_bytes(content)
    pixels, names = read_light(path)
    assert pixels.dtype == np.float32 and pixels.flags.c_contiguous and pixels.shape[2] == len(names)
    return pixels, names


def _light(height, width, channels=3):
    """Half floats of all sizes, the largest, the smallest and 0."""
    light = np.exp(np.random.default_rng(0).uniform(-12, 11, (height, width, channels))).astype(np.float16)
    light[0, 0], light[0, 1], light[1, 0] = 0, 65504, 2.0**-24
    return light


def _exponents(codes, mantissa, bias=15):
    """Floats without a sign, by the formulas of EXT_packed_float."""
    m, e = codes & ((1 << mantissa) - 1), codes >> mantissa
    values = np.where(e == 0, m / 2.0**mantissa * 2.0 ** (1 - bias), (1 + m / 2.0**mantissa) * 2.0 ** (e - bias))
    return np.where(e == 31, np.where(m == 0, np.inf, np.nan), values)


@pytest.mark.parametrize("make", [lambda *a: make_ktx2(122, *a[:2], [a[2]]), lambda *a: make_dds(26, *a)])
def test_every_code_of_11_11_10(tmp_path, make):
    red = np.arange(2048).reshape(32, 64)
    green, blue = red[::-1], red[:, ::-1] % 1024
    words = (red | green << 11 | blue << 22).astype("<u4")
    pixels, names = _read(tmp_path / "a", make(64, 32, words.tobytes()))
    assert names == RGB
    expected = np.stack([_exponents(red, 6), _exponents(green, 6), _exponents(blue, 5)], -1)
    np.testing.assert_array_equal(pixels, expected)


@pytest.mark.parametrize("make", [lambda *a: make_ktx2(123, *a[:2], [a[2]]), lambda *a: make_dds(67, *a)])
def test_every_code_of_a_shared_exponent(tmp_path, make):
    exponent, red = np.mgrid[:32, :512]
    green, blue = 511 - red, (red * 7 + exponent) % 512
    words = (red | green << 9 | blue << 18 | exponent << 27).astype("<u4")
    pixels, names = _read(tmp_path / "a", make(512, 32, words.tobytes()))
    assert names == RGB
    np.testing.assert_array_equal(pixels, np.stack([red, green, blue], -1) * 2.0 ** (exponent - 24.0)[..., None])
    assert pixels.max() == 65408  # the largest of the format


@pytest.mark.parametrize(
    ("channels", "kind", "number", "others"),
    [
        (3, "<f2", 90, []),
        (4, "<f2", 97, [(10, b"DX10"), (0, struct.pack("<I", 113))]),
        (3, "<f4", 106, [(6, b"DX10")]),
        (4, "<f4", 109, [(2, b"DX10"), (0, struct.pack("<I", 116))]),
    ],
)
def test_plain_floats(tmp_path, channels, kind, number, others):
    if kind == "<f2":
        values = np.arange(65536, dtype=np.uint16).view("<f2").reshape(128, 512)
    else:
        values = np.geomspace(1e-45, 3e38, 65536, dtype="<f4").reshape(128, 512)
        values[0, :5] = np.nan, np.inf, -np.inf, -0.0, -1.5
    light = np.stack([np.roll(values, 5 * i, 1) for i in range(channels)], -1)
    files = [make_ktx2(number, 512, 128, [light.tobytes()])]
    files += [make_dds(dxgi, 512, 128, light.tobytes(), code) for dxgi, code in others]
    for content in files:
        pixels, names = _read(tmp_path / "a", content)
        assert names == (RGB, RGBA)[channels == 4]
        np.testing.assert_array_equal(pixels, light.astype(np.float32))


def test_bc6h_by_two_decoders(tmp_path):
    light = np.random.default_rng(3).random((8, 12, 3)).repeat(4, 0).repeat(3, 1).astype(np.float16)
    blocks = ispc_bc6h(light)
    bgra = np.frombuffer(texture2ddecoder.decode_bc6(blocks, 36, 32), np.uint8).reshape(32, 36, 4)
    for content in (make_ktx2(143, 34, 31, [blocks]), make_dds(95, 34, 31, blocks)):
        pixels, names = _read(tmp_path / "a", content)
        assert names == RGB and pixels.shape == (31, 34, 3)
        assert abs(255 * pixels.clip(0, 1) - bgra[:31, :34, 2::-1]).max() <= 1.0
        assert abs(pixels - light[:31, :34]).mean() < 0.02


def test_bc6h_reaches_the_ends_and_goes_below_zero(tmp_path):
    light = _light(8, 8)
    light[:4, :4] = 65504
    blocks = ispc_bc6h(light)
    pixels = _read(tmp_path / "a", make_ktx2(143, 8, 8, [blocks]))[0]
    assert (pixels[:4, :4] > 65000).all() and np.isfinite(pixels).all()
    draw = np.random.default_rng(0).integers(0, 256, (64, 16), np.uint8)
    for content in (make_ktx2(144, 32, 32, [draw.tobytes()]), make_dds(96, 32, 32, draw.tobytes())):
        pixels = _read(tmp_path / "a", content)[0]
        np.testing.assert_array_equal(pixels, imagecodecs.bcn_decode(draw.tobytes(), -6, shape=(32, 32, 3)))
        assert pixels.min() < -100 and pixels.max() > 100


@pytest.mark.parametrize("block", ASTC_BLOCKS[::4])
def test_astc_of_high_dynamic_range(tmp_path, block):
    y, x = np.mgrid[:31, :50]
    light = np.stack([100 * y + 1, 30 * x + 1, 0 * x + 500], -1).astype(np.float16)
    blocks = astcenc.astc(block, astcenc.MEDIUM, "test").encode(light)
    number = 1000066000 + ASTC_BLOCKS.index(block)
    pixels, names = _read(tmp_path / "a", make_ktx2(number, 50, 31, [blocks]))
    assert names == RGB and pixels.shape == (31, 50, 3)
    assert abs(pixels - light).mean() < 60 and abs(pixels - light).max() < 900


def test_a_picture_of_several_bands_is_one(tmp_path, monkeypatch):
    blocks = np.random.default_rng(0).integers(0, 256, (8, 8, 16), np.uint8).tobytes()
    whole = _read(tmp_path / "a", make_ktx2(143, 31, 29, [blocks]))[0]
    monkeypatch.setattr("wlm.formats.float_texels._BAND", 300)
    np.testing.assert_array_equal(_read(tmp_path / "a", make_ktx2(143, 31, 29, [blocks]))[0], whole)


@pytest.mark.parametrize("scheme", [0, 2, 3])
def test_the_largest_level_alone_is_read(tmp_path, scheme):
    levels = [_light(4 >> i, 6 >> i, 4).tobytes() if i < 2 else bytes(8) for i in range(3)]
    pixels, names = _read(tmp_path / "a", make_ktx2(97, 6, 4, levels, scheme))
    assert names == RGBA
    np.testing.assert_array_equal(pixels, _light(4, 6, 4))
    pixels = _read(tmp_path / "a", make_dds(10, 6, 4, b"".join(levels), mips=3))[0]
    np.testing.assert_array_equal(pixels, _light(4, 6, 4))


@pytest.mark.parametrize("orientation", ["rd", "ru", "ld", "lu"])
def test_the_first_row_is_the_top(tmp_path, orientation):
    light = _light(5, 3)
    stored = light[:: 1 if orientation[1] == "d" else -1, :: 1 if orientation[0] == "r" else -1]
    pairs = {"KTXorientation": orientation, "KTXwriter": "a test"}
    pixels = _read(tmp_path / "a", make_ktx2(90, 3, 5, [stored.tobytes()], pairs=pairs))[0]
    np.testing.assert_array_equal(pixels, light)


def test_kinds_are_told_by_content(tmp_path):
    light = _light(3, 5).astype(np.float32)
    write_exr(tmp_path / "a.hdr", light, half=False)
    np.testing.assert_array_equal(read_light(tmp_path / "a.hdr")[0], light)
    (tmp_path / "a.exr").write_bytes(make_ktx2(106, 5, 3, [light.tobytes()]))
    np.testing.assert_array_equal(read_light(tmp_path / "a.exr")[0], light)
    for content, found in (
        (b"", "an empty file"),
        (b"no lightmap", "other content"),
        (PNG, "a PNG: state what light its numbers stand for with --encoding (linear, srgb, rgbm, ...)"),
        (b"\xabKTX 11\xbb\r\n\x1a\n", "a KTX file of version 1"),
    ):
        (tmp_path / "a.exr").write_bytes(content)
        message = error_of(read_light, tmp_path / "a.exr")
        expected = "expected a lightmap, EXR, Radiance (.hdr), PFM, TIFF of floats, KTX2 or DDS, found "
        assert message == f"{tmp_path / 'a.exr'}: {expected}{found}"


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ({"KTXorientation": "rdi"}, "KTXorientation: expected rd, ru, ld or lu, found b'rdi'"),
        ({"KTXswizzle": "bgra"}, "KTXswizzle: expected rgba, found b'bgra'"),
    ],
)
def test_other_orders_are_refused(tmp_path, pairs, words):
    content = make_ktx2(90, 5, 3, [_light(3, 5).tobytes()], pairs={"KTXorientation": "rd", "KTXswizzle": "rgb1"})
    np.testing.assert_array_equal(_read(tmp_path / "a", content)[0], _light(3, 5))
    (tmp_path / "a.ktx2").write_bytes(make_ktx2(90, 5, 3, [_light(3, 5).tobytes()], pairs=pairs))
    assert words in error_of(read_light, tmp_path / "a.ktx2")


@pytest.mark.parametrize(
    ("suffix", "at", "value", "words"),
    [
        ("ktx2", FORMAT, 37, "BC6H or ASTC SFLOAT, found 37"),
        ("ktx2", FORMAT, 97, "byteLength of level 0: expected 120 for 5 x 3 texels of R16G16B16A16_SFLOAT, found 90"),
        ("ktx2", HEIGHT, 0, "pixelHeight: expected at least 1 (2D), found 0"),
        ("ktx2", LAYERS, 3, "layerCount: expected 0 (no array), found 3"),
        ("ktx2", FACES, 6, "faceCount: expected 1 (no cube), found 6"),
        ("ktx2", SCHEME, 2, "level 0: cannot unpack: zstd: "),
        ("ktx2", LEVEL, 500, "level 0: the file is cut short: expected 590 bytes"),
        ("ktx2", DESCRIPTOR_AT, 2**31, "the data format descriptor: the file is cut short"),
        ("ktx2", TRANSFER, 2, "expected linear light (transfer function 1), found 2"),
        ("dds", DDS_SIZE, 125, "header size: expected 124, found 125"),
        ("dds", DDS_HEIGHT, 4, "texels of R16G16B16A16_FLOAT: the file is cut short: expected 308 bytes, found 268"),
        ("dds", DDS_FLAGS, 0x40, "expected DX10, or FourCC 113 (A16B16G16R16F) or 116 (A32B32G32R32F), found"),
        ("dds", DDS_CODE, 0x31545844, "found FourCC DXT1"),
        ("dds", DDS_CAPS2, 0xFE00, "expected a 2D texture, found a cube"),
        ("dds", DXGI, 98, "found 98 (BC7_UNORM)"),
        ("dds", MISC, 4, "DX10 flags: expected no cube, found 0x4"),
        ("dds", ARRAY, 6, "array size: expected 1 (no array), found 6"),
    ],
)  # fmt: skip
def test_a_wrong_field_of_a_header_is_named(tmp_path, suffix, at, value, words):
    content = bytearray(make_ktx2(90, 5, 3, [_light(3, 5).tobytes()], pairs={"KTXwriter": "a test"}))
    if suffix == "dds":
        content = bytearray(make_dds(10, 5, 3, _light(3, 5, 4).tobytes()))
    content[at : at + 4] = bytes([value]) + content[at + 1 : at + 4] if at == TRANSFER else struct.pack("<I", value)
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    message = error_of(read_light, path)
    assert message.startswith(f"{path}: ") and words in message


def test_a_missing_package_is_named_with_the_file(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    (tmp_path / "a.dds").write_bytes(make_dds(95, 4, 4, bytes(16)))
    words = "a.dds: cannot decode the texels: atlas: imagecodecs is missing; needs the extra: pip install 'wlm[atlas]'"
    assert words in error_of(read_light, tmp_path / "a.dds")


def test_pfm_of_either_byte_order_and_of_grey(tmp_path):
    light, path = _light(5, 7).astype(np.float32), tmp_path / "a.pfm"
    for scale, order in (("-1", "<f4"), ("1.0", ">f4"), ("-2e0", "<f4")):
        notes = []
        path.write_bytes(f"PF\n7 5\n{scale}\n".encode() + light[::-1].astype(order).tobytes())
        np.testing.assert_array_equal(read_light(path, notes)[0], light)
        assert notes == ["the scale of its header, 2, is not applied"] * ("2" in scale)
    path.write_bytes(b"Pf 7 5 -1\n" + light[::-1, :, 0].astype("<f4").tobytes())
    notes = []
    np.testing.assert_array_equal(read_light(path, notes)[0], light[..., :1].repeat(3, 2))
    assert notes == ["its only channel is taken as grey light"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"PF\n2 2\n-1\n" + bytes(47), "the texels: the file is cut short: expected 58 bytes, found 57"),
        (b"PF\n2 2\n0\n" + bytes(48), "expected a PFM header"),
        (b"PF\n16384 16384\n-1\n" + bytes(48), "expected at most 2048 times"),
    ],
)
def test_a_damaged_pfm(tmp_path, content, words):
    path = tmp_path / "a.exr"
    path.write_bytes(content)
    assert words in error_of(read_light, path)


TIFFS = (
    {},
    {"byteorder": ">"},
    {"compression": "zlib", "predictor": True},
    {"tile": (16, 16), "compression": "lzw"},
    {"planarconfig": "separate"},
    {"rowsperstrip": 5},
)


@pytest.mark.parametrize("kind", ["<f2", "<f4", "<f8"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_float_tiffs(tmp_path, kind, channels):
    light, path, notes = _light(32, 20, channels).astype(kind), tmp_path / "a.tif", []
    for options in TIFFS:
        _tiff(path, light, options)
        pixels, names = read_light(path, notes)
        np.testing.assert_array_equal(pixels, light if channels > 1 else light.repeat(3, 2))
        assert pixels.dtype == np.float32 and names == (RGBA if channels == 4 else RGB)
    assert set(notes) == ({"its only colour channel is taken as grey light"} if channels == 1 else set())


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_tiffs_of_integers_need_an_encoding(tmp_path, kind):
    levels, path = (np.arange(60).reshape(4, 5, 3) * np.iinfo(kind).max / 60).astype(kind), tmp_path / "a.tiff"
    _tiff(path, levels, {})
    assert "found a TIFF of integers: state what light its numbers stand for" in error_of(read_light, path)
    np.testing.assert_allclose(read_encoded(path, "linear"), levels / np.iinfo(kind).max, rtol=1e-6)
    _tiff(path, levels.astype(np.float32), {})
    assert "expected a picture of integers, found floats" in error_of(read_encoded, path, "linear")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_tiff(tmp_path, orientation):
    light, path = _light(3, 5), tmp_path / "a.tif"
    # Where the first row and the first column of the file are in the picture: TIFF 6.0, tag 274.
    stored = light.swapaxes(0, 1) if orientation > 4 else light
    rows, columns = (0, 1) if orientation <= 4 else (1, 0)
    if orientation in (3, 4, 7, 8):
        stored = np.flip(stored, rows)
    if orientation in (2, 3, 6, 7):
        stored = np.flip(stored, columns)
    _tiff(path, stored, {"extratags": [(274, 3, 1, orientation, True)]})
    np.testing.assert_array_equal(read_light(path)[0], light)


def test_tiffs_that_are_refused(tmp_path):
    path, light = tmp_path / "a.tif", _light(16, 16).astype(np.float32)
    _tiff(path, light, {})
    whole = path.read_bytes()
    for length in (*range(0, 60), len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        assert error_of(read_light, path).startswith(f"{path}: ")
    for tag, value, words in (
        (256, 60000, "cut short or damaged"),
        (262, 5, "expected a TIFF of grey or RGB, found the photometric interpretation 5 with 3 samples"),
        (257, 17, "a.tif: "),
    ):
        path.write_bytes(_with_tag(whole, tag, value))
        assert words in error_of(read_light, path), tag
    path.write_bytes(_with_tag(_with_tag(whole, 256, 16384), 257, 16384))
    assert "expected at most 2048 times" in error_of(read_light, path)
    path.write_bytes(b"II+\0" + whole[4:])
    assert "found a BigTIFF" in error_of(read_light, path)


def _tiff(path, light, options):
    form = "minisblack" if light.shape[2] == 1 else "rgb"
    stored = light[..., 0] if light.shape[2] == 1 else light
    if options.get("planarconfig") == "separate":
        stored = light.transpose(2, 0, 1)
        if light.shape[2] == 1:
            stored, options = light[..., 0], {}
    extra = ["unassalpha"] if light.shape[2] == 4 else None
    tifffile.imwrite(path, np.ascontiguousarray(stored), photometric=form, extrasamples=extra, **options)


def _with_tag(data, tag, value):
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        if struct.unpack_from("<H", data, entry) == (tag,):
            return data[: entry + 2] + struct.pack("<HII", 4, 1, value) + data[entry + 12 :]
    raise AssertionError(f"no tag {tag}")


def test_other_files_are_named(tmp_path):
    for content, words in (
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "found a pointer of Git LFS: run git"),
        (b"<!DOCTYPE html>", "found text such as a web page"),
        (b"\0\0\0\x20ftypavif" + bytes(40), "found an AVIF"),
        (b"\x1f\x8b" + bytes(40), "found a file under gzip"),
    ):
        (tmp_path / "a.exr").write_bytes(content)
        assert words in error_of(read_light, tmp_path / "a.exr")


@pytest.mark.parametrize(("number", "name"), [(0, None), (1, None), (4, "Rec. 2020"), (7, "ACES AP1 (ACEScg)")])
def test_primaries_of_a_ktx2(tmp_path, number, name):
    light, path, notes = _light(6, 5).astype(np.float32) / 100, tmp_path / "a.ktx2", []
    content = bytearray(make_ktx2(106, 5, 6, [light.tobytes()]))
    (descriptor,) = struct.unpack_from("<I", content, DESCRIPTOR_AT)
    content[descriptor + 13] = number
    path.write_bytes(content)
    pixels = read_light(path, notes)[0]
    assert notes == [f"converted to Rec. 709 from {name}"] * (name is not None)
    assert np.array_equal(pixels, light) == (name is None)
    grey = np.float32([0.5, 0.5, 0.5])
    path.write_bytes(content[: -light.nbytes] + np.broadcast_to(grey, light.shape).tobytes())
    np.testing.assert_allclose(read_light(path)[0], 0.5, atol=1e-3)
    content[descriptor + 13] = 200
    path.write_bytes(content)
    assert "expected colour primaries 0, 1, 4, 5, 6, 7, 10, 11, found 200" in error_of(read_light, path)


def test_a_colour_profile_of_a_tiff_is_mentioned(tmp_path):
    path, notes = tmp_path / "a.tif", []
    _tiff(path, _light(4, 4).astype(np.float32), {"iccprofile": b"profile" * 30})
    read_light(path, notes)
    assert notes == ["its colour profile is not applied: colours are taken as Rec. 709"]
