"""Locks that fall away with their process: on an output while it is written, and on what a write has in the making.

What is in the making has a name such as `.wlm-0123456789abcdef-0123456789abcdef.tmp`, beside its destination: a hash of
the destination's name, and a random number. Its maker holds a lock on it, so one without a lock was left by a process
that was killed, and the next write to that destination removes it.

Where the system has no such locks (Windows, some file systems of networks) there are none: nobody is kept from an
output, and nothing is removed.
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
_held: Counter[Path] = Counter()  # outputs that this process has locked, and how many times


def is_passing(name: str) -> bool:
    """Whether a file's name is that of a lock or of what is in the making: nothing that a folder holds."""
    return _PASSING.fullmatch(name) is not None


@contextmanager
def locked(output: str | os.PathLike[str]) -> Iterator[None]:
    """Keeps other processes from writing an output, and removes what killed ones left of it.

    The lock is on a file beside the output that is gone at the end. Within one process locks may be nested.

    Args:
        output: A file or a folder; it need not exist.

    Raises:
        WlmError: Another process has the lock.
    """
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
            # Before it is released: otherwise it could be another process's by then.
            with suppress(OSError):
                lock.unlink()
            os.close(handle)


@contextmanager
def temporary(target: Path, *, folder: bool = False) -> Iterator[Path]:
    """Makes an empty file or folder beside its destination, and removes it at the end if it is still there.

    Args:
        target: The destination, without links.
        folder: Whether it is a folder.

    Yields:
        Its path. The name is short: the destination's may already be as long as the system allows.

    Raises:
        OSError: It can't be made.
    """
    sweep(target)
    handle = None
    try:
        while True:
            path = target.parent / f"{_stem(target)}-{secrets.token_hex(8)}.tmp"
            handle = _make(path, folder)
            # Another process may have taken it for a dead one's before it was locked.
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
    """Removes what killed processes left of writing to a file or folder: beside it, and in the folder."""
    stem = _stem(target)
    for parent, prefix in ((target.parent, f"{stem}-"), (target, ".wlm-")):
        with suppress(OSError):
            for name in os.listdir(parent):
                if name.startswith(prefix) and name.endswith(".tmp") and is_passing(name):
                    _remove_if_dead(parent / name)


def _stem(target: Path) -> str:
    return f".wlm-{hashlib.blake2b(os.fsencode(target.name), digest_size=8).hexdigest()}"


def _acquire(lock: Path, output: str | os.PathLike[str]) -> int | None:
    """Locks a file, which is made if it isn't there; None where that can't be."""
    while fcntl is not None:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            # Writing will say what is wrong with the folder.
            return None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        except BlockingIOError:
            os.close(handle)
            raise WlmError(f"{output}: is being written by another process") from None
        except FileNotFoundError:
            # Its holder ended, and took it along, after it was opened.
            os.close(handle)
            continue
        except OSError:
            os.close(handle)
            lock.unlink(missing_ok=True)
            return None
        os.close(handle)
    return None


def _make(path: Path, folder: bool) -> int | None:
    """Makes a file or folder and locks it; returns the lock's handle, None where there are no locks."""
    if folder:
        path.mkdir()
    else:
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    # Windows renames no file that is open.
    if fcntl is None:
        return None
    handle = None
    with suppress(OSError):
        handle = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
        fcntl.flock(handle, fcntl.LOCK_EX)
    return handle


def _remove_if_dead(path: Path) -> None:
    """Removes a file or folder in the making whose process is gone."""
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
