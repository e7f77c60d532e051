"""Files with other content under a digest that fits: anyone can write them, and only checks of their parts see it."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from builders.checks import error_of

import wlm
from wlm.formats.artifact import read_artifact, write_artifact

GONE = object()
"""Marks a value that is removed from the file."""

WEIRD = {
    "none": None,
    "true": True,
    "negative": -1,
    "zero": 0,
    "fraction": 1.5,
    "huge": 10**400,
    "text": "24",
    "list": [],
    "table": [[1, 2], [3, 4]],
    "mapping": {"a": {"b": 1}},
}
"""Values of other types and magnitudes, to put in place of a setting."""


def rewrite(
    path: Path,
    settings: Mapping[str, Any] | None = None,
    tensors: Mapping[str, np.ndarray | Callable[[np.ndarray], np.ndarray] | object] | None = None,
) -> None:
    """Replaces settings and parts of a file by the real writer; a split part is the list of its pieces."""
    artifact = read_artifact(path)
    contents, parts = [], {**artifact.tensors, **{name: list(pieces) for name, pieces in artifact.pieces.items()}}
    for values, changes in ((artifact.settings, settings or {}), (parts, tensors or {})):
        changed = {name: change(values[name]) if callable(change) else change for name, change in changes.items()}
        contents.append({name: value for name, value in {**values, **changed}.items() if value is not GONE})
    write_artifact(path, artifact.system, *contents, artifact.source)


def error_of_changed(
    model: Any, path: Path, settings: Mapping[str, Any] | None = None, tensors: Mapping[str, Any] | None = None
) -> str:
    """The error of the file of a model with other settings or parts, which names the file, when all of it is read."""
    model.save(path)
    rewrite(path, settings, tensors)
    text = error_of(lambda: wlm.load(path).check())
    assert text.startswith(str(path)), text
    return text


def rewrite_number(path: Path, key: str, text: str) -> None:
    """Writes a number that Python's writer refuses in place of a setting: `NaN`, `Infinity`, `1e999`."""
    place = "-" * 20
    rewrite(path, {key: place})
    content = path.read_bytes()
    # In the header `'` stands for the settings' own quotes.
    content = content.replace(f"'{place}'".encode(), text.rjust(len(place) + 2).encode())
    digest = re.search(rb'"wlm":"[^"]* ([0-9a-f]{32})"', content)[1]
    content = content.replace(digest, b"0" * 32, 1)
    index = content[: index_bytes(content)]
    path.write_bytes(content.replace(b"0" * 32, hashlib.blake2b(index, digest_size=16).hexdigest().encode(), 1))


def index_bytes(content: bytes) -> int:
    """The size of the index of an artifact by the documented rule: all but its split parts."""
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    entries = {name: entry["data_offsets"][1] for name, entry in header.items() if name != "__metadata__"}
    return start + max((end for name, end in entries.items() if f"{name}.pieces" not in entries), default=0)
