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
from wlm.formats.float_texels import Layout, check_picture, decode_texels
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

_BLOCK_BYTES = 16
# Bytes of a texel, for the formats without blocks.
_TEXEL_BYTES = {
    "R32G32B32A32_FLOAT": 16,
    "R16G16B16A16_UINT": 8,
    "R16G16B16A16_FLOAT": 8,
    "R10G10B10A2_UNORM": 4,
    "R11G11B10_FLOAT": 4,
    "R8G8B8A8_UNORM": 4,
    "R16G16_FLOAT": 4,
    "R16G16_UNORM": 4,
    "R16G16_UINT": 4,
    "R8G8_UNORM": 2,
    "R8_UNORM": 1,
    "R9G9B9E5_SHAREDEXP": 4,
}
MOST_SIDE = 16384
"""Largest side of a 2D texture in Direct3D 11 and 12, in texels."""
_MAX_DEPTH = 2048

MAGIC = b"DDS "
# Size, flags, height, width, linear size, depth, mip levels, 11 reserved; pixel format: size, flags, code,
# bits, 4 masks; caps 1 to 4, reserved. Then DX10: format, dimension, flags, array size, alpha mode.
_HEADER = struct.Struct("<4s 7I 44x 2I 4s 5I 4I 4x 5I")
_HEADER_SIZE = 124
_PIXEL_FORMAT_SIZE = 32

_CAPS, _HEIGHT, _WIDTH, _PIXEL_FORMAT, _DEPTH = 0x1, 0x2, 0x4, 0x1000, 0x800000
_PITCH, _LINEAR_SIZE = 0x8, 0x80000  # the size field states the bytes of a row, or of a slice
_REQUIRED = _CAPS | _HEIGHT | _WIDTH | _PIXEL_FORMAT
_FOUR_CC = 0x4
_CAPS_COMPLEX, _CAPS_TEXTURE, _CAPS_MIPS = 0x8, 0x1000, 0x400000
_MIPS = 0x20000
_CAPS2_VOLUME = 0x200000
_DIMENSION_2D, _DIMENSION_3D = 3, 4

# Size, flags, height, width; pixel format: size, flags, code; caps 2. Then the DX10 header.
_READ_HEADER = struct.Struct("<4s 4I 56x 2I 4s 24x I 12x")
_DX10 = struct.Struct("<5I")  # format, dimension, flags, array size, alpha mode
_CAPS2_CUBE = 0x200
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
    blocks: bytes,
    width: int,
    height: int,
    depth: int = 1,
    fmt: str = "BC7_UNORM",
    volume: bool | None = None,
    mips: int = 0,
    layers: int = 0,
) -> None:
    """Writes blocks or texels as a DDS file, atomically.

    Args:
        path: The file to write; its folder must exist.
        blocks: 16 bytes per block, ceil(width / 4) * ceil(height / 4) blocks per slice, slice by slice; for a format
            without blocks the texels, row by row.
        width: Width in texels, 1 to 16384.
        height: Height in texels, 1 to 16384.
        depth: Number of slices, 1 to 2048.
        fmt: Texel format, a key of `DXGI_FORMATS`.
        volume: Whether the texture is a volume, which shaders sample as 3D; None: if `depth` is above 1.
        mips: Number of mip levels after the full-size one, each of half the size rounded down; they follow in `blocks`.
        layers: Number of layers of an array of 2D textures, 1 to 2048, layer by layer in `blocks`; 0: no array.

    Raises:
        ValueError: The format is unknown; a size, the mips or the layers are out of range; slices, mips and layers are
            combined in a way that DDS cannot store; or the blocks do not fill the texture.
        WlmError: The file cannot be written; the old content stays.
    """
    if fmt not in DXGI_FORMATS:
        raise ValueError(f"fmt: expected one of {', '.join(DXGI_FORMATS)}, got {fmt}")
    if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE and 1 <= depth <= _MAX_DEPTH):
        raise ValueError(f"expected 1 to {MOST_SIDE}x{MOST_SIDE}x{_MAX_DEPTH} texels, got {width}x{height}x{depth}")
    volume = depth > 1 if volume is None else volume
    most = 0 if volume else max(width, height).bit_length() - 1
    if not 0 <= mips <= most:
        raise ValueError(f"mips: expected 0 to {most}, got {mips}")
    if not 0 <= layers <= _MAX_DEPTH or (layers and (volume or mips)):
        raise ValueError(f"layers: expected 0 to {_MAX_DEPTH}, and 0 for a volume or with mips, got {layers}")
    slice_bytes = _slice_bytes(fmt, width, height)
    levels = (_slice_bytes(fmt, max(width >> level, 1), max(height >> level, 1)) for level in range(1, mips + 1))
    whole = depth * max(layers, 1) * slice_bytes + sum(levels)
    if len(blocks) != whole:
        raise ValueError(f"blocks: expected {whole} bytes, got {len(blocks)}")
    if depth > 1 and not volume:
        raise ValueError(f"depth: expected 1 for a 2D texture, got {depth}")
    size_flag, size = _LINEAR_SIZE, slice_bytes
    if fmt in _TEXEL_BYTES:
        size_flag, size = _PITCH, width * _TEXEL_BYTES[fmt]
    header = _HEADER.pack(
        MAGIC,
        _HEADER_SIZE,
        _REQUIRED | size_flag | (_DEPTH if volume else 0) | (_MIPS if mips else 0),
        height,
        width,
        size,
        depth if volume else 0,
        1 + mips,
        _PIXEL_FORMAT_SIZE,
        _FOUR_CC,
        b"DX10",
        *(0, 0, 0, 0, 0),
        _CAPS_TEXTURE | (_CAPS_COMPLEX if volume or mips or layers else 0) | (_CAPS_MIPS if mips else 0),
        _CAPS2_VOLUME if volume else 0,
        *(0, 0),
        DXGI_FORMATS[fmt],
        _DIMENSION_3D if volume else _DIMENSION_2D,
        *(0, max(layers, 1), 0),
    )
    atomic_write(path, [header, blocks])


