"""glTF 2.0, `.glb` and `.gltf`: the triangles that a scene draws, and copies of the file with one more UV set.

A file is kept as the JSON tree that it is, and only the primitives that get new UVs are touched. A library of typed
classes, such as pygltflib, is longer to use here and drops the fields that it has no class for.

====================================  ================================================================
in the file                           behaviour
====================================  ================================================================
points, lines; no `POSITION`          left out; kept in copies
strips, fans                          read; a list of triangles in copies
no `indices`                          vertices in their order
integer UVs and positions             read, normalised or not (KHR_mesh_quantization)
strided, sparse, absent (zero) data   read
a mesh under two nodes                given twice; in copies each node has a mesh of its own, and equal
                                      data is stored once
a node that mirrors                   vertices keep the file's order: such triangles face the other way
skins, morph targets, animations      left out: the mesh is given at rest, under its node's transform
nodes outside the scene               left out; kept in copies
external `.bin`, `data:` URIs         read; in copies all in the one `.glb`
external images                       in copies inside the `.glb`; one that is missing or isn't PNG, JPEG,
                                      WebP, KTX2 or DDS keeps its URI
a buffer outside the file's folder    error, unless the file is trusted; such an image keeps its URI
more corners and vertices than        error, unless the file is trusted (`wlm.formats.limits`)
`limits` allow
Draco, meshopt, GPU instances         error that names the extension
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
from wlm.formats.limits import CORNERS, CORNERS_A_BYTE, JSON_BYTES, MESH_BYTES, SURE_CORNERS
from wlm.formats.reading import named_file, read_file

MAGIC = b"glTF"
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942

_URI_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
TRIANGLES, STRIP, FAN = 4, 5, 6

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""NumPy's names of glTF's component types."""

_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MATRIX_SIDES = {"MAT2": 2, "MAT3": 3, "MAT4": 4}
_LONGEST_STRIDE = 252  # bytes
_LABEL = 60  # letters of a name
_OVERHEAD = 256  # corners that take about as long as a primitive without any
_UV_NAME = re.compile(r"TEXCOORD_(0|[1-9]\d{0,3})")
_REFUSED = {
    "KHR_draco_mesh_compression": "decompress the mesh first",
    "EXT_meshopt_compression": "decompress the mesh first",
    "KHR_meshopt_compression": "decompress the mesh first",
    "EXT_mesh_gpu_instancing": "make its instances nodes first",
}


@dataclass(frozen=True, eq=False)
class GltfDocument:
    """A glTF file as it was read.

    Attributes:
        path: Its name, for messages and for what it refers to.
        content: The JSON tree; not to be changed.
        buffers: The bytes of each of its buffers.
        trust: Whether it may name files outside its folder, and draw more than its bytes account for.
        most: Corners and vertices that it may draw, and elements that an accessor without data may have.
    """

    path: str
    content: dict
    buffers: tuple[bytes, ...]
    trust: bool = False
    most: int = CORNERS

    def item(self, kind: str, number: object) -> dict:
        """Gives an entry of one of the tree's lists, `accessors` for example.

        Raises:
            WlmError: There is none of this number.
        """
        entries = self.content.get(kind, [])
        if not isinstance(number, int) or not 0 <= number < len(entries):
            raise WlmError(f"{self.path}: {kind}[{number}]: expected one of {len(entries)}")
        return entries[number]


