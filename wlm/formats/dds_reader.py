"""Reading light from DDS files: 2D textures of floats, the largest mip level alone; the top row is the first.

Volumes of four bytes a texel, as `wlm.formats.dds` writes them, come as they are.

Layout: Microsoft's DDS_HEADER and DDS_HEADER_DXT10, and the FourCC of Direct3D 9's float formats.
"""

import os
import struct

import numpy as np

from wlm.errors import WlmError
from wlm.formats import float_texels as texels
from wlm.formats.dds import DXGI_FORMATS
from wlm.formats.float_texels import Layout, check_picture, decode_texels
from wlm.formats.reading import open_file, read_file

MAGIC = b"DDS "

# Size, flags, height, width; pixel format: size, flags, code; caps 2.
_HEADER = struct.Struct("<4s 4I 56x 2I 4s 24x I 12x")
_DX10 = struct.Struct("<5I")  # format, dimension, flags, array size, alpha mode
_DEPTH, _DEPTH_AT = struct.Struct("<I"), 24
_MOST_BYTES = 1 << 26  # of a volume
_HEADER_SIZE, _PIXEL_FORMAT_SIZE = 124, 32
_FOUR_CC = 0x4
_CAPS2_CUBE, _CAPS2_VOLUME = 0x200, 0x200000
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
# Those that textures often have, for the message.
_OTHERS = {
    11: "R16G16B16A16_UNORM",
    16: "R32G32_FLOAT",
    24: "R10G10B10A2_UNORM",
    28: "R8G8B8A8_UNORM",
    29: "R8G8B8A8_UNORM_SRGB",
    34: "R16G16_FLOAT",
    41: "R32_FLOAT",
    54: "R16_FLOAT",
    71: "BC1_UNORM",
    72: "BC1_UNORM_SRGB",
    77: "BC3_UNORM",
    78: "BC3_UNORM_SRGB",
    80: "BC4_UNORM",
    83: "BC5_UNORM",
    87: "B8G8R8A8_UNORM",
    91: "B8G8R8A8_UNORM_SRGB",
    94: "BC6H_TYPELESS",
    98: "BC7_UNORM",
    99: "BC7_UNORM_SRGB",
}


def read_dds(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the largest level of a DDS file of light.

    Args:
        path: The file.

    Returns:
        The pixels, float32 [H, W, 3 or 4], and the channels' names.

    Raises:
        WlmError: The file is missing, not a DDS, cut short or damaged, of another format, an array, a cube or a volume,
            or the package that decodes it is missing.
    """
    with open_file(path, "the DDS file") as file:
        held = os.fstat(file.fileno()).st_size
        head = file.read(_HEADER.size)
        if not head.startswith(MAGIC):
            raise WlmError(f"{path}: expected a DDS file, found other content")
        if len(head) < _HEADER.size:
            raise WlmError(f"{path}: the file is cut short: expected {_HEADER.size} bytes, found {len(head)}")
        _, size, _, height, width, pixel_size, pixel_flags, code, caps2 = _HEADER.unpack(head)
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
        raise WlmError(f"{path}: expected {expected} bytes of texels, found another number: does it change?")
    return decode_texels(path, layout, data, width, height), layout.names


def read_word_volume(path: str | os.PathLike[str], fmt: str, size: tuple[int, int, int]) -> np.ndarray:
    """Reads a volume texture of four bytes a texel.

    Args:
        path: The file.
        fmt: A key of `wlm.formats.dds.DXGI_FORMATS`.
        size: Width, height and depth.

    Returns:
        uint32 [depth, height, width], little-endian, the first channel in the lowest bits.

    Raises:
        WlmError: The file can't be read, is another kind of texture or of another size, or is cut short.
    """
    width, height, depth = size
    head = _HEADER.size + _DX10.size
    data = read_file(path, _MOST_BYTES, "the texture")
    if len(data) < head or not data.startswith(MAGIC):
        raise WlmError(f"{path}: expected a DDS file of {width} x {height} x {depth} texels, found other content")
    _, _, _, rows, columns, _, _, code, caps2 = _HEADER.unpack_from(data)
    number, dimension, *_ = _DX10.unpack_from(data, _HEADER.size)
    expected = (b"DX10", DXGI_FORMATS[fmt], _DIMENSION_3D)
    if (code, number, dimension) != expected or not caps2 & _CAPS2_VOLUME:
        raise WlmError(f"{path}: expected a volume texture of {fmt}, found another kind")
    found = (columns, rows, *_DEPTH.unpack_from(data, _DEPTH_AT))
    if found != size or len(data) != head + 4 * width * height * depth:
        raise WlmError(
            f"{path}: expected {width} x {height} x {depth} texels, found {' x '.join(map(str, found))} "
            f"in {len(data) - head} bytes"
        )
    return np.frombuffer(data, "<u4", offset=head).reshape(depth, height, width)


def _of_dx10(path: str | os.PathLike[str], data: bytes) -> tuple[str, Layout]:
    """The format that the DX10 header states."""
    if len(data) < _DX10.size:
        raise WlmError(f"{path}: the file is cut short within its DX10 header")
    number, dimension, flags, layers, _ = _DX10.unpack(data)
    if number not in _LAYOUTS:
        found = f"{number} ({_OTHERS[number]})" if number in _OTHERS else number
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
    """The format of a file without the DX10 header."""
    number = int.from_bytes(code, "little")
    if flags & _FOUR_CC and number in _LEGACY:
        return _LEGACY[number]
    text = code.decode("latin-1") if code.isalnum() else str(number)
    found = f"FourCC {text}" if flags & _FOUR_CC else "bit masks of integers"
    known = " or ".join(f"{number} ({name})" for number, (name, _) in _LEGACY.items())
    raise WlmError(f"{path}: pixel format: expected DX10, or FourCC {known}, found {found}")
