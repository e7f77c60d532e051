"""Compact artifacts: eight or sixteen bytes before what the system says, for files that a JSON header would be most of.

Byte 3 is 16 times the system's number, its place in `SYSTEMS`, plus the version:

=======  =========================================================================================================
version  content
=======  =========================================================================================================
2        "wlm", byte 3, the first 4 bytes of the BLAKE2b of all else; then the body
3        "wlm", byte 3, 8 such bytes of all up to the end of the head, the head's length U32, the head; then data that
         is read and checked piece by piece
=======  =========================================================================================================

What the body, the head and the data are is the system's own. Neither has a name: it is called as its file is.
"""

import hashlib
import struct
from collections.abc import Mapping

import numpy as np

from wlm.errors import WlmError

SYSTEMS = ("probe",)
"""Those that have compact artifacts."""

BODY, HEAD, DATA = "body", "head", "data"
"""The parts: a body alone, or head and data."""

_MAGIC = b"wlm"
_WHOLE, _PIECES = 2, 3
_DIGEST = {_WHOLE: 4, _PIECES: 8}
_LENGTH = struct.Struct("<I")


def is_compact(begin: bytes) -> bool:
    """Whether a file that begins so is a compact artifact; no safetensors header is as long as that would be."""
    return begin[: len(_MAGIC)] == _MAGIC


def digest(*pieces: bytes | np.ndarray, size: int = 4) -> bytes:
    """The first bytes of a BLAKE2b of that length."""
    hasher = hashlib.blake2b(digest_size=size)
    for piece in pieces:
        hasher.update(piece)
    return hasher.digest()


def encode_compact(system: str, parts: Mapping[str, np.ndarray]) -> list[bytes | np.ndarray]:
    """Lays out a compact artifact.

    Args:
        system: One of `SYSTEMS`.
        parts: uint8 [B] each: `BODY`, or `HEAD` and `DATA`.

    Returns:
        The file's content as consecutive buffers.
    """
    version = _WHOLE if BODY in parts else _PIECES
    begin = _MAGIC + bytes([SYSTEMS.index(system) << 4 | version])
    if version == _WHOLE:
        return [begin + digest(begin, parts[BODY], size=_DIGEST[version]), parts[BODY]]
    head = _LENGTH.pack(len(parts[HEAD])) + parts[HEAD].tobytes()
    return [begin + digest(begin, head, size=_DIGEST[version]) + head, parts[DATA]]


def parse_compact(where: object, mapped: bytes | memoryview) -> tuple[str, int, dict[str, np.ndarray], int]:
    """Splits a compact artifact and checks it against its digest, but for `DATA`.

    Args:
        where: The file, for messages.
        mapped: Its content.

    Returns:
        System, version, parts as views, and the bytes that are none of theirs.

    Raises:
        WlmError: It is cut short, damaged, from a newer version or from a system that has none.
    """
    view = np.frombuffer(mapped, np.uint8)
    begin = view[:4].tobytes()
    version, number = (begin[3] & 15, begin[3] >> 4) if len(begin) == 4 else (_WHOLE, 0)
    if version > _PIECES or number >= len(SYSTEMS):
        raise WlmError(f"{where}: artifact version {version}.{number}: expected at most {_PIECES}; update wlm")
    if version < _WHOLE:
        raise WlmError(f"{where}: artifact version {version}: expected {_WHOLE} or {_PIECES}")
    start = 4 + _DIGEST[version]
    stated, end = view[4:start].tobytes(), len(view)
    if version == _PIECES:
        start += _LENGTH.size
        if len(view) >= start:
            end = start + _LENGTH.unpack(view[start - _LENGTH.size : start].tobytes())[0]
    if len(view) < max(start, end):
        raise WlmError(f"{where}: the artifact is cut short: expected {max(start, end)} bytes, found {len(view)}")
    if digest(begin, view[4 + _DIGEST[version] : end], size=_DIGEST[version]) != stated:
        raise WlmError(f"{where}: the artifact is damaged: its content does not match its digest")
    parts = {BODY: view[start:]} if version == _WHOLE else {HEAD: view[start:end], DATA: view[end:]}
    return SYSTEMS[number], version, parts, start
