"""Reads probes from JSON and from tables of numbers (`.csv`, `.tsv`), by the names that other writers give to fields.

JSON is a list of one object per probe, an object with a list for each field, or a three.js scene; a table has a probe
in each line, with or without a line of names. The names that engines and exporters use for the position and the light
are known, in any case: `pos`, `location`, `coefficients`, `sphericalHarmonics`, one field for each colour channel
(`shRed`, `sh_r`) and others. A vector or colour may be an object (`x`, `y`, `z`; `r`, `g`, `b`), and numbers may be
members with a number (`sh[ 0]`, `shr0`).
"""

import json
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import JSON_BYTES, NUMBERS, PROBES
from wlm.formats.reading import damaged, open_file, read_json_file

_PROBES, _POSITION, _SH, _CONVENTION = "probes", "position", "sh", "convention"
_FLAGS = ("valid",)  # fields that may be booleans
_PLACES = ("position", "positions", "pos", "location", "center", "centre", "worldposition", "translation")
_LIGHTS = ("coefficients", "coefs", "coeffs", "harmonics", "lighting", "bakedprobes", "sphericalharmonics")
_LIGHTS = (*_LIGHTS, "sphericalharmonicscoefficients", "sphericalharmonicsl2", "irradiancecoefficients")
_CHANNELS = (("red", "green", "blue"), ("r", "g", "b"))
_AXIS = re.compile(r"(?:p|pos|position|world|worldposition)?([xyz])")
_NUMBERED = re.compile(r"[a-z]*?(red|green|blue|[rgb])?(\d{1,4})(red|green|blue|[rgb])?")
_UNITY = re.compile(r"sh\[ ?\d+\]|shr\d")  # members of Unity's SphericalHarmonicsL2
_VCI = "sphericalHarmonicsCoefficientsRed"  # of the glTF extension VCAST_vci_location_lighting
_DEEPEST = 6  # levels that are searched or converted
_LONGEST_LINE = 1 << 20  # characters


class Fields(NamedTuple):
    """The fields of probes in a JSON file. The position and the light have the `names` "position" and "sh". `read`
    reads a field as an array; it raises a WlmError if the field is missing or not numeric. `convention` is the SH
    convention that the file states or that follows from its kind, `axes` a remark on the axes of the positions; both
    are "" if unknown."""

    names: list[str]
    read: Callable[[str], np.ndarray]
    convention: str = ""
    axes: str = ""


class _Columns(NamedTuple):
    """The members of a file that hold each field, and whether those of the light go colour channel by channel."""

    members: dict[str, list[str]]
    by_channel: bool


def holds_probes(content: Any) -> bool:
    """Whether the content of a JSON file looks like probes."""
    if isinstance(content, dict) and (_PROBES in content or _POSITION in content or _is_scene(content)):
        return True
    found = _list_of_probes(content)
    names = _columns(found[1][0] if found else content if isinstance(content, dict) else {}).members
    return _POSITION in names and any(name.startswith(_SH) for name in names)


def read_positions(path: Path) -> np.ndarray:
    """Reads the positions of probes, or a list of points, from a JSON file as an array. Raises a WlmError if the file
    cannot be read or its content has another form."""
    content = read_json_file(path, "the probes", JSON_BYTES)
    if isinstance(content, list) and _list_of_probes(content) is None:
        return _numbers(path, _POSITION, content)
    return _fields(path, content).read(_POSITION)


def read_fields(path: Path) -> Fields:
    """Finds the fields of the probes in a JSON file. Raises a WlmError if the file cannot be read or its content has
    another form."""
    content = read_json_file(path, "the probes", JSON_BYTES)
    fields = _fields(path, content)
    stated = content.get(_CONVENTION, fields.convention) if isinstance(content, dict) else fields.convention
    if not isinstance(stated, str):
        raise WlmError(f"{path}: {_CONVENTION}: expected a string, got {_kind(stated)}")
    return fields._replace(convention=stated)


