"""`open_scene`: makes the scene that a window shows of a model."""

import os
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Literal

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry, read_geometry
from wlm.formats.light import read_light
from wlm.inspection.contents import check_options
from wlm.system import load, system_of
from wlm.view.scene import Scene

_Path = str | os.PathLike[str]


def open_scene(
    file: _Path,
    *,
    mesh: _Path | None = None,
    original: _Path | None = None,
    key: str | None = None,
    time: float | None = None,
    flat: bool = False,
    up: Literal["y", "z"] = "y",
) -> Scene:
    """Makes the scene of a model.

    Args:
        file: A `.wlm` of lightmaps over time, lightmaps of meshes or probes; docs/view.md lists what is shown.
        mesh: Mesh file that the light belongs to; for lightmaps it needs their UVs.
        original: The input that was compressed, to compare with: a lightmap set, a lightmap, or a probe file.
        key: Name of the array to show of a probe file with several.
        time: Hour of the day to show of light probes that have several.
        flat: Whether a lightmap is shown unwrapped, although its mesh is known.
        up: The axis that points up.

    Raises:
        WlmError: The file is damaged or no such model; or an option has no meaning for it.
    """
    options = {"mesh": mesh, "original": original, "key": key, "time": time, "flat": flat or None}
    given = {name: value for name, value in options.items() if value is not None}
    path = Path(file)
    opener = _OPENERS.get(system_of(path))
    if opener is None:
        raise WlmError(f"{path}: expected a .wlm of lightmaps or probes; a smoke network has no picture of its own")
    check_options(path, tuple(given), tuple(signature(opener).parameters))
    return opener(path, title=path.name, up="xyz".index(up), **given)


def _lightmap_model(
    path: Path, title: str, up: int, mesh: _Path | None = None, original: _Path | None = None, flat: bool = False
) -> Scene:
    from wlm.lightmap.data import load as load_set
    from wlm.lightmap.sheet import LIGHT, first_light
    from wlm.view.surface import lightmap_scene

    model = load(path, "lightmap")
    sheet = first_light(model.sheets)
    own, given = model.sheets[sheet], None
    if original is not None:
        given = load_set(original).find(sheet)
        _check_size(original, given.mask.shape, (own.height, own.width))
    title += "" if sheet == LIGHT else f": {sheet.label}"
    return lightmap_scene(own, given, title=title, geometry=_mesh(mesh, flat), up=up)


def _atlas_model(path: Path, title: str, up: int, original: _Path | None = None, flat: bool = False) -> Scene:
    from wlm.view.surface import atlas_scene

    model, light = load(path, "atlas"), None
    if original is not None:
        light = read_light(original)[0]
        _check_size(original, light.shape[:2], model.sheets[0].size)
    return atlas_scene(model, light, title=title, flat=flat, up=up)


def _probes(
    path: Path,
    title: str,
    up: int,
    mesh: _Path | None = None,
    original: _Path | None = None,
    key: str | None = None,
    time: float | None = None,
) -> Scene:
    from wlm.view.probe_scene import model_probes, probe_scene

    probes = model_probes(load(path, "probe").at(time), original, key, title, time)
    geometry = None if mesh is None else read_geometry(mesh, with_uv=False)
    return probe_scene(probes, title=title, geometry=geometry, up=up)


_OPENERS: dict[str, Callable[..., Scene]] = {"atlas": _atlas_model, "lightmap": _lightmap_model, "probe": _probes}


def _mesh(mesh: _Path | None, flat: bool) -> Geometry | None:
    geometry = None if mesh is None else read_geometry(mesh)
    return None if flat else geometry


def _check_size(original: _Path, found: tuple[int, ...], expected: tuple[int, int]) -> None:
    if tuple(found) != tuple(expected):
        raise WlmError(f"{original}: expected a lightmap of {expected[1]}x{expected[0]}, found {found[1]}x{found[0]}")
