"""Runs the network of a training step on a GPU's matrix units: wraps `native/matrix_step.cuh` for Warp kernels.

Read first: `wlm_kernels/mlp.py`, the same network in float32, and `losses` in `tests/reference/temporal.py`.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.lightmap.features import INPUTS
from wlm_kernels.native import native_source, on_cuda

BLOCK = 128  # threads of a CUDA block; the samples of a tile are a multiple of it there

WIDTHS = (16, 32, 48, 64)
"""Numbers of hidden units: multiples of the size of a matrix product, of which the largest fills the 48 KiB of shared
memory of a block with its activations and weights."""


@functools.cache
def matrix_network(hidden: int, gelu: str) -> Any:
    """Builds (once) the `wp.func` that runs a network forward and backward for `BLOCK` samples of one tile.

    The function's arguments are the layers of all networks, `hidden` [N, 18 + H] and `output` [N, H + 1], see
    `wlm_kernels.mlp`; the number `n` of the tile's network; each sample's inputs `f`, `target` and `weight` of the
    channels; `share`, a factor on every squared error; `row`, the number of this block of samples; and the results,
    written for each block: `partial` [rows * (18 + H), H], `partial_out` [rows * (H + 1), 3] and `loss` [rows].

    It returns the gradient of the inputs of each sample, followed by the error of the output, and the address of 80
    bytes of shared memory that are now the sample's own: rows of a warp's lanes follow each other.

    Args:
        hidden: H, the number of hidden units, one of `WIDTHS`.
        gelu: "exact" or "tanh".
    """
    if hidden not in WIDTHS:
        raise ValueError(f"hidden: expected one of {WIDTHS} on CUDA, got {hidden}")
    vec_in, vec_hidden = wp.types.vector(INPUTS, float), wp.types.vector(hidden, float)
    vec_result = wp.types.vector(INPUTS + 4, float)
    # A row of 64 halves spans all banks: its groups of 8 are permuted to avoid bank conflicts; other rows are padded.
    rows = {"STRIDE": hidden, "MASK": 7} if hidden == WIDTHS[-1] else {"STRIDE": hidden + 8, "MASK": 0}
    constants = {"I": INPUTS, "H": hidden, "T": BLOCK, "EXACT": int(gelu == "exact"), **rows}
    code = native_source("wlm_kernels", "matrix_units") + native_source(__package__, "matrix_step", **constants)

    @wp.func_native(on_cuda(code, f"return wp::vec_t<{INPUTS + 4}, float>();"))
    def network(
        hidden: wp.array2d[vec_hidden],
        output: wp.array2d[wp.vec3],
        n: int,
        f: vec_in,
        target: wp.vec3,
        weight: wp.vec3,
        share: float,
        row: int,
        partial: wp.array2d[float],
        partial_out: wp.array2d[float],
        loss: wp.array1d[float],
    ) -> vec_result: ...

    return network
