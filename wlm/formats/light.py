"""Reading of pictures of light from bakers and engines, recognised by their content, whatever their suffix."""

import os
from collections.abc import Callable, Sequence

import numpy as np

from wlm.errors import WlmError
from wlm.formats import dds, ktx2, pfm, radiance, tiff
from wlm.formats.exr import read_exr
from wlm.formats.exr_header import MAGIC as EXR_MAGIC
from wlm.formats.reading import open_file

SUFFIXES = (".exr", ".hdr", ".ktx2", ".dds", ".pfm", ".tif", ".tiff")
"""Suffixes by which pictures of light are found in a folder."""

EXPECTED = "EXR, Radiance (.hdr), PFM, TIFF of floats, KTX2 or DDS"
"""Names of the formats, for messages."""

_Notes = list[str]


def _read_tiff(path: str | os.PathLike[str], notes: _Notes) -> tuple[np.ndarray, tuple[str, ...]]:
    pixels, names = tiff.read_tiff(path, notes)
    if pixels.dtype != np.float32:
        raise WlmError(f"{path}: expected a lightmap, {EXPECTED}, found a TIFF of integers{_STATE_IT}")
    if "L" not in names:
        return pixels, names
    notes.append("its only colour channel is taken as grey light")
    light = np.concatenate([np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]], axis=2)
    return light, ("R", "G", "B", *names[1:])


_READERS: dict[bytes, Callable[[str | os.PathLike[str], _Notes], tuple[np.ndarray, tuple[str, ...]]]] = {
    EXR_MAGIC: read_exr,
    radiance.MAGIC: radiance.read_radiance,
    ktx2.MAGIC: ktx2.read_ktx2,
    dds.MAGIC: lambda path, notes: dds.read_dds(path),
    **dict.fromkeys(pfm.MAGIC, pfm.read_pfm),
    **dict.fromkeys(tiff.MAGIC, _read_tiff),
}
_STATE_IT = ": state what light its numbers stand for with --encoding (linear, srgb, rgbm, ...)"
# Formats that users mistake for light, with the message.
_OTHERS = {
    b"\x89PNG": f"a PNG{_STATE_IT}",
    b"\xff\xd8\xff": f"a JPEG{_STATE_IT}",
    b"RIFF": f"a WebP or another RIFF file{_STATE_IT}",
    b"\xabKTX 11": "a KTX file of version 1",
    b"II+\0": "a BigTIFF",
    b"MM\0+": "a BigTIFF",
    b"QLIT": "the coloured light of a Quake map",
    b"GIF8": "a GIF",
    b"BM": "a BMP",
    b"\x1f\x8b": "a file under gzip: unpack it first",
    b"PK\3\4": "a ZIP archive: unpack it first",
    b"<": "text such as a web page: was the download refused?",
}
_FIRST = 12  # bytes that identify a format


def read_light(path: str | os.PathLike[str], notes: _Notes | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a picture of linear light in the primaries of Rec. 709, whatever its suffix, float32 [H, W, 3 or 4], the
    top row first; returns it and the names of the channels, ("R", "G", "B") or ("R", "G", "B", "A").

    NaN, infinity and negative values are kept: the caller checks them. Each assumption and each conversion adds a line
    to `notes`.
    """
    with open_file(path, "the lightmap") as file:
        first = file.read(_FIRST)
    for magic, read in _READERS.items():
        if not first.startswith(magic):
            continue
        try:
            return read(path, [] if notes is None else notes)
        except MemoryError as error:
            raise WlmError(f"{path}: the lightmap is too large for the memory: {error}") from error
    found = next((name for magic, name in _OTHERS.items() if first.startswith(magic)), "other content")
    if first[4:12] == b"ftypavif":
        found = "an AVIF: convert it to a PNG, and state its --encoding"
    elif not first:
        found = "an empty file"
    elif os.fspath(path).lower().endswith(".tga"):
        found = f"a TGA{_STATE_IT}"
    raise WlmError(f"{path}: expected a lightmap, {EXPECTED}, found {found}")


def noted(labels: Sequence[str], notes: Sequence[Sequence[str]]) -> list[str]:
    """Returns the notes about several files, the lines that `read_light` adds, one line for each text: the label of the
    first file that has it, and how many more do."""
    found: dict[str, list[str]] = {}
    for label, lines in zip(labels, notes, strict=True):
        for line in lines:
            found.setdefault(line, []).append(label)
    return [
        f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}: {line}" for line, names in found.items()
    ]
