"""Reading of glTF 2.0 (`.glb`, `.gltf`): the triangles that a scene draws. `gltf_writer` writes copies with new UVs.

The file stays a JSON tree, so that a copy keeps every field that this package does not know. A library of typed
classes, such as pygltflib, would drop them.

====================================  ================================================================
in the file                           behaviour
====================================  ================================================================
points, lines; no `POSITION`          left out; kept in copies
strips, fans                          read; a list of triangles in copies
no `indices`                          vertices are used in order
integer UVs and positions             read, normalised or not (KHR_mesh_quantization)
strided, sparse, absent (zero) data   read
a mesh under two nodes                returned twice; in copies each node has its own mesh, and equal
                                      data is stored once
a node that mirrors                   the winding of its triangles is turned round, so that they keep their front
skins, morph targets, animations      ignored: the mesh is read in its rest pose, with its node's transform
nodes outside the scene               left out; kept in copies
external `.bin`, `data:` URIs         read; copies embed them in the `.glb`
external images                       copies embed them; an image that is missing or not PNG, JPEG, WebP,
                                      KTX2 or DDS keeps its URI
a buffer outside the file's folder    error, unless the file is trusted; an image there keeps its URI
more corners and vertices than        error, unless the file is trusted (`wlm.formats.limits`)
the limits
Draco, meshopt                        decompressed, with the extra `gltf` (`gltf_packed`)
GPU instances                         error that names the extension
a file missing or damaged             error that names the file, and the field
====================================  ================================================================
"""

import base64
import binascii
import json
import os
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from wlm.errors import WlmError, one_line
from wlm.formats.gltf_packed import is_fallback, unpack
from wlm.formats.limits import CORNERS, CORNERS_A_BYTE, JSON_BYTES, MESH_BYTES, SURE_CORNERS, Budget
from wlm.formats.reading import damaged, named_file, parse_json, read_file

MAGIC = b"glTF"
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942

