"""Locks that the system releases when their process ends: on outputs while they are written, and on temporary files.

A temporary file is beside its destination and has a name such as `.wlm-0123456789abcdef-0123456789abcdef.tmp`: a hash
of the name of the destination, and a random number. Its process locks it, so a temporary file without a lock was left
by a killed process, and the next write to that destination removes it.

On systems without such locks (Windows, some network file systems) outputs are not protected and nothing is removed.
"""

import hashlib
import os
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wlm.errors import WlmError

try:
    import fcntl
except ImportError:
    fcntl = None

_PASSING = re.compile(r"\.wlm-[0-9a-f-]+\.(tmp|lock)")
_held: Counter[Path] = Counter()  # how many times this process has locked each output


def is_passing(name: str) -> bool:
    """Whether a file name is the name of a lock or of a temporary file, which don't count as content of a folder."""
    return _PASSING.fullmatch(name) is not None


@contextmanager
def locked(output: str | os.PathLike[str]) -> Iterator[None]:
    """Locks an output against other processes, and removes temporary files that killed processes left. The lock is on a
    file beside the output, which is removed at the end. Locks may be nested within one process."""
    target = Path(os.path.realpath(output))
    lock = target.parent / f"{_stem(target)}.lock"
    handle = None
    if not _held[target]:
        handle = _acquire(lock, output)
        sweep(target)
    _held[target] += 1
    try:
        yield
    finally:
        _held[target] -= 1
        if handle is not None:
            # The file is removed before its lock is released; later, it could be the lock of another process.
            with suppress(OSError):
                lock.unlink()
            os.close(handle)


@contextmanager
def temporary(target: Path, *, folder: bool = False) -> Iterator[Path]:
    """Yields the path of an empty file or folder beside its destination, and removes it at the end if it still exists.

    `target`, the destination, contains no links. The temporary name is short, since that of `target` may be very long.
    Raises an OSError if the file or folder cannot be made."""
    sweep(target)
    handle = None
    try:
        while True:
            path = target.parent / f"{_stem(target)}-{secrets.token_hex(8)}.tmp"
            handle = _make(path, folder)
            # Another process may have removed it as abandoned before it was locked.
            if path.exists():
                break
            if handle is not None:
                os.close(handle)
        yield path
    finally:
        with suppress(OSError):
            shutil.rmtree(path) if folder else path.unlink()
        if handle is not None:
            os.close(handle)


def sweep(target: Path) -> None:
    """Removes the temporary files that killed processes left beside `target` and, if it is a folder, in it."""
    stem = _stem(target)
    for parent, prefix in ((target.parent, f"{stem}-"), (target, ".wlm-")):
        with suppress(OSError):
            for name in os.listdir(parent):
                if name.startswith(prefix) and name.endswith(".tmp") and is_passing(name):
                    _remove_if_dead(parent / name)


def _stem(target: Path) -> str:
    return f".wlm-{hashlib.blake2b(os.fsencode(target.name), digest_size=8).hexdigest()}"


def _acquire(lock: Path, output: str | os.PathLike[str]) -> int | None:
    """Locks a file, made if missing; returns its handle, None if it can't be locked; WlmError if another has it."""
    while fcntl is not None:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            # Writing the output will report the problem.
            return None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        except BlockingIOError:
            os.close(handle)
            raise WlmError(f"{output}: another process is writing it: wait until it ends") from None
        except FileNotFoundError:
            # Its owner removed it after it was opened here.
            os.close(handle)
            continue
        except OSError:
            os.close(handle)
            lock.unlink(missing_ok=True)
            return None
        os.close(handle)
    return None


def _make(path: Path, folder: bool) -> int | None:
    """Makes a file or folder and locks it; returns its handle, or None on a system without locks."""
    if folder:
        path.mkdir()
    else:
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    # Windows cannot rename an open file.
    if fcntl is None:
        return None
    handle = None
    with suppress(OSError):
        handle = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
        fcntl.flock(handle, fcntl.LOCK_EX)
    return handle


def _remove_if_dead(path: Path) -> None:
    if fcntl is None:
        return
    with suppress(OSError):
        folder = path.is_dir()
        handle = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(path) if folder else path.unlink()
        finally:
            os.close(handle)
