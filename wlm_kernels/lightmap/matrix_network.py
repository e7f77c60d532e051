"""Evaluates the networks of tiles on a GPU's matrix units (tensor cores), for hidden widths that are multiples of 16.

Activations and weights are half floats, and GELU is its tanh form with the GPU's tanh instruction.

Read first: `exact_kernel` in `wlm_kernels/lightmap/decode.py`.
"""

import functools
from typing import Any

import numpy as np
import warp as wp

from wlm_kernels.lightmap.decode import Stored
from wlm_kernels.lightmap.features import INPUTS, MAP_INPUTS
from wlm_kernels.native import native_source, on_cuda

STEP = 16  # size of a matrix product: the hidden width is a multiple of it
_UV_SCALE = np.sqrt(12.0) / 255.0
_SCALE = (np.sqrt(2.0 / np.pi) * 0.044715) ** (1.0 / 3.0)  # of arguments of GELU, whose x^3 then has the factor 1


Maps = wp.types.vector(MAP_INPUTS, float)


def pack_networks(hidden: np.ndarray, output: np.ndarray) -> np.ndarray:
    """Arranges the weights of N networks as `native/matrix_network.cuh` reads them.

    Args:
        hidden: float [N, 18 + H, H], hidden layers of networks with 16 inputs, see `wlm_kernels.mlp`.
        output: float [N, H + 1, 3], output layers.

    Returns:
        uint32 [N, words], two half floats each: the operands of the three layers in the order of the lanes, then the
        biases of the second and (as floats) of the third. Inputs 12 to 15 have no weights. F_uv is an input in steps of
        1/255. Arguments of GELU are scaled by 0.3292035 and its results by twice that, see the kernel. The output has
        eight columns, in two versions.
    """
    n, width = len(hidden), hidden.shape[2]
    first = np.zeros((n, STEP, width))
    first[:, :4], first[:, 4:MAP_INPUTS] = hidden[:, :4] * (_SCALE * _UV_SCALE), hidden[:, 4:MAP_INPUTS] * _SCALE
    bias = INPUTS + 1 + width
    third = np.zeros((n, 2, width, 8))
    third[:, 0, :, :3] = third[:, 1, :, 4:7] = output[:, :-1] / (2.0 * _SCALE)
    layers = [
        _operands(first),
        _operands(hidden[:, INPUTS + 1 : bias] / 2.0),
        _operands(third.reshape(n, 2 * width, 8)),
        np.ascontiguousarray(hidden[:, bias] * _SCALE, np.float16).view(np.uint32),
        np.pad(output[:, -1].astype(np.float32), ((0, 0), (0, 1))).view(np.uint32),
    ]
    return np.ascontiguousarray(np.concatenate(layers, axis=1))


def packed_words(width: int) -> int:
    """Returns the words of a network from `pack_networks`, for a hidden width."""
    steps = width // STEP
    return 64 * (2 * steps + 2 * steps**2 + 2 * steps) + width // 2 + 4


def pack_biases(hidden: np.ndarray) -> np.ndarray:
    """Returns of the first layers of N networks, as `pack_networks` takes them, the biases and their change by each of
    the four numbers of the encoded time, float32 [N, 5, H], scaled like the layers' sums."""
    bias = hidden[:, INPUTS] + 0.5 * _UV_SCALE * hidden[:, :4].sum(1)
    return (np.concatenate([bias[:, None], hidden[:, MAP_INPUTS:INPUTS]], 1) * _SCALE).astype(np.float32)


def _operands(weights: np.ndarray) -> np.ndarray:
    """Arranges the weights of a layer, [N, inputs, units], as right operands of products, uint32 [N, words].

    A lane holds of 16 inputs and 8 units the inputs 2 q, 2 q + 1, 2 q + 8, 2 q + 9 of unit g; see `matrix_units.cuh`.
    """
    n, inputs, units = weights.shape
    parts = weights.reshape(n, inputs // STEP, 2, 4, 2, units // 8, 8).transpose(0, 1, 5, 6, 3, 2, 4)
    return np.ascontiguousarray(parts, np.float16).reshape(n, -1).view(np.uint32)


def native(*names: str, **constants: int) -> str:
    """Returns the code of a native function from its parts, with integer constants."""
    units = native_source("wlm_kernels", "matrix_units", **constants)
    return units + "".join(native_source(__package__, name) for name in names)


@wp.func_native(on_cuda(native("matrix_maps", "map_inputs"), "return wp::vec_t<12, float>();"))
def map_inputs(stored: Stored, n: int, tau: float, y: int, x: int) -> Maps:
    """Reads the maps of tile n at its texel (y, x) as `matrix_texels` takes them: F_uv in steps of 1/255 less 128, then
    F_uvt, F_ut and F_vt, scaled as the network takes them. On a GPU only."""
    ...


@functools.cache
def matrix_texels(hidden: int) -> Any:
    """Builds (once) the `wp.func` that evaluates networks, at one texel per thread.

    It is evaluate(packed, biases, f, encoding, n, time), a vec3. All threads of a warp must call it, in blocks of 128
    threads. Its arguments are `packed`, uint32 [N, words], from `pack_networks`; `biases`, vecH [N, 5], from
    `pack_biases`; `f`, vec12, from `map_inputs`; `encoding`, vec4, the encoded time; `n`, the number of the network, or
    -1 for a thread without one; `time`, a number that is equal only where the encoding is.
    """
    vec_hidden = wp.types.vector(hidden, float)

    @wp.func_native(on_cuda(native("matrix_network", "matrix_texels", H=hidden), "return wp::vec_t<3, float>();"))
    def evaluate(
        packed: wp.array2d[wp.uint32],
        biases: wp.array2d[vec_hidden],
        f: Maps,
        encoding: wp.vec4,
        n: int,
        time: int,
    ) -> wp.vec3: ...

    return evaluate
