// Decodes P points with a block of T threads, or those of them in the region `own` if that is not negative. T / P neighbouring
// threads share the Gaussians that a point's cube lists (gaussian-probe-compression, eq. 5); then a warp evaluates the network
// (eq. 7) of 16 points at a time on the matrix units. Behind matrix_units.cuh and decode_layout.cuh; constants and packed arrays are
// of wlm_kernels/probe/decode.py, the reference is benchmarks/probe_exact.py. The code is native for the matrix units and for
// loads of 16 bytes: a thread's Gaussians lie scattered, and loads of single floats would keep the load units busy.
//
// Inputs and activations are pairs of half floats, the rounded number and the rest, so that products have nearly the precision
// of float32; sums of Gaussians are clamped at the largest half float. Weights of the hidden layers are half floats in every
// model; those of the last layer, which may be mixed from two hours, are pairs too.

constexpr int SHARE = T / P, TILES = P / 16;
constexpr int R = (14 + L + 3) / 4, MOST = KI > KH ? KI : KH;
constexpr bool KEPT = WORDS <= MOST_KEPT;
__shared__ uint4 kept[KEPT ? WORDS / 4 : 1];
__shared__ __align__(16) float rows_of[P][16 * KI + 8];  // inputs, then outputs
const int t = threadIdx.x, share = t % SHARE, point = t / SHARE;
if (!fresh || own >= 0) __syncthreads();  // a call before still reads what is shared
if (KEPT && fresh)
    for (int m = t; m < WORDS / 4; m += T)
        asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(unsigned(__cvta_generic_to_shared(kept + m))),
                     "l"(net.data + 4 * m));

// A record: centre, squared radius of a sphere, W, whether W needs float64, latent; the rests of W are behind all records.
const float4* records = reinterpret_cast<const float4*>(rows.data);
auto load = [&](float* v, int k) {
    #pragma unroll
    for (int j = 0; j < R; ++j) {
        const float4 four = records[size_t(k) * R + j];
        v[4 * j] = four.x; v[4 * j + 1] = four.y; v[4 * j + 2] = four.z; v[4 * j + 3] = four.w;
    }
};
float f[L] = {};
if (begin + share < end) {
    int i = begin + share, k = items.data[i];
    float v[4 * R];
    while (i < end) {
        load(v, k);
        i += SHARE;
        const int next_k = items.data[min(i, end - 1)];
        const float r[3] = {x[0] - v[0], x[1] - v[1], x[2] - v[2]};
        float u[3];
        #pragma unroll
        for (int a = 0; a < 3; ++a) u[a] = v[4 + 3 * a] * r[0] + v[5 + 3 * a] * r[1] + v[6 + 3 * a] * r[2];
        if (v[13] != 0.0f) {
            const float* rest = reinterpret_cast<const float*>(records + size_t(count) * R) + size_t(k) * 12;
            for (int a = 0; a < 3; ++a) {
                double sum = 0.0;
                for (int b = 0; b < 3; ++b) sum += (static_cast<double>(v[4 + 3 * a + b]) + rest[3 * a + b]) * (static_cast<double>(x[b]) - v[b]);
                u[a] = static_cast<float>(sum);
            }
        }
        const float d2 = u[0] * u[0] + u[1] * u[1] + u[2] * u[2];
        const bool inside = v[3] > 0.0f ? r[0] * r[0] + r[1] * r[1] + r[2] * r[2] < v[3] : d2 < cut * cut;
        const float w = inside ? __expf(-0.5f * d2) : 0.0f;
        #pragma unroll
        for (int c = 0; c < L; ++c) f[c] += w * v[14 + c];
        k = next_k;
    }
}
#pragma unroll
for (int c = 0; c < 16 * KI; ++c) {
    float sum = c < L ? f[c < L ? c : 0] : c < I ? x[c < I && c >= L ? c - L : 0] : 0.0f;
    if (c < L)
        #pragma unroll
        for (int step = 1; step < SHARE; step *= 2) sum += __shfl_xor_sync(~0u, sum, step);
    if (c % SHARE == share) rows_of[point][c] = sum;
}
asm volatile("cp.async.wait_all;" ::: "memory");
__syncthreads();

