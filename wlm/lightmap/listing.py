"""Lists the files of a lightmap set and their times, from a `set.json` or from file names in folders.

No pixels are read here. The layout follows the scene configuration of neural-dynamic-gi, section 10.1. A set consists
of atlases and layers; the plain set of one lightmap for each time has one atlas "0" with one layer "light".
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from wlm.errors import WlmError
from wlm.formats.levels import SUFFIXES as LEVEL_SUFFIXES
from wlm.formats.light import EXPECTED, SUFFIXES
from wlm.formats.limits import TIMES
from wlm.formats.reading import named_file, read_json_file
from wlm.lightmap.hours import DAY, hours_of_names
from wlm.lightmap.sheet import LIGHT, MOST_CHANNELS, MOST_NAME, MOST_SHEETS, VALUE_RANGES

SET_FILE = "set.json"

# Names that Unity gives: Lightmap-0_comp_light.exr, Lightmap-0_comp_dir.png, Lightmap-0_comp_shadowmask.png.
_UNITY = re.compile(r"(.+)_comp_(light|dir|shadowmask)(\.exr|\.hdr|\.png|\.ktx2|\.dds)", re.IGNORECASE)
_UNITY_ENCODING = {"light": "radiance", "dir": "unit", "shadowmask": "unit"}
_UNITY_SUFFIXES = (".exr", ".hdr", ".ktx2", ".dds", ".png")  # the first format that all states have is read

_MASK_WORDS = ("all", "alpha")
_GIVEN = "the times given, in the order of the names"


@dataclass(frozen=True)
class Source:
    """A picture: a whole file, or one of several pictures of equal height that are stacked vertically in a file.

    Attributes:
        path: The file.
        label: Name of the picture in warnings.
        slice: Index of the picture in the stack, from the top.
        slices: Number of pictures in the stack.
    """

    path: Path
    label: str
    slice: int = 0
    slices: int = 1


@dataclass(frozen=True)
class LayerInfo:
    """Description of a layer, which every atlas of the set has.

    Attributes:
        name: Name of the layer.
        encoding: "radiance", "unit" for values in [0, 1], or "signed" for values in [-1, 1].
        channels: Channels to read; None reads R, G and B of radiance and all channels of other layers.
        stored: How the files of a layer of radiance store their light, if they don't define it themselves: an encoding
            of `wlm.formats.channels`. None: they do.
    """

    name: str
    encoding: str
    channels: tuple[str, ...] | None = None
    stored: str | None = None


@dataclass(frozen=True)
class AtlasInfo:
    """Description of an atlas.

    Attributes:
        name: Name of the atlas.
        mask: "all", "alpha", the path of a PNG, or None: "alpha" if the layer of light has an alpha channel, otherwise
            "all".
        size: Height and width in texels if the set states them, else None.
        mesh: Path of the mesh that the atlas belongs to (it does not have to exist), or None.
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
) -> Listing:
    """Lists the files of a set, by the rules that `wlm.lightmap.load` describes. `stored` is its `encoding`.

    Raises:
        WlmError: The set cannot be read, a field is missing or wrong, a file lies outside the folder, there are too
            many states, or a state has no picture.
    """
    if path.is_dir() and (path / SET_FILE).is_file():
        path = path / SET_FILE
    if path.is_dir():
        unity = state_folders(path)
        listing = _list_states(path, times, layers) if unity else _list_folder(path, times, stored is not None)
    elif path.is_file():
        if path.suffix.lower() != ".json":
            lone = path.suffix.lower() in SUFFIXES
            found = "one lightmap, which wlm compress takes with its mesh" if lone else "a file of another kind"
            raise WlmError(f"{path}: expected a {SET_FILE} or a folder of lightmaps ({EXPECTED}), found {found}")
        listing = _parse(path, times, trust)
    else:
        raise WlmError(f"{path}: no such file or folder; expected a {SET_FILE} or a folder of lightmaps ({EXPECTED})")
    if stored is not None:
        light = (replace(each, stored=stored) if each.encoding == LIGHT.encoding else each for each in listing.layers)
        listing = replace(listing, layers=tuple(light))
    if layers is None:
        return listing
    names = [layer.name for layer in listing.layers]
    wrong = [repr(name) for name in layers if name not in names] or ([] if layers else ["none"])
    if wrong:
        raise WlmError(f"{path}: layers: expected names among {', '.join(names)}, got {wrong[0]}")
    return replace(listing, layers=tuple(layer for layer in listing.layers if layer.name in layers))


def natural(name: str) -> list[str | int]:
    """Returns a sort key that compares digits in a name as numbers, so that "2" sorts before "10"."""
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(re.split(r"([0-9]+)", name))]


def count_of(items: Sequence[object], noun: str) -> str:
    """Returns the number of items in words: "1 time", "2 times"."""
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"


