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

_BLOCKS_A_THREAD = 256  # the least work of a thread on the CPU, about 20 ms
_CODECS: dict[str, tuple[ModuleType, dict[str, np.ndarray]]] = {
    "bc6h": (bc6h_kernels, bc6h.TABLES),
    "astc": (astc_kernels, astc.TABLES),
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
    decoded, tables, kernels = torch.zeros_like(light), _tables(codec, str(light.device)), _CODECS[codec][0]
    # On the CPU a launch is a loop in one thread.
    step = max(count, 1) if light.is_cuda else max(_BLOCKS_A_THREAD, math.ceil(count / cores()))

    def encode(first: int) -> None:
        parts = (part[first : first + step] for part in (light, weight, words, decoded))
        arrays = list(map(to_warp, parts, (wp.vec3, None, wp.uint32, wp.vec3)))
        kernels.encode(*arrays[:2], tables, *arrays[2:])

    wp.load_module(kernels, str(light.device))  # before threads launch its kernel
    starts = range(0, count, step)
    with on_stream(light.device):
        list(map(encode, starts) if light.is_cuda else each(encode, starts))
    return words.view(torch.uint8), decoded


@functools.cache
def _tables(codec: str, device: str) -> Any:
    kernels, arrays = _CODECS[codec]
    tables = kernels.Tables()
    for name, values in arrays.items():
        setattr(tables, name, wp.array(values, dtype=int, device=device))
    return tables
