"""Lists of a scene's lightmaps: the files of each sheet, and the objects that each sheet lights.

docs/atlas.md shows the JSON format. A sheet is one layout of charts and has a file for each state; its other fields are
arguments of `wlm.atlas.load`. An object is a node, named by its name, its mesh's name or its number; it reads the sheet
at UV * (scale x, y) + (offset x, y). Without `objects` every sheet is assigned to the mesh that it fits (`matching`).
`convention` states how the rectangles are written: v runs down in glTF and Godot, up in Unity, whose glTF exporters
write 1 - v.

Other lists: a `.lmbake` of Godot 4, with its texture, an EXR, beside it (a stack of slices or of directional layers has
to be cut first); a `set.json` of `wlm lightmap`, which is one sheet with a state for each time; and a folder, which
stands for its `set.json` or else for each picture of light in it, a sheet of one state for the mesh that it fits.

Without a list the lightmaps that the glTF file names itself are read (`materials`).
"""

import json
import math
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from wlm.config import check_settings
from wlm.errors import WlmError
from wlm.formats.godot import read_users
from wlm.formats.light import SUFFIXES
from wlm.formats.limits import INDEX_BYTES
from wlm.formats.reading import named_file, read_json_file, system_errors
from wlm.formats.unity_asset import has_lightmap
from wlm.system import Header

_Three = Annotated[list[Annotated[float, Field(ge=0.0)]], Field(min_length=3, max_length=3)]
_Four = Annotated[list[float], Field(min_length=4, max_length=4)]
_SET_FILE = "set.json"


class SheetFiles(Header):
    """A sheet (a UV layout): the files of its lightmaps, one for each state; its mask, a PNG above 0 where a texel
    belongs to a chart; and arguments of `wlm.atlas.load`."""

    files: Annotated[list[str], Field(min_length=1)]
    name: str | None = None
    encoding: str | None = None
    flip: bool = False
    mask: str | None = None
    intensity: Annotated[float, Field(ge=0.0)] | _Three = 1.0


class ObjectPlace(Header):
    """A node and its rectangle in a sheet, v downwards: UV times the first two numbers, plus the last two."""

    node: str
    sheet: int = Field(ge=0)
    scale_offset: _Four = [1.0, 1.0, 0.0, 0.0]


class _Content(Header):
    states: list[str] | None = None
    sheets: Annotated[list[SheetFiles], Field(min_length=1)]
    objects: list[ObjectPlace] | None = None
    convention: Literal["gltf", "unity", "godot"] = "gltf"
    uv_set: int | None = Field(None, ge=0)


@dataclass(frozen=True, eq=False)
class Listing:
    """The lightmaps of a scene and the objects that they light, from a JSON file, bake, folder or glTF file.

    Attributes:
        path: The file that names the lightmaps.
        states: Names of the states; each sheet has one file for each state.
        sheets: The files of each sheet.
        objects: Nodes and their rectangles; None: every sheet is assigned to the mesh that it fits.
        uv_set: n of the glTF attribute `TEXCOORD_n`; None: 1 if the mesh has TEXCOORD_1, else 0.
        direct: Whether the caller gave the paths of lightmaps; false if a file names them.
        held: The bytes of pictures that the file holds itself, by their names in `sheets`.
        tiles: For each sheet its UDIM tile, 1001 + u + 10 v (v up); empty if the files are not named by tiles.
        notes: Assumptions, one line each.
    """

    path: str
    states: tuple[str, ...]
    sheets: tuple[SheetFiles, ...]
    objects: tuple[ObjectPlace, ...] | None = None
    uv_set: int | None = None
    direct: bool = False
    held: Mapping[str, bytes | memoryview] = field(default_factory=dict)
    tiles: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @contextmanager
    def opened(self, name: str, trust: bool) -> Iterator[tuple[str, str]]:
        """Yields a picture's path and its name for messages; bytes in `held` are put into an unnamed temporary file."""
        if name not in self.held:
            path = str(self.file(name, trust))
            yield path, path
            return
        label = f"{self.path}: {name}"
        with tempfile.TemporaryFile() as file:
            file.write(self.held[name])
            file.flush()
            path = f"/proc/self/fd/{file.fileno()}"
            try:
                yield path, label
            except WlmError as error:
                raise WlmError(str(error).replace(path, label)) from error

    def file(self, name: str, trust: bool) -> Path:
        """Returns the path of a file that the list names."""
        if self.direct:
            return Path(name)
        return named_file(self.path, name, f"{self.path}: {name}", trust)


