// Evaluates a network of a lightmap's tile for 32 texels on the matrix units: a warp multiplies the inputs of its 32 lanes
// with the weights. Numbers are half floats, two to a register; those of the last layer's sums are floats.
//
// Native, since Warp's tiles go through shared memory between layers: here the sums of one layer are the operand of the
// next one as they lie in the registers (`matrix_units.cuh`).
//
// Part of the bodies of native functions, behind `matrix_units.cuh`. A function defines:
//   H          hidden width, a multiple of 16
// The weights are those of `pack_networks` in wlm_kernels/lightmap/matrix_network.py.

constexpr int NT = H / 8, KT = H / 16;  // columns of 8 units, and steps of 16, in a layer
constexpr int W1 = NT * 64, W2 = KT * NT * 64, W3 = 2 * KT * 64, B2 = H / 2, WORDS = W1 + W2 + W3 + B2 + 4;
const int lane = threadIdx.x & 31, g = lane >> 2, q = lane & 3;

// GELU of two numbers by its tanh form, x (1 + tanh(0.79788 x + 0.035677 x^3)) / 2. Numbers are scaled so that the factor
// of x^3 is 1, and the result is doubled; `pack_networks` scales the weights.
auto gelu = [](unsigned x) {
    const unsigned slope = Units::fma(x, x, 0x40d940d9u);
    return Units::fma(x, Units::tanh(Units::scale(x, slope)), x);
};
// The operand of a layer for eight units and 16 inputs.
auto pair = [&](const unsigned* of, int i) { return *reinterpret_cast<const uint2*>(of + (i * 32 + lane) * 2); };
// Returns the outputs of texel 8 q + g of the 32.
//   b          of two groups of 16 texels the left operands of the first layer, [0] of each; overwritten
//   first      returns the weights of the first layer's units 8 i to 8 i + 7, its bias among them
//   later      the weights of the other layers
auto network = [&](unsigned (&b)[2][KT][4], auto first, const unsigned* later) {
    const unsigned *w2 = later, *w3 = later + W2, *b2 = w3 + W3;
    const float* b3 = reinterpret_cast<const float*>(b2 + B2);
    unsigned a[2][KT][4];
    // Two groups of 16 texels, so that a weight that is read serves both.
    #pragma unroll
    for (int i = 0; i < NT; ++i) {
        const uint2 of = first(i);
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
    return make_float3(odd ? one : s[0], odd ? other : s[1], odd ? s[2] : one);
};
