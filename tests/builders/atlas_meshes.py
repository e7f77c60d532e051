"""Small meshes with lightmaps, for tests of the atlas."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from wlm.atlas.data import LightmappedScene, from_arrays
from wlm.formats.exr import write_exr
from wlm.formats.gltf_writer import write_glb

Light = Callable[[np.ndarray], np.ndarray]
"""Radiance [..., 3] at places [..., 2] in [0, 1] of the lightmap."""


def image(light: Light, height: int, width: int) -> np.ndarray:
    """A lightmap float32 [height, width, 3], the light at the texels' centres."""
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return np.asarray(light(np.stack([u, v], -1)), np.float32)


def soft(place: np.ndarray) -> np.ndarray:
    """A lamp's pool of light, a slope and, within one half, a hard shadow."""
    u, v = place[..., 0], place[..., 1]
    pool = np.exp(-((u - 0.3) ** 2 + (v - 0.4) ** 2) / 0.02)
    shadow = np.where((u > 0.55) & (u + v > 1.2), 0.2, 1.0)
    return (np.stack([0.8 * pool, 0.6 * pool, 0.4 * pool], -1) + 0.3 + 0.2 * u[..., None]) * shadow[..., None]


def constant(*colour: float) -> Light:
    """Makes a lightmap of one colour."""
    return lambda place: np.broadcast_to(np.array(colour), (*place.shape[:-1], 3))


def sheet(
    light: Light = soft, height: int = 40, width: int = 48, quads: int = 4, name: str = "sheet"
) -> LightmappedScene:
    """A bent sheet of `quads` x `quads`, one chart that fills the whole lightmap."""
    v, u = np.meshgrid(*[np.linspace(0.0, 1.0, quads + 1)] * 2, indexing="ij")
    position = np.stack([u, v, 0.3 * np.sin(3.0 * u)], -1).reshape(-1, 3)
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return from_arrays(position, _quads(quads, quads), uv, image(light, height, width), name=name)


def charts(light: Light = soft, height: int = 48, width: int = 64, name: str = "charts") -> LightmappedScene:
    """The six sides of a cube, one separate chart per side; a seventh chart inside it is hidden from all views."""
    position, triangle, uv = [], [], []
    for side in range(7):
        axis, end = side // 2 % 3, side % 2
        corner = np.insert(np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float), axis, end, axis=1)
        if side == 6:
            corner = 0.25 + 0.5 * np.insert(corner[:, 1:], 0, 0.5, axis=1)
        triangle.append(_quads(1, 1) + 4 * side)
        position.append(corner)
        row, column = divmod(side, 4)
        uv.append((np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * 0.8 + 0.1 + [column, row]) / [4, 2])
    lightmap = image(light, height, width)
    mesh = [np.concatenate(part) for part in (position, triangle, uv)]
    return from_arrays(*mesh, lightmap, name=name)


def triangle(light: Light = soft, height: int = 16, width: int = 16, name: str = "triangle") -> LightmappedScene:
    """Makes a triangle in a corner of its lightmap."""
    corner = np.array([[0.1, 0.1], [0.7, 0.15], [0.2, 0.6]])
    position = np.insert(corner, 2, 0.0, axis=1)
    return from_arrays(position, np.array([[0, 1, 2]]), corner, image(light, height, width), name=name)


def write_files(folder: Path, mesh: LightmappedScene) -> tuple[Path, Path]:
    """Writes a mesh and its lightmap as `mesh.glb` and `light.exr`."""
    write_glb(folder / "mesh.glb", mesh.document, [], 1)
    write_exr(folder / "light.exr", mesh.sheets[0].lightmap)
    return folder / "mesh.glb", folder / "light.exr"


def _quads(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of (rows + 1) x (columns + 1) vertices, int64 [2 rows columns, 3]."""
    number = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    return np.stack([np.stack([a, b, c], -1), np.stack([c, b, d], -1)], 2).reshape(-1, 3)
