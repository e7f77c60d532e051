"""Reads probes from JSON: a list of one object per probe, or an object with a list for each field; three.js scenes.

The names that engines and exporters use for the position and the light are known, in any case: `pos`, `location`,
`coefficients`, `sphericalHarmonics`, one field for each colour channel (`shRed`, `sh_r`) and others. A vector or colour
may be an object (`x`, `y`, `z`; `r`, `g`, `b`), and numbers may be members with a number (`sh[ 0]`, `shr0`).
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import JSON_BYTES
from wlm.formats.reading import read_json_file
from wlm.probe.table import axes_of, light_columns, plain

_PROBES, _POSITION, _SH = "probes", "position", "sh"
_FLAGS = ("valid",)  # fields that may be booleans
_PLACES = ("position", "positions", "pos", "location", "center", "centre", "worldposition", "translation")
_LIGHTS = ("coefficients", "coefs", "coeffs", "harmonics", "lighting", "bakedprobes", "sphericalharmonics")
_LIGHTS = (*_LIGHTS, "sphericalharmonicscoefficients", "sphericalharmonicsl2", "irradiancecoefficients")
_CHANNELS = (("red", "green", "blue"), ("r", "g", "b"))
_DEEPEST = 6  # levels that are searched or converted
_UNITY = re.compile(r"sh\[ ?\d+\]|shr\d")  # members of Unity's SphericalHarmonicsL2
_VCI = "sphericalHarmonicsCoefficientsRed"  # of the glTF extension VCAST_vci_location_lighting


class _Source(NamedTuple):
    """The members of the file that a field is read from, and whether they go colour channel by channel."""

    members: list[str]
    by_channel: bool = False


@dataclass(frozen=True)
class Fields:
    """The fields of probes in a JSON file.

    Attributes:
        names: The names of the fields; the position and the light have the names "position" and "sh".
        read: Reads a field as an array. Raises WlmError if it is missing or not numeric.
        convention: The SH convention that follows from the kind of file, "" if unknown.
        axes: A remark on the axes of the positions, "" if there is none.
    """

    names: list[str]
    read: Callable[[str], np.ndarray]
    convention: str = ""
    axes: str = ""


def read_json(path: Path) -> Any:
    """Reads a JSON file and returns its content.

    Raises:
        WlmError: The file is missing, too long or not JSON.
    """
    return read_json_file(path, "the probes", JSON_BYTES)


def holds_probes(content: Any) -> bool:
    """Whether the content of a JSON file looks like probes."""
    if isinstance(content, dict) and (_PROBES in content or _POSITION in content or _is_scene(content)):
        return True
    found = _list_of_probes(content)
    first = found[1][0] if found else content if isinstance(content, dict) else {}
    sources = _sources(first)
    return _POSITION in sources and any(name.startswith(_SH) for name in sources)


def positions_of(path: Path, content: Any) -> np.ndarray:
    """Reads the positions of probes, or a list of points, as an array.

    Raises:
        WlmError: The content has another form.
    """
    if isinstance(content, list) and _list_of_probes(content) is None:
        return numbers_of(path, _POSITION, content)
    return fields_of(path, content).read(_POSITION)


def fields_of(path: Path, content: Any) -> Fields:
    """Finds the fields of the probes in the content of a JSON file.

    Raises:
        WlmError: The content has another form.
    """
    if isinstance(content, dict) and _is_scene(content):
        return _scene(path, content["object"])
    found = _list_of_probes(content)
    if found is None:
        if not isinstance(content, dict):
            raise WlmError(f"{path}: expected a JSON object, got {kind_of(content)}")
        if _PROBES not in content:
            first = {name: rows[0] if isinstance(rows, list) and rows else None for name, rows in content.items()}
            return _fields(path, _sources(first), lambda name: numbers_of(path, name, _rows(path, content, name)))
        found = _PROBES, _rows(path, content, _PROBES)
    where, probes = found
    for i, probe in enumerate(probes):
        if not isinstance(probe, dict):
            raise WlmError(f"{path}: {where}[{i}]: expected an object (position, sh), got {kind_of(probe)}")
    sources = _sources(probes[0] if probes else {_POSITION: 0, _SH: 0})

    def read(name: str) -> np.ndarray:
        for i, probe in enumerate(probes):
            if name not in probe:
                raise WlmError(f"{path}: {where}[{i}].{name} is missing")
        return numbers_of(path, name, [probe[name] for probe in probes])

    return _fields(path, sources, read)


def _fields(path: Path, sources: dict[str, _Source], read: Callable[[str], np.ndarray]) -> Fields:
    """Returns the fields that `read` reads from members of the file."""
    light = sources[_SH].members if _SH in sources else []
    vci = _VCI in light

    def field(name: str) -> np.ndarray:
        source = sources.get(name, _Source([name]))
        arrays = [read(member) for member in source.members]
        if len({array.shape for array in arrays}) > 1:
            raise WlmError(f"{path}: {', '.join(source.members[:3])}: expected as many numbers in each")
        array = arrays[0] if len(arrays) == 1 else np.stack(arrays, axis=1)
        if source.by_channel:
            array = array.reshape(len(array), 3, -1)
        if name == _POSITION and array.ndim == 1 and len(array) % 3 == 0:  # the numbers in one list
            array = array.reshape(-1, 3)
        return array * [-1.0, 1.0, 1.0] if vci and name == _POSITION and array.shape[1:] == (3,) else array

    axes = "x of the positions negated, from glTF's axes back to Unity's, in which the light is" if vci else ""
    unity = vci or bool(light and _UNITY.fullmatch(light[0]))
    return Fields(list(sources), field, "unity" if unity else "", axes)


def _sources(first: dict[str, Any]) -> dict[str, _Source]:
    """Finds the members that hold the position and the light among `first`, those of an object with examples."""
    names = list(first)
    known = {plain(name): name for name in reversed(names)}
    place = [_POSITION] if _POSITION in first else [known[each] for each in _PLACES if each in known][:1]
    place = place or axes_of(names)
    own = any(name.startswith(_SH) for name in names)
    found = []  # members for red, green and blue
    for channels in _CHANNELS:
        for name in known:
            stem = name.removesuffix(channels[0])
            members = [known.get(stem + channel, "") for channel in channels]
            if name != stem and all(members) and (stem or not own):
                found.append(members)
    light = _Source(found[0], True) if len(found) == 1 else _Source([])
    if not light.members:
        scalars = [name for name in names if name not in place and isinstance(first[name], int | float)]
        light = _Source(*light_columns(scalars))
    if not (light.members or own):
        light = _Source([known[each] for each in _LIGHTS if each in known][:1])
    taken = {*place, *light.members}
    sources = {name: _Source([name]) for name in names if name not in taken}
    sources |= {_POSITION: _Source(place)} if place else {}
    return sources | ({_SH: light} if light.members else {})


def _list_of_probes(content: Any) -> tuple[str, list] | None:
    """Finds the first list of objects with a position, in the file or in an object within it, and its name."""
    waiting = [("", content, 0)]
    for name, value, depth in waiting:
        if isinstance(value, list):
            place = _sources(value[0]).get(_POSITION) if value and isinstance(value[0], dict) else None
            if place is not None and len(value[0]) > len(place.members):  # more than a point
                return name or _PROBES, value
        elif isinstance(value, dict) and depth < _DEEPEST:
            waiting += [(key, member, depth + 1) for key, member in value.items() if isinstance(member, dict | list)]
    return None


def _is_scene(content: dict[str, Any]) -> bool:
    """Whether the content is an object of three.js (Object3D.toJSON)."""
    metadata = content.get("metadata")
    return isinstance(content.get("object"), dict) and isinstance(metadata, dict) and metadata.get("type") == "Object"


def _scene(path: Path, root: dict[str, Any]) -> Fields:
    """Returns the probes of a three.js scene: `LightProbe` with its `matrix`, those of its parents, and `intensity`."""
    position, light = [], []
    waiting = [(root, np.eye(4))]
    while waiting:
        node, parent = waiting.pop()
        name = str(node.get("name") or node.get("uuid") or node.get("type"))[:40]
        matrix = numbers_of(path, f"{name}.matrix", [node.get("matrix", np.eye(4).ravel().tolist())])
        if matrix.shape != (1, 16):
            raise WlmError(f"{path}: {name}.matrix: expected 16 numbers, got {matrix.shape[1:]}")
        with np.errstate(over="ignore", invalid="ignore"):
            world = parent @ matrix.reshape(4, 4).T  # stored column by column
        if node.get("type") == "LightProbe":
            position.append(world[:3, 3])
            value = numbers_of(path, f"{name}.sh", [node.get("sh")])
            intensity = numbers_of(path, f"{name}.intensity", [node.get("intensity", 1)])
            if value.ndim != 2 or intensity.shape != (1,):
                raise WlmError(f"{path}: {name}: expected a list sh of numbers and an intensity")
            light.append(value.reshape(-1, 3) * intensity if value.size % 3 == 0 else value)
        children = node.get("children", [])
        if not isinstance(children, list) or not all(isinstance(child, dict) for child in children):
            raise WlmError(f"{path}: {name}.children: expected a list of objects")
        waiting += [(child, world) for child in reversed(children)]
    if len({each.shape for each in light}) > 1:
        raise WlmError(f"{path}: expected as many numbers in each LightProbe, found different numbers")
    arrays = {_POSITION: np.array(position).reshape(-1, 3), _SH: np.array(light)}
    return Fields(list(arrays), arrays.__getitem__, "threejs", "positions in the world of the scene, y up")


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
    if array is None and any(isinstance(row, dict | list) for row in rows[:1]):
        array = _array(_listed(rows, 0), kinds)
    if array is not None:
        return array
    shapes = [None if row is None else row.shape for row in (_array(row, kinds) for row in rows)]
    odd = next((i for i, shape in enumerate(shapes) if shape is None or shape != shapes[0]), 0)
    raise WlmError(f"{path}: {field}[{odd}]: expected numbers, as many as {field}[0] has, got {kind_of(rows[odd])}")


def _listed(value: Any, depth: int) -> Any:
    """Replaces objects by lists: members x y z or r g b in this order, numbered ones in theirs, a single one alone."""
    if depth > _DEEPEST or not isinstance(value, dict | list):
        return value
    if isinstance(value, list):
        return [_listed(each, depth + 1) for each in value] if value and isinstance(value[0], dict | list) else value
    known = {plain(name): name for name in value}
    for names in (("x", "y", "z"), *_CHANNELS):
        if set(names) <= known.keys():
            return [_listed(value[known[name]], depth + 1) for name in names]
    if len(value) == 1:
        return _listed(next(iter(value.values())), depth + 1)
    numbered, by_channel = light_columns(list(value))
    if len(numbered) != len(value):
        return value
    row = [value[name] for name in numbered]
    count = len(row) // 3
    return [row[i : i + count] for i in range(0, len(row), count)] if by_channel else row


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
