"""`content_of`: the kind of content in one or more files, by which `wlm view` and `wlm web` choose how to show it."""

import os
from collections.abc import Sequence
from pathlib import Path

from wlm.errors import WlmError
from wlm.inspection.files import kind_of
from wlm.smoke.data import SCENE_FILE, is_six_way, six_way_files
from wlm.system import system_of

_PROBES = ("probes", "godot bake", "unity asset")


def content_of(files: Sequence[str | os.PathLike[str]]) -> tuple[str, list[Path]]:
    """Finds the kind of content of one file or folder, or of six-way lightmaps of smoke, one EXR a frame.

    Returns the kind, and the files; a folder of six-way lightmaps is replaced by its files. The kind is the system of a
    model ("lightmap", "atlas", "probe" or "smoke"); "six-way"; "set" of lightmaps over time; "probes"; "volume" of
    smoke or frames of a simulation; or another kind of `wlm.inspection.files.kind_of`, such as "picture" or "mesh".
    """
    paths = [Path(file) for file in files]
    if not paths:
        raise WlmError("expected a file to show, found none")
    path = paths[0]
    if not path.exists():
        raise WlmError(f"{path}: no such file or folder")
    if is_six_way(path):
        return "six-way", paths
    if len(paths) > 1:
        raise WlmError(f"{paths[1]}: expected one file; only six-way lightmaps may be several, an EXR per frame")
    if path.is_dir():
        if (path / SCENE_FILE).is_file():
            return "volume", paths
        frames = six_way_files(path)
        return ("six-way", list(frames.values())) if frames else ("set", paths)
    kind = kind_of(path)
    if kind == "model":
        return system_of(path), paths
    return ("probes" if kind in _PROBES else kind), paths


def check_options(path: Path, given: Sequence[str], known: Sequence[str]) -> None:
    """Checks that the options `given` with a file are among those `known` for its kind."""
    for name in given:
        if name not in known:
            raise WlmError(f"{path}: --{name} has no meaning for this file; leave the option out")
