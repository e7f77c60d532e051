"""Decodes light at points: sums Gaussians and evaluates a network in one launch (gaussian-probe-compression, eq. 5-7).

Points may lie in several regions, each with Gaussians and a network of its own. A block of threads then decodes the
regions of its points one after another, so points are best sorted by region.

On CUDA a block of 128 threads decodes 32 points after another: four threads share the Gaussians that a point's cube
lists, and the network of 16 points is evaluated together on the matrix units (`native/decode.cuh`), from arrays that
`DecodeKernels.pack` arranges. Of very many points it decodes up to 128, so that a warp loads the same Gaussians for all
of its points where these are sorted by cube. On the CPU a thread decodes one point. The reference is
`benchmarks/probe_exact.py`.
"""

import functools
from collections.abc import Mapping
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
_MANY = (128, 64)  # of a block that has turns: the most whose inputs fit in shared memory beside the network
_SHARED, _KEPT = 46 * 1024, 8192  # bytes of shared memory, and most words of a network that a block keeps there
_BLOCKS = 1056  # most blocks of a launch, which take turns


@wp.struct
class Region:
    """The model of a region on the device; the attributes are those of `DecodeKernels.launch`, `net` is empty if the
    region is not in memory, and `gain` then stands for each of the light's numbers."""

    rows: wp.array2d[float]
    shapes: wp.array1d[Shape]
    cubes: Cubes
    net: wp.array1d[float]
    gain: float


