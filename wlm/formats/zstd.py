"""Zstandard frames of a known size."""

import zstandard

_LEVEL = 19


def compress(*pieces: bytes) -> bytes:
    """Packs pieces of data, one after another, into one frame that states its size.

    Each piece has blocks of its own, so that zstd models pieces with different statistics separately.
    """
    packer = zstandard.ZstdCompressor(level=_LEVEL).compressobj(size=sum(map(len, pieces)))
    frame = b""
    for piece in pieces:
        frame += packer.compress(piece) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    return frame + packer.flush()


def decompress(frame: bytes, size: int, name: str) -> bytes:
    """Unpacks a frame and never allocates more than its expected size.

    Args:
        frame: One frame with nothing behind it.
        size: Number of bytes that it must unpack to.
        name: What the frame is, for messages.

    Raises:
        ValueError: The frame is damaged or has another size.
    """
    try:
        stated = zstandard.frame_content_size(frame)
        if stated != size:
            raise ValueError(f"{name}: expected {size} bytes, found a frame of {stated}")
        reader = zstandard.ZstdDecompressor().decompressobj(read_across_frames=False)
        unpacked = reader.decompress(frame)
    except zstandard.ZstdError as error:
        raise ValueError(f"{name}: {error}") from error
    if len(unpacked) != size or not reader.eof or reader.unused_data:
        raise ValueError(f"{name}: expected one whole frame of {size} bytes")
    return unpacked
