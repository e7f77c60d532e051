// Evaluates the network of a tile for four rows of texels: a thread brings the features of a column's four texels, and a
// warp multiplies those of its 32 columns with the weights on the matrix units.
//
// Native, since Warp's tiles go through shared memory between layers: here the sums of one layer are the operand of the
// next one as they lie in the registers (`matrix_units.cuh`). Numbers are half floats, two to a register.
//
// The body of the function `forward` of wlm_kernels/lightmap/matrix_decode.py, behind `matrix_units.cuh`. The function
// defines its arguments, and:
//   H          hidden width, a multiple of 16
//   R          size of F_uvt along u and v
//   ROWS       rows of texels in a strip, a multiple of 4; a block of 128 threads decodes one strip of a tile
//   HOURS      number of hours that a texel is evaluated at, 1 or 2
// The weights in `packed` are those of `pack_networks`. A call evaluates rows 4 `part` to 4 `part` + 3 of the strip
// `strip` at one hour; the first call of a block for an hour, with `part` 0, loads what the strip needs.

constexpr int NT = H / 8, KT = H / 16;  // columns of 8 units, and steps of 16, in a layer
constexpr int VOLUME = (ROWS * R + 127) / 128 + 2;  // rows of F_uvt that a strip reads
constexpr int W1 = NT * 64, W2 = KT * NT * 64, W3 = 2 * KT * 64, B2 = H / 2, WORDS = W1 + W2 + W3 + B2 + 4;
constexpr float SCALE = 3.4641016151377544f / 255.0f;
__shared__ __align__(16) unsigned w1[HOURS][W1], later[WORDS - W1];
__shared__ uint2 volume[HOURS][VOLUME][R], down[HOURS][ROWS];  // F_uvt; of each row its place in a cell of F_uvt, and F_vt
__shared__ unsigned across[HOURS][128];  // F_ut of each column
__shared__ uint4 staged[2][128];

