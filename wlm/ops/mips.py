"""Mip levels of textures: their texels, the level that a pixel reads, and reads of many textures at once."""

import torch
import warp as wp
from torch.autograd.function import once_differentiable
from torch.nn.functional import adaptive_avg_pool2d, pad

from wlm.interop import to_warp
from wlm.ops.tensors import dense, on_stream, optional_array, zeros_for
from wlm_kernels.raster import mips as kernels

# Steps per pixel beyond this read the last level; their squares stay finite.
_MOST = 1e12
# A GPU sums the gradients of textures with few numbers in 32 copies: additions to one number wait for one another.
_COPIES, _FEW_NUMBERS = 32, 2**15


def read(
    images: torch.Tensor, uv: torch.Tensor, derivatives: torch.Tensor | None, filter: str, boundary: str
) -> torch.Tensor:
    """Reads B textures [B, H, W, C] at uv [B N, 2], N points each; see `wlm.ops.texture`. Returns [B N, C]."""
    _, height, width, channels = images.shape
    if derivatives is None:
        levels, level = 1, None
    else:
        levels, level = max(height, width).bit_length(), level_of(derivatives, height, width).reshape(-1)
    stacks = torch.cat([pad(each, (0, 0, 0, width - each.shape[2])) for each in pyramid(images, levels)], 1)
    return Read.apply(stacks.reshape(-1, width, channels), (height, width), levels, uv, level, filter, boundary)


def pyramid(images: torch.Tensor, levels: int) -> list[torch.Tensor]:
    """Returns the mip levels of textures [B, H, W, C]: each has half the rows and columns, rounded down but at least 1,
    and means of 2 x 2 texels; of an odd number, the middle texel counts in two means."""
    found = [images]
    for _ in range(levels - 1):
        size = tuple(max(n // 2, 1) for n in found[-1].shape[1:3])
        found.append(adaptive_avg_pool2d(found[-1].movedim(-1, 1), size).movedim(1, -1))
    return found


def level_of(derivatives: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Returns log2 of the largest singular value of the derivatives [..., 2, 2], in texels per pixel: [...]."""
    u, v = derivatives.clamp(-_MOST, _MOST).unbind(-2)
    (ux, uy), (vx, vy) = (width * u).unbind(-1), (height * v).unbind(-1)
    right, down, mixed = ux * ux + vx * vx, uy * uy + vy * vy, ux * uy + vx * vy
    # The derivative of the root at a circle, where it is 0, would be infinite.
    spread = 0.25 * (right - down).square() + mixed.square()
    root = torch.where(spread > 0.0, spread, 1.0).sqrt() * (spread > 0.0)
    longest = 0.5 * (right + down) + root
    return 0.5 * torch.where(longest > 1.0, longest, torch.where(longest.isnan(), longest, 1.0)).log2()


class Read(torch.autograd.Function):
    """Reads of textures with their gradients: `mips.sample` of the kernels."""

    @staticmethod
    def forward(ctx, stacks, size, levels, uv, level, filter, boundary):
        stacks, uv, level = dense(stacks), dense(uv), None if level is None else dense(level)
        out = stacks.new_empty(len(uv), stacks.shape[2])
        ctx.mode = {"size": size, "levels": levels, "filter": filter, "boundary": boundary}
        with on_stream(stacks.device):
            at = None if level is None else to_warp(level)
            kernels.sample(to_warp(stacks), to_warp(uv, wp.vec2), to_warp(out), level=at, **ctx.mode)
        ctx.save_for_backward(stacks, uv, level)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        stacks, uv, level = ctx.saved_tensors
        copies = _COPIES if stacks.is_cuda and len(uv) > stacks.numel() and stacks.numel() <= _FEW_NUMBERS else 1
        on_stacks = zeros_for(stacks.expand(copies, *stacks.shape).movedim(0, -1), ctx.needs_input_grad[0])
        on_uv = torch.empty_like(uv) if ctx.needs_input_grad[3] else None
        on_level = torch.empty_like(level) if ctx.needs_input_grad[4] else None
        device = stacks.device
        with on_stream(device):
            kernels.sample_backward(
                to_warp(stacks),
                to_warp(uv, wp.vec2),
                to_warp(dense(grad_out)),
                optional_array(None if on_stacks is None else on_stacks.flatten(2), 3, wp.float32, device),
                optional_array(on_uv, 1, wp.vec2, device),
                optional_array(on_level, 1, wp.float32, device),
                level=None if level is None else to_warp(level),
                **ctx.mode,
            )
        if on_stacks is not None:
            on_stacks = on_stacks.sum(-1) if copies > 1 else on_stacks.squeeze(-1)  # a sum of one would be a copy
        return on_stacks, None, None, on_uv, on_level, None, None
