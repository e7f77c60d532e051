"""Engines' texture files taken apart and made by their specifications' offsets, with no code of ours."""

import struct
from dataclasses import dataclass
from pathlib import Path

from wlm.formats.dds import DXGI_FORMATS


@dataclass(frozen=True)
class Texture:
    """The size in texels, the format's name, and the texels or blocks."""

    width: int
    height: int
    fmt: str
    data: bytes


def open_dds(path: Path) -> Texture:
    """A DDS file with a DX10 header."""
    content = path.read_bytes()
    height, width = struct.unpack_from("<2I", content, 12)
    (number,) = struct.unpack_from("<I", content, 128)
    return Texture(width, height, _name(DXGI_FORMATS, number), content[148:])


def _name(formats: dict[str, int], number: int) -> str:
    return {value: name for name, value in formats.items()}[number]


def make_dds(number: int, width: int, height: int, data: bytes, code: bytes = b"DX10", mips: int = 1) -> bytes:
    """A DDS file, with the DX10 header where the code says so."""
    head = struct.pack("<4s 7I 44x", b"DDS ", 124, 0x21007, height, width, 0, 0, mips)
    head += struct.pack("<2I 4s 20x 5I", 32, 4, code, 0x401008 if mips > 1 else 0x1000, 0, 0, 0, 0)
    return head + (struct.pack("<5I", number, 3, 0, 1, 0) if code == b"DX10" else b"") + data
