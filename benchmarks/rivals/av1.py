"""AV1 streams of pictures of three planes in 10 bits with full chroma: encoded by libaom, decoded as the standard says.

A stream is in AV1's low-overhead format, a temporal unit for each picture, every unit with its delimiter (AV1 Bitstream
and Decoding Process Specification, sections 5 and 7.5). libavif reads and writes AVIF alone, whose boxes hold the time
of writing: they are taken away from what it wrote, and made anew around what it reads. The colour matrix is the
identity, so that samples come out as the standard defines them, to the bit, whichever decoder there is.

A decoder takes memory as the stream asks. So the stream is walked before it is decoded: it has one sequence header,
which may repeat, of the expected size and depth, and its units are counted.
"""

import struct
from collections.abc import Iterator

import numpy as np

from wlm.formats.hdr_blocks import need
from wlm.workers import cores

BITS = 10
"""Of a sample."""

_IDENTITY = 0  # matrix coefficients, ITU-T H.273: green, blue and red are Y, U and V
_FROM_PLANES, _TO_PLANES = [2, 0, 1], [1, 2, 0]
_PROFILE = 1  # of AV1, "high": 4:4:4 in 8 or 10 bits

_SEQUENCE_HEADER, _DELIMITER = 1, 2
# Frame headers, tiles, metadata, whole frames, repeated headers, padding; not lists of large tiles.
_KNOWN = {_SEQUENCE_HEADER, _DELIMITER, 3, 4, 5, 6, 7, 15}


def encode_av1_stream(pictures: np.ndarray, quality: int, speed: int, extra: str) -> bytes:
    """Encodes pictures as one stream, the same on any machine with the same version of the encoder.

    Args:
        pictures: uint16 [T, H, W, 3], planes Y, U and V, below 1024.
        quality: 0 to 100; of 100 the stream has the pictures exactly.
        speed: libaom's, 0 (slowest, best) to 10.
        extra: The extra that a message names.

    Raises:
        WlmError: The encoder is missing.
    """
    codecs = need("imagecodecs", extra)
    rgb = np.ascontiguousarray(pictures[..., _FROM_PLANES])
    data = codecs.avif_encode(
        rgb if len(rgb) > 1 else rgb[0],  # one frame is a still picture
        level=quality,
        speed=speed,
        bitspersample=BITS,
        pixelformat="yuv444",
        matrix=_IDENTITY,
        codec="aom",
        numthreads=max(2, cores()),  # the stream is the same for any number but 1
    )
    at = 0
    while data[at + 4 : at + 8] != b"mdat":
        at += int.from_bytes(data[at : at + 4], "big")
    return data[at + 8 : at + int.from_bytes(data[at : at + 4], "big")]


def decode_av1(stream: bytes, count: int, height: int, width: int, extra: str) -> np.ndarray:
    """Decodes a stream, once it is known how large it becomes.

    Args:
        stream: From `encode_av1_stream`, or from a file.
        count, height, width: Of its pictures.
        extra: The extra that a message names.

    Returns:
        uint16 [count, H, W, 3], below 1024.

    Raises:
        ValueError: The stream is damaged, or not of these pictures.
        WlmError: The decoder is missing.
    """
    codecs = need("imagecodecs", extra)
    units, header = _units(stream)
    if len(units) != count:
        raise ValueError(f"expected {count} pictures, found {len(units)}")
    _check_sequence(header, height, width)
    try:
        rgb = codecs.avif_decode(_container(units, header, height, width))
    except codecs.AvifError as error:
        raise ValueError(f"AV1: {error}") from error
    if rgb.dtype != np.uint16 or rgb.size != count * height * width * 3 or int(rgb.max()) >> BITS:
        raise ValueError(f"expected pictures of three planes in {BITS} bits, found others")
    return np.ascontiguousarray(rgb.reshape(count, height, width, 3)[..., _TO_PLANES])


def _blocks(stream: bytes) -> Iterator[tuple[int, int, bytes]]:
    """The OBUs of a stream: type, where it begins, and payload."""
    at = 0
    while at < len(stream):
        start, head = at, stream[at]
        # The type lies between a bit that is 0 and the flags of an extension and of a size, and the last bit is 0.
        if head & 0b10000111 != 0b010:
            raise ValueError("AV1: expected blocks with their sizes and without layers, found others")
        size, shift, more = 0, 0, True
        at += 1
        while more:
            if at == len(stream) or shift > 28:
                raise ValueError("AV1: the stream is cut short")
            size |= (stream[at] & 127) << shift
            more, shift, at = bool(stream[at] & 128), shift + 7, at + 1
        if size > len(stream) - at:
            raise ValueError("AV1: the stream is cut short")
        yield head >> 3 & 15, start, stream[at : at + size]
        at += size


