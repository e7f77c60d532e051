"""Reads probes from JSON: an object with a list for each field, or with a list `probes` of one object per probe."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import JSON_BYTES
from wlm.formats.reading import read_json_file

_PROBES = "probes"
_FLAGS = ("valid",)  # fields that may be booleans


def read_json(path: Path) -> Any:
    """Reads a JSON file and returns its content.

    Raises:
        WlmError: The file is missing, too long or not JSON.
    """
    return read_json_file(path, "the probes", JSON_BYTES)


def fields_of(path: Path, content: Any) -> tuple[list[str], Callable[[str], np.ndarray]]:
    """Returns the names of the probes' fields, and a function that reads the field of a name as an array.

    Raises:
        WlmError: The content has another form. The returned function raises it if a field is missing or not numeric.
    """
    if not isinstance(content, dict):
        raise WlmError(f"{path}: expected a JSON object, got {kind_of(content)}")
    if _PROBES not in content:
        return list(content), lambda field: numbers_of(path, field, _rows(path, content, field))
    probes = _rows(path, content, _PROBES)
    for i, probe in enumerate(probes):
        if not isinstance(probe, dict):
            raise WlmError(f"{path}: {_PROBES}[{i}]: expected an object (position, sh), got {kind_of(probe)}")

    def read(field: str) -> np.ndarray:
        for i, probe in enumerate(probes):
            if field not in probe:
                raise WlmError(f"{path}: {_PROBES}[{i}].{field} is missing")
        return numbers_of(path, field, [probe[field] for probe in probes])

    return list(probes[0]) if probes else ["position", "sh"], read


def _rows(path: Path, holder: dict, field: str) -> list:
    if not isinstance(holder.get(field), list):
        raise WlmError(f"{path}: {field}: expected a list, got {kind_of(holder.get(field))}")
    return holder[field]


def numbers_of(path: Path, field: str, rows: list) -> np.ndarray:
    """Converts nested lists of one shape to an array; booleans are allowed only in the fields `_FLAGS`.

    Raises:
        WlmError: The lists have several shapes, or an element is not a number.
    """
    kinds = "biuf" if field in _FLAGS else "iuf"
    array = _array(rows, kinds)
    if array is not None:
        return array
    shapes = [None if row is None else row.shape for row in (_array(row, kinds) for row in rows)]
    odd = next((i for i, shape in enumerate(shapes) if shape is None or shape != shapes[0]), 0)
    raise WlmError(f"{path}: {field}[{odd}]: expected numbers, as many as {field}[0] has, got {kind_of(rows[odd])}")


def _array(value: object, kinds: str) -> np.ndarray | None:
    """Converts a value to an array; None if its NumPy kind is not in `kinds`, as for text, null and ragged lists."""
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError):
        return None
    return array if array.dtype.kind in kinds else None


def kind_of(value: object) -> str:
    """Returns a short description of a JSON value for messages."""
    if isinstance(value, dict):
        return "an object"
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