def _fields(path: Path, content: Any) -> Fields:
    if isinstance(content, dict) and _is_scene(content):
        return _scene(path, content["object"])
    found = _list_of_probes(content)
    if found is None and not isinstance(content, dict):
        raise WlmError(f"{path}: expected a JSON object, got {_kind(content)}")
    if found is None and _PROBES not in content:
        first = {name: rows[0] if isinstance(rows, list) and rows else None for name, rows in content.items()}
        columns, rows_of = _columns(first), lambda name: _rows(path, content, name)
    else:
        where, probes = found or (_PROBES, _rows(path, content, _PROBES))
        for i, probe in enumerate(probes):
            if not isinstance(probe, dict):
                raise WlmError(f"{path}: {where}[{i}]: expected an object (position, sh), got {_kind(probe)}")
        columns = _columns(probes[0] if probes else {_POSITION: 0, _SH: 0})

        def rows_of(name: str) -> list:
            for i, probe in enumerate(probes):
                if name not in probe:
                    raise WlmError(f"{path}: {where}[{i}].{name} is missing")
            return [probe[name] for probe in probes]

    light = columns.members.get(_SH, [""])
    vci = _VCI in light

    def read(name: str) -> np.ndarray:
        members = columns.members.get(name, [name])
        arrays = [_numbers(path, member, rows_of(member)) for member in members]
        if len({array.shape for array in arrays}) > 1:
            raise WlmError(f"{path}: {', '.join(members[:3])}: expected as many numbers in each of these fields")
        array = arrays[0] if len(arrays) == 1 else np.stack(arrays, axis=1)
        if name == _SH and columns.by_channel:
            return array.reshape(len(array), 3, -1)
        if name == _POSITION and array.ndim == 1 and len(array) % 3 == 0:  # the numbers in one list
            array = array.reshape(-1, 3)
        return array * [-1.0, 1.0, 1.0] if vci and name == _POSITION and array.shape[1:] == (3,) else array

    axes = "x of the positions negated, from glTF's axes back to Unity's, in which the light is" if vci else ""
    return Fields(list(columns.members), read, "unity" if vci or _UNITY.fullmatch(light[0]) else "", axes)


def _columns(first: dict[str, Any]) -> _Columns:
    """Finds by their names which members of a JSON object hold a probe's position and light; `first` has examples."""
    names = list(first)
    known = {_plain(name): name for name in reversed(names)}
    place = [_POSITION] if _POSITION in first else [known[each] for each in _PLACES if each in known][:1]
    place = place or _axes(names)
    own = any(name.startswith(_SH) for name in names)
    found = []  # members for red, green and blue
    for channels in _CHANNELS:
        for name in known:
            stem = name.removesuffix(channels[0])
            members = [known.get(stem + channel, "") for channel in channels]
            if name != stem and all(members) and (stem or not own):
                found.append(members)
    light, by_channel = found[0] if len(found) == 1 else [], len(found) == 1
    if not light:
        light, by_channel = _light(
            [name for name in names if name not in place and isinstance(first[name], int | float)]
        )
    if not (light or own):
        light = [known[each] for each in _LIGHTS if each in known][:1]
    members = {name: [name] for name in names if name not in place and name not in light}
    members |= {field: each for field, each in ((_POSITION, place), (_SH, light)) if each}
    return _Columns(members, by_channel)


def _plain(name: str) -> str:
    return re.sub(r"[^0-9a-z]", "", name.lower().removeprefix("m_"))


def _axes(names: list[str]) -> list[str]:
    found = {match[1]: name for name in reversed(names) if (match := _AXIS.fullmatch(_plain(name)))}
    return [found[axis] for axis in "xyz"] if len(found) == 3 else []


def _light(names: list[str]) -> tuple[list[str], bool]:
    """Finds names with consecutive numbers (`sh0`, `sh[ 1]`), or one such series per colour channel (`shr0`, `c0_g`).
    Returns the names in order, and whether they go channel by channel; no names if they do not form a full set."""
    found = {}
    for name in names:
        if match := _NUMBERED.fullmatch(_plain(name)):
            found[(match[1] or match[3] or "")[:1], int(match[2])] = name
    numbers = {channel: sorted(number for each, number in found if each == channel) for channel, _ in found}
    count = range(min(each[0] for each in numbers.values()), 1 + max(map(max, numbers.values()))) if numbers else []
    if set(numbers) not in ({""}, set("rgb")) or any(each != list(count) for each in numbers.values()):
        return [], False
    return [found[channel, number] for channel in sorted(numbers, reverse=True) for number in count], "r" in numbers


