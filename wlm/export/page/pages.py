"""Pages of our files, by what a file holds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from wlm.errors import WlmError
from wlm.export.page.html import Page
from wlm.smoke.data import is_six_way, six_way_files
from wlm.system import OnProgress, load


def write_page(path: str | os.PathLike[str], files: Sequence[str | os.PathLike[str]], **options: Any) -> int:
    """Writes a page that shows a file of ours: HTML that needs no network.

    Args:
        path: The page, `.html`; its folder must exist.
        files: As for `make_page`.
        options: As for `make_page`.

    Returns:
        The page's size, bytes.

    Raises:
        WlmError: A file is missing, damaged, or of a kind that no page shows; an option doesn't fit it.
    """
    return make_page(files, **options).write(path)


def make_page(
    files: Sequence[str | os.PathLike[str]],
    *,
    mesh: str | os.PathLike[str] | None = None,
    original: str | os.PathLike[str] | None = None,
    key: str | None = None,
    hours: int = 6,
    rate: float = 30.0,
    up: Literal["y", "z"] = "y",
    progress: OnProgress | None = None,
) -> Page:
    """Makes the page of a file.

    Args:
        files: One `.wlm` of lightmaps (of layered ones the first light is shown) or of probes; or the folder that
            `wlm atlas compress` wrote; or six-way lightmaps of smoke, one EXR a frame, or their folder.
        mesh: The scene: `.glb`, `.gltf` or `.obj`; of lightmaps with their UVs, of probes any.
        original: What was compressed, to compare with: a lightmap set, an atlas' lightmap, a probe file.
        key: Of a probe file with several arrays, the one that was compressed.
        hours: Most frames of the original lightmaps that the page carries, spread evenly.
        rate: Frames a second of smoke that plays.
        up: The axis that points up in the scene.
        progress: Called about twice a second, of originals and of frames of smoke.

    Raises:
        WlmError: As `write_page`.
    """
    paths = [Path(file) for file in files]
    if not paths:
        raise WlmError("expected a file to show, found none")
    path = paths[0]
    if not path.exists():
        raise WlmError(f"{path}: no such file or folder")
    if len(paths) == 1 and path.is_dir():
        paths = six_way_files(path) or paths
    if is_six_way(paths[0]):
        from wlm.export.page.smoke import smoke_page

        _refuse(path, mesh=mesh, original=original, key=key)
        return smoke_page(paths, rate=rate, progress=progress)
    if len(paths) > 1:
        raise WlmError(f"{paths[1]}: expected one file; only smoke has several, one EXR a frame")
    if path.is_dir() or path.suffix.lower() != ".wlm":
        raise WlmError(f"{path}: expected a .wlm or six-way EXRs; wlm view shows inputs too")
    model = load(path)
    if model.SYSTEM == "lightmap":
        from wlm.export.page.lightmap import lightmap_page

        _refuse(path, key=key)
        return lightmap_page(
            model, path.stat().st_size, mesh=mesh, original=original, hours=hours, up=up, progress=progress
        )
    if model.SYSTEM == "probe":
        from wlm.export.page.probe import probe_page

        return probe_page(model, path.stat().st_size, mesh=mesh, original=original, key=key, up=up)
    if model.SYSTEM == "atlas":
        from wlm.export.page.atlas import model_page

        _refuse(path, mesh=mesh, key=key)
        return model_page(model, original=original, up=up)
    raise WlmError(f"{path}: a network has no picture of its own; expected the lightmaps that it predicts")


def _refuse(path: Path, **options: object) -> None:
    for name, value in options.items():
        if value is not None:
            raise WlmError(f"{path}: --{name} means nothing to this file")
