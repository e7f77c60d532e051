"""Antialiasing of silhouettes, which gives pictures gradients by the positions of the vertices."""

import torch
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad, relu

from wlm.interop import to_warp
from wlm.ops.raster import Raster
from wlm.ops.tapes import takes_arrays
from wlm.ops.tensors import check, check_finite, check_index, dense, on_stream, zeros_for
from wlm_kernels.raster import silhouette as kernels


# The barycentrics of a raster may require a gradient, and get none.
@takes_arrays("colour", "clip", "raster.barycentric")
def antialias(colour: torch.Tensor, raster: Raster, clip: torch.Tensor, triangle: torch.Tensor) -> torch.Tensor:
    """Blends the colours of neighbouring pixels where a silhouette passes between their centres.

    Where a silhouette crosses the line from one pixel's centre to that of the next one, at its right or below, the
    colour on each side of the edge counts up to the edge: an edge beyond the border of the pixels at the distance d
    adds d of the nearer colour to the farther pixel, one before it d of the farther colour to the nearer pixel. So
    a long edge covers the area that it should. An edge that runs more down than across is blended between pixels
    side by side, another between pixels one above the other (Laine et al. 2020, "Modular Primitives for High-
    Performance Differentiable Rendering", section 3.5).

    The silhouette is found from the nearer of the two visible triangles on, over the edges that it and its
    neighbours share, up to 32 triangles: the first edge behind which no triangle with the same two vertices
    continues the surface on the screen. A seam, where triangles have different vertices at equal positions, counts
    as a silhouette; it blends colours that the two sides have in common. A surface that is seen at no pixel's
    centre has no silhouette.

    Args:
        colour: float [H, W, C], or [B, H, W, C] for a batch; has a gradient.
        raster: Result of `rasterize` for these corners and triangles.
        clip: float [V, 4], or [B, V, 4] for a batch, as for `rasterize`. Its x, y and w have gradients: those of the
            silhouettes' places. Corners may lie behind the viewer.
        triangle: int32 or int64 [F, 3].

    Returns:
        float, shaped like `colour`.

    Raises:
        ValueError: A tensor's shape, type, device or size doesn't fit, a colour isn't finite, a triangle has a corner
            that isn't in `clip`, or there are not as many triangles as were drawn. The checks of numbers wait for the
            GPU and are skipped while a CUDA graph is captured.
    """
    batched = getattr(clip, "ndim", 2) == 3
    check("clip", clip, (None, None, 4) if batched else (None, 4))
    device, images = clip.device, tuple(clip.shape[:-2])
    check_index("triangle", triangle, clip.shape[-2], (None, 3), device)
    if raster.count not in (None, len(triangle)):
        raise ValueError(f"triangle: expected the {raster.count} triangles that were drawn, got {len(triangle)}")
    check("raster.depth", raster.depth, (*images, None, None), device)
    check("raster.triangle", raster.triangle, raster.depth.shape, device, torch.int32)
    check("colour", colour, (*raster.depth.shape, None), device)
    check_finite(colour=colour)
    if not batched:
        return _blended(colour, _Offsets.apply(clip[None], triangle, raster.triangle[None], raster.depth[None])[0])
    return _blended(colour, _Offsets.apply(clip, triangle, raster.triangle, raster.depth))


def _blended(colour: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Blends colours [..., H, W, C] by the offsets [..., H, W, 2] of crossings to the right and below, -1/2 to 1/2."""
    result = colour
    for axis, side in ((0, -2), (1, -3)):
        pairs, outer = colour.shape[side] - 1, (0, 0) * (axis + 1)
        step = colour.narrow(side, 0, pairs) - colour.narrow(side, 1, pairs)
        at = offset[..., axis : axis + 1].narrow(side, 0, pairs)
        result = result + pad(relu(at) * step, (*outer, 1, 0)) - pad(relu(-at) * step, (*outer, 0, 1))
    return result


def _edges(triangle: torch.Tensor, vertices: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Groups the 3 F edges by their two vertices, of which there are `vertices`; see `kernels.find`."""
    ends = triangle[:, [1, 2, 0]].long(), triangle[:, [2, 0, 1]].long()
    key = (torch.minimum(*ends) * vertices + torch.maximum(*ends)).reshape(-1)
    ordered, sides = key.sort(stable=True)
    group = [torch.searchsorted(ordered, key, right=right) for right in (False, True)]
    return sides.int(), torch.stack(group, 1).int()


class _Offsets(torch.autograd.Function):
    @staticmethod
    def forward(ctx, clip, triangle, visible, depth):
        sides, group = _edges(triangle, clip.shape[1])
        triangle = triangle.int()
        offset = depth.new_empty(*depth.shape, 2)
        edge = torch.empty(offset.shape, dtype=torch.int32, device=clip.device)
        with on_stream(clip.device):
            arrays = [to_warp(each) for each in (clip, triangle, sides, group, visible, depth, offset, edge)]
            kernels.find(*arrays)
        ctx.save_for_backward(clip, triangle, edge)
        return offset

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_offset):
        clip, triangle, edge = ctx.saved_tensors
        grad = zeros_for(clip)
        with on_stream(clip.device):
            kernels.find_backward(*(to_warp(each) for each in (clip, triangle, edge, dense(grad_offset), grad)))
        return grad, None, None, None
