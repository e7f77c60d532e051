"""Reading light from KTX2 files: 2D textures of floats, the largest mip level alone.

Layout: the KTX file format specification 2.0. Formats without light beyond 1, with fewer than three channels, arrays,
cubes and volumes are refused.
"""

import os
import struct
import zlib
from typing import BinaryIO

import numpy as np

from wlm.errors import WlmError
from wlm.formats import float_texels as texels
from wlm.formats.float_texels import Layout, check_picture, decode_texels, unpack_zstd
from wlm.formats.hdr_blocks import ASTC_BLOCKS
from wlm.formats.reading import open_file

MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"

# As `wlm.formats.ktx2` writes it: of files with more levels the first is the largest, too.
_HEADER = struct.Struct("<12s 9I 4I 2Q 3Q")
_PAIRS_BYTES = 1 << 20  # of the key/value data
_DESCRIPTOR_BYTES = 20  # of the descriptor, up to its colours
_TRANSFERS = (0, 1)  # unspecified, linear

_LAYOUTS: dict[int, tuple[str, Layout]] = {
    90: ("R16G16B16_SFLOAT", texels.HALF_RGB),
    97: ("R16G16B16A16_SFLOAT", texels.HALF_RGBA),
    106: ("R32G32B32_SFLOAT", texels.FLOAT_RGB),
    109: ("R32G32B32A32_SFLOAT", texels.FLOAT_RGBA),
    122: ("B10G11R11_UFLOAT_PACK32", texels.PACKED),
    123: ("E5B9G9R9_UFLOAT_PACK32", texels.SHARED),
    143: ("BC6H_UFLOAT_BLOCK", texels.BC6H_UNSIGNED),
    144: ("BC6H_SFLOAT_BLOCK", texels.BC6H_SIGNED),
    **{
        1000066000 + i: (f"ASTC_{block[0]}x{block[1]}_SFLOAT_BLOCK", texels.ASTC[block])
        for i, block in enumerate(ASTC_BLOCKS)
    },
}
_EXPECTED = "16 or 32-bit SFLOAT of RGB or RGBA, B10G11R11, E5B9G9R9, BC6H or ASTC SFLOAT"
# Those that textures often have, for the message.
_OTHERS = {
    0: "UNDEFINED (Basis Universal)",
    23: "R8G8B8_UNORM",
    29: "R8G8B8_SRGB",
    37: "R8G8B8A8_UNORM",
    43: "R8G8B8A8_SRGB",
    44: "B8G8R8A8_UNORM",
    50: "B8G8R8A8_SRGB",
    76: "R16_SFLOAT",
    83: "R16G16_SFLOAT",
    91: "R16G16B16A16_UNORM",
    100: "R32_SFLOAT",
    103: "R32G32_SFLOAT",
    131: "BC1_RGB_UNORM_BLOCK",
    132: "BC1_RGB_SRGB_BLOCK",
    133: "BC1_RGBA_UNORM_BLOCK",
    134: "BC1_RGBA_SRGB_BLOCK",
    137: "BC3_UNORM_BLOCK",
    138: "BC3_SRGB_BLOCK",
    139: "BC4_UNORM_BLOCK",
    141: "BC5_UNORM_BLOCK",
    145: "BC7_UNORM_BLOCK",
    146: "BC7_SRGB_BLOCK",
    147: "ETC2_R8G8B8_UNORM_BLOCK",
    148: "ETC2_R8G8B8_SRGB_BLOCK",
    151: "ETC2_R8G8B8A8_UNORM_BLOCK",
    152: "ETC2_R8G8B8A8_SRGB_BLOCK",
    **{
        157 + 2 * i + j: f"ASTC_{width}x{height}_{kind}_BLOCK"
        for i, (width, height) in enumerate(ASTC_BLOCKS)
        for j, kind in enumerate(("UNORM", "SRGB"))
    },
}
_NONE, _ZSTD, _ZLIB = 0, 2, 3


