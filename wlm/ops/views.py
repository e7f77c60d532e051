"""Views of a mesh from cameras on a sphere around it, and the visible surface point of each pixel.

The mesh is scaled into [-1, 1]³: the longest side of its box is 2 long, the box's centre is the origin. Cameras are at
a distance of 3 and look at the origin (lightmap-uv-clustering-cascade, section 4.1.4). Their field of view is
the smallest that contains the cube's circumscribed sphere of radius sqrt 3: 2 asin(sqrt 3 / 3), 70.5 degrees in both
directions, so that nothing is cut off. Images are square; row 0 is the top row.

A `Viewpoint` is a camera inside the scene instead.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
import warp as wp

from wlm.interop import StepGraph, check_device, to_warp, torch_memory
from wlm.ops.tensors import check_index
from wlm_kernels.raster import gradient, rasterize
from wlm_kernels.raster.rasterize import MOST_PIXELS

DISTANCE = 3.0
"""Distance of a camera from the origin."""

_SPHERE = math.sqrt(3.0)

ZOOM = math.sqrt(DISTANCE**2 - _SPHERE**2) / _SPHERE
"""Clip x of a point over its distance to the right of the camera's axis, in units of the scaled mesh; likewise clip y
and the distance upwards. Clip w is the distance along the axis."""

_NEAR, _FAR = DISTANCE - _SPHERE, DISTANCE + _SPHERE
# If y of the direction is larger (within 26 degrees of a pole), the image's up axis is z instead of y.
_STEEP = 0.9
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class View:
    """A camera outside the mesh.

    Attributes:
        axes: float64 [3, 3], orthonormal rows: the image's right and up, and the direction from
            the origin to the camera.
    """

    axes: np.ndarray

    @classmethod
    def of(cls, direction: Sequence[float] | np.ndarray) -> Self:
        """Creates the camera in a direction from the origin.

        Args:
            direction: [3], of any length except 0. The image's up axis is +y, or +z for directions near the y axis.

        Raises:
            ValueError: The direction has no length or isn't finite.
        """
        back = np.asarray(direction, np.float64)
        if back.shape != (3,) or not np.isfinite(back).all() or not back.any():
            raise ValueError(f"direction: expected three finite numbers, not all 0, got {direction}")
        back = back / np.abs(back).max()
        back = back / np.linalg.norm(back)
        right = np.cross([0.0, 1.0, 0.0] if abs(back[1]) <= _STEEP else [0.0, 0.0, 1.0], back)
        right = right / np.linalg.norm(right)
        return cls(np.stack([right, np.cross(back, right), back]))


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera inside the scene with a field of view of 90 degrees in both directions: its position, float64 [3], in
    the mesh's space and unit, and its direction, float64 [3], not straight up or down."""

    eye: np.ndarray
    forward: np.ndarray


def sphere_views(count: int, seed: int | np.random.Generator | None = None) -> list[View]:
    """Creates cameras on the sphere: spread evenly without a seed (a Fibonacci sphere), otherwise random, independent
    and uniform; a generator continues from its current state."""
    if count < 0:
        raise ValueError(f"count: expected at least 0, got {count}")
    if seed is None:
        number = np.arange(count)
        y = 1.0 - (2.0 * number + 1.0) / max(count, 1)
        azimuth = number * _GOLDEN_ANGLE
    else:
        random = np.random.default_rng(seed)
        y = random.uniform(-1.0, 1.0, count)
        azimuth = random.uniform(0.0, 2.0 * math.pi, count)
    # Bands of equal height have equal areas on a sphere.
    radius = np.sqrt(1.0 - y * y)
    return [View.of(each) for each in np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=-1)]


