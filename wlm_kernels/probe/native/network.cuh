// The network for a block of P probes and T threads (gaussian-probe-compression, eq. 7 and 8): the loss, the gradient of the
// Gaussians' sums, and this block's part of the weights' gradients. The reference is tests/reference/probe_network.py.
//
// The code is native for the matrix units (matrix_units.cuh). They multiply floats of 11 significant bits; a number here is the
// sum of two such floats, and of a product of two numbers only that of both rests is left out, so that sums have nearly the
// precision of float32: fits of high quality need it.
//
// Constants from wlm_kernels/probe/network.py:
//   L, H, D, DP  latent, hidden units, outputs, and outputs filled up to fours
//   P, T         probes and threads of a block
//   XR, ER       rows of the inputs, with a row of ones for the biases, and of the outputs, filled up to eights

constexpr int I = L + 3;
constexpr int SECOND = (I + 1) * H, THIRD = SECOND + (H + 1) * H, SIZE = THIRD + (H + 1) * DP;
const int t = threadIdx.x, warp = t / 32, g = t % 32 / 4, q = t % 4;
const int first = block * P, n = x.shape[0];
const float *w1 = net.data, *w2 = w1 + SECOND, *w3 = w1 + THIRD;
float* part = partial.data + size_t(block) * SIZE;

// Rows of P probes: inputs, both hidden layers, and the gradient of the outputs. Columns are permuted in steps of 8, so that the
// 32 numbers that a warp loads are in different banks.
__shared__ __align__(16) float X[XR * P], A[H * P], B[H * P], E[ER * P], errors[T / 32];
auto at = [](int row, int p) { return row * P + (p ^ 8 * ((row >> 1 ^ row << 1) & 3 & P / 8 - 1)); };
auto two = [](const float* p) { return *reinterpret_cast<const float2*>(p); };
auto whole = [](float a) { return __uint_as_float(__float_as_uint(a) & 0xffffe000u); };

// Multiplies M x K and K x N numbers, in tiles of 16 x 8. left(m, k, a) loads the rows m + g and m + g + 8 of the columns
// k + 2 q and k + 2 q + 1, right(n, k) the column n + g of these rows; done(row, n, value) takes the columns n + 2 q and
// n + 2 q + 1 of a row of the product.
auto multiply = [&](auto size, auto left, auto right, auto done) {
    constexpr int DOWN = (sizeof(size.m) + 15) / 16, ACROSS = sizeof(size.n) / 8, DEPTH = sizeof(size.k), W = T / 32;
    constexpr int G = DOWN * ACROSS >= 4 * W ? 4 : DOWN * ACROSS >= 2 * W ? 2 : 1;  // tiles of a warp
    for (int item = warp; item < DOWN * ((ACROSS + G - 1) / G); item += W) {
        const int m = item % DOWN * 16, start = item / DOWN * G;
        float sum[G][4] = {};
        #pragma unroll 2
        for (int k = 0; k < DEPTH; k += 8) {
            float a[4], rest[4];
            left(m, k, a);
            #pragma unroll
            for (int e = 0; e < 4; ++e) {
                rest[e] = a[e] - whole(a[e]);
                a[e] = whole(a[e]);
            }
            #pragma unroll
            for (int j = 0; j < G; ++j)
                if (ACROSS % G == 0 || start + j < ACROSS) {
                    const float2 b = right(8 * (start + j), k);
                    const float high[2] = {whole(b.x), whole(b.y)};
                    Units::multiply_floats(sum[j], rest, high[0], high[1]);
                    Units::multiply_floats(sum[j], a, b.x - high[0], b.y - high[1]);
                    Units::multiply_floats(sum[j], a, high[0], high[1]);
                }
        }
        #pragma unroll
        for (int j = 0; j < G; ++j)
            if (ACROSS % G == 0 || start + j < ACROSS)
                #pragma unroll
                for (int v = 0; v < 2; ++v)
                    done(m + g + 8 * v, 8 * (start + j), float2{sum[j][2 * v], sum[j][2 * v + 1]});
    }
};
// Sizes as those of arrays, since a lambda's argument cannot carry a constant.
struct Hidden { char m[H], n[P], k[H]; } hidden;
struct FromInputs { char m[H], n[P], k[XR]; } from_inputs;
struct ToOutputs { char m[ER], n[P], k[H]; } to_outputs;
struct FromOutputs { char m[H], n[P], k[ER]; } from_outputs;
struct ToSums { char m[L], n[P], k[H]; } to_sums;
struct Third { char m[H], n[ER], k[P]; } third;
struct Second { char m[H], n[H], k[P]; } second;
struct First { char m[I + 1], n[H], k[P]; } first_layer;

