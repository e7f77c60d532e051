// A block of T samples of one tile through its network and back, on a GPU's matrix units: the answers, their loss, and
// the gradients of the weights and of the inputs.
//
// Operands are half floats and sums float32. Halves end at 6e-8 and gradients are far smaller, so each sample's are in
// units of its own, a power of two (an exact factor) near its largest d3. In the gradients of the weights, which are
// sums over samples, they are in units of the block.
//
// A warp takes its 32 samples from layer to layer. Activations and deltas lie in shared memory, sample by sample, since
// the gradients of the weights are products over all samples of the block; their 16 x 16 pieces are dealt to the warps.
// The order of all additions is fixed.
//
// The body of the function `network` of wlm_kernels/lightmap/matrix_step.py, behind `matrix_units.cuh`. The function
// defines its arguments, and these constants:
//   I, H          inputs (16 at most) and hidden width (a multiple of 16) of the network
//   T             threads of a block
//   EXACT         1: GELU with erf, 0: its tanh form
//   STRIDE, MASK  halves between two rows of H, and how far their groups of 8 are permuted to keep banks apart

constexpr int KT = H / 16, WARPS = T / 32;
constexpr unsigned ALL = 0xffffffffu;
struct Place {
    // The group `group` of 8 halves of a row: of H halves, and of the 16 inputs.
    static __device__ int at(int row, int group) { return row * STRIDE + ((group ^ (row & MASK)) << 3); }
    static __device__ int input(int row, int group) { return row * 16 + ((group ^ (row >> 2 & 1)) << 3); }
};
struct Gelu {
    // GELU of two numbers, x and y, and its slopes there.
    static __device__ void evaluate(float x, float y, unsigned& h, unsigned& slopes) {
        if (EXACT) {
            const float on_x = gate(x), on_y = gate(y);
            h = Units::pack(x * on_x, y * on_y);
            slopes = Units::pack(slope(x, on_x), slope(y, on_y));
        } else {
            // The gate is (1 + tanh z) / 2 with z = 0.7979 x + 0.03568 x^3, its slope is 2 gate (1 - gate) dz/dx. Beyond
            // +-8 it is 0 or 1.
            const unsigned half = 0x38003800u, pair = Units::pack(x, y);
            unsigned near;
            asm("{min.f16x2 %0, %1, %2; max.f16x2 %0, %0, %3;}" : "=&r"(near) : "r"(pair), "r"(0x48004800u), "r"(0xc800c800u));
            const unsigned square = Units::scale(near, near);
            const unsigned z = Units::scale(near, Units::fma(square, 0x28912891u, 0x3a623a62u));
            const unsigned on = Units::fma(Units::tanh(z), half, half), rest = Units::fma(on ^ 0x80008000u, on, on);
            h = Units::scale(pair, on);
            slopes = Units::fma(rest, Units::scale(near, Units::fma(square, 0x32da32dau, 0x3e623e62u)), on);
        }
    }
    static __device__ float gate(float x) { return 0.5f + 0.5f * erff(x * 0.7071067811865476f); }
    static __device__ float slope(float x, float gate) { return gate + x * 0.3989422804014327f * __expf(-0.5f * x * x); }
};
__shared__ __align__(16) unsigned short inputs[T * 16], w2[H * STRIDE], both[2 * T * STRIDE];
// Of a sample: its answer; then as halves its d3 in its own units, 0, its d3 in the block's units and their ratio.
__shared__ __align__(16) unsigned answers[T * 4];
unsigned short *left = both, *right = both + T * STRIDE, *w1 = right;  // w1 where nothing else is at the time

