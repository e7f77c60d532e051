"""Viewers who stand in a scene: points above walkable floor from which something is seen all around.

A floor is a triangle that faces up, at most 45 degrees steep. A viewer stands on it where

- there is nothing within the height of their eyes above the floor;
- of directions spread evenly over the sphere at least half end on a triangle: between the walls of a room or of a
  street, not on the roof or beside a thing;
- three quarters of those end on a triangle's front: not in a wall or in a solid thing;
- and none within a fifth of the height of their eyes.

A room whose fronts are outside can't be told from a thing, and nobody stands in it.

Eyes are 1 m above the floor; 0.35 of the scene's height where that is less, where the unit isn't known, or where the
scene is higher than 200 m, which says that its unit isn't the metre.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from wlm.interop import check_device
from wlm.ops.views import Viewpoint
from wlm_kernels.raster.rays import first_hit

EYES, EYES_SHARE = 1.0, 0.35
"""Metres above the floor; or this share of the scene's height."""

_TALLEST = 200.0  # metres
_STEEPEST = math.sqrt(0.5)  # of a floor: the least y of its normal
_CANDIDATES, _RAYS = 1024, 96
_FEWEST = 16  # places among the candidates: fewer are a crack in a thing
_ENCLOSED, _FRONTS, _NEAREST = 0.5, 0.75, 0.2
_PITCH = 0.6  # the largest |y| of the directions that viewers look in
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class Indoors:
    """Where viewers may stand.

    Attributes:
        eye: float64 [P, 3], their eyes, in random order; empty where nobody can stand.
        height: Of the eyes above the floor, in the scene's unit.
    """

    eye: np.ndarray
    height: float

    def views(self, count: int, seed: int = 0) -> list[Viewpoint]:
        """Makes views from the places in turn, their directions spread evenly round the horizon and a little up and
        down; none where nobody can stand.

        Args:
            count: Number of views.
            seed: Turns all directions, and begins at another place.
        """
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
    """Finds where viewers can stand in a scene, the same in every run.

    Args:
        position: float [V, 3], y up.
        triangle: int [F, 3], at least one.
        metres: Whether the unit is known to be the metre.
        device: "cpu" or "cuda:N".

    Raises:
        WlmError: There is no such device.
    """
    device = check_device(device)
    corner = np.asarray(position, np.float64)[triangle]
    low, high = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
    tall = float(high[1] - low[1])
    known = metres and tall <= _TALLEST
    height = min(EYES, EYES_SHARE * tall) if known else EYES_SHARE * tall
    none = Indoors(np.empty((0, 3)), height)
    if not height > 0.0:
        return none
    # Scaled to a size of 1: float32 and rays have no range to speak of.
    scale = 1.0 / float((high - low).max())
    scaled = (corner - low) * scale
    points = wp.array(scaled.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    mesh = wp.Mesh(points, wp.array(np.arange(3 * len(corner), dtype=np.int32), dtype=int, device=device))
    normal = np.cross(scaled[:, 1] - scaled[:, 0], scaled[:, 2] - scaled[:, 0])
    eye = _standing(mesh, scaled, normal, height * scale, device)
    return Indoors(eye / scale + low, height) if len(eye) >= _FEWEST else none


def _standing(mesh: wp.Mesh, corner: np.ndarray, normal: np.ndarray, height: float, device: str) -> np.ndarray:
    """Eyes above the floors by the module's rules, float64 [P, 3]."""
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
    # Headroom: down from the eyes the floor is the first thing, and what is met going up is above them.
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
