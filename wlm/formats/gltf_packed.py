"""Decompression of glTF meshes: KHR_draco_mesh_compression, EXT_meshopt_compression and KHR_meshopt_compression.

Both need the extra `gltf`: Draco is decoded by DracoPy in a process of its own (`draco_child`), meshopt by meshopt. The
result is a document without the extension, whose compressed parts are in new buffers.
"""

import copy
import json
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats import draco_child
from wlm.formats.child import run_child
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import GROWTH, SURE_BYTES, check_growth
from wlm.formats.reading import damaged

DRACO, MESHOPT = "KHR_draco_mesh_compression", ("EXT_meshopt_compression", "KHR_meshopt_compression")
_EXTRA = "gltf"


def is_fallback(buffer: dict[str, Any]) -> bool:
    """Tests whether a buffer is a place for decompressed data that has no bytes in the file."""
    return "uri" not in buffer and any(
        buffer.get("extensions", {}).get(name, {}).get("fallback", False) for name in MESHOPT
    )


def unpack(
    path: str | os.PathLike[str], content: dict, buffers: Sequence[bytes], components: dict[int, str]
) -> tuple[dict, tuple[bytes, ...]]:
    """Decompresses the buffer views and primitives of a glTF tree, with the bytes of each buffer and the NumPy types of
    component types; returns the tree and the buffers, those that were given if nothing is compressed."""
    stated = (*content.get("extensionsUsed", []), *content.get("extensionsRequired", []))
    used = [name for name in (DRACO, *MESHOPT) if name in stated]
    if not used:
        return content, tuple(buffers)
    content, buffers = copy.deepcopy(content), list(buffers)
    held = sum(map(len, buffers))
    if set(used) & set(MESHOPT):
        _unpack_views(path, content, buffers, held)
    if DRACO in used:
        _unpack_primitives(path, content, buffers, held, components)
    for name in ("extensionsUsed", "extensionsRequired"):
        if name in content:
            content[name] = [each for each in content[name] if each not in used]
    for holder in (*content["bufferViews"], *(each for mesh in content["meshes"] for each in mesh["primitives"])):
        if holder.get("extensions") == {}:
            del holder["extensions"]
    for number, buffer in enumerate(content["buffers"]):
        if is_fallback(buffer):
            content["buffers"][number] = {"byteLength": len(buffers[number])}
    return content, tuple(buffers)


def _needed(path: str | os.PathLike[str], package: str, extension: str) -> Any:
    try:
        return need(package, _EXTRA)
    except WlmError as error:
        raise WlmError(f"{path}: uses the extension {extension}: {error}, or export the file without it") from error


def _add(content: dict, buffers: list[bytes], data: bytes, **extra: Any) -> dict[str, Any]:
    content["buffers"].append({"byteLength": len(data)})
    buffers.append(data)
    return {"buffer": len(buffers) - 1, "byteLength": len(data), **extra}


def _unpack_views(path: str | os.PathLike[str], content: dict, buffers: list[bytes], held: int) -> None:
    total = 0
    for number, view in enumerate(content.get("bufferViews", [])):
        name = next((each for each in MESHOPT if each in view.get("extensions", {})), None)
        if name is None:
            continue
        where = f"{path}: bufferViews[{number}].{name}"
        meshopt = _needed(path, "meshopt", name)
        packed = view["extensions"].pop(name)
        count, stride, length, source = (packed[each] for each in ("count", "byteStride", "byteLength", "buffer"))
        start = packed.get("byteOffset", 0)
        if not all(isinstance(each, int) and each >= 0 for each in (count, stride, start, length, source)):
            raise WlmError(f"{where}: expected whole numbers of 0 or more")
        if source >= len(buffers) or start + length > len(buffers[source]):
            raise WlmError(f"{where}: needs {start + length} bytes of buffers[{source}], which lacks them")
        total += count * stride
        check_growth(where, held, total)
        with damaged(f"{where}: damaged", ValueError, RuntimeError, TypeError):
            options = (packed["mode"], packed.get("filter", "NONE"))
            data = meshopt.decode_gltf_buffer(buffers[source][start : start + length], count, stride, *options)
        rows = {"byteStride": stride} if packed["mode"] == "ATTRIBUTES" else {}
        view |= {"byteOffset": 0} | _add(content, buffers, np.asarray(data).tobytes(), **rows)


def _unpack_primitives(
    path: str | os.PathLike[str], content: dict, buffers: list[bytes], held: int, components: dict[int, str]
) -> None:
    found = [
        (f"meshes[{i}].primitives[{k}].{DRACO}", primitive, primitive["extensions"].pop(DRACO))
        for i, mesh in enumerate(content.get("meshes", []))
        for k, primitive in enumerate(mesh["primitives"])
        if DRACO in primitive.get("extensions", {})
    ]
    if not found:
        return
    _needed(path, "DracoPy", DRACO)
    pieces = []
    for where, _, packed in found:
        view = content["bufferViews"][packed["bufferView"]]
        start = view.get("byteOffset", 0)
        pieces.append(buffers[view["buffer"]][start : start + view["byteLength"]])
        if sum(map(len, pieces)) > held:
            raise WlmError(
                f"{path}: {where}: expected compressed data of its own, found data that other primitives name too"
            )
    sizes = json.dumps([len(each) for each in pieces]).encode()
    with damaged(f"{path}: {DRACO}: damaged", ValueError):
        arrays = run_child(draco_child, b"\n".join((sizes, b"".join(pieces))), str(max(SURE_BYTES, GROWTH * held)))
    for mesh, (where, primitive, packed) in enumerate(found):
        places = [(name, primitive["attributes"][name], number) for name, number in packed["attributes"].items()]
        for name, place, number in [*places, ("indices", primitive.get("indices"), -1)]:
            if place is None or f"{mesh},{number}" not in arrays:
                raise WlmError(
                    f"{path}: {where}: {name}: expected both an accessor and compressed data, found at most one"
                )
            accessor, data = content["accessors"][place], arrays[f"{mesh},{number}"]
            data = data.reshape(-1, 1) if number == -1 else data
            if len(data) != accessor["count"]:
                raise WlmError(f"{path}: {where}: {name}: expected {accessor['count']} elements, found {len(data)}")
            content["bufferViews"].append(
                _add(content, buffers, data.astype(components[accessor["componentType"]]).tobytes())
            )
            accessor |= {"bufferView": len(content["bufferViews"]) - 1, "byteOffset": 0}
