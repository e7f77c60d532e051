"""Sums network gradients over a CUDA block of samples in native code; `native/block_sums.cuh` explains why.

Read first: `losses` in `tests/reference/temporal.py`, whose autograd gradients equal these sums.
"""

from typing import Any

import warp as wp

from wlm_kernels import mlp
from wlm_kernels.native import native_source

BLOCK = 128  # threads of a CUDA block; the samples of a tile are a multiple of it there

_SHARED = 46 * 1024  # bytes of shared memory that the staged samples of a block may take


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("" ::: "memory");
#endif
""")
def reload():
    """Makes the compiler load the weights again for the backward pass.

    If the weights were kept from the forward pass, they would fill hundreds of registers and spill to memory; loading
    them again hits the cache.
    """


def block_reduction(net: mlp.MlpKernels) -> Any:
    """Builds the `wp.func` that sums the gradients of a network over a block of `BLOCK` samples, on CUDA.

    The function's arguments are, for each sample, the inputs `f`, `h1`, `h2` of the three layers, the gradients `d1`,
    `d2`, `d3` of the layers' outputs before activation, and the loss `value`; `row`, the number of this block of
    samples; and the sums, written for each block: `partial` [rows * (I + H + 2), H] for I inputs and H units,
    `partial_out` [rows * (H + 1), 3] and `loss` [rows].
    """
    inputs, hidden = net.inputs, net.hidden

    def round4(n: int) -> int:
        return -(-n // 4) * 4

    sizes = [round4(inputs + 1), round4(hidden), round4(hidden + 1), round4(hidden), round4(hidden + 1), 4]
    # An odd multiple of 4, so that threads hit different banks.
    stride = sum(sizes) + (4 if sum(sizes) % 8 == 0 else 0)
    across = sizes[1] // 4
    constants = {
        "I": inputs,
        "H": hidden,
        "THREADS": BLOCK,
        "STAGED": next(s for s in (128, 64, 32, 16) if s * stride * 4 <= _SHARED),
        "STRIDE": stride,
        **{name: sum(sizes[:i]) for i, name in enumerate(("F", "D1", "H1", "D2", "H2", "D3"))},
        "B1": sizes[0] // 4 * across,
        "B2": sizes[2] // 4 * across,
        "B3": sizes[4] // 4,
        "ACROSS": across,
    }
    vec_in, vec_hidden = net.vec_in, net.vec_hidden

    @wp.func_native(native_source(__package__, "block_sums", **constants))
    def reduce(
        f: vec_in,
        h1: vec_hidden,
        h2: vec_hidden,
        d1: vec_hidden,
        d2: vec_hidden,
        d3: wp.vec3,
        value: float,
        row: int,
        partial: wp.array2d[float],
        partial_out: wp.array2d[float],
        loss: wp.array1d[float],
    ): ...

    return reduce
