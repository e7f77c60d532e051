"""DDS files of block-compressed textures and of a few uncompressed formats, with the DX10 header: a 2D texture or
a volume, one mip level.

A volume's slices follow each other, each a 2D grid of blocks (or of texels, row by row without padding).
"""

import os
import struct
from dataclasses import dataclass

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.limits import TEXTURE_BYTES
from wlm.formats.reading import read_file

__all__ = ["DXGI_FORMATS", "DdsTexture", "read_dds", "write_dds"]

DXGI_FORMATS = {
    "R16G16B16A16_FLOAT": 10,
    "R16G16_FLOAT": 34,
    "R16G16_UNORM": 35,
    "R16G16_UINT": 36,
    "R8G8_UNORM": 49,
    "BC6H_UF16": 95,
    "BC6H_SF16": 96,
    "BC7_UNORM": 98,
    "BC7_UNORM_SRGB": 99,
}
"""The formats that can be written and their DXGI numbers: those of BC with 16 bytes a block of 4 x 4 texels, the
others with a texel's channels one after another, little-endian."""

_BLOCK_BYTES = 16
# Of the formats without blocks.
_TEXEL_BYTES = {
    "R16G16B16A16_FLOAT": 8,
    "R16G16_FLOAT": 4,
    "R16G16_UNORM": 4,
    "R16G16_UINT": 4,
    "R8G8_UNORM": 2,
}
_MAX_SIDE = 16384  # texels; the limit of a 2D texture in Direct3D 11 and 12
_MAX_DEPTH = 2048

_MAGIC = b"DDS "
# Size, flags, height, width, linear size, depth, mip levels, 11 reserved; pixel format: size, flags, code,
# bits, 4 masks; caps 1 to 4, reserved. Then DX10: format, dimension, flags, array size, alpha mode.
_HEADER = struct.Struct("<4s 7I 44x 2I 4s 5I 4I 4x 5I")
_HEADER_SIZE = 124
_PIXEL_FORMAT_SIZE = 32

_CAPS, _HEIGHT, _WIDTH, _PIXEL_FORMAT, _DEPTH = 0x1, 0x2, 0x4, 0x1000, 0x800000
_PITCH, _LINEAR_SIZE = 0x8, 0x80000  # which of the two the size field holds: bytes of a row, or of a slice
_REQUIRED = _CAPS | _HEIGHT | _WIDTH | _PIXEL_FORMAT
_FOUR_CC = 0x4
_CAPS_COMPLEX, _CAPS_TEXTURE = 0x8, 0x1000
_CAPS2_VOLUME = 0x200000
_DIMENSION_2D, _DIMENSION_3D = 3, 4
_ALPHA_MODES = range(5)


@dataclass(frozen=True)
class DdsTexture:
    """What a DDS file holds.

    Attributes:
        width: Texels.
        height: Texels.
        depth: Slices; 1 for a 2D texture.
        fmt: A key of `DXGI_FORMATS`.
        volume: Whether it is a volume, which may have just one slice.
        blocks: The payload: slice by slice, rows of blocks or of texels.
    """

    width: int
    height: int
    depth: int
    fmt: str
    volume: bool
    blocks: bytes


def write_dds(
    path: str | os.PathLike[str],
    blocks: bytes,
    width: int,
    height: int,
    depth: int = 1,
    fmt: str = "BC7_UNORM",
    volume: bool | None = None,
) -> None:
    """Writes blocks or texels as a DDS file, whole or not at all.

    Args:
        path: The file to write; its folder must exist.
        blocks: 16 bytes a block, ceil(width / 4) * ceil(height / 4) blocks a slice, slices one after another;
            of a format without blocks the texels, row by row.
        width: Texels, 1 to 16384.
        height: Texels, 1 to 16384.
        depth: Slices, 1 to 2048.
        fmt: A key of `DXGI_FORMATS`.
        volume: Whether it is a volume, which a shader reads through another sampler; None: if `depth` is
            above 1.

    Raises:
        ValueError: An unknown format, a size out of range, several slices of what is no volume, or blocks
            that don't fill the texture.
        WlmError: The file can't be written; what was there before stays.
    """
    if fmt not in DXGI_FORMATS:
        raise ValueError(f"fmt: expected one of {', '.join(DXGI_FORMATS)}, got {fmt}")
    if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE and 1 <= depth <= _MAX_DEPTH):
        raise ValueError(f"expected sides of 1 to {_MAX_SIDE} and a depth of 1 to {_MAX_DEPTH} texels")
    slice_bytes = _slice_bytes(fmt, width, height)
    if len(blocks) != depth * slice_bytes:
        raise ValueError(f"blocks: expected {depth * slice_bytes} bytes, got {len(blocks)}")
    volume = depth > 1 if volume is None else volume
    if depth > 1 and not volume:
        raise ValueError(f"depth: expected 1 of a 2D texture, got {depth}")
    size_flag, size = _LINEAR_SIZE, slice_bytes
    if fmt in _TEXEL_BYTES:
        size_flag, size = _PITCH, width * _TEXEL_BYTES[fmt]
    header = _HEADER.pack(
        _MAGIC,
        _HEADER_SIZE,
        _REQUIRED | size_flag | (_DEPTH if volume else 0),
        height,
        width,
        size,
        depth if volume else 0,
        1,
        _PIXEL_FORMAT_SIZE,
        _FOUR_CC,
        b"DX10",
        *(0, 0, 0, 0, 0),
        _CAPS_TEXTURE | (_CAPS_COMPLEX if volume else 0),
        _CAPS2_VOLUME if volume else 0,
        *(0, 0),
        DXGI_FORMATS[fmt],
        _DIMENSION_3D if volume else _DIMENSION_2D,
        *(0, 1, 0),
    )
    atomic_write(path, [header, blocks])


