"""Writing of copies of a glTF file as `.glb`, in which some primitives have new vertices and one more UV set."""

import copy
import hashlib
import json
import os
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.gltf import (
    BINARY_CHUNK,
    COMPONENTS,
    JSON_CHUNK,
    MAGIC,
    TRIANGLES,
    GltfDocument,
    GltfPrimitive,
    elements,
    image_file,
    reported,
)
from wlm.formats.limits import MESH_BYTES
from wlm.formats.reading import read_file

_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_MAX_GLB = 2**32 - 1
# Keyed by the first bytes of a file; "." matches any byte.
_IMAGE_TYPES = {
    rb"\x89PNG\r\n\x1a\n": "image/png",
    rb"\xff\xd8\xff": "image/jpeg",
    rb"RIFF....WEBP": "image/webp",
    rb"\xabKTX 20\xbb\r\n\x1a\n": "image/ktx2",
    rb"DDS ": "image/vnd-ms.dds",
}
# Extensions that refer to vertices by index and would be wrong for the new vertices.
_OF_VERTICES = ("CESIUM_primitive_outline", "EXT_mesh_primitive_edge_visibility")
HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_mesh_quantization", "EXT_texture_")
"""Beginnings of the names of extensions that change no mesh, and refer to no accessor and no buffer view."""


@dataclass(frozen=True, eq=False)
class Replacement:
    """New vertices and triangles of a primitive.

    `gather`, int [V'], names for each new vertex the vertex of the primitive whose attributes it takes; `triangle`, int
    [F', 3], at least one, has indices of new vertices; `uv`, [V', 2], is the new UV, u right, v down, stored as
    float32.
    """

    primitive: GltfPrimitive
    gather: np.ndarray
    triangle: np.ndarray
    uv: np.ndarray


def write_glb(
    path: str | os.PathLike[str], document: GltfDocument, replacements: Sequence[Replacement], uv_set: int
) -> int:
    """Writes the result of `encode_glb` atomically and returns its size in bytes; also raises if the file can't be
    written."""
    return atomic_write(path, encode_glb(document, replacements, uv_set, path))


def encode_glb(
    document: GltfDocument,
    replacements: Sequence[Replacement] = (),
    uv_set: int = 1,
    path: str | os.PathLike[str] | None = None,
) -> list[bytes]:
    """Encodes a document as `.glb` with some primitives replaced and everything else unchanged.

    Attributes and morph targets keep their encoding. glTF requires consecutive UV sets, so missing sets below `uv_set`
    get the new UVs too. Unused data is dropped, unless the file has an extension that may refer to it in an unknown
    way. Extensions of a replaced primitive that refer to its vertices (CESIUM_primitive_outline,
    EXT_mesh_primitive_edge_visibility) are dropped.

    Args:
        document: The document.
        replacements: At most one for each primitive.
        uv_set: n of the new `TEXCOORD_n`, the same for all replacements.
        path: Name of the file in messages; None: the document's path.

    Returns:
        The bytes of the file, in pieces.

    Raises:
        ValueError: A primitive is replaced twice or already has the UV set, a shape is wrong or an index out of range.
        WlmError: A part of the document that reading did not check, since the scene does not draw it, is malformed;
            or the file would exceed the 4 GiB of the format.
    """
    for each in replacements:
        _check(each, uv_set)
    keys = [(each.primitive.node, each.primitive.primitive) for each in replacements]
    if len(set(keys)) < len(keys):
        raise ValueError("replacements: expected at most one for each primitive")
    with reported(document.path):
        tree = _Tree(document)
        meshes: dict[int, dict] = {}
        for each in sorted(replacements, key=lambda each: each.primitive.node):
            node = each.primitive.node
            meshes[node] = meshes[node] if node in meshes else tree.own_mesh(node)
            tree.replace(meshes[node]["primitives"][each.primitive.primitive], each, uv_set)
        tree.embed_images()
        # An extension may refer to data in an unknown way.
        if all(name.startswith(HARMLESS) for name in tree.content.get("extensionsUsed", [])):
            tree.keep("accessors", _accessor_slots)
            tree.payloads = [tree.payloads[number] for number in tree.keep("bufferViews", _view_slots)]
    return _pack(document.path if path is None else path, tree.content, tree.payloads)


