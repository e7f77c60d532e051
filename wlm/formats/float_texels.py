"""Texel formats of DDS and KTX2: their sizes, and decoding of light to float32.

Shared exponents follow OpenGL's EXT_texture_shared_exponent, floats of 11 and 10 bits EXT_packed_float. Optional
packages decode blocks.
"""

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import BinaryIO

import numpy as np

from wlm.errors import WlmError
from wlm.formats.hdr_blocks import ASTC_BLOCKS, decode_astc, decode_bc6h
from wlm.formats.limits import PICTURE_BYTES, PICTURE_GROWTH, check_growth, check_sides
from wlm.formats.shared_exponent import unpack_rgb9e5

EXTRA = "atlas"
"""The optional extra with the packages that decode blocks."""

_BAND = 1 << 20  # texels decoded at once, which bounds the temporary memory
_HALF_BYTES = 2
MOST_SIDE = 16384
"""Largest side of a 2D texture in Direct3D 11 and 12 and on desktop GPUs, in texels."""

MOST_SLICES = 2048
"""Most slices of a volume and layers of an array."""


@dataclass(frozen=True)
class Layout:
    """Memory layout of a texel format.

    It states the channels of a decoded texel, 3, or 4 with alpha; the bytes of a texel or of a block, and a block's
    width and height in texels. `decode` decodes whole rows of whole blocks to half or float [rows, columns, channels].
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
    """Checks the claimed size of a picture, in texels of `texel` decoded bytes, before memory is allocated. `held` is
    the size of the file in bytes, `path` names it in messages."""
    check_sides(str(path), width, height)
    check_growth(str(path), held, width * height * texel, PICTURE_GROWTH, PICTURE_BYTES)


def decode_texels(
    path: str | os.PathLike[str], layout: Layout, data: bytes | memoryview, width: int, height: int
) -> np.ndarray:
    """Decodes the bytes of a picture (`Layout.bytes_of`) to float32 [H, W, channels]."""
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


def check_fields(path: str | os.PathLike[str], *fields: tuple[str, object, bool, object]) -> None:
    """Refuses the first wrong field of a header, each given as name, value, whether it fits, expectation."""
    for field, found, fits, expected in fields:
        if not fits:
            raise WlmError(f"{path}: {field}: expected {expected}, found {found}")


def layout_of(
    path: str | os.PathLike[str],
    field: str,
    number: int,
    layouts: Mapping[int, tuple[str, Layout]],
    others: Mapping[str, int],
    expected: str,
) -> tuple[str, Layout]:
    """Returns the name and the layout of a format by its number."""
    if number not in layouts:
        name = next((f" ({name})" for name, written in others.items() if written == number), "")
        raise WlmError(f"{path}: {field}: expected {expected}, found {number}{name}")
    return layouts[number]


def read_head(path: str | os.PathLike[str], file: BinaryIO, kind: str, magic: bytes, size: int) -> bytes:
    """Reads the first `size` bytes of an open file, which begins with `magic` if it is of the `kind`."""
    head = file.read(size)
    if not head.startswith(magic):
        raise WlmError(f"{path}: expected a {kind} file, found other content")
    if len(head) < size:
        raise WlmError(f"{path}: the file is cut short: expected {size} bytes, found {len(head)}")
    return head


def read_part(path: str | os.PathLike[str], file: BinaryIO, start: int, size: int, part: str) -> bytes:
    """Reads `size` bytes of an open file from `start` on; `path` and `part` name the file and the part in messages."""
    held = os.fstat(file.fileno()).st_size
    if start + size > held:
        raise WlmError(f"{path}: {part}: the file is cut short: expected {start + size} bytes, found {held}")
    file.seek(start)
    data = file.read(size)
    if len(data) != size:
        raise WlmError(f"{path}: {part}: expected {size} bytes, found {len(data)}; has the file changed?")
    return data


def channel_bits(fmt: str) -> list[int]:
    """Returns the bits of each channel of a format, which its name states, such as "R16G16_FLOAT"; none for blocks."""
    return [] if fmt.startswith(("BC", "ASTC")) else [int(bits) for bits in re.findall(r"\d+", fmt.partition("_")[0])]


def format_bytes(fmt: str, width: int, height: int) -> int:
    """Returns the bytes of a picture in a format of Direct3D or Vulkan: of its texels, or of its blocks of 4 x 4."""
    if bits := channel_bits(fmt):
        return width * height * sum(bits) // 8
    return -(-width // 4) * -(-height // 4) * 16


def mip_bytes(fmt: str, width: int, height: int, mips: int, most: int | None = None) -> list[int]:
    """Returns the bytes of each mip level of a picture, the largest first. `mips` is the number of levels after the
    largest one, and `most` their largest number; None: down to one texel."""
    if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE):
        raise ValueError(f"expected a width and a height of 1 to {MOST_SIDE} texels, got {width}x{height}")
    most = max(width, height).bit_length() - 1 if most is None else most
    if not 0 <= mips <= most:
        raise ValueError(f"mips: expected 0 to {most}, got {mips}")
    return [format_bytes(fmt, max(width >> level, 1), max(height >> level, 1)) for level in range(mips + 1)]


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
    return decode_astc(bytes(data), block, rows, columns, EXTRA)


HALF_RGB = Layout(3, 6, partial(_plain, dtype="<f2"))
HALF_RGBA = Layout(4, 8, partial(_plain, dtype="<f2"))
FLOAT_RGB = Layout(3, 12, partial(_plain, dtype="<f4"))
FLOAT_RGBA = Layout(4, 16, partial(_plain, dtype="<f4"))
PACKED = Layout(3, 4, _packed)
SHARED = Layout(3, 4, _shared)
BC6H_UNSIGNED = Layout(3, 16, partial(_bc6h, signed=False), (4, 4))
BC6H_SIGNED = Layout(3, 16, partial(_bc6h, signed=True), (4, 4))
ASTC = {block: Layout(3, 16, partial(_astc, block=block), block) for block in ASTC_BLOCKS}
