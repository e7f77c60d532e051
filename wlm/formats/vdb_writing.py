"""Writing of OpenVDB's `.vdb` files (version 224), which Blender and Houdini read; `wlm.formats.vdb` names the format.

Voxels other than 0 are active and are stored, compressed by zlib; all others are the background, 0.
"""

import hashlib
import struct
import zlib
from collections.abc import Sequence

import numpy as np

from wlm.formats.vdb import ACTIVE_MASK, LEAF, LOWER, MAGIC, NEWEST, UPPER, ZIP

_LIBRARY = (10, 0)  # the version of OpenVDB that states this version of the format


def encode_vdb(grids: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> bytes:
    """Returns the content of a file of grids. `grids` has for each its name; its values [X, Y, Z], or vectors [X, Y, Z,
    3], stored as halves if they are float16 and as float32 otherwise; and its transform, [4, 4], from indices of voxel
    centres to world space."""
    parts = [struct.pack("<2I", 0, len(grids))]
    size = 57 + len(parts[0])  # of what is before the next grid
    for name, values, matrix in grids:
        vectors, half = values.ndim == 4, values.dtype == np.float16
        kind = f"Tree_{'vec3s' if vectors else 'float'}_5_4_3" + "_HalfFloat" * half
        meta = [("name", "string", name.encode()), ("is_saved_as_half_float", "bool", bytes([half]))]
        meta.append(("class", "string", b"unknown" if vectors else b"fog volume"))
        head = struct.pack("<2I", ZIP | ACTIVE_MASK, len(meta))
        head += b"".join(_text(key) + _text(form) + struct.pack("<I", len(data)) + data for key, form, data in meta)
        head += _text("AffineMap") + np.asarray(matrix, "<f8").T.tobytes()  # for row vectors
        topology, leaves = _tree(values if half else values.astype("<f4", copy=False))
        lead = _text(name) + _text(kind) + _text("")
        begin = size + len(lead) + 24
        ends = np.cumsum([begin, len(head) + len(topology), len(leaves)])
        parts += [lead, struct.pack("<3q", *ends), head, topology, leaves]
        size = int(ends[-1])
    body = b"".join(parts)
    digest = hashlib.blake2b(body, digest_size=16).hexdigest()
    uuid = "-".join((digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:]))
    return struct.pack("<qIII?", MAGIC, NEWEST, *_LIBRARY, True) + uuid.encode() + body


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask.ravel(), bitorder="little").tobytes()


def occupied_leaves(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cuts values [X, Y, Z] or [X, Y, Z, C] into leaves of 8^3 voxels.

    Returns, for each leaf with a voxel other than 0, in the order of x, y, z: its place, int64 [N, 3] in leaves; its
    values, [N, 8, 8, 8] or [N, 8, 8, 8, C]; and which of its voxels are not 0, bool [N, 8, 8, 8].
    """
    channels = values.shape[3:]
    padded = np.pad(values, [(0, -n % LEAF) for n in values.shape[:3]] + [(0, 0)] * len(channels))
    x, y, z = (n // LEAF for n in padded.shape[:3])
    cut = np.moveaxis(padded.reshape(x, LEAF, y, LEAF, z, LEAF, *channels), (2, 4), (1, 2))
    active = (cut.reshape(x, y, z, LEAF, LEAF, LEAF, -1) != 0).any(-1)
    some = active.any((3, 4, 5))
    return np.argwhere(some), cut[some], active[some]


def _tree(values: np.ndarray) -> tuple[bytes, bytes]:
    """Returns the topology of a tree, and the values of its leaves."""
    half, (places, cubes, active), leaves = values.dtype == np.float16, occupied_leaves(values), []
    uppers = np.unique(places // (LOWER * UPPER), axis=0)
    # The number of buffers of a leaf, the background, and the number of tiles of the root.
    topology = [struct.pack("<I", 1), bytes(values[0, 0, 0].size * 4), struct.pack("<2I", 0, len(uppers))]
    for upper in uppers:
        within = places[(places // (LOWER * UPPER) == upper).all(1)]
        topology += [struct.pack("<3i", *(upper * LOWER * UPPER * LEAF)), _node(within // LOWER % UPPER, UPPER, half)]
        for lower in np.unique(within // LOWER, axis=0):
            inside = np.flatnonzero((places // LOWER == lower).all(1))
            topology.append(_node(places[inside] % LOWER, LOWER, half))
            for i in inside:
                mask, data = _bits(active[i]), cubes[i][active[i]].tobytes()
                packed = zlib.compress(data, 1)
                size = len(packed) if len(packed) < len(data) else -len(data)
                topology.append(mask)
                leaves += [mask, b"\0", struct.pack("<q", size), packed if size > 0 else data]
    return b"".join(topology), b"".join(leaves)


def _node(children: np.ndarray, side: int, half: bool) -> bytes:
    """Returns an inner node without tiles: masks of its children and of active tiles, and no values."""
    mask = np.zeros((side,) * 3, bool)
    mask[tuple(children.T)] = True
    # Of halves OpenVDB writes no length where there is no value.
    return _bits(mask) + bytes(side**3 // 8) + b"\0" + (b"" if half else bytes(8))