const int warp = t / 32, lane = t % 32, g = lane / 4, q = lane % 4;
for (int tile = warp; tile < TILES; tile += T / 32) {
    const uint4* weights = KEPT ? kept : reinterpret_cast<const uint4*>(net.data);
    const float* biases = reinterpret_cast<const float*>(weights + END);
    unsigned high[MOST][4], low[MOST][4];  // left operands, see matrix_units.cuh
    auto split = [&](int k, int piece, float a, float b) {
        high[k][piece] = Units::pack(a, b);
        const float2 whole = Units::unpack(high[k][piece]);
        low[k][piece] = Units::pack(a - whole.x, b - whole.y);
    };
    auto hidden = [&](int depth, const uint4* w, const float* bias) {
        float sum[2 * KH][4];
        #pragma unroll
        for (int n = 0; n < 2 * KH; ++n)
            for (int e = 0; e < 4; ++e) sum[n][e] = bias[8 * n + 2 * q + e % 2];
        #pragma unroll
        for (int k = 0; k < MOST; ++k)
            #pragma unroll
            for (int n = 0; n < KH; ++n)
                if (k < depth) {
                    const uint4 b = w[(k * KH + n) * 32 + lane];
                    Units::multiply(sum[2 * n], high[k], b.x, b.y);
                    Units::multiply(sum[2 * n + 1], high[k], b.z, b.w);
                    Units::multiply(sum[2 * n], low[k], b.x, b.y);
                    Units::multiply(sum[2 * n + 1], low[k], b.z, b.w);
                }
        #pragma unroll
        for (int n = 0; n < 2 * KH; ++n) {
            #pragma unroll
            for (int e = 0; e < 4; ++e) sum[n][e] = __fdividef(1.0f, 1.0f + __expf(-sum[n][e]));
            split(n / 2, n % 2 * 2, sum[n][0], sum[n][1]);
            split(n / 2, n % 2 * 2 + 1, sum[n][2], sum[n][3]);
        }
    };
    auto half = [](float a) { return fminf(fmaxf(a, -65504.0f), 65504.0f); };
    #pragma unroll
    for (int k = 0; k < KI; ++k)
        #pragma unroll
        for (int piece = 0; piece < 4; ++piece) {
            const float* row = rows_of[16 * tile + g + piece % 2 * 8] + 16 * k + piece / 2 * 8 + 2 * q;
            split(k, piece, half(row[0]), half(row[1]));
        }
    hidden(KI, weights, biases);
    hidden(KH, weights + SECOND, biases + 16 * KH);

    float scale[2] = {gain, gain};
    for (int start = 0; start < N; start += 2) {
        float sum[2][4];
        #pragma unroll
        for (int n = 0; n < 2; ++n)
            for (int e = 0; e < 4; ++e) sum[n][e] = start + n < N ? biases[32 * KH + 8 * (start + n) + 2 * q + e % 2] : 0.0f;
        #pragma unroll
        for (int k = 0; k < KH; ++k)
            #pragma unroll
            for (int n = 0; n < 2; ++n)
                if (start + n < N) {
                    const uint4 b = weights[THIRD + (k * N + start + n) * 32 + lane];
                    Units::multiply(sum[n], high[k], b.x, b.y);
                    Units::multiply(sum[n], low[k], b.x, b.y);
                    Units::multiply(sum[n], high[k], b.z, b.w);
                }
        if (FIRST && start == 0)
            for (int v = 0; v < 2; ++v) scale[v] *= expf(fminf(__shfl_sync(~0u, sum[0][2 * v], lane & ~3), 0.0f));
        #pragma unroll
        for (int n = 0; n < 2; ++n)
            for (int e = 0; e < 4; ++e) rows_of[16 * tile + g + e / 2 * 8][8 * n + 2 * q + e % 2] = scale[e / 2] * sum[n][e];
        __syncwarp();
        const int from = max(8 * start - FIRST, 0), width = min(8 * start + 16 - FIRST, OUT) - from;
        const int top = block * P + 16 * tile;
        for (int m = lane; m < 16 * width; m += 32) {
            const int p = m / width, c = from + m % width;
            const float value = rows_of[16 * tile + p][c + FIRST - 8 * start];
            if (top + p < points && (own < 0 || region.data[top + p] == own))
                out.data[size_t(top + p) * OUT + c] = c < AMBIENT ? fmaxf(value, 0.0f) : value;
        }
        __syncwarp();
    }
}
