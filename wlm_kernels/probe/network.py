"""The probes' network there and back (gaussian-probe-compression, eq. 7 and 8): loss, and every gradient.

L + 3 inputs, two hidden layers of H units, D outputs. Its weights are one array: for each layer a row for every
input, then the biases; a row of the last layer is padded to a multiple of four numbers.

On CUDA a block of threads takes up to 64 probes through all layers in shared memory, each thread a piece of 4 probes by
8 units at a time: fourteen small matrix products, for which one thread a probe would spill its registers. On the CPU a
thread takes a probe. Parts of the weights' gradients are written by block, to be added in a fixed order.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

__all__ = [
    "CPU_LANES",
    "THREADS",
    "NetworkKernels",
    "cpu_network",
    "layer_code",
    "network_kernels",
    "padded",
    "probes_at_once",
]

THREADS = 128
_SHARED = 47 * 1024  # bytes of shared memory that a block can have without asking for more
CPU_LANES = 2


def padded(outputs: int) -> int:
    """Numbers in a row of the last layer."""
    return -(-outputs // 4) * 4


def probes_at_once(latent: int, hidden: int, outputs: int) -> int:
    """Probes that a block of threads takes on CUDA: as many as fit its shared memory, 64 at most."""
    rows = latent + 3 + 2 * hidden + padded(outputs)
    return next(p for p in (64, 32, 16, 8, 4) if rows * (p + 4) * 4 <= _SHARED)


def layer_code(latent: int, hidden: int, outputs: int, probes: int) -> str:
    """CUDA code for the forward pass of a block of ``THREADS`` threads, for the beginning of a native function.

    It declares the sizes, the rows X (inputs), A and B (hidden layers) and E (outputs) of P probes in shared memory,
    and ``forward(in, rows, weights, out)``, a hidden layer, and ``last(in, weights, put)``, which hands every output
    c of probe p to ``put(c, p, value)``. The caller fills X and synchronises.
    """
    inputs, wide = latent + 3, padded(outputs)
    return f"""
    constexpr int L = {latent}, I = {inputs}, H = {hidden}, D = {outputs}, DP = {wide}, T = {THREADS};
    constexpr int SECOND = (I + 1) * H, THIRD = SECOND + (H + 1) * H, SIZE = THIRD + (H + 1) * DP;
    constexpr int P = {probes}, LD = P + 4;  // rows of P probes, a bank apart
    constexpr int Q = P / 4;                 // pieces along the probes
    __shared__ __align__(16) float X[I * LD], A[H * LD], B[H * LD], E[DP * LD];
    auto four = [](const float* p) {{ return *reinterpret_cast<const float4*>(p); }};
    auto forward = [&](const float* in, int rows, const float* w, float* out) {{
        for (int tile = threadIdx.x; tile < Q * (H / 8); tile += T) {{
            const int p = tile % Q * 4, j = tile / Q * 8;
            float sum[8][4];
            #pragma unroll
            for (int v = 0; v < 8; ++v)
                #pragma unroll
                for (int u = 0; u < 4; ++u) sum[v][u] = w[rows * H + j + v];
            #pragma unroll 4
            for (int i = 0; i < rows; ++i) {{
                const float4 a = four(in + i * LD + p), b = four(w + i * H + j), c = four(w + i * H + j + 4);
                const float left[4] = {{a.x, a.y, a.z, a.w}}, right[8] = {{b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w}};
                #pragma unroll
                for (int v = 0; v < 8; ++v)
                    #pragma unroll
                    for (int u = 0; u < 4; ++u) sum[v][u] += left[u] * right[v];
            }}
            #pragma unroll
            for (int v = 0; v < 8; ++v)
                #pragma unroll
                for (int u = 0; u < 4; ++u) out[(j + v) * LD + p + u] = 1.0f / (1.0f + __expf(-sum[v][u]));
        }}
        __syncthreads();
    }};
    auto last = [&](const float* in, const float* w, auto put) {{
        for (int tile = threadIdx.x; tile < Q * (DP / 4); tile += T) {{
            const int p = tile % Q * 4, j = tile / Q * 4;
            float sum[4][4];
            #pragma unroll
            for (int v = 0; v < 4; ++v)
                #pragma unroll
                for (int u = 0; u < 4; ++u) sum[v][u] = w[H * DP + j + v];
            #pragma unroll 4
            for (int i = 0; i < H; ++i) {{
                const float4 a = four(in + i * LD + p), b = four(w + i * DP + j);
                const float left[4] = {{a.x, a.y, a.z, a.w}}, right[4] = {{b.x, b.y, b.z, b.w}};
                #pragma unroll
                for (int v = 0; v < 4; ++v)
                    #pragma unroll
                    for (int u = 0; u < 4; ++u) sum[v][u] += left[u] * right[v];
            }}
            #pragma unroll
            for (int v = 0; v < 4; ++v)
                #pragma unroll
                for (int u = 0; u < 4; ++u) put(j + v, p + u, sum[v][u]);
        }}
    }};
    """


@dataclass(frozen=True)
class NetworkKernels:
    """The network of one shape on one kind of device.

    Attributes:
        latent: L.
        hidden: H, units of both hidden layers.
        outputs: D.
        device_kind: "cpu" or "cuda".
        probes: Probes that a block of threads takes on CUDA.
    """

    latent: int
    hidden: int
    outputs: int
    device_kind: str
    probes: int
    _kernel: Any

    @property
    def size(self) -> int:
        """Numbers in the weights' array."""
        return (self.latent + 4) * self.hidden + (self.hidden + 1) * (self.hidden + padded(self.outputs))

    def parts(self, probes: int) -> int:
        """Parts of the gradient that a launch over so many probes writes."""
        return CPU_LANES if self.device_kind == "cpu" else probes // self.probes

    def load(self, device) -> None:
        """Compiles it for a device now."""
        self._kernel.module.load(wp.get_device(device))

    def launch(self, groups, f, target, weight, net, grad_f, partial, loss, base=0, count=None) -> None:
        """The loss, sum over live probes and numbers of weight * error^2, and its gradients.

        Args:
            groups: ``probe_step.Groups``.
            f: float [S, L, N], the Gaussians' sums in S parts.
            target: float [D, N].
            weight: float [D].
            net: float [P].
            grad_f: float [L, N], written.
            partial: float [B, P], B = ``parts(N)``: written on CUDA, added to on the CPU.
            loss: float [B], likewise.
            base, count: On the CPU, the probes from ``base`` on; one lane has base 0.
        """
        probes = groups.x.shape[0]
        if self.device_kind == "cuda":
            dims = (probes // self.probes, THREADS)
        else:
            dims = probes if count is None else count
        wp.launch(
            self._kernel,
            dims,
            inputs=[groups.x, groups.count, f, target, weight, net, base],
            outputs=[grad_f, partial, loss],
            device=net.device,
            block_dim=THREADS,
        )


@functools.cache
def network_kernels(latent: int, hidden: int, outputs: int, device_kind: str) -> NetworkKernels:
    """Builds (once) the network.

    Args:
        latent: L >= 1.
        hidden: H, a multiple of 8.
        outputs: D >= 1.
        device_kind: "cpu" or "cuda".
    """
    options = {"enable_backward": False}
    probes = probes_at_once(latent, hidden, outputs)
    snippet = f"""
    {layer_code(latent, hidden, outputs, probes)}
    const int t = threadIdx.x;
    const int first = block * P, n = x.shape[0];
    const float* w1 = net.data, *w2 = w1 + SECOND, *w3 = w1 + THIRD;
    float* part = partial.data + size_t(block) * SIZE;

    for (int m = t; m < I * P; m += T) {{
        const int c = m / P, p = m % P;
        float v = 0.0f;
        if (c < L) for (int s = 0; s < f.shape[0]; ++s) v += f.data[(size_t(s) * L + c) * n + first + p];
        else v = x.data[first + p][c - L];
        X[c * LD + p] = v;
    }}
    __syncthreads();
    // The delta before a layer from the one behind it, in place of the layer's input.
    auto back = [&](const float* d, int count, const float* w, float* out) {{
        for (int tile = t; tile < Q * (H / 8); tile += T) {{
            const int p = tile % Q * 4, i = tile / Q * 8;
            float sum[8][4] = {{}};
            for (int j = 0; j < count; j += 4) {{
                float right[4][4];
                #pragma unroll
                for (int s = 0; s < 4; ++s) {{
                    const float4 a = four(d + (j + s) * LD + p);
                    right[s][0] = a.x; right[s][1] = a.y; right[s][2] = a.z; right[s][3] = a.w;
                }}
                #pragma unroll
                for (int v = 0; v < 8; ++v) {{
                    const float4 b = four(w + (i + v) * count + j);
                    #pragma unroll
                    for (int u = 0; u < 4; ++u)
                        sum[v][u] += b.x * right[0][u] + b.y * right[1][u] + b.z * right[2][u] + b.w * right[3][u];
                }}
            }}
            #pragma unroll
            for (int v = 0; v < 8; ++v)
                #pragma unroll
                for (int u = 0; u < 4; ++u) {{
                    float& h = out[(i + v) * LD + p + u];
                    h = sum[v][u] * h * (1.0f - h);
                }}
        }}
        __syncthreads();
    }};
    // The gradient of a layer's weights, rows of inputs times units, and of its biases.
    auto outer = [&](const float* in, int rows, auto tall, const float* d, int count, float* out) {{
        constexpr int R = sizeof(*tall);
        const int down = rows / R, across = count / 4;
        for (int tile = t; tile < down * across; tile += T) {{
            // Rows a thread apart lie in different banks.
            const int i = tile % down, j = tile / down;
            float sum[R][4] = {{}};
            #pragma unroll 2
            for (int p = 0; p < P; p += 4) {{
                float4 right[4];
                #pragma unroll
                for (int v = 0; v < 4; ++v) right[v] = four(d + (j + v * across) * LD + p);
                #pragma unroll
                for (int u = 0; u < R; ++u) {{
                    const float4 a = four(in + (i + u * down) * LD + p);
                    #pragma unroll
                    for (int v = 0; v < 4; ++v)
                        sum[u][v] += a.x * right[v].x + a.y * right[v].y + a.z * right[v].z + a.w * right[v].w;
                }}
            }}
            #pragma unroll
            for (int u = 0; u < R; ++u)
                #pragma unroll
                for (int v = 0; v < 4; ++v) out[(i + u * down) * count + j + v * across] = sum[u][v];
        }}
        for (int j = t; j < count; j += T) {{
            float sum = 0.0f;
            for (int p = 0; p < P; p += 4) {{
                const float4 a = four(d + j * LD + p);
                sum += (a.x + a.y) + (a.z + a.w);
            }}
            out[rows * count + j] = sum;
        }}
        __syncthreads();
    }};
    // Rows that a thread takes, as the size of an array, for a lambda's argument can carry no number.
    const char (*one)[1] = nullptr, (*eight)[8] = nullptr;

    forward(X, I, w1, A);
    forward(A, H, w2, B);
    float error = 0.0f;
    last(B, w3, [&](int c, int p, float y) {{
        float d = 0.0f;
        if (c < D && first + p < count) {{
            const float e = y - target.data[size_t(c) * n + first + p];
            d = weight.data[c] * e;
            error += d * e;
        }}
        E[c * LD + p] = 2.0f * d;
    }});
    __syncthreads();
    outer(B, H, eight, E, DP, part + THIRD);
    back(E, DP, w3, B);
    outer(A, H, eight, B, H, part + SECOND);
    back(B, H, w2, A);
    outer(X, I, one, A, H, part);
    for (int m = t; m < L * Q; m += T) {{
        const int p = m % Q * 4, i = m / Q;
        float4 sum = {{0.0f, 0.0f, 0.0f, 0.0f}};
        #pragma unroll 4
        for (int j = 0; j < H; ++j) {{
            const float4 a = four(A + j * LD + p);
            const float b = w1[i * H + j];
            sum.x += a.x * b; sum.y += a.y * b; sum.z += a.z * b; sum.w += a.w * b;
        }}
        *reinterpret_cast<float4*>(grad_f.data + size_t(i) * n + first + p) = sum;
    }}
    #pragma unroll
    for (int step = 16; step > 0; step /= 2) error += __shfl_down_sync(0xffffffffu, error, step);
    if (t % 32 == 0) X[t / 32] = error;
    __syncthreads();
    if (t == 0) {{
        float sum = 0.0f;
        for (int s = 0; s < T / 32; ++s) sum += X[s];
        loss.data[block] = sum;
    }}
    """
    if device_kind == "cuda":

        @wp.func_native(snippet)
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

        @wp.kernel(module="unique", module_options=options, launch_bounds=(THREADS, 2))
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
            block, thread = wp.tid()
            network(x, count, f, target, weight, net, grad_f, partial, loss, block)

    else:
        kernel = _cpu_kernel(latent, hidden, outputs)
    return NetworkKernels(latent, hidden, outputs, device_kind, probes, kernel)


@dataclass(frozen=True)
class CpuNetwork:
    """The network's ``wp.func``s of a CPU thread; vectors of inputs, of units and of padded outputs.

    Attributes:
        vec_in, vec_hidden, vec_out: The types.
        forward: (net, inputs) -> both hidden layers and the outputs.
        hidden_row, output_row: (net, at) -> the numbers of the array from ``at`` on.
    """

    vec_in: Any
    vec_hidden: Any
    vec_out: Any
    forward: Any
    hidden_row: Any
    output_row: Any


@functools.cache
def cpu_network(latent: int, hidden: int, outputs: int) -> CpuNetwork:
    """Builds (once) the functions of one shape."""
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


def _cpu_kernel(latent: int, hidden: int, outputs: int):
    inputs, wide = latent + 3, padded(outputs)
    second = (inputs + 1) * hidden
    third = second + (hidden + 1) * hidden
    net_of = cpu_network(latent, hidden, outputs)
    vec_in, vec_hidden, vec_out = net_of.vec_in, net_of.vec_hidden, net_of.vec_out
    forward, hidden_row, output_row = net_of.forward, net_of.hidden_row, net_of.output_row
    add_hidden, add_output = _add_to(vec_hidden, hidden), _add_to(vec_out, wide)

    @wp.kernel(module="unique", module_options={"enable_backward": False, "max_unroll": 1})
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

    return kernel
