"""Solid obstacles in the air of a simulation, at rest or moving: spheres and closed meshes, their surfaces and paths,
and the cells that they cover.

Lengths are in cells of the lattice, times in its steps, as in `wlm.fluid.lattice`. Surfaces are closed and consist of
triangles, anticlockwise from outside: corners float64 [V, 3], triangles int64 [F, 3].
"""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from wlm_kernels.fluid import lattice_bodies

_PIECES = 16  # straight pieces of a ramp of a path
SHELL = 0.71
"""Half of the thickness in cells of a surface that stops air: a link of D3Q19, of at most 2^(1/2), ends in it."""
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
    """The path of a body through K poses: position and turn change at constant rates between two of them, and are
    constant before the first time and after the last.

    Attributes:
        positions: float64 [K, 3], of the body's origin in cells.
        times: float64 [K], in steps of the lattice, increasing.
        rotations: float64 [K, 4], unit quaternions (x, y, z, w) that turn the body about its origin.
    """

    positions: np.ndarray
    times: np.ndarray
    rotations: np.ndarray

    @classmethod
    def of(
        cls, positions: Sequence, times: Sequence[float] = (0.0,), rotations: Sequence | None = None
    ) -> "Trajectory":
        """Makes a trajectory through positions [K, 3] in cells at times [K] in steps, or one constant position (3,).

        `rotations` are unit quaternions (x, y, z, w), [K, 4] or (4,); None: the body does not turn. Between two times
        it turns the shorter way (spherical linear interpolation), by less than half a turn.

        Raises:
            ValueError: A shape is wrong, a number is not finite, the times do not increase, or a quaternion's length is
                not 1.
        """
        p, t = np.atleast_2d(np.asarray(positions, np.float64)), np.asarray(times, np.float64)
        if t.ndim != 1 or len(t) == 0 or p.shape != (len(t), 3):
            raise ValueError(f"path: expected positions [K, 3] and times [K], got shapes {p.shape} and {t.shape}")
        if not (np.isfinite(p).all() and np.isfinite(t).all()):
            raise ValueError("path: expected finite positions and times, got NaN or infinity")
        if (np.diff(t) <= 0).any():
            raise ValueError(f"path: expected increasing times, got {t.tolist()}")
        still = np.broadcast_to((0.0, 0.0, 0.0, 1.0), (len(t), 4))
        r = still if rotations is None else np.atleast_2d(np.asarray(rotations, np.float64))
        lengths = np.linalg.norm(r, axis=-1, keepdims=True)
        if r.shape != (len(t), 4) or not (np.abs(lengths - 1.0) < 1e-3).all():
            raise ValueError(f"path: expected rotations [{len(t)}, 4], quaternions of length 1, got {r.tolist()}")
        return cls(p, t, r / lengths)

    @property
    def moves(self) -> bool:
        """Whether a body on this path moves, that is whether the positions or the rotations differ."""
        return bool((self.positions != self.positions[0]).any() or self.turns)

    @property
    def turns(self) -> bool:
        """Whether a body on this path turns."""
        return bool(self.rates[1].any())

    @functools.cached_property
    def rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocity in cells per step and angular velocity in radians per step after each time, float64 [K, 3]; 0 after
        the last."""
        spans, turns = np.diff(self.times)[:, None], Rotation.from_quat(self.rotations)
        rates = np.diff(self.positions, axis=0) / spans, (turns[1:] * turns[:-1].inv()).as_rotvec() / spans
        return tuple(np.concatenate([rate, np.zeros((1, 3))]) for rate in rates)

    def at(self, time: float) -> np.ndarray:
        """Returns the position in cells, float64 (3,), at a time in steps."""
        return np.array([np.interp(time, self.times, self.positions[:, axis]) for axis in range(3)])

    def turn(self, time: float) -> np.ndarray:
        """Returns the matrix, float64 (3, 3), that turns the body from its own frame at a time in steps."""
        return self._turned(time).as_matrix()

    def _turned(self, time: float) -> Rotation:
        k = max(int(np.searchsorted(self.times, time, side="right")) - 1, 0)
        angle = max(time - self.times[k], 0.0) * self.rates[1][k]
        return Rotation.from_rotvec(angle) * Rotation.from_quat(self.rotations[k])

    def eased(self, reach: float) -> "Trajectory":
        """Returns the path of a body that starts at rest at time 0, with ramps in place of jumps of its velocity and
        angular velocity.

        A ramp is a cubic Hermite curve, in straight pieces. It lasts as long as the faster side of the jump takes for
        the distance `reach`, the body's diameter, also on its surface, but at most half of the time to the next pose. A
        jump at time 0 is followed by its ramp, in which the body catches up, at up to 4/3 of its speed; others are in
        the middle of theirs.
        """
        start = np.append(0.0, self.times[self.times > 0.0])
        times = start if self.times[0] < 0.0 else self.times
        positions = np.array([self.at(time) for time in times])
        turns = [self._turned(time) for time in times]
        path = Trajectory(positions, times, np.array([turn.as_quat() for turn in turns]))
        speeds, spins = (np.concatenate([np.zeros((1, 3)), rates]) for rates in path.rates)
        fast = np.linalg.norm(speeds, axis=1) + 0.5 * reach * np.linalg.norm(spins, axis=1)
        room = np.concatenate([[2.0 * times[0]], np.diff(times), [np.inf]]) / 2.0
        keys = [np.column_stack([times, positions, path.rotations])]
        for k, (time, place, turn) in enumerate(zip(times, positions, turns, strict=True)):
            if (speeds[k] == speeds[k + 1]).all() and np.allclose(spins[k], spins[k + 1], 1e-9, 1e-9 * fast[k] / reach):
                continue
            fastest = fast[k : k + 2].max()
            after = min(0.5 * reach / fastest, room[k], room[k + 1])
            before = after
            if time == 0.0:
                before, after = 0.0, min(reach / fastest, room[k + 1])
            s = np.linspace(0.0, 1.0, _PIECES + 1)[:, None]
            span = before + after
            first, last = place - before * speeds[k], place + after * speeds[k + 1]
            begin, end = (Rotation.from_rotvec(angle) * turn for angle in (-before * spins[k], after * spins[k + 1]))
            whole = (end * begin.inv()).as_rotvec()
            curve = first + _ramp(s, last - first, span * speeds[k], span * speeds[k + 1])
            turned = Rotation.from_rotvec(_ramp(s, whole, span * spins[k], span * spins[k + 1])) * begin
            keys[0] = keys[0][keys[0][:, 0] != time]
            keys.append(np.column_stack([time - before + span * s, curve, turned.as_quat()]))
        table = np.concatenate(keys)
        table = table[np.argsort(table[:, 0], kind="stable")]
        # Ramps that touch share a time, up to rounding.
        gaps = np.diff(table[:, 0])
        table = table[np.append(True, gaps > 1e-9 * gaps.max(initial=0.0))]
        return Trajectory(table[:, 1:4], table[:, 0], table[:, 4:])


def _ramp(s: np.ndarray, whole: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Returns the cubic from 0 to `whole`, with the derivatives `before` and `after` at its ends, at s in 0 to 1."""
    return s**2 * (3 - 2 * s) * whole + s * (1 - s) ** 2 * before - s**2 * (1 - s) * after


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

    def speeds(self) -> np.ndarray:
        """Returns the largest speed of the surface after each time of the path, float64 [K], cells per step."""
        velocity, spin = self.path.rates
        return np.linalg.norm(velocity, axis=1) + self.radius * np.linalg.norm(spin, axis=1)

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the lowest and highest coordinates (3,) of the obstacle relative to its origin, at any time."""
        return np.full(3, -self.radius), np.full(3, self.radius)

    def form(self, device: str) -> lattice_bodies.Form:
        """Returns the form of the obstacle for kernels on a device."""
        return lattice_bodies.make_form(self.radius, 1.0, 0.0, self.path.moves)


@dataclass(frozen=True, eq=False)
class Mesh:
    """An obstacle bounded by a mesh.

    It is solid by its winding number, so that small holes do not matter, and within the shell of its surface, so that
    a surface that is open or thin stops the air. A cell whose centre is exactly on the surface may count as inside or
    outside.

    Attributes:
        path: Path of the mesh's origin.
        vertices: float32 [V, 3], corners relative to the mesh's origin, in the mesh's own unit.
        triangles: int32 [T, 3], indices of each triangle's corners, anticlockwise seen from outside.
        scale: Cells per unit of the mesh.
        shell: Distance from the surface in cells within which a cell is solid, too; of at least `SHELL` no air passes.
    """

    path: Trajectory
    vertices: np.ndarray
    triangles: np.ndarray
    scale: float = 1.0
    shell: float = 0.0
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
        if not 0.0 <= self.shell < np.inf:
            raise ValueError(f"shell: expected a distance of at least 0, got {self.shell}")

    @functools.cached_property
    def extent(self) -> np.ndarray:
        """Largest distances from the origin along the mesh's axes, in its unit, (3,)."""
        return np.abs(np.asarray(self.vertices, np.float64)).max(0)

    def speeds(self) -> np.ndarray:
        """As for `Sphere`."""
        fastest = np.linalg.norm(self.path.rates[0], axis=1)
        if self.path.turns:
            corners = self.scale * np.asarray(self.vertices, np.float64)
            for k, spin in enumerate(self.path.rates[1]):
                # The angular velocity in the mesh's own frame; the distances from its axis do not change.
                own = Rotation.from_quat(self.path.rotations[k]).inv().apply(spin)
                fastest[k] += np.linalg.norm(np.cross(own, corners), axis=1).max()
        return fastest

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """As for `Sphere`."""
        corners = self.scale * np.asarray(self.vertices, np.float64)
        if self.path.turns:
            corners = np.linalg.norm(corners, axis=1).max() * np.array([[-1.0] * 3, [1.0] * 3])
        else:
            corners = corners @ self.path.turn(0.0).T
        return corners.min(axis=0) - self.shell, corners.max(axis=0) + self.shell

    def on(self, device: str) -> wp.Mesh:
        """Returns the mesh on a device, in its own unit, for `wlm_kernels.fluid.mesh_inside`."""
        if device not in self._meshes:
            points = wp.array(np.asarray(self.vertices, np.float32), dtype=wp.vec3, device=device)
            indices = wp.array(np.asarray(self.triangles, np.int32).ravel(), dtype=int, device=device)
            self._meshes[device] = wp.Mesh(points, indices, support_winding_number=True)
        return self._meshes[device]

    def form(self, device: str) -> lattice_bodies.Form:
        """As for `Sphere`."""
        return lattice_bodies.make_form(self.on(device), self.scale, self.shell, self.path.moves)


