"""Views of a mesh from all around, and the surface point at each pixel (lightmap-uv-clustering-cascade, section 4.1.4).

The mesh is scaled into [-1, 1]³: the longest side of its box is 2 long, the box's centre is the origin. Cameras are at
a distance of 3 and look at the origin. Their field of view just holds the sphere around that cube, of radius sqrt 3:
2 asin(sqrt 3 / 3), 70.5 degrees both ways, so that nothing is ever cut off. Pictures are square; row 0 is their top.

A triangle that isn't `active` hides what is behind it, but its pixels count as uncovered.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from wlm.atlas.data import LightmappedMesh
from wlm.interop import check_device
from wlm.ops import raster as ops_raster

DISTANCE = 3.0
"""Distance of a camera from the origin."""

_SPHERE = math.sqrt(3.0)

ZOOM = math.sqrt(DISTANCE**2 - _SPHERE**2) / _SPHERE
"""Clip x over the distance from the camera's axis; w is the distance along it."""

_NEAR, _FAR = DISTANCE - _SPHERE, DISTANCE + _SPHERE
# Where y in the direction is larger, within 26 degrees of a pole, the picture's up is z instead of y.
_STEEP = 0.9
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class View:
    """A camera.

    Attributes:
        axes: float64 [3, 3], rows of unit length at right angles: the picture's right and up, and the direction from
            the origin to the camera.
    """

    axes: np.ndarray

    @classmethod
    def of(cls, direction: Sequence[float] | np.ndarray) -> Self:
        """Makes the camera in a direction from the origin.

        Args:
            direction: [3], of any length but 0. The picture's up is +y, or +z where the direction is near y's axis.

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


def sphere_views(count: int, seed: int | np.random.Generator | None = None) -> list[View]:
    """Makes cameras on the sphere.

    Args:
        count: Number of cameras, at least 0.
        seed: None spreads them evenly (a Fibonacci sphere); else they are random, independent and uniform. A generator
            goes on where it was.

    Raises:
        ValueError: A negative count.
    """
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


def normalised(mesh: LightmappedMesh) -> np.ndarray:
    """The positions scaled into [-1, 1]³, float64 [V, 3]; the box is that of all triangles."""
    used = mesh.position[mesh.triangle.reshape(-1)]
    low, high = used.min(axis=0), used.max(axis=0)
    return (mesh.position - (low + high) / 2.0) * (2.0 / (high - low).max())


def clip_positions(position: np.ndarray, view: View) -> np.ndarray:
    """The vertices in a camera's clip space, for `wlm.ops.rasterize`.

    Args:
        position: float64 [V, 3], `normalised`.
        view: The camera.

    Returns:
        float32 [V, 4]: x, y, z, w; w is the distance along the camera's axis, z / w is -1 and 1 where the sphere
        around the cube is nearest and farthest. Vertices at one place have equal numbers.
    """
    # Written out: a matrix product may round rows differently, and shared edges would come apart.
    x, y, back = (position[:, 0] * a + position[:, 1] * b + position[:, 2] * c for a, b, c in view.axes)
    w = DISTANCE - back
    z = ((_FAR + _NEAR) * w - 2.0 * _FAR * _NEAR) / (_FAR - _NEAR)
    return np.stack([ZOOM * x, ZOOM * y, z, w], axis=1).astype(np.float32)


def visible_uv(
    mesh: LightmappedMesh, views: Sequence[View], resolution: int, device: str
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Draws the mesh from each camera.

    Args:
        mesh: The mesh.
        views: The cameras.
        resolution: Pixels along a side, 1 to 16,384.
        device: "cpu" or "cuda:N".

    Yields:
        For each camera, on the device: int32 [h, w], the visible triangle, -1 for none; float32 [h, w, 2], the weights
        of its corners 0 and 1, corner 2 has the rest; float32 [h, w, 2], the mesh's own UVs there. The latter two are
        0 in uncovered pixels.

    Raises:
        WlmError: There is no such device.
        ValueError: The resolution is out of range.
    """
    device = check_device(device)
    position = normalised(mesh)
    triangle = torch.tensor(mesh.triangle, device=device)
    uv = torch.tensor(mesh.uv, dtype=torch.float32, device=device)
    active = torch.tensor(mesh.active, device=device)
    for view in views:
        with torch.no_grad():
            raster = ops_raster.rasterize(
                torch.tensor(clip_positions(position, view), device=device), triangle, resolution, resolution
            )
            visible, barycentric = raster.triangle, raster.barycentric
            pixel_uv = ops_raster.interpolate(uv, triangle, raster)
            if not mesh.active.all():
                covered = (visible >= 0) & active[visible.clamp(min=0).long()]
                visible = torch.where(covered, visible, -1)
                barycentric, pixel_uv = barycentric * covered[..., None], pixel_uv * covered[..., None]
        yield visible, barycentric, pixel_uv