// A layer's weights w, rows of inputs times columns of units, as the left operand forward and backward.
auto ahead = [&](const float* w, int rows, int columns) {
    return [=](int m, int k, float* a) {
        #pragma unroll
        for (int e = 0; e < 4; ++e) {
            const int row = k + 2 * q + e / 2, column = m + g + e % 2 * 8;
            a[e] = row < rows && column < columns ? w[row * columns + column] : 0.0f;
        }
    };
};
auto back = [&](const float* w, int rows, int columns) {
    return [=](int m, int k, float* a) {
        #pragma unroll
        for (int v = 0; v < 2; ++v) {
            const int row = m + g + 8 * v, column = k + 2 * q;
            const float2 pair = row < rows && column < columns ? two(w + row * columns + column) : float2{0.0f, 0.0f};
            a[v] = pair.x;
            a[v + 2] = pair.y;
        }
    };
};
// Rows of probes as the operand that probes are the columns of, and as both operands of a product over the probes.
auto probes = [&](const float* rows) {
    return [=](int p, int k) { return float2{rows[at(k + 2 * q, p + g)], rows[at(k + 2 * q + 1, p + g)]}; };
};
auto across = [&](const float* in, int rows) {
    return [=](int m, int k, float* a) {
        #pragma unroll
        for (int v = 0; v < 2; ++v) {
            const int row = m + g + 8 * v;
            const float2 pair = row < rows ? two(in + at(row, k + 2 * q)) : float2{0.0f, 0.0f};
            a[v] = pair.x;
            a[v + 2] = pair.y;
        }
    };
};
auto down = [&](const float* in) {
    return [=](int row, int k) { return two(in + at(row + g, k + 2 * q)); };
};
auto activate = [&](float* out, const float* bias) {
    return [=](int row, int p, float2 v) {
        if (H % 16 && row >= H) return;
        const float b = bias ? bias[row] : 0.0f;
        const float2 h = {1.0f / (1.0f + __expf(-b - v.x)), 1.0f / (1.0f + __expf(-b - v.y))};
        *reinterpret_cast<float2*>(out + at(row, p + 2 * q)) = h;
    };
};
// The gradient of a layer's inputs from that of its outputs, written over the inputs.
auto through = [&](float* out) {
    return [=](int row, int p, float2 v) {
        if (H % 16 && row >= H) return;
        float2* to = reinterpret_cast<float2*>(out + at(row, p + 2 * q));
        const float2 h = *to;
        *to = float2{v.x * h.x * (1.0f - h.x), v.y * h.y * (1.0f - h.y)};
    };
};
// The gradient of a layer's weights and of its biases.
auto store = [&](float* out, int rows, int columns) {
    return [=](int row, int j, float2 v) {
        if (row < rows && j + 2 * q < columns) *reinterpret_cast<float2*>(out + row * columns + j + 2 * q) = v;
    };
};
auto biases = [&](const float* d, int columns, float* out) {
    for (int j = t; j < columns; j += T) {
        float sum = 0.0f;
        #pragma unroll 4
        for (int p = 0; p < P; p += 4) {
            // Neighbouring threads are in different banks.
            const float4 a = *reinterpret_cast<const float4*>(d + j * P + (p + 4 * j) % P);
            sum += (a.x + a.y) + (a.z + a.w);
        }
        out[j] = sum;
    }
};

for (int m = t; m < XR * P; m += T) {
    const int c = m / P, p = m % P;
    float v = c == I ? 1.0f : 0.0f;
    if (c < L)
        for (int s = 0; s < f.shape[0]; ++s) v += f.data[(size_t(s) * L + c) * n + first + p];
    else if (c < I) v = x.data[first + p][c - L];
    X[at(c, p)] = v;
}
__syncthreads();
multiply(from_inputs, ahead(w1, I + 1, H), probes(X), activate(A, nullptr));
__syncthreads();
multiply(hidden, ahead(w2, H, H), probes(A), activate(B, w2 + H * H));
__syncthreads();
float error = 0.0f;
multiply(to_outputs, ahead(w3, H, DP), probes(B), [&](int row, int p, float2 v) {
    if (row >= ER) return;
    const int i = first + p + 2 * q;
    float2 d = {0.0f, 0.0f};
    if (row < D) {
        const float2 wanted = two(target.data + size_t(row) * n + i);
        const float2 e = {v.x + w3[H * DP + row] - wanted.x, v.y + w3[H * DP + row] - wanted.y};
        if (i < count) d.x = weight.data[row] * e.x;
        if (i + 1 < count) d.y = weight.data[row] * e.y;
        error += d.x * e.x + d.y * e.y;
    }
    *reinterpret_cast<float2*>(E + at(row, p + 2 * q)) = float2{2.0f * d.x, 2.0f * d.y};
});
#pragma unroll
for (int step = 16; step > 0; step /= 2) error += __shfl_down_sync(0xffffffffu, error, step);
if (t % 32 == 0) errors[warp] = error;
__syncthreads();
if (t == 0) {
    float sum = 0.0f;
    for (int s = 0; s < T / 32; ++s) sum += errors[s];
    loss.data[block] = sum;
}
multiply(third, across(B, H), down(E), store(part + THIRD, H, DP));
biases(E, DP, part + THIRD + H * DP);
__syncthreads();
multiply(from_outputs, back(w3, H, DP), probes(E), through(B));
__syncthreads();
multiply(second, across(A, H), down(B), store(part + SECOND, H, H));
biases(B, H, part + SECOND + H * H);
__syncthreads();
multiply(hidden, back(w2, H, H), probes(B), through(A));
__syncthreads();
multiply(first_layer, across(X, I + 1), down(A), store(part, I + 1, H));
multiply(to_sums, back(w1, L, H), probes(A), [&](int row, int p, float2 v) {
    if (row < L) *reinterpret_cast<float2*>(grad_f.data + size_t(row) * n + first + p + 2 * q) = v;
});
