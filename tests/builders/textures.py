"""Engines' texture files taken apart by their specifications' offsets, with no code of the writers'."""

import struct
from dataclasses import dataclass
from pathlib import Path

from wlm.formats.dds import DXGI_FORMATS
from wlm.formats.ktx2 import VK_FORMATS


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


def open_ktx2(path: Path) -> Texture:
    """A KTX2 file of one level."""
    content = path.read_bytes()
    number, _, width, height = struct.unpack_from("<4I", content, 12)
    start, length = struct.unpack_from("<2Q", content, 80)
    assert start + length == len(content)
    return Texture(width, height, _name(VK_FORMATS, number), content[start:])


def _name(formats: dict[str, int], number: int) -> str:
    return {value: name for name, value in formats.items()}[number]
