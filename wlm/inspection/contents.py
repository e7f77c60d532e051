"""`content_of`: the kind of content in one or more files, by which `wlm web` chooses a page."""

import os
from collections.abc import Sequence
from pathlib import Path

from wlm.errors import WlmError
from wlm.fluid.volume import SUFFIXES
from wlm.inspection.files import kind_of
from wlm.smoke.data import is_six_way, six_way_files
from wlm.system import system_of


def content_of(files: Sequence[str | os.PathLike[str]]) -> tuple[str, list[Path]]:
    """Finds the kind of content of one file or folder, or of six-way lightmaps of smoke, one EXR a frame.

    Returns the kind, and the files; a folder of six-way lightmaps is replaced by its files. The kind is the system of a
    model ("lightmap", "atlas", "probe" or "smoke"); "six-way"; "volume", or a folder of volumes; "folder", any other
    one; or another kind of `wlm.inspection.files.kind_of`, such as "settings".
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
        frames = six_way_files(path)
        if frames:
            return "six-way", list(frames.values())
        return ("volume" if any(each.suffix.lower() in SUFFIXES for each in path.iterdir()) else "folder"), paths
    kind = kind_of(path)
    return (system_of(path) if kind == "model" else kind), paths


def check_options(path: Path, given: Sequence[str], known: Sequence[str]) -> None:
    """Checks that the options `given` with a file are among those `known` for its kind."""
    for name in given:
        if name not in known:
            raise WlmError(f"{path}: --{name} has no meaning for this file; leave the option out")
