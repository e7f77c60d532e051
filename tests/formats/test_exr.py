"""EXR files as the OpenEXR library has them, and headers that are refused before it reads them."""

import os
import re
import resource
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from builders.checks import error_of

from tests.builders.exr import exr_header
from wlm.errors import WlmError
from wlm.formats import exr
from wlm.formats.channels import read_channels, read_encoded
from wlm.formats.exr import HALF_MAX, read_every_channel, read_exr, read_header, read_planes, write_exr
from wlm.formats.exr_header import check_header

SCANLINES = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def _pixels(channels: int, height: int = 37, width: int = 21) -> np.ndarray:
    """Noise that half floats hold exactly."""
    rng = np.random.default_rng(channels)
    return (rng.random((height, width, channels)) * 4 - 1).astype(np.float16).astype(np.float32)


def _planes(names: str, dtype: type = np.float32) -> dict[str, np.ndarray]:
    pixels = _pixels(len(names)).astype(dtype)
    return {name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(names)}


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("channels", [3, 4])
def test_what_was_written_is_read(tmp_path, half, channels):
    path = tmp_path / "a.exr"
    write_exr(path, _pixels(channels), half=half)
    pixels, names = read_exr(path)
    assert names == tuple("RGBA"[:channels])
    assert pixels.dtype == np.float32 and np.array_equal(pixels, _pixels(channels))
    stored = OpenEXR.File(str(path), separate_channels=True).channels()
    assert stored["R"].pixels.dtype == (np.float16 if half else np.float32)
    assert os.listdir(tmp_path) == ["a.exr"]


def test_floats_are_kept_and_halves_are_clamped(tmp_path):
    pixels = np.array([[[1e6, -1e6, np.inf], [65504.0, 65519.0, 1 / 3]]], np.float32)
    write_exr(tmp_path / "half.exr", pixels)
    write_exr(tmp_path / "float.exr", pixels, half=False)
    expected = [[[HALF_MAX, -HALF_MAX, HALF_MAX], [HALF_MAX, HALF_MAX, np.float16(1 / 3)]]]
    assert np.array_equal(read_exr(tmp_path / "half.exr")[0], expected)
    assert np.array_equal(read_exr(tmp_path / "float.exr")[0], pixels)
    write_exr(tmp_path / "nan.exr", np.full((2, 2, 3), np.nan))
    assert np.isnan(read_exr(tmp_path / "nan.exr")[0]).all()


