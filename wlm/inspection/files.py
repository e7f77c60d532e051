"""Describes single files by their content and, where that is not enough, by their names.

`_KINDS` is the table of all kinds of files. `inspect` uses it to describe a file, and `wlm compress` to find the system
that compresses its input.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from wlm.atlas.listing import read_listing
from wlm.atlas.materials import filled_slots, own_extension
from wlm.config import check_settings, read_yaml
from wlm.errors import WlmError, counted
from wlm.formats.artifact import read_artifact
from wlm.formats.checkpoint import SUFFIX as CHECKPOINT
from wlm.formats.gltf import read_gltf
from wlm.formats.godot import read_users
from wlm.formats.hours import hours_of_names
from wlm.formats.ktx2 import VOLUME_HEAD, is_volume
from wlm.formats.levels import SUFFIXES as LEVEL_SUFFIXES
from wlm.formats.light import SUFFIXES
from wlm.formats.limits import JSON_BYTES
from wlm.formats.meshes import SUFFIXES as MESHES
from wlm.formats.meshes import read_mesh
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
    "wlm-scene-run": "pictures and figures of a scene that wlm run wrote",
}
_MODELS = {
    "lightmap": "compressed lightmaps over time",
    "atlas": "compressed lightmaps of meshes",
    "probe": "compressed light probes",
    "smoke": "a network that predicts six-way lightmaps",
}
_OUTPUTS = {".gif": "an animation", ".html": "a web page", ".mp4": "a film", ".onnx": "a network in ONNX"}
_MOST_NAMES = 8  # names that one line lists


def kind_of(path: Path) -> str:
    """Finds the kind of a file from its first bytes, its suffix, or the names inside it; reads no large part of it.
    Returns a key of the table of kinds, "" if the kind is unknown."""
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
        if "position" in names:
            return "probes" if _value_names(names) else "positions"
        return "volume" if {"density", "density_bricks"} & set(names) else "arrays"
    return _kind_of_json(path) if kind == "json" else kind


def inspect_file(path: Path) -> Finding:
    """Describes a file. An unreadable file gives a `Finding` with a problem, not an error."""
    try:
        kind = kind_of(path)
        return _KINDS[kind].inspect(path) if kind else Finding(path, "unknown kind of file")
    except WlmError as error:
        return Finding(path, UNREADABLE, problems=(said(error, path),))


def file_system(path: Path) -> str:
    """Returns the system that compresses a file ("lightmap", "atlas", "probe" or "smoke"), "" if there is none."""
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
    return [name for name in names if name.startswith("sh")]


def _arrays(path: Path) -> Finding:
    names = ", ".join(_names(path)[:_MOST_NAMES]) or "none"
    return Finding(path, f"arrays: {names}", problems=("neither light probes nor a volume of smoke",))


def _probes(path: Path) -> Finding:
    from wlm.probe.data import load as load_probes

    keys = _value_names(_names(path)) if path.suffix.lower() == ".npz" else []
    key = keys[0] if len(keys) > 1 and None in hours_of_names(keys)[0] else None
    probes = load_probes(path, key=key)
    coefficients = probes.outputs // 3 if probes.outputs % 3 == 0 else 0
    form = f"{coefficients} RGB coefficients" if coefficients else f"{probes.outputs} numbers"
    what = f"{probes.probes:,} light probes of {form}, {int(probes.live.sum()):,} of them lit"
    if len(keys) > 1:
        what += f", under the keys {', '.join(keys[:_MOST_NAMES])}"
    what += f"; {probes.reading}"
    options = () if key is None else ("--key", key)
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


def scene_command(mesh: Path, *light: Path) -> tuple[str, tuple[str, ...]]:
    """Reads a mesh with its lightmaps: a lightmap, a folder or a list of them, or none for those that a glTF file names
    itself.

    Returns the command that compresses them, "" if they cannot be read together, and problems and assumptions, a line
    each.
    """
    # This imports torch.
    from wlm.atlas.data import load as load_scene

    try:
        scene = load_scene(mesh, *light)
    except WlmError as error:
        return "", (said(error, mesh),)
    return compress_command(mesh, *light), tuple(line.removeprefix(f"{mesh}: ") for line in scene.warnings)


def _mesh(path: Path) -> Finding:
    use, words, notes = "compress it together with its lightmap", "", ()
    if path.suffix.lower() in MESHES:
        mesh = read_mesh(path)
        parts, count = 1, len(mesh.triangle)
        sets, uvs = ("", []) if mesh.uv is None else ("UVs", [mesh.uv[mesh.triangle]])
    else:
        document, primitives = read_gltf(path)
        if name := own_extension(document):
            words, notes = scene_command(path)
            use = f"with {notes[0]}" if words else f"its lightmaps are named by {name}"
            notes = notes[1:] if words else notes
        elif slots := filled_slots(document):
            use += f", or with that of a material slot (--slot {' or '.join(slots)})"
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
        if len(corners) and (corners.min() < -1e-3 or corners.max() > 1.001):
            problems.append("its UVs exceed 0 to 1: they are those of a repeated texture or of UDIM tiles")
        elif area > 1.0:
            cause = "each mesh may have its own lightmap" if parts > 1 else "are they those of a lightmap?"
            problems.append(f"the triangles cover {area:.1f} times the UV square and overlap; {cause}")
        what += f"; {use}"
    return Finding(path, what, words, (*problems, *notes))


def _model(path: Path) -> Finding:
    model, system = load(path), system_of(path)
    model.check()
    if system == "smoke":
        return Finding(path, _MODELS[system], command("info", path))
    what = f"{_MODELS[system]}: {model.name}"
    if system == "probe" and not model.has_positions:
        return Finding(path, f"{what}, without positions", command("info", path))
    if system == "lightmap" and len(model.groups) > 1:
        groups = model.group_sizes()
        sizes = (f"{name} {size:,} bytes at {counted(len(times), 'time')}" for name, (times, size) in groups.items())
        what = f"{what}; {counted(len(groups), 'light group')}: {', '.join(sizes)}"
    return Finding(path, what, command("web", path, "-o", "PAGE.html"))


def _kind_of_json(path: Path) -> str:
    content: Any = read_json_file(path, "the file", JSON_BYTES)
    if isinstance(content, dict):
        if str(content.get("format")) in _EXPORTS:
            return "export"
        for key, kind in (("sheets", "lights"), ("lightmaps", "set"), ("groups", "set"), ("psnr", "scores")):
            if key in content:
                return kind
    # This imports scipy.
    from wlm.probe.data import load_positions
    from wlm.probe.fields import holds_probes

    if holds_probes(content):
        return "probes"
    points = content.get("position") if isinstance(content, dict) else content
    with suppress(WlmError):
        if isinstance(points, list) and points and isinstance(points[0], list):
            load_positions(path)
            return "positions"
    return "json"


def _lights(path: Path) -> Finding:
    listing = read_listing(path)
    lists = f"{counted(len(listing.sheets), 'lightmap')} at {counted(len(listing.states), 'state')}"
    return Finding(path, f"a list of lightmaps of a scene: {lists}; compress it together with its mesh")


def _positions(path: Path) -> Finding:
    from wlm.probe.data import load_positions

    use = "for --positions of wlm decode"
    return Finding(path, f"{counted(len(load_positions(path)), 'position')} without light, {use}")


def _settings(path: Path) -> Finding:
    values = read_yaml(path)
    if "grid" in values:
        # This imports torch.
        from wlm.smoke.scene import Scene

        scene = check_settings(Scene, values, f"{path}: ")
        what = f"a scene of smoke: {counted(scene.frames, 'frame')} at {scene.rate:g} a second"
        return Finding(path, what, command("smoke", "simulate", path, "-o", "DIR"))
    if "geometry" in values:
        return _bake_scene(path)
    if "light" in values:
        return _scene(path)
    fitting, faults = [], {}
    for system in _MODELS:
        profile = import_module(f"wlm.{system}").Profile
        try:
            check_settings(profile, values, f"{path}: ")
            fitting.append(system)
        except WlmError as error:
            faults[system] = said(error, path)
    if fitting:
        use = "wlm smoke train" if fitting == ["smoke"] else "--profile of wlm compress"
        return Finding(path, f"settings of {' or '.join(fitting)}, for {use}")
    return Finding(path, "YAML, neither a scene nor settings", problems=tuple(f"{s}: {f}" for s, f in faults.items()))


def _bake_scene(path: Path) -> Finding:
    from wlm.bake.geometry import check_lamps, read_geometry
    from wlm.bake.work import open_task

    task = open_task(path)
    what = f"a scene to bake at {counted(len(task.scene.hours), 'hour')}, {task.geometry.name}"
    use, problems = ("lightmaps", path, "-o", "DIR"), list[str]()
    geometry, settings = read_geometry(task.geometry, None), task.scene.lightmap
    check_lamps(path, task.scene, geometry)
    if not settings.unwrap:
        try:
            read_geometry(task.geometry, settings)
        except WlmError as error:
            problems.append(said(error, path))
            use = ("probes", path, "-o", "OUT.npz")
    if find_spec("mitsuba") is None:
        problems.append("wlm bake needs Mitsuba: pip install 'wlm[bake]'")
    return Finding(path, what, command("bake", *use), tuple(problems))


def _scene(path: Path) -> Finding:
    from wlm.scene import load as load_scene

    with load_scene(path) as scene:
        parts = [f"{len(scene.mesh.triangle):,} triangles", counted(len(scene.light.groups), "light group")]
        if scene.probes is not None:
            parts.append(f"probes of {counted(len(scene.probe_hours), 'hour')}")
        if scene.moving:
            parts.append(counted(len(scene.moving), "moving object"))
        if scene.smoke:
            parts.append(f"smoke at {counted(len(scene.smoke), 'place')}")
        what = f"a scene over {scene.day.seconds:g} s, from {scene.day.first:g} h to {scene.day.last:g} h: "
    return Finding(path, what + ", ".join(parts), command("run", path, "-o", "DIR"))


def _checkpoint(path: Path) -> Finding:
    name = path.name.removesuffix(CHECKPOINT)
    work = read_artifact(path).system.removesuffix("-checkpoint")
    return Finding(path, f"an interrupted run ({work}): repeat the command that writes {name} with --resume")


def _unity_asset(path: Path) -> Finding:
    if not len(read_lighting_data(path).position):
        return Finding(path, "lighting data of Unity: no light probes")
    found = _probes(path)
    return replace(found, what=f"lighting data of Unity: {found.what}")


class _Kind(NamedTuple):
    """A kind of file: the function that describes it, and the name of the system that compresses it, "" for none."""

    inspect: Callable[[Path], Finding]
    system: str = ""


_KINDS = {
    "arrays": _Kind(_arrays),
    "checkpoint": _Kind(_checkpoint),
    "export": _Kind(lambda path: Finding(path, str(document_of(path)))),
    "godot bake": _Kind(_lmbake, "probe"),
    "json": _Kind(lambda path: Finding(path, "unknown JSON")),
    "lights": _Kind(_lights),
    "mesh": _Kind(_mesh, "atlas"),
    "model": _Kind(_model),
    "output": _Kind(lambda path: Finding(path, f"{_OUTPUTS[path.suffix.lower()]}, which no command of wlm reads")),
    "picture": _Kind(inspect_picture),
    "positions": _Kind(_positions),
    "probes": _Kind(_probes, "probe"),
    "scores": _Kind(lambda path: Finding(path, "scores, such as wlm evaluate --json writes")),
    "set": _Kind(inspect_set, "lightmap"),
    "settings": _Kind(_settings),
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
    **dict.fromkeys((*SUFFIXES, *LEVEL_SUFFIXES, *_OTHER_LIGHT), "picture"),
    **dict.fromkeys((".glb", ".gltf", *MESHES), "mesh"),
    **dict.fromkeys((".csv", ".tsv"), "probes"),
    **dict.fromkeys((".nvdb", ".vdb"), "volume"),
    **dict.fromkeys((".yaml", ".yml"), "settings"),
    **dict.fromkeys(_OUTPUTS, "output"),
    CHECKPOINT: "checkpoint",
    ".asset": "unity asset",
    ".json": "json",
    ".lmbake": "godot bake",
    ".npz": "arrays",
    ".wlm": "model",
}
