// The network's backward pass for a block of probes (gaussian-probe-compression, eq. 8), after layers.cuh: the loss, the
// gradient of the Gaussians' sums, and this block's part of the weights' gradients.
// The reference is tests/reference/probe_network.py; layers.cuh gives the reason for native code.

const int t = threadIdx.x;
const int first = block * P, n = x.shape[0];
const float* w1 = net.data, *w2 = w1 + SECOND, *w3 = w1 + THIRD;
float* part = partial.data + size_t(block) * SIZE;

for (int m = t; m < I * P; m += T) {
    const int c = m / P, p = m % P;
    float v = 0.0f;
    if (c < L) for (int s = 0; s < f.shape[0]; ++s) v += f.data[(size_t(s) * L + c) * n + first + p];
    else v = x.data[first + p][c - L];
    X[c * LD + p] = v;
}
__syncthreads();
// The gradient of a layer's inputs from that of its outputs, written over the inputs.
auto back = [&](const float* d, int count, const float* w, float* out) {
    for (int tile = t; tile < Q * (H / 8); tile += T) {
        const int p = tile % Q * 4, i = tile / Q * 8;
        float sum[8][4] = {};
        for (int j = 0; j < count; j += 4) {
            float right[4][4];
            #pragma unroll
            for (int s = 0; s < 4; ++s) {
                const float4 a = four(d + (j + s) * LD + p);
                right[s][0] = a.x; right[s][1] = a.y; right[s][2] = a.z; right[s][3] = a.w;
            }
            #pragma unroll
            for (int v = 0; v < 8; ++v) {
                const float4 b = four(w + (i + v) * count + j);
                #pragma unroll
                for (int u = 0; u < 4; ++u)
                    sum[v][u] += b.x * right[0][u] + b.y * right[1][u] + b.z * right[2][u] + b.w * right[3][u];
            }
        }
        #pragma unroll
        for (int v = 0; v < 8; ++v)
            #pragma unroll
            for (int u = 0; u < 4; ++u) {
                float& h = out[(i + v) * LD + p + u];
                h = sum[v][u] * h * (1.0f - h);
            }
    }
    __syncthreads();
};
// The gradient of a layer's weights, rows of inputs times units, and of its biases.
auto outer = [&](const float* in, int rows, auto tall, const float* d, int count, float* out) {
    constexpr int R = sizeof(*tall);
    const int down = rows / R, across = count / 4;
    for (int tile = t; tile < down * across; tile += T) {
        // The rows of neighbouring threads are in different banks.
        const int i = tile % down, j = tile / down;
        float sum[R][4] = {};
        #pragma unroll 2
        for (int p = 0; p < P; p += 4) {
            float4 right[4];
            #pragma unroll
            for (int v = 0; v < 4; ++v) right[v] = four(d + (j + v * across) * LD + p);
            #pragma unroll
            for (int u = 0; u < R; ++u) {
                const float4 a = four(in + (i + u * down) * LD + p);
                #pragma unroll
                for (int v = 0; v < 4; ++v)
                    sum[u][v] += a.x * right[v].x + a.y * right[v].y + a.z * right[v].z + a.w * right[v].w;
            }
        }
        #pragma unroll
        for (int u = 0; u < R; ++u)
            #pragma unroll
            for (int v = 0; v < 4; ++v) out[(i + u * down) * count + j + v * across] = sum[u][v];
    }
    for (int j = t; j < count; j += T) {
        float sum = 0.0f;
        for (int p = 0; p < P; p += 4) {
            const float4 a = four(d + j * LD + p);
            sum += (a.x + a.y) + (a.z + a.w);
        }
        out[rows * count + j] = sum;
    }
    __syncthreads();
};
// Rows per thread, as the size of an array, since a lambda's argument cannot carry a constant.
const char (*one)[1] = nullptr, (*eight)[8] = nullptr;

forward(X, I, w1, A);
forward(A, H, w2, B);
float error = 0.0f;
last(B, w3, [&](int c, int p, float y) {
    float d = 0.0f;
    if (c < D && first + p < count) {
        const float e = y - target.data[size_t(c) * n + first + p];
        d = weight.data[c] * e;
        error += d * e;
    }
    E[c * LD + p] = 2.0f * d;
});
__syncthreads();
outer(B, H, eight, E, DP, part + THIRD);
back(E, DP, w3, B);
outer(A, H, eight, B, H, part + SECOND);
back(B, H, w2, A);
outer(X, I, one, A, H, part);
for (int m = t; m < L * Q; m += T) {
    const int p = m % Q * 4, i = m / Q;
    float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
    #pragma unroll 4
    for (int j = 0; j < H; ++j) {
        const float4 a = four(A + j * LD + p);
        const float b = w1[i * H + j];
        sum.x += a.x * b; sum.y += a.y * b; sum.z += a.z * b; sum.w += a.w * b;
    }
    *reinterpret_cast<float4*>(grad_f.data + size_t(i) * n + first + p) = sum;
}
#pragma unroll
for (int step = 16; step > 0; step /= 2) error += __shfl_down_sync(0xffffffffu, error, step);
if (t % 32 == 0) X[t / 32] = error;
__syncthreads();
if (t == 0) {
    float sum = 0.0f;
    for (int s = 0; s < T / 32; ++s) sum += X[s];
    loss.data[block] = sum;
}
