"""Transforms in files: a compact artifact whose body is some twenty bytes, and the coded numbers.

`wlm.probe.fields` has its table.

Earlier files are safetensors: `light` is step F32, CRC-32 U32, words of the directions U16, V U8, flags U8, then the
directions, the numbers, and in the last `dead` bytes the dead probes' bits, deflated. `places` and `frame` are apart.
"""

import struct
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.compact import BODY
from wlm.formats.deflate import inflate
from wlm.formats.limits import NUMBERS, PROBES
from wlm.formats.parts import Part, check_part, check_parts
from wlm.probe import fields
from wlm.probe.transform import Head, Places, TransformModel, step_of
from wlm.probe.tree import RADII
from wlm.system import Header, Name

_LIGHT, _PLACES, _FRAME = "light", "places", "frame"
_EARLIER = struct.Struct("<fIHBB")


class _EarlierHeader(Header):
    """The settings of an earlier file."""

    name: Name
    probes: int = Field(ge=1, le=PROBES)
    outputs: int = Field(fields.L2, ge=1, le=NUMBERS)
    dead: int = Field(0, ge=0, le=2 * PROBES)


_EARLIER_PARTS = {
    _LIGHT: Part(np.uint8, (None,)),
    _PLACES: Part(np.uint8, (None,), optional=True),
    _FRAME: Part(np.float64, (4,), optional=True, least=-fields.FARTHEST, most=fields.FARTHEST),
}


def is_transform(artifact: Artifact) -> bool:
    """Whether a probe file is one of a transform."""
    return BODY in artifact.tensors or _LIGHT in artifact.tensors


