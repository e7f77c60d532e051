// Evaluates the network of a tile for four rows of texels: a thread brings the features of a column's four texels, and a
// warp evaluates the network of its 32 columns together.
//
// The body of the function `forward` of benchmarks/matrix_tiles.py, behind `matrix_network.cuh` and
// `matrix_maps.cuh`. The function defines its arguments, and:
//   R          size of F_uvt along u and v
//   ROWS       rows of texels in a strip, a multiple of 4; a block of 128 threads decodes one strip of a tile
//   HOURS      number of hours that a texel is evaluated at, 1 or 2
// The weights in `packed` are those of `pack_networks`. A call evaluates rows 4 `part` to 4 `part` + 3 of the strip
// `strip` at one hour; the first call of a block for an hour, with `part` 0, loads what the strip needs.

constexpr int VOLUME = (ROWS * R + 127) / 128 + 2;  // rows of F_uvt that a strip reads
__shared__ __align__(16) unsigned w1[HOURS][W1], later[WORDS - W1];
__shared__ uint2 volume[HOURS][VOLUME][R], down[HOURS][ROWS];  // F_uvt; of each row its place in a cell of F_uvt, and F_vt
__shared__ unsigned across[HOURS][128];  // F_ut of each column
__shared__ uint4 staged[2][128];

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
        const int y = min(max(top + i / R, 0), R - 1), x = i % R;
        float f[4] = {};
        for (int k = 0; k < 2; ++k) {
            const uint4 block = blocks[((k == 0 ? slice.a : slice.b) * (R / 4) + y / 4) * (R / 4) + x / 4];
            const Ends ends(block);
            ends.add(f, k == 0 ? 1.0f - slice.part : slice.part, Ends::weight(Ends::index(block, y, x)));
        }
        for (int c = 0; c < 4; ++c) f[c] = (f[c] - 127.5f) * SCALE;
        volume[hour][i / R][x] = make_uint2(Units::pack(f[0], f[1]), Units::pack(f[2], f[3]));
    }
    auto packed_plane = [&](const wp::array_t<wp::vec_t<2, wp::uint8>>& of, int i) {
        const float2 f = plane(of, n, i, tau, wraps);
        return Units::pack(f.x, f.y);
    };
    across[hour][t] = packed_plane(stored.ut, t);
    if (t < ROWS) {
        const int y = strip * ROWS + t;
        const float share = (((2 * y + 1) * R - 128) & 255) / 256.0f;
        down[hour][t] = make_uint2(Units::pack(share, share), packed_plane(stored.vt, y));
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
