"""Decodes tiles on a GPU's matrix units (tensor cores), for hidden widths that are multiples of 16.

A launch does everything: a block of threads decodes a strip of a tile, for which it reads F_uvt, F_ut and F_vt at one
hour, or at two between which it interpolates the radiance. A thread decodes the texels of a column. Activations and
weights are half floats, and GELU is its tanh form with the GPU's tanh instruction.

Read first: `exact_kernel` in `wlm_kernels/lightmap/decode.py`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wlm_kernels.lightmap.decode import Stored, TimeState
from wlm_kernels.lightmap.features import INPUTS, MAP_INPUTS
from wlm_kernels.native import native_source, on_cuda
from wlm_kernels.shared_exponent import pack_rgb9e5

_ROWS = 16  # of texels in a strip, or half as many
_SHARED = 48 << 10  # bytes of shared memory of a block
_BOUNDS = (128, 4)  # threads of a block, blocks of a multiprocessor: 128 registers per thread
_STEP = 16  # size of a matrix product: the hidden width is a multiple of it
_UV_SCALE = np.sqrt(12.0) / 255.0
_SCALE = (np.sqrt(2.0 / np.pi) * 0.044715) ** (1.0 / 3.0)  # of arguments of GELU, whose x^3 then has the factor 1


Maps = wp.types.vector(MAP_INPUTS, float)


@wp.func_native(
    on_cuda(
        """
