"""Headers of EXR files, byte by byte, for what the OpenEXR library does not write."""

import struct
from collections.abc import Sequence


def exr_header(
    *attributes: tuple[str, str, bytes],
    names: Sequence[str] = ("B", "G", "R"),
    window: tuple[int, int, int, int] = (0, 0, 15, 15),
    kind: int = 1,
    sampling: int = 1,
    compression: int = 3,
    flags: int = 0,
) -> bytes:
    """Returns the magic number, the version with its flags, and a header of one part.

    Args:
        attributes: Name, type and value of further attributes.
        names: Names of the channels.
        window: The data window and display window: left, top, right, bottom.
        kind: Type of the samples: 0 uint, 1 half, 2 float.
        sampling: Distance between the samples of every channel, along x and y.
        compression: Number of the compression; 3 is ZIP, 13 zstd.
        flags: Flags of the version: 0x200 tiles, 0x800 deep data, 0x1000 several parts.
    """
    sampled = struct.pack("<iB3xii", kind, 0, sampling, sampling)
    channels = b"".join(name.encode() + b"\0" + sampled for name in names) + b"\0"
    box = struct.pack("<4i", *window)
    fields = [
        ("channels", "chlist", channels),
        ("compression", "compression", bytes([compression])),
        ("dataWindow", "box2i", box),
        ("displayWindow", "box2i", box),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", bytes(8)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
        *attributes,
    ]
    stored = (f"{name}\0{kind}\0".encode() + struct.pack("<I", len(value)) + value for name, kind, value in fields)
    return b"\x76\x2f\x31\x01" + struct.pack("<I", 2 | flags) + b"".join(stored) + b"\0"