_URI_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
TRIANGLES, STRIP, FAN = 4, 5, 6

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""NumPy types of glTF component types."""

_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MATRIX_SIDES = {"MAT2": 2, "MAT3": 3, "MAT4": 4}
_LONGEST_STRIDE = 252  # bytes
_LABEL = 60  # characters of a name in a message
_OVERHEAD = 512  # cost of a primitive under a node, in corners
_LARGEST_TRANSFORM = 1e9  # magnitude of the numbers of a texture transform
_MOVES, _UNMOVED = {"matrix", "translation", "rotation", "scale"}, np.eye(4)
_UV_NAME = re.compile(r"TEXCOORD_(0|[1-9]\d{0,3})")
_REFUSED = {"EXT_mesh_gpu_instancing": "make its instances nodes first, for example with gltf-transform uninstance"}


@dataclass(frozen=True, eq=False)
class GltfDocument:
    """A glTF file: its path, for messages and for the files that it refers to; the JSON tree, which must not be
    changed; the bytes of each buffer.

    `trust` tells whether the file may name files outside its folder and exceed the limits for its size; `most` is the
    largest allowed number of drawn corners and vertices, and of elements of an accessor without data.
    """

    path: str
    content: dict
    buffers: tuple[bytes, ...]
    trust: bool = False
    most: int = CORNERS

    def item(self, kind: str, number: object) -> dict:
        """Returns an entry of one of the lists of the tree, for example `accessors`."""
        entries = self.content.get(kind, [])
        if not isinstance(number, int) or not 0 <= number < len(entries):
            raise WlmError(f"{self.path}: {kind}[{number}]: the file has {len(entries)} {kind}")
        return entries[number]


@dataclass(frozen=True, eq=False)
class GltfPrimitive:
    """Triangles of one primitive under one node, with the vertices that they use.

    Attributes:
        node: Index of the node.
        mesh: Index of its mesh.
        primitive: Index of the primitive in the mesh.
        name: Name for messages.
        position: float64 [V, 3], in the scene's space.
        triangle: int32 [F, 3].
        uv: float32 [V, 2] for each UV set n (`TEXCOORD_n`); u right, v down.
        row: int64 [V], the row of each vertex in the primitive's accessors.
        label, mesh_label: Names of the node and of its mesh; "node 3" or "mesh 2", by index, without a name.
        material: Index of the material, or None.
        mirrored: Whether the node's transform has a negative determinant, for which `triangle` has the opposite winding
            of the file (glTF 2.0, 3.7.4).
    """

    node: int
    mesh: int
    primitive: int
    name: str
    position: np.ndarray
    triangle: np.ndarray
    uv: dict[int, np.ndarray]
    row: np.ndarray
    label: str
    mesh_label: str
    material: int | None
    mirrored: bool = False


def read_gltf(path: str | os.PathLike[str], trust: bool = False) -> tuple[GltfDocument, list[GltfPrimitive]]:
    """Reads a `.glb` or `.gltf` file, recognised by its first bytes; `GltfDocument` explains `trust`.

    Returns the document, and the primitives with triangles that its scene draws (the default scene, else the first
    scene, else all nodes), in depth-first order of the nodes.
    """
    return parse_gltf(path, read_file(path, MESH_BYTES, "the glTF file"), trust)


def parse_gltf(
    path: str | os.PathLike[str], data: bytes, trust: bool = False
) -> tuple[GltfDocument, list[GltfPrimitive]]:
    """Reads the bytes of a `.glb` or `.gltf` file, as `read_gltf` does; `path` is its name in messages."""
    with reported(path):
        text, binary = _split_glb(path, data) if data[:4] == MAGIC else (data, None)
        if len(text) > JSON_BYTES:
            raise WlmError(f"{path}: expected at most {JSON_BYTES} bytes of JSON, found {len(text)}")
        content = parse_json(str(path), text)
        if not isinstance(content, dict) or not isinstance(content.get("asset"), dict):
            raise WlmError(f"{path}: expected a glTF file, found other content")
        version = str(content["asset"].get("version"))
        if version.partition(".")[0] != "2":
            raise WlmError(f"{path}: asset.version: expected 2.0, found {version}")
        for name in (*content.get("extensionsUsed", []), *content.get("extensionsRequired", [])):
            if name in _REFUSED:
                raise WlmError(f"{path}: uses the extension {name}, which is not read here: {_REFUSED[name]}")
        buffers = _load_buffers(path, content.get("buffers", []), binary, trust)
        content, buffers = unpack(path, content, buffers, COMPONENTS)
        held = len(text) + sum(map(len, buffers))
        most = CORNERS if trust else min(CORNERS, max(SURE_CORNERS, CORNERS_A_BYTE * held))
        document = GltfDocument(str(path), content, buffers, trust, most)
        for i, view in enumerate(content.get("bufferViews", [])):
            _check_view(document, i, view)
        with np.errstate(all="ignore"):  # infinite numbers are reported where they are used
            return document, _read_primitives(document)


Arrays = tuple[str, np.ndarray, np.ndarray, np.ndarray]
"""A mesh that came from elsewhere: its name, positions [V, 3], triangles int [F, 3] and UVs [V, 2]."""


def document_from_meshes(
    meshes: Sequence[Arrays], name: str, uv_set: int = 0
) -> tuple[GltfDocument, list[GltfPrimitive]]:
    """Makes a glTF document of several meshes, at least one, each with its own node; returns it with its primitives,
    one for each mesh.

    A mesh has a name; positions [V, 3], stored as float32; triangles int [F, 3], at least one; and UVs [V, 2], u right,
    v down, stored as float32 in all UV sets up to `TEXCOORD_n` with n = `uv_set`.
    """
    views, accessors, data, primitives = [], [], [], []
    nodes, trees, start = [], [], 0
    for number, (label, position, triangle, uv) in enumerate(meshes):
        points, places = np.asarray(position, "<f4"), np.asarray(uv, "<f4")
        corners = np.asarray(triangle, "<u4")
        for array, target, kind, component in (
            (points, 34962, "VEC3", 5126),
            (places, 34962, "VEC2", 5126),
            (corners.reshape(-1), 34963, "SCALAR", 5125),
        ):
            views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
            accessor = {"bufferView": len(accessors), "componentType": component, "count": len(array), "type": kind}
            accessors.append(accessor)
            start += array.nbytes
            data.append(array.tobytes())
        first = len(accessors) - 3
        accessors[first] |= {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        nodes.append({"mesh": number, "name": label})
        attributes = {"POSITION": first} | {f"TEXCOORD_{number}": first + 1 for number in range(uv_set + 1)}
        trees.append({"primitives": [{"attributes": attributes, "indices": first + 2}]})
        row, short = np.arange(len(points)), one_line(label, _LABEL)
        arrays = points.astype(np.float64), corners.astype(np.int32), {uv_set: places}
        primitives.append(GltfPrimitive(number, number, 0, label, *arrays, row, short, short, None))
    content = {
        "asset": {"version": "2.0", "generator": "wlm"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": trees,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    return GltfDocument(name, content, (b"".join(data),)), primitives


def elements(document: GltfDocument, number: int) -> np.ndarray:
    """Reads the encoded elements of an accessor, with its sparse part applied.

    Returns:
        uint8 [count, bytes of an element], with the column padding that glTF requires for small matrices; it may be a
        view of the file's bytes.
    """
    accessor = document.item("accessors", number)
    where = f"{document.path}: accessors[{number}]"
    component, kind, count = accessor.get("componentType"), accessor.get("type"), accessor.get("count")
    if component not in COMPONENTS or kind not in (*_WIDTHS, *_MATRIX_SIDES):
        raise WlmError(f"{where}: expected a componentType and a type of glTF, found {component} and {kind}")
    if not isinstance(count, int) or count < 1:
        raise WlmError(f"{where}: count: expected at least 1, found {count}")
    size = np.dtype(COMPONENTS[component]).itemsize
    if kind in _WIDTHS:
        size *= _WIDTHS[kind]
    else:  # each column begins at a multiple of 4 bytes
        size = -(-size * _MATRIX_SIDES[kind] // 4) * 4 * _MATRIX_SIDES[kind]
    if "bufferView" in accessor:
        rows = _rows(document, where, accessor, count, size, strided=True)
    elif count > document.most:
        raise WlmError(f"{where}: count: expected at most {document.most} without a bufferView, found {count}")
    else:
        rows = np.zeros((count, size), np.uint8)
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        if sparse["count"] > count:
            raise WlmError(f"{where}.sparse.count: expected at most {count}, found {sparse['count']}")
        places = sparse["indices"]
        wide = np.dtype(COMPONENTS[places["componentType"]])
        if wide.kind != "u":
            raise WlmError(f"{where}.sparse.indices: expected unsigned integers, found {wide}")
        at = _rows(document, f"{where}.sparse.indices", places, sparse["count"], wide.itemsize)
        at = np.ascontiguousarray(at).view(wide)[:, 0]
        if at.max() >= count:
            raise WlmError(f"{where}.sparse.indices: expected numbers below {count}, found {at.max()}")
        rows = rows.copy()
        rows[at] = _rows(document, f"{where}.sparse.values", sparse["values"], sparse["count"], size)
    return rows


def components(document: GltfDocument, number: int, kind: str) -> np.ndarray:
    """Reads the numbers of an accessor in their stored type, [count, components]."""
    accessor = document.item("accessors", number)
    if accessor.get("type") != kind:
        raise WlmError(f"{document.path}: accessors[{number}].type: expected {kind}, found {accessor.get('type')}")
    return np.ascontiguousarray(elements(document, number)).view(COMPONENTS[accessor["componentType"]])


def vertex_normals(document: GltfDocument, primitives: Sequence[GltfPrimitive]) -> list[np.ndarray | None]:
    """Returns the vertex normals in the space of the scene.

    Returns:
        For each primitive float64 [V, 3], of unit length, or 0 where the stored normal has no length; None for a
        primitive without `NORMAL`.
    """
    with reported(document.path):
        transforms = dict(_walk(document))
        normals: list[np.ndarray | None] = []
        stored: dict[int, np.ndarray] = {}  # primitives often share their accessors
        budget = Budget(document.path, document.most, "stored normals")
        for each in primitives:
            attributes = document.item("meshes", each.mesh)["primitives"][each.primitive]["attributes"]
            if "NORMAL" not in attributes:
                normals.append(None)
                continue
            number = attributes["NORMAL"]
            if number not in stored:
                budget.spend(_count(document, number))
                stored[number] = _floats(document, number, "VEC3")
            local = stored[number]
            if len(local) <= each.row.max():
                raise WlmError(
                    f"{document.path}: {each.name}: expected {each.row.max() + 1} normals or more, found {len(local)}"
                )
            # Normals transform by the cofactor matrix: the inverse transpose times the determinant. It exists for a
            # scale of 0, too.
            a, b, c = transforms[each.node][:3, :3].T
            side = -1.0 if a @ np.cross(b, c) < 0 else 1.0
            turn = side * np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
            turned = local[each.row].astype(np.float64) @ turn
            length = np.linalg.norm(turned, axis=1, keepdims=True)
            good = np.isfinite(length) & (length > 0)
            normals.append(np.divide(turned, length, out=np.zeros_like(turned), where=good))
        return normals


def vertex_colours(
    document: GltfDocument, primitives: Sequence[GltfPrimitive], textured: bool = False
) -> list[np.ndarray]:
    """Returns the base colours of vertices: `COLOR_0`, or white without it, times the factor of the material.
    `textured` tells whether materials may have a texture, by which the caller multiplies the colours. Returns for each
    primitive float32 [V, 3], linear, from 0 to 1."""
    with reported(document.path):
        colours = []
        for each in primitives:
            material = {} if each.material is None else document.item("materials", each.material)
            shading = material.get("pbrMetallicRoughness", {})
            if "baseColorTexture" in shading and not textured:
                raise WlmError(
                    f"{document.path}: materials[{each.material}]: expected a base colour by its factor or COLOR_0, "
                    "found a texture; store its colours in COLOR_0"
                )
            factor = np.array(shading.get("baseColorFactor", (1.0,) * 4), np.float32)
            if factor.shape != (4,):
                raise WlmError(f"{document.path}: materials[{each.material}].baseColorFactor: expected four numbers")
            attributes = document.item("meshes", each.mesh)["primitives"][each.primitive]["attributes"]
            own = np.ones((len(each.row), 3), np.float32)
            if "COLOR_0" in attributes:
                number = attributes["COLOR_0"]
                kind = "VEC3" if document.item("accessors", number).get("type") == "VEC3" else "VEC4"
                own = _floats(document, number, kind)
                if len(own) <= each.row.max():
                    raise WlmError(
                        f"{document.path}: {each.name}: expected {each.row.max() + 1} colours or more, found {len(own)}"
                    )
                own = own[each.row, :3]
            colours.append(np.clip(own * factor[:3], 0.0, 1.0))
        return colours


@contextmanager
def reported(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turns exceptions that malformed JSON of a glTF file causes in the block into one-line errors."""
    try:
        yield
    except KeyError as error:
        raise WlmError(f"{path}: malformed glTF: the field {error} is missing") from error
    except (ValueError, TypeError, AttributeError, IndexError, OverflowError, RecursionError) as error:
        raise WlmError(f"{path}: malformed glTF: {error}") from error
    except MemoryError as error:
        raise WlmError(f"{path}: malformed glTF: it states a count that exceeds the memory") from error


