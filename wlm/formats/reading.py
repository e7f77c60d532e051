"""Files from strangers: opened once, regular files only, read up to a stated size; and what a file may name."""

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from wlm.errors import WlmError
from wlm.formats.limits import INDEX_BYTES

# Windows lacks the first two: there, no name of a file blocks. The last keeps its bytes as they are.
_FLAGS = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_BINARY"))

_LONGEST_NAME = 1024  # characters; systems allow 255 between two slashes


@contextmanager
def open_file(path: str | os.PathLike[str], what: str) -> Iterator[BinaryIO]:
    """Opens a regular file; what the system refuses in the block is a line that names it too.

    Args:
        path: The file. Links are followed.
        what: What is read, for messages: "the OBJ file".

    Yields:
        The open file.

    Raises:
        WlmError: It is missing, a folder, a device or a pipe, or can't be read.
    """
    try:
        # Without blocking: a pipe that nobody writes to would never open.
        handle = os.open(path, _FLAGS)
    except OSError as error:
        raise WlmError(f"{path}: cannot read {what}: {error.strerror or error}") from error
    except ValueError as error:  # a NUL, or half a character
        raise WlmError(f"{path}: cannot read {what}: no file can have that name") from error
    try:
        # Checked once it is open: until then, the name could be given to another file.
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise WlmError(f"{path}: cannot read {what}: expected a file, found a folder, a device or a pipe")
        with os.fdopen(handle, "rb", closefd=False) as file:
            yield file
    except OSError as error:
        raise WlmError(f"{path}: cannot read {what}: {error.strerror or error}") from error
    finally:
        os.close(handle)


def read_file(path: str | os.PathLike[str], limit: int, what: str, first: int | None = None) -> bytes:
    """Reads a regular file.

    Args:
        path: The file.
        limit: Most bytes that it may have.
        what: What is read, for messages.
        first: Bytes to read from its beginning, no more than it has; None: all.

    Returns:
        Its bytes.

    Raises:
        WlmError: As `open_file`; or the file is larger than the limit, shorter than `first`, or changes meanwhile.
    """
    with open_file(path, what) as file:
        size = os.fstat(file.fileno()).st_size
        if first is not None and first > size:
            raise WlmError(f"{path}: cannot read {what}: expected {first} bytes, found {size}")
        wanted = size if first is None else first
        if wanted > limit:
            raise WlmError(f"{path}: cannot read {what}: expected at most {limit} bytes, found {wanted}")
        # One more than it has, to see that it has no more.
        data = file.read(wanted + (first is None))
    if len(data) != wanted:
        raise WlmError(f"{path}: cannot read {what}: expected {wanted} bytes, found another number: does it change?")
    return data


def read_json_file(path: str | os.PathLike[str], what: str, limit: int = INDEX_BYTES) -> Any:
    """Reads a JSON file in UTF-8.

    Args:
        path: The file.
        what: What is read, for messages.
        limit: Most bytes that it may have.

    Raises:
        WlmError: As `read_file`, or it isn't JSON.
    """
    data = read_file(path, limit, what)
    try:
        return json.loads(data)
    except (ValueError, RecursionError, MemoryError) as error:
        raise WlmError(f"{path}: not valid JSON: {error or 'too large for the memory'}") from error


def named_file(document: str | os.PathLike[str], name: str, where: str, trust: bool = False) -> Path:
    """Gives the file that a document names, which has to lie in the document's folder, links resolved.

    A document from a stranger could otherwise have any file of the machine read, and copied into what is written.

    Args:
        document: The file that names another.
        name: Relative to the document's folder.
        where: The document and its field, for messages.
        trust: Whether the file may lie elsewhere.

    Raises:
        WlmError: It lies elsewhere.
    """
    if len(name) > _LONGEST_NAME:
        raise WlmError(f"{where}: expected a name of at most {_LONGEST_NAME} characters, found {len(name)}")
    folder = Path(document).parent
    path = folder / name
    try:
        # Nearly all are plain names, for which one look at the disk is enough.
        plain = name not in (".", "..") and os.path.basename(name) == name and not os.path.islink(path)
        inside = trust or plain or path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:  # a name too long, a NUL in it, links in a circle
        raise WlmError(f"{where}: cannot follow the name {name}: {error}") from error
    if not inside:
        raise WlmError(
            f"{where}: expected a file within {folder}, found {name}; trust=True (--trust of commands that have it) "
            "allows it, where the author is trusted"
        )
    return path
