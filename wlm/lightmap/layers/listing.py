"""The files of a layered set: from a `set.json` with `layers`, or from folders as Unity writes them.

No pixels are read here.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wlm.errors import WlmError
from wlm.formats.light import SUFFIXES
from wlm.formats.limits import TIMES
from wlm.formats.reading import named_file
from wlm.lightmap.fields import field, is_list, is_number, is_size, is_text, kind, name_of, period_of, read_set
from wlm.lightmap.layers.sheet import ENCODINGS, MOST_CHANNELS, MOST_SHEETS
from wlm.lightmap.listing import SET_FILE, check_count, count_of, natural, time_of_name

# Unity's names: Lightmap-0_comp_light.exr, Lightmap-0_comp_dir.png, Lightmap-0_comp_shadowmask.png.
_UNITY = re.compile(r"(.+)_comp_(light|dir|shadowmask)(\.exr|\.hdr|\.png|\.ktx2|\.dds)", re.IGNORECASE)
_UNITY_ENCODING = {"light": "radiance", "dir": "unit", "shadowmask": "unit"}
_SUFFIXES = (".exr", ".hdr", ".ktx2", ".dds", ".png")  # of one picture in several formats the first is read

MOST_NAME = 128  # characters of a layer's, an atlas' or a channel's name


@dataclass(frozen=True)
class Source:
    """A picture: a file, or one of several of one height that are stacked in it.

    Attributes:
        path: The file.
        slice: Which one, from the top.
        slices: How many are stacked in the file.
    """

    path: Path
    slice: int = 0
    slices: int = 1


@dataclass(frozen=True)
class Layer:
    """A layer of every atlas.

    Attributes:
        name: Its name.
        encoding: A name of `wlm.lightmap.layers.sheet.ENCODINGS`.
        channels: The channels of its files; None: of radiance R, G and B, of others all.
    """

    name: str
    encoding: str
    channels: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Atlas:
    """An atlas.

    Attributes:
        name: Its name.
        mask: "all", "alpha", the path of a PNG, or None: alpha where the light has it, otherwise all.
        size: Height and width in texels where the set states them, else None.
        mesh: The mesh that it belongs to, which need not be there, or None.
    """

    name: str
    mask: str | None
    size: tuple[int, int] | None = None
    mesh: Path | None = None


@dataclass(frozen=True)
class LayeredListing:
    """The files to read, and what the set states about itself.

    Attributes:
        name: The set's name.
        where: Its file or folder.
        times: One for each state, not yet checked.
        period: Length of the day in the unit of the times, or None.
        layers, atlases: In the order of the set.
        states: For each time the picture of each atlas' each layer, by both names.
        labels: What a message calls each state.
        warn_order: Whether times that are out of order deserve a warning.
    """

    name: str
    where: Path
    times: Sequence[float]
    period: float | None
    layers: tuple[Layer, ...]
    atlases: tuple[Atlas, ...]
    states: list[dict[tuple[str, str], Source]]
    labels: list[str]
    warn_order: bool


def is_name(value: object) -> bool:
    """Whether a value can name a layer, an atlas or a channel."""
    return is_text(value) and len(value) <= MOST_NAME and value.isprintable()


def is_layered(path: Path) -> bool:
    """Whether a set is layered: a `set.json` with `layers`, or a folder with one, or with Unity's files."""
    if path.is_dir():
        if not (path / SET_FILE).is_file():
            return bool(state_folders(path))
        path = path / SET_FILE
    # One that can't be read is an error of whoever reads it.
    return path.is_file() and path.suffix.lower() == ".json" and "layers" in read_set(path)


def list_layers(path: Path, times: Sequence[float] | None, chosen: Sequence[str] | None, trust: bool) -> LayeredListing:
    """Lists a layered set.

    Args:
        path: As for `wlm.lightmap.layers.data.load`.
        times: One for each state, in place of those of the set.
        chosen: Names of the layers to read; None: all.
        trust: Whether a `set.json` may name files outside its folder.

    Raises:
        WlmError: The set can't be read, or its states aren't alike; the line names the file and the field.
    """
    if path.is_dir() and (path / SET_FILE).is_file():
        path = path / SET_FILE
    listing = _list_states(path, times, chosen) if path.is_dir() else _parse(path, times, trust)
    names = [layer.name for layer in listing.layers]
    wanted = names if chosen is None else list(chosen)
    for name in wanted:
        if name not in names:
            raise WlmError(f"{path}: layers: expected some of {', '.join(names)}, got {name!r}")
    if not wanted:
        raise WlmError(f"{path}: layers: expected some of {', '.join(names)}, got none")
    layers = tuple(layer for layer in listing.layers if layer.name in wanted)
    return LayeredListing(**vars(listing) | {"layers": layers})


