"""Reading and writing OpenEXR pictures of RGB or RGBA."""

import contextlib
import io
import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR

from wlm.errors import WlmError, one_line
from wlm.formats.atomic import atomic_path

__all__ = ["HALF_MAX", "read_exr", "write_exr"]

HALF_MAX = 65504.0
"""The largest finite half float."""

_MAGIC = b"\x76\x2f\x31\x01"
_COLOUR = ("R", "G", "B")
_ALPHA = "A"
_STDERR = 2
_STDERR_LOCK = threading.Lock()


def read_exr(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the colour channels of a single-part EXR file, over its data window.

    Half and float files are read, scan lines or tiles. Channels other than R, G, B and A are left out. Values
    come as they are in the file, NaN and Inf too: the caller checks what it can't use.

    Args:
        path: The EXR file.

    Returns:
        The pixels, float32 [H, W, 3 or 4], and the channels' names, ("R", "G", "B") or ("R", "G", "B", "A").

    Raises:
        WlmError: The file is missing, not an EXR, cut short or damaged, has several parts or deep data, or
            lacks one of R, G and B.
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
    channels = parts[0].channels
    if any(name not in channels for name in _COLOUR):
        raise WlmError(f"{path}: expected channels R,G,B or R,G,B,A, found {','.join(channels) or 'none'}")
    names = (*_COLOUR, _ALPHA) if _ALPHA in channels else _COLOUR
    planes = [channels[name].pixels for name in names]
    for name, plane in zip(names, planes, strict=True):
        if plane is None or plane.dtype not in (np.float16, np.float32):
            found = "no pixels" if plane is None else plane.dtype
            raise WlmError(f"{path}: channel {name}: expected half or float, found {found}")
        if plane.shape != planes[0].shape:
            raise WlmError(f"{path}: channel {name}: expected {planes[0].shape} pixels, found {plane.shape}")
    return np.stack(planes, axis=-1).astype(np.float32, copy=False), names


def write_exr(path: str | os.PathLike[str], pixels: np.ndarray, half: bool = True) -> None:
    """Writes RGB or RGBA pixels as an EXR file of scan lines under lossless ZIP, whole or not at all.

    Args:
        path: The file to write; its folder must exist.
        pixels: Linear values, [H, W, 3 or 4], neither side empty.
        half: Whether to round to half floats. Values beyond their range, Inf too, become +-65504; NaN stays.

    Raises:
        ValueError: The shape isn't that of a picture.
        WlmError: The file can't be written; what was there before stays.
    """
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise ValueError(f"expected pixels [H, W, 3 or 4], got {pixels.shape}")
    if half:
        pixels = np.clip(pixels, -HALF_MAX, HALF_MAX).astype(np.float16)
    else:
        pixels = pixels.astype(np.float32, copy=False)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = dict(zip((*_COLOUR, _ALPHA), np.moveaxis(pixels, -1, 0), strict=False))
    # The library wants every plane contiguous.
    picture = OpenEXR.File(header, {name: np.ascontiguousarray(plane) for name, plane in planes.items()})
    with atomic_path(path) as temporary:
        with _captured_chatter() as chatter:
            try:
                picture.write(str(temporary))
            except (RuntimeError, ValueError) as error:
                reason = one_line(error).replace(str(temporary), str(path))
                raise WlmError(f"{path}: cannot write: {reason}") from error
        if chatter.text:
            raise WlmError(f"{path}: cannot write: {chatter.text}")
        # The library says nothing where a full disk swallows what it still held when it closed the file.
        try:
            read_exr(temporary)
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
            said = "; ".join(dict.fromkeys(map(str.strip, reasons))) or printed.getvalue()
            chatter.text = one_line(said, 200)