def _slice_bytes(fmt: str, width: int, height: int) -> int:
    if fmt in _TEXEL_BYTES:
        return width * height * _TEXEL_BYTES[fmt]
    return -(-width // 4) * -(-height // 4) * _BLOCK_BYTES


def read_dds(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the largest mip of a DDS texture of light; returns float32 [H, W, 3 or 4] and the channel names.

    Raises:
        WlmError: The file is missing, is not a DDS file, is cut short or damaged, has another format, is an array, a
            cube or a volume, or the package that decodes it is missing.
    """
    with open_file(path, "the DDS file") as file:
        held = os.fstat(file.fileno()).st_size
        head = file.read(_READ_HEADER.size)
        if not head.startswith(MAGIC):
            raise WlmError(f"{path}: expected a DDS file, found other content")
        if len(head) < _READ_HEADER.size:
            raise WlmError(f"{path}: the file is cut short: expected {_READ_HEADER.size} bytes, found {len(head)}")
        _, size, _, height, width, pixel_size, pixel_flags, code, caps2 = _READ_HEADER.unpack(head)
        for field, found, expected in (
            ("header size", size, _HEADER_SIZE),
            ("pixel format size", pixel_size, _PIXEL_FORMAT_SIZE),
        ):
            if found != expected:
                raise WlmError(f"{path}: {field}: expected {expected}, found {found}")
        if caps2 & (_CAPS2_CUBE | _CAPS2_VOLUME):
            kind = "cube" if caps2 & _CAPS2_CUBE else "volume"
            raise WlmError(f"{path}: expected a 2D texture, found a {kind}")
        if pixel_flags & _FOUR_CC and code == b"DX10":
            name, layout = _of_dx10(path, file.read(_DX10.size))
        else:
            name, layout = _of_code(path, pixel_flags, code)
        check_picture(path, held, width, height, layout.unpacked)
        expected = layout.bytes_of(width, height)
        start = file.tell()
        if start + expected > held:
            claimed = f"{start + expected} bytes, of {width} x {height} {name}"
            raise WlmError(f"{path}: the file is cut short: expected {claimed}, found {held}")
        data = file.read(expected)
    if len(data) != expected:
        raise WlmError(f"{path}: expected {expected} bytes of texels, found {len(data)}; has the file changed?")
    return decode_texels(path, layout, data, width, height), layout.names


def _of_dx10(path: str | os.PathLike[str], data: bytes) -> tuple[str, Layout]:
    """Returns the texel format that the DX10 header states."""
    if len(data) < _DX10.size:
        raise WlmError(f"{path}: the file is cut short within its DX10 header")
    number, dimension, flags, layers, _ = _DX10.unpack(data)
    if number not in _LAYOUTS:
        name = next((name for name, written in DXGI_FORMATS.items() if written == number), None)
        found = f"{number} ({name})" if name else number
        raise WlmError(f"{path}: DXGI format: expected {_EXPECTED}, found {found}")
    for field, found, fits, expected in (
        ("dimension", dimension, dimension == _DIMENSION_2D, f"{_DIMENSION_2D} (2D)"),
        ("DX10 flags", hex(flags), not flags & _FLAG_CUBE, "no cube"),
        ("array size", layers, layers <= 1, "1 (no array)"),
    ):
        if not fits:
            raise WlmError(f"{path}: {field}: expected {expected}, found {found}")
    return _LAYOUTS[number]


def _of_code(path: str | os.PathLike[str], flags: int, code: bytes) -> tuple[str, Layout]:
    """Returns the texel format of a file without a DX10 header, from its FourCC code."""
    number = int.from_bytes(code, "little")
    if flags & _FOUR_CC and number in _LEGACY:
        return _LEGACY[number]
    text = code.decode("latin-1") if code.isalnum() else str(number)
    found = f"FourCC {text}" if flags & _FOUR_CC else "bit masks of integers"
    known = " or ".join(f"{number} ({name})" for number, (name, _) in _LEGACY.items())
    raise WlmError(f"{path}: pixel format: expected DX10, or FourCC {known}, found {found}")
