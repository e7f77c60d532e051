"""OpenEXR files of one flat part: pictures of RGB or RGBA, single-channel images with a JSON note, and headers."""

import contextlib
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from wlm.errors import WlmError, one_line
from wlm.formats.atomic import atomic_path
from wlm.formats.exr_header import check_header
from wlm.formats.stderr import captured_stderr

HALF_MAX = 65504.0
"""The largest finite half float."""

_COLOUR = ("R", "G", "B")
_ALPHA = "A"
_NOTE = "wlm"  # the header's attribute


def read_exr(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the colour channels of a single-part EXR file, over its data window.

    Half and float files are read, scan lines or tiles. Channels other than R, G, B and A are ignored. Values are
    returned unchanged, NaN and infinity included.

    Returns:
        The pixels, float32 [H, W, 3 or 4], and the names of the channels, ("R", "G", "B") or ("R", "G", "B", "A").

    Raises:
        WlmError: The file is missing, is not an EXR file, is cut short or damaged, has several parts or deep data, or
            lacks one of R, G and B.
    """
    channels = read_part(path).channels
    if any(name not in channels for name in _COLOUR):
        raise WlmError(f"{path}: expected channels R,G,B or R,G,B,A, found {','.join(channels) or 'none'}")
    names = (*_COLOUR, _ALPHA) if _ALPHA in channels else _COLOUR
    return float_pixels(path, channels, names), names


def float_pixels(path: str | os.PathLike[str], channels: Mapping[str, Any], names: Sequence[str]) -> np.ndarray:
    """Returns the pixels of the channels `names` of an EXR part, float32 [H, W, C].

    Raises:
        WlmError: See `float_planes`.
    """
    pixels = np.zeros(0, np.float32)
    for index, plane in enumerate(float_planes(path, channels, names)):
        if not index:
            pixels = np.empty((*plane.shape, len(names)), np.float32)
        pixels[..., index] = plane
    return pixels


def float_planes(
    path: str | os.PathLike[str], channels: Mapping[str, Any], names: Iterable[str]
) -> Iterator[np.ndarray]:
    """Yields the pixels of the channels `names` of an EXR part, float32 [H, W] each.

    Raises:
        WlmError: A channel is neither half nor float, or has another shape than the first.
    """
    shape = None
    for name in names:
        pixels = channels[name].pixels
        if pixels is None or pixels.dtype not in (np.float16, np.float32):
            content = "no pixels" if pixels is None else pixels.dtype
            raise WlmError(f"{path}: channel {name}: expected half or float, found {content}")
        shape = pixels.shape if shape is None else shape
        if pixels.shape != shape:
            raise WlmError(f"{path}: channel {name}: expected {shape} pixels, found {pixels.shape}")
        yield pixels.astype(np.float32, copy=False)


def write_exr(path: str | os.PathLike[str], pixels: np.ndarray, half: bool = True) -> None:
    """Writes linear pixels [H, W, 3 or 4] as an EXR file of scan lines with lossless ZIP compression, atomically.

    With `half` they are rounded to half floats: values beyond their range, infinity included, become +-65504; NaN
    stays.

    Raises:
        ValueError: The pixels' shape is not [H, W, 3 or 4].
        WlmError: The file cannot be written; the old content stays.
    """
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise ValueError(f"expected pixels [H, W, 3 or 4], got {pixels.shape}")
    pixels = np.clip(pixels, -HALF_MAX, HALF_MAX).astype(np.float16) if half else pixels.astype(np.float32, copy=False)
    planes = zip((*_COLOUR, _ALPHA), np.moveaxis(pixels, -1, 0), strict=False)
    # The library requires contiguous planes.
    write_part(path, {name: np.ascontiguousarray(plane) for name, plane in planes}, read_exr)


def write_planes(
    path: str | os.PathLike[str],
    planes: Mapping[str, np.ndarray],
    note: Mapping[str, Any] | None = None,
    *,
    whole: tuple[str, ...] = (),
) -> None:
    """Writes single-channel images (planes) as one EXR file with lossless ZIP compression, atomically.

    Args:
        path: The file to write; its folder must exist.
        planes: [H, W] each, linear, not empty; the keys name the channels.
        note: JSON object that is stored in the header.
        whole: Names of the planes that stay float32. The others become half floats, clamped to +-65504.

    Raises:
        ValueError: The planes differ in shape.
        WlmError: The file cannot be written; the old content stays.
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

    Returns:
        The planes by name, float32 [H, W], unchanged, NaN included; and the note of the header, empty if the file has
        none.

    Raises:
        WlmError: The file is missing, is not an EXR file, is damaged, has several parts or deep data, or a channel is
            neither half nor float.
    """
    part = read_part(path)
    planes = dict(zip(part.channels, float_planes(path, part.channels, part.channels), strict=True))
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
        The part as an object of the OpenEXR module, with separate channels.

    Raises:
        WlmError: The file is missing, is not an EXR file, is cut short or damaged, has several parts or deep data.
    """
    file, complaints = _open(path)
    parts = file.parts if file is not None else []
    if not parts:
        raise WlmError(f"{path}: the EXR file is cut short or damaged: {complaints or 'no pixels found'}")
    if len(parts) > 1:
        raise WlmError(f"{path}: expected an EXR file of one part, found {len(parts)}")
    return parts[0]


def read_header(path: str | os.PathLike[str]) -> tuple[int, int, tuple[str, ...]]:
    """Reads the width, height and channel names of the first part of an EXR file, without its pixels.

    Raises:
        WlmError: See `wlm.formats.exr_header.check_header`.
    """
    part = check_header(path)[0]
    return part.width, part.height, part.channels


def write_part(
    path: str | os.PathLike[str],
    channels: Mapping[str, np.ndarray],
    read: Callable[[Path], object],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Writes channels as an EXR file of scan lines with lossless ZIP compression, atomically.

    Args:
        path: The file to write; its folder must exist.
        channels: half or float [H, W] each, contiguous, not empty.
        read: Called with the new file before it replaces an old one; raises WlmError if the file cannot be read.
        attributes: Further header attributes.

    Raises:
        WlmError: The file cannot be written; the old content stays.
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
        # The library reports no error if the disk is full when it flushes its buffer at the end.
        try:
            read(temporary)
        except WlmError as error:
            reason = str(error).replace(str(temporary), "the file as written")
            raise WlmError(f"{path}: cannot write: {reason}; is the disk full?") from error


def _open(path: str | os.PathLike[str]) -> tuple["OpenEXR.File | None", str]:
    """Returns the opened file and the library's messages; on failure the file is None or has no parts."""
    check_header(path)
    with _captured_chatter() as chatter:
        try:
            # Channels are kept separate, since joined ones have other names in RGB, RGBA and layered files.
            file = OpenEXR.File(str(path), separate_channels=True)
        except (RuntimeError, ValueError, MemoryError) as error:
            return None, chatter.text or one_line(error)
    # A part that cannot be read is missing from the list; only the printed message reports it.
    return file, chatter.text


class _Chatter:
    """Collects the messages that OpenEXR prints in a block, joined to one line in `text`."""

    text = ""


@contextlib.contextmanager
def _captured_chatter() -> Iterator[_Chatter]:
    """Captures what OpenEXR prints in the block: its C library to the stderr, its Python module to sys.stdout."""
    chatter, printed = _Chatter(), io.StringIO()
    lines: list[bytes] = []
    try:
        with captured_stderr(lambda line: b"(EXR_ERR_" in line) as lines, contextlib.redirect_stdout(printed):
            yield chatter
    finally:
        # The reason follows the error code; our own message names the file.
        reasons = [line.decode(errors="replace").partition(") ")[2] for line in lines]
        messages = "; ".join(dict.fromkeys(map(str.strip, reasons))) or printed.getvalue()
        chatter.text = one_line(messages, 200)
