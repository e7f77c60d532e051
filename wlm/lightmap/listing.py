"""Lists the files of a lightmap set and their times, from a `set.json` or from file names in folders.

No pixels are read here. The layout follows the scene configuration of neural-dynamic-gi, section 10.1. A set consists
of atlases and layers; the plain set of one lightmap for each time has one atlas "0" with one layer "light".
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from wlm.config import check_settings
from wlm.errors import WlmError, counted
from wlm.formats.hours import DAY, hours_of_names
from wlm.formats.levels import SUFFIXES as LEVEL_SUFFIXES
from wlm.formats.light import EXPECTED, SUFFIXES
from wlm.formats.limits import TIMES
from wlm.formats.reading import named_file, read_json_file, system_errors
from wlm.lightmap.sheet import BASE, LIGHT, MOST_CHANNELS, MOST_NAME, MOST_SHEETS, is_group, is_name

SET_FILE = "set.json"

# Names that Unity gives: Lightmap-0_comp_light.exr, Lightmap-0_comp_dir.png, Lightmap-0_comp_shadowmask.png.
_UNITY = re.compile(r"(.+)_comp_(light|dir|shadowmask)(\.exr|\.hdr|\.png|\.ktx2|\.dds)", re.IGNORECASE)
_UNITY_ENCODING = {"light": "radiance", "dir": "unit", "shadowmask": "unit"}
_UNITY_SUFFIXES = (".exr", ".hdr", ".ktx2", ".dds", ".png")  # the first format that all states have is read

_MASK_WORDS = ("all", "alpha")
_GIVEN = "the times given, in the order of the names"


@dataclass(frozen=True)
class Source:
    """A picture: the file `path`, or number `slice`, from the top, of `slices` pictures of equal height that are
    stacked in it. `label` is its name in warnings."""

    path: Path
    label: str
    slice: int = 0
    slices: int = 1


@dataclass(frozen=True)
class LayerInfo:
    """A layer, which every atlas of the set has. Its encoding is "radiance", "unit" for values in [0, 1], or "signed"
    for values in [-1, 1]. `channels` are those to read; None reads R, G and B of radiance and all channels of other
    layers. `stored` is the encoding of `wlm.formats.channels` in which files store radiance, None if they define it
    themselves."""

    name: str
    encoding: str
    channels: tuple[str, ...] | None = None
    stored: str | None = None


@dataclass(frozen=True)
class AtlasInfo:
    """An atlas.

    `mask` is "all", "alpha", the path of a PNG, or None: "alpha" if the layer of light has an alpha channel, otherwise
    "all". `size` is height and width in texels if the set states them, else None. `mesh` is the path of the mesh that
    the atlas belongs to (it does not have to exist), or None.
    """

    name: str
    mask: str | None
    size: tuple[int, int] | None = None
    mesh: Path | None = None


@dataclass(frozen=True)
class Listing:
    """The files to read, and the properties that the set states.

    Attributes:
        name: Name of the set.
        where: The `set.json` or the folder.
        times: A time for each state, not yet checked.
        period: Length of the day in the unit of the times; None if the set is not periodic.
        layers, atlases: The layers and atlases, in the order of the set.
        states: For each time, the pictures by names of atlas and layer; a picture may be missing at some times.
        labels: Name of each state (the pictures of one time) in messages.
        origin: Where times come from that no `set.json` states, for messages; else "".
        doubt: A line about names whose hours may be read differently, or "".
    """

    name: str
    where: Path
    times: Sequence[float]
    period: float | None
    layers: tuple[LayerInfo, ...]
    atlases: tuple[AtlasInfo, ...]
    states: list[dict[tuple[str, str], Source]]
    labels: list[str]
    origin: str = ""
    doubt: str = ""

    @property
    def light_first(self) -> list[LayerInfo]:
        """The layers in the order in which they are read: the light's alpha and size are those of the atlas's mask."""
        return sorted(self.layers, key=lambda layer: layer.encoding != LIGHT.encoding)

    @property
    def files(self) -> list[Path]:
        """The files of all pictures, one time after another."""
        return [source.path for state in self.states for source in state.values()]


def list_set(
    path: Path,
    times: Sequence[float] | None = None,
    layers: Sequence[str] | None = None,
    trust: bool = False,
    stored: str | None = None,
    groups: Mapping[str, Path] | None = None,
) -> dict[str, Listing]:
    """Lists the files of a set, by the rules that `wlm.lightmap.load` describes. `stored` is its `encoding`. Returns a
    listing for each light group; for a set that names none, one of the name `BASE`."""
    found = _listings(path, times, layers, trust, stored is not None)
    for name, own in (groups or {}).items():
        if not is_group(name) or name in found:
            raise WlmError(f"{own}: expected a group's name that is printable, without '=' and not taken, got {name!r}")
        if _is_lightmap(own):  # one lightmap, which is the same at all times
            listings = [_of_files(own.stem, own, [own], None, times=[0.0], period=None)]
        else:
            listings = list(_listings(own, None, layers, trust, stored is not None).values())
        if len(listings) > 1:
            raise WlmError(f"{own}: group {name}: expected a set without groups, found one with {len(listings)}")
        found[name] = listings[0]
    if stored is not None:
        found = {name: _stored_as(listing, stored) for name, listing in found.items()}
    if layers is None:
        return found
    names = list(dict.fromkeys(layer.name for listing in found.values() for layer in listing.layers))
    wrong = [repr(name) for name in layers if name not in names] or ([] if layers else ["none"])
    if wrong:
        raise WlmError(f"{path}: layers: expected names among {', '.join(names)}, got {wrong[0]}")
    for name, listing in found.items():
        found[name] = replace(listing, layers=tuple(layer for layer in listing.layers if layer.name in layers))
    return {name: listing for name, listing in found.items() if listing.layers}


def _stored_as(listing: Listing, stored: str) -> Listing:
    light = (replace(each, stored=stored) if each.encoding == LIGHT.encoding else each for each in listing.layers)
    return replace(listing, layers=tuple(light))


def _is_lightmap(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES + LEVEL_SUFFIXES


def _of_files(name: str, where: Path, files: Sequence[Path], mask: str | None, **timed: Any) -> Listing:
    """Lists files of light as the only atlas; `timed` has the fields of a `Listing` about times."""
    layers, atlases = (LayerInfo(LIGHT.layer, LIGHT.encoding),), (AtlasInfo(LIGHT.atlas, mask),)
    states = [{(LIGHT.atlas, LIGHT.layer): Source(file, file.name)} for file in files]
    labels = [file.name for file in files]
    return Listing(name, where, layers=layers, atlases=atlases, states=states, labels=labels, **timed)


def _listings(
    path: Path, times: Sequence[float] | None, layers: Sequence[str] | None, trust: bool, levels: bool
) -> dict[str, Listing]:
    """Lists a set by group; `levels` states whether pictures of integers are lightmaps."""
    if path.is_dir() and (path / SET_FILE).is_file():
        path = path / SET_FILE
    if path.is_dir():
        unity = state_folders(path)
        listing = _list_states(path, times, layers) if unity else _list_folder(path, times, levels)
    elif path.is_file():
        if path.suffix.lower() != ".json":
            lone = path.suffix.lower() in SUFFIXES
            found = "one lightmap, which wlm compress takes with its mesh" if lone else "a file of another kind"
            raise WlmError(f"{path}: expected a {SET_FILE} or a folder of lightmaps ({EXPECTED}), found {found}")
        return _parse(path, times, trust)
    else:
        raise WlmError(f"{path}: no such file or folder; expected a {SET_FILE} or a folder of lightmaps ({EXPECTED})")
    return {BASE: listing}


def natural(name: str) -> list[str | int]:
    """Returns a sort key that compares digits in a name as numbers, so that "2" sorts before "10"."""
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(re.split(r"([0-9]+)", name))]


def state_folders(folder: Path) -> list[Path]:
    """Returns the folders that hold lightmaps with Unity's names: the folder itself, or folders in it in natural order.
    A folder with lightmaps of other names is a plain set, whatever the folders in it contain."""
    with system_errors(f"{folder}: cannot read"):
        if _has_light(folder):
            return [folder]
        inside = sorted(folder.iterdir(), key=lambda path: natural(path.name))
        if any(path.suffix.lower() in SUFFIXES and path.is_file() for path in inside):
            return []
        return [path for path in inside if path.is_dir() and _has_light(path)]


def _check_count(where: Path, items: Sequence[object], times: Sequence[float], noun: str) -> None:
    if len(times) != len(items):
        raise WlmError(
            f"{where}: {counted(len(times), 'time')} for {counted(len(items), noun)}; expected a time for each"
        )


def _timed(folder: Path, stems: Sequence[str], times: Sequence[float] | None, noun: str) -> dict[str, Any]:
    """Returns the `times` of lightmaps, or hours from their names `stems` if it is None, as fields of a `Listing`."""
    if times is not None:
        _check_count(folder, stems, times, noun)
        return {"times": times, "period": None, "origin": _GIVEN}
    hours, doubt = hours_of_names(stems)
    if None in hours:
        order = ", ".join(stems[:8]) + ", ..." * (len(stems) > 8)
        raise WlmError(
            f"{folder}: {counted(len(stems), noun)} and no {SET_FILE}: give {counted(len(stems), 'time')} with "
            f"--times, in the order {order} ({stems[hours.index(None)]} does not end in an hour such as _18h)"
        )
    a_day = len(hours) > 1 and all(0 <= hour < DAY for hour in hours)
    return {"times": hours, "period": DAY if a_day else None, "origin": "hours from the names", "doubt": doubt}


def _list_folder(folder: Path, times: Sequence[float] | None, levels: bool) -> Listing:
    suffixes = SUFFIXES + LEVEL_SUFFIXES * levels
    with system_errors(f"{folder}: cannot read"):
        files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and f.is_file() and f.name != "mask.png"]
    # Hidden files belong to other programs: macOS writes one beside every file on a foreign disk.
    files = sorted((f for f in files if f.name[0] != "."), key=lambda f: (natural(f.name), f.name))
    if not files:
        known = f"{', '.join(SUFFIXES)}; with --encoding {', '.join(LEVEL_SUFFIXES)}"
        raise WlmError(f"{folder}: expected a {SET_FILE} or lightmaps ({known}), found none of them")
    mask, timed = folder / "mask.png", _timed(folder, [f.stem for f in files], times, "lightmap")
    return _of_files(folder.resolve().name, folder, files, str(mask) if mask.is_file() else "all", **timed)


def _has_light(folder: Path) -> bool:
    return any(name[1].lower() == "light" for name, _ in _unity_files(folder))


def _unity_files(folder: Path) -> list[tuple[tuple[str, str], Path]]:
    found = [(match, path) for path in folder.iterdir() if (match := _UNITY.fullmatch(path.name))]
    return [((match[1], match[2].lower()), path) for match, path in found if path.name[0] != "." and path.is_file()]


def _list_states(folder: Path, times: Sequence[float] | None, chosen: Sequence[str] | None) -> Listing:
    states = state_folders(folder)
    found: list[dict[tuple[str, str], dict[str, Path]]] = []
    for state in states:
        files: dict[tuple[str, str], dict[str, Path]] = {}
        for key, path in _unity_files(state):
            files.setdefault(key, {})[path.suffix.lower()] = path
        found.append(files)
    everywhere = sorted({key for files in found for key in files}, key=lambda key: (natural(key[0]), key))
    atlases = list(dict.fromkeys(atlas for atlas, _ in everywhere))
    layers = [name for name in _UNITY_ENCODING if any(key[1] == name for key in everywhere)]
    sources: list[dict[tuple[str, str], Source]] = [{} for _ in states]
    keys = [(atlas, layer) for layer in layers if chosen is None or layer in chosen for atlas in atlases]
    for key in keys:
        common = [suffix for suffix in _UNITY_SUFFIXES if all(suffix in files[key] for files in found if key in files)]
        for files, source in zip(found, sources, strict=True):
            if key in files:
                suffix = next(suffix for suffix in (*common, *_UNITY_SUFFIXES) if suffix in files[key])
                source[key] = _labelled(files[key][suffix])
    labels = [state.name for state in states]
    return Listing(
        name=folder.resolve().name,
        where=folder,
        layers=tuple(LayerInfo(name, _UNITY_ENCODING[name]) for name in layers),
        atlases=tuple(AtlasInfo(name, None) for name in atlases),
        states=sources,
        labels=labels,
        **_timed(folder, labels, [0.0] if times is None and len(states) == 1 else times, "state"),
    )


def _labelled(path: Path, *place: int) -> Source:
    return Source(path, f"{path.parent.name}/{path.name}", *place)


def _parse(path: Path, times: Sequence[float] | None, trust: bool) -> dict[str, Listing]:
    content = read_json_file(path, "the set")
    if not isinstance(content, dict) or "groups" not in content:
        return {BASE: _parse_group(path, content, times, trust)}
    if times is not None:
        raise WlmError(f"{path}: expected a set without groups for --times, found groups, which state their own times")
    # A group has the fields of the set and its own.
    groups = check_settings(_Grouped, content, f"{path}: ", extra="ignore").groups
    whole = {key: value for key, value in content.items() if key != "groups"}
    found: dict[str, Listing] = {}
    for group, own in zip(groups, content["groups"], strict=True):
        if group.name in found:
            raise WlmError(f"{path}: groups: expected different names, found {group.name} twice")
        found[group.name] = _parse_group(path, whole | own | {"name": content.get("name")}, None, trust, group.name)
    for noun, kind in (("atlas", "atlases"), ("layer", "layers")):
        used = {item.name for listing in found.values() for item in getattr(listing, kind)}
        if lone := sorted(content.get(kind, {}).keys() - used):
            raise WlmError(f"{path}: {noun} {lone[0]}: expected a picture of it in a group, found none")
    return found


def _parse_group(
    path: Path, content: Any, times: Sequence[float] | None, trust: bool, group: str | None = None
) -> Listing:
    """Lists a set without groups, or one group of it: this may lack atlases and layers, and its only time is 0."""
    where = str(path) if group is None else f"{path}: groups.{group}"
    kind = _Layered if isinstance(content, dict) and "layers" in content else _Plain
    checked = check_settings(kind, content, f"{where}: ", extra="ignore")
    found: dict[str, Path] = {}

    def file(name: str, place: str) -> Path:
        if name not in found:
            found[name] = named_file(path, name, f"{where}: {place}", trust)
        return found[name]

    def atlas(name: str, entry: _Atlas, place: str) -> AtlasInfo:
        mask = entry.mask or "all"
        mask = mask if mask in _MASK_WORDS else str(file(mask, f"{place}mask"))
        size = None if entry.height is None or entry.width is None else (entry.height, entry.width)
        return AtlasInfo(name, mask, size, None if entry.mesh is None else file(entry.mesh, f"{place}mesh"))

    states: list[dict[tuple[str, str], Source]] = []
    if isinstance(checked, _Plain):
        layers: tuple[LayerInfo, ...] = (LayerInfo(LIGHT.layer, LIGHT.encoding, stored=checked.stored),)
        atlases: tuple[AtlasInfo, ...] = (atlas(LIGHT.atlas, checked, ""),)
        for i, one in enumerate(checked.lightmaps):
            picture = file(one.file, f"lightmaps.{i}.file")
            states.append({(LIGHT.atlas, LIGHT.layer): Source(picture, picture.name)})
        labels = [source.label for state in states for source in state.values()]
    else:
        layers = tuple(LayerInfo(name, **dict(entry)) for name, entry in checked.layers.items())
        atlases = tuple(atlas(name, entry, f"atlases.{name}.") for name, entry in checked.atlases.items())
        labels = [f"lightmaps.{i}" for i in range(len(checked.lightmaps))]
        for label, state in zip(labels, checked.lightmaps, strict=True):
            states.append({})
            for own, layer in product(checked.atlases, checked.layers):
                if (entry := state.files.get(own, {}).get(layer)) is not None:
                    place = f"{label}.files.{own}.{layer}"
                    states[-1][own, layer] = _labelled(file(entry.file, place), entry.slice, entry.slices)
            if not states[-1]:
                raise WlmError(f"{where}: {label}.files: expected a picture, found none of the atlases and layers")
        if group is not None:
            used = {name for state in states for key in state for name in (("atlas", key[0]), ("layer", key[1]))}
            atlases = tuple(each for each in atlases if ("atlas", each.name) in used)
            layers = tuple(each for each in layers if ("layer", each.name) in used)
        for i, noun, names in ((0, "atlas", atlases), (1, "layer", layers)):
            if lone := sorted({each.name for each in names} - {key[i] for state in states for key in state}):
                raise WlmError(
                    f"{path}: {noun} {lone[0]}: expected a picture of it in an entry of lightmaps, found none"
                )
    stamps = [one.time_hours for one in checked.lightmaps] if times is None else times
    if group is not None and stamps == [None]:
        stamps = [0.0]
    _check_count(path, states, stamps, "lightmap")
    if None in stamps:
        raise WlmError(f"{where}: lightmaps.{stamps.index(None)}.time_hours: expected a finite number, found none")
    return Listing(
        name=checked.name or path.resolve().parent.name,
        where=path,
        times=stamps,
        period=checked.period_hours,
        layers=layers,
        atlases=atlases,
        states=states,
        labels=labels,
        origin="" if times is None else _GIVEN,
    )


def _text(value: str) -> str:
    if not value.strip() or "\0" in value:
        raise PydanticCustomError("text", "expected a name that is not blank and has no NUL")
    return value


def _word(value: str) -> str:
    if not is_name(value):
        raise PydanticCustomError("name", f"expected a name of 1 to {MOST_NAME} printable characters")
    return value


_Text = Annotated[str, AfterValidator(_text)]
_Word = Annotated[str, AfterValidator(_word)]
_Texels = Annotated[int, Field(gt=0)] | None


def _group(value: str) -> str:
    if not is_group(value):
        raise PydanticCustomError("group", f"expected a name of 1 to {MOST_NAME} printable characters without '='")
    return value


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)


class _Picture(_Part):
    file: _Text
    slice: int = Field(0, ge=0)
    slices: int = Field(1, gt=0)

    @model_validator(mode="before")
    @classmethod
    def _of_name(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.slice >= self.slices:
            raise PydanticCustomError("slice", f"slice: expected a whole number from 0 to {self.slices - 1}")
        return self


class _Layer(_Part):
    encoding: Literal["radiance", "unit", "signed"]
    channels: tuple[_Word, ...] | None = Field(None, min_length=1, max_length=MOST_CHANNELS, strict=False)
    stored: _Text | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_encoding(cls, value: Any) -> Any:
        return {"encoding": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(set(self.channels or ())) < len(self.channels or ()):
            raise PydanticCustomError("channels", "channels: expected different names, found one twice")
        return self


class _Atlas(_Part):
    width: _Texels = None
    height: _Texels = None
    mask: _Text | None = None
    mesh: _Text | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.width is None) != (self.height is None):
            raise PydanticCustomError("size", "width and height: expected both or neither, found one")
        return self


class _Time(_Part):
    time_hours: float | None = None


class _PlainTime(_Time):
    file: _Text


class _LayeredTime(_Time):
    files: dict[str, dict[str, _Picture]]


class _Set(_Part):
    name: _Text | None = None
    period_hours: float | None = Field(None, gt=0)


class _Group(_Part):
    name: Annotated[str, AfterValidator(_group)]


class _Grouped(_Part):
    groups: list[_Group] = Field(min_length=1, max_length=MOST_SHEETS)


class _Plain(_Set, _Atlas):
    lightmaps: list[_PlainTime] = Field(min_length=1, max_length=TIMES)
    stored: _Text | None = None


class _Layered(_Set):
    layers: dict[_Word, _Layer] = Field(min_length=1, max_length=MOST_CHANNELS)
    atlases: dict[_Word, _Atlas] = Field(min_length=1, max_length=MOST_SHEETS)
    lightmaps: list[_LayeredTime] = Field(min_length=1, max_length=TIMES)
