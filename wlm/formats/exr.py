"""OpenEXR files: pictures of RGB or RGBA, single-channel images with a JSON note, and headers.

Pictures cover the display window, whatever the data window, and have the primaries of Rec. 709. Their colour may be in
a named layer, such as `ViewLayer.Combined.R`, or in one part of several.
"""

import contextlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import OpenEXR

from wlm.errors import WlmError, one_line
from wlm.formats.atomic import atomic_path
from wlm.formats.exr_header import check_header
from wlm.formats.primaries import ACES_AP0, CIE_XYZ, REC709, to_rec709
from wlm.formats.stderr import captured_stderr

HALF_MAX = 65504.0
"""The largest finite half float."""

CROPPED = "texels outside it are 0"
"""Words of the note about a data window that leaves texels of the display window out."""

_COLOUR = ("R", "G", "B")
_ALPHA = "A"
_LETTERS = {"r": "R", "red": "R", "g": "G", "green": "G", "b": "B", "blue": "B", "a": "A", "alpha": "A"}
_MOST_NAMES, _MOST_CHANNELS = 8, 64  # layers and channels that a message lists
_NOTE = "wlm"  # the header's attribute


def read_exr(
    path: str | os.PathLike[str], notes: list[str] | None = None, layer: str | None = None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the light of an EXR file, over its display window, in the primaries of Rec. 709.

    Half and float files are read, scan lines or tiles, of one part or several. The light is in the channels R, G and B,
    also in lower case; without them in the only layer that has such channels, or in a lone channel Y, which is grey; or
    it is in the layer or part `layer`. NaN and infinity are kept. Texels of the display window that the file doesn't
    store are 0. Each assumption and conversion adds a line to `notes`.

    Returns the pixels, float32 [H, W, 3 or 4], and the names of the channels, ("R", "G", "B") or ("R", "G", "B", "A").
    """
    notes = [] if notes is None else notes
    channels = _channels(path)
    chosen = _light_channels(path, list(channels), layer, notes)
    pixels = _pixels(path, channels, list(chosen.values()), notes)
    header = channels[chosen["R"]][0].header
    if "envmap" in header:
        notes.append("its header says that it is an environment map: is it a lightmap?")
    to_rec709(pixels, _chromaticities(path, header, notes), f"{path}: chromaticities", notes)
    return pixels, tuple(chosen)


def read_every_channel(
    path: str | os.PathLike[str], notes: list[str] | None = None, light: bool = False
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads all channels of an EXR file, over its display window; each conversion adds a line to `notes`.

    With `light` the colours of each layer are light, which is converted to the primaries of Rec. 709. Returns the
    pixels, float32 [H, W, C], and the names of the channels: R, G, B and A first, others sorted. In a file of several
    parts, a name begins with that of its part, such as "beauty.R".
    """
    notes = [] if notes is None else notes
    channels, first = _channels(path), (*_COLOUR, _ALPHA)
    names = sorted(channels, key=lambda name: (first.index(name) if name in first else len(first), name))
    if not names:
        raise WlmError(f"{path}: expected channels, found none")
    pixels = _pixels(path, channels, names, notes)
    for layer in _layers(names).values() if light else ():
        chromaticities = _chromaticities(path, channels[layer["R"]][0].header, notes)
        places, lines = [names.index(layer[letter]) for letter in _COLOUR], []
        colour = pixels[..., places]
        to_rec709(colour, chromaticities, f"{path}: chromaticities", lines)
        if lines:
            pixels[..., places] = colour
            notes += [line for line in lines if line not in notes]
    return pixels, tuple(names)


_Channels = Mapping[str, tuple[OpenEXR.Part, Any]]  # the part and the channel of each name


def _channels(path: str | os.PathLike[str]) -> _Channels:
    """Reads all channels of an EXR file; in a file of several parts, a name begins with that of its part."""
    check_header(path)
    parts, reason = [], "no pixels found"
    with _captured_chatter() as chatter:
        try:
            # Channels are kept separate, since joined ones have other names in RGB, RGBA and layered files.
            parts = list(OpenEXR.File(str(path), separate_channels=True).parts)
        except (RuntimeError, ValueError, MemoryError) as error:
            reason = one_line(error)
    # A part that cannot be read is missing from the list; only the printed message reports it.
    if not parts or chatter:
        raise WlmError(f"{path}: the EXR file is cut short or damaged: {(chatter or [reason])[0]}")
    found = {}
    for part in parts:
        prefix = f"{part.name()}." if len(parts) > 1 else ""
        for name, channel in part.channels.items():
            found[name if name.startswith(prefix) else prefix + name] = (part, channel)
    return found


def _layers(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Returns the layers of colour: for each name, which is "" for channels without one, the channels of R, G, B and
    A in this order."""
    found: dict[str, dict[str, str]] = {}
    for name in names:
        layer, _, channel = name.rpartition(".")
        letter = _LETTERS.get(channel.lower())
        if letter is not None and (letter == channel or letter not in found.get(layer, ())):
            found.setdefault(layer, {})[letter] = name
    return {
        layer: {letter: channels[letter] for letter in (*_COLOUR, _ALPHA) if letter in channels}
        for layer, channels in found.items()
        if channels.keys() >= set(_COLOUR)
    }


def _light_channels(
    path: str | os.PathLike[str], names: list[str], layer: str | None, notes: list[str]
) -> dict[str, str]:
    """Returns for R, G, B and perhaps A the name of the file's channel that holds it, of `layer` or by `read_exr`."""
    layers = _layers(names)
    listed = ", ".join(f"{each!r}" for each in list(layers)[:_MOST_NAMES]) or "none"
    if layer is not None:
        if layer not in layers:
            raise WlmError(f"{path}: expected a layer of colour {layer!r}, found {listed}")
        return layers[layer]
    if "" in layers:
        if others := ", ".join([each for each in layers if each][:_MOST_NAMES]):
            notes.append(f"the light is taken from R, G and B; its other layers of colour ({others}) are not read")
        return layers[""]
    if len(layers) == 1:
        ((only, channels),) = layers.items()
        notes.append(f"the light is taken from {only!r}, its only layer of colour")
        return channels
    if layers:
        raise WlmError(
            f"{path}: expected one layer of colour, found {listed}: choose one with --encoding layer:NAME, or by "
            "channels in a set.json"
        )
    if len(names) == 1 and names[0] in ("Y", "L"):
        notes.append(f"its only channel, {names[0]}, is taken as grey light")
        return dict.fromkeys(_COLOUR, names[0])
    reason = " (luminance and chroma: save it as RGB)" if {"Y", "RY", "BY"} <= set(names) else ""
    found = ",".join(names[:_MOST_CHANNELS]) or "none"
    raise WlmError(f"{path}: expected channels R,G,B or R,G,B,A, found {found}{reason}")


def _pixels(path: str | os.PathLike[str], channels: _Channels, names: Sequence[str], notes: list[str]) -> np.ndarray:
    """Returns the pixels of channels over the display window, float32 [H, W, C]."""
    pixels = np.zeros(0, np.float32)
    for index, name in enumerate(names):
        (part, channel), where = channels[name], f"{path}: channel {name}"
        plane = channel.pixels
        if plane is None or plane.dtype not in (np.float16, np.float32):
            raise WlmError(
                f"{where}: expected half or float numbers, found {'no pixels' if plane is None else plane.dtype}"
            )
        plane = _framed(where, part, plane, notes)
        if not index:
            pixels = np.empty((*plane.shape, len(names)), np.float32)
        if plane.shape != pixels.shape[:2]:
            raise WlmError(f"{where}: expected {pixels.shape[:2]} pixels (height, width), found {plane.shape}")
        pixels[..., index] = plane
    return pixels


def _framed(where: str, part: OpenEXR.Part, plane: np.ndarray, notes: list[str]) -> np.ndarray:
    """Places the pixels of the data window, [h, w], in the display window, 0 elsewhere: [H, W] of the same type."""
    data, display = _window(part, "dataWindow"), _window(part, "displayWindow")
    if plane.shape != (data[3], data[2]):
        raise WlmError(
            f"{where}: expected {data[2]}x{data[3]} pixels in the data window, found {plane.shape[1]}x{plane.shape[0]}"
        )
    if data == display:
        return plane
    left, top, width, height = display
    x, y = data[0] - left, data[1] - top
    rows, columns = (slice(max(at, 0), max(at + size, 0)) for at, size in ((y, data[3]), (x, data[2])))
    framed = np.zeros((height, width), plane.dtype)
    inside = plane[max(-y, 0) : max(height - y, 0), max(-x, 0) : max(width - x, 0)]
    if not inside.size:
        raise WlmError(f"{where}: expected a data window that overlaps the display window, found none")
    framed[rows, columns] = inside
    line = f"the data window, {data[2]}x{data[3]} at ({x}, {y}), is placed in the display window, {width}x{height}"
    if inside.size < framed.size:
        line += f": {framed.size - inside.size} {CROPPED}"
    if inside.size < plane.size:
        line += f"{';' if inside.size < framed.size else ':'} {plane.size - inside.size} texels beyond it are left out"
    if line not in notes:
        notes.append(line)
    return framed


def _window(part: OpenEXR.Part, name: str) -> tuple[int, int, int, int]:
    (left, top), (right, bottom) = (np.asarray(corner).tolist() for corner in part.header[name])
    return left, top, right - left + 1, bottom - top + 1


def _chromaticities(path: str | os.PathLike[str], header: Mapping[str, Any], notes: list[str]) -> Sequence[float]:
    """Returns the chromaticities that a header states; those of Rec. 709, the format's default, if it states none."""
    if "chromaticities" in header:
        return tuple(header["chromaticities"])
    space = str(header.get("colorInteropID", ""))
    if space == "lin_ciexyzd65_scene":
        return CIE_XYZ
    if space.startswith("lin_"):
        stated = OpenEXR.colorInteropIDToChromaticities(space)
        if stated is None:
            notes.append(f"the colour space {space[:_MOST_CHANNELS]} is not known: its primaries are taken as Rec. 709")
        return stated or REC709
    if space not in ("", "data", "unknown"):
        raise WlmError(f"{path}: colorInteropID: expected linear light, found {space[:_MOST_CHANNELS]}")
    return ACES_AP0 if header.get("acesImageContainerFlag") else REC709


def write_exr(
    path: str | os.PathLike[str], pixels: np.ndarray, half: bool = True, note: Mapping[str, Any] | None = None
) -> None:
    """Writes linear pixels [H, W, 3 or 4] as an EXR file of scan lines with lossless ZIP compression, atomically.

    With `half` they are rounded to half floats: values beyond their range, infinity included, become +-65504; NaN
    stays. `note` is a JSON object for the header.
    """
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise ValueError(f"expected pixels [H, W, 3 or 4], got {pixels.shape}")
    planes = dict(zip((*_COLOUR, _ALPHA), np.moveaxis(pixels, -1, 0), strict=False))
    write_planes(path, planes, note, whole=() if half else tuple(planes))


def write_planes(
    path: str | os.PathLike[str],
    planes: Mapping[str, np.ndarray],
    note: Mapping[str, Any] | None = None,
    *,
    whole: tuple[str, ...] = (),
) -> None:
    """Writes single-channel images (planes) [H, W], linear, not empty, as one EXR file with lossless ZIP compression,
    atomically; the keys name the channels, and `note`, a JSON object, is stored in the header.

    The planes in `whole` stay float32; the others become half floats, clamped to +-65504.
    """
    shapes = {np.shape(plane) for plane in planes.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise ValueError(f"expected planes [H, W] of one shape, got {sorted(shapes)}")
    channels = {}
    for name, plane in planes.items():
        plane = plane if name in whole else np.clip(plane, -HALF_MAX, HALF_MAX)
        channels[name] = np.ascontiguousarray(plane, np.float32 if name in whole else np.float16)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if note is not None:
        header[_NOTE] = json.dumps(note, allow_nan=False)
    with atomic_path(path) as temporary:
        with _captured_chatter() as chatter:
            try:
                OpenEXR.File(header, channels).write(str(temporary))
            except (RuntimeError, ValueError) as error:
                reason = one_line(error).replace(str(temporary), str(path))
                raise WlmError(f"{path}: cannot write: {reason}") from error
        if chatter:
            raise WlmError(f"{path}: cannot write: {chatter[0]}")
        # The library reports no error if the disk is full when it flushes its buffer at the end.
        try:
            read_every_channel(temporary)
        except WlmError as error:
            reason = str(error).replace(str(temporary), "the file as written")
            raise WlmError(f"{path}: cannot write: {reason}; is the disk full?") from error


def read_planes(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Reads all channels of an EXR file of one part, over its display window, and the note that `write_planes` stored.
    Returns the planes by name, float32 [H, W], NaN included; and the note of the header, empty if the file has none."""
    header, *others = check_header(path)
    if others:
        raise WlmError(f"{path}: expected an EXR file of one part, found {1 + len(others)}")
    pixels, names = read_every_channel(path)
    try:
        note = json.loads(header.attributes.get(_NOTE, ("string", b"{}"))[1])
    except (ValueError, RecursionError):
        note = None
    if not isinstance(note, dict):
        raise WlmError(f"{path}: header attribute {_NOTE}: expected a JSON object")
    return dict(zip(names, np.moveaxis(pixels, -1, 0), strict=True)), note


def read_header(path: str | os.PathLike[str]) -> tuple[int, int, tuple[str, ...]]:
    """Reads the size of the display window and the names of all channels of an EXR file, without its pixels. In a file
    of several parts, a name begins with that of its part."""
    parts = check_header(path)
    return *parts[0].size, tuple(name for part in parts for name in part.full_names(len(parts) > 1))


@contextlib.contextmanager
def _captured_chatter() -> Iterator[list[str]]:
    """Captures what OpenEXR prints in the block: its C library to the stderr, its Python module to sys.stdout. Yields a
    list, to which the messages are added as one line at the end, if there are any."""
    chatter, printed = list[str](), io.StringIO()
    lines: list[bytes] = []
    try:
        with captured_stderr(lambda line: b"(EXR_ERR_" in line) as lines, contextlib.redirect_stdout(printed):
            yield chatter
    finally:
        # The reason follows the error code; our own message names the file.
        reasons = [line.decode(errors="replace").partition(") ")[2] for line in lines]
        messages = "; ".join(dict.fromkeys(map(str.strip, reasons))) or printed.getvalue()
        chatter += [text] if (text := one_line(messages, 200)) else []