def is_name(value: object) -> bool:
    """Returns whether a value can name a layer, an atlas or a channel."""
    return is_text(value) and len(value) <= MOST_NAME and value.isprintable()


def state_folders(folder: Path) -> list[Path]:
    """Returns the folders that hold lightmaps with Unity's names: the folder itself, or folders in it in natural order.

    A folder with lightmaps of other names is a plain set, whatever the folders in it contain.
    """
    try:
        if _has_light(folder):
            return [folder]
        inside = sorted(folder.iterdir(), key=lambda path: natural(path.name))
        if any(path.suffix.lower() in SUFFIXES and path.is_file() for path in inside):
            return []
        return [path for path in inside if path.is_dir() and _has_light(path)]
    except OSError as error:
        raise WlmError(f"{folder}: cannot read: {error.strerror or error}") from error


def _check_count(where: Path, items: Sequence[object], times: Sequence[float], noun: str) -> None:
    if len(times) != len(items):
        raise WlmError(f"{where}: {count_of(times, 'time')} for {count_of(items, noun)}; expected a time for each")


def _timed(folder: Path, stems: Sequence[str], times: Sequence[float] | None, noun: str) -> dict[str, Any]:
    """Returns the times of lightmaps, given or of their names without suffixes, as fields of a `Listing`."""
    if times is not None:
        _check_count(folder, stems, times, noun)
        return {"times": times, "period": None, "origin": _GIVEN}
    hours, doubt = hours_of_names(stems)
    if None in hours:
        order = ", ".join(stems[:8]) + ", ..." * (len(stems) > 8)
        raise WlmError(
            f"{folder}: {count_of(stems, noun)} and no {SET_FILE}: give {count_of(stems, 'time')} with --times, in the "
            f"order {order} ({stems[hours.index(None)]} does not end in an hour such as _18h)"
        )
    a_day = len(hours) > 1 and all(0 <= hour < DAY for hour in hours)
    return {"times": hours, "period": DAY if a_day else None, "origin": "hours from the names", "doubt": doubt}


def _list_folder(folder: Path, times: Sequence[float] | None, levels: bool) -> Listing:
    """Lists a folder of lightmaps, also of integers if `levels`; a "mask.png" in it is the mask."""
    suffixes = SUFFIXES + LEVEL_SUFFIXES * levels
    try:
        files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and f.is_file() and f.name != "mask.png"]
    except OSError as error:
        raise WlmError(f"{folder}: cannot read: {error.strerror or error}") from error
    # Hidden files belong to other programs: macOS writes one beside every file on a foreign disk.
    files = sorted((f for f in files if f.name[0] != "."), key=lambda f: (natural(f.name), f.name))
    if not files:
        raise WlmError(f"{folder}: expected a {SET_FILE} or lightmaps ({', '.join(SUFFIXES)}), found none of them")
    mask = folder / "mask.png"
    return Listing(
        name=folder.resolve().name,
        where=folder,
        layers=(LayerInfo(LIGHT.layer, LIGHT.encoding),),
        atlases=(AtlasInfo(LIGHT.atlas, str(mask) if mask.is_file() else "all"),),
        states=[{(LIGHT.atlas, LIGHT.layer): Source(file, file.name)} for file in files],
        labels=[file.name for file in files],
        **_timed(folder, [f.stem for f in files], times, "lightmap"),
    )


def _has_light(folder: Path) -> bool:
    return any(name[1].lower() == "light" for name, _ in _unity_files(folder))


def _unity_files(folder: Path) -> list[tuple[tuple[str, str], Path]]:
    """Returns the files of a folder that have Unity's names, by atlas and layer; hidden files are left out."""
    found = [(match, path) for path in folder.iterdir() if (match := _UNITY.fullmatch(path.name))]
    return [((match[1], match[2].lower()), path) for match, path in found if path.name[0] != "." and path.is_file()]


def _list_states(folder: Path, times: Sequence[float] | None, chosen: Sequence[str] | None) -> Listing:
    """Lists a folder of lightmaps as Unity bakes them: one state of light, or a folder inside it for each state."""
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
    """Returns a picture with the name of its folder in the label, because the folder's name identifies the state."""
    return Source(path, f"{path.parent.name}/{path.name}", *place)