def _check_view(document: GltfDocument, number: int, view: dict) -> None:
    where = f"{document.path}: bufferViews[{number}]"
    document.item("buffers", view["buffer"])
    start, length, held = view.get("byteOffset", 0), view["byteLength"], len(document.buffers[view["buffer"]])
    if not (isinstance(start, int) and isinstance(length, int) and start >= 0 and length >= 0):
        raise WlmError(f"{where}: expected whole numbers of 0 or more, found byteOffset {start}, byteLength {length}")
    if start + length > held:
        raise WlmError(f"{where}: needs {start + length} bytes of buffers[{view['buffer']}], which has {held}")


def _rows(document: GltfDocument, where: str, place: dict, count: int, size: int, strided: bool = False) -> np.ndarray:
    """Returns uint8 [count, size]: elements from the bufferView and byteOffset in `place`, a part of an accessor."""
    view = document.item("bufferViews", place["bufferView"])
    offset, length = place.get("byteOffset", 0), view["byteLength"]
    stride = view.get("byteStride", size) if strided else size
    if not all(isinstance(each, int) and each >= least for each, least in ((count, 1), (offset, 0), (stride, 1))):
        raise WlmError(f"{where}: expected whole numbers as count, byteOffset and byteStride")
    if stride != size and not (size <= stride <= _LONGEST_STRIDE and stride % 4 == 0):
        raise WlmError(f"{where}: byteStride: expected a multiple of 4, {size} to {_LONGEST_STRIDE}, found {stride}")
    needed = offset + (count - 1) * stride + size
    if needed > length:
        raise WlmError(f"{where}: needs {needed} bytes of bufferViews[{place['bufferView']}], which has {length}")
    start = view.get("byteOffset", 0) + offset
    data = np.frombuffer(document.buffers[view["buffer"]], np.uint8, needed - offset, start)
    return np.lib.stride_tricks.as_strided(data, (count, size), (stride, 1), writeable=False)


