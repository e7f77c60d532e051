import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.builders.exr import exr_header
from wlm.errors import WlmError
from wlm.formats.exr import HALF_MAX, read_exr, read_planes, write_exr, write_planes

PLANES = {"depth": np.ones((3, 4)), "top": np.zeros((3, 4))}
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


def test_tiles_and_a_moved_window_are_read(tmp_path):
    path = tmp_path / "a.exr"
    header = {
        "compression": OpenEXR.PIZ_COMPRESSION,
        "type": OpenEXR.tiledimage,
        "tiles": OpenEXR.TileDescription(),
    }
    OpenEXR.File(header, _planes("RGB")).write(str(path))
    assert np.array_equal(read_exr(path)[0], _pixels(3))
    window = (np.array([5, 7], np.int32), np.array([25, 43], np.int32))
    OpenEXR.File({**SCANLINES, "dataWindow": window}, _planes("RGB")).write(str(path))
    assert np.array_equal(read_exr(path)[0], _pixels(3))


@pytest.mark.parametrize("names", ["XYZ", "Y", "RG", "rgb", "RGA"])
def test_misnamed_channels_are_listed(tmp_path, names):
    path = tmp_path / "a.exr"
    OpenEXR.File(SCANLINES, _planes(names)).write(str(path))
    found = ",".join(sorted(names))
    with pytest.raises(WlmError) as caught:
        read_exr(path)
    assert str(caught.value) == f"{path}: expected channels R,G,B or R,G,B,A, found {found}"


READERS = pytest.mark.parametrize("read", [read_exr, read_planes])


@READERS
def test_integers_and_several_parts_are_refused(tmp_path, read):
    path = tmp_path / "a.exr"
    planes = _planes("RGB")
    OpenEXR.File(SCANLINES, {**planes, "G": np.ones((37, 21), np.uint32)}).write(str(path))
    with pytest.raises(WlmError, match="channel G: expected half or float, found uint32"):
        read(path)
    parts = [OpenEXR.Part({}, planes, name=name) for name in ("one", "two")]
    OpenEXR.File(parts).write(str(path))
    with pytest.raises(WlmError, match="expected an EXR file of one part, found 2"):
        read(path)


@READERS
def test_a_missing_file_or_other_content_is_refused(tmp_path, capfd, read):
    path = tmp_path / "a.exr"
    with pytest.raises(WlmError, match="cannot read the EXR file: No such file"):
        read(path)
    with pytest.raises(WlmError, match="found a folder"):
        read(tmp_path)
    for content in (b"", b"\x76\x2f", b"\x89PNG" + b"x" * 500):
        path.write_bytes(content)
        with pytest.raises(WlmError, match="a.exr: expected an EXR file, found other content$"):
            read(path)
    path.write_bytes(b"\x76\x2f\x31\x01" + b"x" * 500)
    with pytest.raises(WlmError, match="cut short or damaged"):
        read(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("write", [lambda path: write_exr(path, _pixels(3)), lambda path: write_planes(path, PLANES)])
def test_what_cannot_be_written_leaves_what_was_there(tmp_path, monkeypatch, write):
    path = tmp_path / "a.exr"
    path.write_bytes(b"what was there")

    def full(self, name):
        raise RuntimeError(f"{name}: no room\nat all")

    monkeypatch.setattr(OpenEXR.File, "write", full)
    with pytest.raises(WlmError) as caught:
        write(path)
    assert str(caught.value) == f"{path}: cannot write: {path}: no room at all"
    assert path.read_bytes() == b"what was there" and os.listdir(tmp_path) == ["a.exr"]


@pytest.mark.parametrize("kind", [OpenEXR.scanlineimage, OpenEXR.tiledimage])
def test_a_file_cut_anywhere_is_refused_in_silence(tmp_path, kind, capfd):
    path = tmp_path / "a.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": kind}
    if kind == OpenEXR.tiledimage:
        header["tiles"] = OpenEXR.TileDescription()
    OpenEXR.File(header, {"RGB": _pixels(3, 40, 9).astype(np.float16)}).write(str(path))
    whole = path.read_bytes()
    read_exr(path)
    # Every length near the ends, where the header, the chunk table and the last chunk end, and some between.
    lengths = [*range(0, 420, 7), *range(420, len(whole) - 20, 97), *range(len(whole) - 20, len(whole))]
    for length in lengths:
        path.write_bytes(whole[:length])
        with pytest.raises(WlmError) as caught:
            read_exr(path)
        line = str(caught.value)
        assert line.startswith(f"{path}: ") and "\n" not in line, length
    assert capfd.readouterr() == ("", "")


def test_lines_of_others_on_stderr_pass(tmp_path, capfd, monkeypatch):
    path = tmp_path / "a.exr"
    path.write_bytes(exr_header())
    opened = OpenEXR.File

    def chatty(*args, **kwargs):
        os.write(2, b"a line of another thread\n")
        return opened(*args, **kwargs)

    monkeypatch.setattr(OpenEXR, "File", chatty)
    with pytest.raises(WlmError):
        read_exr(path)
    assert capfd.readouterr() == ("", "a line of another thread\n")


@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 2), (4, 4, 5), (0, 4, 3), (2, 4, 4, 3)])
def test_other_shapes_are_a_value_error(tmp_path, shape):
    with pytest.raises(ValueError, match="expected pixels"):
        write_exr(tmp_path / "a.exr", np.zeros(shape, np.float32))
    assert os.listdir(tmp_path) == []


def test_a_closed_stderr_does_no_harm(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, _pixels(3))
    code = "import os, sys; os.close(2)\nfrom wlm.formats.exr import read_exr\nprint(read_exr(sys.argv[1])[0].shape)"
    done = subprocess.run([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True)
    assert done.stdout.strip() == "(37, 21, 3)"


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
    with pytest.raises(WlmError, match="does not exist"):
        write_exr(tmp_path / "none" / "a.exr", pixels)
    assert capfd.readouterr() == ("", "")


def test_planes_of_several_shapes_and_types(tmp_path):
    for planes in ({"a": np.ones((2, 2)), "b": np.ones((2, 3))}, {}):
        with pytest.raises(ValueError, match="one shape"):
            write_planes(tmp_path / "a.exr", planes)
    write_planes(tmp_path / "a.exr", {"a": np.full((1, 1), 1e9), "b": np.full((1, 1), 1e9)}, whole=("b",))
    planes, note = read_planes(tmp_path / "a.exr")
    assert planes["a"] == HALF_MAX and planes["b"] == np.float32(1e9) and note == {}
