"""Describes single files by their content and, where that is not enough, by their names.

`_KINDS` is the table of all kinds of files. `inspect` uses it to describe a file, and `wlm compress` to find the system
that compresses its input.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from wlm.atlas.materials import filled_slots, own_extension, own_lightmaps
from wlm.errors import WlmError
from wlm.formats.geometry import read_geometry
from wlm.formats.gltf import GltfDocument, GltfPrimitive, read_gltf
from wlm.formats.godot import read_users
from wlm.formats.ktx2 import VOLUME_HEAD, is_volume
from wlm.formats.levels import SUFFIXES as LEVEL_SUFFIXES
from wlm.formats.light import SUFFIXES, read_light
from wlm.formats.limits import JSON_BYTES
from wlm.formats.npz import read_npz
from wlm.formats.reading import open_file, read_json_file
from wlm.formats.unity_asset import read_lighting_data
from wlm.inspection.finding import UNREADABLE, Finding, command, compress_command
from wlm.inspection.pictures import inspect_picture, picture_of, said
from wlm.inspection.sets import inspect_set
from wlm.system import load, system_of

if TYPE_CHECKING:
    from wlm.fluid.volume import DensityVolume

_OTHER_LIGHT = (".avif", ".lit")  # suffixes of light that no command reads
BAKED = "lightmaps that wlm bake lightmaps wrote, with their noise and coverage"
"""Description of the folder of a bake."""
FRAMES = "frames of smoke that wlm smoke simulate wrote"
"""Description of a folder of smoke."""

# `format` of our JSON documents and the description of the folders that they are in.
_EXPORTS = {
    "wlm-light-probe-grid": "a grid of light for three.js",
    "wlm-unity-probes": "light probes for Unity",
    "wlm-unreal-light": "light probes for Unreal, volume textures and a shader",
    "wlm-bake": BAKED,
    "wlm-bevy-irradiance-volume": "an irradiance volume for Bevy",
    "wlm-bundle": "a model that wlm export wrote: textures, buffers and a shader",
    "wlm-smoke-frames": FRAMES,
}
_MODELS = {
    "lightmap": "compressed lightmaps over time",
    "atlas": "compressed lightmaps of meshes",
    "probe": "compressed light probes",
    "smoke": "a network that predicts six-way lightmaps",
}
_MOST_NAMES = 8  # names that one line lists


def kind_of(path: Path) -> str:
    """Finds the kind of a file from its first bytes, its suffix, or the names inside it; reads no large part of it.

    Returns:
        A key of the table of kinds, "" if the kind is unknown.

    Raises:
        WlmError: The file cannot be read.
    """
    with open_file(path, "the file") as file:
        head = file.read(VOLUME_HEAD)
    if is_volume(head):
        return "probes"
    if picture_of(path) is not None:
        return "picture"
    kind = next((kind for magic, kind in _BY_MAGIC.items() if head.startswith(magic)), None)
    kind = kind or _BY_SUFFIX.get(path.suffix.lower(), "")
    if kind == "arrays":
        names = _names(path)
        return "volume" if "density" in names else "probes" if _value_names(names) else "arrays"
    return _kind_of_json(path) if kind == "json" else kind


def inspect_file(path: Path) -> Finding:
    """Describes a file. An unreadable file gives a `Finding` with a problem, not an error."""
    try:
        if kind := kind_of(path):
            return _KINDS[kind].inspect(path)
    except WlmError as error:
        return Finding(path, UNREADABLE, problems=(said(error, path),))
    if path.suffix.lower() in (*SUFFIXES, *LEVEL_SUFFIXES, *_OTHER_LIGHT):
        try:
            read_light(path)
        except WlmError as error:
            return Finding(path, UNREADABLE, problems=(said(error, path),))
    return Finding(path, "unknown kind of file")


def file_system(path: Path) -> str:
    """Returns the system that compresses a file ("lightmap", "atlas", "probe" or "smoke"), "" if there is none.

    Raises:
        WlmError: The file cannot be read.
    """
    kind = kind_of(path)
    return _KINDS[kind].system if kind else ""


def document_of(path: Path) -> str | None:
    """Returns the description of a JSON file that an export of wlm contains; None for other or unreadable files."""
    try:
        content = read_json_file(path, "the file")
    except WlmError:
        return None
    return _EXPORTS.get(str(content.get("format"))) if isinstance(content, dict) else None


def _names(path: Path) -> list[str]:
    names: list[str] = []

    def look(found: Sequence[str]) -> list[str]:
        names.extend(found)
        return []

    read_npz(path, look, numbers=0)
    return names


def _value_names(names: Sequence[str]) -> list[str]:
    """Returns the names of the arrays of an .npz that hold probe values; none if it has no positions."""
    return [name for name in names if name.startswith("sh")] if "position" in names else []


def _arrays(path: Path) -> Finding:
    names = ", ".join(_names(path)[:_MOST_NAMES]) or "none"
    return Finding(path, f"arrays: {names}", problems=("neither light probes nor a volume of smoke",))


def _probes(path: Path) -> Finding:
    from wlm.probe.data import load as load_probes

    keys = _value_names(_names(path)) if path.suffix.lower() == ".npz" else []
    key = keys[0] if len(keys) > 1 else None
    probes = load_probes(path, key=key)
    coefficients = probes.outputs // 3 if probes.outputs % 3 == 0 else 0
    form = f"{coefficients} RGB coefficients" if coefficients else f"{probes.outputs} numbers"
    what = f"{probes.probes:,} light probes of {form}, {int(probes.live.sum()):,} of them lit"
    if len(keys) > 1:
        what += f", under the keys {', '.join(keys[:_MOST_NAMES])}"
    what += f"; {probes.reading}"
    options = () if key is None else ("--key", key.removeprefix("sh_"))
    return Finding(path, what, compress_command(path, *options), probes.warnings)


def _lmbake(path: Path) -> Finding:
    found = _probes(path)
    try:
        bake = read_users(path)
    except WlmError as error:
        return replace(found, problems=(*found.problems, said(error, path)))
    if not bake.users:
        return found
    textures = ", ".join(each.rsplit("/", 1)[-1] for each in bake.textures[:_MOST_NAMES])
    count = f"{len(bake.users)} mesh{'es' if len(bake.users) > 1 else ''}"
    return replace(found, what=f"{found.what}; {count} with rectangles in {textures}, compressed with their scene")


def _volume(path: Path) -> Finding:
    from wlm.fluid.volume import load_volume

    return describe_volume(path, load_volume(path, up="y"), path, "OUT.exr")


def describe_volume(path: Path, volume: "DensityVolume", file: Path, output: str, frames: str = "") -> Finding:
    """Describes smoke, of one file or of a folder of frames of which `file` is one; `output` ends the command."""
    from wlm.fluid.grids import choose
    from wlm.fluid.volume import grid_heads, is_long_along_z, thickness_hint

    size = "x".join(map(str, volume.shape))
    hot = ", with temperature" if volume.temperature is not None else ""
    what = f"{frames or 'a volume of smoke'}, {size} voxels of {volume.voxel:.3g}{hot}"
    if len(heads := grid_heads(file)) > 1:
        what += f", grid {choose(str(file), heads)[0]} of {', '.join(map(str, heads[:_MOST_NAMES]))}"
    problems = list(volume.warnings)
    if not bool((volume.density > 0).any()):
        problems.append("its density is 0 everywhere")
    if hint := thickness_hint(volume.thickness, volume.extinction):
        problems.append(hint)
    options: tuple[str, ...] = ()
    if file.suffix.lower() != ".npz" and is_long_along_z(volume):
        options = ("--volume", "up=z")
        problems.append(
            "it is longest along z, which is taken for up as in Blender and Unreal; leave --volume out if y is"
        )
    return Finding(path, what, command("smoke", "bake", path, *options, "-o", output), tuple(problems))


def _mesh(path: Path) -> Finding:
    own: tuple[str, str, tuple[str, ...]] = ("compress it together with its lightmap", "", ())
    if path.suffix.lower() not in (".glb", ".gltf"):
        mesh = read_geometry(path, with_uv=False)
        parts, sets, uvs = 1, "", []
        count = len(mesh.triangle)
        with suppress(WlmError):
            whole = read_geometry(path)
            sets, uvs = "UVs", [whole.uv[whole.triangle]]
    else:
        document, primitives = read_gltf(path)
        own = _own_lightmaps(path, document, primitives)
        count, parts = sum(len(each.triangle) for each in primitives), len({each.mesh for each in primitives})
        numbers = sorted({number for each in primitives for number in each.uv})
        sets = ", ".join(f"TEXCOORD_{number}" for number in numbers)
        used = 1 if 1 in numbers else 0
        uvs = [each.uv[used][each.triangle] for each in primitives if used in each.uv]
    what = f"{parts} mesh{'es' if parts > 1 else ''} of {count:,} triangles with {sets or 'no UVs'}"
    problems = []
    if uvs:
        corners = np.concatenate(uvs).astype(np.float64)
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2.0)
        if corners.min() < -1e-3 or corners.max() > 1.001:
            problems.append("its UVs exceed 0 to 1: are they those of a repeated texture, not of a lightmap?")
        elif area > 1.0:
            cause = "each mesh may have its own lightmap" if parts > 1 else "are they those of a lightmap?"
            problems.append(f"the triangles cover {area:.1f} times the UV square and overlap; {cause}")
        what += f"; {own[0]}"
    return Finding(path, what, own[1], (*problems, *own[2]))


def _own_lightmaps(
    path: Path, document: GltfDocument, primitives: Sequence[GltfPrimitive]
) -> tuple[str, str, tuple[str, ...]]:
    """Describes the lightmaps that a glTF file names: what they are, the command that compresses them, problems."""
    name, slots = own_extension(document), filled_slots(document)
    if name is None:
        other = f", or with that of a material slot (--slot {' or '.join(slots)})" if slots else ""
        return f"compress it together with its lightmap{other}", "", ()
    try:
        listing, _ = own_lightmaps(document, primitives)
    except WlmError as error:
        return f"its lightmaps are named by {name}", "", (said(error, path),)
    notes = tuple(note.removeprefix(f"{path}: ") for note in listing.notes)
    return f"with {notes[0]}", compress_command(path), notes[1:]


def _model(path: Path) -> Finding:
    model, system = load(path), system_of(path)
    what = f"{_MODELS[system]}: {model.name}"
    if system == "smoke":
        return Finding(path, _MODELS[system], command("info", path))
    if system == "probe" and not model.has_positions:
        return Finding(path, f"{what}, without positions", command("info", path))
    return Finding(path, what, command("web", path, "-o", "PAGE.html"))


def _kind_of_json(path: Path) -> str:
    content: Any = read_json_file(path, "the file", JSON_BYTES)
    if isinstance(content, dict):
        if str(content.get("format")) in _EXPORTS:
            return "export"
        if "lightmaps" in content:
            return "set"
    # This imports scipy.
    from wlm.probe.fields import holds_probes

    return "probes" if holds_probes(content) else "json"


def _unity_asset(path: Path) -> Finding:
    """Describes lighting data of Unity, which an optional package reads."""
    data = read_lighting_data(path)
    rectangles = f"{len(data.rectangles)} rectangles of renderers in lightmaps, without names"
    if not len(data.position):
        return Finding(path, f"lighting data of Unity: no light probes, {rectangles}")
    found = _probes(path)
    return replace(found, what=f"lighting data of Unity: {found.what}; {rectangles}")


class _Kind(NamedTuple):
    """A kind of file: the function that describes it, and the name of the system that compresses it, "" for none."""

    inspect: Callable[[Path], Finding]
    system: str = ""


_KINDS = {
    "arrays": _Kind(_arrays),
    "export": _Kind(lambda path: Finding(path, str(document_of(path)))),
    "godot bake": _Kind(_lmbake, "probe"),
    "json": _Kind(lambda path: Finding(path, "unknown JSON")),
    "mesh": _Kind(_mesh, "atlas"),
    "model": _Kind(_model),
    "picture": _Kind(inspect_picture),
    "probes": _Kind(_probes, "probe"),
    "set": _Kind(inspect_set, "lightmap"),
    "unity asset": _Kind(_unity_asset, "probe"),
    "volume": _Kind(_volume, "smoke"),
}
_BY_MAGIC = {
    b"RSRC": "godot bake",
    b"RSCC": "godot bake",
    b"glTF": "mesh",
    b"NanoVDB": "volume",
    b" BDV\0\0\0\0": "volume",
}
_BY_SUFFIX = {
    ".npz": "arrays",
    ".lmbake": "godot bake",
    ".glb": "mesh",
    ".gltf": "mesh",
    ".obj": "mesh",
    ".nvdb": "volume",
    ".vdb": "volume",
    ".wlm": "model",
    ".json": "json",
    ".asset": "unity asset",
    ".csv": "probes",
    ".tsv": "probes",
}
