"""OpenEXR files of one flat part: pictures of RGB or RGBA, named planes with a JSON note, headers and raw parts."""

import contextlib
import io
import json
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
from wlm.formats.limits import PICTURE_BYTES, PICTURE_GROWTH, check_growth, check_sides
from wlm.formats.reading import open_file

MAGIC = b"\x76\x2f\x31\x01"
"""The first bytes of an EXR file."""

_SAMPLE_BYTES = 2  # of a half: the header as the library gives it doesn't tell halves from floats
_STDERR = 2
_STDERR_LOCK = threading.Lock()

HALF_MAX = 65504.0
"""The largest finite half float."""

_COLOUR = ("R", "G", "B")
_ALPHA = "A"
_NOTE = "wlm"  # the header's attribute


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
    channels = read_part(path).channels
    if any(name not in channels for name in _COLOUR):
        raise WlmError(f"{path}: expected channels R,G,B or R,G,B,A, found {','.join(channels) or 'none'}")
    names = (*_COLOUR, _ALPHA) if _ALPHA in channels else _COLOUR
    planes = [channels[name].pixels for name in names]
    for name, plane in zip(names, planes, strict=True):
        if plane is None or plane.dtype not in (np.float16, np.float32):
            content = "no pixels" if plane is None else plane.dtype
            raise WlmError(f"{path}: channel {name}: expected half or float, found {content}")
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
    planes = zip((*_COLOUR, _ALPHA), np.moveaxis(pixels, -1, 0), strict=False)
    # The library wants every plane contiguous.
    write_part(path, {name: np.ascontiguousarray(plane) for name, plane in planes}, read_exr)


def write_planes(
    path: str | os.PathLike[str],
    planes: Mapping[str, np.ndarray],
    note: Mapping[str, Any] | None = None,
    *,
    whole: tuple[str, ...] = (),
) -> None:
    """Writes planes as an EXR file of scan lines under lossless ZIP, whole or not at all.

    Args:
        path: The file to write; its folder must exist.
        planes: [H, W] each, linear, not empty; the keys name the channels.
        note: JSON that goes into the header.
        whole: Planes that stay float32; the others become half floats, and what is beyond their range +-65504.

    Raises:
        ValueError: Not planes of one shape.
        WlmError: The file can't be written; what was there before stays.
    """
    shapes = {np.shape(plane) for plane in planes.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise ValueError(f"expected planes [H, W] of one shape, got {sorted(shapes)}")
    attributes = {} if note is None else {_NOTE: json.dumps(note, allow_nan=False)}
    channels = {}
    for name, plane in planes.items():
        plane = np.asarray(plane)
        if name not in whole:
            plane = np.clip(plane, -HALF_MAX, HALF_MAX)
        channels[name] = np.ascontiguousarray(plane, np.float32 if name in whole else np.float16)
    write_part(path, channels, read_planes, attributes)


def read_planes(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Reads all channels of a single-part EXR file.

    Args:
        path: The EXR file.

    Returns:
        The planes by name, float32 [H, W], as they are in the file, NaN too; and the header's note, empty if there is
        none.

    Raises:
        WlmError: The file is missing, not an EXR, damaged, of several parts or deep, or a channel isn't half or float.
    """
    part = read_part(path)
    planes = {}
    for name, channel in part.channels.items():
        pixels = channel.pixels
        if pixels is None or pixels.dtype not in (np.float16, np.float32):
            content = "no pixels" if pixels is None else pixels.dtype
            raise WlmError(f"{path}: channel {name}: expected half or float, found {content}")
        if planes and pixels.shape != next(iter(planes.values())).shape:
            raise WlmError(f"{path}: channel {name}: expected as many pixels as the others, found {pixels.shape}")
        planes[name] = pixels.astype(np.float32)
    try:
        note = json.loads(part.header.get(_NOTE, "{}"))
    except (ValueError, TypeError, RecursionError):
        note = None
    if not isinstance(note, dict):
        raise WlmError(f"{path}: header attribute {_NOTE}: expected a JSON object")
    return planes, note


def read_part(path: str | os.PathLike[str]) -> OpenEXR.Part:
    """Reads an EXR file of one flat part.

    Returns:
        The part, its channels separate.

    Raises:
        WlmError: The file is missing, not an EXR, cut short or damaged, of several parts or deep.
    """
    size = _check_magic(path)
    file, complaints = _open(path, size)
    parts = file.parts if file is not None else []
    if not parts:
        raise WlmError(f"{path}: the EXR file is cut short or damaged: {complaints or 'no pixels found'}")
    if len(parts) > 1:
        raise WlmError(f"{path}: expected an EXR file of one part, found {len(parts)}")
    if parts[0].type() in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise WlmError(f"{path}: expected a flat EXR picture, found deep data")
    return parts[0]


def read_header(path: str | os.PathLike[str]) -> tuple[int, int, tuple[str, ...]]:
    """Reads what an EXR file says of its first part: width, height and the channels' names; no pixels.

    Raises:
        WlmError: The file is missing, not an EXR, or its header is damaged, or claims more than a picture may have.
    """
    size = _check_magic(path)
    with _captured_chatter() as chatter:
        try:
            parts = OpenEXR.File(str(path), separate_channels=True, header_only=True).parts
            _check_size(path, size, parts)
            first, last = (np.asarray(corner).tolist() for corner in parts[0].header["dataWindow"])
            names = tuple(channel.name for channel in parts[0].header["channels"])
        except (RuntimeError, ValueError, LookupError, MemoryError) as error:
            found = chatter.text or one_line(error)
            raise WlmError(f"{path}: the EXR file is cut short or damaged: {found}") from error
    return last[0] - first[0] + 1, last[1] - first[1] + 1, names


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


def _check_magic(path: str | os.PathLike[str]) -> int:
    """Checks that it is an EXR file; gives its size in bytes."""
    with open_file(path, "the EXR file") as file:
        magic, size = file.read(len(MAGIC)), os.fstat(file.fileno()).st_size
    if magic != MAGIC:
        raise WlmError(f"{path}: expected an EXR file, found other content")
    return size


def _check_size(path: str | os.PathLike[str], held: int, parts: list[OpenEXR.Part]) -> None:
    """Says where a file of so many bytes claims more pixels than it may have, or than it can hold."""
    total = 0
    for part in parts:
        first, last = (np.asarray(corner).tolist() for corner in part.header["dataWindow"])
        width, height = (end - begin + 1 for begin, end in zip(first, last, strict=True))
        check_sides(str(path), width, height)
        total += width * height * _SAMPLE_BYTES * len(part.header["channels"])
    check_growth(str(path), held, total, PICTURE_GROWTH, PICTURE_BYTES)


def _open(path: str | os.PathLike[str], size: int) -> tuple["OpenEXR.File | None", str]:
    """Opens a file; gives None or a file without parts where that failed, and what the library said."""
    with _captured_chatter() as chatter:
        try:
            # Separate channels: joined, `RGB` and `RGBA` would differ in name and layered files would be odd.
            # The header first: the library makes room for all that it claims before it reads a pixel.
            _check_size(path, size, OpenEXR.File(str(path), separate_channels=True, header_only=True).parts)
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