@dataclass(frozen=True, eq=False)
class GltfPrimitive:
    """Triangles of one primitive under one node, with the vertices that they use.

    Attributes:
        node: Number of the node.
        mesh: Number of its mesh.
        primitive: Number of the primitive in the mesh.
        name: What messages call it.
        position: float64 [V, 3], in the scene's space.
        triangle: int32 [F, 3].
        uv: For each set n that the file has as `TEXCOORD_n`, float32 [V, 2]; u right, v down.
        row: int64 [V], where each vertex is in the primitive's accessors.
        label, mesh_label: The names of the node and of its mesh; "node 3", "mesh 2" where they have none.
        material: Number of its material; None: none.
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


def read_gltf(path: str | os.PathLike[str], trust: bool = False) -> tuple[GltfDocument, list[GltfPrimitive]]:
    """Reads a `.glb` or `.gltf` file; its first bytes tell which it is.

    Args:
        path: The file.
        trust: As in `GltfDocument`.

    Returns:
        The document, and the primitives with triangles that its scene draws (the default scene, else the first,
        else all nodes), in the order of the nodes, depth first.

    Raises:
        WlmError: One line that names the file and the field, for each error of the module's table.
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
        content = json.loads(text.decode("utf-8-sig"))
        if not isinstance(content, dict) or not isinstance(content.get("asset"), dict):
            raise WlmError(f"{path}: expected a glTF file, found other content")
        version = str(content["asset"].get("version"))
        if version.partition(".")[0] != "2":
            raise WlmError(f"{path}: asset.version: expected 2.0, found {version}")
        for name in (*content.get("extensionsUsed", []), *content.get("extensionsRequired", [])):
            if name in _REFUSED:
                raise WlmError(f"{path}: uses the extension {name}, which is not read here: {_REFUSED[name]}")
        buffers = _load_buffers(path, content.get("buffers", []), binary, trust)
        held = len(text) + sum(map(len, buffers))
        most = CORNERS if trust else min(CORNERS, max(SURE_CORNERS, CORNERS_A_BYTE * held))
        document = GltfDocument(str(path), content, buffers, trust, most)
        for i, view in enumerate(content.get("bufferViews", [])):
            _check_view(document, i, view)
        return document, _read_primitives(document)


Arrays = tuple[str, np.ndarray, np.ndarray, np.ndarray]
"""A mesh that came from elsewhere: its name, positions [V, 3], triangles int [F, 3] and UVs [V, 2]."""


def document_from_arrays(
    position: np.ndarray, triangle: np.ndarray, uv: np.ndarray, name: str
) -> tuple[GltfDocument, GltfPrimitive]:
    """Makes a document of one mesh, as `document_from_meshes`."""
    document, (primitive,) = document_from_meshes([(name, position, triangle, uv)], name)
    return document, primitive


def document_from_meshes(meshes: Sequence[Arrays], name: str) -> tuple[GltfDocument, list[GltfPrimitive]]:
    """Makes a document of meshes, for geometry that came from elsewhere. Each mesh has a node of its own.

    Args:
        meshes: At least one. Positions are in any unit and are stored as float32, UVs (u right, v down) as float32
            and `TEXCOORD_0`.
        name: What the document is called.

    Returns:
        The document and its primitives, one for each mesh.
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
        trees.append(
            {"primitives": [{"attributes": {"POSITION": first, "TEXCOORD_0": first + 1}, "indices": first + 2}]}
        )
        row, short = np.arange(len(points)), one_line(label, _LABEL)
        arrays = points.astype(np.float64), corners.astype(np.int32), {0: places}
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
    """Reads an accessor as it is encoded, its sparse part applied.

    Args:
        document: The document.
        number: Of the accessor.

    Returns:
        uint8 [count, bytes of an element], columns of small matrices padded as glTF pads them; maybe a view of
        the file's bytes.

    Raises:
        WlmError: The accessor lies outside its view or buffer, or has an unknown type.
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
    """Reads an accessor's numbers in their own type.

    Args:
        document: The document.
        number: Of the accessor.
        kind: The type that it must have, "VEC3" for example.

    Returns:
        [count, components].

    Raises:
        WlmError: It has another type, or an error of `elements`.
    """
    accessor = document.item("accessors", number)
    if accessor.get("type") != kind:
        raise WlmError(f"{document.path}: accessors[{number}].type: expected {kind}, found {accessor.get('type')}")
    return np.ascontiguousarray(elements(document, number)).view(COMPONENTS[accessor["componentType"]])