def encode_transform(model: TransformModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Settings, parts and source of a model's file; of one from an earlier file as it was."""
    if model.head.words is not None:
        return _encode_earlier(model)
    return {}, {BODY: np.frombuffer(encode_body(model), np.uint8)}, ""


def decode_transform(artifact: Artifact) -> TransformModel:
    """Makes the model of a file; what `encode_transform` gave comes back bit for bit, but for the name.

    Raises:
        WlmError, ValueError: A setting or a part is missing or wrong, or they don't fit each other.
    """
    if BODY in artifact.tensors:
        model = decode_body(fields.name_of(artifact), artifact.tensors[BODY])
    else:
        model = _decode_earlier(artifact)
    if model.places is not None:
        # What can be unpacked here is, so that whatever is wrong with it is said of the file.
        _ = model.stored_values
    return model


def encode_body(model: TransformModel) -> bytes:
    """The bytes of the module's table."""
    head = model.head
    flags, own = fields.pack_own(model.dead, model.places)
    pieces = [fields.begin_bytes(fields.head_flags(head) | flags, model), own, fields.step_bytes(head.step)]
    if model.places is None:
        pieces.append(fields.CHECK.pack(head.check))
    return b"".join([*pieces, model.stream.tobytes()])


def decode_body(name: str, body: np.ndarray) -> TransformModel:
    """Undoes `encode_body`; the model is called `name`.

    Raises:
        ValueError: It is damaged.
    """
    reader = fields.Fields(body)
    flags, probes, outputs, source = reader.begin()
    fields.check_flags(flags & (fields.DEAD | fields.DEFLATED) != fields.DEFLATED, flags)
    dead, places = reader.own(flags, probes)
    step = step_of(reader.fields(fields.SHORT)[0])
    check = reader.check(places)
    stream = reader.rest()
    head = fields.head_of(flags, step, check).checked(outputs, len(stream))
    fields.check_counts(probes, outputs, [dead], len(stream))
    return TransformModel(name, source, probes, outputs, dead, head, stream, places)


def pack_piece(dead: np.ndarray, places: Places | None, check: int, grid: int, stream: np.ndarray) -> bytes:
    """The bytes of a region: flags U8, those of the table's from 2048 on, over 2048; then dead, places, check, stream.

    Args:
        dead: bool [n], of the region's probes, empty if there are none; nothing is stored of it without places.
        places: Of the region, where they are stored.
        check, grid: Of the region's places.
        stream: The numbers.
    """
    flags, own = fields.pack_own(dead, places) if places is not None else (0, fields.CHECK.pack(check))
    return bytes([(flags | grid << fields.GRID_SHIFT) // fields.DEAD]) + own + stream.tobytes()


def parse_piece(
    data: np.ndarray, probes: int, outputs: int, dead: np.ndarray | None
) -> tuple[np.ndarray, Places | None, int, int, np.ndarray]:
    """Undoes `pack_piece`: dead probes, places, check, grid and stream.

    Args:
        data: uint8 [B].
        probes, outputs: Of the region.
        dead: Which probes are dead, where the file has no places.

    Raises:
        ValueError: It is damaged.
    """
    reader = fields.Fields(data)
    flags = int(reader.take(1)[0]) * fields.DEAD
    grid = flags >> fields.GRID_SHIFT
    if grid >= len(RADII) or flags & fields.GRIDLESS not in (
        0,
        fields.PLACED,
        fields.PLACED | fields.DEAD,
        fields.PLACED | fields.DEAD | fields.DEFLATED,
    ):
        raise ValueError(f"expected known flags, found {flags // fields.DEAD}")
    own, places = reader.own(flags, probes)
    check = reader.check(places)
    if places is None and dead is not None:
        own = dead
    stream = reader.rest()
    fields.check_counts(probes, outputs, [own], len(stream))
    return own, places, check, grid, stream


def pack_labels(labels: np.ndarray) -> np.ndarray:
    """Regions of probes, int [N], deflated: all low bytes, then all high ones; uint8."""
    planes = labels.astype("<u2").view(np.uint8).reshape(-1, 2).T
    return np.frombuffer(zlib.compress(planes.tobytes(), 9), np.uint8)


def unpack_labels(packed: np.ndarray, probes: int) -> np.ndarray:
    """int64 [N]."""
    data = inflate(packed.tobytes(), 2 * probes, "part order", f"the regions of {probes} probes")
    planes = np.frombuffer(data, np.uint8).reshape(2, probes)
    return planes[0].astype(np.int64) | planes[1].astype(np.int64) << 8


def _encode_earlier(model: TransformModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    settings: dict[str, Any] = {"name": model.name, "probes": model.probes}
    if model.outputs != fields.L2:
        settings["outputs"] = model.outputs
    dead = fields.pack_dead(model.dead)
    if len(dead):
        settings["dead"] = len(dead)
    head = model.head
    begin = _EARLIER.pack(head.step, head.check, head.words, head.vectors, head.flags)
    parts = {_LIGHT: np.concatenate([np.frombuffer(begin, np.uint8), model.stream, dead])}
    if model.places is not None:
        parts[_PLACES] = np.frombuffer(fields.pack_places(model.places), np.uint8)
        parts[_FRAME] = np.array([*model.places.origin, model.places.extent], np.float64)
    return settings, parts, model.source


def _decode_earlier(artifact: Artifact) -> TransformModel:
    header = check_settings(_EarlierHeader, artifact.settings, "setting ")
    parts = check_parts(artifact.tensors, _EARLIER_PARTS)
    light = parts[_LIGHT]
    end = len(light) - header.dead
    if end < _EARLIER.size:
        expected = _EARLIER.size + header.dead
        raise ValueError(f"part light: expected at least {expected} bytes, found {len(light)}")
    step, check, words, vectors, flags = _EARLIER.unpack(light[: _EARLIER.size].tobytes())
    stream = light[_EARLIER.size : end]
    head = Head(step, check, vectors, flags, 0, words).checked(header.outputs, len(stream))
    dead = fields.unpack_dead(light[end:], header.probes)
    fields.check_counts(header.probes, header.outputs, [dead], len(stream))
    places = None
    if parts[_PLACES].size:
        frame = check_part(artifact.tensors, _FRAME, replace(_EARLIER_PARTS[_FRAME], optional=False))
        places = fields.unpack_places(frame, parts[_PLACES], header.probes)
    elif parts[_FRAME].size:
        raise ValueError("part frame: expected none without places")
    return TransformModel(header.name, artifact.source, header.probes, header.outputs, dead, head, stream, places)