@pytest.mark.parametrize("name", ["RGB", "RGBA"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_a_joined_array_is_read(tmp_path, name, dtype):
    path = tmp_path / "a.exr"
    OpenEXR.File(SCANLINES, {name: _pixels(len(name)).astype(dtype)}).write(str(path))
    pixels, names = read_exr(path)
    assert names == tuple(name) and np.array_equal(pixels, _pixels(len(name)))


def test_channels_are_ordered_by_name_and_others_left_out(tmp_path):
    path = tmp_path / "a.exr"
    planes = _planes("RGBZ")
    shuffled = {name: planes[name] for name in "ZBGR"}
    OpenEXR.File(SCANLINES, {**shuffled, "diffuse.R": planes["Z"]}).write(str(path))
    pixels, names = read_exr(path)
    assert names == ("R", "G", "B")
    assert np.array_equal(pixels, np.stack([planes[name] for name in "RGB"], -1))


@pytest.mark.parametrize("size", [(30, 50), (15, 50), (15, 20)])
@pytest.mark.parametrize("corner", [(0, 0), (4, 3), (-2, -3), (-6, 12)])
def test_the_data_window_is_placed_in_the_display_window(tmp_path, corner, size):
    path, (x, y), (width, height), origin = tmp_path / "a.exr", corner, size, 100
    display = _box(origin, origin, width, height)
    header = {**SCANLINES, "dataWindow": _box(origin + x, origin + y, 21, 37), "displayWindow": display}
    # Rows are stored from the bottom in half of the files.
    header["lineOrder"] = OpenEXR.DECREASING_Y if x else OpenEXR.INCREASING_Y
    OpenEXR.File(header, _planes("RGBA")).write(str(path))
    expected = np.zeros((height + 200, width + 200, 4), np.float32)
    expected[y + 100 : y + 137, x + 100 : x + 121] = _pixels(4)
    expected = expected[100 : 100 + height, 100 : 100 + width]
    notes = []
    pixels, names = read_exr(path, notes)
    np.testing.assert_array_equal(pixels, expected)
    np.testing.assert_array_equal(read_every_channel(path)[0], expected)
    assert names == tuple("RGBA") and read_header(path) == (width, height, ("A", "B", "G", "R"))
    (note,) = notes
    assert note.startswith(f"the data window, 21x37 at ({x}, {y}), is placed in the display window, {width}x{height}: ")
    stored = np.count_nonzero((expected != 0).any(-1))
    assert (f"{width * height - stored} texels outside it are 0" in note) == (stored < width * height)
    assert (f"{21 * 37 - stored} texels beyond it are left out" in note) == (stored < 21 * 37)


def test_a_data_window_outside_the_display_window_is_refused(tmp_path):
    path = tmp_path / "a.exr"
    OpenEXR.File({**SCANLINES, "displayWindow": _box(30, 0, 9, 9)}, _planes("RGB")).write(str(path))
    assert "expected a data window that overlaps the display window, found none" in error_of(read_exr, path)
    OpenEXR.File({**SCANLINES, "displayWindow": _box(0, 0, 60000, 60000)}, _planes("RGB")).write(str(path))
    assert "at most 268435456 texels" in error_of(read_exr, path)


def _box(x: int, y: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)


def _write(path: Path, header: dict, planes: dict[str, np.ndarray]) -> None:
    OpenEXR.File({**SCANLINES, **header}, dict(planes)).write(str(path))


@pytest.mark.parametrize(
    ("names", "wanted", "note"),
    [
        ("Bake.B Bake.G Bake.R", "Bake.R Bake.G Bake.B", "the light is taken from 'Bake', its only layer of colour"),
        ("V.Combined.A V.Combined.B V.Combined.G V.Combined.R V.Depth.Z", "V.Combined.R V.Combined.G V.Combined.B "
         "V.Combined.A", "the light is taken from 'V.Combined', its only layer of colour"),
        ("b g r", "r g b", None),
        ("x.blue x.green x.red", "x.red x.green x.blue", "the light is taken from 'x', its only layer of colour"),
        ("B G R r", "R G B", None),
        ("Y", "Y Y Y", "its only channel, Y, is taken as grey light"),
        ("B G R s.B s.G s.R", "R G B", "the light is taken from R, G and B; its other layers of colour (s) are not "
         "read"),
    ],
)  # fmt: skip
def test_the_only_layer_of_colour_is_read(tmp_path, names, wanted, note):
    path, notes = tmp_path / "a.exr", []
    planes = dict(zip(names.split(), np.moveaxis(_pixels(8), -1, 0).copy(), strict=False))
    _write(path, {}, planes)
    pixels, letters = read_exr(path, notes)
    np.testing.assert_array_equal(pixels, np.stack([planes[name] for name in wanted.split()], -1))
    assert letters == tuple("RGBA"[: len(wanted.split())]) and notes == [note] * (note is not None)


def test_one_of_several_layers_is_chosen_by_name(tmp_path):
    path, planes = tmp_path / "a.exr", _planes("RGB")
    doubled = {name: 2 * plane for name, plane in planes.items()}
    _write(path, {}, {f"{layer}.{name}": plane for layer in "ab" for name, plane in planes.items()})
    assert error_of(read_exr, path) == (
        f"{path}: expected one layer of colour, found 'a', 'b': choose one with --encoding layer:NAME, or by channels "
        "in a set.json"
    )
    assert "expected a layer of colour 'c', found 'a', 'b'" in error_of(read_exr, path, None, "c")
    np.testing.assert_array_equal(read_encoded(path, "layer:b"), _pixels(3))
    parts = [OpenEXR.Part({}, dict(each), name=name) for name, each in (("one", planes), ("two", doubled))]
    OpenEXR.File(parts).write(str(path))
    assert "found 'one', 'two'" in error_of(read_exr, path)
    np.testing.assert_array_equal(read_encoded(path, "layer:two"), 2 * _pixels(3))
    names = ("one.B", "one.G", "one.R", "two.B", "two.G", "two.R")
    assert read_header(path)[2] == names and read_every_channel(path)[1] == names
    parts = [OpenEXR.Part({}, {"Z": planes["R"]}, name="z"), OpenEXR.Part({}, dict(planes), name="beauty")]
    OpenEXR.File(parts).write(str(path))
    notes = []
    np.testing.assert_array_equal(read_exr(path, notes)[0], _pixels(3))
    assert notes == ["the light is taken from 'beauty', its only layer of colour"]


AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
# Published matrices: ACES2065-1 to linear sRGB with white adapted by Bradford, and IEC 61966-2-1 from CIE XYZ.
AP0_TO_709 = [[2.52169, -1.13413, -0.38756], [-0.27648, 1.37272, -0.09624], [-0.01538, -0.15298, 1.16835]]
XYZ_TO_709 = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]


@pytest.mark.parametrize(
    ("header", "matrix", "name"),
    [
        ({"chromaticities": AP0}, AP0_TO_709, "ACES AP0"),
        ({"colorInteropID": "lin_ap0_scene"}, AP0_TO_709, "ACES AP0"),
        ({"acesImageContainerFlag": 1}, AP0_TO_709, "ACES AP0"),
        ({"chromaticities": XYZ}, XYZ_TO_709, "CIE XYZ"),
        ({"colorInteropID": "lin_ciexyzd65_scene"}, XYZ_TO_709, "CIE XYZ"),
        ({"chromaticities": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)}, np.eye(3), None),
        ({"colorInteropID": "lin_rec709_scene"}, np.eye(3), None),
        ({"colorInteropID": "unknown"}, np.eye(3), None),
    ],
)
def test_primaries_are_converted(tmp_path, header, matrix, name):
    path, notes = tmp_path / "a.exr", []
    _write(path, header, _planes("RGBA"))
    pixels = read_exr(path, notes)[0]
    np.testing.assert_allclose(pixels[..., :3], _pixels(4)[..., :3] @ np.transpose(matrix), atol=5e-3)
    np.testing.assert_array_equal(pixels[..., 3], _pixels(4)[..., 3])
    assert notes == [f"converted to Rec. 709 from {name}"] * (name is not None)
    np.testing.assert_array_equal(read_channels(path, light=True)[0], pixels)
    np.testing.assert_array_equal(read_channels(path)[0], _pixels(4))  # directions and masks have no primaries


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ({"chromaticities": (0.3,) * 8}, "chromaticities: expected the chromaticities of three primaries and white"),
        ({"chromaticities": (np.nan, *AP0[1:])}, "chromaticities: expected the chromaticities of three primaries"),
        ({"colorInteropID": "srgb_rec709_scene"}, "colorInteropID: expected linear light, found srgb_rec709_scene"),
    ],
)
def test_impossible_primaries_and_screen_colours_are_refused(tmp_path, header, words):
    _write(tmp_path / "a.exr", header, _planes("RGB"))
    assert words in error_of(read_exr, tmp_path / "a.exr")


