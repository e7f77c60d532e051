// The network's forward pass for a block of T threads (gaussian-probe-compression, eq. 7): the beginning of a function's
// body, which network.cuh continues. The reference is tests/reference/probe_network.py.
//
// It declares the rows X (inputs), A and B (hidden layers) and E (outputs) of P probes in shared memory, and
// forward(in, rows, weights, out), a hidden layer, and last(in, weights, put), which calls put(c, p, value) for every
// output c of probe p. The caller fills X and synchronises.
//
// The code is native because a thread computes 4 probes by 8 units in registers while the layers stay in shared memory,
// whose rows are padded against bank conflicts; one probe per thread would spill registers. Measured: a training step on
// 11,404 probes and 570 Gaussians takes 0.133 ms on an H200, 1 / 34.5 of plain torch's (benchmarks/nvidia-h200.json,
// city 12.00, "fit" and "dense torch"). Warp's own tiles have not been measured.
//
// Constants from wlm_kernels/probe/network.py:
//   L, H, D, DP  latent, hidden units, outputs, and outputs filled up to fours
//   P, T         probes and threads of a block

constexpr int I = L + 3;
constexpr int SECOND = (I + 1) * H, THIRD = SECOND + (H + 1) * H, SIZE = THIRD + (H + 1) * DP;
constexpr int LD = P + 4;  // rows of P probes, a bank apart
constexpr int Q = P / 4;   // pieces along the probes
__shared__ __align__(16) float X[I * LD], A[H * LD], B[H * LD], E[DP * LD];
auto four = [](const float* p) { return *reinterpret_cast<const float4*>(p); };
auto forward = [&](const float* in, int rows, const float* w, float* out) {
    for (int tile = threadIdx.x; tile < Q * (H / 8); tile += T) {
        const int p = tile % Q * 4, j = tile / Q * 8;
        float sum[8][4];
        #pragma unroll
        for (int v = 0; v < 8; ++v)
            #pragma unroll
            for (int u = 0; u < 4; ++u) sum[v][u] = w[rows * H + j + v];
        #pragma unroll 4
        for (int i = 0; i < rows; ++i) {
            const float4 a = four(in + i * LD + p), b = four(w + i * H + j), c = four(w + i * H + j + 4);
            const float left[4] = {a.x, a.y, a.z, a.w}, right[8] = {b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w};
            #pragma unroll
            for (int v = 0; v < 8; ++v)
                #pragma unroll
                for (int u = 0; u < 4; ++u) sum[v][u] += left[u] * right[v];
        }
        #pragma unroll
        for (int v = 0; v < 8; ++v)
            #pragma unroll
            for (int u = 0; u < 4; ++u) out[(j + v) * LD + p + u] = 1.0f / (1.0f + __expf(-sum[v][u]));
    }
    __syncthreads();
};
auto last = [&](const float* in, const float* w, auto put) {
    for (int tile = threadIdx.x; tile < Q * (DP / 4); tile += T) {
        const int p = tile % Q * 4, j = tile / Q * 4;
        float sum[4][4];
        #pragma unroll
        for (int v = 0; v < 4; ++v)
            #pragma unroll
            for (int u = 0; u < 4; ++u) sum[v][u] = w[H * DP + j + v];
        #pragma unroll 4
        for (int i = 0; i < H; ++i) {
            const float4 a = four(in + i * LD + p), b = four(w + i * DP + j);
            const float left[4] = {a.x, a.y, a.z, a.w}, right[4] = {b.x, b.y, b.z, b.w};
            #pragma unroll
            for (int v = 0; v < 4; ++v)
                #pragma unroll
                for (int u = 0; u < 4; ++u) sum[v][u] += left[u] * right[v];
        }
        #pragma unroll
        for (int v = 0; v < 4; ++v)
            #pragma unroll
            for (int u = 0; u < 4; ++u) put(j + v, p + u, sum[v][u]);
    }
};
