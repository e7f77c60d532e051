"""Views of a mesh from all around, and what each of their pixels sees (lightmap-uv-clustering-cascade, section 4.1.4).

The mesh is brought into [-1, 1]³: the longest side of its box is 2 long, the box's centre is the origin. Cameras are at
a distance of 3 and look at the origin. Their field of view just holds the sphere around that cube, of radius sqrt 3:
2 asin(sqrt 3 / 3), 70.5 degrees both ways, so that nothing is ever cut off. Pictures are square; row 0 is their top.

A triangle that isn't ``active`` hides what is behind it, but a pixel that sees one counts as one that sees nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.atlas.data import LightmappedMesh
from wlm.interop import check_device
from wlm.ops import raster as ops_raster

__all__ = [
    "View",
    "clip_positions",
    "normalised",
    "sphere_views",
    "surface_points",
    "texel_triangles",
    "visibility",
    "visible_uv",
]

DISTANCE = 3.0
_SPHERE = math.sqrt(3.0)
# Clip x is this times the distance from the axis; w is the distance along it.
_ZOOM = math.sqrt(DISTANCE**2 - _SPHERE**2) / _SPHERE
_NEAR, _FAR = DISTANCE - _SPHERE, DISTANCE + _SPHERE
# Past this share of y in the direction, 26 degrees from a pole, the picture's up is z instead of y.
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

    @staticmethod
    def of(direction: Sequence[float] | np.ndarray) -> View:
        """Makes the camera that is in a direction from the origin.

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
        return View(np.stack([right, np.cross(back, right), back]))

    @property
    def eye(self) -> np.ndarray:
        """Where the camera is, float64 [3]."""
        return DISTANCE * self.axes[2]


def sphere_views(count: int, seed: int | np.random.Generator | None = None) -> list[View]:
    """Gives cameras on the sphere.

    Args:
        count: How many, at least 0.
        seed: None spreads them evenly (a Fibonacci sphere); else they are random and independent, each direction as
            likely. A generator goes on where it was.

    Raises:
        ValueError: A negative count.
    """
    if count < 0:
        raise ValueError(f"count: expected at least 0, got {count}")
    if seed is None:
        number = np.arange(count)
        y = 1.0 - (2.0 * number + 1.0) / max(count, 1)
        turn = number * _GOLDEN_ANGLE
    else:
        random = np.random.default_rng(seed)
        y = random.uniform(-1.0, 1.0, count)
        turn = random.uniform(0.0, 2.0 * math.pi, count)
    # Bands of equal height have equal areas on a sphere.
    radius = np.sqrt(1.0 - y * y)
    return [View.of(each) for each in np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], axis=-1)]


def normalised(mesh: LightmappedMesh) -> np.ndarray:
    """The positions in [-1, 1]³, float64 [V, 3]; the box is that of all triangles."""
    used = mesh.position[mesh.triangle.reshape(-1)]
    low, high = used.min(axis=0), used.max(axis=0)
    return (mesh.position - (low + high) / 2.0) * (2.0 / (high - low).max())


def clip_positions(mesh: LightmappedMesh, view: View) -> np.ndarray:
    """The vertices as a camera sees them, for ``wlm.ops.raster.rasterize``.

    Args:
        mesh: The mesh.
        view: The camera.

    Returns:
        float32 [V, 4]: x, y, z, w; w is the distance along the camera's axis, z / w is -1 and 1 where the sphere
        around the cube is nearest and farthest. Vertices at one place get equal numbers.
    """
    return _project(normalised(mesh), view)


def _project(position: np.ndarray, view: View) -> np.ndarray:
    # Sums by hand: a matrix product may round rows differently, and shared edges would come apart.
    x, y, back = (position[:, 0] * a + position[:, 1] * b + position[:, 2] * c for a, b, c in view.axes)
    w = DISTANCE - back
    z = ((_FAR + _NEAR) * w - 2.0 * _FAR * _NEAR) / (_FAR - _NEAR)
    return np.stack([_ZOOM * x, _ZOOM * y, z, w], axis=1).astype(np.float32)


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
        For each camera, on the device: int32 [h, w], the triangle that is seen, -1 for none; float32 [h, w, 2], the
        weights of its corners 0 and 1, corner 2 has the rest; float32 [h, w, 2], the mesh's own UVs there. The latter
        two are 0 where nothing is seen.

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
                torch.tensor(_project(position, view), device=device), triangle, resolution, resolution
            )
            seen, barycentric = raster.triangle, raster.barycentric
            at = ops_raster.interpolate(uv, triangle, raster)
            if not mesh.active.all():
                shown = (seen >= 0) & active[seen.clamp(min=0).long()]
                seen = torch.where(shown, seen, -1)
                barycentric, at = barycentric * shown[..., None], at * shown[..., None]
        yield seen, barycentric, at


def visibility(
    mesh: LightmappedMesh, views: Sequence[View], resolution: int, height: int, width: int, device: str
) -> np.ndarray:
    """Counts how much each part of UV space is seen.

    Args:
        mesh: The mesh.
        views: The cameras.
        resolution: Pixels along a side of their pictures.
        height, width: Of a grid over UV space, row 0 at v = 0. It may be finer than the lightmap.
        device: "cpu" or "cuda:N".

    Returns:
        float64 [height, width], the pixels of all views whose UVs lie in each cell; a UV of 1 is in the last one.

    Raises:
        WlmError: There is no such device.
        ValueError: A size is out of range.
    """
    if height < 1 or width < 1:
        raise ValueError(f"height, width: expected at least 1, got {height} and {width}")
    count = torch.zeros(height * width, dtype=torch.int64, device=check_device(device))
    for seen, _, uv in visible_uv(mesh, views, resolution, device):
        at = uv[seen >= 0].double()
        column = (at[:, 0] * width).long().clamp(0, width - 1)
        row = (at[:, 1] * height).long().clamp(0, height - 1)
        count += torch.bincount(row * width + column, minlength=height * width)
    return count.reshape(height, width).double().cpu().numpy()


def texel_triangles(mesh: LightmappedMesh, height: int, width: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Which active triangle holds the centre of each cell of a grid over UV space.

    Args:
        mesh: The mesh.
        height, width: Of the grid, row 0 at v = 0.
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
    """Random points of the active triangles, each place of the surface as likely.

    Args:
        mesh: The mesh.
        count: How many, N.
        random: Where they come from.

    Returns:
        int64 [N], their triangles; float64 [N, 3], the weights of the corners.
    """
    corner = mesh.position[mesh.triangle]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) * mesh.active
    ends = np.cumsum(area)
    triangle = np.searchsorted(ends, random.random(count) * ends[-1], side="right").clip(max=len(ends) - 1)
    root, share = np.sqrt(random.random(count)), random.random(count)
    return triangle, np.stack([1.0 - root, root * (1.0 - share), root * share], 1)
