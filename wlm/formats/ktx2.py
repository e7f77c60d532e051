"""Writing of KTX2 files without supercompression: 2D textures of ASTC blocks, and 3D textures of half floats.

Sources: KTX file format specification 2.0; for the data format descriptor, Khronos Data Format specification 1.3, basic
descriptor block.
"""

import os
import struct

from wlm.formats.atomic import atomic_write

VK_FORMATS = {"R16G16B16A16_SFLOAT": 97, "ASTC_4x4_SFLOAT_BLOCK": 1000066000}
"""Formats that can be written, with their Vulkan numbers."""

_MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"
# Identifier; format, bytes of a channel, width, height, depth, layers, faces, levels, supercompression; offset and
# length of the descriptor, of the key/value data and of the supercompression data.
_HEADER = struct.Struct("<12s 9I 4I 2Q")
_LEVEL = struct.Struct("<3Q")  # a level's offset, length and length without supercompression
_ASTC = "ASTC_4x4_SFLOAT_BLOCK"
_BLOCK_BYTES, _TEXEL_BYTES, _CHANNEL_BITS = 16, 8, 16
_MAX_SIDE = 16384  # texels; the limit of desktop GPUs
_MAX_DEPTH = 2048  # slices, likewise
_RGBSDA_MODEL, _ASTC_MODEL = 1, 162
_CHANNEL_IDS = (0, 1, 2, 15)  # red, green, blue, alpha
_VERSION, _BT709, _LINEAR = 2, 1, 1
_SIGNED_FLOAT = 0xC0  # a sample's qualifiers


def write_ktx2(
    path: str | os.PathLike[str], data: bytes, width: int, height: int, fmt: str, depth: int = 0, mips: int = 0
) -> int:
    """Writes texels or blocks as a KTX2 file, atomically.

    Args:
        path: The file to write; its folder must exist.
        data: Rows from the top: RGBA texels of half floats, little-endian, or ceil(width / 4) * ceil(height / 4) blocks
            of 16 bytes.
        width: Texels, 1 to 16384.
        height: Texels, 1 to 16384.
        fmt: A key of `VK_FORMATS`.
        depth: Slices of a 3D texture of texels, 1 to 2048, each with its rows in `data`; 0: a 2D texture.
        mips: Levels after the first of a 2D texture, each of half the size rounded down; they follow in `data`.

    Returns:
        The number of bytes written.

    Raises:
        ValueError: The format is unknown, a size or the number of mips is out of range, a 3D texture has mips, or the
            data does not fill the texture.
        WlmError: The file cannot be written; the old content stays.
    """
    if fmt not in VK_FORMATS:
        raise ValueError(f"fmt: expected one of {', '.join(VK_FORMATS)}, got {fmt}")
    if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE):
        raise ValueError(f"expected sides of 1 to {_MAX_SIDE} texels, got {width}x{height}")
    if not 0 <= depth <= _MAX_DEPTH or (depth and fmt == _ASTC):
        raise ValueError(f"depth: expected 0 to {_MAX_DEPTH} slices of texels, got {depth} of {fmt}")
    most = 0 if depth else max(width, height).bit_length() - 1
    if not 0 <= mips <= most:
        raise ValueError(f"mips: expected 0 to {most}, got {mips}")
    sizes = [_size(fmt, max(width >> level, 1), max(height >> level, 1)) * max(depth, 1) for level in range(mips + 1)]
    if len(data) != sum(sizes):
        raise ValueError(f"data: expected {sum(sizes)} bytes, got {len(data)}")
    descriptor = _descriptor(fmt)
    # Sorted by key; r, d and i stand for right, down and inwards.
    pairs = _pair("KTXorientation", "rdi" if depth else "rd") + _pair("KTXwriter", "wlm")
    begin = _HEADER.size + _LEVEL.size * len(sizes)
    end = begin + len(descriptor) + len(pairs)
    # A level starts at a multiple of the bytes of a texel or block; the smallest level comes first.
    step = _BLOCK_BYTES if fmt == _ASTC else _TEXEL_BYTES
    index, pieces, place = [], [], end
    for level in reversed(range(len(sizes))):
        first = sum(sizes[:level])
        gap = bytes(-place % step)
        index.insert(0, _LEVEL.pack(place + len(gap), sizes[level], sizes[level]))
        pieces += [gap, data[first : first + sizes[level]]]
        place += len(gap) + sizes[level]
    header = _HEADER.pack(
        _MAGIC,
        VK_FORMATS[fmt],
        1 if fmt == _ASTC else _CHANNEL_BITS // 8,
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


def _size(fmt: str, width: int, height: int) -> int:
    if fmt == _ASTC:
        return -(-width // 4) * -(-height // 4) * _BLOCK_BYTES
    return width * height * _TEXEL_BYTES


def _pair(key: str, value: str) -> bytes:
    """Encodes one key and its value: their length, the text, and zeros up to a multiple of 4 bytes."""
    text = f"{key}\0{value}\0".encode()
    return struct.pack("<I", len(text)) + text + bytes(-len(text) % 4)


def _descriptor(fmt: str) -> bytes:
    """Returns the data format descriptor: its total length and one basic descriptor block."""
    if fmt == _ASTC:
        model, side, plane = _ASTC_MODEL, 3, _BLOCK_BYTES  # sides are stored less one
        samples = [(0, 8 * _BLOCK_BYTES, 0)]
    else:
        model, side, plane = _RGBSDA_MODEL, 0, _TEXEL_BYTES
        samples = [(_CHANNEL_BITS * i, _CHANNEL_BITS, channel) for i, channel in enumerate(_CHANNEL_IDS)]
    # Offset, bits, channel; the codes of -1 and of 1.
    packed = [struct.pack("<H2B4x2f", at, bits - 1, channel | _SIGNED_FLOAT, -1, 1) for at, bits, channel in samples]
    size = 24 + 16 * len(samples)
    # Vendor and type; version and size; model, primaries, transfer and flags; block sides; bytes of a plane.
    head = (0, _VERSION, size, model, _BT709, _LINEAR, 0, side, side, 0, 0, plane)
    return struct.pack("<I", 4 + size) + struct.pack("<I 2H 4B 4B B7x", *head) + b"".join(packed)
