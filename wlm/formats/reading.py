"""Safe reading of untrusted files: opened once, regular files only, up to a stated size; and references to files."""

import io
import json
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from wlm.errors import WlmError, one_line
from wlm.formats.limits import INDEX_BYTES, INTEGER, JSON_GROWTH, SURE_JSON, Budget

# Windows lacks the first two, and no file name blocks there. The last one disables newline translation.
_FLAGS = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_BINARY"))

_POINTER = b"version https://git-lfs"  # the first bytes of the text that stands for a file which was not fetched
_MANY_DIGITS = re.compile(rb"\d{19}")
_LONGEST_INTEGER = 40  # characters

_LONGEST_NAME = 1024  # characters; systems allow 255 for each component


@contextmanager
def open_file(path: str | os.PathLike[str], what: str) -> Iterator[BinaryIO]:
    """Opens a regular file; system errors inside the block become one-line errors that name it. Links are followed.
    `what` describes the file in messages, for example "the OBJ file"."""
    try:
        # Opened without blocking, since a pipe without a writer would never open.
        handle = os.open(path, _FLAGS)
    except OSError as error:
        raise WlmError(f"{path}: cannot read {what}: {error.strerror or error}") from error
    except ValueError as error:  # a NUL or an unpaired surrogate
        raise WlmError(f"{path}: cannot read {what}: the name has a NUL or invalid Unicode") from error
    try:
        # Checked after opening: before, the name could be given to another file.
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise WlmError(f"{path}: cannot read {what}: expected a file, found a folder, a device or a pipe")
        with os.fdopen(handle, "rb", closefd=False) as file:
            if file.read(len(_POINTER)) == _POINTER:
                raise WlmError(
                    f"{path}: cannot read {what}: found a pointer of Git LFS: run git lfs pull to fetch the file"
                )
            file.seek(0)
            yield file
    except OSError as error:
        raise WlmError(f"{path}: cannot read {what}: {error.strerror or error}") from error
    finally:
        os.close(handle)


def read_file(path: str | os.PathLike[str], limit: int, what: str, first: int | None = None) -> bytes:
    """Reads a regular file of at most `limit` bytes, or its first `first` bytes."""
    with open_file(path, what) as file:
        size = os.fstat(file.fileno()).st_size
        if first is not None and first > size:
            raise WlmError(f"{path}: cannot read {what}: expected {first} bytes, found {size}")
        wanted = size if first is None else first
        if wanted > limit:
            raise WlmError(f"{path}: cannot read {what}: expected at most {limit} bytes, found {wanted}")
        # One byte more than the size, to detect that the file grows.
        data = file.read(wanted + (first is None))
    if len(data) != wanted:
        raise WlmError(f"{path}: cannot read {what}: expected {wanted} bytes, found {len(data)}; has it changed?")
    return data


def read_json_file(path: str | os.PathLike[str], what: str, limit: int = INDEX_BYTES) -> Any:
    """Reads a JSON file in UTF-8 of at most `limit` bytes."""
    return parse_json(str(path), read_file(path, limit, what))


def parse_json(where: str, data: bytes) -> Any:
    """Parses a JSON text in UTF-8, if its values take no more memory than its length makes likely."""
    check_json(where, data)
    # Python makes integers of any length, which no array holds.
    whole = _whole if _MANY_DIGITS.search(data) else None
    with damaged(f"{where}: not valid JSON", ValueError, RecursionError, MemoryError):
        return json.loads(data, parse_int=whole)


def check_json(where: str, data: bytes) -> None:
    """Checks the memory that the values of a JSON text would take, before it is parsed."""
    budget = Budget(where, max(SURE_JSON, JSON_GROWTH * len(data)), "bytes of values in JSON")
    # Sizes in Python: an object with its table, a list with room for some items, an item with its number, half a text.
    for mark, size in ((b"{", 232), (b"[", 88), (b",", 40), (b'"', 32)):
        budget.spend(size * data.count(mark))


def _whole(text: str) -> int:
    value = int(text) if len(text) < _LONGEST_INTEGER else 2 * INTEGER
    if not -INTEGER <= value < 2 * INTEGER:
        raise ValueError(f"expected integers within 64 bits, found {text[:_LONGEST_INTEGER]}")
    return value


class FileBytes:
    """An open file as a sequence of bytes, of which only the slices that are asked for are read."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._size = file, os.fstat(file.fileno()).st_size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        self._file.seek(part.start)
        return self._file.read(part.stop - part.start)


class OpenFile:
    """A file that stays open, of which any bytes are read when they are needed. Several threads may read at once.

    It is closed by `close`, or with the last reference to it. Reads use `os.pread`, not a mapping: of a file that is
    cut while it is open a read is an error, where a mapping would end the process.
    """

    def __init__(self, file: BinaryIO) -> None:
        """Keeps a file open beyond the end of `open_file`."""
        self._file: _Handle | None = _Handle(os.dup(file.fileno()), "rb")

    def read(self, start: int, size: int) -> bytes:
        """Reads `size` bytes from byte `start` on. Raises a ValueError if the file was closed or cut short, or cannot
        be read."""
        # With its own reference, so that `close` in another thread does not end it during the read.
        handle, data = self._file, b""
        if handle is None:
            raise ValueError("the file was closed")
        try:
            while len(data) < size and (more := os.pread(handle.fileno(), size - len(data), start + len(data))):
                data += more
        except OSError as error:
            raise ValueError(f"cannot read: {error.strerror or error}") from error
        if len(data) < size:
            raise ValueError(f"the file was cut short: expected {size} bytes, found {len(data)}")
        return data

    def close(self) -> None:
        """Closes the file once no thread reads from it; later reads are errors. A second call does nothing."""
        self._file = None


class _Handle(io.FileIO):
    """A file that is closed with its last reference, without the warning of its base class."""

    def __del__(self) -> None:
        self.close()


@contextmanager
def system_errors(text: str) -> Iterator[None]:
    """Turns an error of the operating system in the block into a line: a text, "a.png: cannot read", and a reason."""
    try:
        yield
    except OSError as error:
        raise WlmError(f"{text}: {error.strerror or error}") from error


@contextmanager
def damaged(message: str, *errors: type[Exception]) -> Iterator[None]:
    """Turns the given exceptions, raised in the block by damaged data, into a one-line error: message and reason."""
    try:
        yield
    except WlmError:
        raise
    except errors as error:
        raise WlmError(f"{message}: {one_line(error, 120) or type(error).__name__}") from error


def named_file(document: str | os.PathLike[str], name: str, where: str, trust: bool | None = False) -> Path:
    """Returns the path of a file that a document names, which must be inside the document's folder, links resolved,
    unless the document is trusted.

    An untrusted document could otherwise make this package read any file and copy it into an output. `name` is relative
    to the folder of the document; `where` names the document and its field in messages. `trust` is None for documents
    that cannot be trusted.
    """
    if len(name) > _LONGEST_NAME:
        raise WlmError(f"{where}: expected a name of at most {_LONGEST_NAME} characters, found {len(name)}")
    folder = Path(document).parent
    path = folder / name
    try:
        # Nearly all names are plain, for which one access to the disk is enough.
        plain = name not in (".", "..") and os.path.basename(name) == name and not os.path.islink(path)
        inside = trust or plain or path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:  # a name that is too long or has a NUL, or a cycle of links
        raise WlmError(f"{where}: cannot resolve the file name {name}: {error}") from error
    if not inside:
        hint = "; trust=True (--trust on the command line) allows files elsewhere, for documents from a trusted author"
        raise WlmError(f"{where}: expected a file within {folder}, found {name}{'' if trust is None else hint}")
    return path
