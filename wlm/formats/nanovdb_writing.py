"""Writing of NanoVDB's `.nvdb` files (version 32.6), which renderers and GPUs read as they are.

Voxels other than 0 are active; all others are the background, 0. Structures, fields and sizes are those of
`nanovdb/NanoVDB.h`: `FileHeader`, `FileMetaData`, `GridData`, `TreeData`, `RootData`, `InternalData` and `LeafData`.
"""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

from wlm.formats.vdb import LEAF, LOWER, UPPER
from wlm.formats.vdb_writing import occupied_leaves

_VERSION = 32 << 21 | 6 << 10
# All readers know the first at the start of files and grids; some look for the second at the end of a grid's header.
_MAGIC, _GRID_MAGIC = b"NanoVDB0", b"NanoVDB1"
_BOXES, _RANGES, _BREADTH_FIRST = 2, 4, 32  # flags of a grid whose nodes state the box and the range of active values
_FLOAT, _VECTOR, _FOG = 1, 6, 2
_GRID, _TREE, _ALIGNED = 672, 64, 32  # bytes of `GridData` and `TreeData`, and to whose multiples tables are moved
_HAS_BOX = 2  # flag of a leaf
_BOX: tuple = ("box", "<i4", (2, 3))
_TILE = np.dtype([("key", "<u8"), ("child", "<i8"), ("state", "<u4"), ("value", "V12")])


def encode_nvdb(grids: Sequence[tuple[str, np.ndarray, np.ndarray]], codec: str) -> bytes:
    """Returns the content of a file of grids of floats and vectors, each in a segment of its own. `grids` are as for
    `wlm.formats.vdb_writing.encode_vdb`, with transforms that scale and shift; halves become floats. `codec` is "zip":
    compressed by zlib; "none": grids as they are in memory."""
    parts, zipped = [], codec == "zip"
    for name, values, matrix in grids:
        kind, flags = ((_FLOAT, _FOG), _RANGES) if values.ndim == 3 else ((_VECTOR, 0), 0)
        tree, counts, voxels, box = _tree(values.astype("<f4", copy=False).reshape(*values.shape[:3], -1))
        turn, shift, size = matrix[:3, :3], matrix[:3, 3], _GRID + len(tree)
        numbers = np.concatenate([turn.ravel(), np.linalg.inv(turn).ravel(), shift, [1.0]])
        world = ((box + np.array([[0], [1]])) @ turn.T + shift).tobytes()
        edges = np.diag(turn).tobytes()
        grid = struct.pack("<8sq2I2I", _MAGIC, -1, _VERSION, flags | _BOXES | _BREADTH_FIRST, 0, 1)  # no checksum
        grid += struct.pack("<Q256s", size, name.encode()) + numbers.astype("<f4").tobytes() + numbers.tobytes()
        grid += world + edges + struct.pack("<2IQ16x8s", *kind[::-1], size, _GRID_MAGIC) + tree
        packed = zlib.compress(grid, 1) if zipped else grid
        parts.append(struct.pack("<8sI2H", _MAGIC, _VERSION, 1, zipped))
        parts.append(struct.pack("<4Q2I", size, len(packed) + 8 * zipped, 0, voxels, *kind))
        parts.append(world + box.astype("<i4").tobytes() + edges)
        parts.append(struct.pack("<5I12xH2xI", len(name) + 1, *counts, 1, zipped, _VERSION) + name.encode() + b"\0")
        parts.append(struct.pack("<Q", len(packed)) * zipped + packed)
    return b"".join(parts)


