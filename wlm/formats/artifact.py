"""The artifact: a `.wlm` file of compressed light, written by one system of wlm, such as "lightmap" or "probe".

The file is a valid safetensors file: an 8-byte length, a JSON header, the tensors. The header's
`__metadata__`, whose values must be strings, has two keys:

- `wlm`: "<format version> <system> <source> <digest>": the source is a hash of the input; the digest is the
  BLAKE2b-128 (hex) of the file's index with zeros in place of the digest's 32 characters;
- `settings`: JSON, with `"` and `'` exchanged, because each `"` inside a JSON string would cost an escape.

Each tensor is called a part. Its offsets in the header must span exactly the bytes of its type and shape.

A part may be split in pieces, each of which is read alone. Its bytes are those of its pieces, one after another, and
the part `NAME.pieces`, U32 [n, 5], has the size of each piece and its BLAKE2b-128 as four words. Split parts lie behind
all others. The index is everything before them: length, header, and the parts that are not split, with the digests of
all pieces. So the digest of the index covers every byte of the file, and the index of a large file is read in
milliseconds. A file without split parts is all index.

An artifact without a source is stored in a compact form that is no safetensors file: `wlm.formats.compact`.
"""

import hashlib
import json
import math
import os
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, overload

import numpy as np

from wlm.errors import WlmError, one_line
from wlm.formats.atomic import atomic_write
from wlm.formats.compact import encode_compact, is_compact, parse_compact
from wlm.formats.reading import OpenFile, check_json, open_file

FORMAT_VERSION = 3

Content = np.ndarray | Sequence[bytes]
"""A part to be written: an array, or the pieces of a split part."""

_LENGTH = struct.Struct("<Q")
_NO_DIGEST = "0" * 32
_EXCHANGED_QUOTES = str.maketrans({'"': "'", "'": '"'})
_PIECES = ".pieces"  # suffix of the part that has the sizes and digests of the pieces of another
_WORDS = np.dtype("<u4")
_DIGEST_BYTES = 16
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


class Pieces(Sequence[bytes]):
    """The pieces of a split part of a file. Each is read when it is asked for, and checked against its own digest.

    Several threads may read at once. Later changes of the file never show: they are an error of the pieces that they
    reach. A file that is replaced as `wlm.formats.atomic` does it remains readable.
    """

    def __init__(self, path: str, file: OpenFile, start: int, index: np.ndarray) -> None:
        """Takes the file, the first byte of the part in it, and the content of `NAME.pieces`, uint32 [n, 5]."""
        self.path, self._file = path, file
        self.sizes = index[:, 0].astype(np.int64)
        """int64 [n], bytes of each piece."""
        self.index = index
        """uint32 [n, 5], size and BLAKE2b-128 of each piece."""
        self._starts = start + np.cumsum(self.sizes) - self.sizes

    def __len__(self) -> int:
        return len(self.sizes)

    @overload
    def __getitem__(self, place: int) -> bytes: ...
    @overload
    def __getitem__(self, place: slice) -> list[bytes]: ...
    def __getitem__(self, place: int | slice) -> bytes | list[bytes]:
        """Reads one piece, or several. Raises a ValueError if the file was closed, cut short or changed, or cannot be
        read."""
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(len(self)))]
        data = self._file.read(int(self._starts[place]), int(self.sizes[place]))
        if _digest_of(data) != self.index[place, 1:].tobytes():
            raise ValueError("the file is damaged here: the bytes do not match their digest")
        return data

    def close(self) -> None:
        """Closes the file, for all its split parts; it is also closed with the last reference to them."""
        self._file.close()


@dataclass(frozen=True)
class Artifact:
    """Content of an artifact.

    Attributes:
        system: The system that wrote it, for example "lightmap".
        version: Version of the format.
        settings: Settings of the fit; for a compact artifact only `name`, the file's name without its ending.
        source: Hash of the input, as given by the writer; empty for a compact artifact.
        tensors: The parts that are not split by name, as read-only views of the bytes read.
        pieces: The split parts by name; those of a file are `Pieces`.
        parts: Sizes of the parts by name, in bytes; those of split parts include their sizes and digests.
        file_bytes: Size of the file.
        header_bytes: Size of everything before the parts: the length, the header and its padding.
    """

    system: str
    version: int
    settings: dict[str, Any]
    source: str
    tensors: dict[str, np.ndarray]
    pieces: Mapping[str, Sequence[bytes]] = field(default_factory=dict)
    parts: dict[str, int] = field(default_factory=dict)
    file_bytes: int = 0
    header_bytes: int = 0

    @classmethod
    def of_parts(
        cls, system: str, settings: Mapping[str, Any], parts: Mapping[str, Content], source: str
    ) -> "Artifact":
        """Returns what reading would return of an artifact with this content, without a file."""
        tensors = {name: part for name, part in parts.items() if not isinstance(part, Sequence)}
        pieces = {name: part for name, part in parts.items() if isinstance(part, Sequence)}
        return cls(system, FORMAT_VERSION, dict(settings), source, tensors, pieces)