class _Tree:
    """A growing copy of a document: its JSON tree, and the bytes of each buffer view."""

    def __init__(self, document: GltfDocument) -> None:
        self._document = document
        self.content = copy.deepcopy(document.content)
        self.payloads: list[bytes | memoryview] = []
        for view in self.content.setdefault("bufferViews", []):
            start = view.get("byteOffset", 0)
            self.payloads.append(memoryview(document.buffers[view["buffer"]])[start : start + view["byteLength"]])
        self.content.setdefault("accessors", [])
        self._users = Counter(node["mesh"] for node in self.content.get("nodes", []) if "mesh" in node)
        self._known: dict[object, int] = {}  # new views and accessors by their content

    def own_mesh(self, node: int) -> dict:
        """Returns the mesh of a node; a mesh that other nodes use too is copied first."""
        number = self.content["nodes"][node]["mesh"]
        if self._users[number] > 1:
            self._users[number] -= 1
            self.content["meshes"].append(copy.deepcopy(self._document.content["meshes"][number]))
            number = self.content["nodes"][node]["mesh"] = len(self.content["meshes"]) - 1
        return self.content["meshes"][number]

    def replace(self, primitive: dict, new: Replacement, uv_set: int) -> None:
        """Replaces the vertices and triangles of a primitive of the tree."""
        rows = new.primitive.row[new.gather]
        for attributes in (primitive["attributes"], *primitive.get("targets", [])):
            for name, number in attributes.items():
                attributes[name] = self._gathered(number, rows, bounds=name == "POSITION")
        uv = self._accessor(np.ascontiguousarray(new.uv, "<f4").view(np.uint8), _FLOAT, "VEC2", _VERTICES)
        for number in range(uv_set + 1):
            primitive["attributes"].setdefault(f"TEXCOORD_{number}", uv)
        # Index 65535 would restart the primitive.
        component, name = (_UINT16, "<u2") if len(new.gather) < 65536 else (_UINT32, "<u4")
        triangle = new.triangle[:, ::-1] if new.primitive.mirrored else new.triangle  # as the file has them
        corners = np.ascontiguousarray(triangle, name).reshape(-1, 1)
        primitive["indices"] = self._accessor(corners.view(np.uint8), component, "SCALAR", _INDICES)
        primitive["mode"] = TRIANGLES
        for name in _OF_VERTICES:
            primitive.get("extensions", {}).pop(name, None)
        if primitive.get("extensions") == {}:
            del primitive["extensions"]

    def embed_images(self) -> None:
        """Embeds the images of other files; an image that cannot be read or recognised keeps its URI."""
        for number, image in enumerate(self.content.get("images", [])):
            if "uri" not in image:
                continue
            try:
                data = read_file(image_file(self._document, number), MESH_BYTES, "the image")
            except WlmError:
                continue
            kind = next((kind for head, kind in _IMAGE_TYPES.items() if re.match(head, data, re.DOTALL)), None)
            if kind is None:
                continue
            del image["uri"]
            image |= {"bufferView": self._view(data, {}), "mimeType": kind}

    def keep(self, kind: str, slots: Callable[[dict], Iterable[tuple[dict, str]]]) -> list[int]:
        """Drops the entries of list `kind` that no reference in `slots` uses; returns the old indices of those kept."""
        places = list(slots(self.content))
        numbers = sorted({holder[key] for holder, key in places})
        new = {old: number for number, old in enumerate(numbers)}
        for holder, key in places:
            holder[key] = new[holder[key]]
        self.content[kind] = [self.content[kind][number] for number in numbers]
        return numbers

    def _gathered(self, number: int, rows: np.ndarray, bounds: bool) -> int:
        """Adds an accessor with some rows of accessor `number`, encoded as before; returns the new accessor's index."""
        old = self._document.content["accessors"][number]
        values = elements(self._document, number)[rows]
        extra = {"normalized": True} if old.get("normalized", False) else {}
        if bounds:
            numbers = np.ascontiguousarray(values).view(COMPONENTS[old["componentType"]])
            extra |= {"min": numbers.min(axis=0).tolist(), "max": numbers.max(axis=0).tolist()}
        return self._accessor(values, old["componentType"], old["type"], _VERTICES, **extra)

    def _accessor(self, values: np.ndarray, component: int, kind: str, target: int, **extra: object) -> int:
        """Adds an accessor of encoded elements, uint8 [count, size], unless an equal one exists; returns its index."""
        head: dict[str, object] = {"target": target}
        if target == _VERTICES:  # each vertex begins at a multiple of 4 bytes
            values = np.pad(values, ((0, 0), (0, -values.shape[1] % 4)))
            head["byteStride"] = values.shape[1]
        accessor = {
            "bufferView": self._view(values.tobytes(), head),
            "componentType": component,
            "count": len(values),
            "type": kind,
            **extra,
        }
        key = json.dumps(accessor)
        if key not in self._known:
            self.content["accessors"].append(accessor)
            self._known[key] = len(self.content["accessors"]) - 1
        return self._known[key]

    def _view(self, data: bytes, head: dict) -> int:
        key = (hashlib.blake2b(data).digest(), tuple(head.items()))
        if key not in self._known:
            self.content["bufferViews"].append({"buffer": 0, "byteLength": len(data), **head})
            self.payloads.append(data)
            self._known[key] = len(self.payloads) - 1
        return self._known[key]


