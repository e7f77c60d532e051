"""KTX2 files: writing of 2D textures (with mips) and 3D textures without supercompression, and reading of light.

Only the largest mip of a 2D or a 3D texture of light is read; arrays, cubes and formats of low range or of fewer than
three channels are refused. Sources: KTX file format specification 2.0; for the data format descriptor, Khronos Data
Format specification 1.3, basic descriptor block.
"""

import math
import os
import struct

import numpy as np

from wlm.errors import WlmError
from wlm.formats import float_texels as texels
from wlm.formats.atomic import atomic_write
from wlm.formats.float_texels import MOST_SLICES, Layout, channel_bits, check_fields, format_bytes, read_part
from wlm.formats.hdr_blocks import ASTC_BLOCKS
from wlm.formats.primaries import ACES_AP0, ACES_AP1, ADOBE_RGB, CIE_XYZ, P3_D65, REC709, REC2020, to_rec709
from wlm.formats.reading import damaged, open_file
from wlm.formats.zstd import decompress, inflate

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
"""Formats that can be written, with their Vulkan numbers: 16 or 32 bits per channel, RGB9E5, or blocks of 16 bytes."""

_OTHERS = {"none of Vulkan's, as of Basis Universal": 0, "8-bit RGB": 23, "8-bit RGBA": 37, "8-bit sRGB with alpha": 43}
MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"
VOLUME_HEAD = 32
"""Bytes at the beginning of a file that tell whether it is a volume."""
# Identifier; format, bytes of a channel, width, height, depth, layers, faces, levels, supercompression; offset and
# length of the descriptor, of the key/value data and of the supercompression data.
_HEADER = struct.Struct("<12s 9I 4I 2Q")
_LEVEL = struct.Struct("<3Q")  # a level's offset, length and length without supercompression
_RGBSDA, _BC6H, _ASTC = 1, 133, 162  # colour models
_CHANNEL_IDS = (0, 1, 2, 15)  # red, green, blue, alpha
_VERSION, _BT709, _LINEAR = 2, 1, 1
_FLOAT, _SIGNED, _EXPONENT = 0x80, 0x40, 0x20  # a sample's qualifiers
_SHARED = "E5B9G9R9_UFLOAT_PACK32"
# The mantissa of 1 at the middle exponent, the middle exponent and the largest exponent (section 5.21).
_SHARED_UNITY, _SHARED_MIDDLE, _SHARED_MOST = 8448, 15, 31

# The header and the first entry of the level index, which describes the largest level.
_READ_HEADER = struct.Struct(_HEADER.format + " 3Q")
_PAIRS_BYTES = 1 << 20  # limit of the key/value data
# The primaries of Khronos Data Format 1.3; 0 is unspecified.
_PRIMARIES = {0: REC709, 1: REC709, 4: REC2020, 5: CIE_XYZ, 6: ACES_AP0, 7: ACES_AP1, 10: P3_D65, 11: ADOBE_RGB}
_DESCRIPTOR_BYTES = 20  # the descriptor up to its transfer function
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
_NONE, _ZSTD, _ZLIB = 0, 2, 3


def write_ktx2(
    path: str | os.PathLike[str], data: bytes, width: int, height: int, fmt: str, depth: int = 0, mips: int = 0
) -> int:
    """Writes texels or blocks as a KTX2 file, atomically.

    Args:
        path: The file to write; its folder must exist.
        data: Rows from the top: texels of 16- or 32-bit channels, little-endian, or ceil(width / 4) * ceil(height / 4)
            blocks of 16 bytes; for RGB9E5 one word of 32 bits per texel.
        width, height: Size in texels, 1 to 16384.
        fmt: Texel format, a key of `VK_FORMATS`.
        depth: Slices of a 3D texture of texels, 1 to 2048, each with its rows in `data`; 0: a 2D texture.
        mips: Number of mip levels after the full-size one, each of half the size rounded down; they follow in `data`.

    Returns:
        The number of bytes written.
    """
    if fmt not in VK_FORMATS:
        raise ValueError(f"fmt: expected one of {', '.join(VK_FORMATS)}, got {fmt}")
    bits = channel_bits(fmt)
    if not 0 <= depth <= MOST_SLICES or (depth and not bits):
        raise ValueError(f"depth: expected 0 to {MOST_SLICES}, and 0 for a format of blocks, got {depth} for {fmt}")
    sizes = texels.mip_bytes(fmt, width, height, mips, 0 if depth else None)
    sizes = [size * max(depth, 1) for size in sizes]
    if len(data) != sum(sizes):
        raise ValueError(f"data: expected {sum(sizes)} bytes, got {len(data)}")
    descriptor = _descriptor(fmt)
    # Sorted by key; r, d and i stand for right, down and inwards.
    pairs = _pair("KTXorientation", "rdi" if depth else "rd") + _pair("KTXwriter", "wlm")
    begin = _HEADER.size + _LEVEL.size * len(sizes)
    end = begin + len(descriptor) + len(pairs)
    # A level starts at a multiple of both 4 and the bytes of a texel or block; the smallest level comes first.
    step = math.lcm(4, format_bytes(fmt, 1, 1))
    index, pieces, place = [], [], end
    for level in reversed(range(len(sizes))):
        first = sum(sizes[:level])
        gap = bytes(-place % step)
        index.insert(0, _LEVEL.pack(place + len(gap), sizes[level], sizes[level]))
        pieces += [gap, data[first : first + sizes[level]]]
        place += len(gap) + sizes[level]
    header = _HEADER.pack(
        MAGIC,
        VK_FORMATS[fmt],
        4 if fmt == _SHARED else bits[0] // 8 if bits else 1,
        *(width, height, depth, 0, 1, 1 + mips, 0),
        *(begin, len(descriptor), begin + len(descriptor), len(pairs), 0, 0),
    )
    return atomic_write(path, [header, *index, descriptor, pairs, *pieces])


