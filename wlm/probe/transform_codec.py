"""Transforms in files: a compact artifact whose body is some twenty bytes, and the coded numbers.

The body, little-endian, with whole numbers of any size in 7 bits a byte, the lowest first, 128 added to all but the
last byte:

==============  =======================================================================================================
field           content
==============  =======================================================================================================
flags           U16: stored directions; 64 times `Head.flags`, or `HOURS` (`wlm.probe.day_codec`); 1024 where D follows,
                which else is 27; 2048 where there are dead probes; 4096 where their bits are deflated; 8192 where
                places are stored; 16384 times the tree's place in `RADII`
N, D            numbers of any size; D if it isn't 27
source          the first 4 digits of the input's hash, as 2 bytes
dead            a bit for each probe, the first in the highest bit of the first byte; or a length and these deflated
places          origin and extent, F64 x 4; a length and along each axis in turn the differences of codes from probe to
                probe modulo 2^16, all low bytes and then all high ones, deflated
step            U16, the upper half of a float32
check           CRC-32 of the codes of places (U16, probe by probe), U32; left out where places are stored
stream          to the end
==============  =======================================================================================================

Earlier files are safetensors: `light` is step F32, CRC-32 U32, words of the directions U16, V U8, flags U8, then the
directions, the numbers, and in the last `dead` bytes the dead probes' bits, deflated. `places` and `frame` are apart.
"""

import struct
import zlib
from collections.abc import Sequence
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
from wlm.probe.transform import SOURCE, Head, Places, Transform, TransformModel, step_of
from wlm.probe.tree import RADII
from wlm.system import Header, Name

_LIGHT, _PLACES, _FRAME = "light", "places", "frame"
L2 = 27  # numbers of a probe that a file doesn't state
_EARLIER = struct.Struct("<fIHBB")
CORNERS = struct.Struct("<4d")
CHECK = struct.Struct("<I")
SHORT = struct.Struct("<H")
HOURS = 15  # in place of a kind
DIRECTIONS, KIND = 63, 15  # masks
HEAD_SHIFT, _GRID_SHIFT = 6, 14
OUTPUTS, DEAD, DEFLATED, PLACED = (1 << bit for bit in range(10, 14))
_GRIDLESS = (1 << _GRID_SHIFT) - 1
_LONGEST = 5  # bytes of a whole number
FARTHEST = 1e150
# Numbers that a transform may unpack to: those of a set without any light have next to no bytes.
_SURE_NUMBERS, _NUMBERS_A_BYTE = 1 << 23, 4096
# Live probes of it: each takes some 20 microseconds and 500 bytes to place among the others.
_SURE_PROBES, _PROBES_A_BYTE = 1 << 17, 16


class _EarlierHeader(Header):
    """The settings of an earlier file."""

    name: Name
    probes: int = Field(ge=1, le=PROBES)
    outputs: int = Field(L2, ge=1, le=NUMBERS)
    dead: int = Field(0, ge=0, le=2 * PROBES)


class _NameHeader(Header):
    name: Name = ""


