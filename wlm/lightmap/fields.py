"""Checks of the fields of a `set.json`; an error names the field, the expected and the found value."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from wlm.errors import WlmError
from wlm.formats.reading import read_json_file


def read_set(path: Path) -> dict[str, Any]:
    """Reads a `set.json`.

    Raises:
        WlmError: It cannot be read, or is not a JSON object.
    """
    content = read_json_file(path, "the set")
    if not isinstance(content, dict):
        raise WlmError(f"{path}: expected a JSON object, got {kind(content)}")
    return content


def field(path: Path, holder: dict[str, Any], key: str, place: str, ok: Callable[[Any], bool], expected: str) -> Any:
    """Returns the value of a field of an object at a place of the file, such as `lightmaps[0].`, if `ok` accepts it.

    Raises:
        WlmError: The field is missing or wrong; the line names the place, the key and the expected values.
    """
    if key not in holder:
        raise WlmError(f"{path}: {place}{key} is missing; expected {expected}")
    if not ok(holder[key]):
        raise WlmError(f"{path}: {place}{key}: expected {expected}, got {kind(holder[key])}")
    return holder[key]


def name_of(path: Path, content: dict[str, Any]) -> str:
    """Returns the name of the set: its own, or that of its folder."""
    if content.get("name") is None:
        return path.resolve().parent.name
    return field(path, content, "name", "", is_text, "a name")


def period_of(path: Path, content: dict[str, Any]) -> float | None:
    """Returns the length of the day of the set, or None."""
    if content.get("period_hours") is None:
        return None
    return float(field(path, content, "period_hours", "", is_positive, "a number above 0"))


def is_text(value: object) -> bool:
    """Returns whether a value is text that can be a name."""
    # File names cannot have a NUL or half of a surrogate pair.
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        return False
    return not any("\ud800" <= character <= "\udfff" for character in value)


def is_number(value: object) -> bool:
    """Returns whether a value is a finite number of a usable size."""
    # Python's True is an int, and its JSON reader accepts NaN, Infinity and integers of any length.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= 1e300


def is_positive(value: object) -> bool:
    """Returns whether a value is such a number above 0."""
    return is_number(value) and value > 0


def is_list(value: object) -> bool:
    """Returns whether a value is a list that is not empty."""
    return isinstance(value, list) and bool(value)


def is_size(value: object) -> bool:
    """Returns whether a value is a whole number above 0."""
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


def kind(value: object) -> str:
    """Describes a JSON value in a message: the value itself, or its kind if it is long."""
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}" if value else "an empty list"
    text = json.dumps(value) if not isinstance(value, int) or abs(value) < 1e300 else "a very large number"
    return text if len(text) <= 60 else text[:57] + "..."
