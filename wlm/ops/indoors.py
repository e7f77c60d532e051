"""Eye positions inside a scene: points above walkable floor that are surrounded by geometry.

A floor is a triangle that faces up, at most 45 degrees steep. A point at eye height above it is valid if

- no triangle lies between the floor and the eye;
- at least half of the rays in evenly spread directions hit a triangle, which excludes roofs and points beside an
  object but not rooms and streets;
- three quarters of these rays hit a triangle's front, which excludes points inside walls and solid objects;
- and no ray hits a triangle within a fifth of the eye height.

A room whose triangles face outwards looks like a solid object and gets no viewpoints.

The eye height is 1 m, or 0.35 of the scene's height if that is less, if the unit isn't known, or if the scene is higher
than 200 m, which suggests that its unit isn't the metre.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from wlm.interop import check_device
from wlm.ops.views import Viewpoint
from wlm_kernels.raster.rays import first_hit

EYES, EYES_SHARE = 1.0, 0.35
"""Eye height in metres above the floor, and as a share of the scene's height."""

_TALLEST = 200.0  # metres
_STEEPEST = math.sqrt(0.5)  # smallest y of a floor's unit normal
_CANDIDATES, _RAYS = 1024, 96
_FEWEST = 16  # minimum number of valid candidates: fewer suggest a gap inside an object
_ENCLOSED, _FRONTS, _NEAREST = 0.5, 0.75, 0.2
_PITCH = 0.6  # the largest |y| of the viewing directions
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class Indoors:
    """Valid eye positions inside a scene, float64 [P, 3], in random order, maybe none, and their height above the
    floor, in the scene's unit."""

    eye: np.ndarray
    height: float

    def views(self, count: int, seed: int = 0) -> list[Viewpoint]:
        """Creates `count` views from the eye positions in turn, with directions spread evenly around the horizon and
        slightly up and down; none if there is no eye position. `seed` selects a rotation of all directions and the
        first eye position."""
        if not len(self.eye):
            return []
        turn, start = np.random.default_rng((seed, 1)).random(2)
        first = int(start * len(self.eye))
        number = np.arange(count)
        y = _PITCH * (2.0 * ((number * 0.5 * (math.sqrt(5.0) - 1.0) + turn) % 1.0) - 1.0)
        azimuth = 2.0 * math.pi * turn + number * _GOLDEN_ANGLE
        radius = np.sqrt(1.0 - y * y)
        forward = np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=-1)
        return [Viewpoint(self.eye[(first + i) % len(self.eye)], forward[i]) for i in range(count)]


def indoors(position: np.ndarray, triangle: np.ndarray, *, metres: bool, device: str = "cpu") -> Indoors:
    """Finds the valid eye positions in a scene of positions float [V, 3], y up, and at least one triangle, int [F, 3].
    The result is the same in every run. `metres` tells whether the unit is known to be the metre."""
    device = check_device(device)
    corner = np.asarray(position, np.float64)[triangle]
    low, high = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
    tall = float(high[1] - low[1])
    known = metres and tall <= _TALLEST
    height = min(EYES, EYES_SHARE * tall) if known else EYES_SHARE * tall
    none = Indoors(np.empty((0, 3)), height)
    if not height > 0.0:
        return none
    # The scene is scaled to a size of 1, because float32 ray casting has limited range and precision.
    scale = 1.0 / float((high - low).max())
    scaled = (corner - low) * scale
    points = wp.array(scaled.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    mesh = wp.Mesh(points, wp.array(np.arange(3 * len(corner), dtype=np.int32), dtype=int, device=device))
    normal = np.cross(scaled[:, 1] - scaled[:, 0], scaled[:, 2] - scaled[:, 0])
    eye = _standing(mesh, scaled, normal, height * scale, device)
    return Indoors(eye / scale + low, height) if len(eye) >= _FEWEST else none


def _standing(mesh: wp.Mesh, corner: np.ndarray, normal: np.ndarray, height: float, device: str) -> np.ndarray:
    """Returns the eye positions that satisfy the module's rules, float64 [P, 3]."""
    area = np.linalg.norm(normal, axis=1)
    ends = np.cumsum(np.where(normal[:, 1] >= _STEEPEST * area, area, 0.0))
    if not ends[-1] > 0.0:
        return np.empty((0, 3))
    random = np.random.default_rng(0)
    floor = np.searchsorted(ends, random.random(_CANDIDATES) * ends[-1], side="right").clip(max=len(ends) - 1)
    root, share = np.sqrt(random.random((_CANDIDATES, 1))), random.random((_CANDIDATES, 1))
    a, b, c = (corner[floor, k] for k in range(3))
    place = (1.0 - root) * a + root * ((1.0 - share) * b + share * c)
    eye = place + [0.0, height, 0.0]
    # Clearance: if the first hit of a ray down from the eye is the floor, no triangle lies between them.
    y = 1.0 - (2.0 * np.arange(_RAYS) + 1.0) / _RAYS
    azimuth, radius = np.arange(_RAYS) * _GOLDEN_ANGLE, np.sqrt(1.0 - y * y)
    ray = np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=1)
    distance, front = _cast(mesh, eye, np.concatenate([ray, [[0.0, -1.0, 0.0]]]), device)
    free = distance[:, -1] >= (1.0 - 1e-3) * height
    distance, front = distance[:, :-1], front[:, :-1]
    hit = front != 0
    enclosed = hit.mean(1) >= _ENCLOSED
    outside = (front == 1).sum(1) >= _FRONTS * hit.sum(1)
    return eye[free & enclosed & outside & (distance.min(1) >= _NEAREST * height)]


def _cast(mesh: wp.Mesh, origin: np.ndarray, direction: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    shape = len(origin), len(direction)
    distance, front = wp.empty(shape, dtype=float, device=device), wp.empty(shape, dtype=wp.int8, device=device)
    rays = (wp.array(each.astype(np.float32), dtype=wp.vec3, device=device) for each in (origin, direction))
    first_hit(mesh, *rays, distance, front)
    return distance.numpy(), front.numpy()