// The endpoints of a block of BC7 mode 6, so that a texel's bytes are (a + w d) / 64, rounded, for two channels at once.
struct Ends {
    unsigned a01, a23, d01, d23;
    __device__ Ends(const uint4& b) {
        const unsigned p = (b.y >> 31) * 0x10001u, o = (b.z & 1u) * 0x10001u;
        a01 = 2 * (b.x >> 7 & 127u | b.x >> 5 & 0x7f0000u) + p;
        a23 = 2 * (b.y >> 3 & 127u | b.y >> 1 & 0x7f0000u) + p;
        d01 = 2 * (b.x >> 14 & 127u | __funnelshift_r(b.x, b.y, 12) & 0x7f0000u) + o - a01;
        d23 = 2 * (b.y >> 10 & 127u | b.y >> 8 & 0x7f0000u) + o - a23;
        a01 = 64 * a01 + 0x200020u;
        a23 = 64 * a23 + 0x200020u;
    }
    // The weight of an index in 64ths, which is (64 index + 7) / 15.
    static __device__ unsigned weight(unsigned index) { return index * 279680u + 30590u >> 16; }
    static __device__ unsigned bytes(unsigned a, unsigned d, unsigned w) { return a + w * d >> 6 & 0xff00ffu; }
    // Bytes less 128 as halves: 0x6400 is 1024, whose lowest bit is 1.
    static __device__ unsigned halves(unsigned two) { return Units::add(two | 0x64006400u, 0xe480e480u); }
};
// A position on an axis of `size` cells, see wlm_kernels/interpolate.py.
struct Place {
    int a, b;
    float part;
    __device__ Place(float p, int size, bool wraps) {
        const float at = p * size - 0.5f, low = floorf(at);
        a = (int)low;
        b = a + 1;
        part = at - low;
        a = wraps ? (a + size) % size : max(a, 0);
        b = wraps ? b % size : min(b, size - 1);
    }
};
// GELU of two numbers by its tanh form, x (1 + tanh(0.79788 x + 0.035677 x^3)) / 2. Numbers are scaled so that the factor
// of x^3 is 1, and the result is doubled; `pack_networks` scales the weights.
auto gelu = [](unsigned x) {
    const unsigned slope = Units::fma(x, x, 0x40d940d9u);
    return Units::fma(x, Units::tanh(Units::scale(x, slope)), x);
};
const int t = threadIdx.x, lane = t & 31, first = t & ~31, g = lane >> 2, q = lane & 3;
if (part == 0) {
    const bool wraps = stored.periodic != 0;
    const int top = ((2 * strip * ROWS + 1) * R - 128) >> 8;  // of the first row of texels, in cells of F_uvt
    const unsigned* from = packed.data + size_t(n) * WORDS;
    const float* w = reinterpret_cast<const float*>(hidden.data) + size_t(n) * (18 + H) * H;
    __syncthreads();
    for (int i = t; i < W1; i += 128) {
        unsigned word = from[i];
        if ((i & 7) == 5) {
            // The inputs 12 and 13 are 1: their weights are the bias, which contains the time, in two halves.
            const float* u = w + (i >> 6) * 8 + (i >> 3 & 7);
            float bias = u[16 * H];
            for (int c = 0; c < 4; ++c) bias += encoding[c] * u[(12 + c) * H] + 0.5f * SCALE * u[c * H];
            bias *= 0.3292035f;
            word = Units::pack(bias, bias - Units::unpack(Units::pack(bias, 0.0f)).x);
        }
        w1[hour][i] = word;
    }
    if (hour == 0)
        for (int i = t; i < WORDS - W1; i += 128) later[i] = from[W1 + i];
    const Place slice(tau, stored.slices, wraps);
    const uint4* blocks = reinterpret_cast<const uint4*>(stored.uvt.data) + size_t(n) * stored.slices * (R / 4) * (R / 4);
    for (int i = t; i < VOLUME * R; i += 128) {
        const int y = min(max(top + i / R, 0), R - 1), x = i % R, shift = 16 * (y & 1) + 4 * (x & 3);
        float f[4] = {};
        for (int k = 0; k < 2; ++k) {
            const uint4 block = blocks[((k == 0 ? slice.a : slice.b) * (R / 4) + y / 4) * (R / 4) + x / 4];
            const Ends ends(block);
            const unsigned word = (y & 2) ? block.w : block.z;
            const unsigned weight = Ends::weight((y & 3) + (x & 3) == 0 ? word >> 1 & 7u : word >> shift & 15u);
            const unsigned low = Ends::bytes(ends.a01, ends.d01, weight), high = Ends::bytes(ends.a23, ends.d23, weight);
            const float share = k == 0 ? 1.0f - slice.part : slice.part;
            f[0] += share * (low & 255u);
            f[1] += share * (low >> 16);
            f[2] += share * (high & 255u);
            f[3] += share * (high >> 16);
        }
        for (int c = 0; c < 4; ++c) f[c] = (f[c] - 127.5f) * SCALE;
        volume[hour][i / R][x] = make_uint2(Units::pack(f[0], f[1]), Units::pack(f[2], f[3]));
    }
    auto plane = [&](const wp::array_t<wp::vec_t<2, wp::uint8>>& of, int i) {
        const int rows = of.shape[1], columns = of.shape[2];
        const Place row(tau, rows, wraps), column((i + 0.5f) / 128.0f, columns, false);
        const uchar2* at = reinterpret_cast<const uchar2*>(of.data) + size_t(n) * rows * columns;
        float f[2] = {};
        for (int k = 0; k < 4; ++k) {
            const uchar2 v = at[((k & 2) ? row.b : row.a) * columns + ((k & 1) ? column.b : column.a)];
            const float share = ((k & 2) ? row.part : 1.0f - row.part) * ((k & 1) ? column.part : 1.0f - column.part);
            f[0] += share * v.x;
            f[1] += share * v.y;
        }
        return Units::pack((f[0] - 127.5f) * SCALE, (f[1] - 127.5f) * SCALE);
    };
    across[hour][t] = plane(stored.ut, t);
    if (t < ROWS) {
        const int y = strip * ROWS + t;
        const float share = (((2 * y + 1) * R - 128) & 255) / 256.0f;
        down[hour][t] = make_uint2(Units::pack(share, share), plane(stored.vt, y));
    }
    __syncthreads();
}

const uint4 block = reinterpret_cast<const uint4*>(stored.uv.data)[(n * 32 + strip * (ROWS / 4) + part) * 32 + t / 4];
const Ends ends(block);
const unsigned upper = ((t & 3) == 0 ? block.z & ~15u | block.z >> 1 & 7u : block.z) >> 4 * (t & 3);
const unsigned lower = block.w >> 4 * (t & 3);

// F_uvt at this column: the row of cells above the texel, and the difference of the one below.
const Place column((t + 0.5f) / 128.0f, R, false);
const unsigned aside = Units::pack(column.part, column.part);
auto cells = [&](int row) {
    const uint2 a = volume[hour][row][column.a], b = volume[hour][row][column.b];
    return make_uint2(
        Units::fma(Units::subtract(b.x, a.x), aside, a.x),
        Units::fma(Units::subtract(b.y, a.y), aside, a.y)
    );
};
const int y = strip * ROWS + 4 * part, top = ((2 * strip * ROWS + 1) * R - 128) >> 8;
int above = (((2 * y + 1) * R - 128) >> 8) - top;
uint2 high = cells(above), low = cells(above + 1);
uint2 step = make_uint2(Units::subtract(low.x, high.x), Units::subtract(low.y, high.y));

