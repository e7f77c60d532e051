"""KTX2 files of the textures that we export: 2D, the tail of an atlas with mips, or 3D for grids of probes; none is
supercompressed.

Layout: the KTX file format specification 2.0; the data format descriptor: Khronos Data Format specification 1.3, the
basic descriptor block.
"""

import math
import os
import struct

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.reading import read_file

VK_FORMATS = {
    "R16G16_UNORM": 77,
    "R16G16_UINT": 81,
    "R16G16_SFLOAT": 83,
    "R16G16B16_SFLOAT": 90,
    "R16G16B16A16_SFLOAT": 97,
    "R32G32_SFLOAT": 103,
    "E5B9G9R9_UFLOAT_PACK32": 123,
    "BC6H_UFLOAT_BLOCK": 143,
    "ASTC_4x4_SFLOAT_BLOCK": 1000066000,
}
"""The formats that can be written and their Vulkan numbers: 16 or 32 bits a channel, RGB9E5, or 16 bytes a block of 4 x
4."""

_IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
# Identifier; format, bytes of a channel, width, height, depth, layers, faces, levels, supercompression; offset and
# length of the descriptor and of the key/value data; of the supercompression's data.
_HEADER = struct.Struct("<12s 9I 4I 2Q")
_LEVEL = struct.Struct("<3Q")  # a level's offset, length and length without supercompression
_BLOCK_BYTES = 16
_MAX_SIDE = 16384  # texels; the limit of desktop GPUs
_MAX_DEPTH = 2048  # slices, likewise
_MOST_TEXELS = 2**22  # that are read: 600,000 probes
_MOST_PAIRS = 4096  # bytes of the descriptor and the key/value data

_CHANNELS = {
    "R16G16_UNORM": 2,
    "R16G16_UINT": 2,
    "R16G16_SFLOAT": 2,
    "R16G16B16_SFLOAT": 3,
    "R16G16B16A16_SFLOAT": 4,
    "R32G32_SFLOAT": 2,
}
_RGBSDA, _BC6H, _ASTC = 1, 133, 162  # colour models
_CHANNEL_IDS = (0, 1, 2, 15)  # red, green, blue, alpha
_VERSION, _BT709, _LINEAR = 2, 1, 1
_FLOAT, _SIGNED, _EXPONENT = 0x80, 0x40, 0x20  # a sample's qualifiers
_SHARED = "E5B9G9R9_UFLOAT_PACK32"
# Its mantissa that stands for 1 at the exponent's middle, and the exponent's middle and most (section 5.21).
_SHARED_UNITY, _SHARED_MIDDLE, _SHARED_MOST = 8448, 15, 31


def write_ktx2(
    path: str | os.PathLike[str], data: bytes, width: int, height: int, fmt: str, depth: int = 0, mips: int = 0
) -> int:
    """Writes texels or blocks as a KTX2 file, whole or not at all.

    Args:
        path: The file to write; its folder must exist.
        data: Rows from the top: texels of 16- or 32-bit channels, little-endian, or ceil(width / 4) * ceil(height / 4)
            blocks of 16 bytes; of RGB9E5 one word of 32 bits a texel.
        width: Texels, 1 to 16384.
        height: Texels, 1 to 16384.
        fmt: A key of `VK_FORMATS`.
        depth: Slices of a 3D texture of texels, 1 to 2048, each with its rows in `data`; 0: a 2D texture.
        mips: Levels after the first of a 2D texture, of half the size each, rounded down; `data` holds them one after
            another.

    Returns:
        The number of bytes written.

    Raises:
        ValueError: An unknown format, a size or a number of mips out of range, mips of a 3D texture, or data that
            doesn't fill the texture.
        WlmError: The file can't be written; what was there before stays.
    """
    if fmt not in VK_FORMATS:
        raise ValueError(f"fmt: expected one of {', '.join(VK_FORMATS)}, got {fmt}")
    if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE):
        raise ValueError(f"expected sides of 1 to {_MAX_SIDE} texels, got {width}x{height}")
    if not 0 <= depth <= _MAX_DEPTH or (depth and fmt not in _CHANNELS):
        raise ValueError(f"depth: expected 0 to {_MAX_DEPTH} slices of texels, got {depth} of {fmt}")
    most = 0 if depth else max(width, height).bit_length() - 1
    if not 0 <= mips <= most:
        raise ValueError(f"mips: expected 0 to {most}, got {mips}")
    sizes = [_size(fmt, max(width >> level, 1), max(height >> level, 1)) * max(depth, 1) for level in range(mips + 1)]
    if len(data) != sum(sizes):
        raise ValueError(f"data: expected {sum(sizes)} bytes, got {len(data)}")
    descriptor = _descriptor(fmt)
    # In the order of their keys; r, d and i: to the right, down and inwards.
    pairs = _pair("KTXorientation", "rdi" if depth else "rd") + _pair("KTXwriter", "wlm")
    begin = _HEADER.size + _LEVEL.size * len(sizes)
    end = begin + len(descriptor) + len(pairs)
    # A level begins at a multiple of both 4 and the bytes of a texel or block; the smallest comes first.
    step = math.lcm(4, _texel_bytes(fmt))
    index, pieces, place = [], [], end
    for level in reversed(range(len(sizes))):
        first = sum(sizes[:level])
        gap = bytes(-place % step)
        index.insert(0, _LEVEL.pack(place + len(gap), sizes[level], sizes[level]))
        pieces += [gap, data[first : first + sizes[level]]]
        place += len(gap) + sizes[level]
    header = _HEADER.pack(
        _IDENTIFIER,
        VK_FORMATS[fmt],
        4 if fmt == _SHARED else _channel_bytes(fmt) if fmt in _CHANNELS else 1,
        width,
        height,
        *(depth, 0, 1, 1 + mips, 0),
        begin,
        len(descriptor),
        begin + len(descriptor),
        len(pairs),
        *(0, 0),
    )
    return atomic_write(path, [header, *index, descriptor, pairs, *pieces])