def corner_weights(barycentric: torch.Tensor) -> torch.Tensor:
    """The weights of all three corners, float32 [N, 3], from those of corners 0 and 1, [N, 2]."""
    return torch.cat([barycentric, 1.0 - barycentric.sum(1, keepdim=True)], dim=1)


def visibility(
    mesh: LightmappedMesh, views: Sequence[View], resolution: int, height: int, width: int, device: str
) -> np.ndarray:
    """Counts the pixels that show each part of UV space.

    Args:
        mesh: The mesh.
        views: The cameras.
        resolution: Pixels along a side of their pictures.
        height, width: Size of a grid over UV space, row 0 at v = 0. It may be finer than the lightmap.
        device: "cpu" or "cuda:N".

    Returns:
        float64 [height, width], pixels of all views whose UVs lie in each cell; a UV of 1 lies in the last one.

    Raises:
        WlmError: There is no such device.
        ValueError: A size is out of range.
    """
    if height < 1 or width < 1:
        raise ValueError(f"height, width: expected at least 1, got {height} and {width}")
    count = torch.zeros(height * width, dtype=torch.int64, device=check_device(device))
    for visible, _, uv in visible_uv(mesh, views, resolution, device):
        u, v = uv[visible >= 0].double().T
        column = (u * width).long().clamp(0, width - 1)
        row = (v * height).long().clamp(0, height - 1)
        count += torch.bincount(row * width + column, minlength=height * width)
    return count.reshape(height, width).double().cpu().numpy()


def texel_triangles(mesh: LightmappedMesh, height: int, width: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Finds the active triangle that holds the centre of each cell of a grid over UV space.

    Args:
        mesh: The mesh.
        height, width: Size of the grid, row 0 at v = 0.
        device: "cpu" or "cuda:N".

    Returns:
        On the device: int64 [height, width], the triangle, the first of several, -1 for none; float32 [height, width,
        2], the weights of its corners 0 and 1.
    """
    active = torch.tensor(np.flatnonzero(mesh.active), device=device)
    raster = ops_raster.rasterize_uv(
        torch.tensor(mesh.uv, dtype=torch.float32, device=device),
        torch.tensor(mesh.triangle, device=device)[active],
        height,
        width,
    )
    return torch.where(raster.triangle >= 0, active[raster.triangle.clamp(min=0).long()], -1), raster.barycentric


def surface_points(mesh: LightmappedMesh, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draws random points of the active triangles, uniform over the surface.

    Args:
        mesh: The mesh.
        count: Number of points, N.
        random: The generator.

    Returns:
        int64 [N], their triangles; float64 [N, 3], the weights of the corners.
    """
    corner = mesh.position[mesh.triangle]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) * mesh.active
    ends = np.cumsum(area)
    triangle = np.searchsorted(ends, random.random(count) * ends[-1], side="right").clip(max=len(ends) - 1)
    root, share = np.sqrt(random.random(count)), random.random(count)
    return triangle, np.stack([1.0 - root, root * (1.0 - share), root * share], 1)
