"""Decompression of zlib streams of known size."""

import zlib


def inflate(data: bytes, size: int, where: str, expected: str) -> bytes:
    """Decompresses one zlib stream and never allocates more than one byte beyond its expected size.

    `where` names the stream in messages, and `expected` describes its right content, such as "90 bytes".

    Raises:
        ValueError: The stream is damaged or has another size.
    """
    reader = zlib.decompressobj()
    try:
        unpacked = reader.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"{where}: {error}") from error
    if len(unpacked) != size or not reader.eof or reader.unused_data:
        raise ValueError(f"{where}: expected {expected}, found more or fewer bytes")
    return unpacked
