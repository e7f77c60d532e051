"""The inputs of the atlas benchmark: lightmaps of meshes."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import wlm
from wlm.atlas.data import LightmappedScene
from wlm.atlas.data import load as load_scene
from wlm.errors import WlmError


@dataclass(frozen=True, eq=False)
class Lightmap:
    """A mesh with its lightmap.

    Attributes:
        scene: The scene of its rows.
        lit: The mesh and the lightmap.
    """

    scene: str
    lit: LightmappedScene


def load(
    meshes_path: str | os.PathLike[str] | None = None,
    mesh_path: str | os.PathLike[str] | None = None,
    lightmap_paths: Sequence[str | os.PathLike[str]] = (),
    mask_path: str | os.PathLike[str] | None = None,
) -> list[Lightmap]:
    """Reads the lightmaps of a run.

    Args:
        meshes_path: A folder of a mesh, or of such folders: each has one `.glb`, its lightmaps, `.exr`, and maybe
            their `mask.png`.
        mesh_path: Instead, one mesh.
        lightmap_paths: Its lightmaps.
        mask_path: Their mask; None derives it.

    Returns:
        The lightmaps. Without any path those of the checkout's `demos/data/atlas`.

    Raises:
        WlmError: A file is missing or damaged, a folder has no mesh with a lightmap, or paths were given that don't go
            together.
    """
    if mesh_path is not None:
        if meshes_path is not None or not lightmap_paths:
            raise WlmError("bench atlas: expected --mesh FILE with --lightmap FILE, or --meshes DIR alone")
        return _lightmaps(Path(mesh_path), [Path(path) for path in lightmap_paths], mask_path)
    if lightmap_paths or mask_path is not None:
        raise WlmError("bench atlas: --lightmap and --mask need --mesh FILE")
    if meshes_path is None:
        meshes_path = Path(wlm.__file__).resolve().parents[1] / "demos" / "data" / "atlas"
        if not meshes_path.is_dir():
            raise WlmError("bench atlas: the demo's mesh comes with a checkout alone; expected --meshes DIR")
    folder = Path(meshes_path)
    if not folder.is_dir():
        raise WlmError(f"{folder}: no such folder; expected one of meshes with their lightmaps")
    lightmaps = []
    for each in (folder, *sorted(path for path in folder.iterdir() if path.is_dir())):
        meshes, images = sorted(each.glob("*.glb")), sorted(each.glob("*.exr"))
        if len(meshes) > 1:
            raise WlmError(f"{each}: expected one .glb a folder, found {len(meshes)}")
        if meshes and images:
            mask = each / "mask.png"
            lightmaps += _lightmaps(meshes[0], images, mask if mask.is_file() else None)
    if not lightmaps:
        raise WlmError(f"{folder}: expected a .glb and its .exr in it or in folders of it, found none")
    return lightmaps


def _lightmaps(mesh: Path, lightmaps: Sequence[Path], mask: str | os.PathLike[str] | None) -> list[Lightmap]:
    name = mesh.resolve().parent.name if mesh.stem == "mesh" else mesh.stem
    scenes = [name if path.stem == name else f"{name} {path.stem}" for path in lightmaps]
    meshes = (load_scene(mesh, path, mask_path=mask) for path in lightmaps)
    return [Lightmap(*pair) for pair in zip(scenes, meshes, strict=True)]
