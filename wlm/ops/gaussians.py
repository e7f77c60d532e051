"""Sums of 3D Gaussians with latent vectors."""

from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from wlm.interop import to_warp
from wlm.ops.tapes import takes_arrays
from wlm.ops.tensors import check, check_finite, dense, on_stream
from wlm_kernels.probe import cubes as cubes_kernels
from wlm_kernels.probe import gaussian_sum as kernels
from wlm_kernels.probe.gaussians import LATENT

PAIRS_FOR_LISTS = 2**17
"""Number of Gaussian-point pairs above which points only evaluate the Gaussians listed for their grid cell."""


@takes_arrays("rows", "points")
def gaussian_sum(
    rows: torch.Tensor, points: torch.Tensor, *, cut: float = 3.0, support: str = "ellipsoid"
) -> torch.Tensor:
    """Sums Gaussians at points: F(x) = sum_k F_k exp(-|u_k|^2 / 2); reference: `benchmarks.plain.gaussian_sum`.

    u_k = S^-1 R^T (x - centre) with the scales S and the rotation R (gaussian-probe-compression, eq. 2 to 6, 11, 12),
    over the Gaussians that reach x; the gradients treat this set as constant. Sums and gradients are bitwise
    reproducible. The first use of a latent length compiles its kernels, which takes several seconds; lengths up to 32
    are tested. The function can't be captured in a CUDA graph.

    Args:
        rows: float [K, 10 + L], one Gaussian per row: centre (3), natural logarithm of the scale along its axes (3),
            rotation as a quaternion w x y z of any length (4; below 1e-12 it is the identity and has no gradient),
            latent (L). Has a gradient.
        points: float [..., 3], in the unit of the centres; has a gradient.
        cut: Cutoff radius of a Gaussian in standard deviations, above 0. The omitted part is at most exp(-cut^2 / 2) of
            a latent.
        support: Shape of the cutoff: "ellipsoid" scales the radius along each axis; "sphere" uses the longest axis in
            all directions (eq. 6).

    Returns:
        float [..., L].

    Raises:
        ValueError: A tensor's shape, type or device doesn't fit, the cut isn't above 0, there is no such support, or a
            number isn't finite. The check of numbers waits for the GPU.
    """
    if support not in kernels.SUPPORTS:
        raise ValueError(f"support: expected one of {', '.join(kernels.SUPPORTS)}, got {support!r}")
    if not cut > 0.0:
        raise ValueError(f"cut: expected a number above 0, got {cut}")
    check("rows", rows, (None, None))
    if rows.shape[1] <= LATENT:
        raise ValueError(f"rows: expected {LATENT} columns and at least one of a latent, got {rows.shape[1]} columns")
    check("points", points, (..., 3), rows.device)
    check_finite(rows=rows, points=points)
    sums = _GaussianSum.apply(rows, points.reshape(-1, 3), float(cut), support)
    return sums.reshape(*points.shape[:-1], -1 if sums.numel() else sums.shape[1])


class _GaussianSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows, points, cut, support):
        rows, points = dense(rows), dense(points)
        out = rows.new_empty(rows.shape[1] - LATENT, len(points))
        with on_stream(rows.device):
            ctx.cubes = _forward(rows, points, cut, support, out)
        ctx.save_for_backward(rows, points)
        ctx.cut, ctx.support = cut, support
        return out.T

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        rows, points = ctx.saved_tensors
        on_rows = torch.empty_like(rows) if ctx.needs_input_grad[0] else None
        on_points = torch.empty_like(points) if ctx.needs_input_grad[1] else None
        with on_stream(rows.device):
            _backward(rows, points, ctx.cut, ctx.support, ctx.cubes, dense(grad_out.T), on_rows, on_points)
        return on_rows, on_points, None, None


# Warp frees its allocations at the end of these functions, on the stream that used them.


def _forward(rows, points, cut: float, support: str, out) -> Any:
    array, x = to_warp(rows), to_warp(points, wp.vec3)
    shapes = kernels.shapes(array, cut, support)
    cubes = None
    if len(rows) * len(points) >= PAIRS_FOR_LISTS:
        cubes = cubes_kernels.build(shapes, *(ends.tolist() for ends in points.aminmax(dim=0)))
        # The backward pass runs later; torch frees its memory only when its stream has finished using it.
        cubes.start, cubes.item = (to_warp(wp.to_torch(numbers).clone()) for numbers in (cubes.start, cubes.item))
    kernels.sum(array, shapes, cubes, x, to_warp(out), cut)
    return cubes


def _backward(rows, points, cut: float, support: str, cubes, grad_out, on_rows, on_points) -> None:
    array, x, grad = to_warp(rows), to_warp(points, wp.vec3), to_warp(grad_out)
    shapes = kernels.shapes(array, cut, support)
    if on_rows is not None:
        kernels.backward(array, shapes, cubes, x, grad, to_warp(on_rows), cut)
    if on_points is not None:
        kernels.backward_points(array, shapes, cubes, x, grad, to_warp(on_points, wp.vec3), cut)