def read_half_volume(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads a 3D texture of half floats in RGBA as `write_ktx2` writes it.

    Args:
        path: The file.

    Returns:
        float16 [D, H, W, 4].

    Raises:
        WlmError: The file can't be read, is another kind of texture, or is cut short.
    """
    head = _HEADER.size + _LEVEL.size
    largest = head + _MOST_TEXELS * 8 + _MOST_PAIRS
    data = read_file(path, largest, "the texture")
    if len(data) < head or data[: len(_IDENTIFIER)] != _IDENTIFIER:
        raise WlmError(f"{path}: expected a KTX2 texture")
    fields = _HEADER.unpack_from(data)
    fmt, _, width, height, depth, layers, faces, levels, packing = fields[1:10]
    start, length, _ = _LEVEL.unpack_from(data, _HEADER.size)
    if (fmt, layers, faces, levels, packing) != (VK_FORMATS["R16G16B16A16_SFLOAT"], 0, 1, 1, 0) or not depth:
        raise WlmError(f"{path}: expected one 3D texture of half floats in RGBA, not packed, found format {fmt}")
    if length != 8 * width * height * depth or start + length > len(data):
        raise WlmError(f"{path}: expected {width} x {height} x {depth} texels, found {length} bytes of them")
    return np.frombuffer(data, "<f2", 4 * width * height * depth, start).reshape(depth, height, width, 4)


def _texel_bytes(fmt: str) -> int:
    if fmt == _SHARED:
        return 4
    return _channel_bytes(fmt) * _CHANNELS[fmt] if fmt in _CHANNELS else _BLOCK_BYTES


def _channel_bytes(fmt: str) -> int:
    return 4 if fmt.startswith("R32") else 2


def _size(fmt: str, width: int, height: int) -> int:
    if fmt in _CHANNELS or fmt == _SHARED:
        return width * height * _texel_bytes(fmt)
    return -(-width // 4) * -(-height // 4) * _BLOCK_BYTES


def _pair(key: str, value: str) -> bytes:
    """One key and its value, with their length before and zeros to a multiple of 4 bytes behind."""
    text = f"{key}\0{value}\0".encode()
    return struct.pack("<I", len(text)) + text + bytes(-len(text) % 4)


def _descriptor(fmt: str) -> bytes:
    """The data format descriptor: its total length and one basic descriptor block."""
    if fmt == _SHARED:
        # The exponent is named once for each channel.
        samples = []
        for i, channel in enumerate(_CHANNEL_IDS[:3]):
            samples.append(struct.pack("<H2B4x2I", 9 * i, 8, channel, 0, _SHARED_UNITY))
            samples.append(struct.pack("<H2B4x2I", 27, 4, channel | _EXPONENT, _SHARED_MIDDLE, _SHARED_MOST))
        return _basic_block(_RGBSDA, 0, 4, samples)
    if fmt in _CHANNELS:
        model, side = _RGBSDA, 0
        bits = 8 * _channel_bytes(fmt)
        samples = [(bits * i, bits, channel) for i, channel in enumerate(_CHANNEL_IDS[: _CHANNELS[fmt]])]
    else:
        model, side = (_BC6H if fmt.startswith("BC6H") else _ASTC), 3  # sides are stored less one
        samples = [(0, 8 * _BLOCK_BYTES, 0)]
    if fmt.endswith(("_UNORM", "_UINT")):  # what stands for 0 and for 1; an integer stands for itself
        unity = 0xFFFF if fmt.endswith("_UNORM") else 1
        qualifiers, lowest, highest = 0, struct.pack("<I", 0), struct.pack("<I", unity)
    else:  # of floats the range that stands for -1 or 0 to 1, as floats of 32 bits
        unsigned = "UFLOAT" in fmt
        qualifiers = _FLOAT if unsigned else _FLOAT | _SIGNED
        lowest, highest = struct.pack("<f", 0.0 if unsigned else -1.0), struct.pack("<f", 1.0)
    packed = [
        struct.pack("<H2B4x", offset, bits - 1, channel | qualifiers) + lowest + highest
        for offset, bits, channel in samples
    ]
    return _basic_block(model, side, _texel_bytes(fmt), packed)


def _basic_block(model: int, side: int, texel_bytes: int, samples: list[bytes]) -> bytes:
    size = 24 + 16 * len(samples)
    # Vendor and type; version and size; model, primaries, transfer and flags; the block's sides; bytes of a plane.
    head = (0, _VERSION, size, model, _BT709, _LINEAR, 0, side, side, 0, 0, texel_bytes)
    block = struct.pack("<I 2H 4B 4B B7x", *head) + b"".join(samples)
    return struct.pack("<I", 4 + size) + block
