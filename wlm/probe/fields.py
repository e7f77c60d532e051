"""The fields of compact probe files, which those of one region, of many and of several hours are made of.

The body of one region and one hour, little-endian, with whole numbers of any size in 7 bits a byte, the lowest first,
128 added to all but the last byte:

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
"""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.compact import BODY
from wlm.formats.deflate import inflate
from wlm.formats.limits import NUMBERS, PROBES
from wlm.probe.transform import SOURCE, Head, Places, Transform
from wlm.system import Header, Name

L2 = 27  # numbers of a probe that a file doesn't state
CORNERS = struct.Struct("<4d")
CHECK = struct.Struct("<I")
SHORT = struct.Struct("<H")
HOURS, GAUSSIANS = 15, 14  # in place of a kind
DIRECTIONS, KIND = 63, 15  # masks
HEAD_SHIFT, GRID_SHIFT = 6, 14
OUTPUTS, DEAD, DEFLATED, PLACED = (1 << bit for bit in range(10, 14))
GRIDLESS = (1 << GRID_SHIFT) - 1
_LONGEST = 5  # bytes of a whole number
FARTHEST = 1e150
# Numbers that a transform may unpack to: those of a set without any light have next to no bytes.
_SURE_NUMBERS, _NUMBERS_A_BYTE = 1 << 23, 4096
# Live probes of it: each takes some 20 microseconds and 500 bytes to place among the others.
_SURE_PROBES, _PROBES_A_BYTE = 1 << 17, 16


class _NameHeader(Header):
    name: Name = ""


def is_of(artifact: Artifact, kind: int) -> bool:
    """Whether a probe file has a body of a kind, `HOURS` or `GAUSSIANS`."""
    begin = artifact.tensors.get(BODY, np.zeros(0, np.uint8))[: SHORT.size]
    return len(begin) == SHORT.size and SHORT.unpack(begin.tobytes())[0] >> HEAD_SHIFT & KIND == kind


def name_of(artifact: Artifact) -> str:
    """The name of a compact file's model."""
    return check_settings(_NameHeader, artifact.settings, "setting ").name


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
        return dead, unpack_places(corner, self.take(self.number("bytes", 8 * PROBES)), probes)

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
    return head.vectors | head.flags << HEAD_SHIFT | head.grid << GRID_SHIFT


def head_of(flags: int, step: float, check: int) -> Head:
    """Undoes `head_flags`."""
    return Head(step, check, flags & DIRECTIONS, flags >> HEAD_SHIFT & KIND, flags >> GRID_SHIFT)


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
        packed = pack_places(places)
        result += CORNERS.pack(*places.origin, places.extent) + number_bytes(len(packed)) + packed
    return flags, result


def number_bytes(value: int) -> bytes:
    result = bytearray()
    while value >= 128:
        result.append(value & 127 | 128)
        value >>= 7
    return bytes([*result, value])


def pack_places(places: Places) -> bytes:
    change = np.diff(places.code.astype(np.uint16), axis=0, prepend=np.zeros((1, 3), np.uint16))
    # Axis by axis, low bytes and then high ones: those of a lattice repeat.
    planes = np.ascontiguousarray(change.T.astype("<u2")).view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)
    return zlib.compress(planes.tobytes(), 9)


def unpack_places(frame: np.ndarray, packed: np.ndarray, probes: int) -> Places:
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
