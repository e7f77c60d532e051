"""Decodes light at points: sums Gaussians and evaluates a network in one launch (gaussian-probe-compression, eq. 5-7).

Points may lie in several regions, each with Gaussians and a network of its own. A block of threads then decodes the
regions of its points one after another, so points are best sorted by region.

On CUDA a block of 128 threads decodes up to 64 points: several threads share the Gaussians that a point's cube lists,
their sums are added in shared memory, and the network runs on all points together (`native/layers.cuh`, then
`native/decode.cuh`). On the CPU a thread decodes one point. The reference is `benchmarks/probe_exact.py`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.native import native_source
from wlm_kernels.probe.cubes import Cubes, cube_of
from wlm_kernels.probe.gaussians import Shape, functions
from wlm_kernels.probe.network import THREADS, cpu_network, layer_code, probes_at_once

_NONE = wp.constant(1 << 30)


@wp.struct
class Region:
    """What decodes the points of a region; the attributes are those of `DecodeKernels.launch`, `net` is empty if the
    region is not in memory, and `gain` then stands for each of the light's numbers."""

    rows: wp.array2d[float]
    shapes: wp.array1d[Shape]
    cubes: Cubes
    net: wp.array1d[float]
    gain: float


@dataclass(frozen=True)
class DecodeKernels:
    """The kernel that decodes light at points, for one size of network and one kind of device.

    Attributes:
        device_kind: "cpu" or "cuda".
        points: Points per block of threads on CUDA.
    """

    device_kind: str
    points: int
    _kernel: Any
    _regional: Any

    def launch(self, rows, shapes, cubes, cut, net, gain, x, out) -> None:
        """Decodes the light at M points, D numbers (light coefficients) for each.

        Args:
            rows: float [K, 10 + L], parameters of the K Gaussians, see `gaussians`.
            shapes: Shape [K], made from the rows with this cut.
            cubes: `cubes.Cubes` of the shapes; points outside use the list of the nearest cube.
            cut: Radius of a support in standard deviations.
            net: float [P], weights of the network, see `network`.
            gain: Factor by which the network's outputs are multiplied.
            x: vec3 [M], the points in normalised coordinates.
            out: float [M, D], the light at the points, written.
        """
        inputs = [rows, shapes, cubes, cut, net, gain, x]
        wp.launch(self._kernel, self._dims(x), inputs=inputs, outputs=[out], device=x.device, block_dim=THREADS)

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
        inputs, outputs = [table, region, cut, x], [asked, out]
        wp.launch(self._regional, self._dims(x), inputs=inputs, outputs=outputs, device=x.device, block_dim=THREADS)

    def _dims(self, x) -> tuple[int, ...]:
        return (-(-x.shape[0] // self.points), THREADS) if self.device_kind == "cuda" else x.shape


@functools.cache
def decode_kernels(
    latent: int, hidden: int, outputs: int, relative: bool, ambient: int, device_kind: str
) -> DecodeKernels:
    """Builds the kernel for one size of network; later calls return the same kernel.

    Args:
        latent: Length L of a latent vector, at least 1.
        hidden: Units of a hidden layer, H, a multiple of 8.
        outputs: Numbers D at a point, at least 1.
        relative: Whether the network has an output y_D for the magnitude; exp(min(y_D, 0)) multiplies the others.
        ambient: Number of the first numbers that are clamped at 0.
        device_kind: "cpu" or "cuda".
    """
    fn = functions(latent)
    add, vec_latent = fn.add, fn.vec_latent
    columns = outputs + relative
    points = probes_at_once(latent, hidden, columns)
    cuda = device_kind == "cuda"
    options = {"enable_backward": False, "max_unroll": 32 if cuda else 1}
    network = cpu_network(latent, hidden, columns)
    forward, vec_in = network.forward, network.vec_in
    code = layer_code(latent, hidden, columns, points)
    finish = _finish(code + native_source(__package__, "decode", OUT=outputs, AMBIENT=ambient), vec_latent)

    @wp.func
    def sum_at(
        rows: wp.array2d[float],
        shapes: wp.array1d[Shape],
        cubes: Cubes,
        cut: float,
        x: wp.vec3,
        first: int,
        stride: int,
    ) -> vec_latent:
        cube = cube_of(cubes, x)
        f = vec_latent()
        end = cubes.start[cube + 1]
        i = cubes.start[cube] + first
        if i < end:
            k = cubes.item[i]
            shape = shapes[k]
            while i < end:
                i += stride
                # The next Gaussian is loaded while this one is summed.
                next_k = cubes.item[wp.min(i, end - 1)]
                next_shape = shapes[next_k]
                f = add(f, shape, rows, k, x, cut)
                k = next_k
                shape = next_shape
        return f

    @wp.func
    def next_region(region: wp.array1d[int], first: int, after: int) -> int:
        """Returns the lowest region above `after` among the points of a block; a large number if there is none."""
        found = int(_NONE)
        for j in range(first, wp.min(first + wp.static(points), region.shape[0])):
            r = region[j]
            if r > after:
                found = wp.min(found, r)
        return found

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
        f = sum_at(rows, shapes, cubes, cut, x, 0, 1)
        v = vec_in()
        for c in range(wp.static(latent)):
            v[c] = f[c]
        for c in range(3):
            v[wp.static(latent) + c] = x[c]
        _h1, _h2, y = forward(net, v)
        light = float(gain)
        if wp.static(relative):
            light *= wp.exp(wp.min(y[wp.static(columns - 1)], 0.0))
        for c in range(wp.static(outputs)):
            value = light * y[c]
            if c < wp.static(ambient):
                value = wp.max(value, 0.0)
            out[i, c] = value

    @wp.kernel(module="unique", module_options=options)
    def kernel(
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
        if wp.static(cuda):
            block, t = wp.tid()
            # Threads past the end repeat the last point, since all threads of a block must synchronise.
            i = wp.min(block * wp.static(points) + t % wp.static(points), x.shape[0] - 1)
            f = sum_at(rows, shapes, cubes, cut, x[i], t // wp.static(points), wp.static(THREADS // points))
            finish(f, x[i], net, gain, block, x.shape[0], cubes.item, -1, out)
        else:
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
        if wp.static(cuda):
            block, t = wp.tid()
            i = wp.min(block * wp.static(points) + t % wp.static(points), x.shape[0] - 1)
            r = next_region(region, block * wp.static(points), -1)
            while r < table.shape[0]:
                if t == 0:
                    asked[r] = 1
                own = table[r]
                if own.net.shape[0] > 0:
                    f = sum_at(
                        own.rows, own.shapes, own.cubes, cut, x[i], t // wp.static(points), wp.static(THREADS // points)
                    )
                    finish(f, x[i], own.net, own.gain, block, x.shape[0], region, r, out)
                elif region[i] == r and t < wp.static(points):
                    for c in range(wp.static(outputs)):
                        out[i, c] = own.gain
                r = next_region(region, block * wp.static(points), r)
        else:
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

    return DecodeKernels(device_kind, points, kernel, regional)


def _finish(code: str, vec_latent):
    @wp.func_native(code)
    def finish(
        f: vec_latent,
        x: wp.vec3,
        net: wp.array1d[float],
        gain: float,
        block: int,
        count: int,
        region: wp.array1d[int],
        own: int,
        out: wp.array2d[float],
    ): ...

    return finish
