"""Reading Radiance pictures, `.hdr`: RGB with a shared exponent, plain or under the run-length code of 1991.

The header is parsed and bounded here; imagecodecs decodes the texels. The run-length code of before 1991 is refused.

Format: "Radiance File Formats", section "Picture File Format", of the Radiance documentation. A mantissa m with the
exponent e is m 2^(e - 136), as in `rgbe.c` and in the readers of engines; Radiance itself uses m + 1/2, which makes
black texels glow.
"""

import math
import os
import re

import numpy as np

from wlm.errors import WlmError
from wlm.formats.float_texels import EXTRA, check_picture
from wlm.formats.hdr_blocks import need
from wlm.formats.reading import open_file

MAGIC = b"#?"

_HEADER_BYTES = 64 << 10
_FORMAT = "32-bit_rle_rgbe"
_SIZE = re.compile(rb"([+-])([XY]) +([0-9]{1,9}) +([+-])([XY]) +([0-9]{1,9})")
_TEXEL = 4  # bytes: red, green, blue, exponent
_UNPACKED = 6  # bytes of a texel as half floats


def read_radiance(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a Radiance picture of RGB.

    Values are divided by every `EXPOSURE` and `COLORCORR` of the header, which are factors that were applied to them;
    `PRIMARIES` are ignored.

    Returns:
        The pixels, float32 [H, W, 3], the top row first whatever the file's orientation, and the names of the
        channels.

    Raises:
        WlmError: The file is missing, is not a Radiance picture, is cut short or damaged, contains XYZ or
            gamma-corrected values, or the package imagecodecs is missing.
    """
    with open_file(path, "the Radiance picture") as file:
        held = os.fstat(file.fileno()).st_size
        head = file.read(_HEADER_BYTES)
        if not head.startswith(MAGIC):
            raise WlmError(f"{path}: expected a Radiance picture, found other content")
        lines, start = _header(path, head)
        axes = _SIZE.fullmatch(lines.pop())
        if axes is None or axes[2] == axes[5]:
            raise WlmError(f"{path}: expected a size like -Y 512 +X 512 after the header, found another line")
        factor = _factor(path, lines)
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
    return np.ascontiguousarray(pixels), ("R", "G", "B")


def _header(path: str | os.PathLike[str], head: bytes) -> tuple[list[bytes], int]:
    """Returns the header's lines, the last of which states the size, and the offset of the first texel."""
    blank = head.find(b"\n\n")
    end = head.find(b"\n", blank + 2)
    if blank < 0 or end < 0:
        raise WlmError(
            f"{path}: expected an empty line and then the size within the first {_HEADER_BYTES} bytes, found neither"
        )
    return [*head[:blank].split(b"\n"), head[blank + 2 : end].strip()], end + 1


def _factor(path: str | os.PathLike[str], lines: list[bytes]) -> tuple[float, float, float]:
    """Returns the factors that EXPOSURE and COLORCORR applied to red, green and blue, and checks the other fields."""
    product = [1.0, 1.0, 1.0]
    for line in lines:
        name, equals, value = line.decode("latin-1").partition("=")
        name, value = name.strip(), value.strip()
        if not equals or name not in ("FORMAT", "GAMMA", "EXPOSURE", "COLORCORR"):
            continue
        if name == "FORMAT":
            if value != _FORMAT:
                raise WlmError(f"{path}: FORMAT: expected {_FORMAT}, found {value[:40]}")
            continue
        try:
            numbers = [float(word) for word in value.split()]
        except ValueError:
            numbers = []
        wanted = 3 if name == "COLORCORR" else 1
        if len(numbers) != wanted or not all(math.isfinite(number) and number > 0 for number in numbers):
            raise WlmError(f"{path}: {name}: expected {wanted} finite number(s) above 0, found {value[:40]}")
        if name == "GAMMA":
            if numbers != [1.0]:
                raise WlmError(f"{path}: GAMMA: expected 1 (linear light), found {numbers[0]:g}")
            continue
        product = [old * new for old, new in zip(product, numbers * (3 // wanted), strict=True)]
    if not all(math.isfinite(factor) and factor > 0 for factor in product):
        raise WlmError(f"{path}: EXPOSURE and COLORCORR: expected finite products above 0, found {product}")
    return tuple(product)


def _decode(path: str | os.PathLike[str], data: bytes, rows: int, columns: int) -> np.ndarray:
    """Decodes all rows of a file, float32 [rows, columns, 3]."""
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