def is_listing(path: str | os.PathLike[str] | None) -> bool:
    """Tests whether a path names several lightmaps: a folder, a JSON file or a Godot bake. True also for None, which
    stands for the lightmaps that the glTF file names itself."""
    return path is None or os.path.isdir(path) or os.fspath(path).lower().endswith((".json", ".lmbake"))


def read_listing(path: str | os.PathLike[str]) -> Listing:
    """Reads a list of lightmaps from a JSON file, a `.lmbake` file or a folder."""
    if os.path.isdir(path):
        folder = Path(path).resolve()
        if not (folder / _SET_FILE).is_file():
            return _from_folder(str(path), folder)
        path = Path(path) / _SET_FILE
    if os.fspath(path).lower().endswith(".lmbake"):
        return _from_bake(str(path))
    content = read_json_file(path, "the list of lightmaps", INDEX_BYTES)
    if not isinstance(content, dict):
        raise WlmError(f"{path}: expected a JSON object with the key sheets, found other JSON")
    if "lightmaps" in content and "sheets" not in content:
        return _from_set(str(path), content)
    convention, unlit = content.get("convention", "gltf"), 0
    if isinstance(content.get("objects"), list) and convention in ("unity", "godot"):
        objects = [_object(each, convention, f"{path}: objects[{i}]") for i, each in enumerate(content["objects"])]
        lit = [each for each in objects if not isinstance(each, dict) or has_lightmap(each.get("sheet", 0))]
        unlit = len(objects) - len(lit)
        content = content | {"objects": lit}
    checked = check_settings(_Content, content, f"{path}: ")
    counts = {len(sheet.files) for sheet in checked.sheets}
    states = checked.states or [str(i) for i in range(len(checked.sheets[0].files))]
    if counts != {len(states)}:
        raise WlmError(f"{path}: sheets: expected {len(states)} files each, one per state, found {sorted(counts)}")
    for i, each in enumerate(checked.objects or ()):
        if each.sheet >= len(checked.sheets):
            raise WlmError(f"{path}: objects[{i}].sheet: expected 0 to {len(checked.sheets) - 1}, found {each.sheet}")
    objects = None if checked.objects is None else tuple(checked.objects)
    line = f"{path}: {unlit} objects have no lightmap (their lightmap's number is -1, 65534 or 65535)"
    notes = (f"{line}: in rendered views they hide what is behind them",) * (unlit > 0)
    return Listing(str(path), tuple(states), tuple(checked.sheets), objects, checked.uv_set, notes=notes)


def _object(entry: Any, convention: str, where: str) -> Any:
    """Converts an object's names and rectangle, in an engine's convention, to UV * scale + offset with v downwards. A
    malformed rectangle raises WlmError; other malformed input is kept, since later checks report it."""
    if not isinstance(entry, dict):
        return entry
    entry = dict(entry)
    if convention == "godot":
        if "path" in entry:
            entry["node"] = str(entry.pop("path")).rsplit("/", 1)[-1]
        if "slice_index" in entry:
            entry["sheet"] = entry.pop("slice_index")
        if "uv_scale" in entry:
            x, y, width, height = numbers(entry.pop("uv_scale"), f"{where}.uv_scale", ("x", "y", "width", "height"))
            entry["scale_offset"] = [width, height, x, y]
        return entry
    if "lightmapIndex" in entry:
        entry["sheet"] = entry.pop("lightmapIndex")
    name = "lightmapScaleOffset" if "lightmapScaleOffset" in entry else "scale_offset"
    if name in entry:
        sx, sy, x, y = numbers(entry.pop(name), f"{where}.{name}", ("x", "y", "z", "w"))
        entry["scale_offset"] = [sx, sy, x, 1.0 - sy - y]  # the rectangle applies to 1 - v
    return entry


