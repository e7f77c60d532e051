"""Feature maps in simulated BC7 mode 6 blocks with trainable endpoints and weights.

A map of 4 channels is cut into blocks of 4 x 4 texels. A block has two endpoints, e0 and e1, and a weight w for each
texel, which is (1 - w) e0 + w e1 (neural-dynamic-gi, eq. 7 and 8). `quantised` uses exactly the levels of the 16-byte
block format and rounds like its decoder; rounding and clamping are straight-through, with derivative 1. Train without
it first and with it at the end; `bc7_blocks` then returns the blocks' bytes.
"""

import numpy as np
import torch
import warp as wp
from torch.autograd.function import once_differentiable

from wlm.formats.bc7 import pack_mode6
from wlm.interop import to_warp
from wlm.ops.sampling import sample
from wlm.ops.tapes import takes_arrays
from wlm.ops.tensors import check, check_finite, dense, on_stream
from wlm_kernels.lightmap import blocks


@takes_arrays("endpoints", "weights", "uv")
def bc7_map(
    endpoints: torch.Tensor,
    weights: torch.Tensor,
    uv: torch.Tensor,
    *,
    layer: torch.Tensor | None = None,
    quantised: bool = False,
) -> torch.Tensor:
    """Samples a map of blocks bilinearly, clamped at its border; the reference is `benchmarks.plain.bc7_map`.

    Each call decodes all texels once, so it is inefficient for a few samples of a large map.

    Args:
        endpoints: float [H/4, W/4, 2, 4], or [L, H/4, W/4, 2, 4] with `layer`: two RGBA colours per block,
            clamped to [0, 1] for use. Has a gradient, also for values outside [0, 1].
        weights: float [H, W] or [L, H, W], one per texel, clamped like the endpoints; has a gradient.
        uv: float [..., 2], u right, v down, the centre of texel i of n at (i + 1/2) / n; has a gradient.
        layer: int32 or int64 [...], 0 to L - 1: the index of each point's map.
        quantised: Whether to round to the values that BC7 mode 6 can store.

    Returns:
        float [..., 4].

    Raises:
        ValueError: A tensor's shape, type or device doesn't fit, or a number isn't finite or in range. The check of
            numbers waits for the GPU and is skipped while a CUDA graph is captured.
    """
    if layer is None:
        check("weights", weights, (None, None))
    texels = bc7_texels(endpoints, weights, quantised=quantised)
    return sample(texels, uv, layer, axes=2, names=("weights", "uv"))


@takes_arrays("endpoints", "weights")
def bc7_texels(endpoints: torch.Tensor, weights: torch.Tensor, *, quantised: bool = False) -> torch.Tensor:
    """Decodes whole maps; the reference is `benchmarks.plain.bc7_texels`. Gradients are bitwise reproducible.

    Args:
        endpoints: float [H/4, W/4, 2, 4] or [L, H/4, W/4, 2, 4], see `bc7_map`.
        weights: float [H, W] or [L, H, W].
        quantised: Whether to round to the values that BC7 mode 6 can store.

    Returns:
        float [H, W, 4] or [L, H, W, 4], an input for `plane`, or for `volume` if the maps are its slices.

    Raises:
        ValueError: See `bc7_map`.
    """
    _check(endpoints, weights)
    shape = (-1 if weights.numel() else 0, *weights.shape[-2:])
    texels = _Texels.apply(endpoints.reshape(-1, *endpoints.shape[-4:]), weights.reshape(shape), quantised)
    return texels.reshape(*weights.shape, 4)


@takes_arrays()
def bc7_blocks(endpoints: torch.Tensor, weights: torch.Tensor) -> np.ndarray:
    """Packs maps into BC7 blocks, which decode to the result of `bc7_texels` with `quantised`; has no gradient.

    Args:
        endpoints: float [H/4, W/4, 2, 4] or [L, H/4, W/4, 2, 4], see `bc7_map`.
        weights: float [H, W] or [L, H, W].

    Returns:
        uint8 [H/4, W/4, 16] or [L, H/4, W/4, 16], BC7 blocks of mode 6.

    Raises:
        ValueError: See `bc7_map`; or an array requires a gradient while a tape is active.
    """
    _check(endpoints, weights)
    *layers, height, width = weights.shape
    stored = torch.empty(endpoints.shape, dtype=torch.uint8, device=weights.device)
    index = torch.empty(weights.shape, dtype=torch.uint8, device=weights.device)
    if weights.numel():
        with on_stream(weights.device):
            blocks.quantise(
                to_warp(dense(endpoints).reshape(-1, *endpoints.shape[-4:]), wp.vec4),
                to_warp(weights.reshape(-1, height, width)),
                to_warp(stored.reshape(-1, *stored.shape[-4:]), wp.vec4ub),
                to_warp(index.reshape(-1, height, width)),
            )
    in_blocks = index.reshape(*layers, height // 4, 4, width // 4, 4).transpose(-3, -2)
    return pack_mode6(stored.cpu().numpy(), in_blocks.reshape(*stored.shape[:-2], 16).cpu().numpy())


def _check(endpoints: torch.Tensor, weights: torch.Tensor) -> None:
    check("weights", weights, (...,))
    check("weights", weights, (None,) * (3 if weights.ndim == 3 else 2))
    *layers, height, width = weights.shape
    if height % 4 or width % 4:
        raise ValueError(f"weights: expected sizes in whole blocks of 4 x 4, got {tuple(weights.shape)}")
    check("endpoints", endpoints, (*layers, height // 4, width // 4, 2, 4), weights.device)
    check_finite(endpoints=endpoints, weights=weights)


class _Texels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, endpoints, weights, quantised):
        endpoints = dense(endpoints)
        out = weights.new_empty(*weights.shape, 4)
        with on_stream(weights.device):
            blocks.reconstruct(to_warp(endpoints, wp.vec4), to_warp(weights), to_warp(out, wp.vec4), quantised)
        ctx.save_for_backward(endpoints, weights)
        ctx.quantised = quantised
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        endpoints, weights = ctx.saved_tensors
        on_endpoints, on_weights = torch.empty_like(endpoints), weights.new_empty(weights.shape)
        with on_stream(weights.device):
            blocks.reconstruct_backward(
                to_warp(endpoints, wp.vec4),
                to_warp(weights),
                to_warp(dense(grad_out), wp.vec4),
                to_warp(on_endpoints, wp.vec4),
                to_warp(on_weights),
                ctx.quantised,
            )
        return on_endpoints, on_weights, None
