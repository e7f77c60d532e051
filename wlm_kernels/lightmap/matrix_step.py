"""Runs the network of a training step on a GPU's matrix units: wraps `native/matrix_step.cuh` for Warp kernels.

Read first: `wlm_kernels/mlp.py`, the same network in float32, and `losses` in `tests/reference/temporal.py`.
"""

import functools
from typing import Any

import warp as wp

from wlm_kernels.lightmap.reduce import BLOCK
from wlm_kernels.native import native_source, on_cuda

_STEP = 16  # size of a matrix product: the hidden width is a multiple of it
_WIDEST = 64  # a block's activations and weights then fill its 48 KiB of shared memory


def fits_matrix_units(inputs: int, hidden: int) -> bool:
    """Returns whether `matrix_network` supports networks with these numbers of inputs and hidden units."""
    return inputs <= _STEP and hidden % _STEP == 0 and hidden <= _WIDEST


@functools.cache
def matrix_network(inputs: int, hidden: int, gelu: str) -> Any:
    """Builds (once) the `wp.func` that runs a network forward and backward for `BLOCK` samples of one tile.

    The function's arguments are the layers of all networks, `hidden` [N, I + H + 2] and `output` [N, H + 1], see
    `wlm_kernels.mlp`; the number `n` of the tile's network; each sample's inputs `f`, `target` and `weight` of the
    channels; `share`, a factor on every squared error; `row`, the number of this block of samples; and the results,
    written for each block: `partial` [rows * (I + H + 2), H], `partial_out` [rows * (H + 1), 3] and `loss` [rows].

    It returns the gradient of the inputs of each sample, followed by the error of the output.

    Args:
        inputs, hidden: I and H, the numbers of inputs and hidden units, as `fits_matrix_units` allows.
        gelu: "exact" or "tanh".
    """
    vec_in, vec_hidden = wp.types.vector(inputs, float), wp.types.vector(hidden, float)
    vec_result = wp.types.vector(inputs + 3, float)
    # A row of 64 halves spans all banks: its groups of 8 are permuted to avoid bank conflicts; other rows are padded.
    rows = {"STRIDE": hidden, "MASK": 7} if hidden == _WIDEST else {"STRIDE": hidden + 8, "MASK": 0}
    constants = {"I": inputs, "H": hidden, "T": BLOCK, "EXACT": int(gelu == "exact"), **rows}
    code = native_source("wlm_kernels", "matrix_units") + native_source(__package__, "matrix_step", **constants)

    @wp.func_native(on_cuda(code, f"return wp::vec_t<{inputs + 3}, float>();"))
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
