"""Decodes light at points: sums Gaussians and evaluates a network in one launch (gaussian-probe-compression, eq. 5-7).

On CUDA a block of 128 threads decodes 32 points after another: four threads share the Gaussians that a point's cube
lists, and the network of 16 points is evaluated together on the matrix units (`native/decode.cuh`), from arrays that
`DecodeKernels.pack` arranges. On the CPU a thread decodes one point. The reference is `benchmarks/probe_exact.py`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wlm_kernels.native import native_source
from wlm_kernels.probe.cubes import Cubes, cube_of
from wlm_kernels.probe.gaussians import LATENT, Shape, functions
from wlm_kernels.probe.network import cpu_network

_THREADS = 128
_POINTS = 32  # of a block of threads on CUDA
_BLOCKS = 1056  # most blocks of a launch, which take turns


@dataclass(frozen=True)
class DecodeKernels:
    """The kernels that decode light at points, for one size of network and one kind of device.

    Attributes:
        device_kind: "cpu" or "cuda".
        words: Length of the network that `pack` arranges for CUDA.
    """

    device_kind: str
    words: int
    _kernel: Any
    _pack: Any

    def pack(self, rows, shapes, net):
        """Arranges Gaussians and a network as `launch` takes them: in new arrays on CUDA, unchanged on the CPU.

        Args:
            rows: float [K, 10 + L], parameters of the K Gaussians, see `gaussians`.
            shapes: Shape [K], made from the rows.
            net: float [P], weights of the network, see `network`; on CUDA those of the hidden layers are rounded to
                half floats, as files hold them.

        Returns:
            The arrays `rows` and `net` of `launch`.
        """
        if self.device_kind == "cpu":
            return rows, net
        shape, latent = shapes.numpy(), rows.numpy()[:, LATENT:]
        parts = shape["centre"], shape["radius"], shape["whiten"], shape["slender"], latent
        record = np.concatenate([part.reshape(len(latent), -1) for part in parts], 1)
        record = np.pad(record, ((0, 0), (0, -record.shape[1] % 4)))
        # The rests of W follow behind all Gaussians, in twelve numbers each.
        rest = np.pad(shape["rest"].reshape(len(latent), 9), ((0, 0), (0, 3))).ravel()
        rest = np.pad(rest, (0, -len(rest) % record.shape[1])).reshape(-1, record.shape[1])
        packed = wp.empty(self.words, dtype=float, device=net.device)
        self.pack_network(net, packed)
        return wp.array(np.concatenate([record, rest]), dtype=float, device=net.device), packed

    def pack_network(self, net, packed) -> None:
        """Arranges a network again, after its weights changed; arguments as `pack` takes and returns them. On the CPU
        there is nothing to do."""
        if self.device_kind == "cuda":
            wp.launch(self._pack, self.words, inputs=[net], outputs=[packed], device=net.device)

    def launch(self, rows, shapes, cubes, cut, net, gain, x, out) -> None:
        """Decodes the light at M points, D numbers (light coefficients) for each.

        Args:
            rows, net: The result of `pack`.
            shapes: Shape [K], made from the rows with this cut.
            cubes: `cubes.Cubes` of the shapes; points outside use the list of the nearest cube.
            cut: Radius of a support in standard deviations.
            gain: Factor by which the network's outputs are multiplied.
            x: vec3 [M], the points in normalised coordinates.
            out: float [M, D], the light at the points, written.
        """
        count = x.shape[0]
        dims = (min(-(-count // _POINTS), _BLOCKS), _THREADS) if self.device_kind == "cuda" else count
        inputs = [rows, shapes, cubes, cut, net, gain, x]
        wp.launch(self._kernel, dims, inputs=inputs, outputs=[out], device=x.device, block_dim=_THREADS)


@functools.cache
def decode_kernels(
    latent: int, hidden: int, outputs: int, relative: bool, ambient: int, device_kind: str
) -> DecodeKernels:
    """Builds the kernels for one size of network; later calls return the same kernels.

    Args:
        latent: Length L of a latent vector, at least 1.
        hidden: Units of a hidden layer, H, a multiple of 8.
        outputs: Numbers D at a point, at least 1.
        relative: Whether the network has an output y_D for the magnitude; exp(min(y_D, 0)) multiplies the others.
        ambient: Number of the first numbers that are clamped at 0.
        device_kind: "cpu" or "cuda".
    """
    columns = outputs + relative
    if device_kind == "cpu":
        return DecodeKernels(device_kind, 0, _cpu_kernel(latent, hidden, columns, outputs, ambient), None)
    sizes = {"L": latent, "H": hidden, "D": columns, "OUT": outputs, "AMBIENT": ambient}
    layout = native_source(__package__, "decode_layout", **sizes)
    return DecodeKernels(device_kind, _words(latent, hidden, columns), _cuda_kernel(layout), _pack_kernel(layout))


def _cpu_kernel(latent: int, hidden: int, columns: int, outputs: int, ambient: int) -> Any:
    fn, network = functions(latent), cpu_network(latent, hidden, columns)
    add, vec_latent, forward, vec_in = fn.add, fn.vec_latent, network.forward, network.vec_in

    @wp.kernel(module="unique", module_options={"enable_backward": False, "max_unroll": 1})
    def decode(
        # in:
        rows: wp.array2d[float],
        shapes: wp.array1d[Shape],
        cubes: Cubes,
        cut: float,
        net: wp.array1d[float],
        gain: float,
        x: wp.array1d[wp.vec3],
        # out:
        out: wp.array2d[float],
    ):
        i = wp.tid()
        cube = cube_of(cubes, x[i])
        f = vec_latent()
        for j in range(cubes.start[cube], cubes.start[cube + 1]):
            k = cubes.item[j]
            f = add(f, shapes[k], rows, k, x[i], cut)
        v = vec_in()
        for c in range(wp.static(latent)):
            v[c] = f[c]
        for c in range(3):
            v[wp.static(latent) + c] = x[i][c]
        _h1, _h2, y = forward(net, v)
        light = float(gain)
        if wp.static(columns > outputs):
            light *= wp.exp(wp.min(y[wp.static(columns - 1)], 0.0))
        for c in range(wp.static(outputs)):
            value = light * y[c]
            if c < wp.static(ambient):
                value = wp.max(value, 0.0)
            out[i, c] = value

    return decode


def _cuda_kernel(layout: str) -> Any:
    constants = {"T": _THREADS, "P": _POINTS}
    units = native_source("wlm_kernels", "matrix_units")

    @wp.func_native(units + layout + native_source(__package__, "decode", **constants))
    def decode_block(
        rows: wp.array2d[float],
        count: int,
        items: wp.array1d[int],
        begin: int,
        end: int,
        cut: float,
        net: wp.array1d[float],
        gain: float,
        x: wp.vec3,
        block: int,
        fresh: int,
        points: int,
        out: wp.array2d[float],
    ): ...

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def decode(
        # in:
        rows: wp.array2d[float],
        shapes: wp.array1d[Shape],
        cubes: Cubes,
        cut: float,
        net: wp.array1d[float],
        gain: float,
        x: wp.array1d[wp.vec3],
        # out:
        out: wp.array2d[float],
    ):
        block, t = wp.tid()
        fresh = int(1)
        while block * wp.static(_POINTS) < x.shape[0]:
            # Threads past the end repeat the last point, since all threads of a block must synchronise.
            at = x[wp.min(block * wp.static(_POINTS) + t // wp.static(_THREADS // _POINTS), x.shape[0] - 1)]
            cube = cube_of(cubes, at)
            begin = cubes.start[cube]
            end = cubes.start[cube + 1]
            count = shapes.shape[0]
            decode_block(rows, count, cubes.item, begin, end, cut, net, gain, at, block, fresh, x.shape[0], out)
            fresh = 0
            block += _BLOCKS

    return decode


def _words(latent: int, hidden: int, columns: int) -> int:
    """Returns the length of a packed network; see `native/decode_layout.cuh`."""
    inputs, units, last = -(-(latent + 3) // 16), -(-hidden // 16), -(-columns // 8)
    return 128 * units * (inputs + units + last) + 32 * units + 8 * last


def _pack_kernel(layout: str) -> Any:
    @wp.func_native(layout + native_source(__package__, "decode_pack"))
    def word(net: wp.array1d[float], m: int) -> float: ...

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def pack(
        # in:
        net: wp.array1d[float],
        # out:
        packed: wp.array1d[float],
    ):
        m = wp.tid()
        packed[m] = word(net, m)

    return pack
