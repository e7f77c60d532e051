"""Files that are written whole or not at all, and arrays in a file without a name."""

import errno
import os
import re
import resource
import tempfile
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of

from wlm.errors import WlmError
from wlm.formats import scratch
from wlm.formats.atomic import atomic_write


@pytest.fixture
def target(tmp_path: Path) -> Path:
    """A file that already holds something."""
    path = tmp_path / "file.bin"
    path.write_bytes(b"before")
    return path


def _assert_untouched(target: Path) -> None:
    assert target.read_bytes() == b"before"
    assert os.listdir(target.parent) == [target.name]


def test_bytes_and_pieces_are_written(tmp_path, target):
    assert atomic_write(target, b"after!!") == 7
    assert target.read_bytes() == b"after!!"
    pieces = [b"a", bytearray(b"b"), memoryview(b"c"), np.array([[1, 2]], np.uint16), np.empty((0, 3)), b""]
    assert atomic_write(tmp_path / "new.bin", iter(pieces)) == 7
    assert (tmp_path / "new.bin").read_bytes() == b"abc\x01\x00\x02\x00"
    assert atomic_write(tmp_path / "new.bin", b"") == 0
    assert (tmp_path / "new.bin").read_bytes() == b""
    assert sorted(os.listdir(tmp_path)) == ["file.bin", "new.bin"]


@pytest.mark.parametrize("call", ["fsync", "replace", "open"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_refusing_system_leaves_nothing_behind(target, monkeypatch, call, number):
    def refuse(*args, **kwargs):
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(os, call, refuse)
        with pytest.raises(WlmError) as caught:
            atomic_write(target, b"after")
    assert str(caught.value) == f"{target}: cannot write: {os.strerror(number)}"
    _assert_untouched(target)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_source_leaves_nothing_behind(target, error):
    def pieces():
        yield b"half"
        raise error

    with pytest.raises(error):
        atomic_write(target, pieces())
    _assert_untouched(target)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_device_is_not_replaced():
    assert "expected a file or none, found" in error_of(atomic_write, "/dev/full", b"x")
    assert Path("/dev/full").is_char_device()


def test_a_folder_or_a_missing_folder_is_refused(tmp_path, target):
    assert "expected a file or none, found" in error_of(atomic_write, tmp_path, b"x")
    assert re.search("the folder .*none does not exist", error_of(atomic_write, tmp_path / "none" / "f", b"x"))
    assert re.search("the folder .*file.bin does not exist", error_of(atomic_write, target / "f", b"x"))
    _assert_untouched(target)


def test_a_link_stays_a_link(tmp_path, target):
    link = tmp_path / "link"
    link.symlink_to(target.name)
    atomic_write(link, b"after")
    assert link.is_symlink() and target.read_bytes() == b"after"
    broken = tmp_path / "broken"
    broken.symlink_to("made")
    atomic_write(broken, b"new")
    assert broken.is_symlink() and (tmp_path / "made").read_bytes() == b"new"


def test_the_longest_name_and_the_usual_mode(tmp_path):
    path = tmp_path / ("n" * 255)
    mask = os.umask(0o027)
    try:
        atomic_write(path, b"x")
    finally:
        os.umask(mask)
    assert path.read_bytes() == b"x" and path.stat().st_mode & 0o777 == 0o640
    assert "name too long" in error_of(atomic_write, tmp_path / ("n" * 256), b"x")
    assert len(os.listdir(tmp_path)) == 1


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The folder for temporary files, and a bound above which arrays lie there."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(scratch, "IN_MEMORY", 1000)
    return tmp_path


def test_a_large_array_is_in_a_file_and_a_small_one_in_memory(folder):
    small, large = (scratch.room((n, 5), np.float32, "test") for n in (50, 51))
    assert small.base is None and large.base is not None
    for array in (small, large):
        assert type(array) is np.ndarray and not array.any()
        array[3] = 7.0
        assert array.sum() == 35.0 and array[2:4].max() == 7.0
    assert list(folder.iterdir()) == [], "the file has no name"


@pytest.mark.parametrize("portable", [False, True])
def test_a_full_disk_is_one_line(folder, portable, monkeypatch):
    if portable:
        monkeypatch.delattr("os.posix_fallocate")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(WlmError, match=r"^set.json: needs 8,000 bytes in .+ \(TMPDIR\): File too large$") as error:
            scratch.room((2000,), np.float32, "set.json")
        assert str(folder) in str(error.value)
        assert len(scratch.room((1000,), np.float32, "set.json")) == 1000
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
