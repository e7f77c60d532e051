"""Writes a page as one HTML file: scripts and style, a JSON manifest, and arrays compressed by zlib in base64."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Literal

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.geometry import Geometry

_ALIGNMENT = 16  # bytes; alignment of arrays in the content
_COMMON = ("content.js", "graphics.js", "blocks.js", "camera.js", "panel.js", "light.js", "surface.js", "reading.js")


@dataclass(frozen=True, eq=False)
class Page:
    """The content of a page.

    Its kind, `lightmap`, `atlas`, `probe`, `smoke`, `scene` or `viewer`, selects the main script, which may need
    further `scripts` and reads `manifest`, JSON values, and `arrays` by name. The panel shows the title, a sentence
    below it, which may be empty, and the table `figures`, of a name and a text each.
    """

    kind: str
    title: str
    note: str
    figures: Sequence[tuple[str, str]]
    manifest: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    scripts: Sequence[str] = ()

    def write(self, path: str | os.PathLike[str]) -> int:
        """Writes the page atomically. Returns the size of the file in bytes."""
        content, places, held = bytearray(), {}, dict[bytes, list[int]]()
        for name, values in self.arrays.items():
            part = np.ascontiguousarray(values).tobytes()
            if part not in held:  # equal arrays are stored once
                content += bytes(-len(content) % _ALIGNMENT)
                held[part] = [len(content), len(part)]
                content += part
            places[name] = held[part]
        manifest = {
            "kind": self.kind,
            "title": self.title,
            "note": self.note,
            "figures": [list(figure) for figure in self.figures],
            **self.manifest,
            "arrays": places,
            "bytes": len(content),
        }
        try:
            # Without "<" no name can end the script element.
            text = json.dumps(manifest, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
        except ValueError as error:
            raise WlmError(f"{self.title}: cannot make the page: a number for its script is NaN or infinite") from error
        scripts = [*map(asset, _COMMON), *self.scripts, *map(asset, (f"{self.kind}.js", "main.js"))]
        script = "\n".join(["'use strict';", *scripts])
        pieces = {
            # The browser runs this script alone, whatever a name brought into the page.
            "SCRIPT-HASH": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
            "TITLE": html.escape(self.title),
            "STYLE": asset("page.css"),
            "MANIFEST": text,
            "CONTENT": base64.b64encode(zlib.compress(bytes(content), 9)).decode(),
            "SCRIPT": script,
        }
        # The template is split before it is filled, since the parts may contain marks.
        first, *rest = asset("page.html").split("@")
        page = [first, *(pieces.get(part, part) for part in rest)]
        return atomic_write(path, "".join(page).encode())


def pack_triangles(geometry: Geometry, up: Literal["y", "z"]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns a mesh's arrays by their names in the script, and its bounding box as entries of the manifest."""
    parts = {"position": geometry.position, "triangles": geometry.triangle, "uv": geometry.uv}
    low, high = geometry.box
    box = {"low": low.tolist(), "high": high.tolist(), "up": "xyz".index(up), "inward": geometry.is_room}
    return {name: values for name, values in parts.items() if values is not None}, box


def compare_sizes(stored: int, original: int, kind: str = "half floats") -> list[tuple[str, str]]:
    """Returns rows of a page's table: the bytes of the original as numbers of a kind, and its ratio to those stored."""
    return [(f"original as {kind}", f"{original:,} bytes"), ("ratio", f"{original / stored:.1f}×")]


def asset(name: str) -> str:
    """Returns the text of a file of `assets`."""
    return (resources.files("wlm.export.page") / "assets" / name).read_text(encoding="utf-8").rstrip("\n")
