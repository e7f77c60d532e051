"""What a single file holds, told by its content and, where that doesn't tell, by its name."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats.geometry import read_geometry
from wlm.formats.gltf import read_gltf
from wlm.formats.godot import read_users
from wlm.formats.light import SUFFIXES
from wlm.formats.limits import JSON_BYTES
from wlm.formats.npz import read_npz
from wlm.formats.reading import open_file, read_json_file
from wlm.formats.unity_asset import read_lighting_data
from wlm.inspection.finding import Finding, quoted
from wlm.inspection.pictures import inspect_picture, picture_of, said
from wlm.inspection.sets import inspect_set
from wlm.system import load

_MAGIC = 16
_VDB = b" BDV\0\0\0\0"
BAKED = "lightmaps that wlm bake lightmaps made, with their noise and coverage"
"""What is said of the folder of a bake."""

# Exports that can be read back.
_PROBE_EXPORTS = {
    "wlm-light-probe-grid": "a grid of light for three.js",
    "wlm-unity-probes": "light probes for Unity",
    "wlm-unreal-light": "light probes for Unreal, volume textures and a shader",
}
# What says of itself in JSON that it is ours, and what to do with it.
_EXPORTS = _PROBE_EXPORTS | {
    "wlm-bake": BAKED,
    "wlm-lightmap-export": "lightmaps over time for an engine: textures, weights and a shader",
    "wlm-bundle": "a model that wlm export wrote: textures, buffers and a shader",
    "wlm-lightmap-layers-export": "layered lightmaps for an engine: a folder for each sheet",
    "wlm-probe-export": "light probes for an engine: buffers and a shader",
    "wlm-probe-volume": "a cascaded volume of probes for an engine: buffers and shaders",
    "wlm-godot-light": "light probes for Godot",
    "wlm-smoke-frames": "frames of smoke that wlm smoke simulate wrote",
}


def inspect_file(path: Path) -> Finding:
    """Says what a file holds; a damaged one is said to be that."""
    try:
        picture = picture_of(path)
        if picture is not None:
            return inspect_picture(path, picture)
        with open_file(path, "the file") as file:
            head = file.read(_MAGIC)
        for magic, inspect in _BY_MAGIC.items():
            if head.startswith(magic):
                return inspect(path)
        inspect = _BY_SUFFIX.get(path.suffix.lower())
        if inspect is not None:
            return inspect(path)
    except WlmError as error:
        return Finding(path, "can't be read", problems=(said(error, path),))
    if path.suffix.lower() in (*SUFFIXES, ".png"):
        return Finding(path, "can't be read", problems=(f"is called {path.suffix} and holds something else",))
    return Finding(path, "no kind of file that is known here")


def document_of(path: Path) -> str | None:
    """What a JSON file says that it is, where it is one of ours; None of others and of what can't be read."""
    try:
        content = read_json_file(path, "the file")
    except WlmError:
        return None
    return _EXPORTS.get(str(content.get("format"))) if isinstance(content, dict) else None


def _npz(path: Path) -> Finding:
    names: list[str] = []

    def look(found: Sequence[str]) -> list[str]:
        names.extend(found)
        return []

    read_npz(path, look, numbers=0)
    if "density" in names:
        return _volume(path)
    values = [name for name in names if name.startswith("sh")]
    if "position" in names and values:
        return _probes(path, values)
    return Finding(
        path, f"arrays: {', '.join(names[:8]) or 'none'}", problems=("neither probes nor a volume of smoke",)
    )


def _probes(path: Path, keys: Sequence[str] = ()) -> Finding:
    from wlm.probe.data import load as load_probes

    key = keys[0] if len(keys) > 1 else None
    probes = load_probes(path, key=key)
    coefficients = probes.outputs // 3 if probes.outputs % 3 == 0 else 0
    form = f"{coefficients} RGB coefficients" if coefficients else f"{probes.outputs} numbers"
    what = f"{probes.probes:,} light probes of {form}, {int(probes.live.sum()):,} of them lit"
    if len(keys) > 1:
        what += f", under the keys {', '.join(keys[:8])}"
    option = "" if key is None else f" --key {key.removeprefix('sh_')}"
    problems = list(probes.warnings)
    if coefficients:
        # Of radiance that is nowhere negative, no other coefficient is beyond the first one by more than this.
        mean = probes.values[probes.live][:, :3]
        rest = np.abs(probes.values[probes.live][:, 3:]).reshape(len(mean), -1, 3)
        if rest.size and (wrong := int(np.count_nonzero((rest > 2.3 * np.abs(mean)[:, None]).any((1, 2))))):
            problems.append(f"{wrong} have a coefficient beyond what light can: another order, or convention?")
    return Finding(path, what, f"wlm probe compress {quoted(path)}{option} -o OUT.wlm", tuple(problems))


