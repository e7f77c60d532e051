"""Zstandard frames and zlib streams of a known size, and parts of an artifact that are stored as Zstandard frames."""

import math
import zlib
from collections.abc import Mapping

import numpy as np
import zstandard

from wlm.errors import one_line
from wlm.formats.parts import Part, check_part

_LEVEL, _FAST_LEVEL = 19, 9
_FAST_BYTES = 4 << 20  # data above this size is packed at the faster level, in a tenth of the time
_FREE, _MOST = 1 << 26, 64
_MOST_AXES = 4

Shapes = dict[str, list[int]]
"""The shapes of the parts that are stored as frames, by name: a setting of the artifact."""


def compress(*pieces: bytes) -> bytes:
    """Compresses consecutive pieces of data into one Zstandard frame that states its size. Each piece has blocks of its
    own, so that zstd models pieces with different statistics separately."""
    size = sum(map(len, pieces))
    packer = zstandard.ZstdCompressor(level=_LEVEL if size <= _FAST_BYTES else _FAST_LEVEL).compressobj(size=size)
    frame = b""
    for piece in pieces:
        frame += packer.compress(piece) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    return frame + packer.flush()


def check_frame(frame: bytes, size: int, name: str) -> None:
    """Checks the size that a frame states, if it states one, without decompressing it; `name` is for messages. Raises a
    ValueError if the data are no frame, or one of another size."""
    try:
        stated = zstandard.frame_content_size(frame)
    except zstandard.ZstdError as error:
        raise ValueError(f"{name}: expected a zstd frame, found other data") from error
    if stated not in (size, -1):
        raise ValueError(f"{name}: expected a frame of {size} decompressed bytes, found {stated}")


def decompress(frame: bytes, size: int, name: str) -> bytes:
    """Decompresses data of exactly one frame to `size` bytes, and never allocates more; `name` is for messages. Raises
    a ValueError if the frame is damaged or has another size."""
    check_frame(frame, size, name)
    try:
        reader = zstandard.ZstdDecompressor()
        unpacked = reader.decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ValueError(f"{name}: {error}") from error
    if len(unpacked) != size:
        raise ValueError(f"{name}: expected a frame of {size} decompressed bytes, found {len(unpacked)}")
    return unpacked


def inflate(data: bytes, size: int, name: str) -> bytes:
    """Decompresses one zlib stream to `size` bytes, and allocates at most one byte more; `name` is for messages. Raises
    a ValueError if the stream is damaged or has another size."""
    reader = zlib.decompressobj()
    try:
        unpacked = reader.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"{name}: {error}") from error
    if len(unpacked) != size or not reader.eof or reader.unused_data:
        raise ValueError(f"{name}: expected {size} decompressed bytes, found more or fewer")
    return unpacked


def pack_parts(parts: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], Shapes]:
    """Compresses each part of an artifact, unless that would make it larger.

    Returns the parts, compressed ones as frames, uint8 [bytes], and the shapes of the compressed parts. A part that
    compresses so well that `unpack_parts` would refuse it stays uncompressed too.
    """
    result, shapes = dict(parts), {}
    for name, part in parts.items():
        frame = compress(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes())
        if len(frame) < part.nbytes <= _limit(len(frame)):
            result[name], shapes[name] = np.frombuffer(frame, np.uint8), list(part.shape)
    return result, shapes


def unpack_parts(tensors: Mapping[str, np.ndarray], shapes: Shapes, table: Mapping[str, Part]) -> dict[str, np.ndarray]:
    """Decompresses the parts that `pack_parts` compressed; `check_parts` still has to check their values. Raises a
    ValueError if a frame is damaged, a part is not in the table, or a shape needs more bytes than a frame can hold."""
    result = dict(tensors)
    for name, shape in shapes.items():
        if name not in table or name not in tensors:
            raise ValueError(f"setting parts: the file has no part {one_line(name, 60)}")
        frame = check_part(tensors, name, Part(np.uint8, (None,)))
        dtype = np.dtype(table[name].dtype).newbyteorder("<")
        size = math.prod(shape) * dtype.itemsize
        if len(shape) > _MOST_AXES or size > _limit(len(frame)):
            raise ValueError(f"part {name}: the shape {shape} is too large for {len(frame)} compressed bytes")
        data = decompress(frame.tobytes(), size, f"part {name}")
        result[name] = np.frombuffer(data, dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
    return result


def _limit(size: int) -> int:
    return _FREE + _MOST * size
