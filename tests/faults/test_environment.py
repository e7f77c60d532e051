"""Faults of the surroundings of a command: each is one line, with the exit code of a wrong input."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest
import warp as wp
import yaml
from builders.running import call, fails
from builders.smoke_plumes import SCENE

import wlm.formats.folder
import wlm.formats.lock
from wlm.errors import WlmError
from wlm.formats.folder import staged, write_index

ROOT = Path(__file__).resolve().parents[2]
FILES, CORPUS = ROOT / "tests" / "files", ROOT / "tests" / "fuzz" / "corpus"


@pytest.mark.parametrize("words, code", [("--version", 0), pytest.param("info absent.wlm", 2, marks=pytest.mark.slow)])
def test_streams_that_are_closed_or_full(words, code):
    """A closed or full stderr changes no exit code; a full stdout is an output that cannot be written."""
    command = subprocess.list2cmdline([sys.executable, "-m", "wlm", *words.split()])
    full = (2, b"error: stdout: No space left on device\n") if code == 0 else (2, None)
    for streams, expected in (("2>&-", (code, b"")), (">&- 2>/dev/full", (code, b"")), (">/dev/full", full)):
        process = subprocess.run(f"{command} {streams}", shell=True, cwd=ROOT, capture_output=True, timeout=60)
        assert process.returncode == expected[0] and expected[1] in (process.stderr, None), streams


COMMANDS = (
    ("compress", CORPUS / "probes.npz", "--steps", 10, "-o", "a.wlm"),
    ("decode", FILES / "lightmap.wlm", "--time", 6, "-o", "a.exr"),
    ("decode", FILES / "probe.wlm", "--positions", CORPUS / "positions.npz", "-o", "a.npz"),
    ("export", FILES / "lightmap.wlm", "-o", "a"),
    ("export", FILES / "probe.wlm", "--engine", "unity", "-o", "a"),
    ("export", FILES / "atlas-plain.wlm", "--engine", "godot", "-o", "a"),
    ("probe", "volume", FILES / "probe.wlm", "-o", "a"),
    ("web", FILES / "lightmap-frames.wlm", "-o", "a.html"),
    ("smoke", "simulate", "scene.yaml", "-o", "a"),
    ("smoke", "bake", CORPUS / "volume.npz", "--resolution", 8, "-o", "a.exr"),
    ("smoke", "shade", CORPUS / "six-way.exr", "-o", "a.png"),
    ("smoke", "flipbook", CORPUS / "six-way.exr", "-o", "a.tga"),
    ("smoke", "flipbook", CORPUS / "six-way.exr", "-o", "a.exr"),
    ("smoke", "flipbook", CORPUS / "six-way.exr", "-o", "a"),
)
"""A command for each way to write an output."""


def error_of(*words) -> str:
    """Runs a command that must end with exit code 2 and one line of error beside those of its progress."""
    call(*words, code=2)
    (line,) = [line for line in call.stderr.splitlines() if line.startswith("error: ")]
    return line


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: " ".join(map(str, (*words[:2], words[-1]))))
def test_an_output_that_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, words):
    output = tmp_path / "out" / words[-1]
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(SCENE | {"frames": 1}))
    output.parent.mkdir()
    words = [tmp_path / word if word == "scene.yaml" else word for word in words[:-1]]

    def full(path, is_folder):
        if is_folder:
            path.mkdir()
        else:
            path.symlink_to("/dev/full")

    def read_only(path, is_folder):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    for make, reason in ((full, "cannot write"), (read_only, "Read-only file system")):
        monkeypatch.setattr(wlm.formats.lock, "_make", make)
        assert reason in error_of(*words, output)
        assert os.listdir(output.parent) == []
    output.symlink_to(output)
    assert "loop" in error_of(*words, output).lower()
    assert os.listdir(output.parent) == [output.name]


def test_the_first_texture_of_a_flip_book_is_not_left_alone(tmp_path, monkeypatch):
    made = []

    def later_full(path, is_folder):
        made.append(path)
        path.symlink_to("/dev/full") if len(made) == 2 else path.touch()

    monkeypatch.setattr(wlm.formats.lock, "_make", later_full)
    assert "a_2.png: cannot write: No space left" in error_of(
        "smoke", "flipbook", CORPUS / "six-way.exr", "-o", tmp_path / "a.png"
    )
    assert os.listdir(tmp_path) == []


def test_a_looped_link_is_one_line(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for words in (["inspect"], ["info"], ["compress"], ["compress", ROOT / "demos/data/city", "-o"]):
        assert "loop" in fails(*words, tmp_path / "loop" / "a.wlm")


def test_a_broken_package_and_a_full_cache_are_one_line(monkeypatch):
    wp.init()
    cases = (
        (ImportError("libImath.so: cannot open", name="OpenEXR.core"), "the package OpenEXR cannot be imported"),
        (OSError(errno.ENOSPC, "No space left on device"), "WARP_CACHE_PATH names another folder"),
        (OSError(errno.EROFS, "read-only", f"{wp.config.kernel_cache_dir}/1"), "WARP_CACHE_PATH names another folder"),
    )
    for error, words in cases:
        monkeypatch.setattr("wlm.inspection.input_system", mock.Mock(side_effect=error))
        assert words in fails("compress", "a.wlm")


def test_a_full_disk_leaves_no_folder(tmp_path, monkeypatch):
    """There is room for the files of an export, but not for the index that marks them as unfinished."""
    write = wlm.formats.folder.atomic_write

    def full(path, content):
        if path.parent.name == "out":
            raise WlmError(f"{path}: cannot write: No space left on device")
        return write(path, content)

    monkeypatch.setattr(wlm.formats.folder, "atomic_write", full)
    with (
        pytest.raises(WlmError, match="out/index.json: cannot write"),
        staged(tmp_path / "out", "index.json", "a") as made,
    ):
        write_index(made / "index.json", {"format": "a"})
    assert os.listdir(tmp_path) == []
