"""Output folders: checked before long work, written to a temporary folder, and moved into place as a whole.

An index file, JSON with its own `format`, identifies the folder. It is written last, so a folder with a complete index
holds all files that the index lists.
"""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write, sync_folder
from wlm.formats.lock import is_passing, locked, temporary
from wlm.formats.reading import read_json_file, system_errors

UNFINISHED = "unfinished"
"""Key that marks the temporary index of a folder while files are moved into it."""

_NAME = re.compile(r"([\w.-]+/)?[\w.-]+")
_NUMBERS = re.compile(r"\[\n([^\[\]{}\"]*)\]")


def claim(folder: Path, index: str, format_name: str) -> None:
    """Checks, before long work, that a folder can be written and holds no files other than an earlier output. The
    earlier output is recognised by its index file and the `format` in it."""
    with system_errors(f"{folder}: cannot write there"):
        if folder.exists() and read_index(folder / index).get("format") != format_name:
            # Temporary files of a killed process do not count.
            if not all(is_passing(path.name) for path in folder.iterdir()):
                raise WlmError(f"{folder}: expected an empty folder or an earlier output, found other files")
    parent = folder.resolve().parent
    if not parent.is_dir():
        raise WlmError(f"{folder}: cannot write: the folder {parent} does not exist")
    for place in (parent, folder):
        if place.exists() and not os.access(place, os.W_OK):
            raise WlmError(f"{folder}: cannot write: the folder {place} is read-only")


@contextmanager
def made_parents(folder: Path) -> Iterator[None]:
    """Creates the missing parent folders of an output, and removes them again if the block raises."""
    parent = Path(os.path.abspath(folder)).parent
    missing = [each for each in (parent, *parent.parents) if not each.exists()]
    try:
        with system_errors(f"{folder}: cannot write there"):
            parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with suppress(OSError):
            for each in missing:
                each.rmdir()
        raise


@contextmanager
def staged(folder: Path, index: str, format_name: str) -> Iterator[Path]:
    """Yields a temporary folder beside the real one, which is made if it does not exist, and moves its files into the
    real one if nothing went wrong.

    The files may lie in subfolders. The block has to write the index, whose `format` is `format_name`. It is moved
    last, with the files' names as its entry "files"; files that the index of an earlier output lists and the new one
    lacks are removed. If the move is interrupted, the folder's index is marked `UNFINISHED`: it cannot be read, but it
    can be written again.
    """
    with locked(folder), system_errors(f"{folder}: cannot write there"):
        claim(folder, index, format_name)
        try:
            with temporary(Path(os.path.realpath(folder)), folder=True) as made:
                yield made
                _move(made, folder, index, format_name)
        except WlmError as error:
            raise WlmError(str(error).replace(str(made), str(folder))) from error


def _move(made: Path, folder: Path, index: str, format_name: str) -> None:
    names = sorted(path.relative_to(made).as_posix() for path in made.rglob("*") if path.is_file())
    names.remove(index)
    old = set(_listed(folder, index))
    write_index(made / index, read_index(made / index) | {"files": names})
    try:
        folder.mkdir(exist_ok=True)
        # An old index must not seem to describe new files, and a later run must be able to write the folder.
        write_index(folder / index, {"format": format_name, UNFINISHED: True, "files": sorted(old | set(names))})
    except WlmError:
        with suppress(OSError):
            folder.rmdir()  # only if it is empty, so that a full disk leaves no new folder
        raise
    for name in sorted(old - set(names)):
        (folder / name).unlink(missing_ok=True)
    for parent in {(folder / name).parent for name in old} - {folder}:
        with suppress(OSError):
            parent.rmdir()
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        os.replace(made / name, folder / name)
    sync_folder(folder)
    os.replace(made / index, folder / index)
    sync_folder(folder)


def _listed(folder: Path, index: str) -> list[str]:
    """Returns the existing files that an earlier output's index lists, except hidden files and ones in deep folders."""
    listed = read_index(folder / index).get("files")
    names = [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []
    safe = [name for name in names if _NAME.fullmatch(name) and not any(p.startswith(".") for p in name.split("/"))]
    return [name for name in safe if (folder / name).is_file() and not (folder / name).parent.is_symlink()]


def read_index(path: Path) -> dict[str, Any]:
    """Reads an index; an empty mapping if the file is missing or not a JSON object."""
    try:
        content = read_json_file(path, "the index")
    except WlmError:
        content = None
    return content if isinstance(content, dict) else {}


def write_index(path: Path, content: dict[str, Any]) -> int:
    """Writes an index atomically, formatted by `compact_json`; returns its size in bytes."""
    return atomic_write(path, compact_json(content).encode())


def compact_json(content: Any) -> str:
    """Returns JSON text with one key per line, and each list of numbers on one line."""
    text = json.dumps(content, indent=1, allow_nan=False)
    # Otherwise each number would have its own line. JSON strings hold no raw line break, so they are not changed.
    return _NUMBERS.sub(lambda match: "[" + " ".join(match[1].split()) + "]", text) + "\n"


def rounded(values: np.ndarray) -> list[Any]:
    """Converts float32 numbers to nested lists, each rounded to the nine digits that identify it."""
    values = np.asarray(values, np.float64)
    if values.ndim > 1:
        return [rounded(row) for row in values]
    return [float(f"{value:.9g}") for value in values.tolist()]