def _units(stream: bytes) -> tuple[list[bytes], bytes]:
    """The units of a stream, and the payload of its sequence header."""
    starts, header = [], None
    for kind, start, payload in _blocks(stream):
        if kind not in _KNOWN or (not starts and kind != _DELIMITER):
            raise ValueError(f"AV1: expected units of frames, found a block of type {kind}")
        if kind == _DELIMITER:
            starts.append(start)
        elif kind == _SEQUENCE_HEADER:
            if header not in (None, payload):
                raise ValueError("AV1: expected one sequence header, found two that differ")
            header = payload
        elif header is None:
            raise ValueError("AV1: expected a sequence header first, found none")
    if header is None:
        raise ValueError("AV1: expected a sequence header, found none")
    return [stream[a:b] for a, b in zip(starts, [*starts[1:], len(stream)], strict=True)], header


def _check_sequence(header: bytes, height: int, width: int) -> None:
    """Checks what a sequence header says of the pictures (section 5.5.1 of the specification)."""
    bits, at = "".join(f"{byte:08b}" for byte in header), 0

    def take(count: int) -> int:
        nonlocal at
        at += count
        if at > len(bits):
            raise ValueError("AV1: the sequence header is cut short")
        return int(bits[at - count : at] or "0", 2)

    profile, _, still = take(3), take(1), take(1)
    if still:
        take(5)
    else:
        # No times, no delay of the display, one operating point of any level.
        timing, delay, points, _, level = take(1), take(1), take(5), take(12), take(5)
        if timing or delay or points:
            raise ValueError("AV1: expected a sequence without times and layers, found others")
        take(1 if level > 7 else 0)
    lengths = take(4) + 1, take(4) + 1
    size = take(lengths[0]) + 1, take(lengths[1]) + 1
    # A frame may be of another size than the sequence's, in as many bits.
    shortest = (width - 1).bit_length() or 1, (height - 1).bit_length() or 1
    if profile != _PROFILE or size != (width, height) or lengths[0] > shortest[0] or lengths[1] > shortest[1]:
        raise ValueError(
            f"AV1: expected pictures of {width}x{height} in profile {_PROFILE}, found {size[0]}x{size[1]} in {profile}"
        )


def _container(units: list[bytes], header: bytes, height: int, width: int) -> bytes:
    """The smallest image sequence that libavif reads (AV1 Image File Format, and ISO/IEC 14496-12)."""

    def box(name: bytes, *parts: bytes) -> bytes:
        content = b"".join(parts)
        return struct.pack(">I4s", 8 + len(content), name) + content

    def full(name: bytes, *parts: bytes) -> bytes:
        return box(name, bytes(4), *parts)

    count, square = len(units), struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    # Profile 1 and level 9 (the highest without a tier); more than 8 bits, full chroma.
    config = box(b"av1C", bytes([0x81, _PROFILE << 5 | 9, 0x40, 0x00]))
    colour = box(b"colr", b"nclx", struct.pack(">3HB", 2, 2, _IDENTITY, 0x80))  # all values of 10 bits are used
    entry = struct.pack(">6xH16x2H2I4xH32xHh", 1, width, height, 72 << 16, 72 << 16, 1, 24, -1)
    first = box(b"ftyp", b"avis", bytes(4), b"avismsf1iso8miaf")

    def movie(offset: int) -> bytes:
        table = box(
            b"stbl",
            full(b"stsd", struct.pack(">I", 1), box(b"av01", entry, config, colour)),
            full(b"stts", struct.pack(">3I", 1, count, 1)),
            full(b"stsc", struct.pack(">4I", 1, 1, count, 1)),
            full(b"stsz", struct.pack(f">2I{count}I", 0, count, *map(len, units))),
            full(b"stco", struct.pack(">2I", 1, offset)),
        )
        media = box(
            b"mdia",
            full(b"mdhd", struct.pack(">4I2H", 0, 0, 1, count, 0x55C4, 0)),
            full(b"hdlr", struct.pack(">I4s13x", 0, b"pict")),
            box(b"minf", full(b"vmhd", bytes(8)), table),
        )
        tall = struct.pack(">5I16x", 0, 0, 1, 0, count), square, struct.pack(">2I", width << 16, height << 16)
        track = box(b"trak", box(b"tkhd", b"\0\0\0\1", *tall), media)
        head = full(b"mvhd", struct.pack(">4IIH10x", 0, 0, 1, count, 1 << 16, 1 << 8), square, bytes(24), b"\0\0\0\2")
        return box(b"moov", head, track)

    begin = first + movie(0)
    return first + movie(len(begin) + 8) + box(b"mdat", *units)
