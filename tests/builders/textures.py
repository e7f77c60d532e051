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
