"""Models of the scene `demos/data/street` that are made by code: vehicles and smoke; and the writer of their meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wlm.formats.gltf import GltfDocument
from wlm.formats.gltf_writer import write_glb

VOXELS = 48  # of the smoke along an edge of its box
PUFFS, BILLOWS = 26, 7

VEHICLE = 1.5  # size of the vehicles over the numbers below
PAINT, GLASS, DARK, LAMP, TAIL = (
    (0.62, 0.36, 0.03),
    (0.05, 0.07, 0.1),
    (0.03,) * 3,
    (0.8, 0.76, 0.6),
    (0.45, 0.02, 0.02),
)
WHITE = (0.6, 0.6, 0.57)


def save_mesh(
    path: Path, position: np.ndarray, triangle: np.ndarray, colour: np.ndarray, uv: np.ndarray | None
) -> None:
    """Writes triangles with a linear colour [F, 3] each, as vertex colours: vertices of several colours are split."""
    colours, number = np.unique(np.rint(np.asarray(colour) * 65535).astype("<u2"), axis=0, return_inverse=True)
    keys = triangle.astype(np.int64) * len(colours) + number.reshape(-1, 1)
    used, corner = np.unique(keys, return_inverse=True)
    vertex, tint = np.divmod(used, len(colours))
    opaque = np.column_stack([colours[tint], np.full(len(used), 65535, "<u2")])
    arrays = {"POSITION": position[vertex].astype("<f4"), "COLOR_0": opaque.astype("<u2")}
    arrays |= {} if uv is None else {"TEXCOORD_0": uv[vertex].astype("<f4")}
    data = [*arrays.values(), corner.reshape(-1).astype("<u2" if len(used) < 65535 else "<u4")]
    views, accessors, start = [], [], 0
    for number, each in enumerate(data):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": each.nbytes})
        kind = {"f": 5126, "u": 5123 if each.itemsize == 2 else 5125}[each.dtype.kind]
        shape = "SCALAR" if each.ndim == 1 else f"VEC{each.shape[1]}"
        accessors.append({"bufferView": number, "componentType": kind, "count": len(each), "type": shape})
        start += each.nbytes
    accessors[0] |= {"min": data[0].min(0).tolist(), "max": data[0].max(0).tolist()}
    accessors[1]["normalized"] = True
    attributes = {name: number for number, name in enumerate(arrays)}
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": path.stem}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(arrays), "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    write_glb(path, GltfDocument(path.name, content, (b"".join(each.tobytes() for each in data),)), [], 0)


def frustum(low: tuple, y0: float, high: tuple, y1: float, side: tuple, top: tuple) -> list[tuple[np.ndarray, tuple]]:
    """Squares of a box whose lower and upper faces are rectangles (half width in x, first and last z)."""
    at = [[(s * w, y, z) for s, z in ((-1, a), (1, a), (1, b), (-1, b))] for (w, a, b), y in ((low, y0), (high, y1))]
    p, q = np.array(at[0]), np.array(at[1])
    walls = [(np.array([p[j], p[i], q[i], q[j]]), side) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    return [*walls, (q[::-1], top), (p, side)]


def wheel(x: float, y: float, z: float, width: float) -> list[tuple[np.ndarray, tuple]]:
    """Squares of an octagonal wheel with its axis along x, on the ground."""
    turn = np.arange(9) * np.pi / 4
    rim = np.stack([np.zeros(9), y + y * np.cos(turn), z + y * np.sin(turn)], 1)
    left, right, middle = rim + [x - width / 2, 0, 0], rim + [x + width / 2, 0, 0], np.array([x, y, z])
    squares = [(np.array([left[i], left[i + 1], right[i + 1], right[i]]), DARK) for i in range(8)]
    for face, order in ((right, 1), (left, -1)):
        hub = middle + [face[0, 0] - x, 0, 0]
        squares += [(np.array([hub, face[i], face[i + 1], face[i + 2]][::order]), (0.2,) * 3) for i in range(0, 8, 2)]
    return squares


def vehicles() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Returns positions, triangles and their colours of a car and of a van, which stand on y = 0; +z is ahead."""
    car = frustum((0.056, -0.13, 0.13), 0.02, (0.054, -0.128, 0.122), 0.06, PAINT, PAINT)
    car += frustum((0.06, -0.135, 0.136), 0.018, (0.06, -0.135, 0.136), 0.03, DARK, DARK)
    car += frustum((0.05, -0.112, 0.062), 0.06, (0.04, -0.085, 0.015), 0.096, GLASS, PAINT)
    car += frustum((0.016, -0.045, -0.025), 0.096, (0.016, -0.043, -0.027), 0.107, WHITE, WHITE)  # a taxi's sign
    van = frustum((0.064, -0.17, 0.17), 0.022, (0.064, -0.17, 0.166), 0.075, WHITE, WHITE)
    van += frustum((0.066, -0.173, 0.174), 0.02, (0.066, -0.173, 0.174), 0.034, DARK, DARK)
    van += frustum((0.064, -0.17, 0.07), 0.075, (0.06, -0.168, 0.07), 0.155, WHITE, WHITE)
    van += frustum((0.0645, -0.168, 0.068), 0.088, (0.064, -0.168, 0.068), 0.1, (0.05, 0.2, 0.45), WHITE)
    van += frustum((0.062, 0.07, 0.155), 0.075, (0.057, 0.07, 0.105), 0.148, GLASS, WHITE)
    for body, nose, tail, wide, high in ((car, 0.129, -0.13, 0.026, 0.046), (van, 0.171, -0.17, 0.034, 0.056)):
        for x in (-wide - 0.018, wide):
            for z, tint in ((nose, LAMP), (tail - 0.003, TAIL)):
                box = frustum(
                    (0.009, z - 0.004, z + 0.004), high - 0.008, (0.009, z - 0.004, z + 0.004), high, tint, tint
                )
                body += [(corners + [x + 0.009, 0, 0], tint) for corners, tint in box]
            for z in (0.62 * nose, 0.62 * tail):
                body += wheel(np.sign(x) * (wide + 0.022), 0.024, z, 0.022)
    found = {}
    for name, squares in {"car": car, "van": van}.items():
        position = VEHICLE * np.concatenate([square for square, _ in squares])
        triangle = (4 * np.arange(len(squares))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
        found[name] = position, triangle, np.repeat([tint for _, tint in squares], 2, axis=0)
    return found


def plume(turn: float) -> np.ndarray:
    """Returns the density of smoke that rises and leans, [X, Y, Z] in a box of edge 1; it repeats when `turn` is 1."""
    random = np.random.default_rng(3)
    axis = (np.arange(VOXELS) + 0.5) / VOXELS
    density = np.zeros((VOXELS,) * 3)
    for puff in range(PUFFS):
        age = (turn + (puff + random.uniform(-0.3, 0.3)) / PUFFS) % 1.0
        wide = 0.03 + 0.17 * age**0.8
        strength = min(age / 0.04, 1.0) * (1.0 - age) ** 1.5
        lean = np.array([0.5 + 0.24 * age**1.4, 0.03 + 0.8 * age**0.85, 0.5]) + 0.08 * age * random.normal(0, 1, 3)
        for offset, size in zip(random.normal(0, 0.45, (BILLOWS, 3)), random.uniform(0.35, 0.7, BILLOWS), strict=True):
            angle = 2.0 * age
            x, y, z = offset
            at = lean + wide * np.array(
                [x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle), z]
            )
            square = [(axis - centre) ** 2 for centre in at]
            distance = np.sqrt(square[0][:, None, None] + square[1][:, None] + square[2])
            density += strength * np.clip(1.5 - distance / (wide * size), 0.0, 1.0)
    return np.minimum(density, 1.5).astype(np.float32)
