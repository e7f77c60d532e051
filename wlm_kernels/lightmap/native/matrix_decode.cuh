// Evaluates the network of a tile for four rows of texels: a thread brings the features of a column's four texels, and a
// warp evaluates the network of its 32 columns together.
//
// The body of the function `forward` of wlm_kernels/lightmap/matrix_decode.py, behind `matrix_network.cuh`. The function
// defines its arguments, and:
//   R          size of F_uvt along u and v
//   ROWS       rows of texels in a strip, a multiple of 4; a block of 128 threads decodes one strip of a tile
//   HOURS      number of hours that a texel is evaluated at, 1 or 2
// The weights in `packed` are those of `pack_networks`. A call evaluates rows 4 `part` to 4 `part` + 3 of the strip
// `strip` at one hour; the first call of a block for an hour, with `part` 0, loads what the strip needs.

constexpr int VOLUME = (ROWS * R + 127) / 128 + 2;  // rows of F_uvt that a strip reads
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
const int t = threadIdx.x, first = t & ~31;
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
    unsigned piece[4], b[2][KT][4];
    Units::load(piece, &staged[r & 1][t]);
    #pragma unroll
    for (int m = 0; m < 2; ++m) {
        b[m][0][0] = piece[2 * m];
        b[m][0][1] = piece[2 * m + 1];
        b[m][0][2] = q == 1 ? row.y : fixed[m][0];
        b[m][0][3] = q == 1 ? row.y : fixed[m][1];
    }
    const float3 output = network(b, [&](int i) { return pair(w1[hour], i); }, later);
    result.c[3 * r] = output.x;
    result.c[3 * r + 1] = output.y;
    result.c[3 * r + 2] = output.z;
}
return result;
