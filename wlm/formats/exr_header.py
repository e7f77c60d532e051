"""Headers of OpenEXR files, read and checked before the OpenEXR library opens the file.

The library unpacks deep data at any size, and its time for a header grows with the square of the number of attributes
and channels. Every reader of EXR files comes through `check_header`. The layout is that of the document "OpenEXR File
Layout" (openexr.com).
"""

import os
import struct
from dataclasses import dataclass

from wlm.errors import WlmError
from wlm.formats.limits import PICTURE_BYTES, PICTURE_GROWTH, check_growth, check_sides
from wlm.formats.reading import damaged, open_file

MAGIC = b"\x76\x2f\x31\x01"
"""The first bytes of an EXR file."""

_HEADER_BYTES = 8 << 20  # a preview picture or a colour profile may take some
_FIELDS = 8192  # attributes and channels of all parts
_DEEP, _MULTIPART = 0x800, 0x1000  # flags beside the version
_SAMPLE_BYTES = (4, 2, 4)  # of uint, half and float, by the type's number


@dataclass(frozen=True)
class ExrHeader:
    """The header of a part: width and height of the display window, the names of the channels in the order of the file,
    and type and value of each attribute as stored."""

    size: tuple[int, int]
    channels: tuple[str, ...]
    attributes: dict[str, tuple[str, bytes]]

    def full_names(self, several: bool) -> tuple[str, ...]:
        """Returns the names of the channels, which begin with the name of the part if the file has `several`."""
        part = self.attributes.get("name", ("", b""))[1].decode("utf-8", "replace")
        prefix = f"{part}." if several else ""
        return tuple(name if name.startswith(prefix) else prefix + name for name in self.channels)


def check_header(path: str | os.PathLike[str]) -> list[ExrHeader]:
    """Reads the headers of all parts of an EXR file, and checks what its pixels would take."""
    with open_file(path, "the EXR file") as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(min(size, _HEADER_BYTES))
    if not data.startswith(MAGIC):
        raise WlmError(f"{path}: expected an EXR file, found other content")
    with damaged(f"{path}: the EXR file is cut short or damaged", ValueError, LookupError, struct.error):
        (flags,) = struct.unpack_from("<I", data, len(MAGIC))
        parts, total, at, fields = [], 0, 2 * len(MAGIC), 0
        while True:
            attributes, at = _attributes(data, at, _FIELDS - fields)
            if not attributes and parts:  # an empty header ends the list of parts
                break
            if flags & _DEEP or attributes.get("type", ("", b""))[1].startswith(b"deep"):
                raise WlmError(f"{path}: expected a flat EXR picture, found deep data")
            part, each = _part(path, attributes, _FIELDS - fields)
            fields += len(attributes) + len(part.channels)
            total += each
            parts.append(part)
            if not flags & _MULTIPART:
                break
    check_growth(str(path), size, total, PICTURE_GROWTH, PICTURE_BYTES)
    return parts


def _attributes(data: bytes, at: int, most: int) -> tuple[dict[str, tuple[str, bytes]], int]:
    attributes: dict[str, tuple[str, bytes]] = {}
    while end := data.index(0, at) - at:
        name = data[at : at + end].decode("utf-8", "replace")
        at += end + 1
        kind, at = data[at : data.index(0, at)].decode("utf-8", "replace"), data.index(0, at) + 1
        (length,) = struct.unpack_from("<i", data, at)
        at += 4
        if not 0 <= length <= len(data) - at:
            raise ValueError(f"attribute {name[:60]}: expected at most {len(data) - at} bytes, found {length}")
        if name in attributes or len(attributes) >= most:
            fault = "twice the attribute" if name in attributes else "also"
            raise ValueError(f"expected at most {_FIELDS} attributes of different names, found {fault} {name[:60]}")
        attributes[name] = kind, data[at : at + length]
        at += length
    return attributes, at + 1


def _part(path: str | os.PathLike[str], attributes: dict[str, tuple[str, bytes]], most: int) -> tuple[ExrHeader, int]:
    """Returns the header of a part, and the bytes of its pixels over the larger of its windows."""
    texels = 0
    for name in ("dataWindow", "displayWindow"):
        left, top, right, bottom = struct.unpack("<4i", attributes.get(name, attributes["dataWindow"])[1])
        width, height = right - left + 1, bottom - top + 1
        if min(width, height) < 1:
            raise ValueError(f"{name}: expected at least one pixel, found {width} x {height}")
        check_sides(str(path), width, height)
        texels = max(texels, width * height)
    listed, at, names, each = attributes["channels"][1], 0, [], 0
    while end := listed.index(0, at) - at:
        names.append(listed[at : at + end].decode("utf-8", "replace"))
        (kind,) = struct.unpack_from("<i", listed, at + end + 1)
        each += _SAMPLE_BYTES[kind] if 0 <= kind < len(_SAMPLE_BYTES) else max(_SAMPLE_BYTES)
        at += end + 17  # the type, a flag with three bytes of padding, and the sampling along x and y
        if len(names) > most:
            raise ValueError(f"expected at most {_FIELDS} attributes and channels, found more")
    return ExrHeader((width, height), tuple(names), attributes), texels * each
