"""Folders of files that belong together: claimed before long work, made beside their place and moved in whole.

An index file, JSON with a `format` of its own, says whose folder it is. It is written last: a folder whose index is
whole holds all that the index names.
"""

import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write, sync_folder
from wlm.formats.lock import is_passing, locked, temporary
from wlm.formats.reading import read_json_file

UNFINISHED = "unfinished"
"""Key of an index that stands in while files are being moved in."""

_NUMBERS = re.compile(r"\[\n([^\[\]{}\"]*)\]")


def claim(folder: Path, index: str, format_name: str) -> None:
    """Checks, before long work, that a folder can be written and holds nothing of others.

    Args:
        folder: Where; it need not exist.
        index: Name of the index file.
        format_name: The index's `format`.

    Raises:
        WlmError: It is a file, holds something other than an earlier output, or it or its parent can't be written.
    """
    try:
        if folder.exists() and read_index(folder / index).get("format") != format_name:
            # What a killed process left in the making is no file of anybody's.
            if not all(is_passing(path.name) for path in folder.iterdir()):
                raise WlmError(f"{folder}: expected an empty folder or one of an earlier output, found other files")
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
    parent = folder.resolve().parent
    if not parent.is_dir():
        raise WlmError(f"{folder}: cannot write: the folder {parent} does not exist")
    for place in (parent, folder):
        if place.exists() and not os.access(place, os.W_OK):
            raise WlmError(f"{folder}: cannot write: the folder {place} is read-only")


@contextmanager
def made_parents(folder: Path) -> Iterator[None]:
    """Makes the folders above a folder, for an output that may lie deeper than `claim` allows.

    Those that it made go again where the block raises, as far as they are empty.

    Raises:
        WlmError: They can't be made.
    """
    parent = Path(os.path.abspath(folder)).parent
    missing = [each for each in (parent, *parent.parents) if not each.exists()]
    try:
        try:
            parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
        yield
    except BaseException:
        with suppress(OSError):
            for each in missing:
                each.rmdir()
        raise


@contextmanager
def staged(folder: Path, index: str, format_name: str, ours: Callable[[str], bool]) -> Iterator[Path]:
    """Yields a new folder beside the real one, and moves its files there at the end if nothing went wrong.

    The index is moved last. Where the moving is stopped half-way, the folder's index says `UNFINISHED`: it can't be
    read, but can be written again.

    Args:
        folder: Where; claimed, made if it isn't there.
        index: Name of the index file, which the block has to write.
        format_name: The index's `format`.
        ours: Whether a name is one that such an output may have: files of an earlier output that the new one lacks are
            removed.

    Raises:
        WlmError: A file can't be written, messages name the real folder; or another process is writing there.
    """
    with locked(folder):
        claim(folder, index, format_name)
        try:
            with temporary(Path(os.path.realpath(folder)), folder=True) as made:
                yield made
                _move(made, folder, index, format_name, ours)
        except OSError as error:
            raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
        except WlmError as error:
            raise WlmError(str(error).replace(str(made), str(folder))) from error


def _move(made: Path, folder: Path, index: str, format_name: str, ours: Callable[[str], bool]) -> None:
    """Moves an output's files into their folder."""
    names = {path.name for path in made.iterdir()}
    folder.mkdir(exist_ok=True)
    # An old index must not vouch for new files, nor may the folder become one that can't be written again.
    write_index(folder / index, {"format": format_name, UNFINISHED: True})
    for path in sorted(folder.iterdir()):
        if path.name != index and path.name not in names and ours(path.name):
            path.unlink(missing_ok=True)
    for name in sorted(names - {index}):
        os.replace(made / name, folder / name)
    sync_folder(folder)
    os.replace(made / index, folder / index)
    sync_folder(folder)


def read_index(path: Path) -> dict[str, Any]:
    """Reads an index; empty where there is none or it isn't a JSON object."""
    try:
        content = read_json_file(path, "the index")
    except WlmError:
        content = None
    return content if isinstance(content, dict) else {}


def write_index(path: Path, content: dict[str, Any]) -> int:
    """Writes an index, whole or not at all, as `compact_json`."""
    return atomic_write(path, compact_json(content).encode())


def compact_json(content: Any) -> str:
    """JSON with one key per line, and each list of numbers on one line.

    Raises:
        ValueError: A number is NaN or infinite.
    """
    text = json.dumps(content, indent=1, allow_nan=False)
    # One number per line would be most of the file. Strings hold no raw line break, so none of them is touched.
    return _NUMBERS.sub(lambda match: "[" + " ".join(match[1].split()) + "]", text) + "\n"


def rounded(values: np.ndarray) -> list[Any]:
    """Nested lists of float32 numbers, each with the nine digits that lead back to it and not float64's seventeen."""
    values = np.asarray(values, np.float64)
    if values.ndim > 1:
        return [rounded(row) for row in values]
    return [float(f"{value:.9g}") for value in values.tolist()]