def _tree(values: np.ndarray) -> tuple[bytes, list[int], int, np.ndarray]:
    """Returns the tree of values [X, Y, Z, C], the numbers of its leaves, lower and upper nodes and of active voxels,
    and the lowest and the highest active voxel, [2, 3]."""
    channels = values.shape[3]
    places, cubes, active = occupied_leaves(values)
    flat, numbers = active.reshape(-1, LEAF**3), cubes.reshape(-1, LEAF**3, channels)
    fields = [("low", "<i4", 3), ("span", "u1", 3), ("flags", "u1"), ("mask", "u1", LEAF**3 // 8)]
    leaves = np.zeros(len(places), _layout(fields, channels, ("values", "<f4", (LEAF**3, channels))))
    along = np.stack([active.any(axes) for axes in ((2, 3), (1, 3), (1, 2))], 2)
    low, high = LEAF * places + along.argmax(1), LEAF * places + LEAF - 1 - along[:, ::-1].argmax(1)
    leaves["low"], leaves["span"], leaves["flags"] = low, high - low, _HAS_BOX
    leaves["mask"], leaves["values"] = np.packbits(flat, 1, "little"), numbers
    # All are minima: the lowest and the negated highest voxel, the least and the negated largest value.
    ends = [np.where(flat, sign * numbers[..., 0], np.inf).min(1)[:, None] for sign in (1, -1)]
    bounds = np.concatenate([low, -high, *ends], 1)
    _state_range(leaves, bounds)
    levels = [leaves]
    for side in (LOWER, UPPER):
        parents, parent = np.unique(places // side, axis=0, return_inverse=True)
        masks = [("flags", "<u8"), ("active", "u1", side**3 // 8), ("children", "u1", side**3 // 8)]
        # An entry of the table has room for a value and for a child's offset.
        table = ("table", "<i8", (side**3, -(-channels // 2)))
        nodes = np.zeros(len(parents), _layout([_BOX, *masks], channels, table))
        slot, taken = (
            np.ravel_multi_index(tuple((places % side).T), (side,) * 3),
            np.zeros((len(parents), side**3), bool),
        )
        taken[parent, slot] = True
        nodes["children"] = np.packbits(taken, 1, "little")
        below = (len(parents) - parent) * nodes.itemsize  # the nodes of a level follow those of the level above it
        nodes["table"][parent, slot, 0] = below + np.arange(len(places)) * levels[-1].itemsize
        within, bounds, places = bounds, np.full((len(parents), 8), np.inf), parents
        np.minimum.at(bounds, parent, within)
        nodes["box"] = _box(bounds)
        _state_range(nodes, bounds)
        levels.append(nodes)
    fields = [_BOX, ("count", "<u4"), ("background", "<f4", channels)]
    root = np.zeros(1, _layout(fields, channels, ("tiles", _TILE, (len(places),))))
    bounds = bounds.min(0, initial=np.inf, keepdims=True)
    root["box"], root["count"] = _box(bounds), len(places)
    root["tiles"]["key"] = places @ (1 << np.array([42, 21, 0]))
    root["tiles"]["child"] = root.itemsize + np.arange(len(places)) * levels[-1].itemsize
    if len(places):
        _state_range(root, bounds)
    levels.append(root)
    counts, sizes = [len(nodes) for nodes in levels[:3]], [nodes.nbytes for nodes in levels]
    offsets = [_TREE + sum(sizes[i + 1 :]) if len(levels[i]) else 0 for i in range(4)]
    voxels = int(np.count_nonzero(flat))
    head = struct.pack("<4Q3I12xQ", *offsets, *counts, voxels)
    return head + b"".join(nodes.tobytes() for nodes in levels[::-1]), counts, voxels, _box(bounds)[0]


def _layout(fields: list[tuple], channels: int, table: tuple) -> np.dtype:
    """Returns the layout of a node: fields, the range, the mean and the deviation of its values, and a table."""
    head = [*fields, ("least", "<f4", (channels,)), ("most", "<f4", (channels,)), ("mean", "<f4", 2)]
    return np.dtype([*head, ("padding", "u1", (-np.dtype(head).itemsize % _ALIGNED,)), table])


def _box(bounds: np.ndarray) -> np.ndarray:
    """Returns boxes [N, 2, 3] of lowest and highest voxels; the box of nothing begins beyond its end, as NanoVDB's."""
    return np.clip(bounds[:, :6].reshape(-1, 2, 3) * [[[1], [-1]]], -(2**31), 2**31 - 1).astype(np.int64)


def _state_range(nodes: np.ndarray, bounds: np.ndarray) -> None:
    """Writes the least and the largest value into nodes of floats; those of vectors state none."""
    if nodes["least"].shape[1] == 1:
        nodes["least"], nodes["most"] = bounds[:, 6:7], -bounds[:, 7:8]