def _list_of_probes(content: Any) -> tuple[str, list] | None:
    """Finds the first list of objects with a position, in the file or in an object within it, and its name."""
    waiting = [("", content, 0)]
    for name, value, depth in waiting:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            place = _columns(value[0]).members.get(_POSITION)
            if place is not None and len(value[0]) > len(place):  # more than a point
                return name or _PROBES, value
        elif isinstance(value, dict) and depth < _DEEPEST:
            waiting += [(key, member, depth + 1) for key, member in value.items() if isinstance(member, dict | list)]
    return None


def _is_scene(content: dict[str, Any]) -> bool:
    metadata = content.get("metadata")
    return isinstance(content.get("object"), dict) and isinstance(metadata, dict) and metadata.get("type") == "Object"


def _scene(path: Path, root: dict[str, Any]) -> Fields:
    """Returns the probes of a three.js scene: `LightProbe` with its `matrix`, those of its parents, and `intensity`."""
    position, light = [], []
    waiting = [(root, np.eye(4))]
    while waiting:
        node, parent = waiting.pop()
        name = str(node.get("name") or node.get("uuid") or node.get("type"))[:40]
        matrix = _numbers(path, f"{name}.matrix", [node.get("matrix", np.eye(4).ravel().tolist())])
        if matrix.shape != (1, 16):
            raise WlmError(f"{path}: {name}.matrix: expected 16 numbers, got {matrix.shape[1:]}")
        with np.errstate(over="ignore", invalid="ignore"):
            world = parent @ matrix.reshape(4, 4).T  # stored column by column
        if node.get("type") == "LightProbe":
            value = _numbers(path, f"{name}.sh", [node.get("sh")])
            intensity = _numbers(path, f"{name}.intensity", [node.get("intensity", 1)])
            if value.ndim != 2 or intensity.shape != (1,):
                raise WlmError(f"{path}: {name}: expected a list of numbers sh and one number intensity")
            position.append(world[:3, 3])
            light.append(value.reshape(-1, 3) * intensity if value.size % 3 == 0 else value)
        children = node.get("children", [])
        if not isinstance(children, list) or not all(isinstance(child, dict) for child in children):
            raise WlmError(f"{path}: {name}.children: expected a list of objects")
        waiting += [(child, world) for child in reversed(children)]
    if len({each.shape for each in light}) > 1:
        raise WlmError(f"{path}: expected as many SH coefficients in each LightProbe as in the first")
    arrays = {_POSITION: np.array(position).reshape(-1, 3), _SH: np.array(light)}
    return Fields(list(arrays), arrays.__getitem__, "threejs", "positions in the world of the scene, y up")


def _rows(path: Path, holder: dict, field: str) -> list:
    if not isinstance(holder.get(field), list):
        raise WlmError(f"{path}: {field}: expected a list, got {_kind(holder.get(field))}")
    return holder[field]


def _numbers(path: Path, field: str, rows: list) -> np.ndarray:
    """Converts nested lists of one shape to an array; booleans are allowed only in the fields `_FLAGS`. Raises a
    WlmError if the lists have several shapes, or an element is not a number."""
    kinds = "biuf" if field in _FLAGS else "iuf"
    array = _array(rows, kinds)
    if array is None and any(isinstance(row, dict | list) for row in rows[:1]):
        array = _array(_listed(rows, 0), kinds)
    if array is not None:
        return array
    shapes = [None if row is None else row.shape for row in (_array(row, kinds) for row in rows)]
    odd = next((i for i, shape in enumerate(shapes) if shape is None or shape != shapes[0]), 0)
    raise WlmError(f"{path}: {field}[{odd}]: expected numbers, as many as {field}[0] has, got {_kind(rows[odd])}")


