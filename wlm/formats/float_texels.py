"""Decoding of HDR texel formats to float32: plain floats, floats packed into 32 bits, and blocks.

Shared exponents follow OpenGL's EXT_texture_shared_exponent, floats of 11 and 10 bits EXT_packed_float. Optional
packages decode blocks.
"""

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from wlm.errors import WlmError
from wlm.formats.hdr_blocks import ASTC_BLOCKS, ASTC_MEDIUM, astc, decode_bc6h, need
from wlm.formats.limits import PICTURE_BYTES, PICTURE_GROWTH, check_growth, check_sides
from wlm.formats.shared_exponent import unpack_rgb9e5

EXTRA = "atlas"
"""The optional extra with the packages that decode blocks."""

_BAND = 1 << 20  # texels decoded at once, which bounds the temporary memory
_HALF_BYTES = 2
_ASTC_LOCK = threading.Lock()  # a context decodes one picture at a time


@dataclass(frozen=True)
class Layout:
    """Memory layout of a texel format.

    Attributes:
        channels: Channels of a decoded texel: 3, or 4 with alpha.
        size: Bytes of a texel, or of a block.
        decode: Decodes whole rows of whole blocks to half or float [rows, columns, channels].
        block: Width and height of a block in texels.
    """

    channels: int
    size: int
    decode: Callable[[memoryview, int, int], np.ndarray]
    block: tuple[int, int] = (1, 1)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple("RGBA"[: self.channels])

    @property
    def unpacked(self) -> int:
        """Bytes of a texel in memory, for limits: as half floats or as stored, whichever is larger."""
        across, down = self.block
        return max(_HALF_BYTES * self.channels, self.size // (across * down))

    def bytes_of(self, width: int, height: int) -> int:
        """Returns the size of a picture, in bytes."""
        across, down = self.block
        return -(-width // across) * -(-height // down) * self.size


def check_picture(path: str | os.PathLike[str], held: int, width: int, height: int, texel: int) -> None:
    """Checks the claimed size of a picture, in texels of `texel` decoded bytes, before memory is allocated.

    `held` is the size of the file in bytes, `path` names it in messages.

    Raises:
        WlmError: The picture has no texels, too many, or more than a file of this size may expand to.
    """
    if not (width and height):
        raise WlmError(f"{path}: expected at least one texel, found {width} x {height}")
    check_sides(str(path), width, height)
    check_growth(str(path), held, width * height * texel, PICTURE_GROWTH, PICTURE_BYTES)


def decode_texels(
    path: str | os.PathLike[str], layout: Layout, data: bytes | memoryview, width: int, height: int
) -> np.ndarray:
    """Decodes the bytes of a picture (`Layout.bytes_of`) to float32 [H, W, channels].

    Raises:
        WlmError: The package that decodes the format is missing, or refuses the data; the line names the file.
    """
    columns, rows = (-(-side // of) for side, of in zip((width, height), layout.block, strict=True))
    across, down = layout.block
    stride = columns * layout.size
    pixels = np.empty((height, width, layout.channels), np.float32)
    step = max(_BAND // (columns * across * down), 1)
    for first in range(0, rows, step):
        count = min(step, rows - first)
        part = memoryview(data)[first * stride : (first + count) * stride]
        try:
            texels = layout.decode(part, count * down, columns * across)
        except (WlmError, RuntimeError, ValueError) as error:
            raise WlmError(f"{path}: cannot decode the texels: {error}") from error
        band = pixels[first * down : (first + count) * down]
        band[:] = texels[: len(band), :width]
    return pixels


def unpack_zstd(path: str | os.PathLike[str], data: bytes, size: int) -> bytes:
    """Decompresses zstd to at most `size` bytes.

    Raises:
        WlmError: The data is damaged or larger, or the package is missing.
    """
    try:
        return need("imagecodecs", EXTRA).zstd_decode(data, out=size)
    except (WlmError, RuntimeError, ValueError) as error:
        raise WlmError(f"{path}: cannot unpack zstd: {error}") from error


def _plain(data: memoryview, rows: int, columns: int, *, dtype: str) -> np.ndarray:
    return np.frombuffer(data, dtype).reshape(rows, columns, -1)


def _packed(data: memoryview, rows: int, columns: int) -> np.ndarray:
    """Decodes R11G11B10: mantissas of 6, 6 and 5 bits, with the exponent bits and bias of half floats."""
    words = np.frombuffer(data, "<u4").reshape(rows, columns)
    bits = np.stack([(words & 0x7FF) << 4, (words >> 11 & 0x7FF) << 4, words >> 22 << 5], axis=-1)
    return bits.astype(np.uint16).view(np.float16)


def _shared(data: memoryview, rows: int, columns: int) -> np.ndarray:
    return unpack_rgb9e5(np.frombuffer(data, "<u4").reshape(rows, columns))


def _bc6h(data: memoryview, rows: int, columns: int, *, signed: bool) -> np.ndarray:
    return decode_bc6h(bytes(data), rows, columns, EXTRA, signed)


def _astc(data: memoryview, rows: int, columns: int, *, block: tuple[int, int]) -> np.ndarray:
    codec = astc(block, ASTC_MEDIUM, EXTRA)
    with _ASTC_LOCK:
        return codec.decode(bytes(data), rows, columns)


HALF_RGB = Layout(3, 6, partial(_plain, dtype="<f2"))
HALF_RGBA = Layout(4, 8, partial(_plain, dtype="<f2"))
FLOAT_RGB = Layout(3, 12, partial(_plain, dtype="<f4"))
FLOAT_RGBA = Layout(4, 16, partial(_plain, dtype="<f4"))
PACKED = Layout(3, 4, _packed)
SHARED = Layout(3, 4, _shared)
BC6H_UNSIGNED = Layout(3, 16, partial(_bc6h, signed=False), (4, 4))
BC6H_SIGNED = Layout(3, 16, partial(_bc6h, signed=True), (4, 4))
ASTC = {block: Layout(3, 16, partial(_astc, block=block), block) for block in ASTC_BLOCKS}