def state_folders(folder: Path) -> list[Path]:
    """The folder itself, or those in it that have light as Unity names it, in natural order.

    A folder with lightmaps of other names is a set of its own, whatever lies in folders in it.
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


def _has_light(folder: Path) -> bool:
    return any(name[1].lower() == "light" for name, _ in _unity_files(folder))


def _unity_files(folder: Path) -> list[tuple[tuple[str, str], Path]]:
    """Files of a folder that have Unity's names, with atlas and layer; hidden ones are other programs'."""
    found = [(match, path) for path in folder.iterdir() if (match := _UNITY.fullmatch(path.name))]
    return [((match[1], match[2].lower()), path) for match, path in found if path.name[0] != "." and path.is_file()]


def _list_states(folder: Path, times: Sequence[float] | None, chosen: Sequence[str] | None) -> LayeredListing:
    """Lists a folder with a state of light as Unity bakes it, or with a folder of each state."""
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
    # What a state lacks that another has is told first.
    for key in sorted(keys, key=lambda key: key not in everywhere):
        suffixes = [suffix for suffix in _SUFFIXES if all(suffix in files.get(key, ()) for files in found)]
        if not suffixes:
            _refuse(folder, key, states, found)
        for files, source in zip(found, sources, strict=True):
            source[key] = Source(files[key][suffixes[0]])
    warn_order = times is not None
    if times is None:
        times = [0.0] if len(states) == 1 else [time_of_name(state.name) for state in states]
        if None in times:
            names = ", ".join(state.name for state in states)
            raise WlmError(
                f"{folder}: {count_of(states, 'state')} of light and no {SET_FILE}: give {count_of(states, 'time')} "
                f"with --times, in the order {names}"
            )
    check_count(folder, states, times, "state")
    return LayeredListing(
        folder.resolve().name,
        folder,
        times,
        None,
        tuple(Layer(name, _UNITY_ENCODING[name]) for name in layers),
        tuple(Atlas(name, None) for name in atlases),
        sources,
        [state.name for state in states],
        warn_order,
    )


def _refuse(
    folder: Path, key: tuple[str, str], states: list[Path], found: list[dict[tuple[str, str], dict[str, Path]]]
) -> None:
    """Says which state lacks a picture that another has."""
    name, has = f"{key[0]}_comp_{key[1]}", [bool(files.get(key)) for files in found]
    if all(has):
        raise WlmError(f"{folder}: {name} has no format that all states have; expected the same files in each")
    without = states[has.index(False)].name
    there = f"{states[has.index(True)].name} has it" if any(has) else "another atlas has that layer"
    raise WlmError(
        f"{folder}: {without} has no {name}, but {there}: all states and atlases need the same layers; choose some "
        f"with --layers, or name the files in a {SET_FILE}"
    )


def _parse(path: Path, times: Sequence[float] | None, trust: bool) -> LayeredListing:
    """Reads a `set.json` with layers."""
    content = read_set(path)
    layers = tuple(
        _layer(path, name, value) for name, value in _named(path, content, "layers", "an object of layers").items()
    )
    atlases = tuple(
        _atlas(path, name, value, trust)
        for name, value in _named(path, content, "atlases", "an object of atlases").items()
    )
    if len(layers) > MOST_CHANNELS or len(layers) * len(atlases) > MOST_SHEETS:
        raise WlmError(f"{path}: expected at most {MOST_CHANNELS} layers and {MOST_SHEETS} of all atlases together")
    entries = field(path, content, "lightmaps", "", is_list, "a list of lightmaps")
    if len(entries) > TIMES:
        raise WlmError(f"{path}: lightmaps: expected at most {TIMES:,}, got {len(entries):,}")
    states, stamps, found = [], [], {}
    for i, entry in enumerate(entries):
        place = f"lightmaps[{i}]"
        if not isinstance(entry, dict):
            raise WlmError(f"{path}: {place}: expected an object (time_hours, files), got {kind(entry)}")
        files = field(path, entry, "files", f"{place}.", _is_object, "an object of atlases")
        state = {}
        for atlas in atlases:
            of_atlas = field(path, files, atlas.name, f"{place}.files.", _is_object, "an object of layers")
            for layer in layers:
                at = f"{place}.files.{atlas.name}."
                value = field(path, of_atlas, layer.name, at, _is_source, "a file, or an object (file, slice, slices)")
                state[atlas.name, layer.name] = _source(path, value, at + layer.name, found, trust)
        states.append(state)
        if times is None:
            stamps.append(float(field(path, entry, "time_hours", f"{place}.", is_number, "a finite number")))
    if times is not None:
        check_count(path, states, times, "state")
    labels = [f"lightmaps[{i}]" for i in range(len(states))]
    period = period_of(path, content)
    return LayeredListing(
        name_of(path, content),
        path,
        stamps if times is None else times,
        period,
        layers,
        atlases,
        states,
        labels,
        warn_order=True,
    )


def _named(path: Path, content: Mapping[str, Any], key: str, expected: str) -> dict[str, Any]:
    """An object of named things, not empty."""
    values = field(path, content, key, "", lambda value: _is_object(value) and bool(value), expected)
    for name in values:
        if not is_name(name):
            raise WlmError(f"{path}: {key}: expected names of 1 to {MOST_NAME} printable characters")
    return values


def _layer(path: Path, name: str, value: Any) -> Layer:
    """`"radiance"`, or an object with `encoding` and maybe `channels`."""
    place, options = f"layers.{name}", {"encoding": value} if isinstance(value, str) else value
    if not isinstance(options, dict):
        raise WlmError(f"{path}: {place}: expected an encoding or an object (encoding, channels), got {kind(value)}")
    names = ", ".join(ENCODINGS)
    encoding = field(path, options, "encoding", f"{place}.", lambda text: text in list(ENCODINGS), f"one of {names}")
    if options.get("channels") is None:
        return Layer(name, encoding)
    channels = field(path, options, "channels", f"{place}.", is_list, f"a list of 1 to {MOST_CHANNELS} channels")
    named = len(channels) <= MOST_CHANNELS and all(is_name(channel) for channel in channels)
    if not named or len(set(channels)) < len(channels):
        raise WlmError(f"{path}: {place}.channels: expected 1 to {MOST_CHANNELS} names, each channel of a layer once")
    return Layer(name, encoding, tuple(channels))


def _atlas(path: Path, name: str, value: Any, trust: bool) -> Atlas:
    """An object with maybe `width` and `height`, `mask` and `mesh`."""
    place = f"atlases.{name}"
    if not isinstance(value, dict):
        raise WlmError(f"{path}: {place}: expected an object (width, height, mask, mesh), got {kind(value)}")
    size = mesh = mask = None
    if value.get("width") is not None or value.get("height") is not None:
        expected = "a whole number of texels above 0"
        size = tuple(field(path, value, key, f"{place}.", is_size, expected) for key in ("height", "width"))
    if value.get("mask") is not None:
        mask = field(path, value, "mask", f"{place}.", is_text, 'the name of a PNG, "alpha" or "all"')
        if mask not in ("all", "alpha"):
            mask = str(named_file(path, mask, f"{path}: {place}.mask", trust))
    if value.get("mesh") is not None:
        file = field(path, value, "mesh", f"{place}.", is_text, "the name of a mesh")
        mesh = named_file(path, file, f"{path}: {place}.mesh", trust)
    return Atlas(name, mask or "all", size, mesh)


def _source(path: Path, value: Any, place: str, found: dict[str, Path], trust: bool) -> Source:
    """A file, or a slice of one; `found` has the files that were named before, whose links are followed once."""
    options = {"file": value} if isinstance(value, str) else value
    file = field(path, options, "file", f"{place}.", is_text, "the name of a picture")
    if file not in found:
        found[file] = named_file(path, file, f"{path}: {place}", trust)
    if "slice" not in options and "slices" not in options:
        return Source(found[file])
    slices = field(path, options, "slices", f"{place}.", is_size, "a whole number above 0")
    one = field(
        path,
        options,
        "slice",
        f"{place}.",
        lambda number: number == 0 or (is_size(number) and number < slices),
        f"a whole number from 0 to {slices - 1}",
    )
    return Source(found[file], int(one), slices)


def _is_object(value: object) -> bool:
    return isinstance(value, dict)


def _is_source(value: object) -> bool:
    return is_text(value) or isinstance(value, dict)