def _pair(key: str, value: str) -> bytes:
    text = f"{key}\0{value}\0".encode()
    return struct.pack("<I", len(text)) + text + bytes(-len(text) % 4)


def _descriptor(fmt: str) -> bytes:
    """Returns the data format descriptor: its total length and one basic descriptor block."""
    if fmt == _SHARED:
        # The exponent is listed once for each channel.
        shared = []
        for i, channel in enumerate(_CHANNEL_IDS[:3]):
            shared.append(struct.pack("<H2B4x2I", 9 * i, 8, channel, 0, _SHARED_UNITY))
            shared.append(struct.pack("<H2B4x2I", 27, 4, channel | _EXPONENT, _SHARED_MIDDLE, _SHARED_MOST))
        return _basic_block(_RGBSDA, 0, 4, shared)
    if sizes := channel_bits(fmt):
        model, side = _RGBSDA, 0
        samples = [
            (bits * i, bits, channel) for i, (bits, channel) in enumerate(zip(sizes, _CHANNEL_IDS, strict=False))
        ]
    else:
        model, side = (_BC6H if fmt.startswith("BC6H") else _ASTC), 3  # sides are stored less one
        samples = [(0, 8 * format_bytes(fmt, 1, 1), 0)]
    if fmt.endswith(("_UNORM", "_UINT")):  # the codes of 0 and of 1
        unity = 0xFFFF if fmt.endswith("_UNORM") else 1
        qualifiers, lowest, highest = 0, struct.pack("<I", 0), struct.pack("<I", unity)
    else:  # the codes of -1 or 0 and of 1, as 32-bit floats
        unsigned = "UFLOAT" in fmt
        qualifiers = _FLOAT if unsigned else _FLOAT | _SIGNED
        lowest, highest = struct.pack("<f", 0.0 if unsigned else -1.0), struct.pack("<f", 1.0)
    packed = [
        struct.pack("<H2B4x", offset, bits - 1, channel | qualifiers) + lowest + highest
        for offset, bits, channel in samples
    ]
    return _basic_block(model, side, format_bytes(fmt, 1, 1), packed)


def _basic_block(model: int, side: int, texel_bytes: int, samples: list[bytes]) -> bytes:
    size = 24 + 16 * len(samples)
    # Vendor and type; version and size; model, primaries, transfer and flags; block sides; bytes of a plane.
    head = (0, _VERSION, size, model, _BT709, _LINEAR, 0, side, side, 0, 0, texel_bytes)
    block = struct.pack("<I 2H 4B 4B B7x", *head) + b"".join(samples)
    return struct.pack("<I", 4 + size) + block


