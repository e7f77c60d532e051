"""Scenes of files, by what a file holds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from wlm.errors import WlmError
from wlm.formats.geometry import read_geometry
from wlm.formats.light import SUFFIXES, read_light
from wlm.formats.npz import read_npz
from wlm.lightmap.listing import SET_FILE
from wlm.smoke.data import SCENE_FILE, is_six_way, six_way_files
from wlm.system import OnProgress, load
from wlm.view.scene import Scene

if TYPE_CHECKING:
    from wlm.atlas.model import AtlasModel
    from wlm.lightmap.data import SheetFrames
    from wlm.lightmap.model import SheetModel
    from wlm.view.probe_scene import Probes


def open_scene(
    files: Sequence[str | os.PathLike[str]],
    *,
    mesh: str | os.PathLike[str] | None = None,
    original: str | os.PathLike[str] | None = None,
    key: str | None = None,
    walk: str | os.PathLike[str] | None = None,
    block: float | None = None,
    extinction: float | None = None,
    flat: bool = False,
    up: Literal["y", "z"] = "y",
    progress: OnProgress | None = None,
) -> Scene:
    """Makes the scene of a file.

    Args:
        files: One file or folder, or six-way lightmaps of smoke, one EXR a frame; what is shown of each is in
            docs/view.md.
        mesh: The scene that the light belongs to: `.glb`, `.gltf` or `.obj`; of lightmaps with their UVs.
        original: What was compressed, to compare with: a lightmap set, an atlas' lightmap, a probe file.
        key: Of a probe file with several arrays, the one to show.
        walk: Viewpoints of the cascaded volume, as `wlm probe walk --path` takes.
        block: Side of the cascaded volume's finest blocks; None: from the probes' spacing.
        extinction: Of a volume of smoke, per unit of length at density 1.
        flat: Whether a lightmap is shown unwrapped though its mesh is there.
        up: The axis that points up.
        progress: Called about twice a second while frames of smoke are read.

    Raises:
        WlmError: A file is missing, damaged, or of a kind that has no picture; an option doesn't fit it.
    """
    paths = [Path(file) for file in files]
    if not paths:
        raise WlmError("expected a file to show, found none")
    path = paths[0]
    request = _Request(path, mesh, original, key, walk, block, extinction, flat, up, progress)
    if not path.exists():
        raise WlmError(f"{path}: no such file or folder")
    if is_six_way(path):
        return request.six_way(paths)
    if len(paths) > 1:
        raise WlmError(f"{paths[1]}: expected one file; only smoke has several, one EXR a frame")
    if path.is_dir():
        return request.folder()
    suffix = path.suffix.lower()
    if suffix == ".wlm":
        return request.model()
    if suffix in SUFFIXES:
        return request.lightmap()
    if suffix in (".nvdb", ".vdb") or (suffix == ".npz" and "density" in _names(path)):
        return request.volume(path)
    if path.name == SET_FILE:
        return request.lightmap_set()
    if suffix in (".npz", ".json", ".lmbake"):
        return request.probes()
    if suffix in (".glb", ".gltf", ".obj"):
        raise WlmError(f"{path}: a mesh has no light of its own; expected the light, with this as --mesh")
    known = ", ".join((".wlm", *SUFFIXES, ".npz", ".nvdb", ".vdb", ".json"))
    raise WlmError(f"{path}: expected a folder or {known} or .lmbake, found {path.suffix or 'none'}")


@dataclass(frozen=True)
class _Request:
    """The arguments of `open_scene`, and a method for each kind of file. What a kind can't use, it refuses."""

    path: Path
    mesh: str | os.PathLike[str] | None
    original: str | os.PathLike[str] | None
    key: str | None
    walk: str | os.PathLike[str] | None
    block: float | None
    extinction: float | None
    flat: bool
    up: Literal["y", "z"]
    progress: OnProgress | None

    def folder(self) -> Scene:
        if (self.path / SCENE_FILE).is_file():
            return self.volume(self.path)
        if frames := six_way_files(self.path):
            return self.six_way(frames)
        return self.lightmap_set()

    def model(self) -> Scene:
        model = load(self.path)
        if model.SYSTEM == "lightmap":
            from wlm.lightmap.data import load as load_set
            from wlm.lightmap.sheet import LIGHT, first_light

            self._refuse("key", "walk", "block", "extinction")
            sheet = first_light(model.sheets)
            model = model.sheets[sheet]
            given = None if self.original is None else load_set(self.original).find(sheet)
            if given is not None:
                self._check_size(given.mask.shape, (model.height, model.width))
            return self._lightmaps(model, given, "" if sheet == LIGHT else f": {sheet.label}")
        if model.SYSTEM == "probe":
            from wlm.probe.places import probes_of
            from wlm.view.probe_scene import Probes

            self._refuse("extinction", "flat")
            position, values, live, _ = probes_of(model, self.original, self.key)
            return self._probes(Probes.of_model(model, position, values, live, self.path.name))
        if model.SYSTEM == "atlas":
            return self.atlas(model)
        raise WlmError(f"{self.path}: a network has no picture of its own; expected the lightmaps that it predicts")

    def lightmap_set(self) -> Scene:
        from wlm.lightmap.data import load as load_set

        self._refuse("original", "key", "walk", "block", "extinction")
        return self._lightmaps(None, load_set(self.path).light)

    def lightmap(self) -> Scene:
        self._refuse("original", "key", "walk", "block", "extinction")
        if self.mesh is None:
            from wlm.lightmap.data import from_arrays

            return self._lightmaps(
                None, from_arrays(read_light(self.path)[0][None, ..., :3], [0.0], name=self.path.name).light
            )
        from wlm.atlas.data import load as load_mesh
        from wlm.view.atlas_scene import input_scene

        return input_scene(load_mesh(self.mesh, self.path), title=self.path.name, flat=self.flat, up=self._up)

    def atlas(self, model: AtlasModel) -> Scene:
        from wlm.view.atlas_scene import atlas_scene

        self._refuse("mesh", "key", "walk", "block", "extinction")
        light = None
        if self.original is not None:
            light = read_light(self.original)[0]
            self._check_size(light.shape[:2], model.sheets[0].size)
        return atlas_scene(model, light, title=self.path.name, flat=self.flat, up=self._up)

    def probes(self) -> Scene:
        from wlm.probe.data import load as load_probes
        from wlm.view.probe_scene import Probes

        self._refuse("original", "extinction", "flat")
        return self._probes(Probes.of_set(load_probes(self.path, key=self.key), self.path.name))

    def volume(self, path: Path) -> Scene:
        from wlm.smoke.data import load_frames
        from wlm.view.smoke_scene import volume_scene

        self._refuse("mesh", "original", "key", "walk", "block", "flat")
        return volume_scene(load_frames(path, extinction=self.extinction), title=path.name, up=self._up)

    def six_way(self, paths: Sequence[Path]) -> Scene:
        from wlm.view.smoke_scene import six_way_scene

        self._refuse("mesh", "original", "key", "walk", "block", "extinction", "flat")
        return six_way_scene(paths, title=self.path.name, progress=self.progress)

    @property
    def _up(self) -> int:
        return "xyz".index(self.up)

    def _refuse(self, *names: str) -> None:
        for name in names:
            if getattr(self, name) not in (None, False):
                raise WlmError(f"{self.path}: --{name} means nothing to this file")

    def _check_size(self, found: tuple[int, ...], expected: tuple[int, int]) -> None:
        if found != expected:
            raise WlmError(
                f"{self.original}: expected a lightmap of {expected[1]}x{expected[0]}, found {found[1]}x{found[0]}"
            )

    def _lightmaps(self, model: SheetModel | None, lightmaps: SheetFrames | None, which: str = "") -> Scene:
        from wlm.view.lightmap_scene import lightmap_scene

        geometry = None if self.mesh is None else read_geometry(self.mesh)
        if self.flat:
            geometry = None
        return lightmap_scene(model, lightmaps, title=self.path.name + which, geometry=geometry, up=self._up)

    def _probes(self, probes: Probes) -> Scene:
        from wlm.probe.data import load_positions
        from wlm.view.probe_scene import probe_scene

        geometry = None if self.mesh is None else read_geometry(self.mesh, with_uv=False)
        walk = None if self.walk is None else load_positions(self.walk)
        return probe_scene(probes, title=self.path.name, geometry=geometry, walk=walk, block=self.block, up=self._up)


def _names(path: Path) -> list[str]:
    """The names of the arrays in a `.npz` file."""
    found: list[str] = []

    def look(names: Sequence[str]) -> Sequence[str]:
        found.extend(names)
        return ()

    read_npz(path, look, numbers=0)
    return found
