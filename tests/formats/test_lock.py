"""Locks on outputs, and temporary files of killed processes."""

import fcntl
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from builders.checks import error_of

from wlm.errors import WlmError
from wlm.formats import lock
from wlm.formats.atomic import atomic_path, atomic_write
from wlm.formats.folder import claim, staged, write_index
from wlm.formats.lock import is_passing, locked
from wlm.smoke.data import NumberedFiles


@contextmanager
def another_process(*lines):
    """A process that runs these lines and waits; killed at the end."""
    code = "\n".join([
        "import os, sys, time",
        "from pathlib import Path",
        "from wlm.formats.atomic import atomic_path",
        "from wlm.formats.folder import staged",
        "from wlm.formats.lock import locked",
        *lines,
    ])  # fmt: skip
    code += "\n" + " " * (len(lines[-1]) - len(lines[-1].lstrip()) + 4) + "print('there', flush=True); time.sleep(600)"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout.readline() == "there\n"
        try:
            yield
        finally:
            process.send_signal(signal.SIGKILL)


@pytest.mark.parametrize("folder", [False, True])
def test_one_process_writes_an_output(folder, tmp_path):
    output = tmp_path / ("n" * 250)
    if folder:
        output.mkdir()
    (tmp_path / "link").symlink_to(output)
    with another_process(f"with locked({str(output)!r}):"):
        for name in (output, tmp_path / "link"):
            with (
                pytest.raises(WlmError, match=f"{name.name}: another process is writing it: wait until it ends$"),
                locked(name),
            ):
                pytest.fail("two have the lock")
        with locked(tmp_path / "other"), locked(tmp_path):
            assert len([name for name in os.listdir(tmp_path) if name.endswith(".lock")]) == 2
    # The lock of a process that was killed is none.
    with locked(output), locked(output):
        assert [is_passing(name) for name in sorted(os.listdir(tmp_path))] == [True, False, *[False] * folder]
    assert sorted(os.listdir(tmp_path)) == ["link", *[output.name] * folder]


def test_a_holder_that_ends_while_it_is_asked(tmp_path, monkeypatch):
    """The file that was opened is gone, or another's, when its lock is had."""
    take, opened = fcntl.flock, []

    def flock(handle, how):
        path = next(path for path in tmp_path.iterdir())
        opened.append(os.fstat(handle).st_ino)
        if len(opened) < 3:
            path.rename(tmp_path.parent / f"gone{len(opened)}")
            if len(opened) == 2:
                path.touch()
        take(handle, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    with locked(tmp_path / "a"):
        (path,) = tmp_path.iterdir()
        assert path.stat().st_ino == opened[2] and len(set(opened)) == 3
    assert os.listdir(tmp_path) == []


def test_what_was_in_the_making_is_removed_once_its_process_is_gone(tmp_path):
    out, file = tmp_path / "out", tmp_path / "a.wlm"
    file.write_bytes(b"old")
    export = [
        f"export = staged(Path({str(out)!r}), 'index.json', 'f')",
        "with export as made:",
        "    (made / 'b').write_text('half')",
        f"    with atomic_path({str(file)!r}) as part:",
        "        part.write_text('half')",
    ]
    export[-1:] = [f"        with atomic_path({str(tmp_path / 'c')!r}) as other:"]
    with another_process(*export):
        before = sorted(os.listdir(tmp_path))
        assert len(before) == 5 and sum(map(is_passing, before)) == 4
        # Its lock keeps others from the folder; files are written by the last who does, and nobody's are removed.
        with pytest.raises(WlmError, match="another process"), staged(out, "index.json", "f"):
            pytest.fail("two write one folder")
        atomic_write(file, b"new")
        assert sorted(os.listdir(tmp_path)) == before
    atomic_write(file, b"newer")
    assert len(os.listdir(tmp_path)) == 4, "the file's is gone, the folder's, its lock and another file's aren't"
    with staged(out, "index.json", "f") as made:
        write_index(made / "index.json", {"format": "f"})
    atomic_write(tmp_path / "c", b"c")
    assert sorted(os.listdir(tmp_path)) == ["a.wlm", "c", "out"] and os.listdir(out) == ["index.json"]
    assert file.read_bytes() == b"newer"


def test_what_is_in_the_making_is_no_file_of_others(tmp_path):
    with another_process(f"with atomic_path({str(tmp_path / 'six_0001.exr')!r}):"):
        (name,) = os.listdir(tmp_path)
        claim(tmp_path, "index.json", "f")
        NumberedFiles(tmp_path, "six", ".exr")
        with locked(tmp_path):
            assert os.listdir(tmp_path) == [name]
    with locked(tmp_path):
        assert os.listdir(tmp_path) == []
    for mine in (".wlm-mine.tmp", ".wlm-0123", "a.tmp", ".wlm-0123.lock.txt"):
        (tmp_path / mine).touch()
        assert "other files" in error_of(claim, tmp_path, "index.json", "f")
        with locked(tmp_path):
            (tmp_path / mine).unlink()


def test_a_system_without_locks(tmp_path, monkeypatch):
    """Nobody is kept out, and nothing is removed, since nobody can tell whose it is."""
    with another_process(f"with atomic_path({str(tmp_path / 'a')!r}):"):
        left = os.listdir(tmp_path)
    monkeypatch.setattr(lock, "fcntl", None)
    before = len(os.listdir("/dev/fd"))
    with locked(tmp_path / "a"), atomic_path(tmp_path / "a") as part:
        part.write_text("a")
        assert len(os.listdir("/dev/fd")) == before, "Windows renames no file that is open"
    with staged(tmp_path / "out", "index.json", "f") as made:
        write_index(made / "index.json", {"format": "f"})
    assert sorted(os.listdir(tmp_path)) == [*left, "a", "out"]


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def flock(handle, how):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", flock)
    with locked(tmp_path / "a"), atomic_path(tmp_path / "a") as part:
        part.write_text("a")
        assert len(os.listdir(tmp_path)) == 1
    assert os.listdir(tmp_path) == ["a"]
    with locked(tmp_path / "none" / "a"):
        assert os.listdir(tmp_path) == ["a"]
