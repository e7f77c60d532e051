"""Reading TIFF pictures of one image: floats, which are linear light, and integers, which are levels.

The tags are parsed and bounded here, because they state how much memory the decoder (libtiff in imagecodecs) allocates.
Format: TIFF 6.0, Adobe.
"""

import os
import struct

import numpy as np

from wlm.errors import WlmError
from wlm.formats.float_texels import EXTRA, check_picture
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import IMAGE_BYTES, check_sides
from wlm.formats.reading import damaged, read_file

MAGIC = {b"II*\0": "<", b"MM\0*": ">"}
"""The first bytes, and the byte order that they state."""

_TAGS = {
    256: "width",
    257: "height",
    258: "bits",
    262: "photometric",
    274: "orientation",
    277: "samples",
    284: "planes",
    319: "list of primaries",
    322: "tile width",
    323: "tile height",
    34675: "colour profile",
}
_FORMATS = {1: "B", 3: "H", 4: "I", 5: "I", 7: "B"}  # of the tags above: byte, short, long, rational, undefined
_COLOURS = ("list of primaries", "colour profile")
_MOST_SAMPLES = 64
_GREY, _RGB = 1, 2


def tags_of(path: str | os.PathLike[str], data: bytes) -> dict[str, int]:
    """Returns the tags of the first image that concern its layout, the first value of each."""
    order = MAGIC.get(data[:4], "")
    found = {"bits": 1, "photometric": _RGB, "orientation": 1, "samples": 1, "planes": 1}
    with damaged(f"{path}: the TIFF is cut short or damaged", struct.error, KeyError, IndexError):
        (at,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        for i in range(count):
            tag, kind, number, place = struct.unpack_from(order + "HHII", data, at + 2 + 12 * i)
            if tag in _TAGS and kind in _FORMATS and number:
                form = order + _FORMATS[kind]
                inline = number * struct.calcsize(form) <= 4
                (found[_TAGS[tag]],) = struct.unpack_from(form, data, at + 10 + 12 * i if inline else place)
        check_sides(str(path), found["width"], found["height"])
    return found


def read_tiff(path: str | os.PathLike[str], notes: list[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the first image of a TIFF of grey or RGB, with alpha or without. `notes` gets a line if the file states
    primaries or a colour profile, which are not applied.

    Returns the pixels, [H, W, C], the top row first whatever the file's orientation: float32, or uint8 and uint16 as
    stored; and the names of the channels: L, or R, G and B, then A if there is alpha.
    """
    data = read_file(path, IMAGE_BYTES, "the TIFF")
    tags = tags_of(path, data)
    notes += [f"its {name} is not applied: colours are taken as Rec. 709" for name in _COLOURS if name in tags]
    samples, colours = tags["samples"], 3 if tags["photometric"] == _RGB else 1
    if tags["photometric"] not in (_GREY, _RGB) or not colours <= samples <= _MOST_SAMPLES:
        raise WlmError(
            f"{path}: expected a TIFF of grey or RGB, found the photometric interpretation {tags['photometric']} with "
            f"{samples} samples"
        )
    texel = max(samples * tags["bits"] // 8, 1)
    check_picture(path, len(data), tags["width"], tags["height"], texel)
    if "tile width" in tags:
        check_picture(path, len(data), tags["tile width"], tags.get("tile height", 1), texel)
    codecs = need("imagecodecs", EXTRA)
    faults = ArithmeticError, LookupError, RuntimeError, ValueError, TypeError, MemoryError, OSError
    with damaged(f"{path}: the TIFF is cut short or damaged", *faults):
        pixels = codecs.tiff_decode(data)
    if tags["planes"] == 2 and samples > 1:
        pixels = np.moveaxis(pixels, 0, -1)
    expected = tags["height"], tags["width"], samples
    if pixels.size != np.prod(expected) or pixels.dtype.str[1:] not in ("u1", "u2", "f2", "f4", "f8"):
        raise WlmError(
            f"{path}: expected a TIFF of floats or of integers of 8 or 16 bits, found {pixels.dtype} {pixels.shape}"
        )
    pixels = pixels.reshape(expected)[..., : colours + 1]
    if tags["orientation"] > 4:
        pixels = pixels.swapaxes(0, 1)
    down, right = tags["orientation"] not in (3, 4, 7, 8), tags["orientation"] not in (2, 3, 6, 7)
    pixels = pixels[:: 1 if down else -1, :: 1 if right else -1]
    if pixels.dtype.kind == "f":
        with np.errstate(over="ignore"):
            pixels = pixels.astype(np.float32)
    names = (("L",) if colours == 1 else ("R", "G", "B")) + ("A",) * (samples > colours)
    return np.ascontiguousarray(pixels), names
