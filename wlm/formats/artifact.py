"""The artifact: a `.wlm` file of compressed light, written by one system of wlm, such as "lightmap" or "probe".

The file is a valid safetensors file: an 8-byte length, a JSON header, the tensors. The header's
`__metadata__`, whose values must be strings, has two keys:

- `wlm`: "<format version> <system> <source> <digest>": the source is a hash of the input; the digest is the
  BLAKE2b-128 (hex) of the whole file with zeros in place of the digest's 32 characters;
- `settings`: JSON, with `"` and `'` exchanged, because each `"` inside a JSON string would cost an escape.

Each tensor is called a part. Its offsets in the header must span exactly the bytes of its type and shape.

An artifact without a source is stored in a compact form that is no safetensors file: `wlm.formats.compact`.
"""

import hashlib
import json
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError, one_line
from wlm.formats.atomic import atomic_write
from wlm.formats.compact import encode_compact, is_compact, parse_compact
from wlm.formats.reading import check_json, open_file

FORMAT_VERSION = 2

_LENGTH = struct.Struct("<Q")
_NO_DIGEST = "0" * 32
_EXCHANGED_QUOTES = str.maketrans({'"': "'", "'": '"'})
_ALIGNMENT = 8  # of the first tensor, in bytes: that of the widest type
_HEADER_LIMIT = 16 << 20  # bytes: settings, names and times of a set of the most states and sheets take some

_MOST_AXES, _MOST_NUMBERS = 8, 1 << 48  # of a part

_NUMBERS = ("U8", "I8", "U16", "I16", "F16", "U32", "I32", "F32", "U64", "I64", "F64")
_TYPES = {"BOOL": np.dtype(bool)} | {name: np.dtype(f"<{name[0].lower()}{int(name[1:]) // 8}") for name in _NUMBERS}
_TYPE_NAMES = {kind: name for name, kind in _TYPES.items()}


def _finite(text: str) -> float:
    """Parses a number in JSON; refuses NaN, Infinity and 1e999, which Python's JSON parser accepts."""
    if not math.isfinite(value := float(text)):
        raise ValueError(f"expected finite numbers, found {one_line(text, 30)}")
    return value


_JSON = json.JSONDecoder(parse_float=_finite, parse_constant=_finite)


@dataclass(frozen=True)
class Artifact:
    """Content of an artifact.

    Attributes:
        system: The system that wrote it, for example "lightmap".
        version: Version of the format.
        settings: Settings of the fit; for a compact artifact only `name`, the file's name without its ending.
        source: Hash of the input, as given by the writer; empty for a compact artifact.
        tensors: The parts by name, as read-only views of the file's content.
        parts: Sizes of the parts by name, in bytes.
        file_bytes: Size of the file.
        header_bytes: Size of everything before the parts: the length, the header and its padding.
    """

    system: str
    version: int
    settings: dict[str, Any]
    source: str
    tensors: dict[str, np.ndarray]
    parts: dict[str, int]
    file_bytes: int
    header_bytes: int


def write_artifact(
    path: str | os.PathLike[str],
    system: str,
    settings: Mapping[str, Any],
    tensors: Mapping[str, np.ndarray],
    source: str,
) -> int:
    """Writes an artifact atomically and returns its size in bytes. Equal arguments give equal bytes; see
    `encode_artifact`.

    Raises:
        ValueError: A name, a setting or a type that the format cannot store.
        WlmError: The file cannot be written; the old content stays.
    """
    return atomic_write(path, encode_artifact(system, settings, tensors, source))


