"""Probe sets of many regions in files: a compact artifact read piece by piece.

The head, with fields as in `wlm.probe.fields`:

===========  ==========================================================================================================
field        content
===========  ==========================================================================================================
flags        U16, of these but for dead probes: 8192 where each region has its places
N, D         as there
source       as there
frame        origin and extent of all places, F64 x 4
step         U16
directions   a length and the directions, coded by themselves; where there are some
R            regions
split        U8 x (2 R - 1), the axis of a plane, 3 for a region: after a plane all that is below it, then the rest;
             U16 x (R - 1), codes of the planes
order        length U32 and digest, 4 bytes of BLAKE2b, of what comes first in the data: with places the region of each
             probe (U16, all low bytes, then all high ones), without them the dead probes' bits, both deflated
regions      for each length U32, digest, probes U32, and codes of the lowest and highest corner of live ones U16 x 6
===========  ==========================================================================================================

The data is `order`, then the regions: see `wlm.probe.transform_codec.pack_piece`.
"""

import struct
from typing import Any

import numpy as np

from wlm.formats.artifact import Artifact
from wlm.formats.compact import DATA, HEAD
from wlm.formats.limits import NUMBERS
from wlm.probe import fields
from wlm.probe.entropy import Shape, pack, unpack
from wlm.probe.regions import Piece, RegionModel, Split
from wlm.probe.transform import step_of
from wlm.probe.tree import flat

_REGIONS = 1 << 16
_ORDER = struct.Struct("<I4s")
_PIECE = struct.Struct("<I4sI6H")


def encode_regions(model: RegionModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Settings, parts and source of a model's file."""
    head = model.head
    pieces = [fields.begin_bytes(fields.head_flags(head) | fields.PLACED * model.has_positions, model)]
    pieces += [fields.CORNERS.pack(*model.origin, model.extent), fields.step_bytes(head.step)]
    if model.directions is not None:
        vectors = np.rint(model.directions * head.fineness).astype(np.int64)
        code = pack((vectors, Shape(model.outputs, flat(len(vectors)))))
        pieces += [fields.number_bytes(len(code)), code]
    pieces += [
        fields.number_bytes(model.split.regions),
        model.split.axis.tobytes(),
        model.split.plane.astype("<u2").tobytes(),
    ]
    pieces.append(_ORDER.pack(len(model.order), model.order_digest))
    for piece in model.pieces:
        pieces.append(_PIECE.pack(len(piece.data), piece.digest, piece.probes, *piece.box.ravel().tolist()))
    data = [model.order, *(piece.data for piece in model.pieces)]
    return {}, {HEAD: np.frombuffer(b"".join(pieces), np.uint8), DATA: np.concatenate(data)}, ""


def decode_regions(artifact: Artifact) -> RegionModel:
    """Makes the model of a file; what `encode_regions` gave comes back bit for bit, but for the name.

    Raises:
        ValueError: The head is damaged, or doesn't fit the data.
    """
    reader, data = fields.Fields(artifact.tensors[HEAD]), artifact.tensors[DATA]
    flags, probes, outputs, source = reader.begin()
    if flags & ~(fields.DIRECTIONS | fields.KIND << fields.HEAD_SHIFT | fields.OUTPUTS | fields.PLACED):
        raise ValueError(f"part {HEAD}: expected known flags, found {flags}")
    frame = np.array(reader.fields(fields.CORNERS))
    if not ((np.abs(frame) <= fields.FARTHEST).all() and frame[3] > 0):
        raise ValueError(f"part {HEAD}: expected an origin and a positive extent within {fields.FARTHEST:g}")
    head = fields.head_of(flags, step_of(reader.fields(fields.SHORT)[0]), 0).checked(outputs, len(data))
    directions = None
    if head.vectors:
        code = reader.take(reader.number("bytes", 16 * NUMBERS * NUMBERS)).tobytes()
        directions = unpack(code, Shape(outputs, flat(head.vectors)))[0] / head.fineness
    regions = reader.number("regions", min(_REGIONS, probes))
    axis = reader.take(2 * regions - 1)
    split = Split(axis, np.frombuffer(reader.take(2 * regions - 2).tobytes(), "<u2"))
    if not split.is_whole():
        raise ValueError(f"part {HEAD}: expected planes that part {regions} regions")
    end, order_digest = reader.fields(_ORDER)
    order, pieces = data[:end], []
    for _ in range(regions):
        size, digest, count, *box = reader.fields(_PIECE)
        pieces.append(Piece(data[end : end + size], digest, count, np.array(box, np.uint16).reshape(2, 3)))
        end += size
    if end != len(data) or len(reader.rest()):
        raise ValueError(f"part {DATA}: expected {end} bytes, found {len(data)}")
    if sum(piece.probes for piece in pieces) != probes:
        raise ValueError(f"part {HEAD}: expected regions of {probes} probes in all")
    fields.check_counts(probes, outputs, [np.zeros(0, bool)], len(data))
    return RegionModel(
        name=fields.name_of(artifact),
        source=source,
        probes=probes,
        outputs=outputs,
        has_positions=bool(flags & fields.PLACED),
        origin=frame[:3].copy(),
        extent=float(frame[3]),
        split=split,
        head=head,
        directions=directions,
        order=order,
        order_digest=order_digest,
        pieces=tuple(pieces),
    )
