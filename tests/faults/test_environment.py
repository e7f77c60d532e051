"""Faults of the surroundings of a command: each is one line, with the exit code of a wrong input."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest
import warp as wp
from builders.running import fails

import wlm.formats.folder
from wlm.errors import WlmError
from wlm.formats.folder import staged, write_index

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("words", "code"), [(["--version"], 0), (["info", "absent.wlm"], 2)])
def test_closed_streams_change_no_exit_code(words, code):
    command = subprocess.list2cmdline([sys.executable, "-m", "wlm", *words])
    for closed in ("2>&-", ">&- 2>&-"):
        process = subprocess.run(f"{command} {closed}", shell=True, cwd=ROOT, capture_output=True, timeout=60)
        assert (process.returncode, process.stderr) == (code, b"")


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
