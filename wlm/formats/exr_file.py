"""OpenEXR files of one part: opening and writing them, with what the library prints made into errors."""

import contextlib
import io
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from wlm.errors import WlmError, one_line
from wlm.formats.atomic import atomic_path

_MAGIC = b"\x76\x2f\x31\x01"
_STDERR = 2
_STDERR_LOCK = threading.Lock()


def read_part(path: str | os.PathLike[str]) -> OpenEXR.Part:
    """Reads an EXR file of one flat part.

    Returns:
        The part, its channels separate.

    Raises:
        WlmError: The file is missing, not an EXR, cut short or damaged, of several parts or deep.
    """
    _check_magic(path)
    file, complaints = _open(path)
    parts = file.parts if file is not None else []
    if not parts:
        raise WlmError(f"{path}: the EXR file is cut short or damaged: {complaints or 'no pixels found'}")
    if len(parts) > 1:
        raise WlmError(f"{path}: expected an EXR file of one part, found {len(parts)}")
    if parts[0].type() in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise WlmError(f"{path}: expected a flat EXR picture, found deep data")
    return parts[0]


def write_part(
    path: str | os.PathLike[str],
    channels: Mapping[str, np.ndarray],
    read: Callable[[Path], object],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Writes channels as an EXR file of scan lines under lossless ZIP, whole or not at all.

    Args:
        path: The file to write; its folder must exist.
        channels: half or float [H, W] each, contiguous, not empty.
        read: Reads the file back, before it takes its place; raises WlmError.
        attributes: More for the header.

    Raises:
        WlmError: The file can't be written; what was there before stays.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    with atomic_path(path) as temporary:
        with _captured_chatter() as chatter:
            try:
                OpenEXR.File(header, dict(channels)).write(str(temporary))
            except (RuntimeError, ValueError) as error:
                reason = one_line(error).replace(str(temporary), str(path))
                raise WlmError(f"{path}: cannot write: {reason}") from error
        if chatter.text:
            raise WlmError(f"{path}: cannot write: {chatter.text}")
        # The library says nothing where a full disk swallows what it still held when it closed the file.
        try:
            read(temporary)
        except WlmError as error:
            reason = str(error).replace(str(temporary), "the file as written")
            raise WlmError(f"{path}: cannot write: {reason}; is the disk full?") from error


def _check_magic(path: str | os.PathLike[str]) -> None:
    try:
        # A FIFO would block and a device has no end.
        if Path(path).exists() and not Path(path).is_file():
            raise WlmError(f"{path}: expected an EXR file, found a folder or a device")
        with open(path, "rb") as file:
            magic = file.read(len(_MAGIC))
    except OSError as error:
        raise WlmError(f"{path}: cannot read the EXR file: {error.strerror or error}") from error
    if magic != _MAGIC:
        raise WlmError(f"{path}: expected an EXR file, found other content")


def _open(path: str | os.PathLike[str]) -> tuple["OpenEXR.File | None", str]:
    """Opens a file; gives None or a file without parts where that failed, and what the library said."""
    with _captured_chatter() as chatter:
        try:
            # Separate channels: joined, `RGB` and `RGBA` would differ in name and layered files would be odd.
            file = OpenEXR.File(str(path), separate_channels=True)
        except (RuntimeError, ValueError, MemoryError) as error:
            return None, chatter.text or one_line(error)
    # A part that could not be read is missing from the list, and only the chatter tells.
    return file, chatter.text


class _Chatter:
    """What OpenEXR printed in a block, on one line."""

    text = ""


@contextlib.contextmanager
def _captured_chatter() -> Iterator[_Chatter]:
    """Catches what OpenEXR prints: its C library on the process's stderr, its Python module on sys.stdout.

    Lines of others, from other threads for example, are passed on afterwards.
    """
    chatter = _Chatter()
    printed = io.StringIO()
    with _STDERR_LOCK, tempfile.TemporaryFile() as sink:
        saved = os.dup(_STDERR)
        os.dup2(sink.fileno(), _STDERR)
        try:
            with contextlib.redirect_stdout(printed):
                yield chatter
        finally:
            os.dup2(saved, _STDERR)
            sink.seek(0)
            lines = sink.read().splitlines(keepends=True)
            ours = [line for line in lines if b"(EXR_ERR_" in line]
            for line in lines:
                if line not in ours:
                    os.write(saved, line)
            os.close(saved)
            # The reason follows the code; what precedes it is the file's name, which our own line has.
            reasons = [line.decode(errors="replace").partition(") ")[2] for line in ours]
            messages = "; ".join(dict.fromkeys(map(str.strip, reasons))) or printed.getvalue()
            chatter.text = one_line(messages, 200)
