"""glTF scenes of named nodes, for tests of lightmaps that belong to some of them."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from builders.gltf_maker import GltfMaker


@dataclass
class Thing:
    """A node with a mesh of its own, or that of an earlier node."""

    name: str
    position: Any = None  # [V, 3]
    triangle: Any = None  # [F, 3]
    uv: Sequence[Any] = ()  # [V, 2] for each set
    translation: Sequence[float] = (0, 0, 0)
    material: dict | None = None
    like: int | None = None  # number of the node whose mesh it draws


def box(
    low: Sequence[float], high: Sequence[float], *, inward: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A box: positions, triangles, and UVs with a chart in each cell of 3 x 2, 5% of a cell from its border."""
    low, high = np.array(low, float), np.array(high, float)
    positions, triangles, uvs = [], [], []
    for face in range(6):
        axis, top = face // 2, face % 2
        corner = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
        place = np.empty((4, 3))
        place[:, axis], place[:, (axis + 1) % 3], place[:, (axis + 2) % 3] = top, corner[:, 0], corner[:, 1]
        square = np.array([[0, 1, 2], [0, 2, 3]])
        if (top == 0) != inward:
            square = square[:, ::-1]
        positions.append(low + place * (high - low))
        triangles.append(square + 4 * face)
        uvs.append((0.05 + 0.9 * corner + [face % 3, face // 3]) / [3, 2])
    return np.concatenate(positions), np.concatenate(triangles), np.concatenate(uvs)


def write_scene(path: Path, things: Sequence[Thing], extra: dict | None = None) -> Path:
    """Writes a `.gltf` with its data inside."""
    maker, meshes, nodes, materials = GltfMaker(), [], [], []
    for thing in things:
        if thing.like is None:
            attributes = {"POSITION": maker.add(np.asarray(thing.position, np.float32))}
            for number, uv in enumerate(thing.uv):
                attributes[f"TEXCOORD_{number}"] = maker.add(np.asarray(uv, np.float32))
            corners = maker.add(np.asarray(thing.triangle, np.uint32).reshape(-1))
            primitive = {"attributes": attributes, "indices": corners}
            if thing.material is not None:
                materials.append(thing.material)
                primitive["material"] = len(materials) - 1
            meshes.append({"primitives": [primitive], "name": f"{thing.name}-mesh"})
        mesh = len(meshes) - 1 if thing.like is None else nodes[thing.like]["mesh"]
        nodes.append({"name": thing.name, "mesh": mesh, "translation": list(thing.translation)})
    uri = "data:application/octet-stream;base64," + base64.b64encode(maker.blob).decode()
    content = {
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "buffers": [{"byteLength": len(maker.blob), "uri": uri}],
    } | ({"materials": materials} if materials else {})
    path.write_text(json.dumps(maker.content | content | (extra or {})))
    return path