def write_artifact(
    path: str | os.PathLike[str], system: str, settings: Mapping[str, Any], parts: Mapping[str, Content], source: str
) -> int:
    """Writes an artifact atomically and returns its size in bytes. Equal arguments give equal bytes; see
    `encode_artifact`. Raises a ValueError for a name, a setting or a type that the format cannot store. Raises a
    WlmError if the file cannot be written; the old content stays."""
    content = encode_artifact(system, settings, parts, source)
    try:
        return atomic_write(path, content)
    except ValueError as error:  # of a piece that is copied from another file
        raise WlmError(f"{path}: cannot write: {error}") from error


def encode_artifact(
    system: str, settings: Mapping[str, Any], parts: Mapping[str, Content], source: str
) -> Iterable[bytes | np.ndarray]:
    """Encodes an artifact in memory; contiguous arrays are not copied, and pieces of another file are read one by one.

    Args:
        system: Name of the system, without spaces.
        settings: Plain JSON values without NaN and infinity.
        parts: The parts by name: arrays of any shape (bool, integers of 8 to 64 bits or floats of 16 to 64 bits), or
            the pieces of a split part.
        source: A hash of the input, without spaces. If it is empty, the artifact is compact: it has the parts of
            `wlm.formats.compact` and no settings.

    Returns:
        The content of the file as consecutive buffers: the header, the arrays, the pieces. It can be read once.

    Raises:
        ValueError: A name, a setting or a type that the format cannot store.
    """
    split = {name: part for name, part in parts.items() if isinstance(part, Sequence)}
    plain = {name: part for name, part in parts.items() if not isinstance(part, Sequence)}
    if not source:
        if settings or split:
            raise ValueError(
                "settings: expected none, and no split part, for an artifact without a source, which is compact, got "
                + ", ".join([*settings, *split])
            )
        return encode_compact(system, plain)
    for what, word in (("system", system), ("source", source)):
        if not word or not word.isascii() or not word.isprintable() or " " in word:
            raise ValueError(f"{what}: expected one word of ASCII characters, got {word!r}")
    for name in parts:
        if name == "__metadata__" or name.endswith(_PIECES):
            raise ValueError(f"{name!r} is no name for a part: the format reserves it")
    plain |= {f"{name}{_PIECES}": _index_of(pieces) for name, pieces in split.items()}
    # Wide types first, so that every tensor begins at a multiple of its item's size with no padding between.
    arrays = {
        name: _little_endian(name, array)
        for name, array in sorted(plain.items(), key=lambda item: (-item[1].dtype.itemsize, item[0]))
    }
    text = json.dumps(dict(settings), separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    metadata = {
        "wlm": f"{FORMAT_VERSION} {system} {source} {_NO_DIGEST}",
        "settings": text.translate(_EXCHANGED_QUOTES),
    }
    header: dict[str, Any] = {"__metadata__": metadata}
    offset = 0
    entries = [(name, _TYPE_NAMES[array.dtype], list(array.shape), array.nbytes) for name, array in arrays.items()]
    for name in sorted(split):
        size = int(arrays[f"{name}{_PIECES}"][:, 0].sum(dtype=np.uint64))
        entries.append((name, "U8", [size], size))
    for name, kind, shape, size in entries:
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [offset, offset + size]}
        offset += size
    encoded = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    encoded += b" " * (-len(encoded) % _ALIGNMENT)
    head = _LENGTH.pack(len(encoded)) + encoded
    digest = hashlib.blake2b(head, digest_size=_DIGEST_BYTES)
    for array in arrays.values():
        digest.update(array)
    # With its quote, the first match is the placeholder: a source of zeros is followed by a space.
    head = head.replace(f' {_NO_DIGEST}"'.encode(), f' {digest.hexdigest()}"'.encode(), 1)
    return chain([head, *arrays.values()], *(split[name] for name in sorted(split)))


def read_artifact(path: str | os.PathLike[str], system: str | None = None) -> Artifact:
    """Reads the index of an artifact and checks all its bytes against its digest; pieces are read when they are needed.

    `system` is the system that must have written it; None accepts any. The tensors are views of the bytes read, which
    no later change of the file reaches. Bytes are copied, not mapped: a mapping would show what another process writes
    after a digest was checked, and end this process where the file is cut.
    """
    try:
        with open_file(path, "the artifact") as file:
            return _read(path, file, system)
    except MemoryError as error:
        raise WlmError(f"{path}: the artifact does not fit into memory") from error


