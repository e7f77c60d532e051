"""Reading Radiance pictures, `.hdr`: RGB with a shared exponent, plain or under the run-length code of 1991.

The header is parsed and bounded here; imagecodecs decodes the texels. The run-length code of before 1991 is refused.

Format: "Radiance File Formats", section "Picture File Format", of the Radiance documentation. A mantissa m with the
exponent e is m 2^(e - 136), as in `rgbe.c` and in the readers of engines; Radiance itself uses m + 1/2, which makes
black texels glow. Pictures of RGB without `PRIMARIES` are taken as Rec. 709, as engines do.
"""

import math
import os
import re

import numpy as np

from wlm.errors import WlmError
from wlm.formats.float_texels import EXTRA, check_picture
from wlm.formats.hdr_blocks import need
from wlm.formats.primaries import CIE_XYZ, to_rec709
from wlm.formats.reading import open_file

MAGIC = b"#?"

_HEADER_BYTES = 64 << 10
_FORMAT, _XYZ = "32-bit_rle_rgbe", "32-bit_rle_xyze"
_SIZE = re.compile(rb"([+-])([XY]) +([0-9]{1,9}) +([+-])([XY]) +([0-9]{1,9})")
_TEXEL = 4  # bytes: red, green, blue, exponent
_UNPACKED = 6  # bytes of a texel as half floats
_FIELDS = {"FORMAT": 1, "GAMMA": 1, "EXPOSURE": 1, "COLORCORR": 3, "PRIMARIES": 8}  # the number of values


def read_radiance(path: str | os.PathLike[str], notes: list[str] | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a Radiance picture of RGB or CIE XYZ, float32 [H, W, 3], the top row first whatever the file's orientation;
    returns it and the names of the channels.

    Values are divided by every `EXPOSURE` and `COLORCORR` of the header, which are factors that were applied to them.
    CIE XYZ and other `PRIMARIES` are converted to Rec. 709. Each of these adds a line to `notes`.
    """
    notes = [] if notes is None else notes
    with open_file(path, "the Radiance picture") as file:
        held = os.fstat(file.fileno()).st_size
        head = file.read(_HEADER_BYTES)
        if not head.startswith(MAGIC):
            raise WlmError(f"{path}: expected a Radiance picture, found other content")
        lines, start = _header(path, head)
        line = lines.pop()
        axes = _SIZE.fullmatch(line)
        if axes is None or axes[2] == axes[5]:
            raise WlmError(f"{path}: expected a size such as -Y 512 +X 512 after the header, found {line[:40]!r}")
        factor, primaries = _header_fields(path, lines)
        rows, columns = int(axes[3]), int(axes[6])  # of the file: a row may be a column of the picture
        upright = axes[2] == b"Y"
        check_picture(path, held, *((columns, rows) if upright else (rows, columns)), _UNPACKED)
        file.seek(start)
        # The longest run-length code has two bytes for each byte of a texel and four bytes for a row.
        data = file.read(rows * (2 * _TEXEL * columns + _TEXEL))
    pixels = _decode(path, data, rows, columns)
    if not upright:
        pixels = pixels.swapaxes(0, 1)
    # X grows to the right, Y upwards.
    signs = {axes[2]: axes[1], axes[5]: axes[4]}
    pixels = pixels[:: 1 if signs[b"Y"] == b"-" else -1, :: 1 if signs[b"X"] == b"+" else -1]
    if factor != (1.0, 1.0, 1.0):
        with np.errstate(over="ignore"):
            pixels /= np.array(factor)
        text = " ".join(f"{number:g}" for number in (factor if len(set(factor)) > 1 else factor[:1]))
        notes.append(f"divided by the EXPOSURE of its header, {text}, which other readers may ignore")
    if primaries is not None:
        to_rec709(pixels, primaries, f"{path}: PRIMARIES", notes)
        if primaries == CIE_XYZ:
            notes.append("its unit is kept: CIE XYZ is usually in cd/m2, 179 times the W/(sr m2) of RGB")
    return np.ascontiguousarray(pixels), ("R", "G", "B")


def _header(path: str | os.PathLike[str], head: bytes) -> tuple[list[bytes], int]:
    blank = head.find(b"\n\n")
    end = head.find(b"\n", blank + 2)
    if blank < 0 or end < 0:
        raise WlmError(
            f"{path}: expected an empty line and then the size within the first {_HEADER_BYTES} bytes, found neither"
        )
    return [*head[:blank].split(b"\n"), head[blank + 2 : end].strip()], end + 1


def _header_fields(
    path: str | os.PathLike[str], lines: list[bytes]
) -> tuple[tuple[float, float, float], tuple[float, ...] | None]:
    """Checks the fields of a header. Returns the factors of EXPOSURE and COLORCORR for red, green and blue, and the
    chromaticities, or None."""
    product, primaries, xyz = [1.0, 1.0, 1.0], None, False
    for line in lines:
        name, equals, value = line.decode("latin-1").partition("=")
        name, value = name.strip(), value.strip()
        if not equals or name not in _FIELDS:
            continue
        if name == "FORMAT":
            xyz = value == _XYZ
            if value not in (_FORMAT, _XYZ):
                raise WlmError(f"{path}: FORMAT: expected {_FORMAT} or {_XYZ}, found {value[:40]}")
            continue
        try:
            numbers = [float(word) for word in value.split()]
        except ValueError:
            numbers = []
        wanted, least = _FIELDS[name], -math.inf if name == "PRIMARIES" else 0.0
        if len(numbers) != wanted or not all(math.isfinite(number) and number > least for number in numbers):
            above = "" if name == "PRIMARIES" else " above 0"
            raise WlmError(f"{path}: {name}: expected {wanted} finite number(s){above}, found {value[:40]}")
        if name == "PRIMARIES":
            primaries = tuple(numbers)
            continue
        if name == "GAMMA":
            if numbers != [1.0]:
                raise WlmError(f"{path}: GAMMA: expected 1 (linear light), found {numbers[0]:g}")
            continue
        product = [old * new for old, new in zip(product, numbers * (3 // wanted), strict=True)]
    if not all(math.isfinite(factor) and factor > 0 for factor in product):
        raise WlmError(f"{path}: EXPOSURE and COLORCORR: expected finite products above 0, found {product}")
    return tuple(product), CIE_XYZ if xyz else primaries


def _decode(path: str | os.PathLike[str], data: bytes, rows: int, columns: int) -> np.ndarray:
    codecs = need("imagecodecs", EXTRA)
    pixels = np.zeros((rows, columns, 3), np.float32)
    texels = np.frombuffer(data, np.uint8, min(len(data) // _TEXEL, rows * columns) * _TEXEL).reshape(-1, _TEXEL)
    try:
        # The old code repeats a texel by a texel of mantissas 1, 1, 1, which the decoder would take for a colour.
        if data[:2] != b"\2\2" and (texels[:, :3] == 1).all(axis=1).any():
            raise ValueError("it uses the run-length code of before 1991, which is not read")
        # The decoder knows one orientation; the caller turns the picture.
        canonical = b"#?RADIANCE\nFORMAT=%s\n\n-Y %d +X %d\n" % (_FORMAT.encode(), rows, columns)
        codecs.rgbe_decode(canonical + data, out=pixels)
    except (RuntimeError, ValueError) as error:
        raise WlmError(f"{path}: the file is cut short or damaged, or of another run-length code: {error}") from error
    return pixels