Obstacle = Sphere | Mesh
"""An obstacle, in cells and steps of the lattice."""


class Bodies:
    """Obstacles on the device of a lattice, with numbers from 1 on.

    Args:
        obstacles: At most 255 obstacles.
        shape: Cells along x, y and z.
        device: The device.

    Attributes:
        motion: The motion of the obstacles in a step, set by `cover` and `move`.
        moving: The windows of those that move.
    """

    def __init__(self, obstacles: Sequence[Obstacle], shape: tuple[int, int, int], device: wp.Device) -> None:
        # The obstacles own the meshes to which the kernels' forms refer.
        self._obstacles, self._shape = tuple(obstacles), shape
        paths = [obstacle.path for obstacle in obstacles]
        self.motion, self._keys = lattice_bodies.make_motion(device), lattice_bodies.Keys()
        columns = {
            "first": (np.cumsum([0, *(len(path.times) for path in paths)], dtype=np.int32), int),
            "time": (np.concatenate([path.times for path in paths]), wp.float64),
            "position": (np.concatenate([path.positions for path in paths]), wp.vec3d),
            "turn": (np.concatenate([path.rotations for path in paths]), wp.quatd),
            "velocity": (np.concatenate([path.rates[0] for path in paths]), wp.vec3d),
            "spin": (np.concatenate([path.rates[1] for path in paths]), wp.vec3d),
        }
        for name, (values, dtype) in columns.items():
            setattr(self._keys, name, wp.array(values, dtype=dtype, device=device))
        flags = np.zeros(256, np.uint8)
        flags[1 : len(paths) + 1] = [path.moves for path in paths]
        self.motion.moving.assign(flags)
        windows = [lattice_bodies.make_window(shape, k + 1, *each.box()) for k, each in enumerate(obstacles)]
        self._forms = [each.form(str(device)) for each in obstacles]
        self._windows, self.moving = windows, [window for window in windows if flags[window.body]]
        # Begin and end of each piece of a moving path, and the largest speed in it.
        moves = [each for each in obstacles if each.path.moves]
        self._ends = np.concatenate(
            [np.zeros((2, 0)), *([each.path.times[:-1], each.path.times[1:]] for each in moves)], axis=1
        )
        self._speeds = np.concatenate([np.zeros(0), *(each.speeds()[:-1] for each in moves)])

    def cover(self, clock: wp.array, pace: float) -> wp.array:
        """Sets `motion` as `move`, and returns the marks of all cells, uint8 [X Y Z]."""
        lattice_bodies.set_poses(self._keys, clock, pace, self.motion)
        solid = wp.zeros(math.prod(self._shape), dtype=wp.uint8, device=clock.device)
        self._mark(self._windows, solid, wp.empty(0, dtype=wp.uint8, device=clock.device), 1)
        return solid

    def move(self, clock: wp.array, pace: float, solid: wp.array, fresh: wp.array, stamp: int) -> None:
        """Sets `motion` to that in the middle of the next step, and the marks of the obstacles that move accordingly.
        Arguments: see `lattice_bodies.set_poses` and `lattice_bodies.mark`."""
        lattice_bodies.set_poses(self._keys, clock, pace, self.motion)
        self._mark(self.moving, solid, fresh, stamp)

    def _mark(self, windows: Sequence, solid: wp.array, fresh: wp.array, stamp: int) -> None:
        for window in windows:
            lattice_bodies.mark(window, self.motion, self._forms[window.body - 1], stamp, solid, fresh)

    def fastest(self, begin: float, end: float) -> float:
        """Returns the largest speed between two times of the paths, in their unit."""
        within = (self._ends[0] < end) & (self._ends[1] > begin)
        return float(self._speeds[within].max(initial=0.0))


def cells_of(obstacles: Sequence[Obstacle], shape: tuple[int, int, int], device: str = "cpu") -> wp.array:
    """Returns the number of the obstacle that covers the centre of each cell at time 0, uint8 [X, Y, Z], 0 for none."""
    clock = wp.zeros(2, dtype=int, device=device)
    return Bodies(obstacles, shape, clock.device).cover(clock, 0.0).reshape(shape)


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