def encode_artifact(
    system: str, settings: Mapping[str, Any], tensors: Mapping[str, np.ndarray], source: str
) -> list[bytes | np.ndarray]:
    """Encodes an artifact in memory; contiguous tensors are not copied.

    Args:
        system: Name of the system, without spaces.
        settings: Plain JSON values without NaN and infinity.
        tensors: The parts by name, of any shape: bool, integers of 8 to 64 bits or floats of 16 to 64 bits.
        source: A hash of the input, without spaces. If it is empty, the artifact is compact: it has the parts of
            `wlm.formats.compact` and no settings.

    Returns:
        The content of the file as consecutive buffers: the header, then the tensors.

    Raises:
        ValueError: A name, a setting or a type that the format cannot store.
    """
    if not source:
        if settings:
            raise ValueError(
                f"settings: expected none for an artifact without a source, which is compact, got {', '.join(settings)}"
            )
        return encode_compact(system, tensors)
    for what, word in (("system", system), ("source", source)):
        if not word or not word.isascii() or not word.isprintable() or " " in word:
            raise ValueError(f"{what}: expected one word of ASCII characters, got {word!r}")
    if "__metadata__" in tensors:
        raise ValueError("'__metadata__' is no name for a tensor: the format reserves it")
    # Wide types first, so that every tensor begins at a multiple of its item's size with no padding between.
    arrays = {
        name: _little_endian(name, array)
        for name, array in sorted(tensors.items(), key=lambda item: (-item[1].dtype.itemsize, item[0]))
    }
    text = json.dumps(dict(settings), separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    metadata = {
        "wlm": f"{FORMAT_VERSION} {system} {source} {_NO_DIGEST}",
        "settings": text.translate(_EXCHANGED_QUOTES),
    }
    header: dict[str, Any] = {"__metadata__": metadata}
    offset = 0
    for name, array in arrays.items():
        end = offset + array.nbytes
        header[name] = {
            "dtype": _TYPE_NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": [offset, end],
        }
        offset = end
    encoded = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    encoded += b" " * (-len(encoded) % _ALIGNMENT)
    head = _LENGTH.pack(len(encoded)) + encoded
    digest = hashlib.blake2b(head, digest_size=16)
    for array in arrays.values():
        digest.update(array)
    # With its quote, the first match is the placeholder: a source of zeros is followed by a space.
    head = head.replace(f' {_NO_DIGEST}"'.encode(), f' {digest.hexdigest()}"'.encode(), 1)
    return [head, *arrays.values()]


def read_artifact(path: str | os.PathLike[str], system: str | None = None) -> Artifact:
    """Reads an artifact and checks all its bytes against its digest.

    `system` is the system that must have written it; None accepts any. The tensors are views of the bytes read, which
    no later change of the file reaches.

    Raises:
        WlmError: The file is missing, not an artifact, cut short, damaged, from a newer version or from another
            system.
    """
    content = _read(path)
    size = len(content)
    if is_compact(content[: _LENGTH.size]):
        return _compact(path, content, system)
    if size < _LENGTH.size:
        raise WlmError(f"{path}: expected an artifact (safetensors), found a file of {size} bytes")
    (length,) = _LENGTH.unpack_from(content)
    start = _LENGTH.size + length
    if not _has_header(content):
        raise WlmError(f"{path}: expected an artifact (safetensors), found other content")
    if start > size:
        raise WlmError(f"{path}: the artifact is cut short: expected a header of {length} bytes, found fewer")
    encoded = content[_LENGTH.size : start]
    check_json(f"{path}: the artifact's header", encoded)
    header = _parse_json(path, encoded, "header")
    stated, settings_text = _metadata(path, header)
    version, found_system, source, digest = stated
    # The version comes first: what a newer one means by the rest isn't for this reader to say.
    if version > FORMAT_VERSION:
        raise WlmError(f"{path}: artifact version {version}: expected at most {FORMAT_VERSION}; update wlm")
    if version < FORMAT_VERSION:
        raise WlmError(f"{path}: artifact version {version}: expected {FORMAT_VERSION}; compress the input again")
    entries = {name: _entry(path, name, entry) for name, entry in header.items() if name != "__metadata__"}
    _check_extents(path, entries, size - start)
    _check_digest(path, content, encoded, digest)
    _check_system(path, found_system, system)
    settings = _parse_json(path, settings_text.translate(_EXCHANGED_QUOTES), "settings")
    tensors = {name: _view(content, start, *entry) for name, entry in entries.items()}
    return Artifact(
        system=found_system,
        version=version,
        settings=settings,
        source=source,
        tensors=tensors,
        parts={name: array.nbytes for name, array in tensors.items()},
        file_bytes=size,
        header_bytes=start,
    )


def _compact(path: str | os.PathLike[str], content: bytes, system: str | None) -> Artifact:
    found, version, tensors, start = parse_compact(path, content)
    _check_system(path, found, system)
    parts = {name: array.nbytes for name, array in tensors.items()}
    return Artifact(found, version, {"name": Path(path).stem}, "", tensors, parts, len(content), start)


def _check_system(path: str | os.PathLike[str], found: str, expected: str | None) -> None:
    if expected is not None and found != expected:
        raise WlmError(f"{path}: expected an artifact of {expected}, found one of {found}")


def _little_endian(name: str, array: np.ndarray) -> np.ndarray:
    dtype = array.dtype.newbyteorder("<")
    if dtype not in _TYPE_NAMES:
        raise ValueError(f"tensor {name}: expected one of {', '.join(_TYPES)}, got {array.dtype}")
    return np.asarray(array, dtype=dtype, order="C")


def _has_header(begin: bytes) -> bool:
    """Tests whether a file's first bytes, at least 8, can begin a safetensors file: header length within the limit."""
    return begin[_LENGTH.size : _LENGTH.size + 1] in (b"{", b"") and _LENGTH.unpack_from(begin)[0] <= _HEADER_LIMIT


def _read(path: str | os.PathLike[str]) -> bytes:
    # A mapping would show what another process writes after the digest was checked, or end this one where it is cut.
    try:
        with open_file(path, "the artifact") as file:
            head = file.read(_LENGTH.size + 1)
            if len(head) > _LENGTH.size and not (is_compact(head) or _has_header(head)):
                return head  # which is enough to refuse it
            file.seek(0)
            return file.read()
    except MemoryError as error:
        raise WlmError(f"{path}: the artifact does not fit into memory") from error


def _parse_json(path: str | os.PathLike[str], text: bytes | str, what: str) -> dict[str, Any]:
    try:
        value = _JSON.decode(text if isinstance(text, str) else text.decode())
    except (ValueError, RecursionError) as error:
        raise WlmError(f"{path}: the artifact's {what} is damaged: {one_line(error, 120)}") from error
    if not isinstance(value, dict):
        raise WlmError(f"{path}: the artifact's {what} is damaged: expected a JSON object")
    return value


def _metadata(path: str | os.PathLike[str], header: dict[str, Any]) -> tuple[tuple[int, str, str, str], str]:
    """Splits the metadata into (version, system, source, digest) and the settings' text."""
    metadata = header.get("__metadata__")
    if not isinstance(metadata, dict) or not isinstance(metadata.get("wlm"), str):
        raise WlmError(f"{path}: expected an artifact of wlm, found a safetensors file without its metadata")
    words = metadata["wlm"].split(" ")
    if not (words[0].isascii() and words[0].isdecimal()):
        raise WlmError(f"{path}: the artifact's version is damaged: expected an integer, found {words[0]!r}")
    version = int(words[0][:9])
    if version <= FORMAT_VERSION and (len(words) != 4 or not isinstance(metadata.get("settings"), str)):
        raise WlmError(f"{path}: the artifact's metadata is damaged: expected a text of four words and settings")
    if version <= FORMAT_VERSION and not (metadata["wlm"].isascii() and metadata["wlm"].isprintable()):
        raise WlmError(f"{path}: the artifact's metadata is damaged: expected words in printable ASCII")
    system, source, digest = (*words[1:], "", "", "")[:3]
    return (version, system, source, digest), str(metadata.get("settings"))


def _entry(path: str | os.PathLike[str], name: str, entry: Any) -> tuple[str, tuple[int, ...], int, int]:
    """Checks the header's entry of one tensor and returns its type, shape, and first and last offset."""
    try:
        kind, shape, (begin, end) = entry["dtype"], tuple(entry["shape"]), entry["data_offsets"]
        numbers = (*shape, begin, end)
        valid = kind in _TYPES and all(type(number) is int and number >= 0 for number in numbers)
    except (KeyError, TypeError, ValueError):
        valid = False
    if not valid:
        raise WlmError(f"{path}: part {one_line(name, 60)}: expected a type, a shape and two offsets in the header")
    # A part of size 0 along one axis may state any other sizes, and NumPy limits them.
    if len(shape) > _MOST_AXES or math.prod(max(size, 1) for size in shape) > _MOST_NUMBERS:
        raise WlmError(
            f"{path}: part {one_line(name, 60)}: the shape {shape} exceeds {_MOST_AXES} axes or {_MOST_NUMBERS} numbers"
        )
    expected = math.prod(shape) * _TYPES[kind].itemsize
    if end - begin != expected:
        raise WlmError(f"{path}: part {one_line(name, 60)}: expected {expected} bytes, found {end - begin}")
    return kind, shape, begin, end


def _check_extents(
    path: str | os.PathLike[str], entries: dict[str, tuple[str, tuple[int, ...], int, int]], payload: int
) -> None:
    reached = 0
    for name, (_, _, begin, end) in sorted(entries.items(), key=lambda item: item[1][2:]):
        if begin != reached:
            raise WlmError(f"{path}: part {one_line(name, 60)}: expected its data at byte {reached}, found {begin}")
        reached = end
    if payload < reached:
        raise WlmError(f"{path}: the artifact is cut short: expected {reached} bytes of parts, found {payload}")
    if payload > reached:
        raise WlmError(f"{path}: expected the end of the file, found {payload - reached} more bytes")


def _check_digest(path: str | os.PathLike[str], content: Any, encoded: bytes, digest: str) -> None:
    stated = digest.encode(errors="replace")
    # Exactly as the writer spells it, at its one place: anything else is a change that it did not make.
    place = encoded.find(b" " + stated + b'"') + 1
    actual = None
    if place > 0 and len(stated) == len(_NO_DIGEST):
        at = _LENGTH.size + place
        hasher = hashlib.blake2b(digest_size=16)
        with memoryview(content) as view:
            hasher.update(view[:at])
            hasher.update(_NO_DIGEST.encode())
            hasher.update(view[at + len(stated) :])
        actual = hasher.hexdigest()
    if actual != digest:
        raise WlmError(f"{path}: the artifact is damaged: its content does not match its digest")


def _view(content: Any, start: int, kind: str, shape: tuple[int, ...], begin: int, end: int) -> np.ndarray:
    # An empty array at the end of the file would begin behind its last byte.
    source = content[:0] if begin == end else content
    return np.frombuffer(source, _TYPES[kind], math.prod(shape), start + begin if begin < end else 0).reshape(shape)