@pytest.mark.parametrize("names", ["XYZ", "RG", "RGA"])
def test_misnamed_channels_are_listed(tmp_path, names):
    path = tmp_path / "a.exr"
    OpenEXR.File(SCANLINES, _planes(names)).write(str(path))
    found = ",".join(sorted(names))
    with pytest.raises(WlmError) as caught:
        read_exr(path)
    assert str(caught.value) == f"{path}: expected channels R,G,B or R,G,B,A, found {found}"


def test_luminance_and_chroma_are_refused_by_name(tmp_path):
    path, planes = tmp_path / "a.exr", _planes("YRB")
    _write(path, {}, {"Y": planes["Y"], "RY": planes["R"], "BY": planes["B"]})
    assert error_of(read_exr, path).endswith("found BY,RY,Y (luminance and chroma: save it as RGB)")


READERS = pytest.mark.parametrize("read", [read_exr, read_planes])


@READERS
def test_integers_and_several_parts_are_refused(tmp_path, read):
    path = tmp_path / "a.exr"
    planes = _planes("RGB")
    OpenEXR.File(SCANLINES, {**planes, "G": np.ones((37, 21), np.uint32)}).write(str(path))
    assert "channel G: expected half or float numbers, found uint32" in error_of(read, path)
    parts = [OpenEXR.Part({}, planes, name=name) for name in ("one", "two")]
    OpenEXR.File(parts).write(str(path))
    assert re.search("expected (an EXR file of one part|one layer of colour), found", error_of(read, path))


@READERS
def test_a_missing_file_or_other_content_is_refused(tmp_path, capfd, read):
    path = tmp_path / "a.exr"
    assert "cannot read the EXR file: No such file" in error_of(read, path)
    assert "found a folder" in error_of(read, tmp_path)
    for content in (b"", b"\x76\x2f", b"\x89PNG" + b"x" * 500):
        path.write_bytes(content)
        assert re.search("a.exr: expected an EXR file, found other content$", error_of(read, path))
    path.write_bytes(b"\x76\x2f\x31\x01" + b"x" * 500)
    assert "cut short or damaged" in error_of(read, path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", [OpenEXR.scanlineimage, OpenEXR.tiledimage])
def test_a_file_cut_anywhere_is_refused_in_silence(tmp_path, kind, capfd):
    path = tmp_path / "a.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": kind}
    if kind == OpenEXR.tiledimage:
        header["tiles"] = OpenEXR.TileDescription()
    OpenEXR.File(header, {"RGB": _pixels(3, 40, 9).astype(np.float16)}).write(str(path))
    whole = path.read_bytes()
    np.testing.assert_array_equal(read_exr(path)[0], _pixels(3, 40, 9))
    # Every length near the ends, where the header, the chunk table and the last chunk end, and some between.
    lengths = [*range(0, 420, 7), *range(420, len(whole) - 20, 97), *range(len(whole) - 20, len(whole))]
    for length in lengths:
        path.write_bytes(whole[:length])
        with pytest.raises(WlmError) as caught:
            read_exr(path)
        line = str(caught.value)
        assert line.startswith(f"{path}: ") and "\n" not in line, length
    assert capfd.readouterr() == ("", "")


