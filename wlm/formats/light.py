"""Reading of pictures of light from bakers and engines: EXR, Radiance, KTX2 and DDS, recognised by their content."""

import os

import numpy as np

from wlm.errors import WlmError
from wlm.formats import dds, ktx2, radiance
from wlm.formats.exr import read_exr
from wlm.formats.exr_header import MAGIC as EXR_MAGIC
from wlm.formats.reading import open_file

SUFFIXES = (".exr", ".hdr", ".ktx2", ".dds")
"""Suffixes by which pictures of light are found in a folder."""

EXPECTED = "EXR, Radiance (.hdr), KTX2 or DDS"
"""Names of the formats, for messages."""

_READERS = {
    EXR_MAGIC: read_exr,
    radiance.MAGIC: radiance.read_radiance,
    ktx2.MAGIC: ktx2.read_ktx2,
    dds.MAGIC: dds.read_dds,
}
# Formats that users mistake for light, with the message.
_OTHERS = {
    b"\x89PNG": "a PNG, whose encoding of light is unknown",
    b"\xff\xd8\xff": "a JPEG, whose encoding of light is unknown",
    b"\xabKTX 11": "a KTX file of version 1",
    b"II*\0": "a TIFF",
    b"MM\0*": "a TIFF",
}
_FIRST = 12  # bytes that identify a format


def read_light(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a picture of linear light, whatever its suffix.

    Values are returned unchanged, including NaN, infinity and negative ones: the caller checks them.

    Returns:
        The pixels, float32 [H, W, 3 or 4], the top row first, and the names of the channels, ("R", "G", "B") or ("R",
        "G", "B", "A").

    Raises:
        WlmError: The file is missing, of another kind, cut short or damaged.
    """
    with open_file(path, "the lightmap") as file:
        first = file.read(_FIRST)
    for magic, read in _READERS.items():
        if not first.startswith(magic):
            continue
        try:
            return read(path)
        except MemoryError as error:
            raise WlmError(f"{path}: the lightmap is too large for the memory: {error}") from error
    found = next((name for magic, name in _OTHERS.items() if first.startswith(magic)), "other content")
    raise WlmError(f"{path}: expected a lightmap, {EXPECTED}, found {found}")
