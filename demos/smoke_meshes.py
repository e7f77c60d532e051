"""Makes the meshes of the scenes of smoke that are shipped, `configs/meshes`: a rabbit, and the wheel and
the housing of a fan.

The command is `python -m demos.smoke_meshes configs/meshes`.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
import warp as wp

# Ellipsoids of the left half of a rabbit that sits and looks along +x, +y up, in units of its height: centre, half
# axes, and degrees of its turn about z.
_PARTS = (
    ((-0.08, 0.26, 0.0), (0.3, 0.25, 0.21), 12),  # trunk
    ((0.14, 0.3, 0.0), (0.15, 0.22, 0.15), -10),  # chest
    ((-0.16, 0.19, 0.13), (0.18, 0.17, 0.09), 0),  # haunch
    ((-0.02, 0.04, 0.17), (0.17, 0.04, 0.05), 0),  # hind foot
    ((0.22, 0.09, 0.08), (0.06, 0.13, 0.05), 8),  # front leg
    ((0.26, 0.025, 0.085), (0.09, 0.03, 0.045), 0),  # front foot
    ((0.24, 0.54, 0.0), (0.14, 0.13, 0.115), -12),  # head
    ((0.34, 0.51, 0.0), (0.08, 0.07, 0.07), 0),  # muzzle
    ((0.14, 0.8, 0.085), (0.06, 0.22, 0.03), 14),  # ear
    ((-0.4, 0.19, 0.0), (0.09, 0.09, 0.08), 0),  # tail
)
_ROUND = 0.035  # radius of the fillets between parts
_CELLS = 36  # of the grid along a rabbit's height
_BLADES, _VANES = 4, 6


def rabbit() -> trimesh.Trimesh:
    """A closed rabbit with its feet on y = 0, 1 high."""
    step = 1.06 / _CELLS
    counts = np.ceil(np.array([1.02, 1.05, 0.6]) / step).astype(int)
    low = np.array([-0.56, -0.03, -0.5 * step * (counts[2] - 1)])
    places = low + step * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1)
    places[..., 2] = np.abs(places[..., 2])
    outside = np.full(places.shape[:-1], 9.0)
    for centre, half, degrees in _PARTS:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        away = (places - centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        scaled = np.linalg.norm(away / half, axis=-1)
        # Nearly the distance, from the gradient of the scaled one.
        slope = np.linalg.norm(away / np.square(half), axis=-1) / np.maximum(scaled, 1e-9)
        distance = (scaled - 1.0) / np.maximum(slope, 1e-9)
        blend = np.clip(0.5 + 0.5 * (outside - distance) / _ROUND, 0.0, 1.0)
        outside = outside + (distance - outside) * blend - _ROUND * blend * (1.0 - blend)
    surface = wp.MarchingCubes(*map(int, counts))
    surface.surface(wp.array(outside, dtype=float, device="cpu"), 0.0)
    mesh = trimesh.Trimesh(low + step * surface.verts.numpy(), surface.indices.numpy().reshape(-1, 3))
    mesh.apply_translation((0, -mesh.bounds[0, 1], 0))
    mesh.apply_scale(1.0 / mesh.bounds[1, 1])
    return mesh if mesh.volume > 0 else trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1])


def fan() -> trimesh.Trimesh:
    """A wheel of twisted blades around a hub, of radius 1, with its axis along x: turned about +x it blows along +x."""
    parts = [_along_x(trimesh.creation.cylinder(0.3, 0.4, sections=24))]
    stations, rows = np.linspace(0.24, 1.0, 9), []
    for r in stations:
        pitch, chord = min(np.arctan(0.55 / r), 1.0), 0.24 * min(1.0, 0.5 + 0.6 * r)
        along = np.array([np.sin(pitch), 0.0, -np.cos(pitch)])
        thick = 0.05 * np.array([np.cos(pitch), 0.0, np.sin(pitch)])
        rows.append([s * chord * along + t * thick + (0, r, 0) for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    points = np.array(rows).reshape(-1, 3)
    k = np.arange(len(stations) - 1)[:, None, None] * 4
    ring = np.array([[(a, a + 4, (a + 1) % 4), ((a + 1) % 4, a + 4, (a + 1) % 4 + 4)] for a in range(4)])
    ends = np.array([(0, 1, 2), (0, 2, 3)])
    faces = np.concatenate([(ring.reshape(-1, 3) + k).reshape(-1, 3), ends, ends[:, ::-1] + points.shape[0] - 4])
    return _joined([*parts, *_around(trimesh.Trimesh(points, faces, process=False), _BLADES)])


def housing() -> trimesh.Trimesh:
    """The duct around the wheel, and vanes behind it that stop the turn of the air: without them the air leaves a
    wheel of so few cells turning with it, and is thrown outwards instead of ahead."""
    duct = _along_x(trimesh.creation.annulus(1.12, 1.26, 1.3, sections=48)).apply_translation((0.25, 0, 0))
    vane = trimesh.creation.box((0.5, 1.0, 0.08)).apply_translation((0.65, 0.65, 0))
    return _joined([duct, *_around(vane, _VANES)])


def _along_x(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))


def _around(mesh: trimesh.Trimesh, count: int) -> list[trimesh.Trimesh]:
    turns = [trimesh.transformations.rotation_matrix(2 * np.pi * k / count, (1, 0, 0)) for k in range(count)]
    return [mesh.copy().apply_transform(turn) for turn in turns]


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """All parts as one mesh, each with its outside out."""
    outward = [part if part.volume > 0 else trimesh.Trimesh(part.vertices, part.faces[:, ::-1]) for part in parts]
    return trimesh.util.concatenate(outward)


if __name__ == "__main__":
    for name, made in (("rabbit", rabbit()), ("fan", fan()), ("fan-housing", housing())):
        made.export(Path(sys.argv[1]) / f"{name}.ply")