def _read_primitives(document: GltfDocument) -> list[GltfPrimitive]:
    primitives = []
    cache: dict[tuple[int, str], np.ndarray] = {}  # primitives often share their accessors
    hint = "; trust=True (--trust on the command line) lifts the limit for files from a trusted author"
    budget = Budget(document.path, document.most, "drawn corners and vertices", "" if document.trust else hint)

    def floats(number: int, kind: str) -> np.ndarray:
        if (number, kind) not in cache:
            budget.spend(_count(document, number))
            cache[number, kind] = _floats(document, number, kind)
        return cache[number, kind]

    for node, transform in _walk(document):
        mesh_number = document.content["nodes"][node].get("mesh")
        if mesh_number is None:
            continue
        mesh = document.item("meshes", mesh_number)
        budget.spend(_OVERHEAD * len(mesh["primitives"]))
        for i, primitive in enumerate(mesh["primitives"]):
            mode, attributes = primitive.get("mode", TRIANGLES), primitive["attributes"]
            if mode not in (TRIANGLES, STRIP, FAN) or "POSITION" not in attributes:
                continue
            local = floats(attributes["POSITION"], "VEC3")
            where = f"{document.path}: meshes[{mesh_number}].primitives[{i}]"
            # Strips and fans have three corners for each index; copies gather each attribute.
            corners = _count(document, primitive["indices"]) if "indices" in primitive else len(local)
            budget.spend(corners * (1 if mode == TRIANGLES else 3) + min(corners, len(local)) * len(attributes))
            triangle = _triangles(_corners(document, where, primitive, len(local)), mode, where)
            if not len(triangle):
                continue
            row, triangle = np.unique(triangle, return_inverse=True)
            sets = {int(match[1]): name for name in attributes if (match := _UV_NAME.fullmatch(name))}
            uv = {}
            for number, name in sorted(sets.items()):
                values = floats(attributes[name], "VEC2")
                if len(values) != len(local):
                    raise WlmError(f"{where}: {name}: expected {len(local)} UVs, like POSITION, found {len(values)}")
                uv[number] = values[row]
            triangle, material = triangle.reshape(-1, 3).astype(np.int32), primitive.get("material")
            if material is not None:
                document.item("materials", material)
            mirrored = bool(np.linalg.det(transform[:3, :3]) < 0)
            primitives.append(
                GltfPrimitive(
                    node=node,
                    mesh=mesh_number,
                    primitive=i,
                    name=f"node {node}, mesh {mesh_number}, primitive {i}",
                    position=local[row].astype(np.float64) @ transform[:3, :3].T + transform[:3, 3],
                    triangle=triangle[:, ::-1] if mirrored else triangle,
                    uv=uv,
                    row=row,
                    label=_label(document.content["nodes"][node], f"node {node}"),
                    mesh_label=_label(mesh, f"mesh {mesh_number}"),
                    material=material,
                    mirrored=mirrored,
                )
            )
    return primitives