def numbers(value: Any, where: str, keys: tuple[str, ...]) -> list[float]:
    """Returns four numbers of a JSON document, written as a list or as an object with the four `keys`."""
    if isinstance(value, dict) and set(keys) <= set(value):
        value = [value[key] for key in keys]
    if not (
        isinstance(value, list)
        and len(value) == 4
        and all(isinstance(each, int | float) and not isinstance(each, bool) for each in value)
        and all(map(math.isfinite, value))
    ):
        raise WlmError(f"{where}: expected 4 numbers, found {json.dumps(value)[:60]}")
    return [float(each) for each in value]


def _from_bake(path: str) -> Listing:
    """Reads one lightmap and its nodes' rectangles from Godot's `.lmbake`, which must have one texture with one
    slice."""
    bake = read_users(path)
    slices = {user.slice for user in bake.users}
    if len(bake.textures) != 1 or bake.directional or slices != {0}:
        raise WlmError(
            f"{path}: expected one texture of one slice without directions, found "
            f"{len(bake.textures)} textures and {len(slices)} slices{' with directions' if bake.directional else ''}: "
            "save each slice as a file, and list the files in JSON"
        )
    sheet = SheetFiles(files=[bake.textures[0].replace("\\", "/").rsplit("/", 1)[-1]])
    objects = []
    for user in bake.users:
        x, y, width, height = user.rectangle
        node = user.node.rsplit("/", 1)[-1]
        objects.append(ObjectPlace(node=node, sheet=0, scale_offset=[width, height, x, y]))
    return Listing(path, ("light",), (sheet,), tuple(objects))


def _from_folder(where: str, folder: Path) -> Listing:
    with system_errors(f"{where}: cannot read"):
        names = sorted(entry.name for entry in folder.iterdir() if entry.is_file() and entry.name[0] != ".")
    sheets = [
        SheetFiles(files=[f"{folder.name}/{name}"], name=name) for name in names if name.lower().endswith(SUFFIXES)
    ]
    if not sheets:
        raise WlmError(f"{where}: expected lightmaps ({', '.join(SUFFIXES)}), found none")
    tiles = tiles_of([Path(each.name).stem for each in sheets])
    return Listing(str(folder), ("light",), tuple(sheets), tiles=tiles)


def tiles_of(names: Sequence[str]) -> tuple[int, ...]:
    """Returns the UDIM tiles of lightmaps by their names without suffix, such as `wall.1001`; empty if they are not
    named by tiles of one texture."""
    found = [re.fullmatch(r"(.*)[._-](1\d{3})", name) for name in names]
    tiles = tuple(int(match[2]) for match in found if match is not None)
    alike = len(tiles) == len(names) == len(set(tiles)) and len({match[1] for match in found if match is not None}) == 1
    return tiles if alike else ()


def _from_set(path: str, content: dict[str, Any]) -> Listing:
    """Reads the list of lightmaps in a `set.json`: one sheet (lightmap), with a state of light for each time of day."""
    entries = content["lightmaps"] if isinstance(content["lightmaps"], list) else [None]
    if not all(isinstance(each, dict) and isinstance(each.get("time_hours"), int | float) for each in entries):
        raise WlmError(f"{path}: lightmaps: expected a list of objects, each with a number as time_hours and a file")
    files = {"files": [each.get("file") for each in entries], "mask": content.get("mask")}
    sheet = check_settings(SheetFiles, files, f"{path}: lightmaps: ")
    return Listing(path, tuple(f"{float(each['time_hours']):g} h" for each in entries), (sheet,))