def _parse(path: Path, times: Sequence[float] | None, trust: bool) -> Listing:
    """Reads a `set.json`."""
    content = read_json_file(path, "the set")
    if not isinstance(content, dict):
        raise WlmError(f"{path}: expected a JSON object, got {_kind(content)}")
    plain = "layers" not in content
    if plain:
        layers = (LayerInfo(LIGHT.layer, LIGHT.encoding, stored=_stored(path, content, "")),)
        expected = "a whole number of texels above 0"
        size = tuple(_field(path, content, key, "", _is_size, expected) for key in ("height", "width"))
        atlases = (AtlasInfo(LIGHT.atlas, _mask(path, content, "", trust), size, _mesh(path, content, "", trust)),)
    else:
        named = _named(path, content, "layers", "an object of layers")
        layers = tuple(_layer(path, name, value) for name, value in named.items())
        named = _named(path, content, "atlases", "an object of atlases")
        atlases = tuple(_atlas(path, name, value, trust) for name, value in named.items())
    if len(layers) > MOST_CHANNELS or len(layers) * len(atlases) > MOST_SHEETS:
        raise WlmError(f"{path}: expected at most {MOST_CHANNELS} layers, {MOST_SHEETS} in all atlases together")
    entries = _field(path, content, "lightmaps", "", _is_list, "a list of lightmaps")
    name, period = path.resolve().parent.name, None
    if content.get("name") is not None:
        name = _field(path, content, "name", "", is_text, "a name")
    if content.get("period_hours") is not None:
        period = float(
            _field(path, content, "period_hours", "", lambda value: _is_number(value) and value > 0, "a number above 0")
        )
    if len(entries) > TIMES:
        raise WlmError(f"{path}: lightmaps: expected at most {TIMES:,} entries, got {len(entries):,}")
    states, stamps, found = [], [], {}
    for i, entry in enumerate(entries):
        place = f"lightmaps[{i}]"
        if not isinstance(entry, dict):
            keys = "time_hours, file" if plain else "time_hours, files"
            raise WlmError(f"{path}: {place}: expected an object ({keys}), got {_kind(entry)}")
        if plain:
            _field(path, entry, "file", f"{place}.", is_text, "the name of a lightmap")
            source = _source(path, entry["file"], f"{place}.file", found, trust)
            states.append({(LIGHT.atlas, LIGHT.layer): replace(source, label=source.path.name)})
        else:
            files = _field(path, entry, "files", f"{place}.", _is_object, "an object of atlases")
            states.append({})
            for atlas in atlases:
                if atlas.name not in files:
                    continue
                of_atlas = _field(path, files, atlas.name, f"{place}.files.", _is_object, "an object of layers")
                for layer in layers:
                    if layer.name not in of_atlas:
                        continue
                    at, expected = f"{place}.files.{atlas.name}.", "a file, or an object (file, slice, slices)"
                    value = _field(path, of_atlas, layer.name, at, _is_source, expected)
                    states[-1][atlas.name, layer.name] = _source(path, value, at + layer.name, found, trust)
            if not states[-1]:
                raise WlmError(f"{path}: {place}.files: expected a picture, found none of the atlases and layers")
        if times is None:
            stamps.append(float(_field(path, entry, "time_hours", f"{place}.", _is_number, "a finite number")))
    held = [key for state in states for key in state]
    for i, noun, infos in ((0, "atlas", atlases), (1, "layer", layers)):
        if lone := sorted({info.name for info in infos} - {key[i] for key in held}):
            raise WlmError(f"{path}: {noun} {lone[0]}: expected a picture of it in an entry of lightmaps, found none")
    if times is not None:
        _check_count(path, states, times, "lightmap" if plain else "state")
    labels = [source.label for state in states for source in state.values()] if plain else None
    return Listing(
        name=name,
        where=path,
        times=stamps if times is None else times,
        period=period,
        layers=layers,
        atlases=atlases,
        states=states,
        labels=labels or [f"lightmaps[{i}]" for i in range(len(states))],
        origin="" if times is None else _GIVEN,
    )


def _named(path: Path, content: Mapping[str, Any], key: str, expected: str) -> dict[str, Any]:
    """Returns a JSON object of named entries from a field; an empty one is an error."""
    values = _field(path, content, key, "", lambda value: _is_object(value) and bool(value), expected)
    for name in values:
        if not is_name(name):
            raise WlmError(f"{path}: {key}: expected names of 1 to {MOST_NAME} printable characters")
    return values


def _layer(path: Path, name: str, value: Any) -> LayerInfo:
    """Reads the description of a layer: an encoding, or an object with `encoding` and optional `channels`."""
    place, options = f"layers.{name}", {"encoding": value} if isinstance(value, str) else value
    if not isinstance(options, dict):
        raise WlmError(f"{path}: {place}: expected an encoding or an object (encoding, channels), got {_kind(value)}")
    names = ", ".join(VALUE_RANGES)
    encoding = _field(
        path, options, "encoding", f"{place}.", lambda text: text in list(VALUE_RANGES), f"one of {names}"
    )
    stored = _stored(path, options, f"{place}.") if encoding == LIGHT.encoding else None
    if options.get("channels") is None:
        return LayerInfo(name, encoding, stored=stored)
    channels = _field(path, options, "channels", f"{place}.", _is_list, f"a list of 1 to {MOST_CHANNELS} channels")
    named = len(channels) <= MOST_CHANNELS and all(is_name(channel) for channel in channels)
    if not named or len(set(channels)) < len(channels):
        raise WlmError(f"{path}: {place}.channels: expected 1 to {MOST_CHANNELS} different names of channels")
    return LayerInfo(name, encoding, tuple(channels), stored)


