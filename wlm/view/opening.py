"""`open_scene`: makes the scene that a window shows from any supported file."""

import os
from collections.abc import Callable, Sequence
from inspect import signature
from pathlib import Path
from typing import Literal

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry, read_geometry
from wlm.formats.light import read_light
from wlm.inspection.contents import check_options, content_of
from wlm.system import OnProgress, load
from wlm.view.scene import Scene

_Path = str | os.PathLike[str]
_EXPECTED = "expected a .wlm, a lightmap, a set of lightmaps, light probes, or six-way lightmaps of smoke"


def open_scene(
    files: Sequence[_Path],
    *,
    mesh: _Path | None = None,
    original: _Path | None = None,
    key: str | None = None,
    time: float | None = None,
    walk: _Path | None = None,
    block: float | None = None,
    flat: bool = False,
    up: Literal["y", "z"] = "y",
    progress: OnProgress | None = None,
) -> Scene:
    """Makes the scene of a file.

    Args:
        files: One file or folder, or six-way lightmaps of smoke, one EXR a frame; docs/view.md lists what is shown.
        mesh: Mesh file that the light belongs to; for lightmaps it needs their UVs.
        original: The input that was compressed, to compare with: a lightmap set, a lightmap, or a probe file.
        key: Name of the array to show of a probe file with several.
        time: Hour of the day to show of light probes that have several.
        walk: File with the viewpoints of the cascaded volume, as `wlm.probe.load_positions` reads it.
        block: Side of the cascaded volume's finest blocks; None to derive it from the probes' spacing.
        flat: Whether a lightmap is shown unwrapped, although its mesh is known.
        up: The axis that points up.
        progress: Called about twice a second while frames of smoke are read.
    """
    options = {"mesh": mesh, "original": original, "key": key, "time": time, "walk": walk, "block": block}
    options["flat"] = flat or None
    given = {name: value for name, value in options.items() if value is not None}
    kind, paths = content_of(files)
    if kind not in _OPENERS:
        raise WlmError(f"{paths[0]}: {_REASONS.get(kind, _EXPECTED)}")
    opener = _OPENERS[kind]
    known = signature(opener).parameters
    check_options(Path(files[0]), tuple(given), tuple(known))
    if "progress" in known:
        given["progress"] = progress
    return opener(paths, title=Path(files[0]).name, up="xyz".index(up), **given)


def _lightmap_model(
    paths: list[Path], title: str, up: int, mesh: _Path | None = None, original: _Path | None = None, flat: bool = False
) -> Scene:
    from wlm.lightmap.data import load as load_set
    from wlm.lightmap.sheet import LIGHT, first_light
    from wlm.view.surface import lightmap_scene

    model = load(paths[0], "lightmap")
    sheet = first_light(model.sheets)
    own, given = model.sheets[sheet], None
    if original is not None:
        given = load_set(original).find(sheet)
        _check_size(original, given.mask.shape, (own.height, own.width))
    title += "" if sheet == LIGHT else f": {sheet.label}"
    return lightmap_scene(own, given, title=title, geometry=_mesh(mesh, flat), up=up)


def _atlas_model(paths: list[Path], title: str, up: int, original: _Path | None = None, flat: bool = False) -> Scene:
    from wlm.view.surface import atlas_scene

    model, light = load(paths[0], "atlas"), None
    if original is not None:
        light = read_light(original)[0]
        _check_size(original, light.shape[:2], model.sheets[0].size)
    return atlas_scene(model.scene, model, light, title=title, flat=flat, up=up)


def _probes(
    paths: list[Path],
    title: str,
    up: int,
    mesh: _Path | None = None,
    original: _Path | None = None,
    key: str | None = None,
    time: float | None = None,
    walk: _Path | None = None,
    block: float | None = None,
) -> Scene:
    from wlm.probe.data import load as load_probes
    from wlm.probe.data import load_positions
    from wlm.view.probe_scene import model_probes, probe_scene, set_probes

    if content_of(paths)[0] == "probe":
        probes = model_probes(load(paths[0], "probe").at(time), original, key, title, time)
    else:
        check_options(paths[0], ("original",) if original else (), ())
        probes = set_probes(load_probes(paths[0], key=key).at(time), title)
    geometry = None if mesh is None else read_geometry(mesh, with_uv=False)
    path = None if walk is None else load_positions(walk)
    return probe_scene(probes, title=title, geometry=geometry, walk=path, block=block, up=up)


def _lightmap_set(paths: list[Path], title: str, up: int, mesh: _Path | None = None, flat: bool = False) -> Scene:
    from wlm.lightmap.data import load as load_set
    from wlm.view.surface import lightmap_scene

    return lightmap_scene(None, load_set(paths[0]).light, title=title, geometry=_mesh(mesh, flat), up=up)


def _picture(paths: list[Path], title: str, up: int, mesh: _Path | None = None, flat: bool = False) -> Scene:
    from wlm.atlas.data import load as load_mesh
    from wlm.lightmap.data import from_arrays
    from wlm.view.surface import atlas_scene, lightmap_scene

    if mesh is not None:
        return atlas_scene(load_mesh(mesh, paths[0]), title=title, flat=flat, up=up)
    light = read_light(paths[0])[0][None, ..., :3]
    return lightmap_scene(None, from_arrays(light, [0.0], name=title).light, title=title, up=up)


def _six_way(paths: list[Path], title: str, up: int, progress: OnProgress | None = None) -> Scene:
    from wlm.view.smoke_scene import six_way_scene

    return six_way_scene(paths, title=title, progress=progress)


_OPENERS: dict[str, Callable[..., Scene]] = {
    "atlas": _atlas_model,
    "lightmap": _lightmap_model,
    "picture": _picture,
    "probe": _probes,
    "probes": _probes,
    "set": _lightmap_set,
    "six-way": _six_way,
}
_REASONS = {
    "mesh": "a mesh has no light of its own; expected the light, with this as --mesh",
    "smoke": "a network has no picture of its own; expected the lightmaps that it predicts",
    "volume": "a volume of smoke is drawn by wlm smoke light; expected six-way lightmaps",
}


def _mesh(mesh: _Path | None, flat: bool) -> Geometry | None:
    geometry = None if mesh is None else read_geometry(mesh)
    return None if flat else geometry


def _check_size(original: _Path, found: tuple[int, ...], expected: tuple[int, int]) -> None:
    if tuple(found) != tuple(expected):
        raise WlmError(f"{original}: expected a lightmap of {expected[1]}x{expected[0]}, found {found[1]}x{found[0]}")
