"""The network that turns sums of Gaussians into light probes, its loss and gradients (gaussian-probe-compression, eq. 7
and 8).

The network has L + 3 inputs (the summed latent vector and the position), two hidden layers of H units and D outputs,
the numbers of a probe. Its weights are one array: for each layer a row for every input, then the biases; a row of the
last layer is padded to a multiple of four numbers.

On CUDA a block of threads evaluates all layers for up to 64 probes in shared memory, on the matrix units, in CUDA C++
(`native/network.cuh`). On the CPU a thread evaluates one probe. Each block writes a partial gradient of the weights;
the partial gradients are added in a fixed order. The reference is `tests/reference/probe_network.py`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.native import native_source

THREADS = 256
_AT_ONCE = (64, 32, 16, 8)
_SHARED = 45 * 1024  # bytes of shared memory that a block has by default, less what Warp takes
CPU_LANES = 2


def padded(outputs: int) -> int:
    """Rounds the number of outputs up to a multiple of four, the length of a row of the last layer."""
    return -(-outputs // 4) * 4


def _eights(rows: int) -> int:
    return -(-rows // 8) * 8


def most_outputs(latent: int, hidden: int) -> int:
    """Returns the largest number of outputs with which the network fits in the shared memory of a CUDA block."""
    return _SHARED // (4 * _AT_ONCE[-1]) // 8 * 8 - _eights(latent + 4) - 2 * hidden


def probes_at_once(latent: int, hidden: int, outputs: int) -> int:
    """Returns how many probes, at most 64, a CUDA block can evaluate within its shared memory. With more outputs than
    `most_outputs`, the kernels only run on the CPU, where the result has no effect."""
    rows = _eights(latent + 4) + 2 * hidden + _eights(outputs)
    return next((p for p in _AT_ONCE if 4 * rows * p <= _SHARED), _AT_ONCE[-1])


@dataclass(frozen=True)
class NetworkKernels:
    """The kernels of the network for one size and one kind of device, "cpu" or "cuda". `probes` counts the probes of a
    block of threads on CUDA."""

    device_kind: str
    probes: int
    _kernel: Any

    def parts(self, probes: int) -> int:
        """Returns the number of partial gradients that a launch for `probes` probes writes."""
        return CPU_LANES if self.device_kind == "cpu" else probes // self.probes

    def load(self, device) -> None:
        """Compiles the kernel for a device, which would otherwise happen at the first launch."""
        wp.load_module(self._kernel.module, device, block_dim=THREADS)

    def launch(self, groups, f, target, weight, net, grad_f, partial, loss, base=0, count=None) -> None:
        """Computes the loss, the sum of weight * error^2 over all numbers of all probes, and its gradients.

        Args:
            groups: The N probes, `step.Groups`.
            f: float [S, L, N], the sum of Gaussians at each probe, as S partial sums.
            target: float [D, N], the numbers that each probe should have.
            weight: float [D], weight of each number in the loss.
            net: float [P], weights of the network.
            grad_f: float [L, N], written: gradient with respect to the sum of Gaussians.
            partial: float [B, P], B = `parts(N)`, partial gradients with respect to `net`: written on CUDA, added to on
                the CPU.
            loss: float [B], partial losses: written on CUDA, added to on the CPU.
            base, count: Index of the first probe and number of probes of this launch, on the CPU alone; default all.
        """
        probes = groups.x.shape[0]
        dims = (probes // self.probes, THREADS) if self.device_kind == "cuda" else count or probes
        inputs, outputs = [groups.x, groups.count, f, target, weight, net, base], [grad_f, partial, loss]
        wp.launch(self._kernel, dims, inputs=inputs, outputs=outputs, device=net.device, block_dim=THREADS)


@dataclass(frozen=True)
class CpuNetwork:
    """The `wp.func`s with which a CPU thread evaluates the network.

    Attributes:
        vec_in, vec_hidden, vec_out: Vector types of the inputs, of a hidden layer, and of the padded outputs.
        forward: (net, inputs) -> the units of both hidden layers, and the outputs.
        hidden_row, output_row: (net, at) -> the row of weights that begins at index `at`.
    """

    vec_in: Any
    vec_hidden: Any
    vec_out: Any
    forward: Any
    hidden_row: Any
    output_row: Any


@functools.cache
def cpu_network(latent: int, hidden: int, outputs: int) -> CpuNetwork:
    """Builds (once) the functions for one size of network; arguments as for `network_kernels`."""
    inputs, wide = latent + 3, padded(outputs)
    second = (inputs + 1) * hidden
    third = second + (hidden + 1) * hidden
    vec_in = wp.types.vector(inputs, float)
    vec_hidden = wp.types.vector(hidden, float)
    vec_out = wp.types.vector(wide, float)
    hidden_row, output_row = _row_of(vec_hidden, hidden), _row_of(vec_out, wide)

    @wp.func
    def forward(net: wp.array1d[float], v: vec_in):
        h1 = hidden_row(net, wp.static(inputs * hidden))
        for c in range(wp.static(inputs)):
            h1 += v[c] * hidden_row(net, c * wp.static(hidden))
        for j in range(wp.static(hidden)):
            h1[j] = 1.0 / (1.0 + wp.exp(-h1[j]))
        h2 = hidden_row(net, wp.static(second + hidden * hidden))
        for c in range(wp.static(hidden)):
            h2 += h1[c] * hidden_row(net, wp.static(second) + c * wp.static(hidden))
        for j in range(wp.static(hidden)):
            h2[j] = 1.0 / (1.0 + wp.exp(-h2[j]))
        y = output_row(net, wp.static(third + hidden * wide))
        for c in range(wp.static(hidden)):
            y += h2[c] * output_row(net, wp.static(third) + c * wp.static(wide))
        return h1, h2, y

    return CpuNetwork(vec_in, vec_hidden, vec_out, forward, hidden_row, output_row)


def _row_of(vec, n: int):
    @wp.func_native(f"""
    wp::vec_t<{n}, wp::float32> v;
    for (int c = 0; c < {n}; ++c) v.c[c] = net.data[at + c];
    return v;
    """)
    def row(net: wp.array1d[float], at: int) -> vec: ...

    return row


def _add_to(vec, n: int):
    @wp.func_native(f"""
    float* to = partial.data + size_t(lane) * partial.shape[1] + at;
    for (int c = 0; c < {n}; ++c) to[c] += factor * v.c[c];
    """)
    def add_row(partial: wp.array2d[float], lane: int, at: int, v: vec, factor: float): ...

    return add_row


@functools.cache
def network_kernels(latent: int, hidden: int, outputs: int, device_kind: str) -> NetworkKernels:
    """Builds (once) the kernels for one size of network.

    Args:
        latent: Length L of a latent vector, at least 1.
        hidden: Number H of units of a hidden layer, a multiple of 8.
        outputs: Numbers D of a probe, at least 1.
        device_kind: "cpu" or "cuda".
    """
    cuda = device_kind == "cuda"
    probes = probes_at_once(latent, hidden, outputs)
    inputs, wide = latent + 3, padded(outputs)
    second = (inputs + 1) * hidden
    third = second + (hidden + 1) * hidden
    net_of = cpu_network(latent, hidden, outputs)
    vec_in, vec_hidden, vec_out = net_of.vec_in, net_of.vec_hidden, net_of.vec_out
    forward, hidden_row, output_row = net_of.forward, net_of.hidden_row, net_of.output_row
    add_hidden, add_output = _add_to(vec_hidden, hidden), _add_to(vec_out, wide)

    sizes = {"L": latent, "H": hidden, "D": outputs, "DP": wide, "P": probes, "T": THREADS}
    sizes |= {"XR": _eights(inputs + 1), "ER": _eights(outputs)}

    @wp.func_native(native_source("wlm_kernels", "matrix_units") + native_source(__package__, "network", **sizes))
    def network(
        x: wp.array1d[wp.vec3],
        count: int,
        f: wp.array3d[float],
        target: wp.array2d[float],
        weight: wp.array1d[float],
        net: wp.array1d[float],
        grad_f: wp.array2d[float],
        partial: wp.array2d[float],
        loss: wp.array1d[float],
        block: int,
    ): ...

    options = {"enable_backward": False} | ({} if cuda else {"max_unroll": 1})

    @wp.kernel(module="unique", module_options=options, launch_bounds=(THREADS, 2) if cuda else None)
    def kernel(
        # in:
        x: wp.array1d[wp.vec3],
        count: int,
        f: wp.array3d[float],
        target: wp.array2d[float],
        weight: wp.array1d[float],
        net: wp.array1d[float],
        base: int,
        # out:
        grad_f: wp.array2d[float],
        partial: wp.array2d[float],
        loss: wp.array1d[float],
    ):
        if wp.static(cuda):
            block, _thread = wp.tid()
            network(x, count, f, target, weight, net, grad_f, partial, loss, block)
        else:
            i = base + wp.tid()
            lane = wp.where(base == 0, 0, 1)
            v = vec_in()
            for c in range(wp.static(latent)):
                v[c] = f[0, c, i]
            for c in range(3):
                v[wp.static(latent) + c] = x[i][c]
            h1, h2, y = forward(net, v)
            d3 = vec_out()
            error = float(0.0)
            if i < count:
                for j in range(wp.static(outputs)):
                    e = y[j] - target[j, i]
                    d = weight[j] * e
                    error += d * e
                    d3[j] = 2.0 * d
            loss[lane] = loss[lane] + error
            d2 = vec_hidden()
            for c in range(wp.static(hidden)):
                d2[c] = wp.dot(output_row(net, wp.static(third) + c * wp.static(wide)), d3) * h2[c] * (1.0 - h2[c])
                add_output(partial, lane, wp.static(third) + c * wp.static(wide), d3, h2[c])
            add_output(partial, lane, wp.static(third + hidden * wide), d3, 1.0)
            d1 = vec_hidden()
            for c in range(wp.static(hidden)):
                d1[c] = wp.dot(hidden_row(net, wp.static(second) + c * wp.static(hidden)), d2) * h1[c] * (1.0 - h1[c])
                add_hidden(partial, lane, wp.static(second) + c * wp.static(hidden), d2, h1[c])
            add_hidden(partial, lane, wp.static(second + hidden * hidden), d2, 1.0)
            for c in range(wp.static(inputs)):
                if c < wp.static(latent):
                    grad_f[c, i] = wp.dot(hidden_row(net, c * wp.static(hidden)), d1)
                add_hidden(partial, lane, c * wp.static(hidden), d1, v[c])
            add_hidden(partial, lane, wp.static(inputs * hidden), d1, 1.0)

    return NetworkKernels(device_kind, probes, kernel)