def test_a_unicode_path(tmp_path):
    path = Path(tmp_path) / "kärtchen ✓.exr"
    write_exr(path, _pixels(3))
    assert np.array_equal(read_exr(path)[0], _pixels(3))


@pytest.mark.parametrize("short", [1, 100, 4000])
def test_a_disk_that_fills_while_writing_leaves_what_was_there(tmp_path, capfd, short):
    """A limit on the size of files stands in for the disk."""
    path, pixels = tmp_path / "a.exr", _pixels(4, 100, 100)
    write_exr(path, pixels)
    limit = path.stat().st_size - short
    path.write_bytes(b"what was there")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(WlmError) as caught:
            write_exr(path, pixels)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(caught.value).startswith(f"{path}: cannot write: ") and "File too large" in str(caught.value)
    assert path.read_bytes() == b"what was there" and os.listdir(tmp_path) == ["a.exr"]
    assert "does not exist" in error_of(write_exr, tmp_path / "none" / "a.exr", pixels)
    assert capfd.readouterr() == ("", "")


DEEP = ("type", "string", b"deepscanline")
HEADERS = {
    "deep by its flag": (exr_header(flags=0x800), "expected a flat EXR picture, found deep data"),
    "deep by its type": (exr_header(DEEP), "expected a flat EXR picture, found deep data"),
    "deep in the second part": (
        exr_header(flags=0x1000) + exr_header(DEEP)[8:] + b"\0",
        "expected a flat EXR picture, found deep data",
    ),
    "many channels": (exr_header(names=[f"c{i}" for i in range(9000)]), "at most 8192 attributes and channels"),
    "many attributes": (
        exr_header(*((f"a{i}", "int", bytes(4)) for i in range(9000))),
        "at most 8192 attributes of different names",
    ),
    "many parts": (exr_header(flags=0x1000) + exr_header(names=["c"] * 100)[8:] * 100 + b"\0", "at most 8192 attri"),
    "one attribute twice": (exr_header(*[("a", "int", bytes(4))] * 2), "different names, found twice the attribute a"),
    "a long attribute": (exr_header(("a", "string", b"")).replace(bytes(5), b"\xff\xff\xff\x7f\0"), "expected at most"),
    "a large window": (exr_header(window=(0, 0, 1 << 20, 1)), "65536 along a side, found 1048577 x 2"),
    "more pixels than bytes": (exr_header(window=(0, 0, 16383, 16383)), "2048 times its"),
    "floats count twice": (exr_header(window=(0, 0, 5999, 5999), kind=2), "found 432000000"),
    "an inverted window": (exr_header(window=(0, 0, -5, 3)), "dataWindow: expected at least one pixel, found -4 x 4"),
    "a window that overflows": (exr_header(window=(-(2**31), 0, 2**31 - 1, 3)), "found 4294967296 x 4"),
    "a cut channel": (exr_header(names=["R"]).replace(b"R\0", b"R\1"), "cut short or damaged"),
}


@pytest.mark.parametrize("name", HEADERS)
@pytest.mark.parametrize("read", [read_exr, read_planes, read_channels, read_header])
def test_a_header_is_refused_before_the_library_sees_it(tmp_path, monkeypatch, name, read):
    path, (content, message) = tmp_path / "a.exr", HEADERS[name]
    path.write_bytes(content)
    monkeypatch.setattr(exr.OpenEXR, "File", lambda *_, **__: pytest.fail("the library was called"))
    with pytest.raises(WlmError) as caught:
        read(path)
    assert message in str(caught.value) and str(caught.value).startswith(f"{path}: ")


def test_headers_of_the_library_are_understood(tmp_path):
    path = tmp_path / "a.exr"
    planes = {"R": np.ones((4, 8), np.float16), "Z": np.ones((4, 8), np.float32)}
    parts = [OpenEXR.Part({"dataWindow": ((2, 3), (9, 6)), "note": "x" * 300}, planes, name=n) for n in ("one", "two")]
    OpenEXR.File(parts).write(str(path))
    first, second = check_header(path)
    assert (first.size, first.channels) == ((8, 4), ("R", "Z"))
    assert second.attributes["name"] == ("string", b"two")
    assert struct.unpack("<4i", first.attributes["dataWindow"][1]) == (2, 3, 9, 6)