def read_ktx2(path: str | os.PathLike[str], notes: list[str] | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Reads the largest mip of a KTX2 texture of light, plain or compressed by zstd or zlib; returns the pixels,
    float32 [H, W, 3 or 4], and the channel names.

    The first row of the result is the top one, whatever `KTXorientation` states. The alpha of ASTC is ignored. Other
    primaries are converted to Rec. 709, which adds a line to `notes`.
    """
    pixels, layout, right, down = _read(path, False, [] if notes is None else notes)
    return np.ascontiguousarray(pixels[0, :: 1 if down else -1, :: 1 if right else -1]), layout.names


def is_volume(head: bytes) -> bool:
    """Whether the first `VOLUME_HEAD` bytes of a file are those of a KTX2 texture with several slices in depth."""
    return head.startswith(MAGIC) and int.from_bytes(head[28:VOLUME_HEAD], "little") > 1


def read_ktx2_volume(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads the largest mip of a 3D texture of light in its stored order, whatever `KTXorientation` states. Returns the
    texels, float32 [D, H, W, 3]; alpha is left out."""
    return _read(path, True, [])[0][..., :3]


def _read(path: str | os.PathLike[str], volume: bool, notes: list[str]) -> tuple[np.ndarray, Layout, bool, bool]:
    """Returns the texels [D, H, W, C] as stored, their layout, and whether columns go right and rows go down."""
    with open_file(path, "the KTX2 file") as file:
        held = os.fstat(file.fileno()).st_size
        fields = _READ_HEADER.unpack(texels.read_head(path, file, "KTX2", MAGIC, _READ_HEADER.size))
        number, _, width, height, depth, layers, faces, _, scheme = fields[1:10]
        descriptor, pairs = fields[10:12], fields[12:14]
        start, stored, size = fields[16:19]
        name, layout = texels.layout_of(path, "vkFormat", number, _LAYOUTS, VK_FORMATS | _OTHERS, _EXPECTED)
        check_fields(
            path,
            ("pixelHeight", height, height > 0, "at least 1 (2D)"),
            ("pixelDepth", depth, volume or depth <= 1, "0 (no volume)"),
            ("layerCount", layers, layers <= 1, "0 (no array)"),
            ("faceCount", faces, faces == 1, "1 (no cube)"),
            ("supercompressionScheme", scheme, scheme in (_NONE, _ZSTD, _ZLIB), "none (0), zstd (2) or zlib (3)"),
        )
        slices = max(depth, 1)
        if slices > 1 and height % layout.block[1]:
            raise WlmError(f"{path}: pixelHeight: expected a multiple of {layout.block[1]} in a volume, found {height}")
        texels.check_picture(path, held, width, height, layout.unpacked * slices)
        expected, most = layout.bytes_of(width, height * slices), 2 * layout.bytes_of(width, height * slices) + 1024
        words = f"{expected} for {width} x {height} texels of {name}"
        check_fields(
            path,
            ("byteLength of level 0", stored, scheme != _NONE or stored == expected, words),
            ("uncompressedByteLength of level 0", size, scheme == _NONE or size == expected, words),
            ("byteLength of level 0", stored, stored <= most, f"at most {most}"),  # no compressor expands data further
        )
        part = "the data format descriptor"
        head = read_part(path, file, descriptor[0], min(descriptor[1], _DESCRIPTOR_BYTES), part)
        primaries = _primaries(path, head)
        words = read_part(path, file, pairs[0], min(pairs[1], _PAIRS_BYTES), "the key/value data")
        right, down = _orientation(path, words, layout.channels, volume)
        data = read_part(path, file, start, stored, "level 0")
    if scheme != _NONE:
        unpack, kind = (decompress, "zstd") if scheme == _ZSTD else (inflate, "zlib")
        with damaged(f"{path}: level 0: cannot unpack", ValueError):
            data = unpack(data, expected, kind)
    pixels = texels.decode_texels(path, layout, data, width, height * slices)
    to_rec709(pixels, primaries, f"{path}: the data format descriptor", notes)
    return pixels.reshape(slices, height, width, -1), layout, right, down


def _primaries(path: str | os.PathLike[str], data: bytes) -> tuple[float, ...]:
    """Returns the chromaticities that the data format descriptor states, and checks that its transfer function is
    linear."""
    if len(data) < _DESCRIPTOR_BYTES:
        raise WlmError(
            f"{path}: the data format descriptor: expected at least {_DESCRIPTOR_BYTES} bytes, found {len(data)}"
        )
    transfer = data[14]
    if transfer not in _TRANSFERS:
        raise WlmError(
            f"{path}: the data format descriptor: expected linear light (transfer function 1), found {transfer}"
        )
    if data[13] not in _PRIMARIES:
        known = ", ".join(map(str, _PRIMARIES))
        raise WlmError(f"{path}: the data format descriptor: expected colour primaries {known}, found {data[13]}")
    return _PRIMARIES[data[13]]


def _orientation(path: str | os.PathLike[str], data: bytes, channels: int, volume: bool) -> tuple[bool, bool]:
    """Returns whether columns go right and whether rows go down, and checks the order of the channels."""
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
    orientation = orientation[:2] if volume else orientation
    if orientation not in (b"rd", b"ru", b"ld", b"lu"):
        raise WlmError(f"{path}: KTXorientation: expected rd, ru, ld or lu, found {orientation[:20]!r}")
    if swizzle[:channels] != b"rgba"[:channels]:
        raise WlmError(f"{path}: KTXswizzle: expected rgba, found {swizzle[:20]!r}")
    return orientation[:1] == b"r", orientation[1:] == b"d"
