"""The bytes of a glTF file: a `.glb`'s chunks, and buffers inside it, in `data:` URIs or in files beside it."""

import base64
import binascii
import os
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

from wlm.errors import WlmError
from wlm.formats.limits import MESH_BYTES
from wlm.formats.reading import named_file, read_file

MAGIC = b"glTF"
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942

_URI_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")


def split_glb(path: str | os.PathLike[str], data: bytes) -> tuple[bytes, bytes | None]:
    """Gives the JSON and the binary chunk of a `.glb`."""
    if len(data) < 12:
        raise WlmError(f"{path}: the file is cut short: expected a header of 12 bytes, found {len(data)}")
    version, length = struct.unpack_from("<2I", data, 4)
    if version != 2:
        raise WlmError(f"{path}: expected version 2 of the .glb format, found {version}")
    if length > len(data):
        raise WlmError(f"{path}: the file is cut short: expected {length} bytes, found {len(data)}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<2I", data, at)
        if at + 8 + size > length:
            raise WlmError(f"{path}: a chunk at byte {at} of {size} bytes goes beyond the file's {length}")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if JSON_CHUNK not in chunks:
        raise WlmError(f"{path}: the .glb file has no JSON chunk")
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK)


def load_buffers(
    path: str | os.PathLike[str], buffers: Sequence[dict[str, Any]], binary: bytes | None, trust: bool
) -> tuple[bytes, ...]:
    """Gives the bytes of each buffer, at least as many as it states.

    Args:
        path: The document.
        buffers: Their entries in the tree.
        binary: The `.glb`'s binary chunk, if there is one.
        trust: Whether they may be files outside the document's folder.

    Raises:
        WlmError: One can't be read, is shorter, or is the file of an earlier one.
    """
    files: dict[Path, int] = {}
    return tuple(_load_buffer(path, number, buffer, binary, trust, files) for number, buffer in enumerate(buffers))


def _load_buffer(
    path: str | os.PathLike[str],
    number: int,
    buffer: dict[str, Any],
    binary: bytes | None,
    trust: bool,
    files: dict[Path, int],
) -> bytes:
    uri, length = buffer.get("uri"), buffer["byteLength"]
    where = f"{path}: buffers[{number}]"
    if uri is None:
        if number or binary is None:
            raise WlmError(f"{where}: has no uri, and the file no binary chunk for it")
        data = binary
    elif uri.startswith("data:"):
        head, comma, body = uri.partition(",")
        if not comma:
            raise WlmError(f"{where}.uri: expected data: with a comma before its content")
        data = unquote_to_bytes(body)
        if head.endswith(";base64"):
            try:
                data = base64.b64decode(data, validate=True)
            except binascii.Error as error:
                raise WlmError(f"{where}.uri: expected base64: {error}") from error
    else:
        if not isinstance(length, int) or length < 1:
            raise WlmError(f"{where}.byteLength: expected at least 1, found {length}")
        file = local_file(str(path), uri, f"{where}.uri", trust).resolve()
        # One file, read for each of thousands of buffers, would fill any memory.
        earlier = files.setdefault(file, number)
        if earlier != number:
            raise WlmError(f"{where}.uri: expected another file than that of buffers[{earlier}], found {uri}")
        data = read_file(file, MESH_BYTES, f"buffers[{number}] of {path}", first=length)
    if len(data) < length:
        raise WlmError(f"{where}: expected {length} bytes, found {len(data)}")
    return data


def local_file(document_path: str, uri: str, where: str, trust: bool) -> Path:
    """Gives the file that a URI names relative to the document.

    Raises:
        WlmError: The URI has a scheme or is an absolute path, or the file lies outside the document's folder and the
            document isn't trusted.
    """
    name = unquote(uri)
    if _URI_SCHEME.match(uri) or Path(name).is_absolute():
        raise WlmError(f"{where}: expected a file relative to it, found {uri}")
    return named_file(document_path, name, where, trust)
