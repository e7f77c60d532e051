"""Decompression of zlib streams of known size."""

import zlib


def inflate(data: bytes, size: int, where: str, expected: str) -> bytes:
    """Decompresses a stream and never allocates more than one byte beyond the expected size.

    Args:
        data: One zlib stream, with nothing after it.
        size: Expected size, in bytes.
        where: Name of the stream for messages.
        expected: Description of the expected content for messages.

    Raises:
        ValueError: The stream is damaged or has another size.
    """
    reader = zlib.decompressobj()
    try:
        unpacked = reader.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"{where}: {error}") from error
    if len(unpacked) != size or not reader.eof or reader.unused_data:
        raise ValueError(f"{where}: expected {expected}")
    return unpacked
