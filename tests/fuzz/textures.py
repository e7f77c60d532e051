"""Changes inside pictures of light: headers, run-length codes, and what lies under zstd and zlib."""

import struct
import zlib
from random import Random

import imagecodecs

from .mutate import corrupt, vary_numbers, vary_text

_LINES = """\
FORMAT=32-bit_rle_xyze
EXPOSURE=1e-300
EXPOSURE=nan
EXPOSURE=0x10
COLORCORR=1 2
GAMMA=1
-Y 1 +X 1
-Y 65536 +X 4096
-Y 16384 +X 16384
+X 30 -Y 40
-Y 00000000000012 +X 10""".split("\n")
_SIZES = (0, 1, 2, 7, 8, 9, 12, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 99999, 999999999)


def vary_radiance(draw: Random, data: bytes) -> bytes:
    """Changes the header's lines, the size, or the codes of rows."""
    blank = data.index(b"\n\n")
    start = data.index(b"\n", blank + 2)
    head, size, body = data[:blank], data[blank + 2 : start], data[start + 1 :]
    kind = draw.randrange(4)
    if kind == 0:
        head = vary_text(draw, head.decode(), _LINES)
    elif kind == 1:
        words = size.split()
        words[draw.choice((1, 1, 3, 3, 0, 2))] = str(draw.choice(_SIZES)).encode()
        size = b" ".join(words)
    else:
        # Counts of the newer code and its marker, repeats of the older one.
        result = bytearray(body)
        for _ in range(draw.choice((1, 1, 2, 4))):
            at = draw.randrange(len(result))
            piece = draw.choice((bytes([draw.choice((0, 1, 2, 127, 128, 129, 255))]), b"\1\1\1\xff", b"\2\2\0\x0a"))
            result[at : at + len(piece)] = piece
        body = corrupt(draw, bytes(result)) if kind == 3 else bytes(result)
    return head + b"\n\n" + size + b"\n" + body


_KTX2_WORDS = [(at, 4) for at in range(12, 64, 4)] + [(at, 8) for at in range(64, 104, 8)] + [(116, 4)]
_FORMATS = (0, 37, 90, 97, 106, 109, 122, 123, 143, 144, 145, 1000066000, 1000066013)
_SCHEMES = {0: bytes, 2: imagecodecs.zstd_encode, 3: zlib.compress}
_UNPACK = {0: bytes, 2: imagecodecs.zstd_decode, 3: zlib.decompress}


def vary_ktx2(draw: Random, data: bytes) -> bytes:
    """Changes words of the header, or the texels, which are packed again, some to another length than is stated."""
    kind = draw.randrange(4)
    if kind == 0:
        return vary_numbers(draw, data, _KTX2_WORDS)
    result = bytearray(data)
    if kind == 1:
        # Bytes of texels stay, so that sizes that fit them get further.
        struct.pack_into("<I", result, 12, draw.choice(_FORMATS))
        sides = draw.choice(((1, 120), (120, 1), (10, 12), (5, 24), (65536, 65536), (16384, 16384), (60, 2), (0, 0)))
        struct.pack_into("<2I", result, 20, *sides)
        return bytes(result)
    start, stored, size = struct.unpack_from("<3Q", data, 80)
    scheme = struct.unpack_from("<I", data, 44)[0]
    texels = corrupt(draw, _UNPACK[scheme](data[start : start + stored]))
    if kind == 2:
        texels = texels[:size].ljust(size, b"\xff")
    elif draw.random() < 0.3:
        texels = bytes(draw.choice((size, 1 << 20, 1 << 26)))
    scheme = draw.choice((scheme, *_SCHEMES))
    packed = _SCHEMES[scheme](texels)
    struct.pack_into("<I", result, 44, scheme)
    struct.pack_into("<2Q", result, 80, len(result), len(packed))
    if draw.random() < 0.2:
        struct.pack_into("<Q", result, 96, len(texels))
    return bytes(result) + packed


_DDS_WORDS = [(at, 4) for at in (4, 8, 12, 16, 20, 24, 28, 76, 80, 84, 88, 108, 112, 128, 132, 136, 140, 144)]
_DXGI = (2, 6, 10, 26, 67, 94, 95, 96, 98)


def vary_dds(draw: Random, data: bytes) -> bytes:
    """Changes words of the headers, the format, the size or the texels."""
    kind = draw.randrange(4)
    if kind == 0:
        return vary_numbers(draw, data, [place for place in _DDS_WORDS if sum(place) <= len(data)])
    result = bytearray(data)
    if kind == 1:
        struct.pack_into("<I", result, 128, draw.choice(_DXGI))
    if kind <= 2:
        sides = draw.choice(((1, 120), (120, 1), (10, 12), (3, 3), (65536, 65536), (16384, 16384), (65536, 1), (0, 0)))
        struct.pack_into("<2I", result, 12, *sides)
        return bytes(result)
    return data[:148] + corrupt(draw, data[148:])
