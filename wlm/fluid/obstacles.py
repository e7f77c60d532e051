"""Solid obstacles in the air of a simulation, at rest or moving: spheres and closed meshes, their surfaces and paths.

Lengths are in cells of the lattice, times in its steps, as in `wlm.fluid.lattice`. Surfaces are closed and consist of
triangles, anticlockwise from outside: corners float64 [V, 3], triangles int64 [F, 3].
"""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp
from scipy.spatial import ConvexHull

from wlm_kernels.fluid.lattice_fields import voxelise_mesh, voxelise_sphere

_PIECES = 16  # straight pieces of a ramp of a path
_SIDES = 24  # segments of a sphere from pole to pole; there are twice as many around it


@functools.cache  # pictures ask for it at each frame
def surface(shape: str) -> tuple[np.ndarray, np.ndarray]:
    """Makes a surface around the origin: a "sphere" of radius 1, a "box" with edge 2, or a "cylinder" along y with
    radius 1 and height 2."""
    if shape == "box":
        points = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    else:
        polar, angle = np.linspace(0.0, np.pi, _SIDES + 1), np.arange(2 * _SIDES) * (np.pi / _SIDES)
        radius, height = (np.sin(polar), np.cos(polar)) if shape == "sphere" else (np.ones(2), np.array([1.0, -1.0]))
        rings = np.outer(radius, np.cos(angle)), np.outer(height, np.ones(len(angle))), np.outer(radius, np.sin(angle))
        points = np.unique(np.stack(rings, -1).reshape(-1, 3).round(12), axis=0)
    hull = ConvexHull(points)
    a, b, c = points[hull.simplices].transpose(1, 0, 2)
    outward = np.einsum("fk,fk->f", np.cross(b - a, c - a), hull.equations[:, :3]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1]).astype(np.int64)
    for array in (points, faces):
        array.flags.writeable = False
    return points, faces


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions at K times, linear between them, constant before the first time and after the last.

    Attributes:
        positions: float64 [K, 3], in cells.
        times: float64 [K], in steps of the lattice, increasing.
    """

    positions: np.ndarray
    times: np.ndarray

    @classmethod
    def of(cls, positions: Sequence, times: Sequence[float] = (0.0,)) -> "Trajectory":
        """Makes a trajectory through positions [K, 3] in cells at times [K] in steps, or one constant position (3,).

        Raises:
            ValueError: A shape is wrong, a number is not finite, or the times do not increase.
        """
        p, t = np.atleast_2d(np.asarray(positions, np.float64)), np.asarray(times, np.float64)
        if t.ndim != 1 or len(t) == 0 or p.shape != (len(t), 3):
            raise ValueError(f"path: expected positions [K, 3] and times [K], got shapes {p.shape} and {t.shape}")
        if not (np.isfinite(p).all() and np.isfinite(t).all()):
            raise ValueError("path: expected finite positions and times, got NaN or infinity")
        if (np.diff(t) <= 0).any():
            raise ValueError(f"path: expected increasing times, got {t.tolist()}")
        return cls(p, t)

    @property
    def moves(self) -> bool:
        """Whether an obstacle on this path moves, that is whether the positions differ."""
        return bool((self.positions != self.positions[0]).any())

    def at(self, time: float) -> np.ndarray:
        """Returns the position in cells, float64 (3,), at a time in steps."""
        return np.array([np.interp(time, self.times, self.positions[:, axis]) for axis in range(3)])

    def eased(self, reach: float) -> "Trajectory":
        """Returns the path of a body that starts at rest at time 0, with ramps in place of jumps of its velocity.

        A ramp is a cubic Hermite curve, in straight pieces. It lasts as long as the faster side of the jump takes for
        the distance `reach`, but at most half of the time to the next position. A jump at time 0 is followed by its
        ramp, in which the body catches up, at up to 4/3 of its speed; others are in the middle of theirs.
        """
        start = np.append(0.0, self.times[self.times > 0.0])
        times = start if self.times[0] < 0.0 else self.times
        positions = np.array([self.at(time) for time in times])
        speeds = np.zeros((len(times) + 1, 3))
        speeds[1:-1] = np.diff(positions, axis=0) / np.diff(times)[:, None]
        room = np.concatenate([[2.0 * times[0]], np.diff(times), [np.inf]]) / 2.0
        keys = [np.column_stack([times, positions])]
        for k, (time, place) in enumerate(zip(times, positions, strict=True)):
            change, fastest = speeds[k + 1] - speeds[k], np.linalg.norm(speeds[k : k + 2], axis=1).max()
            if not change.any():
                continue
            after = min(0.5 * reach / fastest, room[k], room[k + 1])
            before = after
            if time == 0.0:
                before, after = 0.0, min(reach / fastest, room[k + 1])
            s = np.linspace(0.0, 1.0, _PIECES + 1)[:, None]
            first, last, span = place - before * speeds[k], place + after * speeds[k + 1], before + after
            curve = first + s**2 * (3 - 2 * s) * (last - first)
            curve += span * (s * (1 - s) ** 2 * speeds[k] - s**2 * (1 - s) * speeds[k + 1])
            keys[0] = keys[0][keys[0][:, 0] != time]
            keys.append(np.column_stack([time - before + span * s, curve]))
        table = np.concatenate(keys)
        table = table[np.argsort(table[:, 0], kind="stable")]
        # Ramps that touch share a time, up to rounding.
        gaps = np.diff(table[:, 0])
        table = table[np.append(True, gaps > 1e-9 * gaps.max(initial=0.0))]
        return Trajectory(table[:, 1:], table[:, 0])


@dataclass(frozen=True, eq=False)
class Sphere:
    """A spherical obstacle.

    Attributes:
        path: Path of the centre.
        radius: Radius in cells, above 0.
    """

    path: Trajectory
    radius: float

    def __post_init__(self) -> None:
        if not 0.0 < self.radius < np.inf:
            raise ValueError(f"radius: expected a length above 0, got {self.radius}")

    def cover(self, solid: wp.array, body: int, position: np.ndarray) -> None:
        """Marks the cells whose centres are inside the obstacle at a position, and clears its earlier marks.

        Args:
            solid: uint8 [X, Y, Z], modified.
            body: Number of the obstacle, 1 to 255.
            position: Position (3,) in cells.
        """
        voxelise_sphere(solid, body, position.tolist(), self.radius)


@dataclass(frozen=True, eq=False)
class Mesh:
    """An obstacle bounded by a closed mesh, which moves without rotation.

    A cell whose centre is exactly on the surface may count as inside or outside.

    Attributes:
        path: Path of the mesh's origin.
        vertices: float32 [V, 3], corners relative to the mesh's origin, in the mesh's own unit.
        triangles: int32 [T, 3], indices of each triangle's corners, anticlockwise seen from outside.
        scale: Cells per unit of the mesh.
    """

    path: Trajectory
    vertices: np.ndarray
    triangles: np.ndarray
    scale: float = 1.0
    _meshes: dict[str, wp.Mesh] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        v, t = np.asarray(self.vertices), np.asarray(self.triangles)
        if v.ndim != 2 or v.shape[1] != 3 or not np.isfinite(v).all():
            raise ValueError(f"vertices: expected finite numbers of shape [V, 3], got NaN or shape {v.shape}")
        if t.ndim != 2 or t.shape[1] != 3 or len(t) == 0:
            raise ValueError(f"triangles: expected indices of vertices of shape [T, 3], T >= 1, got shape {t.shape}")
        if t.min() < 0 or t.max() >= len(v):
            raise ValueError(f"triangles: expected vertex indices of 0 to {len(v) - 1}, got {t.min()} to {t.max()}")
        if not 0.0 < self.scale < np.inf:
            raise ValueError(f"scale: expected a number above 0, got {self.scale}")

    def cover(self, solid: wp.array, body: int, position: np.ndarray) -> None:
        """Marks the cells whose centres are inside the mesh at a position; arguments as for `Sphere.cover`."""
        device = str(solid.device)
        if device not in self._meshes:
            points = wp.array(np.asarray(self.vertices, np.float32), dtype=wp.vec3, device=device)
            indices = wp.array(np.asarray(self.triangles, np.int32).ravel(), dtype=int, device=device)
            self._meshes[device] = wp.Mesh(points, indices, support_winding_number=True)
        voxelise_mesh(solid, body, self._meshes[device], position.tolist(), scale=self.scale)


Obstacle = Sphere | Mesh
"""An obstacle, in cells and steps of the lattice."""


def box_mesh(path: Trajectory, size: Sequence[float]) -> Mesh:
    """Makes a box with its edges along the axes, of lengths `size` in cells, centred on the path.

    Raises:
        ValueError: A length is not above 0.
    """
    edges = np.asarray(size, np.float64)
    if edges.shape != (3,) or not ((edges > 0.0) & np.isfinite(edges)).all():
        raise ValueError(f"size: expected three lengths above 0, got {size}")
    corners, triangles = surface("box")
    return Mesh(path, (0.5 * corners * edges).astype(np.float32), triangles.astype(np.int32))
