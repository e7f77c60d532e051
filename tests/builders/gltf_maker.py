"""Assembles glTF files from bytes, views and accessors."""

import json
import struct
from pathlib import Path

import numpy as np

TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


class GltfMaker:
    """The JSON content and the buffer of a glTF file without nodes and meshes; `content` may state other buffers."""

    def __init__(self) -> None:
        self.blob = bytearray()
        self.content: dict = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}

    def view(self, data: bytes, **extra: object) -> int:
        self.blob += bytes(-len(self.blob) % 4)
        place = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        self.content["bufferViews"].append(place | extra)
        self.blob += data
        return len(self.content["bufferViews"]) - 1

    def add(self, array: np.ndarray, **extra: object) -> int:
        """Adds an accessor of an array [N] or [N, C]; rows are padded to 4 bytes where they are vertices."""
        rows = np.ascontiguousarray(array).reshape(len(array), -1)
        packed = rows.view(np.uint8)
        stride = {}
        if array.ndim > 1:
            packed = np.pad(packed, ((0, 0), (0, -packed.shape[1] % 4)))
            stride = {"byteStride": packed.shape[1]} if packed.shape[1] != 64 else {}
        self.content["accessors"].append(
            {
                "bufferView": self.view(packed.tobytes(), **stride),
                "componentType": COMPONENTS[array.dtype.name],
                "count": len(rows),
                "type": TYPES[rows.shape[1]],
                **extra,
            }
        )
        return len(self.content["accessors"]) - 1

    def glb(self) -> bytes:
        content = {"buffers": [{"byteLength": len(self.blob)}]} | self.content
        text = json.dumps(content).encode()
        text += b" " * (-len(text) % 4)
        blob = bytes(self.blob) + bytes(-len(self.blob) % 4)
        head = struct.pack("<4s4I", b"glTF", 2, 28 + len(text) + len(blob), len(text), 0x4E4F534A)
        return head + text + struct.pack("<2I", len(blob), 0x004E4942) + blob

    def save(self, path: Path) -> Path:
        path.write_bytes(self.glb())
        return path
