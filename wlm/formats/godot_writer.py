"""Writing light probes as a Godot 4 lightmap bake (`.lmbake`).

It is a binary resource (`RSRC`, core/io/resource_format_binary.cpp) of format 4, which every Godot 4 reads, with one
resource in it, a `LightmapGIData` of which `probe_data` alone is set: no textures, and no meshes that have them.
"""

import struct

import numpy as np

from wlm.formats.godot import COEFFICIENTS

_ENGINE, _FORMAT, _NAMED_IDS = (4, 0), 4, 1
_RESERVED = 11
_TYPE, _PROPERTY = "LightmapGIData", "probe_data"
_BOOL, _FLOAT, _STRING, _AABB, _DICTIONARY, _INTS, _VECTORS, _COLOURS = 2, 4, 5, 15, 26, 32, 35, 36


def lmbake_bytes(
    points: np.ndarray, sh: np.ndarray, tetrahedra: np.ndarray, planes: np.ndarray, children: np.ndarray
) -> bytes:
    """What a new bake holds.

    Args:
        points: [N, 3], metres.
        sh: [N, 9, 3], Godot's numbers, as `wlm.formats.godot` says.
        tetrahedra: int [T, 4], between points.
        planes, children: [M, 4] and int [M, 2], a tree of planes n x = d: where n x > d the first child is next, else
            the second; a child is a node from 0, or -1 - t for the tetrahedron t.
    """
    low, high = points.min(0), points.max(0)
    node = np.zeros((len(planes), 6), "<u4")
    node[:, :4] = planes.astype("<f4").view("<u4")
    node[:, 4:] = children.astype("<i4").view("<u4")
    data = {
        "bounds": _u32(_AABB) + np.concatenate([low, high - low]).astype("<f4").tobytes(),
        "points": _u32(_VECTORS, len(points)) + points.astype("<f4").tobytes(),
        "tetrahedra": _u32(_INTS, tetrahedra.size) + tetrahedra.astype("<i4").tobytes(),
        "bsp": _u32(_INTS, node.size) + node.tobytes(),
        "sh": _u32(_COLOURS, COEFFICIENTS * len(points)) + _colours(sh),
        "interior": _u32(_BOOL, 0),
        "baked_exposure": _u32(_FLOAT) + struct.pack("<f", 1.0),
    }
    content = _u32(_DICTIONARY, len(data)) + b"".join(_u32(_STRING) + _text(key) + each for key, each in data.items())
    head = b"RSRC" + _u32(0, 0, *_ENGINE, _FORMAT) + _text(_TYPE)
    # No import metadata, no UID of its own, no name of a script's class.
    head += struct.pack("<QIQ", 0, _NAMED_IDS, 0) + _u32(*[0] * _RESERVED)
    head += _u32(1) + _text(_PROPERTY) + _u32(0)  # names; resources elsewhere
    head += _u32(1) + _text("local://1")
    body = _text(_TYPE) + _u32(1) + _u32(0) + content
    return head + struct.pack("<Q", len(head) + 8) + body + b"RSRC"


def _colours(sh: np.ndarray) -> bytes:
    colours = np.zeros((len(sh), COEFFICIENTS, 4), "<f4")
    colours[..., :3] = sh
    return colours.tobytes()


def _u32(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _u32(len(data)) + data