float y;
asm("{.reg .f32 l; lg2.approx.f32 l, %1; mul.f32 l, l, %2; ex2.approx.f32 %0, l;}" : "=f"(y) : "f"(x), "f"(exponent));
return y;
""",
        "return wp::pow(x, exponent);",
    )
)
def power(x: float, exponent: float) -> float:
    """Returns x ** exponent for x >= 0 and an exponent above 0, on a GPU with a relative error of about 1e-6."""
    ...


@wp.func
def powers(c: wp.vec3, exponent: float) -> wp.vec3:
    return wp.vec3(power(c[0], exponent), power(c[1], exponent), power(c[2], exponent))


def pack_networks(hidden: np.ndarray, output: np.ndarray) -> np.ndarray:
    """Arranges the weights of N networks as `native/matrix_decode.cuh` reads them.

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
    first = np.zeros((n, _STEP, width))
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
    steps = width // _STEP
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
    parts = weights.reshape(n, inputs // _STEP, 2, 4, 2, units // 8, 8).transpose(0, 1, 5, 6, 3, 2, 4)
    return np.ascontiguousarray(parts, np.float16).reshape(n, -1).view(np.uint32)


@dataclass(frozen=True)
class MatrixKernels:
    """Kernels that decode at one hour and between two, and the rows of a strip of each."""

    _one: Any
    _two: Any
    _rows: tuple[int, ...]

    def decode(
        self,
        stored: Stored,
        packed: wp.array,
        hidden: wp.array,
        times: list[TimeState],
        share: float,
        tiles: wp.array,
        out: wp.array,
    ) -> None:
        """Decodes n of N tiles to linear radiance.

        Args:
            stored: The N tiles.
            packed: uint32 [N, words], from `pack_networks`.
            hidden: vecH [N, 18 + H], hidden layers.
            times: One time, or two between which radiance is interpolated linearly (neural-dynamic-gi, eq. 2).
            share: Weight of the second time, 0 to 1; 0 for one time.
            tiles: int [n], the tiles to decode.
            out: uint32 [n, 128, 128], written: RGB9E5.
        """
        wp.launch(
            self._one if len(times) == 1 else self._two,
            (out.shape[0], 128 // self._rows[len(times) - 1], 128),
            inputs=[stored, packed, hidden, times[0], times[-1], share, tiles],
            outputs=[out],
            device=out.device,
            block_dim=128,
        )


@functools.cache
def matrix_kernels(hidden: int, resolution: int) -> MatrixKernels:
    """Builds (once) the decoder for one shape of tiles.

    Args:
        hidden: H, width of the hidden layers, a multiple of 16.
        resolution: Size of F_uvt along u and v.

    Raises:
        ValueError: The width is not a multiple of 16.
    """
    if hidden % _STEP or hidden < _STEP:
        raise ValueError(f"hidden: expected a width that is a multiple of {_STEP} units, got {hidden}")
    rows = tuple(_rows(hidden, resolution, hours) for hours in (1, 2))
    return MatrixKernels(*(_decode_kernel(hidden, resolution, 1 + i, rows[i]) for i in range(2)), rows)


def _native(*names: str, **constants: int) -> str:
    """Returns the code of a native function from its parts, with integer constants."""
    units = native_source("wlm_kernels", "matrix_units", **constants)
    return units + "".join(native_source(__package__, name) for name in names)


@wp.func_native(on_cuda(_native("matrix_maps", "map_inputs"), "return wp::vec_t<12, float>();"))
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

    @wp.func_native(on_cuda(_native("matrix_network", "matrix_texels", H=hidden), "return wp::vec_t<3, float>();"))
    def evaluate(
        packed: wp.array2d[wp.uint32],
        biases: wp.array2d[vec_hidden],
        f: Maps,
        encoding: wp.vec4,
        n: int,
        time: int,
    ) -> wp.vec3: ...

    return evaluate


def _rows(width: int, resolution: int, hours: int) -> int:
    """Returns the rows of a strip: as many as the arrays of `matrix_decode.cuh` leave room for in shared memory."""
    own = 4 * packed_words(width) + 4 * (hours - 1) * 4 * _STEP * width // 8 + 2 * 128 * 16 + hours * 128 * 4
    volume = hours * 8 * (((_ROWS * resolution + 127) // 128 + 2) * resolution + _ROWS)
    return _ROWS if own + volume <= _SHARED else _ROWS // 2


def _decode_kernel(width: int, resolution: int, hours: int, rows: int) -> wp.Kernel:
    vec_hidden, vec_result = wp.types.vector(width, float), wp.types.vector(12, float)
    code = _native("matrix_network", "matrix_maps", "matrix_decode", H=width, R=resolution, ROWS=rows, HOURS=hours)

    @wp.func_native(on_cuda(code, "return wp::vec_t<12, float>();"))
    def forward(
        stored: Stored,
        packed: wp.array2d[wp.uint32],
        hidden: wp.array2d[vec_hidden],
        tau: float,
        encoding: wp.vec4,
        n: int,
        strip: int,
        part: int,
        hour: int,
    ) -> vec_result: ...

    @wp.kernel(module="unique", module_options={"enable_backward": False}, launch_bounds=_BOUNDS)
    def decode(
        # in:
        stored: Stored,
        packed: wp.array2d[wp.uint32],
        hidden: wp.array2d[vec_hidden],
        early: TimeState,
        late: TimeState,
        share: float,
        tiles: wp.array1d[int],
        # out:
        out: wp.array3d[wp.uint32],
    ):
        i, strip, x = wp.tid()
        n = tiles[i]
        # Of a warp's 32 columns, a thread gets the result of another one than it brought.
        lane = x % 32
        column = x - lane + 8 * (lane % 4) + lane // 4
        shift, spread = early.shift[n], early.spread[n]
        early_scale, late_scale = early.scale[n], late.scale[n]
        # Variables keep the loops rolled.
        parts = int(wp.static(rows // 4))
        count = int(wp.static(hours))
        for part in range(parts):
            total = vec_result()
            for hour in range(count):
                tau = wp.where(hour == 0, early.tau, late.tau)
                encoding = wp.where(hour == 0, early.encoding, late.encoding)
                weight = wp.where(hour == 0, 1.0 - share, share)
                scale = wp.where(hour == 0, early_scale, late_scale)
                y = forward(stored, packed, hidden, tau, encoding, n, strip, part, hour)
                for r in range(4):
                    answer = wp.vec3(y[3 * r], y[3 * r + 1], y[3 * r + 2])
                    light = wp.max(wp.cw_mul(shift + wp.cw_mul(spread, answer), scale), wp.vec3())
                    light = powers(light, early.gamma)
                    for c in range(3):
                        total[3 * r + c] += weight * light[c]
            for r in range(4):
                light = wp.vec3(total[3 * r], total[3 * r + 1], total[3 * r + 2])
                out[i, strip * wp.static(rows) + 4 * part + r, column] = pack_rgb9e5(light)

    return decode