_EARLIER_PARTS = {
    _LIGHT: Part(np.uint8, (None,)),
    _PLACES: Part(np.uint8, (None,), optional=True),
    _FRAME: Part(np.float64, (4,), optional=True, least=-FARTHEST, most=FARTHEST),
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
        model = decode_body(name_of(artifact), artifact.tensors[BODY])
    else:
        model = _decode_earlier(artifact)
    if model.places is not None:
        # What can be unpacked here is, so that whatever is wrong with it is said of the file.
        _ = model.stored_values
    return model


def name_of(artifact: Artifact) -> str:
    """The name of a compact file's model."""
    return check_settings(_NameHeader, artifact.settings, "setting ").name


def encode_body(model: TransformModel) -> bytes:
    """The bytes of the module's table."""
    head = model.head
    flags, own = pack_own(model.dead, model.places)
    pieces = [begin_bytes(head_flags(head) | flags, model), own, step_bytes(head.step)]
    if model.places is None:
        pieces.append(CHECK.pack(head.check))
    return b"".join([*pieces, model.stream.tobytes()])


def decode_body(name: str, body: np.ndarray) -> TransformModel:
    """Undoes `encode_body`; the model is called `name`.

    Raises:
        ValueError: It is damaged.
    """
    reader = Fields(body)
    flags, probes, outputs, source = reader.begin()
    check_flags(flags & (DEAD | DEFLATED) != DEFLATED, flags)
    dead, places = reader.own(flags, probes)
    step = step_of(reader.fields(SHORT)[0])
    check = reader.check(places)
    stream = reader.rest()
    head = head_of(flags, step, check).checked(outputs, len(stream))
    check_counts(probes, outputs, [dead], len(stream))
    return TransformModel(name, source, probes, outputs, dead, head, stream, places)


def pack_piece(dead: np.ndarray, places: Places | None, check: int, grid: int, stream: np.ndarray) -> bytes:
    """The bytes of a region: flags U8, those of the table's from 2048 on, over 2048; then dead, places, check, stream.

    Args:
        dead: bool [n], of the region's probes, empty if there are none; nothing is stored of it without places.
        places: Of the region, where they are stored.
        check, grid: Of the region's places.
        stream: The numbers.
    """
    flags, own = pack_own(dead, places) if places is not None else (0, CHECK.pack(check))
    return bytes([(flags | grid << _GRID_SHIFT) // DEAD]) + own + stream.tobytes()


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
    reader = Fields(data)
    flags = int(reader.take(1)[0]) * DEAD
    grid = flags >> _GRID_SHIFT
    if grid >= len(RADII) or flags & _GRIDLESS not in (0, PLACED, PLACED | DEAD, PLACED | DEAD | DEFLATED):
        raise ValueError(f"expected known flags, found {flags // DEAD}")
    own, places = reader.own(flags, probes)
    check = reader.check(places)
    if places is None and dead is not None:
        own = dead
    stream = reader.rest()
    check_counts(probes, outputs, [own], len(stream))
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


def pack_dead(dead: np.ndarray) -> np.ndarray:
    """A bit for each probe, bool [N], deflated; uint8, empty where none is dead."""
    packed = zlib.compress(np.packbits(dead).tobytes(), 9) if dead.any() else b""
    return np.frombuffer(packed, np.uint8)


def unpack_dead(packed: np.ndarray, probes: int) -> np.ndarray:
    """bool [N], or empty where none is dead."""
    if not packed.size:
        return np.zeros(0, bool)
    size = -(-probes // 8)
    bits = inflate(packed.tobytes(), size, "part dead", f"a bit for each of {probes} probes")
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=probes).astype(bool)


class Fields:
    """The fields of a body, one after the other."""

    def __init__(self, body: np.ndarray) -> None:
        self._body, self._at = body, 0

    def take(self, count: int) -> np.ndarray:
        if count > len(self._body) - self._at:
            raise ValueError(f"part {BODY}: expected {count} bytes at byte {self._at}, found fewer")
        self._at += count
        return self._body[self._at - count : self._at]

    def rest(self) -> np.ndarray:
        return self.take(len(self._body) - self._at)

    def fields(self, layout: struct.Struct) -> tuple:
        return layout.unpack(self.take(layout.size).tobytes())

    def begin(self) -> tuple[int, int, int, str]:
        """Flags, N, D and source."""
        flags = self.fields(SHORT)[0]
        probes = self.number("probes", PROBES)
        outputs = self.number("numbers of a probe", NUMBERS) if flags & OUTPUTS else L2
        return flags, probes, outputs, self.take(SOURCE // 2).tobytes().hex()

    def block(self) -> np.ndarray:
        """A length, and so many bytes."""
        return self.take(self.number("bytes", len(self._body), 0))

    def check(self, places: Places | None) -> int:
        """That of places, which is here where they aren't."""
        return self.fields(CHECK)[0] if places is None else places.check

    def own(self, flags: int, probes: int) -> tuple[np.ndarray, Places | None]:
        """Dead probes and places."""
        dead = np.zeros(0, bool)
        if flags & DEFLATED:
            dead = unpack_dead(self.take(self.number("bytes", 2 * PROBES)), probes)
        elif flags & DEAD:
            dead = np.unpackbits(self.take(-(-probes // 8)), count=probes).astype(bool)
        if not flags & PLACED:
            return dead, None
        corner = np.array(self.fields(CORNERS))
        if not (np.abs(corner) <= FARTHEST).all():
            raise ValueError(f"part places: expected an origin and an extent within {FARTHEST:g}")
        return dead, _unpack_places(corner, self.take(self.number("bytes", 8 * PROBES)), probes)

    def number(self, what: str, most: int, least: int = 1) -> int:
        value = 0
        for place in range(_LONGEST):
            byte = int(self.take(1)[0])
            value |= (byte & 127) << 7 * place
            if byte < 128:
                break
        if not least <= value <= most or byte >= 128 or (byte == 0 and place):
            raise ValueError(f"part {BODY}: expected {least} to {most} {what}, found {value}")
        return value


def begin_bytes(flags: int, model: Transform) -> bytes:
    """Flags, to which that of D is added, N, D and source."""
    pieces = [SHORT.pack(flags | OUTPUTS * (model.outputs != L2)), number_bytes(model.probes)]
    if model.outputs != L2:
        pieces.append(number_bytes(model.outputs))
    return b"".join([*pieces, bytes.fromhex(model.source)])


def head_flags(head: Head) -> int:
    """What flags say of a head."""
    return head.vectors | head.flags << HEAD_SHIFT | head.grid << _GRID_SHIFT


def head_of(flags: int, step: float, check: int) -> Head:
    """Undoes `head_flags`."""
    return Head(step, check, flags & DIRECTIONS, flags >> HEAD_SHIFT & KIND, flags >> _GRID_SHIFT)


def check_flags(known: bool, flags: int) -> None:
    """Refuses flags that aren't known."""
    if not known:
        raise ValueError(f"part {BODY}: expected known flags, found {flags}")


def step_bytes(step: float) -> bytes:
    """A step as files hold it."""
    return SHORT.pack(int(np.array(step, np.float32).view(np.uint32)) >> 16)


def pack_own(dead: np.ndarray, places: Places | None) -> tuple[int, bytes]:
    """Flags and bytes of dead probes and places."""
    flags, result = 0, b""
    if dead.any():
        flags |= DEAD
        bits, deflated = np.packbits(dead).tobytes(), pack_dead(dead).tobytes()
        if len(bits) > len(deflated) + len(number_bytes(len(deflated))):
            flags |= DEFLATED
            bits = number_bytes(len(deflated)) + deflated
        result += bits
    if places is not None:
        flags |= PLACED
        packed = _pack_places(places)
        result += CORNERS.pack(*places.origin, places.extent) + number_bytes(len(packed)) + packed
    return flags, result


def number_bytes(value: int) -> bytes:
    result = bytearray()
    while value >= 128:
        result.append(value & 127 | 128)
        value >>= 7
    return bytes([*result, value])


def _pack_places(places: Places) -> bytes:
    change = np.diff(places.code.astype(np.uint16), axis=0, prepend=np.zeros((1, 3), np.uint16))
    # Axis by axis, low bytes and then high ones: those of a lattice repeat.
    planes = np.ascontiguousarray(change.T.astype("<u2")).view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)
    return zlib.compress(planes.tobytes(), 9)


def _unpack_places(frame: np.ndarray, packed: np.ndarray, probes: int) -> Places:
    data = inflate(packed.tobytes(), 6 * probes, "part places", f"the places of {probes} probes")
    planes = np.frombuffer(data, np.uint8).reshape(3, 2, probes).transpose(0, 2, 1)
    change = np.ascontiguousarray(planes).view("<u2")[..., 0].T
    if not frame[3] > 0:
        raise ValueError(f"part frame: expected a positive extent, found {frame[3]:g}")
    return Places(frame[:3].copy(), float(frame[3]), np.cumsum(change, axis=0, dtype=np.uint16))


def check_numbers(probes: int, outputs: int, size: int) -> None:
    """Checks that so many bytes may be so many probes of so many numbers, of all hours."""
    most = _SURE_NUMBERS + _NUMBERS_A_BYTE * size
    if probes * outputs > most:
        numbers = f"{probes} probes of {outputs} numbers"
        raise ValueError(f"part light: expected at most {most} numbers of {size} bytes, found {numbers}")


def check_counts(probes: int, outputs: int, dead: Sequence[np.ndarray], size: int) -> None:
    """Checks that so many bytes may be so many probes, of which each hour's dead ones are given."""
    check_numbers(probes, outputs * len(dead), size)
    live, most = [probes - int(each.sum()) for each in dead], _SURE_PROBES + _PROBES_A_BYTE * size
    if min(live) < 1 or sum(live) > most:
        found = sum(live) if min(live) else 0
        raise ValueError(f"part light: expected 1 to {most} live probes of {size} bytes, found {found}")


def _encode_earlier(model: TransformModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    settings: dict[str, Any] = {"name": model.name, "probes": model.probes}
    if model.outputs != L2:
        settings["outputs"] = model.outputs
    dead = pack_dead(model.dead)
    if len(dead):
        settings["dead"] = len(dead)
    head = model.head
    begin = _EARLIER.pack(head.step, head.check, head.words, head.vectors, head.flags)
    parts = {_LIGHT: np.concatenate([np.frombuffer(begin, np.uint8), model.stream, dead])}
    if model.places is not None:
        parts[_PLACES] = np.frombuffer(_pack_places(model.places), np.uint8)
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
    dead = unpack_dead(light[end:], header.probes)
    check_counts(header.probes, header.outputs, [dead], len(stream))
    places = None
    if parts[_PLACES].size:
        frame = check_part(artifact.tensors, _FRAME, replace(_EARLIER_PARTS[_FRAME], optional=False))
        places = _unpack_places(frame, parts[_PLACES], header.probes)
    elif parts[_FRAME].size:
        raise ValueError("part frame: expected none without places")
    return TransformModel(header.name, artifact.source, header.probes, header.outputs, dead, head, stream, places)
