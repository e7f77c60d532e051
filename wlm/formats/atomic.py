"""Atomic writing: a file is written completely or not at all."""

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wlm.errors import WlmError
from wlm.formats.lock import temporary
from wlm.formats.reading import system_errors


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yields the path of an empty temporary file beside `path`, which replaces `path` at the end.

    If the block raises, the temporary file is removed and `path` keeps its content. If the process is killed, `path`
    keeps its content too, and the next write to it removes the temporary file. A link is followed: its target is
    replaced.
    """
    # Links are resolved first: os.replace would replace the link itself.
    target = Path(os.path.realpath(path))
    with system_errors(f"{path}: cannot write"):
        # Renaming over a device such as /dev/null would destroy it.
        if os.path.lexists(target) and not stat.S_ISREG(os.stat(target).st_mode):
            raise WlmError(f"{path}: cannot write: expected a file or none, found a folder, a device or a pipe")
        if not target.parent.is_dir():
            raise WlmError(f"{path}: cannot write: the folder {target.parent} does not exist")
        with temporary(target) as part:
            yield part
            # Without fsync, a crash of the machine after the rename could leave an empty file.
            handle = os.open(part, os.O_RDWR)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
            os.replace(part, target)
            sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Makes renames in a folder survive a crash of the machine, on systems that can (Windows cannot)."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def atomic_write(path: str | os.PathLike[str], data: bytes | Iterable[bytes]) -> int:
    """Writes a file completely or not at all, and returns its number of bytes; see `atomic_path`. `data` is the
    content, or its pieces in order, as objects with the buffer protocol."""
    chunks = [data] if isinstance(data, bytes | bytearray | memoryview) else data
    with atomic_path(path) as part, open(part, "wb") as file:
        return sum(map(file.write, chunks))
