"""Packed Gaussians in files: a compact artifact whose body is, with fields as in `wlm.probe.fields`:

=========  ============================================================================================================
field      content
=========  ============================================================================================================
flags      U16: 64 times `GAUSSIANS`; 1024, 2048, 4096 and 8192 as there
N, D       as there
source     as there
dead       as there
profile    a length, and the settings that differ from the defaults of `wlm.probe.model.Profile`, JSON
K          Gaussians
dropped    a number of any size
frame      origin, extent, size of the box and gain, F64 x 8
positions  where they are stored a length, and codes along the box's axes as `places` there
steps      U16 x (15 + 2 L), upper halves of float32: of each number of a Gaussian, centre 3, log of the scale 3,
           rotation 3, latent L; of each row of the network's first layer, of its second and of its third
keys       a length, and what the numbers of bits leave open of the differences of keys: all their bits below the
           highest, the lowest first, one after the other in bytes from their lowest bits
stream     to the end; coded one after the other, each in one level: K x 1 numbers of bits of the differences of keys;
           1 x (9 + L), what is added to each number of a Gaussian; K x (6 + L), all but the centres; the three layers
=========  ============================================================================================================

Gaussians are in the order of their keys, the first of which is a difference from 0: bits of the centres' x, y and z in
turn, x in the lowest.
"""

import json
import struct
from typing import Any

import numpy as np

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.compact import BODY
from wlm.formats.limits import PROBES
from wlm.probe import fields
from wlm.probe.entropy import Shape, pack, unpack
from wlm.probe.index import morton_keys
from wlm.probe.model import ProbeModel, Profile, layer_shapes
from wlm.probe.packed import PLACE, SIZE, Packed
from wlm.probe.transform import Places, step_of
from wlm.probe.tree import flat
from wlm.system import Header

_KIND = fields.GAUSSIANS << fields.HEAD_SHIFT
_FRAME = struct.Struct("<8d")
_SETTINGS = 4096  # bytes of the profile
_KEY_BITS = 48
# Gaussians that a file may hold: those that are all alike have next to no bytes.
_SURE, _A_BYTE = 4096, 16


class _Settings(Header):
    profile: Profile


def most_gaussians(size: int) -> int:
    """Those that a file of so many bytes may hold."""
    return _SURE + _A_BYTE * size


