"""DDS files: writing of 2D textures (with mips), arrays and volumes, and reading of light.

Slices, layers and mips follow each other, each a 2D grid of blocks or of texels, row by row without padding. Only the
largest mip of a texture of light is read. Sources: Microsoft's DDS_HEADER and DDS_HEADER_DXT10, and the FourCC codes of
Direct3D 9's float formats.
"""

import os
import struct

import numpy as np

from wlm.errors import WlmError
from wlm.formats import float_texels as texels
from wlm.formats.atomic import atomic_write
from wlm.formats.float_texels import MOST_SLICES, Layout
from wlm.formats.reading import open_file

DXGI_FORMATS = {
    "R32G32B32A32_FLOAT": 2,
    "R16G16B16A16_FLOAT": 10,
    "R16G16B16A16_UINT": 12,
    "R10G10B10A2_UNORM": 24,
    "R11G11B10_FLOAT": 26,
    "R8G8B8A8_UNORM": 28,
    "R16G16_FLOAT": 34,
    "R16G16_UNORM": 35,
    "R16G16_UINT": 36,
    "R8G8_UNORM": 49,
    "R8_UNORM": 61,
    "R9G9B9E5_SHAREDEXP": 67,
    "BC6H_UF16": 95,
    "BC6H_SF16": 96,
    "BC7_UNORM": 98,
    "BC7_UNORM_SRGB": 99,
}
"""Formats that can be written, with their DXGI numbers. BC formats have 16 bytes per block of 4 x 4 texels. The others
store the channels of a texel in order, little-endian, and R10G10B10A2 in one word with red in the lowest bits."""

MAGIC = b"DDS "
# Size, flags, height, width, linear size, depth, mip levels, 11 reserved; pixel format: size, flags, code,
# bits, 4 masks; caps 1 to 4, reserved.
_HEADER = struct.Struct("<4s 7I 44x 2I 4s 5I 4I 4x")
_DX10 = struct.Struct("<5I")  # format, dimension, flags, array size, alpha mode
_HEADER_SIZE = 124
_PIXEL_FORMAT_SIZE = 32

_CAPS, _HEIGHT, _WIDTH, _PIXEL_FORMAT, _DEPTH = 0x1, 0x2, 0x4, 0x1000, 0x800000
_PITCH, _LINEAR_SIZE = 0x8, 0x80000  # the size field states the bytes of a row, or of a slice
_REQUIRED = _CAPS | _HEIGHT | _WIDTH | _PIXEL_FORMAT
_FOUR_CC = 0x4
_CAPS_COMPLEX, _CAPS_TEXTURE, _CAPS_MIPS = 0x8, 0x1000, 0x400000
_MIPS = 0x20000
_CAPS2_VOLUME, _CAPS2_CUBE = 0x200000, 0x200
_DIMENSION_2D, _DIMENSION_3D = 3, 4
_FLAG_CUBE = 0x4

_LAYOUTS: dict[int, tuple[str, Layout]] = {
    2: ("R32G32B32A32_FLOAT", texels.FLOAT_RGBA),
    6: ("R32G32B32_FLOAT", texels.FLOAT_RGB),
    10: ("R16G16B16A16_FLOAT", texels.HALF_RGBA),
    26: ("R11G11B10_FLOAT", texels.PACKED),
    67: ("R9G9B9E5_SHAREDEXP", texels.SHARED),
    95: ("BC6H_UF16", texels.BC6H_UNSIGNED),
    96: ("BC6H_SF16", texels.BC6H_SIGNED),
}
_EXPECTED = ", ".join(name for name, _ in _LAYOUTS.values())
_LEGACY = {113: ("A16B16G16R16F", texels.HALF_RGBA), 116: ("A32B32G32R32F", texels.FLOAT_RGBA)}