const int t = threadIdx.x, lane = t & 31, warp = t >> 5, first = t & ~31, g = lane >> 2, q = lane & 3;
// The rows and groups of which a lane gives the address: pieces down and then across, or across and then down.
const int down = lane & 15, across = lane >> 4, down_after = (lane & 7) + (lane >> 4) * 8, across_first = lane >> 3 & 1;
// A copy of a number that the compiler doesn't know: what is computed of it, mostly addresses, isn't kept in registers
// from one use to the next, of which there are too few here.
const auto fresh = [](int number) {
    asm volatile("" : "+r"(number));
    return number;
};
const float* w = reinterpret_cast<const float*>(hidden.data) + size_t(n) * (I + H + 2) * H;
const float* o = reinterpret_cast<const float*>(output.data) + size_t(n) * (H + 1) * 3;

// Weights, and the sample's inputs.
const auto load_weights = [&](unsigned short* to, const float* from, int rows, int filled) {
    #pragma unroll
    for (int j = 0; j < (rows * H / 4 + T - 1) / T; ++j) {
        const int i = t + j * T, r = i / (H / 4), column = i % (H / 4) * 4;
        if (i >= rows * H / 4) break;
        float4 v = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (r < filled) v = *reinterpret_cast<const float4*>(from + r * H + column);
        *reinterpret_cast<uint2*>(to + Place::at(r, column >> 3) + (column & 4)) =
            make_uint2(Units::pack(v.x, v.y), Units::pack(v.z, v.w));
    }
};
load_weights(w1, w, 16, I);
load_weights(w2, w + (I + 1) * H, H, H);
#pragma unroll
for (int i = 0; i < 2; ++i) {
    unsigned v[4];
    #pragma unroll
    for (int j = 0; j < 4; ++j) {
        const int c = 8 * i + 2 * j;
        v[j] = Units::pack(c < I ? f.c[c < I ? c : 0] : 0.0f, c + 1 < I ? f.c[c + 1 < I ? c + 1 : 0] : 0.0f);
    }
    *reinterpret_cast<uint4*>(inputs + Place::input(t, i)) = make_uint4(v[0], v[1], v[2], v[3]);
}
__syncthreads();

// Forward: h1 to `left`, h2 to `right`; the slopes of GELU stay in registers as pairs of halves.
unsigned slopes[2][2][2 * KT][2];
#pragma unroll
for (int layer = 0; layer < 2; ++layer) {
    const float* bias = w + (layer == 0 ? I : I + 1 + H) * H;
    unsigned short* to = layer == 0 ? left : right;
    #pragma unroll
    for (int p = 0; p < KT; ++p) {
        const int at = fresh(lane), g = at >> 2, q = at & 3, down = at & 15, across = at >> 4;
        float s[2][2][4];
        #pragma unroll
        for (int j = 0; j < 2; ++j) {
            const float2 v = *reinterpret_cast<const float2*>(bias + 16 * p + 8 * j + 2 * q);
            #pragma unroll
            for (int m = 0; m < 2; ++m) {
                s[m][j][0] = s[m][j][2] = v.x;
                s[m][j][1] = s[m][j][3] = v.y;
            }
        }
        #pragma unroll
        for (int k = 0; k < (layer == 0 ? 1 : KT); ++k) {
            unsigned a[4], b[4];
            Units::load_transposed(b, (layer == 0 ? w1 : w2) + Place::at(16 * k + down, 2 * p + across));
            #pragma unroll
            for (int m = 0; m < 2; ++m) {
                const int row = first + 16 * m + down;
                Units::load(a, layer == 0 ? inputs + Place::input(row, across) : left + Place::at(row, 2 * k + across));
                Units::multiply(s[m][0], a, b[0], b[1]);
                Units::multiply(s[m][1], a, b[2], b[3]);
            }
        }
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int j = 0; j < 2; ++j)
                #pragma unroll
                for (int r = 0; r < 2; ++r) {
                    unsigned* h = reinterpret_cast<unsigned*>(to + Place::at(first + 16 * m + 8 * r + g, 2 * p + j));
                    Gelu::evaluate(s[m][j][2 * r], s[m][j][2 * r + 1], h[q], slopes[layer][m][2 * p + j][r]);
                }
    }
    __syncthreads();
}

