"""Reading PFM, portable float maps: linear float32 of RGB or grey, with the bottom row first.

Format: "PFM Portable FloatMap Image Format", Debevec. The sign of the scale in the header is the byte order; its
magnitude is a unit that the format does not define, and readers ignore it.
"""

import os
import re

import numpy as np

from wlm.errors import WlmError
from wlm.formats.float_texels import check_picture, read_part
from wlm.formats.reading import open_file

MAGIC = (b"PF", b"Pf")

_HEADER = re.compile(rb"P([Ff])\s+([0-9]{1,9})\s+([0-9]{1,9})\s+([-+]?[0-9.eE+-]{1,32})\s")
_HEADER_BYTES = 128
_NUMBER = 4  # bytes


def header_of(path: str | os.PathLike[str], head: bytes) -> tuple[int, int, int, float, int]:
    """Returns the width, the height, the channels (1 or 3), the scale and the offset of the first number."""
    match = _HEADER.match(head[:_HEADER_BYTES])
    try:
        scale = float(match[4]) if match else 0.0
    except ValueError:
        scale = 0.0
    if match is None or not abs(scale) > 0:
        raise WlmError(f"{path}: expected a PFM header: PF or Pf, width, height, and a scale other than 0")
    return int(match[2]), int(match[3]), 3 if match[1] == b"F" else 1, scale, match.end()


def read_pfm(path: str | os.PathLike[str], notes: list[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a PFM picture, float32 [H, W, 3], the top row first, grey repeated; returns it and the names of the
    channels. `notes` gets a line if the picture is grey or states a unit."""
    with open_file(path, "the PFM picture") as file:
        held = os.fstat(file.fileno()).st_size
        width, height, channels, scale, start = header_of(path, file.read(_HEADER_BYTES))
        check_picture(path, held, width, height, channels * _NUMBER)
        data = read_part(path, file, start, width * height * channels * _NUMBER, "the texels")
    stored = np.frombuffer(data, "<f4" if scale < 0 else ">f4").reshape(height, width, channels)[::-1]
    if abs(scale) != 1.0:
        notes.append(f"the scale of its header, {abs(scale):g}, is not applied")
    if channels == 1:
        notes.append("its only channel is taken as grey light")
    pixels = np.broadcast_to(stored, (height, width, 3))
    return np.ascontiguousarray(pixels, np.float32), ("R", "G", "B")
