"""`make_page` and `write_page`: the HTML page of any file that a browser can show."""

import os
from collections.abc import Mapping, Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, Literal

from wlm.errors import WlmError
from wlm.export.page.html import Page
from wlm.inspection.contents import check_options, content_of
from wlm.system import OnProgress

_PAGES = {
    "atlas": ("wlm.export.page.atlas", "atlas_page"),
    "lightmap": ("wlm.export.page.lightmap", "lightmap_page"),
    "probe": ("wlm.export.page.probe", "probe_page"),
    "settings": ("wlm.export.page.scene", "scene_page"),
    "six-way": ("wlm.export.page.smoke", "smoke_page"),
    "volume": ("wlm.export.page.smoke", "live_page"),
}
"""Module and function that make the page of a kind of content."""


def write_page(path: str | os.PathLike[str], files: Sequence[str | os.PathLike[str]], **options: Any) -> int:
    """Writes an HTML page that shows a file and needs no network, and returns its size in bytes.

    Args:
        path: The page, `.html`; its folder must exist.
        files, options: See `make_page`.

    Raises:
        WlmError: A file is missing, damaged, or of a kind that no page shows; or an option has no meaning for it.
    """
    return make_page(files, **options).write(path)


def make_page(
    files: Sequence[str | os.PathLike[str]],
    *,
    mesh: str | os.PathLike[str] | None = None,
    original: str | os.PathLike[str] | None = None,
    key: str | None = None,
    time: float | None = None,
    hours: int | None = None,
    rate: float | None = None,
    network: str | os.PathLike[str] | None = None,
    volume: Mapping[str, Any] | None = None,
    up: Literal["y", "z"] = "y",
    progress: OnProgress | None = None,
) -> Page:
    """Makes the HTML page of one model, of a smoke animation or of a scene.

    Args:
        files: One `.wlm` of lightmaps over time, lightmaps of meshes or probes; six-way lightmaps of smoke, one EXR a
            frame, or their folder; volumes of smoke, one file or a folder of frames; or the YAML file of a scene, see
            `wlm.scene.load`.
        mesh: Mesh file of the scene. To show lightmaps over time, it must have the UVs of the lightmaps.
        original: The input that was compressed, to compare with: a lightmap set, a lightmap, or a probe file.
        key: Name of the array to read from an original probe file with several arrays.
        time: Hour of the day to show of light probes that have several.
        hours: Largest number of original lightmaps in the page, at evenly spread times; None: 6.
        rate: Playback speed of smoke, in frames per second; None: 30.
        network: Network by which the browser makes six-way lightmaps of volumes, a file or "fast", the one that ships
            with wlm; None: it makes them by a coarse march, as `wlm.smoke.predict` does.
        volume: Options of `wlm.smoke.load_frames` for volumes, such as {"extinction": 14.0}.
        up: The axis that points up in the scene.
        progress: Called about twice a second while originals or frames of smoke are read.

    Raises:
        WlmError: A file is missing, damaged, or of a kind that no page shows; or an option has no meaning for it.
    """
    kind, paths = content_of(files)
    if kind == "smoke":
        raise WlmError(f"{paths[0]}: a smoke network has no picture of its own; expected lightmaps predicted by it")
    if kind not in _PAGES:
        raise WlmError(f"{paths[0]}: expected a .wlm file, a scene, smoke or six-way EXRs")
    module, function = _PAGES[kind]
    make = getattr(import_module(module), function)
    known = signature(make).parameters
    given: dict[str, Any] = {"mesh": mesh, "original": original, "key": key, "time": time, "hours": hours}
    given |= {"rate": rate, "network": network, "volume": volume}
    given = {name: value for name, value in given.items() if value is not None}
    check_options(Path(files[0]), tuple(given), tuple(known))
    given |= {"up": up, "progress": progress}  # they have defaults for every kind
    return make(paths, **{name: value for name, value in given.items() if name in known})
