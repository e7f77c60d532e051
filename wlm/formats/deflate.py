"""Reading zlib streams whose size is known."""

import zlib


def inflate(data: bytes, size: int, where: str, expected: str) -> bytes:
    """Unpacks a stream, and never more than a byte beyond what it must become.

    Args:
        data: One zlib stream, with nothing behind it.
        size: Bytes that it must become.
        where, expected: What it is and what it should be, for messages.

    Raises:
        ValueError: It is damaged, or becomes another number of bytes.
    """
    reader = zlib.decompressobj()
    try:
        unpacked = reader.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"{where}: {error}") from error
    if len(unpacked) != size or not reader.eof or reader.unused_data:
        raise ValueError(f"{where}: expected {expected}")
    return unpacked
