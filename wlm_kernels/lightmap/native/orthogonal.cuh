// Moves the weights of a layer along its orthogonalised momentum, on a GPU's matrix units; one block for a layer.
//
// X <- a X + (b A + c A A) X with A = X X^T, five times, from X = momentum / its norm: the singular values of X come
// near 1 (iteration of Newton and Schulz with the numbers of Jordan et al., 2024). Operands are half floats, which X,
// A and A A fit since their singular values are below 1.3; sums are float32.
//
// The body of the function `move` of wlm_kernels/lightmap/gather.py, behind `matrix_units.cuh`. The function defines its
// arguments, and the constants H, columns of X (a multiple of 16), and T, threads of a block: a warp for each piece of
// 16 x 16 of an H x H matrix. `rows` of X are a multiple of 16, at most H.

constexpr int S = H + 8;  // halves between two rows: keeps banks apart
__shared__ __align__(16) unsigned short matrices[4][H * S];
__shared__ float sums[T / 32];
const int t = threadIdx.x, lane = t & 31, warp = t >> 5, g = lane >> 2, q = lane & 3;
const int down = lane & 15, across = (lane >> 4) * 8, down_after = (lane & 7) + across, across_first = (lane & 8);
const float2* from = reinterpret_cast<const float2*>(momentum.data + at);
float norm = 0.0f;
for (int i = t; i < rows * H / 2; i += T) norm += from[i].x * from[i].x + from[i].y * from[i].y;
#pragma unroll
for (int step = 16; step > 0; step /= 2) norm += __shfl_xor_sync(0xffffffffu, norm, step);
if (lane == 0) sums[warp] = norm;
__syncthreads();
norm = 0.0f;
#pragma unroll
for (int i = 0; i < T / 32; ++i) norm += sums[i];
const float inverse = norm > 0.0f ? rsqrtf(norm) : 0.0f;
unsigned short *x = matrices[0], *next = matrices[1], *gram = matrices[2], *polynomial = matrices[3];
const auto pair = [&](unsigned short* values, int i) {
    return reinterpret_cast<unsigned*>(values + 2 * i / H * S + 2 * i % H);
};
for (int i = t; i < rows * H / 2; i += T) *pair(x, i) = Units::pack(from[i].x * inverse, from[i].y * inverse);
__syncthreads();
// to = factor l r + share added, of `inner` columns of l; with `transposed`, r^T in place of r.
const auto multiply = [&](unsigned short* to, int columns, const unsigned short* l, const unsigned short* r, bool transposed,
                          int inner, float factor, const unsigned short* added, float share) {
    const int m = warp / (columns / 16) * 16, p = warp % (columns / 16) * 16;
    if (m < rows) {
        float s[2][4] = {};
        for (int k = 0; k < inner; k += 16) {
            unsigned a[4], b[4];
            Units::load(a, l + (m + down) * S + k + across);
            if (transposed)
                Units::load(b, r + (p + down_after) * S + k + across_first);
            else
                Units::load_transposed(b, r + (k + down) * S + p + across);
            Units::multiply(s[0], a, b[0], b[1]);
            Units::multiply(s[1], a, b[2], b[3]);
        }
        #pragma unroll
        for (int j = 0; j < 2; ++j)
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                const int place = (m + 8 * i + g) * S + p + 8 * j + 2 * q;
                const float2 old = Units::unpack(*reinterpret_cast<const unsigned*>(added + place));
                *reinterpret_cast<unsigned*>(to + place) =
                    Units::pack(factor * s[j][2 * i] + share * old.x, factor * s[j][2 * i + 1] + share * old.y);
            }
    }
    __syncthreads();
};
for (int i = 0; i < 5; ++i) {
    multiply(gram, rows, x, x, true, H, 1.0f, x, 0.0f);
    multiply(polynomial, rows, gram, gram, true, rows, C, gram, B);
    multiply(next, H, polynomial, x, false, rows, 1.0f, x, A);
    unsigned short* old = x;
    x = next;
    next = old;
}
float2* to = reinterpret_cast<float2*>(weights.data + at);
for (int i = t; i < rows * H / 2; i += T) {
    const float2 v = Units::unpack(*pair(x, i));
    to[i] = make_float2(to[i].x - rate * v.x, to[i].y - rate * v.y);
}
