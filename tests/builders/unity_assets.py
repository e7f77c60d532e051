"""Objects as UnityPy lists them: a layout, and bytes by it."""

import struct
from typing import Any

import numpy as np

ALIGNED = 0x4000


def node(kind: str, name: str, *children: Any, flag: int = 0) -> list:
    return [kind, name, flag, list(children)]


def vector(name: str, element: Any) -> Any:
    return node("vector", name, node("Array", "Array", node("int", "size"), element, flag=ALIGNED))


def floats(kind: str, names: list[str]) -> Any:
    return node(kind, "data", *(node("float", name) for name in names))


SH_NAMES = [f"sh[{i:2d}]" for i in range(27)]
TEXT = node("string", "m_Name", node("Array", "Array", node("int", "size"), node("char", "data"), flag=ALIGNED))
# Four values of other sizes between, an array of arrays among them.
PROBES = node(
    "LightProbes",
    "Base",
    TEXT,
    node(
        "Data",
        "m_Data",
        vector("m_Odd", vector("data", node("UInt8", "data"))),
        vector("m_Positions", floats("Vector3f", list("xyz"))),
    ),
    vector("m_BakedCoefficients", floats("SphericalHarmonicsL2", SH_NAMES)),
    vector("m_After", node("UInt8", "data")),
)
RENDERER = node(
    "RendererData",
    "data",
    node("UInt16", "lightmapIndex"),
    node("UInt16", "lightmapIndexDynamic"),
    node("Vector4f", "lightmapST", *(node("float", name) for name in "xyzw")),
)
LIGHTING = node("LightingDataAsset", "Base", TEXT, vector("m_LightmappedRendererData", RENDERER))


def probes(position: np.ndarray, sh: np.ndarray, order: str = "<") -> tuple[str, Any, bytes, str]:
    """Light probes [N, 3] with numbers [N, 9, 3]: nine of red, then of green, then of blue."""
    head = struct.pack(order + "i", 5) + b"probe\0\0\0" + struct.pack(order + "2i", 2, 1) + b"\1\0\0\0"
    head += struct.pack(order + "i", 3) + b"\1\2\3\0"
    places = struct.pack(order + "i", len(position)) + np.asarray(position, order + "f4").tobytes()
    light = np.ascontiguousarray(np.asarray(sh).transpose(0, 2, 1), order + "f4")
    return "LightProbes", PROBES, head + places + struct.pack(order + "i", len(sh)) + light.tobytes(), order


def lighting(rows: list[tuple[int, tuple[float, ...]]]) -> tuple[str, Any, bytes, str]:
    """Renderers: their lightmap's number and scale and offset."""
    packed = b"".join(struct.pack("<2H4f", number, 65535, *place) for number, place in rows)
    return "LightingDataAsset", LIGHTING, struct.pack("<i", 0) + struct.pack("<i", len(rows)) + packed, "<"
