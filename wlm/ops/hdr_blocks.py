"""Encoding of tensors as BC6H and ASTC HDR on their device."""

import functools
import math
from types import ModuleType
from typing import Any

import numpy as np
import torch
import warp as wp

from wlm.formats import astc, bc6h
from wlm.interop import to_warp
from wlm.ops.tensors import check, on_stream
from wlm.workers import cores, each
from wlm_kernels import astc as astc_kernels
from wlm_kernels import bc6h as bc6h_kernels

_FINITE = 0x7C00  # bits of the first half float that isn't finite
_BLOCKS_A_THREAD = 256  # the least work of a thread on the CPU, about 20 ms
_KERNELS: dict[str, ModuleType] = {"bc6h": bc6h_kernels, "astc": astc_kernels}
_TABLES = {
    "bc6h": {
        "modes": bc6h.MODES,
        "layout": bc6h.LAYOUT,
        "masks": bc6h.MASKS,
        "anchors": bc6h.SECOND_ANCHORS,
        "halves": np.arange(_FINITE, dtype=np.uint16).view(np.float16).astype(np.float32),
    },
    "astc": astc.TABLES,
}


def encoded_blocks(
    codec: str, light: torch.Tensor, weight: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Encodes blocks of 4 x 4 texels, float32 [N, 16, 3], linear, row by row, as "bc6h" (unsigned) or "astc" (HDR), see
    `wlm_kernels.bc6h` and `wlm_kernels.astc`.

    `weight`, float32 [N, 16], is that of each texel's squared error; None: all equal. Returns the blocks, uint8 [N,
    16], and their decoded texels, float32 [N, 16, 3]. On the CPU several threads encode.
    """
    count = len(light)
    weight = torch.ones_like(light[..., 0]) if weight is None else weight
    check("light", light, (count, 16, 3))
    check("weight", weight, (count, 16), light.device)
    light, weight = light.contiguous(), weight.contiguous()
    words = torch.zeros((count, 4), dtype=torch.int32, device=light.device)
    decoded, tables = torch.zeros_like(light), _tables(codec, str(light.device))

    def encode(first: int) -> None:
        part = slice(first, first + step)
        arrays = to_warp(light[part], wp.vec3), to_warp(weight[part]), tables
        _KERNELS[codec].encode(*arrays, to_warp(words[part], wp.uint32), to_warp(decoded[part], wp.vec3))

    if light.is_cuda:
        step = max(count, 1)
        with on_stream(light.device):
            encode(0)
    else:
        wp.load_module(_KERNELS[codec], "cpu")  # not by the threads
        step = max(_BLOCKS_A_THREAD, math.ceil(count / cores()))
        for _ in each(encode, range(0, count, step)):
            pass
    return words.view(torch.uint8), decoded


@functools.cache
def _tables(codec: str, device: str) -> Any:
    tables = _KERNELS[codec].Tables()
    for name, values in _TABLES[codec].items():
        setattr(tables, name, wp.array(values, dtype=float if values.dtype == np.float32 else int, device=device))
    return tables