def vertex_normals(document: GltfDocument, primitives: Sequence[GltfPrimitive]) -> list[np.ndarray | None]:
    """The vertices' normals in the scene's space.

    Returns:
        For each primitive of the document float64 [V, 3], of unit length, or 0 where the file has none of any length;
        None: it has no `NORMAL`.

    Raises:
        WlmError: As for `read_gltf`.
    """
    with reported(document.path):
        transforms = dict(_walk(document))
        normals: list[np.ndarray | None] = []
        for each in primitives:
            attributes = document.item("meshes", each.mesh)["primitives"][each.primitive]["attributes"]
            if "NORMAL" not in attributes:
                normals.append(None)
                continue
            local = _floats(document, attributes["NORMAL"], "VEC3")
            if len(local) <= each.row.max():
                raise WlmError(f"{document.path}: {each.name}: NORMAL: expected {each.row.max() + 1} vertices or more")
            # By the cofactors, which are the inverse's transpose times the determinant, and exist for flat scales too.
            a, b, c = transforms[each.node][:3, :3].T
            side = -1.0 if a @ np.cross(b, c) < 0 else 1.0
            turn = side * np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
            turned = local[each.row].astype(np.float64) @ turn
            length = np.linalg.norm(turned, axis=1, keepdims=True)
            good = np.isfinite(length) & (length > 0)
            normals.append(np.divide(turned, length, out=np.zeros_like(turned), where=good))
        return normals