def _check(new: Replacement, uv_set: int) -> None:
    where = new.primitive.name
    if uv_set < 0 or uv_set in new.primitive.uv:
        raise ValueError(f"uv_set: expected 0 or more, a UV set that {where} does not have, got {uv_set}")
    count = len(new.gather)
    if new.uv.shape != (count, 2) or new.triangle.ndim != 2 or new.triangle.shape[1] != 3 or not len(new.triangle):
        raise ValueError(
            f"{where}: expected uv [{count}, 2] and triangle [F, 3], F >= 1, got {new.uv.shape}, {new.triangle.shape}"
        )
    for field, numbers, limit in (("gather", new.gather, len(new.primitive.row)), ("triangle", new.triangle, count)):
        if numbers.min() < 0 or numbers.max() >= limit:
            raise ValueError(
                f"{where}: {field}: expected vertex numbers 0 to {limit - 1}, got {numbers.min()} to {numbers.max()}"
            )


def _accessor_slots(content: dict) -> Iterator[tuple[dict, str]]:
    for mesh in content.get("meshes", []):
        for primitive in mesh["primitives"]:
            for attributes in (primitive["attributes"], *primitive.get("targets", [])):
                for name in attributes:
                    yield attributes, name
            if "indices" in primitive:
                yield primitive, "indices"
    for skin in content.get("skins", []):
        if "inverseBindMatrices" in skin:
            yield skin, "inverseBindMatrices"
    for animation in content.get("animations", []):
        for sampler in animation["samplers"]:
            yield sampler, "input"
            yield sampler, "output"


def _view_slots(content: dict) -> Iterator[tuple[dict, str]]:
    for accessor in content["accessors"]:
        sparse = accessor.get("sparse", {})
        for holder in (accessor, sparse.get("indices", {}), sparse.get("values", {})):
            if "bufferView" in holder:
                yield holder, "bufferView"
    for image in content.get("images", []):
        if "bufferView" in image:
            yield image, "bufferView"


def _pack(
    path: str | os.PathLike[str], content: dict, payloads: Sequence[bytes | memoryview]
) -> list[bytes | memoryview]:
    """Places the buffer views' data (`payloads`) one after another in one buffer; returns the `.glb` file's pieces."""
    pieces: list[bytes | memoryview] = []
    start = 0
    for view, data in zip(content["bufferViews"], payloads, strict=True):
        view |= {"buffer": 0, "byteOffset": start}
        padding = bytes(-len(data) % 4)
        pieces += [data, padding]
        start += len(data) + len(padding)
    content["buffers"] = [{"byteLength": start}]
    for kind in ("accessors", "bufferViews"):  # glTF has no empty lists
        if not content[kind]:
            del content[kind]
    # An unpaired surrogate can only be written as an escape, which JSON and Python share.
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":")).encode("utf-8", "backslashreplace")
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + start
    if length > _MAX_GLB:
        raise WlmError(f"{path}: cannot write: {length} bytes exceed the 4 GiB of the .glb format")
    head = struct.pack("<4s4I", MAGIC, 2, length, len(text), JSON_CHUNK)
    return [head, text, struct.pack("<2I", start, BINARY_CHUNK), *pieces]
