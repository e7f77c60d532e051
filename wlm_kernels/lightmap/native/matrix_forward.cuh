// A network of two hidden layers on a GPU's matrix units: each thread brings the inputs of one texel and takes its
// answer, and a warp multiplies those of its 32 texels with the weights in half floats, summed in float32.
//
// Native, since Warp's tiles go through shared memory between layers: here the sums of one layer are, rounded to halves,
// the operand of the next one as they lie in the registers (mma.m16n8k16, PTX ISA, "matrix fragments").
//
// The body of the function `forward` of wlm_kernels/lightmap/matrix_decode.py, behind `matrix_units.cuh`. The function
// defines its arguments, and:
//   H          hidden width, a multiple of 16
//   NT, KT     columns of 8 units, and steps of 16, in a layer
// A block has 128 threads, all of one network; `fresh` is not 0 in its first call, which loads the weights.

struct Gelu {
    static __device__ float of(float x) {
        float y;
        asm("tanh.approx.f32 %0, %1;" : "=f"(y) : "f"(x * (0.7978845608f + 0.0356774081f * x * x)));
        return x * (0.5f + 0.5f * y);
    }
};
constexpr int I = 16, WORDS = 12;  // words between two texels' inputs: an odd multiple of 4 keeps banks apart
__shared__ __align__(16) unsigned w1[NT * 64], w2[KT * NT * 64], w3[KT * 64], staged[128 * WORDS];
__shared__ float b1[H], b2[H], b3[8], answers[128 * 4];
const int t = threadIdx.x, lane = t & 31, first = t & ~31, g = lane >> 2, q = lane & 3;
if (fresh) {
    // Weights in the order in which a warp reads them: two words a lane, rows 2q, 2q + 1 and 2q + 8, 2q + 9 of column g.
    const float* w = reinterpret_cast<const float*>(hidden.data) + size_t(n) * (I + H + 2) * H;
    const float* o = reinterpret_cast<const float*>(output.data) + size_t(n) * (H + 1) * 3;
    __syncthreads();
    for (int i = t; i < (1 + KT) * NT * 64; i += 128) {
        const int l = i >> 1 & 31, column = (i >> 6) % NT * 8 + (l >> 2), step = (i >> 6) / NT;
        const int row = 2 * (l & 3) + 8 * (i & 1);
        const float* from = w + (step == 0 ? row : I + 1 + (step - 1) * 16 + row) * H + column;
        const unsigned word = Units::pack(from[0], from[H]);
        if (step == 0) w1[i] = word;
        else w2[i - NT * 64] = word;
    }
    for (int i = t; i < KT * 64; i += 128) {
        const int l = i >> 1 & 31, column = l >> 2, row = (i >> 6) * 16 + 2 * (l & 3) + 8 * (i & 1);
        w3[i] = column < 3 ? Units::pack(o[row * 3 + column], o[row * 3 + 3 + column]) : 0u;
    }
    for (int i = t; i < H; i += 128) {
        b1[i] = w[I * H + i];
        b2[i] = w[(I + 1 + H) * H + i];
    }
    if (t < 8) b3[t] = t < 3 ? o[H * 3 + t] : 0.0f;
    __syncthreads();
}
#pragma unroll
for (int c = 0; c < I / 2; ++c) staged[t * WORDS + c] = Units::pack(f.c[2 * c], f.c[2 * c + 1]);
__syncwarp();
// Two groups of 16 texels, so that a weight that is read serves both.
unsigned a[2][KT][4];
float s[2][NT][4];
#pragma unroll
for (int m = 0; m < 2; ++m) {
    const unsigned* from = staged + (first + 16 * m + g) * WORDS + q;
    a[m][0][0] = from[0];
    a[m][0][1] = from[8 * WORDS];
    a[m][0][2] = from[4];
    a[m][0][3] = from[8 * WORDS + 4];
}
#pragma unroll
for (int layer = 0; layer < 2; ++layer) {
    const float* bias = layer == 0 ? b1 : b2;
    #pragma unroll
    for (int i = 0; i < NT; ++i) {
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int j = 0; j < 4; ++j) s[m][i][j] = bias[8 * i + 2 * q + (j & 1)];
        #pragma unroll
        for (int k = 0; k < (layer == 0 ? 1 : KT); ++k) {
            const unsigned* from = layer == 0 ? w1 : w2 + k * NT * 64;
            const uint2 b = *reinterpret_cast<const uint2*>(from + (i * 32 + lane) * 2);
            #pragma unroll
            for (int m = 0; m < 2; ++m) Units::multiply(s[m][i], a[m][k], b.x, b.y);
        }
    }
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int i = 0; i < NT; ++i) {
            a[m][i / 2][2 * (i & 1)] = Units::pack(Gelu::of(s[m][i][0]), Gelu::of(s[m][i][1]));
            a[m][i / 2][2 * (i & 1) + 1] = Units::pack(Gelu::of(s[m][i][2]), Gelu::of(s[m][i][3]));
        }
}
#pragma unroll
for (int m = 0; m < 2; ++m) {
    float y[4] = {b3[2 * q], b3[2 * q + 1], b3[2 * q], b3[2 * q + 1]};
    #pragma unroll
    for (int k = 0; k < KT; ++k) {
        const uint2 b = *reinterpret_cast<const uint2*>(w3 + (k * 32 + lane) * 2);
        Units::multiply(y, a[m][k], b.x, b.y);
    }
    if (q < 2) {
        float* to = answers + (first + 16 * m + g) * 4 + 2 * q;
        to[0] = y[0];
        to[1] = y[1];
        to[32] = y[2];
        to[33] = y[3];
    }
}
__syncwarp();
const float* answer = answers + t * 4;
const wp::vec_t<3, float> result(answer[0], answer[1], answer[2]);
__syncwarp();
return result;
