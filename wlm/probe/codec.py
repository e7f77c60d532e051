"""Reads and writes probe models as files.

A file is a compact artifact (`wlm.formats.compact`), whose header is small even for a few probes. Its body is

=========  =======================================================================================================
field      content
=========  =======================================================================================================
length     U16, length of the header in bytes
header     JSON, see `_Header`
parts      to the end: one zstd frame of all arrays (parts), in the order in which `_table` lists them; the bytes
           of each array are split into planes, first the lowest byte of every number
=========  =======================================================================================================

A model in regions (`wlm.probe.regions`) is an artifact with two parts: `body`, which is the index, and `regions`, whose
pieces are the bodies of the regions, each with a digest of its own. They are read when they are needed.

Signed integers are stored as 2 n for n >= 0 and -2 n - 1 otherwise, so that small magnitudes have empty high planes.
"""

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.formats import zstd
from wlm.formats.artifact import Artifact
from wlm.formats.artifact import Content as Stored
from wlm.formats.compact import BODY
from wlm.formats.hours import DAY
from wlm.formats.limits import NUMBERS, PROBES
from wlm.formats.parts import Part, check_parts
from wlm.probe.gaussian.model import Gaussians
from wlm.probe.model import Content, ProbeModel, Profile
from wlm.probe.pca.model import CLUSTERS, Components
from wlm.probe.regions.model import Regions
from wlm.system import Header, Name

_METHODS: dict[str, type[Content]] = {each.METHOD: each for each in (Gaussians, Components)}

_REGIONS = "regions"
_LENGTH = struct.Struct("<H")
_FARTHEST = 1e150
_SOURCE = 8  # hexadecimal digits of the source
# Limits of the unpacked arrays in bytes, since a tiny file could unpack to huge arrays of zeros.
_SURE, _PER_BYTE = 1 << 24, 4096


class _Header(Header):
    """The header of a file: `count` is the number of Gaussians, of regions, or of components, 0 for unit vectors. The
    method is in `profile`."""

    probes: int = Field(ge=1, le=PROBES)
    outputs: int = Field(27, ge=1, le=NUMBERS)
    source: str = Field(pattern="^[0-9a-f]{8}$")
    profile: Profile
    count: int = Field(0, ge=0, le=PROBES)
    clusters: int = Field(1, ge=1, le=CLUSTERS)
    dropped: int = Field(0, ge=0, le=PROBES)
    live: int | None = Field(None, ge=1, le=PROBES)
    positions: bool = False
    hours: int = Field(1, ge=1, le=NUMBERS)


class _NameHeader(Header):
    name: Name = ""


def encode(model: ProbeModel) -> tuple[dict[str, Any], dict[str, Stored], str]:
    """Encodes a model for `wlm.formats.artifact`: its settings, arrays and pieces, and the hash of the input; for a
    model without regions no settings, one array of bytes, and an empty hash. Raises a ValueError if the model's
    Gaussians have not been quantised to integers."""
    body = np.frombuffer(pack(model), np.uint8)
    if isinstance(model.content, Regions):
        return {"name": model.name}, {BODY: body, _REGIONS: model.content.packed}, model.source[:_SOURCE]
    return {}, {BODY: body}, ""


def pack(model: ProbeModel) -> bytes:
    """Returns the body of a model's file, or, of a model in regions, the index of these; errors as for `encode`."""
    live = int(model.live.sum())
    header: dict[str, Any] = {"probes": model.probes}
    if model.outputs != _Header.model_fields["outputs"].default:
        header["outputs"] = model.outputs
    header |= {"source": model.source[:_SOURCE], "profile": model.profile.changes()}
    header |= model.content.settings()
    header |= {"live": live} if live < model.probes else {}
    header |= {"positions": True} if model.has_positions else {}
    header |= {"hours": len(model.times)} if len(model.times) else {}
    parts = {"box": np.array([*model.origin, model.extent, *model.size])} | model.content.parts()
    if live < model.probes:
        parts["dead"] = np.packbits(model.dead)
    if len(model.times):
        parts |= {"times": model.times, "scales": model.scales}
    if model.has_positions:
        # Differences from probe to probe, modulo 2^16: on a lattice they repeat, which zstd compresses well.
        parts["positions"] = np.diff(model.positions, axis=0, prepend=np.zeros((1, 3), np.uint16)).T
    text = json.dumps(header, separators=(",", ":")).encode()
    table = _table(_Header.model_validate(header), type(model.content))
    frame = zstd.compress(b"".join(_planes(parts[name]) for name in table))
    return _LENGTH.pack(len(text)) + text + frame


def decode(artifact: Artifact) -> ProbeModel:
    """Restores the model that `encode` stored, bit for bit, except that the input's hash keeps only 8 of 16 digits.
    Regions are not read. Raises a WlmError or ValueError if a setting or an array is missing or wrong, or they
    contradict each other."""
    name = check_settings(_NameHeader, artifact.settings, "setting ").name
    return unpack(artifact.tensors[BODY].tobytes(), name, artifact.pieces.get(_REGIONS))


