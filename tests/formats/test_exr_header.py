"""Headers of EXR files are refused before the OpenEXR library reads them."""

import struct

import numpy as np
import OpenEXR
import pytest

from tests.builders.exr import exr_header
from wlm.errors import WlmError
from wlm.formats import exr
from wlm.formats.channels import read_channels
from wlm.formats.exr import read_exr, read_header, read_planes
from wlm.formats.exr_header import check_header

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
    "many parts": (
        exr_header(flags=0x1000) + exr_header(names=["c"] * 100)[8:] * 100 + b"\0",
        "at most 8192 attributes and channels",
    ),
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