def _read(path: str | os.PathLike[str], file: BinaryIO, system: str | None) -> Artifact:
    size, head = os.fstat(file.fileno()).st_size, file.read(_LENGTH.size + 1)
    if is_compact(head):
        return _compact(path, head + file.read(), system)
    if len(head) < _LENGTH.size:
        raise WlmError(f"{path}: expected an artifact (safetensors), found a file of {len(head)} bytes")
    (length,) = _LENGTH.unpack_from(head)
    start = _LENGTH.size + length
    if not _has_header(head):
        raise WlmError(f"{path}: expected an artifact (safetensors), found other content")
    file.seek(0)
    begin = file.read(start)
    if start > len(begin):
        raise WlmError(f"{path}: the artifact is cut short: expected a header of {length} bytes, found fewer")
    encoded = begin[_LENGTH.size :]
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
    split = {name.removesuffix(_PIECES): entry for name, entry in entries.items() if name.endswith(_PIECES)}
    for name in split:
        if name not in entries or name.endswith(_PIECES):
            raise WlmError(f"{path}: part {one_line(name, 60)}{_PIECES}: expected a part in pieces, found none")
    plain = {name: entry for name, entry in entries.items() if name not in split}
    end = start + max((last for *_, last in plain.values()), default=0)
    index = begin + file.read(end - start)
    if len(index) < end:
        raise WlmError(f"{path}: the artifact is cut short: expected an index of {end} bytes, found {len(index)}")
    _check_digest(path, index, encoded, digest)
    _check_system(path, found_system, system)
    tensors = {name: _view(index, start, *entry) for name, entry in plain.items()}
    indices = {name: tensors.pop(f"{name}{_PIECES}") for name in split}
    for name, own in indices.items():
        _check_pieces(f"{path}: part {one_line(name, 60)}", entries[name], own, end - start)
    pieces = {}
    if split:
        opened = OpenFile(file)
        pieces = {n: Pieces(f"{path}", opened, start + entries[n][2], own) for n, own in indices.items()}
    settings = _parse_json(path, settings_text.translate(_EXCHANGED_QUOTES), "settings")
    parts = {name: last - first for name, (_, _, first, last) in entries.items()}
    for name in split:
        parts[name] += parts.pop(f"{name}{_PIECES}")
    return Artifact(found_system, version, settings, source, tensors, pieces, parts, size, start)


def _index_of(pieces: Sequence[bytes]) -> np.ndarray:
    """Returns the sizes and digests of pieces, uint32 [n, 5]."""
    if isinstance(pieces, Pieces):
        return pieces.index
    content = b"".join(struct.pack("<I", len(piece)) + _digest_of(piece) for piece in pieces)
    return np.frombuffer(content, _WORDS).reshape(-1, 1 + _DIGEST_BYTES // _WORDS.itemsize)


def _check_pieces(where: str, entry: tuple[str, tuple[int, ...], int, int], index: np.ndarray, end: int) -> None:
    """Checks the sizes of the pieces of a part, so that none overlaps another or exceeds the part. `end` is the end of
    the parts that are not split, from the first part on."""
    kind, shape, first, last = entry
    words = 1 + _DIGEST_BYTES // _WORDS.itemsize
    if index.dtype != _WORDS or index.shape != (len(index), words) or kind != "U8" or len(shape) != 1:
        raise WlmError(f"{where}: expected bytes, and sizes and digests of its pieces, uint32 (any, {words})")
    if first < end:
        raise WlmError(f"{where}: expected its pieces behind all parts that are not split")
    if (total := int(index[:, 0].sum(dtype=np.uint64))) != last - first:
        raise WlmError(f"{where}: expected pieces of {last - first} bytes in all, found {total}")


def _digest_of(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_DIGEST_BYTES).digest()


def _compact(path: str | os.PathLike[str], content: bytes, system: str | None) -> Artifact:
    found, version, tensors, start = parse_compact(path, content)
    _check_system(path, found, system)
    parts = {name: array.nbytes for name, array in tensors.items()}
    settings = {"name": Path(path).stem}
    return Artifact(found, version, settings, "", tensors, {}, parts, len(content), start)


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


def _check_digest(path: str | os.PathLike[str], content: bytes, encoded: bytes, digest: str) -> None:
    stated = digest.encode(errors="replace")
    # Exactly as the writer spells it, at its one place: anything else is a change that it did not make.
    place = encoded.find(b" " + stated + b'"') + 1
    actual = None
    if place > 0 and len(stated) == len(_NO_DIGEST):
        at = _LENGTH.size + place
        hasher = hashlib.blake2b(digest_size=_DIGEST_BYTES)
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
