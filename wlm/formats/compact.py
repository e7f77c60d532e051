"""Compact artifacts: a header of eight bytes, for files so small that a JSON header would be most of the file.

A file is "wlm", a byte that is 16 times the system's number (its index in `SYSTEMS`) plus the version, the first 4
bytes of the BLAKE2b of everything else, and the body. The system defines the body. The file stores no name: a model is
named after its file.
"""

import hashlib
from collections.abc import Mapping

import numpy as np

from wlm.errors import WlmError

SYSTEMS = ("probe",)
"""Systems that have compact artifacts."""

BODY = "body"
"""Name of the only part."""

_MAGIC = b"wlm"
_VERSION = 6
_DIGEST = 4
_START = 4 + _DIGEST


def is_compact(begin: bytes) -> bool:
    """Whether a file that starts with these bytes is a compact artifact and not a safetensors file."""
    return begin[: len(_MAGIC)] == _MAGIC


def digest(*pieces: bytes | np.ndarray) -> bytes:
    """Returns a BLAKE2b hash of 4 bytes over consecutive pieces."""
    hasher = hashlib.blake2b(digest_size=_DIGEST)
    for piece in pieces:
        hasher.update(piece)
    return hasher.digest()


def encode_compact(system: str, parts: Mapping[str, np.ndarray]) -> list[bytes | np.ndarray]:
    """Encodes a compact artifact of a system in `SYSTEMS`; returns the file's content as consecutive buffers. `parts`
    has only one part: `BODY`, uint8 [bytes]."""
    begin = _MAGIC + bytes([SYSTEMS.index(system) << 4 | _VERSION])
    return [begin + digest(begin, parts[BODY]), parts[BODY]]


def parse_compact(where: object, mapped: bytes | memoryview) -> tuple[str, int, dict[str, np.ndarray], int]:
    """Splits the mapped content of a compact artifact and checks its digest; `where` names the file in messages.
    Returns the system, the version, parts as views, and the number of bytes before them."""
    view = np.frombuffer(mapped, np.uint8)
    begin = view[:4].tobytes()
    version, number = (begin[3] & 15, begin[3] >> 4) if len(begin) == 4 else (_VERSION, 0)
    if version != _VERSION or number >= len(SYSTEMS):
        raise WlmError(
            f"{where}: expected artifact version {_VERSION} of {' or '.join(SYSTEMS)}, found {version}, system {number}"
        )
    if len(view) < _START:
        raise WlmError(f"{where}: the artifact is cut short: expected {_START} bytes, found {len(view)}")
    if digest(begin, view[_START:]) != view[4:_START].tobytes():
        raise WlmError(f"{where}: the artifact is damaged: its content does not match its digest")
    return SYSTEMS[number], version, {BODY: view[_START:]}, _START
