"""Changes inside containers, which are then closed as their writers close them: digests, CRCs, lengths, offsets.

A blind change seldom gets past a digest or a CRC, so whatever is behind them needs these. Anyone can make such files.
"""

import base64
import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from random import Random
from typing import Any

import numpy as np
import zstandard
from numpy.lib import format as npy

from wlm.formats import zstd

from .mutate import NAMES, corrupt, vary_array, vary_json, vary_numbers

# Artifacts.

_TYPES = {"BOOL": "?", "U8": "u1", "I8": "i1", "U16": "<u2", "I16": "<i2", "F16": "<f2", "U32": "<u4", "I32": "<i4"}
_TYPES |= {"F32": "<f4", "U64": "<u8", "I64": "<i8", "F64": "<f8"}
_TYPE_NAMES = {np.dtype(kind): name for name, kind in _TYPES.items()}
_QUOTES = str.maketrans({'"': "'", "'": '"'})
_NAMES = *"x uv lut kind times colour finished.0.uv running.0.step running.1.x running.x".split(), ""


def open_artifact(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The header's JSON and the bytes of all parts."""
    length = struct.unpack_from("<Q", data)[0]
    return json.loads(data[8 : 8 + length]), data[8 + length :]


def sign(header: Any, body: bytes) -> bytes:
    """An artifact of a header, whatever it says, with the digest that fits it."""
    metadata = header.get("__metadata__") if isinstance(header, dict) else None
    digest, end = "0" * 32, len(body)
    with suppress(AttributeError, KeyError, TypeError, IndexError, ValueError, OverflowError):
        whole = [name for name in header if name != "__metadata__" and f"{name}.pieces" not in header]
        end = max(int(header[name]["data_offsets"][1]) for name in whole)
    if isinstance(metadata, dict) and isinstance(metadata.get("wlm"), str) and metadata["wlm"].count(" ") == 3:
        metadata["wlm"] = f"{metadata['wlm'].rpartition(' ')[0]} {digest}"
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    head = struct.pack("<Q", len(text)) + text
    actual = hashlib.blake2b(head + body[:end], digest_size=16).hexdigest()
    return head.replace(f' {digest}"'.encode(), f' {actual}"'.encode(), 1) + body


def signed(head: bytes, body: bytes) -> bytes:
    """An artifact of a header with its length, and of other bytes of its parts."""
    return sign(json.loads(head[8:]), body)


def vary_artifact(draw: Random, data: bytes) -> bytes:
    """Changes settings, parts, the header or the parts' bytes, and signs the whole again."""
    kind = draw.randrange(8)
    if kind <= 1:
        header, body = open_artifact(data)
        return sign(vary_json(draw, header), body) if kind else sign(header, corrupt(draw, body))

    def change(settings: Any, parts: dict[str, np.ndarray]) -> Any:
        if kind >= 4:
            for _ in range(draw.choice((1, 1, 2))):
                name, what = draw.choice(sorted(parts) or ["x"]), draw.randrange(8)
                if what == 0:
                    parts.pop(name, None)
                elif what == 1:
                    parts[draw.choice(_NAMES)] = parts.get(name, np.zeros(3, np.float32))
                elif name in parts:
                    parts[name] = vary_array(draw, parts[name])
        return vary_json(draw, settings) if kind <= 4 else settings

    header, body = open_artifact(data)
    metadata = header.pop("__metadata__")
    parts = {}
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        parts[name] = np.frombuffer(body[begin:end], _TYPES[entry["dtype"]]).reshape(entry["shape"])
    split = [name for name in parts if f"{name}.pieces" in parts]
    if split and draw.random() < 0.4:
        name = draw.choice(split)
        parts[name], parts[f"{name}.pieces"] = _other_pieces(draw, parts[name].tobytes(), parts[f"{name}.pieces"])
    settings = change(json.loads(metadata["settings"].translate(_QUOTES)), parts)
    for name in [name for name in split if {name, f"{name}.pieces"} <= parts.keys()] if draw.random() < 0.8 else ():
        parts[f"{name}.pieces"] = _signed_pieces(parts[name].tobytes(), parts[f"{name}.pieces"])
    return _pack_artifact(metadata["wlm"], settings, parts)


def _other_pieces(draw: Random, body: bytes, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A part of zstd frames, one of which has other content, is another frame or none, and the index that fits it."""
    ends = np.cumsum(index[:, 0]).astype(int).tolist()
    frames = [body[a:b] for a, b in pairwise([0, *ends])]
    number, what = draw.randrange(len(frames)), draw.randrange(6)
    content = zstandard.ZstdDecompressor().decompressobj().decompress(frames[number])
    if what <= 2:
        frames[number] = zstd.compress(corrupt(draw, content) if what else draw.randbytes(2) * (len(content) // 2))
    elif what == 3:
        frames[number] = zstd.compress(bytes(draw.choice((len(content) + 1, 1 << 22))))
    elif what == 4:
        frames[number] = draw.choice((b"", frames[0], frames[number] * 2, corrupt(draw, frames[number])))
    else:
        frames = draw.choice((frames[:-1], [*frames, frames[0]], frames[::-1]))
    made = np.frombuffer(b"".join(frames), np.uint8)
    packed = (struct.pack("<I", len(frame)) + hashlib.blake2b(frame, digest_size=16).digest() for frame in frames)
    return made, np.frombuffer(b"".join(packed), "<u4").reshape(-1, 5)


def _signed_pieces(body: bytes, index: np.ndarray) -> np.ndarray:
    """The sizes and digests of pieces, as far as sizes can be read: the last piece takes what is left."""
    sizes = index[:, 0].astype(int).tolist() if index.ndim == 2 and index.shape[1:] == (5,) and len(index) else [0]
    ends = np.minimum(np.cumsum(sizes[:-1]), len(body)).astype(int).tolist()
    rows = [body[a:b] for a, b in pairwise([0, *ends, len(body)])]
    packed = (struct.pack("<I", len(row)) + hashlib.blake2b(row, digest_size=16).digest() for row in rows)
    return np.frombuffer(b"".join(packed), "<u4").reshape(-1, 5)


def _pack_artifact(words: str, settings: Any, parts: dict[str, np.ndarray]) -> bytes:
    header: dict[str, Any] = {
        "__metadata__": {"wlm": words, "settings": json.dumps(settings, separators=(",", ":")).translate(_QUOTES)}
    }
    body = b""
    for name, array in sorted(parts.items(), key=lambda item: (f"{item[0]}.pieces" in parts, -item[1].dtype.itemsize)):
        if array.dtype not in _TYPE_NAMES:
            array = np.frombuffer(array.tobytes(), np.uint8)
        raw = array.tobytes()
        offsets = [len(body), len(body) + len(raw)]
        header[name] = {"dtype": _TYPE_NAMES[array.dtype], "shape": list(array.shape), "data_offsets": offsets}
        body += raw
    return sign(header, body)


def vary_compact(draw: Random, data: bytes) -> bytes:
    """Changes a probe file's bytes, header or unpacked parts, and packs and signs them again."""
    body, draws = data[8:], draw.random()
    end = 2 + int.from_bytes(body[:2], "little")
    header, frame = body[2:end], body[end:]
    if draws < 0.2:
        body = corrupt(draw, body)
    else:
        if draws < 0.6:
            header = corrupt(draw, header)[:65535]
        else:
            frame = zstd.compress(corrupt(draw, zstandard.ZstdDecompressor().decompress(frame)))
        body = len(header).to_bytes(2, "little") + header + frame
    return data[:4] + compact_digest(data[:4], body) + body


def compact_digest(begin: bytes, body: bytes) -> bytes:
    """The digest of a compact artifact."""
    return hashlib.blake2b(begin + body, digest_size=4).digest()


# NumPy archives.

_WRONG_HEADERS = (
    "(((((",
    "\n  x\n y",
    "{}",
    "[1]",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999,), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (999999999999,), }",
    "{'descr': '<f4', 'fortran_order': True, 'shape': (2, -3), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (True, 2.5), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
    "{'descr': 'x', 'fortran_order': 3, 'shape': (3,), }",
    "{'descr': ('<f4', (100000, 100000)), 'fortran_order': False, 'shape': (3,), }",
    "{b'a': 1, 'descr': '<f4', 'fortran_order': False, 'shape': (3,)}",
    "{'descr': [('a', '<f4'), ('b', 'O')], 'fortran_order': False, 'shape': (3,), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': " + "(" * 300 + ")" * 300 + ", }",
    "9" * 5000,
)
_OBJECTS = *map(np.array, ("x", ["a", "b"], np.float64(3))), np.array([None, {}], object), np.zeros(2, [("a", "f4")])

