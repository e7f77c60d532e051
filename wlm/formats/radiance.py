"""Reading Radiance pictures, `.hdr`: RGB with one exponent, plain or under either of its run-length codes.

Format: "Radiance File Formats", section "Picture File Format", of the Radiance documentation, and its `color.c`. A
mantissa m under the exponent e is m 2^(e - 136), as `rgbe.c` and the readers of engines have it; Radiance itself takes
m + 1/2, which makes black red, green or blue glow.
"""

import math
import os
import re

import numpy as np

from wlm.errors import WlmError
from wlm.formats.float_texels import check_picture
from wlm.formats.reading import open_file

MAGIC = b"#?"

_HEADER_BYTES = 64 << 10
_FORMAT = "32-bit_rle_rgbe"
_SIZE = re.compile(rb"([+-])([XY]) +([0-9]{1,9}) +([+-])([XY]) +([0-9]{1,9})")
_LEAST, _MOST = 8, 0x7FFF  # texels of a row that the newer run-length code is for
_TEXEL = 4  # bytes: red, green, blue, exponent
_UNPACKED = 6  # the same as half floats
_SCALE = np.ldexp(np.float32(1), np.arange(256) - 136)
_SCALE[0] = 0.0  # black, whatever the mantissas


def read_radiance(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads a Radiance picture of RGB.

    Values are divided by all `EXPOSURE` and `COLORCORR` of the header, which say what they were multiplied by;
    `PRIMARIES` are ignored.

    Args:
        path: The file.

    Returns:
        The pixels, float32 [H, W, 3], the top row first whatever the file's orientation, and the channels' names.

    Raises:
        WlmError: The file is missing, not a Radiance picture, cut short or damaged, holds XYZ or is gamma-corrected.
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
        # The worst code has two bytes for each of a texel's, and four for a row. What follows is not of the picture.
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
    """The lines of the header, that of the size last, and where the texels begin."""
    blank = head.find(b"\n\n")
    end = head.find(b"\n", blank + 2)
    if blank < 0 or end < 0:
        raise WlmError(
            f"{path}: expected a header that ends in an empty line and a size within {_HEADER_BYTES} bytes, found none"
        )
    return [*head[:blank].split(b"\n"), head[blank + 2 : end].strip()], end + 1


def _factor(path: str | os.PathLike[str], lines: list[bytes]) -> tuple[float, float, float]:
    """What red, green and blue were multiplied by; checks what else the header says."""
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
            raise WlmError(f"{path}: {name}: expected finite numbers above 0, {wanted} of them, found {value[:40]}")
        if name == "GAMMA":
            if numbers != [1.0]:
                raise WlmError(f"{path}: GAMMA: expected linear light, 1, found {numbers[0]:g}")
            continue
        product = [old * new for old, new in zip(product, numbers * (3 // wanted), strict=True)]
    if not all(math.isfinite(factor) and factor > 0 for factor in product):
        raise WlmError(f"{path}: EXPOSURE and COLORCORR: expected finite products above 0, found {product}")
    return tuple(product)


def _decode(path: str | os.PathLike[str], data: bytes, rows: int, columns: int) -> np.ndarray:
    """Decodes all rows of a file, float32 [rows, columns, 3]."""
    pixels = np.empty((rows, columns, 3), np.float32)
    marker = bytes([2, 2, columns >> 8, columns & 0xFF]) if _LEAST <= columns <= _MOST else None
    at = 0
    for row in range(rows):
        where = f"{path}: row {row} of {rows}"
        if marker is not None and data[at : at + 2] == marker[:2] and data[at + 2 : at + 3] < b"\x80":
            if data[at : at + _TEXEL] != marker:
                raise WlmError(f"{where}: expected a row of {columns} texels, found another length")
            texels, at = _runs(where, data, at + _TEXEL, columns)
        else:
            texels, at = _repeats(where, data, at, columns)
        np.multiply(texels[:, :3], _SCALE[texels[:, 3], None], out=pixels[row], dtype=np.float32)
    return pixels


def _runs(where: str, data: bytes, at: int, columns: int) -> tuple[np.ndarray, int]:
    """Decodes a row of the newer code: the four components one after another, in runs and literals of bytes."""
    row, filled, end = bytearray(_TEXEL * columns), 0, 0
    try:
        for _ in range(_TEXEL):
            end += columns
            while filled < end:
                code = data[at]
                count = code - 128 if code > 128 else code
                if not 0 < count <= end - filled:
                    raise WlmError(f"{where}: the run-length code is damaged: a run of {count} texels")
                if code > 128:
                    row[filled : filled + count] = data[at + 1 : at + 2] * count
                    at += 2
                else:
                    row[filled : filled + count] = data[at + 1 : at + 1 + count]
                    at += 1 + count
                filled += count
    except IndexError:
        at = len(data) + 1
    # Past the end: a slice beyond it is short, and so is the row then.
    if at > len(data) or len(row) != _TEXEL * columns:
        raise WlmError(f"{where}: the file is cut short")
    return np.frombuffer(row, np.uint8).reshape(_TEXEL, columns).T, at


def _repeats(where: str, data: bytes, at: int, columns: int) -> tuple[np.ndarray, int]:
    """Decodes a row of plain texels, or of the older code: 1, 1, 1, n repeats the texel before n times.

    Of several in a row the second counts by 256, the third by 65,536.
    """
    count = min(columns, (len(data) - at) // _TEXEL)
    texels = np.frombuffer(data, np.uint8, _TEXEL * count, at).reshape(-1, _TEXEL)
    repeat = (texels[:, :3] == 1).all(axis=1)
    if not repeat.any():
        if count < columns:
            raise WlmError(f"{where}: the file is cut short")
        return texels, at + _TEXEL * columns
    place = np.arange(count)
    real = np.maximum.accumulate(np.where(repeat, -1, place))  # the texel that is repeated
    # The number of repeats before this one; more than three would be longer than any row.
    power = np.clip(place - real - 1, 0, 3)
    length = np.where(repeat, texels[:, 3].astype(np.int64) << (8 * power), 1)
    ends = np.cumsum(length)
    used = int(np.searchsorted(ends, columns)) + 1
    if used > count:
        raise WlmError(f"{where}: the file is cut short")
    if real[0] < 0 or ends[used - 1] != columns:
        raise WlmError(
            f"{where}: the run-length code is damaged: a repeat before the row's first texel or past its last"
        )
    return texels[np.repeat(real[:used], length[:used])], at + _TEXEL * used