def write_dds(
    path: str | os.PathLike[str],
    data: bytes,
    width: int,
    height: int,
    fmt: str,
    depth: int = 0,
    mips: int = 0,
    layers: int = 0,
) -> None:
    """Writes blocks or texels as a DDS file, atomically.

    Args:
        path: The file to write; its folder must exist.
        data: Texels row by row, or 16 bytes per block, ceil(width / 4) * ceil(height / 4) blocks.
        width, height: Size in texels, 1 to 16384.
        fmt: Texel format, a key of `DXGI_FORMATS`.
        depth: Slices of a volume, 1 to 2048, slice by slice in `data`; 0: a 2D texture.
        mips: Number of mip levels after the full-size one, each of half the size rounded down; they follow in `data`.
        layers: Number of layers of an array of 2D textures, 1 to 2048, layer by layer in `data`; 0: no array.
    """
    if fmt not in DXGI_FORMATS:
        raise ValueError(f"fmt: expected one of {', '.join(DXGI_FORMATS)}, got {fmt}")
    for name, count, alone in (("depth", depth, not layers), ("layers", layers, not mips)):
        if not 0 <= count <= MOST_SLICES or (count and not alone):
            raise ValueError(f"{name}: expected 0 to {MOST_SLICES}, and no layers with depth or mips, got {count}")
    sizes = texels.mip_bytes(fmt, width, height, mips, 0 if depth else None)
    size = (depth or layers or 1) * sizes[0] + sum(sizes[1:])
    if len(data) != size:
        raise ValueError(f"data: expected {size} bytes, got {len(data)}")
    plain = bool(texels.channel_bits(fmt))
    header = _HEADER.pack(
        MAGIC,
        _HEADER_SIZE,
        _REQUIRED | (_PITCH if plain else _LINEAR_SIZE) | (_DEPTH if depth else 0) | (_MIPS if mips else 0),
        *(height, width, texels.format_bytes(fmt, width, 1) if plain else sizes[0], depth, 1 + mips),
        *(_PIXEL_FORMAT_SIZE, _FOUR_CC, b"DX10", 0, 0, 0, 0, 0),
        _CAPS_TEXTURE | (_CAPS_COMPLEX if depth or mips or layers else 0) | (_CAPS_MIPS if mips else 0),
        *(_CAPS2_VOLUME if depth else 0, 0, 0),
    )
    dx10 = _DX10.pack(DXGI_FORMATS[fmt], _DIMENSION_3D if depth else _DIMENSION_2D, 0, max(layers, 1), 0)
    atomic_write(path, [header, dx10, data])


def read_dds(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the largest mip of a DDS texture of light; returns float32 [H, W, 3 or 4] and the channel names."""
    with open_file(path, "the DDS file") as file:
        held = os.fstat(file.fileno()).st_size
        fields = _HEADER.unpack(texels.read_head(path, file, "DDS", MAGIC, _HEADER.size))
        height, width, pixel_flags, code, caps2 = *fields[3:5], *fields[9:11], fields[17]
        texels.check_fields(
            path,
            ("header size", fields[1], fields[1] == _HEADER_SIZE, _HEADER_SIZE),
            ("pixel format size", fields[8], fields[8] == _PIXEL_FORMAT_SIZE, _PIXEL_FORMAT_SIZE),
            ("caps 2", "a cube", not caps2 & _CAPS2_CUBE, "a 2D texture"),
            ("caps 2", "a volume", not caps2 & _CAPS2_VOLUME, "a 2D texture"),
        )
        if pixel_flags & _FOUR_CC and code == b"DX10":
            name, layout = _of_dx10(path, file.read(_DX10.size))
        else:
            name, layout = _of_code(path, pixel_flags, code)
        texels.check_picture(path, held, width, height, layout.unpacked)
        part = f"{width} x {height} texels of {name}"
        data = texels.read_part(path, file, file.tell(), layout.bytes_of(width, height), part)
    return texels.decode_texels(path, layout, data, width, height), layout.names


def _of_dx10(path: str | os.PathLike[str], data: bytes) -> tuple[str, Layout]:
    """Returns the texel format that the DX10 header states."""
    if len(data) < _DX10.size:
        raise WlmError(f"{path}: the file is cut short within its DX10 header")
    number, dimension, flags, layers, _ = _DX10.unpack(data)
    chosen = texels.layout_of(path, "DXGI format", number, _LAYOUTS, DXGI_FORMATS, _EXPECTED)
    texels.check_fields(
        path,
        ("dimension", dimension, dimension == _DIMENSION_2D, f"{_DIMENSION_2D} (2D)"),
        ("DX10 flags", hex(flags), not flags & _FLAG_CUBE, "no cube"),
        ("array size", layers, layers <= 1, "1 (no array)"),
    )
    return chosen


def _of_code(path: str | os.PathLike[str], flags: int, code: bytes) -> tuple[str, Layout]:
    """Returns the texel format of a file without a DX10 header, from its FourCC code."""
    number = int.from_bytes(code, "little")
    if flags & _FOUR_CC and number in _LEGACY:
        return _LEGACY[number]
    text = code.decode("latin-1") if code.isalnum() else str(number)
    found = f"FourCC {text}" if flags & _FOUR_CC else "bit masks of integers"
    known = " or ".join(f"{number} ({name})" for number, (name, _) in _LEGACY.items())
    raise WlmError(f"{path}: pixel format: expected DX10, or FourCC {known}, found {found}")
