"""Engines' texture files made by their specifications' offsets, with no code of ours."""

import struct
import zlib

import imagecodecs


def make_ktx2(
    number: int, width: int, height: int, levels: list[bytes], scheme: int = 0, pairs: dict[str, str] | None = None
) -> bytes:
    """A KTX2 file of levels, the largest first, as they are before supercompression."""
    pack = {0: bytes, 2: imagecodecs.zstd_encode, 3: zlib.compress}[scheme]
    words = b""
    for key, value in (pairs or {}).items():
        text = f"{key}\0{value}\0".encode()
        words += struct.pack("<I", len(text)) + text + bytes(-len(text) % 4)
    # The descriptor's first block alone: model 1 (RGBSDA), primaries 1 (BT.709), transfer 1 (linear).
    descriptor = struct.pack("<I 2I 4B 12x", 28, 0, 24 << 16 | 2, 1, 1, 1, 0)
    start = 80 + 24 * len(levels)
    head = struct.pack("<9I", number, 1, width, height, 0, 0, 1, len(levels), scheme)
    head += struct.pack("<4I 2Q", start, len(descriptor), start + len(descriptor), len(words), 0, 0)
    at, index, body = start + len(descriptor) + len(words), [], b""
    for level in reversed(levels):
        stored = pack(level)
        index.insert(0, struct.pack("<3Q", at + len(body), len(stored), len(level)))
        body += stored
    return b"\xabKTX 20\xbb\r\n\x1a\n" + head + b"".join(index) + descriptor + words + body


def make_dds(number: int, width: int, height: int, data: bytes, code: bytes = b"DX10", mips: int = 1) -> bytes:
    """A DDS file, with the DX10 header where the code says so."""
    head = struct.pack("<4s 7I 44x", b"DDS ", 124, 0x21007, height, width, 0, 0, mips)
    head += struct.pack("<2I 4s 20x 5I", 32, 4, code, 0x401008 if mips > 1 else 0x1000, 0, 0, 0, 0)
    return head + (struct.pack("<5I", number, 3, 0, 1, 0) if code == b"DX10" else b"") + data
