"""BC6H encoding of tensors on their device."""

import functools

import numpy as np
import torch
import warp as wp

from wlm.formats import bc6h
from wlm.interop import to_warp
from wlm.ops.tensors import check, on_stream
from wlm_kernels import bc6h as kernels

_FINITE = 0x7C00  # bits of the first half float that isn't finite


def bc6h_blocks(light: torch.Tensor, weight: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Encodes blocks of 4 x 4 texels, float32 [N, 16, 3], linear, row by row, as unsigned BC6H, see `wlm_kernels.bc6h`.

    `weight`, float32 [N, 16], is that of each texel's squared error; None: all equal. Returns the blocks, uint8 [N,
    16], and their decoded texels, float32 [N, 16, 3].
    """
    count = len(light)
    weight = torch.ones_like(light[..., 0]) if weight is None else weight
    check("light", light, (count, 16, 3))
    check("weight", weight, (count, 16), light.device)
    light, weight = light.contiguous(), weight.contiguous()
    words = torch.zeros((count, 4), dtype=torch.int32, device=light.device)
    decoded = torch.zeros_like(light)
    if count:
        with on_stream(light.device):
            kernels.encode(
                to_warp(light, wp.vec3),
                to_warp(weight),
                _tables(str(light.device)),
                to_warp(words, wp.uint32),
                to_warp(decoded, wp.vec3),
            )
    return words.view(torch.uint8), decoded


@functools.cache
def _tables(device: str) -> kernels.Tables:
    tables = kernels.Tables()
    halves = np.arange(_FINITE, dtype=np.uint16).view(np.float16).astype(np.float32)
    for name, values, dtype in (
        ("modes", bc6h.MODES, int),
        ("layout", bc6h.LAYOUT, int),
        ("masks", bc6h.MASKS, int),
        ("anchors", bc6h.SECOND_ANCHORS, int),
        ("halves", halves, float),
    ):
        setattr(tables, name, wp.array(values, dtype=dtype, device=device))
    return tables