def _label(item: dict, other: str) -> str:
    name = item.get("name")
    return one_line(name, _LABEL) if isinstance(name, str) and name else other


def _count(document: GltfDocument, number: int) -> int:
    count = document.item("accessors", number).get("count")
    return count if isinstance(count, int) else 0


def _floats(document: GltfDocument, number: int, kind: str) -> np.ndarray:
    """Reads an accessor as float32 [count, components]; normalised integers are scaled."""
    values = components(document, number, kind)
    if values.dtype.kind != "f" and document.content["accessors"][number].get("normalized", False):
        scaled = values.astype(np.float64) / np.iinfo(values.dtype).max
        return np.maximum(scaled, -1.0).astype(np.float32)
    return values.astype(np.float32)


def _corners(document: GltfDocument, where: str, primitive: dict, vertices: int) -> np.ndarray:
    if "indices" not in primitive:
        return np.arange(vertices)
    index = components(document, primitive["indices"], "SCALAR")[:, 0]
    if index.dtype.kind != "u":
        raise WlmError(f"{where}.indices: expected unsigned integers, found {index.dtype}")
    if index.max() >= vertices:
        raise WlmError(f"{where}.indices: expected numbers below {vertices}, found {index.max()}")
    return index.astype(np.int64)


def _triangles(corner: np.ndarray, mode: int, where: str) -> np.ndarray:
    """Converts the corners [N] of a triangle list, strip or fan (`mode`) to triangles [F, 3]."""
    if mode == TRIANGLES:
        if len(corner) % 3:
            raise WlmError(f"{where}: expected three corners per triangle, found {len(corner)} corners")
        return corner.reshape(-1, 3)
    first = np.arange(max(len(corner) - 2, 0))
    if mode == FAN:
        return np.stack([corner[first + 1], corner[first + 2], np.full_like(first, corner[0])], axis=1)
    odd = first % 2
    return np.stack([corner[first], corner[first + 1 + odd], corner[first + 2 - odd]], axis=1)