def normalised(position: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Scales a mesh, float [V, 3] and triangles int [F, 3], whose bounding box must not be empty, into [-1, 1]³;
    returns the positions, float64 [V, 3]."""
    used = position[triangle.reshape(-1)].astype(np.float64)
    low, high = used.min(axis=0), used.max(axis=0)
    return (position - (low + high) / 2.0) * (2.0 / (high - low).max())


def clip_positions(position: np.ndarray, view: View) -> np.ndarray:
    """Transforms vertices, float64 [V, 3] and `normalised`, into a camera's clip space, float32 [V, 4], for
    `wlm.ops.rasterize`.

    w is the distance along the camera's axis, z / w is -1 and 1 where the sphere around the cube is nearest and
    farthest. Vertices at equal positions have equal results.
    """
    # A matrix product may round rows differently, which would open cracks along shared edges.
    x, y, back = (position[:, 0] * a + position[:, 1] * b + position[:, 2] * c for a, b, c in view.axes)
    w = DISTANCE - back
    z = ((_FAR + _NEAR) * w - 2.0 * _FAR * _NEAR) / (_FAR - _NEAR)
    return np.stack([ZOOM * x, ZOOM * y, z, w], axis=1).astype(np.float32)


def clip_from(position: np.ndarray, eye: np.ndarray, forward: np.ndarray, up: int = 1) -> np.ndarray:
    """Transforms vertices [V, 3], in any unit, into the clip space of a camera inside the scene, 90 degrees wide and
    high.

    `eye` is its position, `forward` its direction, of any length except 0 and not along `up`, the axis that points up,
    0 to 2. Returns float32 [V, 4], x, y, z, w, as `clip_positions`; z / w rises from -infinity at the eye to 1 far
    away.
    """
    forward = np.asarray(forward, np.float64) / np.linalg.norm(forward)
    right = np.cross(forward, np.eye(3)[up])
    right /= np.linalg.norm(right)
    offset = np.asarray(position, np.float64) - eye
    # No matrix product, for the same reason as in `clip_positions`.
    x, y, w = (
        offset[:, 0] * a + offset[:, 1] * b + offset[:, 2] * c for a, b, c in (right, np.cross(right, forward), forward)
    )
    near = 1e-3 * float(np.abs(offset).max(initial=0.0))
    return np.stack([x, y, w - 2.0 * near, w], axis=1).astype(np.float32)


def visible_points(
    position: np.ndarray,
    triangle: np.ndarray,
    uv: np.ndarray,
    views: Sequence[View | Viewpoint],
    resolution: int,
    device: str,
    *,
    cull: bool = False,
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Draws a mesh from each camera, square pictures of `resolution` pixels along a side; positions, float [V, 3] in
    any unit, are scaled here.

    With `cull`, back faces are skipped, so that an interior is visible through its walls. Yields for each camera, on
    the device: int32 [h, w], the visible triangle, -1 for none; float32 [h, w, 2], the weights of its corners 0 and 1;
    float32 [h, w, 2], the UVs at the visible point. The latter two are 0 in uncovered pixels.
    """
    device = check_device(device)
    if not 1 <= resolution <= MOST_PIXELS:
        raise ValueError(f"resolution: expected 1 to {MOST_PIXELS}, got {resolution}")
    scaled = normalised(position, triangle)
    draw = _Drawing(triangle, uv, resolution, cull, device)
    for view in views:
        inside = isinstance(view, Viewpoint)
        yield draw(clip_from(position, view.eye, view.forward) if inside else clip_positions(scaled, view))


class _Drawing:
    """Draws a mesh repeatedly; checks and allocations happen once, and on CUDA each draw replays a CUDA graph."""

    def __init__(self, triangle: np.ndarray, uv: np.ndarray, resolution: int, cull: bool, device: str) -> None:
        corner = torch.tensor(triangle.astype(np.int32), device=device)
        check_index("triangle", corner, len(uv), (None, 3), corner.device)
        coordinate = torch.tensor(uv, dtype=torch.float32, device=device)
        self._clip = torch.empty((len(uv), 4), dtype=torch.float32, device=device)
        self._seen = torch.empty((resolution, resolution, 2), dtype=torch.float32, device=device)
        empty = torch_memory(corner.device)
        self._rasterizer = rasterize.Rasterizer(to_warp(corner), resolution, resolution, cull=cull, empty=empty)
        self._arrays = to_warp(self._clip), to_warp(coordinate), to_warp(corner), to_warp(self._seen)
        raster = self._rasterizer.raster
        self._pictures = wp.to_torch(raster.triangle), wp.to_torch(raster.barycentric), self._seen
        self._step = StepGraph(self._draw, device)

    def __call__(self, clip: np.ndarray) -> tuple[torch.Tensor, ...]:
        self._clip.copy_(torch.from_numpy(clip))
        self._step()
        return tuple(picture.clone() for picture in self._pictures)

    def _draw(self) -> None:
        clip, coordinate, corner, seen = self._arrays
        raster = self._rasterizer.run(clip)
        gradient.interpolate(coordinate, corner, raster.triangle, raster.barycentric, seen)