def _listed(value: Any, depth: int) -> Any:
    """Replaces JSON objects in a value by lists of members x, y, z or r, g, b or numbered; a lone member by itself."""
    if depth > _DEEPEST or not isinstance(value, dict | list):
        return value
    if isinstance(value, list):
        return [_listed(each, depth + 1) for each in value] if value and isinstance(value[0], dict | list) else value
    known = {_plain(name): name for name in value}
    for names in (("x", "y", "z"), *_CHANNELS):
        if set(names) <= known.keys():
            return [_listed(value[known[name]], depth + 1) for name in names]
    if len(value) == 1:
        return _listed(next(iter(value.values())), depth + 1)
    numbered, by_channel = _light(list(value))
    if len(numbered) != len(value):
        return value
    row = [value[name] for name in numbered]
    count = len(row) // 3
    return [row[i : i + count] for i in range(0, len(row), count)] if by_channel else row


def _array(value: object, kinds: str) -> np.ndarray | None:
    """Converts a value to an array; None if its NumPy kind is not in `kinds`, as for text, null and ragged lists."""
    with suppress(ValueError, OverflowError):
        array = np.asarray(value)
        return array if array.dtype.kind in kinds else None
    return None


def _kind(value: object) -> str:
    text = "an object" if isinstance(value, dict) else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def read_table(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Reads a table. Without a line of names, a line has the position, then the numbers.

    Returns:
        Positions, float64 [N, 3]; values, float64 [N, D], or [N, 3, C] if the names state the channels; and a remark
        on columns that are ignored, "" for none.

    Raises:
        WlmError: The file is missing, too large, not a table of numbers, or its columns are unknown.
    """
    with damaged(f"{path}: not a table of numbers", ValueError, MemoryError), open_file(path, "the probes") as file:
        if (size := file.seek(0, 2)) > JSON_BYTES:
            raise WlmError(f"{path}: expected a table of at most {JSON_BYTES} bytes, found {size}")
        file.seek(0)
        first, skipped = b"", -1
        while not first and (line := file.readline(_LONGEST_LINE)):
            first, skipped = line.partition(b"#")[0].strip(b" \t\r\n\xef\xbb\xbf"), skipped + 1
        text = first.decode("utf-8", "replace")
        if "\0" in text:
            raise WlmError(f"{path}: expected a table in UTF-8, found UTF-16 or bytes that are no text")
        mark = next((mark for mark in ";\t," if mark in text), None)
        names = cells = [cell.strip().strip('"') for cell in text.split(mark)]
        if len(cells) > NUMBERS + 3:
            raise WlmError(f"{path}: expected at most {NUMBERS + 3} columns, found {len(cells)}")
        with suppress(ValueError):  # where a cell is a name
            names = [*"xyz", *(f"sh{i}" for i in range(len(list(map(float, cells))) - 3))]
        place = _axes(names)
        light, by_channel = _light([name for name in names if name not in place])
        if not (place and light) or len(set(names)) < len(names):
            listed = ", ".join(cells[:12]) or "none"
            raise WlmError(
                f"{path}: expected columns of a position and of light, named x, y, z and sh0, sh1 ... or r0, g0, b0 "
                f"..., or without names; found {listed}"
            )
        file.seek(0)
        # NumPy allocates as many rows as are allowed; a number and a mark take two bytes.
        most, skip = min(PROBES, size // (2 * len(cells))) + 1, skipped + (names is cells)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a table without lines
            rows = np.loadtxt(file, delimiter=mark, skiprows=skip, ndmin=2, max_rows=most, encoding="utf-8-sig")
    if not rows.size:
        raise WlmError(f"{path}: expected at least one probe, found none")
    if rows.shape[1] != len(names):
        raise WlmError(f"{path}: expected {len(names)} columns, as many as names, found {rows.shape[1]}")
    column = {name: i for i, name in enumerate(names)}
    position, values = (rows[:, [column[name] for name in part]] for part in (place, light))
    others = ", ".join(name for name in names if name not in place and name not in light)
    values = values.reshape(len(rows), 3, -1) if by_channel else values
    return position, values, f"without the columns {others}" if others else ""