// The answers, to the threads of their samples.
{
    float y[2][4];
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int j = 0; j < 4; ++j) y[m][j] = 2 * q + (j & 1) < 3 ? o[H * 3 + 2 * q + (j & 1)] : 0.0f;
    #pragma unroll
    for (int k = 0; k < KT; ++k) {
        const float* from = o + (16 * k + 2 * q) * 3 + min(g, 2);
        const unsigned low = Units::pack(from[0], from[3]), high = Units::pack(from[24], from[27]);
        const int at = fresh(lane), down = at & 15, across = at >> 4;
        unsigned a[4];
        #pragma unroll
        for (int m = 0; m < 2; ++m) {
            Units::load(a, right + Place::at(first + 16 * m + down, 2 * k + across));
            Units::multiply(y[m], a, g < 3 ? low : 0u, g < 3 ? high : 0u);
        }
    }
    if (q < 2)
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int r = 0; r < 2; ++r) {
                unsigned* to = answers + (first + 16 * m + 8 * r + g) * 4 + 2 * q;
                to[0] = __float_as_uint(y[m][2 * r]);
                to[1] = __float_as_uint(y[m][2 * r + 1]);
            }
    __syncwarp();
}

// Loss and d3. `unit` is the exponent of the sample's largest d3, as float32 has it; halves hold it over 2^(unit - 123),
// so that its largest is near 1/16: deltas can grow a million times on their way back.
unsigned* own = answers + 4 * t;
float error[3], d3[3], value = 0.0f, most = 0.0f;
#pragma unroll
for (int c = 0; c < 3; ++c) {
    error[c] = __uint_as_float(own[c]) - target.c[c];
    const float half_of = weight.c[c] * error[c] * share;
    value += half_of * error[c];
    d3[c] = 2.0f * half_of;
    most = fmaxf(most, fabsf(d3[c]));
}
const int unit = min(max(__float_as_int(most) >> 23, 8), 240);
int widest = unit;
#pragma unroll
for (int step = 16; step > 0; step /= 2) {
    value += __shfl_xor_sync(ALL, value, step);
    widest = max(widest, __shfl_xor_sync(ALL, widest, step));
}
{
    const float into = __int_as_float((250 - unit) << 23);
    #pragma unroll
    for (int c = 0; c < 3; ++c) d3[c] *= into;
    own[0] = Units::pack(d3[0], d3[1]);
    own[1] = Units::pack(d3[2], 0.0f);
    if (lane == 0) {
        own[2] = __float_as_uint(value);
        own[3] = static_cast<unsigned>(widest);
    }
}
__syncthreads();
value = 0.0f;
#pragma unroll
for (int i = 0; i < WARPS; ++i) {
    value += __uint_as_float(answers[128 * i + 2]);
    widest = max(widest, static_cast<int>(answers[128 * i + 3]));
}
__syncthreads();
if (t == 0) loss.data[row] = value;
{
    const int behind = unit - widest;
    const float ratio = behind < -30 ? 0.0f : __int_as_float((127 + behind) << 23);
    own[2] = Units::pack(d3[0] * ratio, d3[1] * ratio);
    own[3] = Units::pack(d3[2] * ratio, ratio);
}
const float back = __int_as_float((unit + 4) << 23), back_all = __int_as_float((widest + 4) << 23);
__syncthreads();