def _walk(document: GltfDocument) -> Iterator[tuple[int, np.ndarray]]:
    """Yields the nodes of the scene, depth first, each with its transform [4, 4] to the space of the scene."""
    content = document.content
    nodes = content.get("nodes", [])
    if content.get("scenes"):
        roots: Sequence[int] = document.item("scenes", content.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [number for number in range(len(nodes)) if number not in children]
    visited = set()
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        number, above = stack.pop()
        node = document.item("nodes", number)
        if number in visited:
            raise WlmError(f"{document.path}: nodes[{number}]: expected one parent, found the node twice in the scene")
        visited.add(number)
        own = _transform(node)
        transform = above if own is _UNMOVED else above @ own
        yield number, transform
        stack += [(child, transform) for child in reversed(node.get("children", []))]


def _transform(node: dict) -> np.ndarray:
    """Returns the local transform [4, 4] of a node: its matrix, else translation * rotation * scale."""
    if not _MOVES & node.keys():
        return _UNMOVED
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # stored by columns
    transform = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    norm = x * x + y * y + z * z + w * w
    if norm > 0:  # exporters round quaternions; an all-zero one has no rotation
        s = 2.0 / norm
        transform[:3, :3] = [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    transform[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    transform[:3, 3] = node.get("translation", (0, 0, 0))
    return transform


def _split_glb(path: str | os.PathLike[str], data: bytes) -> tuple[bytes, bytes | None]:
    if len(data) < 12:
        raise WlmError(f"{path}: the file is cut short: expected a header of 12 bytes, found {len(data)}")
    version, length = struct.unpack_from("<2I", data, 4)
    if version != 2:
        raise WlmError(f"{path}: expected version 2 of the .glb format, found {version}")
    if length > len(data):
        raise WlmError(f"{path}: the file is cut short: expected {length} bytes, found {len(data)}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<2I", data, at)
        if at + 8 + size > length:
            raise WlmError(f"{path}: the chunk of {size} bytes at byte {at} exceeds the file of {length} bytes")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if JSON_CHUNK not in chunks:
        raise WlmError(f"{path}: the .glb file has no JSON chunk")
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK)


def _load_buffers(
    path: str | os.PathLike[str], buffers: Sequence[dict[str, Any]], binary: bytes | None, trust: bool
) -> tuple[bytes, ...]:
    """Returns the bytes of each buffer, from files in the document's folder or, with `trust`, in any folder."""
    files: dict[Path, int] = {}
    loaded = []
    for number, buffer in enumerate(buffers):
        uri, length, where = buffer.get("uri"), buffer["byteLength"], f"{path}: buffers[{number}]"
        if is_fallback(buffer):
            data, length = b"", 0
        elif uri is None:
            if number or binary is None:
                raise WlmError(f"{where}: expected a uri; only buffers[0] of a .glb with a binary chunk has none")
            data = binary
        elif uri.startswith("data:"):
            data = _data_uri(f"{where}.uri", uri)
        else:
            if not isinstance(length, int) or length < 1:
                raise WlmError(f"{where}.byteLength: expected at least 1, found {length}")
            file = _local_file(str(path), uri, f"{where}.uri", trust).resolve()
            # Thousands of buffers of one file, each read separately, would exhaust the memory.
            earlier = files.setdefault(file, number)
            if earlier != number:
                raise WlmError(f"{where}.uri: expected another file, since buffers[{earlier}] already names {uri}")
            data = read_file(file, MESH_BYTES, f"buffers[{number}] of {path}", first=length)
        if len(data) < length:
            raise WlmError(f"{where}: expected {length} bytes, found {len(data)}")
        loaded.append(data)
    return tuple(loaded)


def _data_uri(where: str, uri: str) -> bytes:
    head, comma, body = uri.partition(",")
    if not comma:
        raise WlmError(f"{where}: expected a data: URI with a comma before its content")
    data = unquote_to_bytes(body)
    if head.endswith(";base64"):
        with damaged(f"{where}: expected base64", binascii.Error):
            data = base64.b64decode(data, validate=True)
    return data


def texture_image(document: GltfDocument, number: object) -> int:
    """Returns the index of the image of a texture. Of several sources float pictures come first, then those that all
    readers know."""
    texture = document.item("textures", number)
    extensions = texture.get("extensions", {})
    for name in ("EXT_texture_exr", "", "EXT_texture_webp", "KHR_texture_basisu", "MSFT_texture_dds"):
        source = (extensions.get(name, {}) if name else texture).get("source")
        if source is not None:
            return source
    others = ", ".join(one_line(name, _LABEL) for name in extensions) or "no source"
    raise WlmError(f"{document.path}: textures[{number}]: expected an image that can be read, found {others}")


def held_image(document: GltfDocument, number: int) -> bytes | memoryview | None:
    """Returns the bytes of an image in a buffer view or a `data:` URI; None for an image in a file of its own."""
    image = document.item("images", number)
    if "bufferView" in image:
        view = document.item("bufferViews", image["bufferView"])
        start = view.get("byteOffset", 0)
        return memoryview(document.buffers[view["buffer"]])[start : start + view["byteLength"]]
    if str(image["uri"]).startswith("data:"):
        return _data_uri(f"{document.path}: images[{number}].uri", image["uri"])
    return None


def texture_transform(where: str, info: dict) -> tuple[int | None, np.ndarray]:
    """Returns how a texture slot reads UVs: n of its `TEXCOORD_n`, None if the slot does not state it; and its
    KHR_texture_transform, float64 [2, 3]: UV' = transform[:, :2] UV + transform[:, 2]."""
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    names = {"scale": [1.0, 1.0], "rotation": 0.0, "offset": [0.0, 0.0]}
    scale, turn, offset = (np.array(transform.get(name, usual), np.float64) for name, usual in names.items())
    numbers = [*scale.ravel(), *turn.ravel(), *offset.ravel()]
    if (scale.shape, turn.shape, offset.shape) != ((2,), (), (2,)) or not np.abs(numbers).max() <= _LARGEST_TRANSFORM:
        raise WlmError(
            f"{where}: KHR_texture_transform: expected two numbers each for scale and offset, and one for rotation, of "
            f"at most {_LARGEST_TRANSFORM:g}"
        )
    cosine, sine = np.cos(turn), np.sin(turn)
    matrix = np.column_stack([np.array([[cosine, sine], [-sine, cosine]]) * scale, offset])
    number = transform.get("texCoord", info.get("texCoord"))
    if number is not None and (not isinstance(number, int) or number < 0):
        raise WlmError(f"{where}: texCoord: expected the number of a UV set, found {json.dumps(number)[:60]}")
    return number, matrix


def image_file(document: GltfDocument, number: int) -> Path:
    """Returns the path of an image that is a file of its own."""
    where = f"{document.path}: images[{number}].uri"
    return _local_file(document.path, document.item("images", number)["uri"], where, document.trust)


def _local_file(document_path: str, uri: str, where: str, trust: bool) -> Path:
    """Returns the path of the file that a URI names, relative to the document."""
    name = unquote(uri)
    if _URI_SCHEME.match(uri) or Path(name).is_absolute():
        raise WlmError(f"{where}: expected a path relative to the document, found {one_line(uri, _LABEL)}")
    path = named_file(document_path, name, where, trust)
    # Some writers don't encode a percent sign of the name.
    raw = path if name == uri else named_file(document_path, uri, where, trust)
    return raw if not path.exists() and raw.exists() else path