@dataclass(frozen=True)
class DecodeKernels:
    """The kernels that decode light at points, for one size of network and one kind of device, "cpu" or "cuda". `words`
    is the length of the network that `pack` arranges for CUDA."""

    device_kind: str
    words: int
    _kernels: Mapping[int, tuple[Any, Any]]  # by the points of a block: for one model, and for regions
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
        self._launch(0, x, [rows, shapes, cubes, cut, net, gain, x], [out])

    def launch_regions(self, table, region, cut, x, asked, out) -> None:
        """Decodes the light at M points in several of R regions.

        Args:
            table: Region [R].
            region: int [M], region of each point; negative: no light is written.
            cut: As for `launch`.
            x: vec3 [M], the points in the normalised coordinates of their regions.
            asked: int [R], set to 1 for each region that has a point.
            out: float [M, D], the light at the points, written.
        """
        self._launch(1, x, [table, region, cut, x], [asked, out])

    def _launch(self, kind: int, x, inputs: list, outputs: list) -> None:
        points = (min if x.shape[0] <= _BLOCKS * _POINTS else max)(self._kernels)
        blocks = min(-(-x.shape[0] // points), _BLOCKS)
        dims = (blocks, _THREADS) if self.device_kind == "cuda" else x.shape
        kernel = self._kernels[points][kind]
        wp.launch(kernel, dims, inputs=inputs, outputs=outputs, device=x.device, block_dim=_THREADS)


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
        kernels = {_POINTS: _cpu_kernels(latent, hidden, columns, outputs, ambient)}
        return DecodeKernels(device_kind, 0, kernels, None)
    sizes = {"L": latent, "H": hidden, "D": columns, "OUT": outputs, "AMBIENT": ambient}
    layout = native_source(__package__, "decode_layout", **sizes)
    words = _words(latent, hidden, columns)
    kept, row = 4 * words if words <= _KEPT else 0, 64 * -(-(latent + 3) // 16) + 32
    many = next((points for points in _MANY if kept + points * row <= _SHARED), _POINTS)
    kernels = {points: _cuda_kernels(layout, points) for points in {_POINTS, many}}
    return DecodeKernels(device_kind, words, kernels, _pack_kernel(layout))


def _cpu_kernels(latent: int, hidden: int, columns: int, outputs: int, ambient: int) -> tuple[Any, Any]:
    fn, network = functions(latent), cpu_network(latent, hidden, columns)
    add, vec_latent, forward, vec_in = fn.add, fn.vec_latent, network.forward, network.vec_in
    options = {"enable_backward": False, "max_unroll": 1}

    @wp.func
    def decode_at(
        rows: wp.array2d[float],
        shapes: wp.array1d[Shape],
        cubes: Cubes,
        cut: float,
        net: wp.array1d[float],
        gain: float,
        x: wp.vec3,
        out: wp.array2d[float],
        i: int,
    ):
        cube = cube_of(cubes, x)
        f = vec_latent()
        for j in range(cubes.start[cube], cubes.start[cube + 1]):
            k = cubes.item[j]
            f = add(f, shapes[k], rows, k, x, cut)
        v = vec_in()
        for c in range(wp.static(latent)):
            v[c] = f[c]
        for c in range(3):
            v[wp.static(latent) + c] = x[c]
        _h1, _h2, y = forward(net, v)
        light = float(gain)
        if wp.static(columns > outputs):
            light *= wp.exp(wp.min(y[wp.static(columns - 1)], 0.0))
        for c in range(wp.static(outputs)):
            value = light * y[c]
            if c < wp.static(ambient):
                value = wp.max(value, 0.0)
            out[i, c] = value

    @wp.kernel(module="unique", module_options=options)
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
        decode_at(rows, shapes, cubes, cut, net, gain, x[i], out, i)

    @wp.kernel(module="unique", module_options=options)
    def regional(
        # in:
        table: wp.array1d[Region],
        region: wp.array1d[int],
        cut: float,
        x: wp.array1d[wp.vec3],
        # out:
        asked: wp.array1d[int],
        out: wp.array2d[float],
    ):
        i = wp.tid()
        r = region[i]
        if r >= 0:
            asked[r] = 1
            own = table[r]
            if own.net.shape[0] > 0:
                decode_at(own.rows, own.shapes, own.cubes, cut, own.net, own.gain, x[i], out, i)
            else:
                for c in range(wp.static(outputs)):
                    out[i, c] = own.gain

    return decode, regional


def _cuda_kernels(layout: str, points: int) -> tuple[Any, Any]:
    """Builds the kernels of which a block decodes so many points after another, of one model and of regions."""
    code = layout + native_source(__package__, "decode", T=_THREADS, P=points, MOST_KEPT=_KEPT)
    options, share = {"enable_backward": False}, _THREADS // points

    @wp.func_native(native_source("wlm_kernels", "matrix_units") + code)
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
        region: wp.array1d[int],
        own: int,
        out: wp.array2d[float],
    ): ...

    @wp.func_native(f"""
    int lowest = 1 << 30;
    for (int i = first + threadIdx.x % 32; i < min(first + {points}, region.shape[0]); i += 32)
        if (region.data[i] > after) lowest = min(lowest, region.data[i]);
    return __reduce_min_sync(~0u, lowest);
    """)
    def next_region(region: wp.array1d[int], first: int, after: int) -> int:
        """Returns the lowest region above `after` among the points of a block; a large number if there is none."""

    @wp.kernel(module="unique", module_options=options)
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
        count = x.shape[0]
        while block * wp.static(points) < count:
            # Threads past the end repeat the last point, since all threads of a block must synchronise.
            at = x[wp.min(block * wp.static(points) + t // share, count - 1)]
            cube = cube_of(cubes, at)
            begin = cubes.start[cube]
            end = cubes.start[cube + 1]
            k = shapes.shape[0]
            decode_block(rows, k, cubes.item, begin, end, cut, net, gain, at, block, fresh, count, cubes.item, -1, out)
            fresh = 0
            block += _BLOCKS

    @wp.kernel(module="unique", module_options=options)
    def regional(
        # in:
        table: wp.array1d[Region],
        region: wp.array1d[int],
        cut: float,
        x: wp.array1d[wp.vec3],
        # out:
        asked: wp.array1d[int],
        out: wp.array2d[float],
    ):
        block, t = wp.tid()
        count = x.shape[0]
        # A block decodes neighbouring points, most of which are in the region whose network it has.
        pieces = (count + wp.static(points - 1)) // wp.static(points)
        blocks = wp.min(pieces, _BLOCKS)
        piece = block * (pieces // blocks) + wp.min(block, pieces % blocks)
        end = (block + 1) * (pieces // blocks) + wp.min(block + 1, pieces % blocks)
        kept = int(-1)
        while piece < end:
            first = piece * wp.static(points)
            i = wp.min(first + t // share, count - 1)
            r = next_region(region, first, -1)
            while r < table.shape[0]:
                if t == 0:
                    asked[r] = 1
                own = table[r]
                if own.net.shape[0] > 0:
                    cube = cube_of(own.cubes, x[i])
                    begin = own.cubes.start[cube]
                    until = own.cubes.start[cube + 1]
                    k = own.shapes.shape[0]
                    item = own.cubes.item
                    new = wp.where(r == kept, 0, 1)
                    decode_block(
                        own.rows, k, item, begin, until, cut, own.net, own.gain, x[i], piece, new, count, region, r, out
                    )
                    kept = r
                elif region[i] == r and t % share == 0:
                    for c in range(out.shape[1]):
                        out[i, c] = own.gain
                r = next_region(region, first, r)
            piece += 1

    return decode, regional


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