def encode_gaussians(model: ProbeModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Settings, parts and source of the file of a model that has whole numbers."""
    packed = model.packed
    flags, dead = fields.pack_own(model.dead, None)
    settings = json.dumps(model.profile.changes(), separators=(",", ":")).encode()
    content = [fields.begin_bytes(flags | _KIND | fields.PLACED * model.has_positions, model), dead]
    content += [fields.number_bytes(len(settings)), settings, fields.number_bytes(model.count)]
    content += [fields.number_bytes(model.dropped), _FRAME.pack(*model.origin, model.extent, *model.size, model.gain)]
    if model.has_positions:
        positions = fields.pack_places(Places(model.origin, model.extent, model.positions))
        content += [fields.number_bytes(len(positions)), positions]
    content += [fields.step_bytes(step) for step in (*packed.step, *packed.net_step)]
    numbers = packed.gaussians
    added = np.rint(np.median(numbers, axis=0)).astype(np.int64)
    added[PLACE] = numbers[:, PLACE].min(0)
    change = np.diff(morton_keys(numbers[:, PLACE] - added[PLACE]).astype(np.int64), prepend=0)
    length, low = _split(change)
    stream = pack(
        (length[:, None], Shape(1, flat(len(length)))),
        (added[None], Shape(len(added), flat(1))),
        ((numbers - added)[:, SIZE.start :], Shape(len(added) - SIZE.start, flat(len(numbers)))),
        *((layer, Shape(layer.shape[1], flat(len(layer)))) for layer in packed.net),
    )
    content += [fields.number_bytes(len(low)), low, stream]
    return {}, {BODY: np.frombuffer(b"".join(content), np.uint8)}, ""


def decode_gaussians(artifact: Artifact) -> ProbeModel:
    """Makes the model of a file; what `encode_gaussians` gave comes back bit for bit, but for the name.

    Raises:
        WlmError, ValueError: The body is damaged.
    """
    body = artifact.tensors[BODY]
    reader = fields.Fields(body)
    flags, probes, outputs, source = reader.begin()
    known = _KIND | fields.OUTPUTS | fields.DEAD | fields.DEFLATED | fields.PLACED
    fields.check_flags(not flags & ~known and flags & (fields.DEAD | fields.DEFLATED) != fields.DEFLATED, flags)
    dead, _ = reader.own(flags & ~fields.PLACED, probes)
    profile = _profile(reader.take(reader.number("bytes", _SETTINGS)).tobytes())
    count = reader.number("Gaussians", min(PROBES, most_gaussians(len(body))))
    dropped = reader.number("dropped Gaussians", PROBES, 0)
    frame = np.array(reader.fields(_FRAME))
    positions = np.zeros((0, 3), np.uint16)
    if flags & fields.PLACED:
        positions = fields.unpack_places(frame[:4], reader.block(), probes).code
    latent = profile.latent
    halves = np.frombuffer(reader.take(2 * (15 + 2 * latent)).tobytes(), "<u2")
    steps = np.array([step_of(half) for half in halves.tolist()])
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        raise ValueError("part body: expected positive steps")
    low = reader.block()
    shapes = layer_shapes(latent, profile.hidden, outputs)
    try:
        length, added, rest, *net = unpack(
            reader.rest().tobytes(),
            Shape(1, flat(count)),
            Shape(9 + latent, flat(1)),
            Shape(6 + latent, flat(count)),
            *(Shape(columns, flat(rows)) for rows, columns in shapes),
        )
    except ValueError as error:
        raise ValueError(f"part body: {error}") from error
    centre = _centres(_joined(length[:, 0], low))
    numbers = np.concatenate([centre, rest], 1) + added
    packed = Packed(numbers, steps[: 9 + latent], tuple(net), steps[9 + latent :])
    return ProbeModel(
        name=fields.name_of(artifact),
        source=source,
        profile=profile,
        probes=probes,
        outputs=outputs,
        origin=frame[:3].copy(),
        extent=float(frame[3]),
        size=frame[4:7].copy(),
        gain=float(frame[7]),
        dead=dead,
        positions=positions,
        dropped=dropped,
        packed=packed,
        **packed.arrays(),
    )


def _profile(text: bytes) -> Profile:
    try:
        settings = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError("part body: expected settings as JSON") from error
    return check_settings(_Settings, {"profile": settings}, "setting ").profile


def _split(change: np.ndarray) -> tuple[np.ndarray, bytes]:
    """Numbers of bits of whole numbers, int64 [K], and their bits below the highest."""
    length = np.zeros(len(change), np.int64)
    for bit in range(_KEY_BITS):
        length[change >> bit > 0] = bit + 1
    bits = change[:, None] >> np.arange(_KEY_BITS - 1) & 1
    open_bits = np.arange(_KEY_BITS - 1) < length[:, None] - 1
    return length, np.packbits(bits[open_bits].astype(np.uint8), bitorder="little").tobytes()


def _joined(length: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Undoes `_split`, and sums: keys, int64 [K]."""
    if length.min() < 0 or length.max() > _KEY_BITS:
        raise ValueError(f"part body: expected keys of at most {_KEY_BITS} bits")
    open_bits = np.arange(_KEY_BITS - 1) < length[:, None] - 1
    count = int(open_bits.sum())
    if len(low) != -(-count // 8):
        raise ValueError(f"part body: expected {-(-count // 8)} bytes of keys, found {len(low)}")
    bits = np.zeros(open_bits.shape, np.int64)
    bits[open_bits] = np.unpackbits(low, count=count, bitorder="little")
    change = (bits << np.arange(_KEY_BITS - 1)).sum(1)
    change[length > 0] |= 1 << (length[length > 0] - 1)
    # Sums of whole numbers as floats tell what would be too large for them.
    if np.cumsum(change.astype(np.float64))[-1] >= 2.0**_KEY_BITS:
        raise ValueError(f"part body: expected keys of at most {_KEY_BITS} bits")
    return np.cumsum(change)


def _centres(key: np.ndarray) -> np.ndarray:
    """The places of keys, int64 [K, 3]: undoes `wlm.probe.index.morton_keys`."""
    centre = np.zeros((len(key), 3), np.int64)
    for bit in range(_KEY_BITS // 3):
        centre |= (key[:, None] >> 3 * bit + np.arange(3) & 1) << bit
    return centre