// The third layer's gradients: [h2 1]^T d3. Columns 4 to 6 of the product are in the block's units.
const unsigned ones[4] = {0x3c003c00u, 0x3c003c00u, 0x3c003c00u, 0x3c003c00u};
float* grad_o = partial_out.data + size_t(row) * (H + 1) * 3;
for (int m = warp; m < KT; m += WARPS) {
    float s[4] = {}, bias[4] = {};
    #pragma unroll 2
    for (int k = 0; k < T / 16; ++k) {
        unsigned a[4], b[2];
        Units::load_transposed(a, right + Place::at(16 * k + down_after, 2 * m + across_first));
        Units::load_two_transposed(b, answers + (16 * k + down) * 4);
        Units::multiply(s, a, b[0], b[1]);
        if (m == 0) Units::multiply(bias, ones, b[0], b[1]);
    }
    #pragma unroll
    for (int j = 0; j < 2; ++j) {
        const int c = 2 * q + j - 4;
        if (c < 0 || c > 2) continue;
        grad_o[(16 * m + g) * 3 + c] = s[j] * back_all;
        grad_o[(16 * m + g + 8) * 3 + c] = s[2 + j] * back_all;
        if (m == 0 && g == 0) grad_o[H * 3 + c] = bias[j] * back_all;
    }
}
__syncthreads();

// d2, to `right`, and in the samples' own units as the next product's operand.
unsigned ratios[2][2], d2[2][KT][4], d1[2][KT][4];
#pragma unroll
for (int m = 0; m < 2; ++m)
    #pragma unroll
    for (int r = 0; r < 2; ++r) {
        const unsigned high = answers[(first + 16 * m + 8 * r + g) * 4 + 3] >> 16;
        ratios[m][r] = high << 16 | high;
    }
#pragma unroll
for (int p = 0; p < KT; ++p) {
    const int at = fresh(lane), g = at >> 2, q = at & 3;
    float s[2][2][4] = {};
    #pragma unroll
    for (int j = 0; j < 2; ++j) {
        const float* from = o + (16 * p + 8 * j + g) * 3;
        const unsigned b = q == 0 ? Units::pack(from[0], from[1]) : q == 1 ? Units::pack(from[2], 0.0f) : 0u;
        #pragma unroll
        for (int m = 0; m < 2; ++m) {
            const unsigned* a = answers + (first + 16 * m + g) * 4 + q;
            Units::multiply_short(s[m][j], a[0], a[32], b);
        }
    }
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int j = 0; j < 2; ++j)
            #pragma unroll
            for (int r = 0; r < 2; ++r) {
                const float2 v = Units::unpack(slopes[1][m][2 * p + j][r]);
                const unsigned d = Units::pack(s[m][j][2 * r] * v.x, s[m][j][2 * r + 1] * v.y);
                d2[m][p][2 * j + r] = d;
                unsigned* to = reinterpret_cast<unsigned*>(right + Place::at(first + 16 * m + 8 * r + g, 2 * p + j));
                to[q] = Units::scale(d, ratios[m][r]);
            }
}

// d1.
#pragma unroll
for (int p = 0; p < KT; ++p) {
    const int at = fresh(lane), down_after = (at & 7) + (at >> 4) * 8, across_first = at >> 3 & 1;
    float s[2][2][4] = {};
    #pragma unroll
    for (int k = 0; k < KT; ++k) {
        unsigned b[4];
        Units::load(b, w2 + Place::at(16 * p + down_after, 2 * k + across_first));
        #pragma unroll
        for (int m = 0; m < 2; ++m) {
            Units::multiply(s[m][0], d2[m][k], b[0], b[1]);
            Units::multiply(s[m][1], d2[m][k], b[2], b[3]);
        }
    }
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int j = 0; j < 2; ++j)
            #pragma unroll
            for (int r = 0; r < 2; ++r) {
                const float2 v = Units::unpack(slopes[0][m][2 * p + j][r]);
                d1[m][p][2 * j + r] = Units::pack(s[m][j][2 * r] * v.x, s[m][j][2 * r + 1] * v.y);
            }
}
__syncthreads();