def unpack(body: bytes, name: str, regions: Sequence[bytes] | None = None) -> ProbeModel:
    """Restores a model from what `pack` returned, and its regions, if it has any; errors as for `decode`."""
    start = _LENGTH.size + (_LENGTH.unpack_from(body)[0] if len(body) >= _LENGTH.size else len(body))
    if start > len(body):
        raise ValueError("expected a header and compressed arrays, found fewer bytes than the header's length")
    try:
        settings = json.loads(body[_LENGTH.size : start])
    except (ValueError, RecursionError) as error:
        raise ValueError("header: expected JSON, found other bytes") from error
    header = check_settings(_Header, settings, "setting ")
    if header.profile.method not in _METHODS:
        raise ValueError(f"setting method: expected {' or '.join(_METHODS)}, found {header.profile.method}")
    if header.live is not None and header.live >= header.probes:
        raise ValueError(f"setting live: expected fewer live probes than {header.probes}, found {header.live}")
    kind: type[Content] = _METHODS[header.profile.method] if regions is None else Regions
    table = _table(header, kind)
    stored = check_parts(_split(body[start:], table, len(body)), table)
    box = stored["box"]
    origin, extent, size = box[:3].copy(), float(box[3]), box[4:].copy()
    profile, outputs = header.profile, header.outputs
    if not (extent > 0 and (np.abs(box) <= _FARTHEST).all() and (size >= 0).all() and (size <= 1).all()):
        raise ValueError("part box: expected finite numbers, a longest side above 0, and relative sides from 0 to 1")
    dead = np.zeros(0, bool)
    if "dead" in table:
        dead = np.unpackbits(stored["dead"], count=header.probes).astype(bool)
        if int((~dead).sum()) != header.live:
            raise ValueError(f"part dead: expected to leave {header.live} live probes, found {int((~dead).sum())}")
    positions = np.zeros((0, 3), np.uint16)
    if "positions" in table:
        positions = np.cumsum(stored["positions"].T, axis=0, dtype=np.uint16)
    times, scales = stored.get("times", np.zeros(0)), stored.get("scales", np.ones(1))
    if not ((np.diff(times) > 0).all() and (times < DAY).all()):
        raise ValueError("part times: expected increasing hours of the day, from 0 to less than 24")
    content = kind.from_parts(profile, outputs, header.hours, stored, header.dropped)
    if isinstance(content, Regions):
        if regions is None or len(regions) != content.tree.count:
            raise ValueError(f"part {_REGIONS}: expected {content.tree.count} pieces, found {len(regions or ())}")
        content = replace(content, packed=regions, name=name)
    known = {"times": times, "scales": scales}
    place = {"origin": origin, "extent": extent, "size": size, "positions": positions}
    return ProbeModel(
        name, header.source, profile, header.probes, outputs, dead=dead, content=content, **place, **known
    )


def _table(header: _Header, kind: type[Content]) -> dict[str, Part]:
    """Returns the types and shapes of a file's arrays, by name."""
    live = header.probes if header.live is None else header.live
    table = {"box": Part(np.float64, (7,))}
    if header.live is not None:
        table["dead"] = Part(np.uint8, (-(-header.probes // 8),))
    if header.positions:
        table["positions"] = Part(np.uint16, (3, header.probes))
    if header.hours > 1:
        table["times"] = Part(np.float64, (header.hours,), least=0.0)
        table["scales"] = Part(np.float64, (header.hours,), least=0.0, most=1.0)
    if (numbers := header.hours * header.outputs) > NUMBERS:
        raise ValueError(f"setting hours: expected at most {NUMBERS} numbers of a probe at all hours, found {numbers}")
    return table | kind.table(header.profile, header.outputs, header.hours, header.count, live, header.clusters)


def _planes(part: np.ndarray) -> bytes:
    """Returns the bytes of an array, split into planes: first the lowest byte of every number, then the next bytes."""
    if part.dtype == np.int32:
        part = ((part << 1) ^ (part >> 31)).view(np.uint32)
    little = np.ascontiguousarray(part, part.dtype.newbyteorder("<"))
    return little.view(np.uint8).reshape(part.size, part.itemsize).T.tobytes()


def _split(frame: bytes, table: Mapping[str, Part], size: int) -> dict[str, np.ndarray]:
    """Decompresses a zstd frame of byte planes to a file's arrays, by name; `size` is the file's size in bytes."""
    sizes = {name: math.prod(part.shape) * np.dtype(part.dtype).itemsize for name, part in table.items()}
    total, most = sum(sizes.values()), _SURE + _PER_BYTE * size
    if total > most:
        raise ValueError(f"parts: expected at most {most} bytes of arrays in a file of {size} bytes, found {total}")
    data = np.frombuffer(zstd.decompress(frame, total, "parts"), np.uint8)
    result, at = {}, 0
    for name, part in table.items():
        dtype = np.dtype(part.dtype)
        planes = data[at : at + sizes[name]].reshape(dtype.itemsize, -1)
        at += sizes[name]
        numbers = np.ascontiguousarray(planes.T).reshape(-1)
        if dtype == np.int32:
            folded = numbers.view("<u4")
            numbers = (folded >> 1).astype(np.int32) ^ -(folded & 1).astype(np.int32)
        result[name] = numbers.view(dtype.newbyteorder("<")).reshape(part.shape)
    return result
