"""A mesh and its lightmap, seen: the surface point at each pixel of a view, and at each texel.

The cameras are those of `wlm.ops.views`, and viewers who stand in the mesh, `wlm.ops.indoors`. A triangle that isn't
`active` hides what is behind it, but its pixels count as uncovered.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from wlm.atlas.charts import charts, welded
from wlm.atlas.data import LightmappedMesh
from wlm.interop import check_device
from wlm.ops import raster as ops_raster
from wlm.ops.views import View, Viewpoint, sphere_views, visible_points


def mesh_views(mesh: LightmappedMesh, count: int, seed: int | None = None) -> list[View | Viewpoint]:
    """Makes the views of a mesh: cameras around it and, where viewers can stand in it, as many views from inside.

    Args:
        mesh: The mesh.
        count: Number of cameras around it, at least 0.
        seed: None spreads them evenly; else they are random. Views from inside follow it too.
    """
    return [*sphere_views(count, seed), *mesh.indoors.views(count, 0 if seed is None else seed)]


def visible_uv(
    mesh: LightmappedMesh, views: Sequence[View | Viewpoint], resolution: int, device: str
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
    active = torch.tensor(mesh.active, device=check_device(device))
    for visible, barycentric, uv in visible_points(mesh.position, mesh.triangle, mesh.uv, views, resolution, device):
        if not mesh.active.all():
            covered = (visible >= 0) & active[visible.clamp(min=0).long()]
            visible = torch.where(covered, visible, -1)
            barycentric, uv = barycentric * covered[..., None], uv * covered[..., None]
        yield visible, barycentric, uv


def corner_weights(barycentric: torch.Tensor) -> torch.Tensor:
    """The weights of all three corners, float32 [N, 3], from those of corners 0 and 1, [N, 2]."""
    return torch.cat([barycentric, 1.0 - barycentric.sum(1, keepdim=True)], dim=1)


def visibility(
    mesh: LightmappedMesh, views: Sequence[View | Viewpoint], resolution: int, height: int, width: int, device: str
) -> torch.Tensor:
    """Counts the pixels that show each part of UV space.

    Args:
        mesh: The mesh.
        views: The cameras.
        resolution: Pixels along a side of their pictures.
        height, width: Size of a grid over UV space, row 0 at v = 0. It may be finer than the lightmap.
        device: "cpu" or "cuda:N".

    Returns:
        float64 [height, width] on the device, pixels of all views whose UVs lie in each cell; a UV of 1 lies in the
        last one.

    Raises:
        WlmError: There is no such device.
        ValueError: A size is out of range.
    """
    if height < 1 or width < 1:
        raise ValueError(f"height, width: expected at least 1, got {height} and {width}")
    count = torch.zeros(height * width, dtype=torch.int64, device=check_device(device))
    # Pixels without a triangle count as nothing, each in a cell of its own: choosing the others would wait for the GPU.
    own = torch.arange(resolution**2, device=count.device) % count.numel()
    for visible, _, uv in visible_uv(mesh, views, resolution, device):
        u, v = uv.reshape(-1, 2).double().T
        column = (u * width).long().clamp(0, width - 1)
        row = (v * height).long().clamp(0, height - 1)
        seen = visible.reshape(-1) >= 0
        count.index_add_(0, torch.where(seen, row * width + column, own), seen.long())
    return count.reshape(height, width).double()


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


def mesh_charts(mesh: LightmappedMesh) -> np.ndarray:
    """Numbers the charts of the lightmap's UVs.

    Args:
        mesh: The mesh.

    Returns:
        int32 [F]: active triangles connected by edges whose ends coincide in space and in UV space are one chart; -1
        where a triangle isn't active.
    """
    return charts(welded(mesh.position, mesh.uv, mesh.triangle), mesh.active)