def read_dds(path: str | os.PathLike[str]) -> DdsTexture:
    """Reads a DDS file of the kind that `write_dds` writes.

    Args:
        path: The file.

    Returns:
        The texture.

    Raises:
        WlmError: The file is missing, not a DDS with a DX10 header, of another format, with mip levels, an
            array or a cube, or not of the length that its header says.
    """
    data = read_file(path, TEXTURE_BYTES, "the DDS file")
    if data[:4] != _MAGIC:
        raise WlmError(f"{path}: expected a DDS file, found other content")
    if len(data) < _HEADER.size:
        raise WlmError(f"{path}: expected a DX10 header of {_HEADER.size} bytes, found {len(data)}")
    fields = _HEADER.unpack_from(data)
    size, flags, height, width, _, depth, mips, pixel_size, pixel_flags, code = fields[1:11]
    caps2 = fields[17]
    number, dimension, misc, array_size, alpha_mode = fields[20:]
    volume = dimension == _DIMENSION_3D
    names = {value: name for name, value in DXGI_FORMATS.items()}
    checks = (
        ("header size", size, size == _HEADER_SIZE, _HEADER_SIZE),
        ("flags", hex(flags), flags & _REQUIRED == _REQUIRED, f"at least {_REQUIRED:#x}"),
        ("pixel format size", pixel_size, pixel_size == _PIXEL_FORMAT_SIZE, _PIXEL_FORMAT_SIZE),
        ("pixel format", code, bool(pixel_flags & _FOUR_CC) and code == b"DX10", "DX10"),
        ("DXGI format", number, number in names, f"one of {sorted(names)}"),
        ("dimension", dimension, dimension in (_DIMENSION_2D, _DIMENSION_3D), "3 (2D) or 4 (volume)"),
        ("volume flag", hex(caps2), bool(caps2 & _CAPS2_VOLUME) == volume, "that of the dimension"),
        ("width", width, 1 <= width <= _MAX_SIDE, f"1 to {_MAX_SIDE}"),
        ("height", height, 1 <= height <= _MAX_SIDE, f"1 to {_MAX_SIDE}"),
        ("depth", depth, 1 <= depth <= _MAX_DEPTH if volume else depth <= 1, "that of the dimension"),
        ("mip levels", mips, mips <= 1, "one"),
        ("DX10 flags", hex(misc), misc == 0, "none (no cube)"),
        ("array size", array_size, array_size == 1, 1),
        ("alpha mode", alpha_mode, alpha_mode in _ALPHA_MODES, "0 to 4"),
    )
    for field, found, fits, expected in checks:
        if not fits:
            raise WlmError(f"{path}: {field}: expected {expected}, found {found}")
    slices = depth if volume else 1
    blocks = data[_HEADER.size :]
    expected_bytes = slices * _slice_bytes(names[number], width, height)
    if len(blocks) != expected_bytes:
        raise WlmError(f"{path}: expected {expected_bytes} bytes of blocks, found {len(blocks)}")
    return DdsTexture(width, height, slices, names[number], volume, blocks)


def _slice_bytes(fmt: str, width: int, height: int) -> int:
    if fmt in _TEXEL_BYTES:
        return width * height * _TEXEL_BYTES[fmt]
    return -(-width // 4) * -(-height // 4) * _BLOCK_BYTES