@contextmanager
def reported(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turns what Python raises on a malformed tree into one line."""
    try:
        yield
    except KeyError as error:
        raise WlmError(f"{path}: malformed glTF: the field {error} is missing") from error
    except (ValueError, TypeError, AttributeError, IndexError, OverflowError, RecursionError) as error:
        raise WlmError(f"{path}: malformed glTF: {error}") from error
    except MemoryError as error:
        raise WlmError(f"{path}: malformed glTF: a count too large for the memory") from error


def _check_view(document: GltfDocument, number: int, view: dict) -> None:
    """Says where a buffer view is not within its buffer."""
    where = f"{document.path}: bufferViews[{number}]"
    document.item("buffers", view["buffer"])
    start, length, held = view.get("byteOffset", 0), view["byteLength"], len(document.buffers[view["buffer"]])
    if not (isinstance(start, int) and isinstance(length, int) and start >= 0 and length >= 0):
        raise WlmError(f"{where}: expected whole numbers of 0 or more, found byteOffset {start}, byteLength {length}")
    if start + length > held:
        raise WlmError(f"{where}: needs {start + length} bytes of buffers[{view['buffer']}], which has {held}")


def _rows(document: GltfDocument, where: str, place: dict, count: int, size: int, strided: bool = False) -> np.ndarray:
    """Views `count` elements of `size` bytes at a place, an object with a bufferView and maybe a byteOffset."""
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
    drawn = 0

    def spend(count: int) -> None:
        nonlocal drawn
        drawn += count
        if drawn > document.most:
            raise WlmError(
                f"{document.path}: draws more than {document.most} corners and vertices, which is more than its data "
                "accounts for; trust=True (--trust of commands that have it) allows it, where the author is trusted"
            )

    def floats(number: int, kind: str) -> np.ndarray:
        if (number, kind) not in cache:
            spend(_count(document, number))
            cache[number, kind] = _floats(document, number, kind)
        return cache[number, kind]

    for node, transform in _walk(document):
        mesh_number = document.content["nodes"][node].get("mesh")
        if mesh_number is None:
            continue
        mesh = document.item("meshes", mesh_number)
        for i, primitive in enumerate(mesh["primitives"]):
            mode, attributes = primitive.get("mode", TRIANGLES), primitive["attributes"]
            if mode not in (TRIANGLES, STRIP, FAN) or "POSITION" not in attributes:
                continue
            local = floats(attributes["POSITION"], "VEC3")
            where = f"{document.path}: meshes[{mesh_number}].primitives[{i}]"
            # Of strips and fans three for each index; each attribute is gathered in copies.
            corners = _count(document, primitive["indices"]) if "indices" in primitive else len(local)
            spend(corners * (1 if mode == TRIANGLES else 3) + min(corners, len(local)) * len(attributes) + _OVERHEAD)
            triangle = _triangles(_corners(document, where, primitive, len(local)), mode, where)
            if not len(triangle):
                continue
            row, triangle = np.unique(triangle, return_inverse=True)
            sets = {int(match[1]): name for name in attributes if (match := _UV_NAME.fullmatch(name))}
            uv = {}
            for number, name in sorted(sets.items()):
                values = floats(attributes[name], "VEC2")
                if len(values) != len(local):
                    raise WlmError(f"{where}: {name}: expected {len(local)} vertices as POSITION, found {len(values)}")
                uv[number] = values[row]
            primitives.append(
                GltfPrimitive(
                    node=node,
                    mesh=mesh_number,
                    primitive=i,
                    name=f"node {node}, mesh {mesh_number}, primitive {i}",
                    position=local[row].astype(np.float64) @ transform[:3, :3].T + transform[:3, 3],
                    triangle=triangle.reshape(-1, 3).astype(np.int32),
                    uv=uv,
                    row=row,
                    label=_label(document.content["nodes"][node], f"node {node}"),
                    mesh_label=_label(mesh, f"mesh {mesh_number}"),
                    material=_material(where, primitive),
                )
            )
    return primitives


def _label(item: dict, other: str) -> str:
    name = item.get("name")
    return one_line(name, _LABEL) if isinstance(name, str) and name else other


def _material(where: str, primitive: dict) -> int | None:
    number = primitive.get("material")
    if number is not None and (not isinstance(number, int) or isinstance(number, bool)):
        raise WlmError(f"{where}.material: expected a whole number, found {one_line(number, _LABEL)}")
    return number


def _count(document: GltfDocument, number: int) -> int:
    """Elements that an accessor states; 0 where it states none, which is told when it is read."""
    count = document.item("accessors", number).get("count")
    return count if isinstance(count, int) else 0


def _floats(document: GltfDocument, number: int, kind: str) -> np.ndarray:
    """Reads an accessor as float32 [count, components], integers scaled where it says so."""
    values = components(document, number, kind)
    if values.dtype.kind != "f" and document.content["accessors"][number].get("normalized", False):
        scaled = values.astype(np.float64) / np.iinfo(values.dtype).max
        return np.maximum(scaled, -1.0).astype(np.float32)
    return values.astype(np.float32)


def _corners(document: GltfDocument, where: str, primitive: dict, vertices: int) -> np.ndarray:
    """Gives the vertex of every corner, int64 [N]."""
    if "indices" not in primitive:
        return np.arange(vertices)
    index = components(document, primitive["indices"], "SCALAR")[:, 0]
    if index.dtype.kind != "u":
        raise WlmError(f"{where}.indices: expected unsigned integers, found {index.dtype}")
    if index.max() >= vertices:
        raise WlmError(f"{where}.indices: expected numbers below {vertices}, found {index.max()}")
    return index.astype(np.int64)


def _triangles(corner: np.ndarray, mode: int, where: str) -> np.ndarray:
    """Makes triangles [F, 3] of corners [N], as the specification's section on primitive topology orders them."""
    if mode == TRIANGLES:
        if len(corner) % 3:
            raise WlmError(f"{where}: expected three corners a triangle, found {len(corner)} corners")
        return corner.reshape(-1, 3)
    first = np.arange(max(len(corner) - 2, 0))
    if mode == FAN:
        return np.stack([corner[first + 1], corner[first + 2], np.full_like(first, corner[0])], axis=1)
    odd = first % 2
    return np.stack([corner[first], corner[first + 1 + odd], corner[first + 2 - odd]], axis=1)


def _walk(document: GltfDocument) -> Iterator[tuple[int, np.ndarray]]:
    """Yields the scene's nodes, depth first, each with its transform [4, 4] to the scene's space."""
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
            raise WlmError(f"{document.path}: nodes[{number}]: expected one parent, found it twice in the scene")
        visited.add(number)
        transform = above @ _transform(node)
        yield number, transform
        stack += [(child, transform) for child in reversed(node.get("children", []))]


def _transform(node: dict) -> np.ndarray:
    """The node's own transform [4, 4]: its matrix, else translation * rotation * scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # stored by columns
    transform = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    norm = x * x + y * y + z * z + w * w
    if norm > 0:  # exporters round quaternions; of an all-zero one nothing can be made
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
    """Gives the JSON and the binary chunk of a `.glb`."""
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
            raise WlmError(f"{path}: a chunk at byte {at} of {size} bytes goes beyond the file's {length}")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if JSON_CHUNK not in chunks:
        raise WlmError(f"{path}: the .glb file has no JSON chunk")
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK)


def _load_buffers(
    path: str | os.PathLike[str], buffers: Sequence[dict[str, Any]], binary: bytes | None, trust: bool
) -> tuple[bytes, ...]:
    """Gives the bytes of each buffer, at least as many as it states.

    Args:
        path: The document.
        buffers: Their entries in the tree.
        binary: The `.glb`'s binary chunk, if there is one.
        trust: Whether they may be files outside the document's folder.

    Raises:
        WlmError: One can't be read, is shorter, or is the file of an earlier one.
    """
    files: dict[Path, int] = {}
    return tuple(_load_buffer(path, number, buffer, binary, trust, files) for number, buffer in enumerate(buffers))


def _load_buffer(
    path: str | os.PathLike[str],
    number: int,
    buffer: dict[str, Any],
    binary: bytes | None,
    trust: bool,
    files: dict[Path, int],
) -> bytes:
    uri, length = buffer.get("uri"), buffer["byteLength"]
    where = f"{path}: buffers[{number}]"
    if uri is None:
        if number or binary is None:
            raise WlmError(f"{where}: has no uri, and the file no binary chunk for it")
        data = binary
    elif uri.startswith("data:"):
        head, comma, body = uri.partition(",")
        if not comma:
            raise WlmError(f"{where}.uri: expected data: with a comma before its content")
        data = unquote_to_bytes(body)
        if head.endswith(";base64"):
            try:
                data = base64.b64decode(data, validate=True)
            except binascii.Error as error:
                raise WlmError(f"{where}.uri: expected base64: {error}") from error
    else:
        if not isinstance(length, int) or length < 1:
            raise WlmError(f"{where}.byteLength: expected at least 1, found {length}")
        file = local_file(str(path), uri, f"{where}.uri", trust).resolve()
        # One file, read for each of thousands of buffers, would fill any memory.
        earlier = files.setdefault(file, number)
        if earlier != number:
            raise WlmError(f"{where}.uri: expected another file than that of buffers[{earlier}], found {uri}")
        data = read_file(file, MESH_BYTES, f"buffers[{number}] of {path}", first=length)
    if len(data) < length:
        raise WlmError(f"{where}: expected {length} bytes, found {len(data)}")
    return data


def local_file(document_path: str, uri: str, where: str, trust: bool) -> Path:
    """Gives the file that a URI names relative to the document.

    Raises:
        WlmError: The URI has a scheme or is an absolute path, or the file lies outside the document's folder and the
            document isn't trusted.
    """
    name = unquote(uri)
    if _URI_SCHEME.match(uri) or Path(name).is_absolute():
        raise WlmError(f"{where}: expected a file relative to it, found {uri}")
    return named_file(document_path, name, where, trust)