// The gradients of the second layer, [h1 1]^T d2, and of the first one, [f 1]^T d1; d1 takes the place of h1.
float on_inputs[2][2][4] = {};
float* grad_w = partial.data + size_t(row) * (I + H + 2) * H;
#pragma unroll
for (int layer = 1; layer >= 0; --layer) {
    const int rows = layer == 0 ? I : H;
    float* to = grad_w + (layer == 0 ? 0 : (I + 1) * H);
    for (int piece = warp; piece < (layer == 0 ? 1 : KT) * KT; piece += WARPS) {
        const int m = piece / KT, p = piece % KT;
        float s[2][4] = {}, bias[2][4] = {};
        #pragma unroll 2
        for (int k = 0; k < T / 16; ++k) {
            unsigned a[4], b[4];
            const int sample = 16 * k + down_after;
            Units::load_transposed(
                a, layer == 0 ? inputs + Place::input(sample, across_first) : left + Place::at(sample, 2 * m + across_first));
            Units::load_transposed(b, (layer == 0 ? left : right) + Place::at(16 * k + down, 2 * p + across));
            #pragma unroll
            for (int j = 0; j < 2; ++j) {
                Units::multiply(s[j], a, b[2 * j], b[2 * j + 1]);
                if (m == 0) Units::multiply(bias[j], ones, b[2 * j], b[2 * j + 1]);
            }
        }
        #pragma unroll
        for (int j = 0; j < 2; ++j) {
            const int column = 16 * p + 8 * j + 2 * q;
            #pragma unroll
            for (int r = 0; r < 2; ++r) {
                const int unit_in = 16 * m + 8 * r + g;
                if (unit_in < rows)
                    *reinterpret_cast<float2*>(to + unit_in * H + column) =
                        make_float2(s[j][2 * r] * back_all, s[j][2 * r + 1] * back_all);
            }
            if (m == 0 && g == 0)
                *reinterpret_cast<float2*>(to + rows * H + column) =
                    make_float2(bias[j][0] * back_all, bias[j][1] * back_all);
        }
    }
    __syncthreads();
    if (layer == 0) continue;
    load_weights(w1, w, 16, I);
    #pragma unroll
    for (int p = 0; p < KT; ++p) {
        const int at = fresh(lane), g = at >> 2, q = at & 3;
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int j = 0; j < 2; ++j)
                #pragma unroll
                for (int r = 0; r < 2; ++r) {
                    unsigned* d = reinterpret_cast<unsigned*>(left + Place::at(first + 16 * m + 8 * r + g, 2 * p + j));
                    d[q] = Units::scale(d1[m][p][2 * j + r], ratios[m][r]);
                }
    }
    __syncthreads();
    #pragma unroll
    for (int p = 0; p < KT; ++p) {
        unsigned b[4];
        Units::load(b, w1 + Place::at(down_after, 2 * p + across_first));
        #pragma unroll
        for (int m = 0; m < 2; ++m) {
            Units::multiply(on_inputs[m][0], d1[m][p], b[0], b[1]);
            Units::multiply(on_inputs[m][1], d1[m][p], b[2], b[3]);
        }
    }
}

// The inputs' gradients, to the threads of their samples: rows of 20 numbers keep banks apart.
constexpr int WIDE = 20;
float* passed = reinterpret_cast<float*>(both);
#pragma unroll
for (int m = 0; m < 2; ++m)
    #pragma unroll
    for (int j = 0; j < 2; ++j)
        #pragma unroll
        for (int r = 0; r < 2; ++r)
            *reinterpret_cast<float2*>(passed + (first + 16 * m + 8 * r + g) * WIDE + 8 * j + 2 * q) =
                make_float2(on_inputs[m][j][2 * r], on_inputs[m][j][2 * r + 1]);
__syncwarp();
wp::vec_t<I + 4, float> result;
#pragma unroll
for (int c = 0; c < I; ++c) result.c[c] = passed[t * WIDE + c] * back;
#pragma unroll
for (int c = 0; c < 3; ++c) result.c[I + c] = error[c];
result.c[I + 3] = static_cast<float>(__cvta_generic_to_shared(passed + t * WIDE));
return result;