def _stored(path: Path, holder: dict[str, Any], place: str) -> str | None:
    """Reads how files store the light of a layer, such as "rgbm:8:2"; None if the field is absent."""
    if holder.get("stored") is None:
        return None
    return _field(path, holder, "stored", place, is_text, "an encoding, such as srgb or rgbm:8:2")


def _atlas(path: Path, name: str, value: Any, trust: bool) -> AtlasInfo:
    """Reads the description of an atlas: an object with optional `width`, `height`, `mask` and `mesh`."""
    place = f"atlases.{name}"
    if not isinstance(value, dict):
        raise WlmError(f"{path}: {place}: expected an object (width, height, mask, mesh), got {_kind(value)}")
    size = None
    if value.get("width") is not None or value.get("height") is not None:
        expected = "a whole number of texels above 0"
        size = tuple(_field(path, value, key, f"{place}.", _is_size, expected) for key in ("height", "width"))
    place += "."
    return AtlasInfo(name, _mask(path, value, place, trust), size, _mesh(path, value, place, trust))


def _mask(path: Path, holder: dict[str, Any], place: str, trust: bool) -> str:
    """Reads the mask of an atlas: "all", "alpha" or the path of a PNG; "all" if none is named."""
    if holder.get("mask") is None:
        return "all"
    mask = _field(path, holder, "mask", place, is_text, 'the name of a PNG, "alpha" or "all"')
    return mask if mask in _MASK_WORDS else str(named_file(path, mask, f"{path}: {place}mask", trust))


def _mesh(path: Path, holder: dict[str, Any], place: str, trust: bool) -> Path | None:
    if holder.get("mesh") is None:
        return None
    file = _field(path, holder, "mesh", place, is_text, "the name of a mesh")
    return named_file(path, file, f"{path}: {place}mesh", trust)


def _source(path: Path, value: Any, place: str, found: dict[str, Path], trust: bool) -> Source:
    """Reads the entry of a picture: a file, or a slice of one. `found` caches resolved paths of files named before."""
    options = {"file": value} if isinstance(value, str) else value
    file = _field(path, options, "file", f"{place}.", is_text, "the name of a picture")
    if file not in found:
        found[file] = named_file(path, file, f"{path}: {place}", trust)
    if "slice" not in options and "slices" not in options:
        return _labelled(found[file])
    slices = _field(path, options, "slices", f"{place}.", _is_size, "a whole number above 0")
    expected = f"a whole number from 0 to {slices - 1}"
    index = _field(path, options, "slice", f"{place}.", lambda at: at == 0 or (_is_size(at) and at < slices), expected)
    return _labelled(found[file], int(index), slices)


def _is_object(value: object) -> bool:
    return isinstance(value, dict)


def _is_source(value: object) -> bool:
    return is_text(value) or isinstance(value, dict)


def _field(path: Path, holder: dict[str, Any], key: str, place: str, ok: Callable[[Any], bool], expected: str) -> Any:
    """Returns `holder[key]` if `ok` accepts it. For messages: `place` of the object, such as `lightmaps[0].`."""
    if key not in holder:
        raise WlmError(f"{path}: {place}{key} is missing; expected {expected}")
    if not ok(holder[key]):
        raise WlmError(f"{path}: {place}{key}: expected {expected}, got {_kind(holder[key])}")
    return holder[key]


def is_text(value: object) -> bool:
    """Returns whether a value is text that can name a file or a set: not blank, and valid in file names."""
    # File names cannot have a NUL or half of a surrogate pair.
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        return False
    return not any("\ud800" <= character <= "\udfff" for character in value)


def _is_number(value: object) -> bool:
    """Returns whether a JSON value is a finite number that is not too large for a float."""
    # Python's True is an int, and its JSON reader accepts NaN, Infinity and integers of any length.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= 1e300


def _is_list(value: object) -> bool:
    """Returns whether a value is a list that is not empty."""
    return isinstance(value, list) and bool(value)


def _is_size(value: object) -> bool:
    """Returns whether a value is a whole number above 0."""
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


def _kind(value: object) -> str:
    """Describes a JSON value in a message: the value itself, or its kind if it is long."""
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}" if value else "an empty list"
    text = json.dumps(value) if not isinstance(value, int) or abs(value) < 1e300 else "a very large number"
    return text if len(text) <= 60 else text[:57] + "..."