def read_ktx2(path: str | os.PathLike[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the largest level of a KTX2 file of light, plain or under zstd or zlib.

    `KTXorientation` is honoured: the pixels' first row is the top one.

    Args:
        path: The file.

    Returns:
        The pixels, float32 [H, W, 3 or 4], and the channels' names. Of ASTC the alpha is left out.

    Raises:
        WlmError: The file is missing, not a KTX2, cut short or damaged, of another format, an array, a cube or a
            volume, its channels are exchanged or not linear, or the package that unpacks it is missing.
    """
    with open_file(path, "the KTX2 file") as file:
        held = os.fstat(file.fileno()).st_size
        head = file.read(_HEADER.size)
        if not head.startswith(MAGIC):
            raise WlmError(f"{path}: expected a KTX2 file, found other content")
        if len(head) < _HEADER.size:
            raise WlmError(f"{path}: the file is cut short: expected {_HEADER.size} bytes, found {len(head)}")
        fields = _HEADER.unpack(head)
        number, _, width, height, depth, layers, faces, _, scheme = fields[1:10]
        descriptor, pairs = fields[10:12], fields[12:14]
        start, stored, size = fields[16:19]
        if number not in _LAYOUTS:
            found = f"{number} ({_OTHERS[number]})" if number in _OTHERS else number
            raise WlmError(f"{path}: vkFormat: expected {_EXPECTED}, found {found}")
        name, layout = _LAYOUTS[number]
        for field, found, fits, expected in (
            ("pixelHeight", height, height > 0, "at least 1 (2D)"),
            ("pixelDepth", depth, depth <= 1, "0 (no volume)"),
            ("layerCount", layers, layers <= 1, "0 (no array)"),
            ("faceCount", faces, faces == 1, "1 (no cube)"),
            ("supercompressionScheme", scheme, scheme in (_NONE, _ZSTD, _ZLIB), "none (0), zstd (2) or zlib (3)"),
        ):
            if not fits:
                raise WlmError(f"{path}: {field}: expected {expected}, found {found}")
        check_picture(path, held, width, height, layout.unpacked)
        expected = layout.bytes_of(width, height)
        for field, found in (("byteLength", stored), ("uncompressedByteLength", size))[scheme != _NONE :]:
            if found != expected:
                raise WlmError(
                    f"{path}: {field} of level 0: expected {expected}, of {width} x {height} {name}, found {found}"
                )
        if stored > 2 * expected + 1024:  # no packer makes it longer than that
            raise WlmError(f"{path}: byteLength of level 0: expected at most {2 * expected + 1024}, found {stored}")
        _check_descriptor(path, _part(path, file, held, *descriptor, "the data format descriptor", _DESCRIPTOR_BYTES))
        words = _part(path, file, held, *pairs, "the key/value data", _PAIRS_BYTES)
        right, down = _orientation(path, words, layout.channels)
        data = _part(path, file, held, start, stored, "level 0", stored)
    if scheme == _ZSTD:
        data = unpack_zstd(path, data, expected)
    elif scheme == _ZLIB:
        data = _unpack_zlib(path, data, expected)
    if len(data) != expected:
        raise WlmError(f"{path}: level 0: expected {expected} bytes once unpacked, found {len(data)}")
    pixels = decode_texels(path, layout, data, width, height)
    return np.ascontiguousarray(pixels[:: 1 if down else -1, :: 1 if right else -1]), layout.names


def _part(
    path: str | os.PathLike[str], file: BinaryIO, held: int, start: int, size: int, what: str, most: int
) -> bytes:
    """Reads a part of the file, its first bytes alone where it has more than `most`."""
    if start + size > held:
        raise WlmError(f"{path}: {what}: the file is cut short: expected {start + size} bytes, found {held}")
    file.seek(start)
    data = file.read(min(size, most))
    if len(data) != min(size, most):
        raise WlmError(f"{path}: {what}: expected {min(size, most)} bytes, found another number: does it change?")
    return data


def _check_descriptor(path: str | os.PathLike[str], data: bytes) -> None:
    """Checks that the light is linear: its size, a block's kind and size, then model, primaries and transfer."""
    if len(data) < _DESCRIPTOR_BYTES:
        raise WlmError(f"{path}: the data format descriptor: expected {_DESCRIPTOR_BYTES} bytes, found {len(data)}")
    transfer = data[14]
    if transfer not in _TRANSFERS:
        raise WlmError(f"{path}: the data format descriptor: expected linear light (transfer 1), found {transfer}")


def _orientation(path: str | os.PathLike[str], data: bytes, channels: int) -> tuple[bool, bool]:
    """Whether columns go to the right and rows down, as they do without a word; checks the order of channels."""
    found = {b"KTXorientation": b"rd", b"KTXswizzle": b"rgba"}
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        key, _, value = data[at + 4 : at + 4 + size].partition(b"\0")
        if not 0 < size <= len(data) - at - 4:
            raise WlmError(f"{path}: the key/value data is damaged, or longer than {_PAIRS_BYTES} bytes")
        if key in found:
            found[key] = value.rstrip(b"\0")
        at += 4 + size + -size % 4
    orientation, swizzle = found.values()
    if orientation not in (b"rd", b"ru", b"ld", b"lu"):
        raise WlmError(f"{path}: KTXorientation: expected rd, ru, ld or lu, found {orientation[:20]}")
    if swizzle[:channels] != b"rgba"[:channels]:
        raise WlmError(f"{path}: KTXswizzle: expected rgba, found {swizzle[:20]}")
    return orientation[:1] == b"r", orientation[1:] == b"d"


def _unpack_zlib(path: str | os.PathLike[str], data: bytes, size: int) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(data, size + 1)
    except zlib.error as error:
        raise WlmError(f"{path}: cannot unpack zlib: {error}") from error
    if not unpacker.eof:
        raise WlmError(f"{path}: cannot unpack zlib: level 0 is cut short or becomes more than {size} bytes")
    return unpacked
