"""Decodes whole tiles of a lightmap on a GPU's matrix units (tensor cores), for hidden widths that are multiples of 16.

A launch does everything: a block of threads decodes a strip of a tile, for which it reads F_uvt, F_ut and F_vt at one
hour, or at two between which it interpolates the radiance. A thread decodes the texels of a column.

Read first: `wlm_kernels.lightmap.matrix_network`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.lightmap.decode import Stored, TimeState
from wlm_kernels.lightmap.features import powers
from wlm_kernels.lightmap.matrix_network import STEP, native, packed_words
from wlm_kernels.native import native_source, on_cuda
from wlm_kernels.shared_exponent import pack_rgb9e5

_ROWS = 16  # of texels in a strip, or half as many
_SHARED = 48 << 10  # bytes of shared memory of a block
_BOUNDS = (128, 4)  # threads of a block, blocks of a multiprocessor: 128 registers per thread


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
    if hidden % STEP or hidden < STEP:
        raise ValueError(f"hidden: expected a width that is a multiple of {STEP} units, got {hidden}")
    rows = tuple(_rows(hidden, resolution, hours) for hours in (1, 2))
    return MatrixKernels(*(_decode_kernel(hidden, resolution, 1 + i, rows[i]) for i in range(2)), rows)


def _rows(width: int, resolution: int, hours: int) -> int:
    """Returns the rows of a strip: as many as the arrays of `matrix_tiles.cuh` leave room for in shared memory."""
    own = 4 * packed_words(width) + 4 * (hours - 1) * 4 * STEP * width // 8 + 2 * 128 * 16 + hours * 128 * 4
    volume = hours * 8 * (((_ROWS * resolution + 127) // 128 + 2) * resolution + _ROWS)
    return _ROWS if own + volume <= _SHARED else _ROWS // 2


def _decode_kernel(width: int, resolution: int, hours: int, rows: int) -> wp.Kernel:
    vec_hidden, vec_result = wp.types.vector(width, float), wp.types.vector(12, float)
    shapes = {"H": width, "R": resolution, "ROWS": rows, "HOURS": hours}
    code = native("matrix_network", "matrix_maps", **shapes) + native_source("benchmarks", "matrix_tiles")

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