def _lmbake(path: Path) -> Finding:
    """Godot's probes, and the lightmap that some meshes read."""
    found = _probes(path)
    try:
        bake = read_users(path)
    except WlmError as error:
        return replace(found, problems=(*found.problems, said(error, path)))
    if not bake.users:
        return found
    textures = ", ".join(each.rsplit("/", 1)[-1] for each in bake.textures[:8])
    count = f"{len(bake.users)} mesh{'es' if len(bake.users) > 1 else ''}"
    scene = f"wlm atlas compress SCENE.glb {quoted(path)} -o OUT.wlm takes it with its scene"
    return replace(found, what=f"{found.what}; {count} with rectangles in {textures}: {scene}")


def _volume(path: Path) -> Finding:
    from wlm.fluid.volume import is_long_along_z, load_volume

    volume = load_volume(path, up="y")
    size = "x".join(map(str, volume.shape))
    hot = ", with temperature" if volume.temperature is not None else ""
    what = f"a volume of smoke, {size} voxels of {volume.voxel:.3g}{hot}"
    problems = list(volume.warnings)
    if not bool((volume.density > 0).any()):
        problems.append("no smoke in it")
    up = ""
    if path.suffix.lower() != ".npz" and is_long_along_z(volume):
        up = " --up z"
        problems.append("longest along z, which is taken for up, as in Blender and Unreal: without --up z if y is")
    return Finding(path, what, f"wlm smoke bake {quoted(path)}{up} -o OUT.exr", tuple(problems))


def _mesh(path: Path) -> Finding:
    if path.suffix.lower() == ".obj":
        mesh = read_geometry(path, with_uv=False)
        parts, sets, uvs = 1, "", []
        count = len(mesh.triangle)
        with suppress(WlmError):
            whole = read_geometry(path)
            sets, uvs = "UVs", [whole.uv[whole.triangle]]
    else:
        primitives = read_gltf(path)[1]
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
            problems.append("UVs beyond 0 to 1: of a repeated texture, not of a lightmap?")
        elif area > 1.0:
            cause = "each mesh may have a lightmap of its own" if parts > 1 else "not of a lightmap?"
            problems.append(f"its triangles have {area:.1f} times the UVs' square: they overlap; {cause}")
    command = f"wlm atlas compress {quoted(path)} LIGHTMAP -o OUT.wlm" if uvs and not problems else ""
    return Finding(path, what, command, tuple(problems))


def _model(path: Path) -> Finding:
    model = load(path)
    if model.SYSTEM == "probe":
        from wlm.probe.regions import RegionModel

        if isinstance(model, RegionModel):
            # It is read piece by piece; here all of it is asked for.
            model.check_pieces()
    if model.SYSTEM == "smoke-network":
        what = "a network that predicts six-way lightmaps"
        return Finding(path, what, f"wlm smoke predict SMOKE --network {quoted(path)} -o OUT.exr")
    kind = {
        "lightmap": "lightmaps over time",
        "atlas": "the lightmaps of a scene",
        "probe": "light probes",
    }[model.SYSTEM]
    command = f"wlm web {quoted(path)} -o PAGE.html"
    return Finding(path, f"{kind}, compressed: {model.name}", command)


def _json(path: Path) -> Finding:
    content: Any = read_json_file(path, "the file", JSON_BYTES)
    form = str(content.get("format")) if isinstance(content, dict) else ""
    if form in _PROBE_EXPORTS:
        found = _probes(path)
        return replace(found, what=f"{_PROBE_EXPORTS[form]}: {found.what}")
    if form in _EXPORTS:
        return Finding(path, _EXPORTS[form])
    if isinstance(content, dict) and "lightmaps" in content:
        return inspect_set(path)
    if isinstance(content, dict) and ("probes" in content or "position" in content):
        return _probes(path)
    return Finding(path, "JSON that is nothing known here")


def _unity_asset(path: Path) -> Finding:
    """Light probes and rectangles, where it is lighting data; reading it needs an extra."""
    data = read_lighting_data(path)
    places = f"{len(data.rectangles)} renderers' rectangles in lightmaps, without their names"
    if not len(data.position):
        return Finding(path, f"lighting data of Unity: no light probes, {places}")
    found = _probes(path)
    return replace(found, what=f"lighting data of Unity: {found.what}; {places}")


_BY_MAGIC: dict[bytes, Callable[[Path], Finding]] = {
    b"RSRC": _lmbake,
    b"RSCC": _lmbake,
    b"glTF": _mesh,
    b"NanoVDB": _volume,
    _VDB: _volume,
}
_BY_SUFFIX: dict[str, Callable[[Path], Finding]] = {
    ".npz": _npz,
    ".lmbake": _lmbake,
    ".glb": _mesh,
    ".gltf": _mesh,
    ".obj": _mesh,
    ".nvdb": _volume,
    ".vdb": _volume,
    ".wlm": _model,
    ".json": _json,
    ".asset": _unity_asset,
}