// The inputs 8 to 15: F_ut, F_vt, 1 and 1, 0 and 0; of them a lane holds two.
unsigned fixed[2][2];
#pragma unroll
for (int m = 0; m < 2; ++m)
    #pragma unroll
    for (int j = 0; j < 2; ++j)
        fixed[m][j] = q == 0 ? across[hour][first + 16 * m + 8 * j + g] : q == 2 ? 0x3c003c00u : 0u;

const unsigned *w2 = later, *w3 = later + W2, *b2 = w3 + W3;
const float* b3 = reinterpret_cast<const float*>(b2 + B2);
auto pair = [&](const unsigned* of, int i) { return *reinterpret_cast<const uint2*>(of + (i * 32 + lane) * 2); };
wp::vec_t<12, float> result;
#pragma unroll
for (int r = 0; r < 4; ++r) {
    const int next = (((2 * (y + r) + 1) * R - 128) >> 8) - top;
    if (next != above) {
        above = next;
        high = low;
        low = cells(above + 1);
        step = make_uint2(Units::subtract(low.x, high.x), Units::subtract(low.y, high.y));
    }
    const uint2 row = down[hour][4 * part + r];
    const unsigned weight = Ends::weight((r < 2 ? upper : lower) >> 16 * (r & 1) & 15u);
    staged[r & 1][t] = make_uint4(
        Ends::halves(Ends::bytes(ends.a01, ends.d01, weight)),
        Ends::halves(Ends::bytes(ends.a23, ends.d23, weight)),
        Units::fma(step.x, row.x, high.x),
        Units::fma(step.y, row.x, high.y)
    );
    __syncwarp();
    unsigned piece[4], a[2][KT][4], b[2][KT][4];
    Units::load(piece, &staged[r & 1][t]);
    #pragma unroll
    for (int m = 0; m < 2; ++m) {
        b[m][0][0] = piece[2 * m];
        b[m][0][1] = piece[2 * m + 1];
        b[m][0][2] = q == 1 ? row.y : fixed[m][0];
        b[m][0][3] = q == 1 ? row.y : fixed[m][1];
    }
    // Two groups of 16 texels, so that a weight that is read serves both.
    #pragma unroll
    for (int i = 0; i < NT; ++i) {
        const uint2 of = pair(w1[hour], i);
        #pragma unroll
        for (int m = 0; m < 2; ++m) {
            unsigned sums[2] = {0u, 0u};
            Units::multiply_half(sums, b[m][0], of.x, of.y);
            a[m][i / 2][2 * (i & 1)] = gelu(sums[0]);
            a[m][i / 2][2 * (i & 1) + 1] = gelu(sums[1]);
        }
    }
    #pragma unroll
    for (int i = 0; i < NT; ++i) {
        const unsigned bias = b2[4 * i + q];
        unsigned sums[2][2] = {{bias, bias}, {bias, bias}};
        #pragma unroll
        for (int k = 0; k < KT; ++k) {
            const uint2 of = pair(w2, k * NT + i);
            #pragma unroll
            for (int m = 0; m < 2; ++m) Units::multiply_half(sums[m], a[m][k], of.x, of.y);
        }
        #pragma unroll
        for (int m = 0; m < 2; ++m) {
            b[m][i / 2][2 * (i & 1)] = gelu(sums[m][0]);
            b[m][i / 2][2 * (i & 1) + 1] = gelu(sums[m][1]);
        }
    }
    // The first group's channels are columns 0 to 2 of the output, the second's 4 to 6.
    const float red = b3[2 * (q & 1)], green = b3[2 * (q & 1) + 1];
    float s[4] = {red, green, red, green};
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int k = 0; k < KT; ++k) {
            const uint2 of = pair(w3, m * KT + k);
            Units::multiply(s, b[m][k], of.x, of.y);
        }
    // A lane with even q has two channels of its group's rows g and g + 8, its neighbour the third: they swap.
    const bool odd = q & 1;
    const float one = __shfl_xor_sync(~0u, odd ? s[0] : s[2], 1), other = __shfl_xor_sync(~0u, s[3], 1);
    result.c[3 * r] = odd ? one : s[0];
    result.c[3 * r + 1] = odd ? other : s[1];
    result.c[3 * r + 2] = odd ? s[2] : one;
}
return result;