# Most often those that are read.
_METHODS = (*(zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) * 4, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


def _member(array: np.ndarray) -> bytes:
    """A `.npy` file."""
    buffer = io.BytesIO()
    npy.write_array(buffer, np.asanyarray(array))
    return buffer.getvalue()


def vary_npz(draw: Random, data: bytes) -> bytes:
    """Changes members of an archive: their arrays, headers, bytes or names; every CRC is right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    # Each at most once: what has been changed may be no array any more.
    for name in draw.sample(sorted(members), min(draw.choice((1, 1, 2)), len(members))):
        content, kind = members[name], draw.randrange(9)
        if kind <= 3:
            content = _member(vary_array(draw, npy.read_array(io.BytesIO(content))))
        elif kind == 4:
            text = draw.choice(_WRONG_HEADERS).encode()
            content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(64)
        elif kind == 5:
            content = _member(draw.choice(_OBJECTS))
        elif kind == 6:
            content = corrupt(draw, content)
        elif kind == 7:
            members.pop(name)
            name = draw.choice(("x.npy", "sh.npy", "sh_x.npy", name[:-4], f"../{name}", "position", "\u202e.npy"))
        else:
            # Bytes without an array's header, or nothing.
            content = draw.choice((b"", b"xx", content[:9], content[:64]))
        members[name] = content
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", draw.choice(_METHODS)) as archive:
        for name, content in members.items():
            if draw.random() < 0.02:
                content += bytes(1 << draw.choice((20, 25)))
            # A fixed date: a case is the same on every day.
            archive.writestr(zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0)), content)
    result = buffer.getvalue()
    # The flags, the method and the sizes that the directory states.
    return vary_numbers(draw, result, _zip_fields(result)) if draw.random() < 0.2 else result


def _zip_fields(data: bytes) -> list[tuple[int, int]]:
    places = []
    for magic, fields in (
        (b"PK\x03\x04", ((6, 2), (8, 2), (18, 4), (22, 4), (26, 2), (28, 2))),
        (b"PK\x01\x02", ((8, 2), (10, 2), (20, 4), (24, 4), (28, 2), (42, 4))),
        (b"PK\x05\x06", ((8, 2), (10, 2), (12, 4), (16, 4), (20, 2))),
    ):
        at = data.find(magic)
        while at >= 0:
            places += [(at + offset, width) for offset, width in fields if at + offset + width <= len(data)]
            at = data.find(magic, at + 4)
    return places


def vary_gltf(draw: Random, data: bytes) -> bytes:
    """Changes the JSON of a `.gltf`, or what a buffer inside it holds."""
    content = json.loads(data)
    if draw.random() < 0.15:
        buffer = draw.choice(content["buffers"])
        head, _, body = buffer["uri"].partition(",")
        buffer["uri"] = f"{head},{base64.b64encode(corrupt(draw, base64.b64decode(body))).decode()}"
    else:
        content = vary_json(draw, _multiplied(draw, content) if draw.random() < 0.2 else content)
    return json.dumps(content).encode()


def _multiplied(draw: Random, content: Any) -> Any:
    """A glTF file whose nodes draw many primitives, some of accessors without data, or that names other files."""
    kind, meshes = draw.randrange(4), content["meshes"]
    if kind == 0:
        count = draw.choice((1, 3, 1 << 20, 1 << 28))
        content["accessors"].append({"componentType": 5126, "type": "VEC3", "count": count})
        for primitive in meshes[0]["primitives"]:
            primitive["attributes"][draw.choice(("POSITION", "NORMAL"))] = len(content["accessors"]) - 1
    elif kind == 1:
        for primitive in meshes[0]["primitives"]:
            primitive["attributes"].pop("POSITION", None)
    if kind <= 2:
        meshes[0]["primitives"] *= draw.choice((1, 30, 1000))
        content["nodes"] += [{"mesh": 0}] * draw.choice((1, 30, 1000))
        content["scenes"] = [{"nodes": list(range(len(content["nodes"])))[draw.choice((0, -1, -500)) :]}]
    else:
        draw.choice(content["images"] + content["buffers"])["uri"] = draw.choice(NAMES)
    return content


def vary_glb(draw: Random, data: bytes) -> bytes:
    """Changes the JSON or the binary chunk of a `.glb`; the lengths fit."""
    size = struct.unpack_from("<I", data, 12)[0]
    text, binary = data[20 : 20 + size], data[28 + size :]
    if draw.random() < 0.2:
        binary = corrupt(draw, binary)
    else:
        content = json.loads(text)
        content = _multiplied(draw, content) if draw.random() < 0.2 and "images" in content else content
        text = json.dumps(vary_json(draw, content)).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text + struct.pack("<2I", len(binary), 0x004E4942) + binary
    return b"glTF" + struct.pack("<2I", 2, 12 + len(chunks)) + chunks


# OpenEXR.

_WINDOWS = (0, -1, 1, 15, 16, 4095, 32767, 65535, 1 << 20, 1 << 24, 1 << 30, (1 << 31) - 1, -(1 << 30), -(1 << 31))
_KINDS = ("box2i", "chlist", "compression", "float", "int", "lineOrder", "string", "v2f", "tiledesc", "x")


def vary_exr(draw: Random, data: bytes, note: str = "") -> bytes:
    """Changes attributes of an EXR's header; their lengths and the offsets of the pixels fit."""
    attributes, at = [], 8
    while data[at]:
        name, kind, rest = data[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        size = struct.unpack("<I", rest[:4])[0]
        attributes.append([name, kind, rest[4 : 4 + size]])
        at += 4 + size
    table = at + 1
    for each in attributes:
        if each[0] == note.encode() and draw.random() < 0.7:
            each[2] = json.dumps(vary_json(draw, json.loads(each[2]))).encode()
    flags = data[4:8]
    if draw.random() < 0.1:
        # Deep, of several parts, with long names, tiled; the type may say another than the flags.
        flags = bytes([2, draw.choice((0x02, 0x04, 0x08, 0x10, 0x18)) ^ data[5], 0, 0])
        kind = draw.choice((b"deepscanline", b"deeptile", b"tiledimage", b"scanlineimage"))
        attributes = [each for each in attributes if each[0] != b"type"] + [[b"type", b"string", kind]]
    for each in attributes:
        if each[0] == b"channels" and draw.random() < 0.1:
            # The sampling of the first channel.
            at = each[2].index(0) + 9
            each[2] = each[2][:at] + struct.pack("<2i", *draw.choices((0, 1, 2, -1, 1 << 30), k=2)) + each[2][at + 8 :]
    for _ in range(draw.choice((0, 1, 1) if note else (1, 1, 2))):
        chosen, kind = draw.choice(attributes), draw.randrange(8)
        if kind == 0 and len(attributes) > 1:
            attributes.remove(chosen)
        elif kind == 1:
            attributes.append(list(draw.choice(attributes)))
        elif kind == 2:
            chosen[draw.randrange(2)] = draw.choice((*_KINDS, chosen[0].decode("latin-1"))).encode("latin-1")
        elif kind <= 5 and chosen[1] == b"box2i" and len(chosen[2]) == 16:
            window = list(struct.unpack("<4i", chosen[2]))
            for _ in range(draw.choice((1, 2, 2, 4))):
                window[draw.randrange(4)] = draw.choice(_WINDOWS)
            chosen[2] = struct.pack("<4i", *window)
        else:
            chosen[2] = corrupt(draw, chosen[2])
    rows = [(name, kind, struct.pack("<I", len(value)) + value) for name, kind, value in attributes]
    header = b"".join(map(b"\0".join, rows))
    moved = 8 + len(header) + 1 - table
    body = bytearray(data[table:])
    for place in range(0, struct.unpack_from("<Q", data, table)[0] - table, 8):
        struct.pack_into("<Q", body, place, struct.unpack_from("<Q", body, place)[0] + moved)
    return data[:4] + flags + header + b"\0" + bytes(body)


def vary_png(draw: Random, data: bytes) -> bytes:
    """Changes chunks of a PNG; every CRC is right."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = struct.unpack_from(">I", data, at)[0]
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    for _ in range(draw.choice((1, 1, 2))):
        number, kind = draw.randrange(len(chunks)), draw.randrange(6)
        name, content = chunks[number]
        if kind == 0 and len(chunks) > 1:
            del chunks[number]
        elif kind == 1:
            chunks.insert(number, draw.choice(chunks))
        elif kind == 2:
            name = draw.choice(b"IHDR PLTE IDAT IEND tRNS zTXt iCCP acTL eXIf xxxx".split())
            chunks.insert(number, (name, draw.choice((b"", content, b"x\0\0" + zlib.compress(bytes(1 << 20))))))
        elif name == b"IDAT" and kind == 3:
            chunks[number] = (name, zlib.compress(corrupt(draw, _inflated(content))))
        elif name == b"IHDR":
            # Width, height, depth, colour, compression, filter, interlace.
            places = ((0, 4), (4, 4), (8, 1), (9, 1), (10, 1), (11, 1), (12, 1))
            chunks[number] = (name, vary_numbers(draw, content, places))
        else:
            chunks[number] = (name, corrupt(draw, content))
    return data[:8] + b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        for name, content in chunks
    )


def _inflated(data: Sequence[int] | bytes) -> bytes:
    try:
        return zlib.decompress(data)
    except zlib.error:
        return b""
