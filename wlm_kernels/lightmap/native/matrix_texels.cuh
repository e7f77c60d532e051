// Evaluates the networks of any 32 texels: each lane of a warp brings a texel and the number of its tile, and the warp
// evaluates the network of one tile after another for all lanes. Neighbouring texels are mostly of one tile.
//
// The body of the function `evaluate` of `matrix_texels` in wlm_kernels/lightmap/matrix_network.py, behind
// `matrix_network.cuh`. All lanes of a warp must call it, in blocks of 128 threads; a lane without a texel has n < 0.

__shared__ uint4 staged[2][128];
const int t = threadIdx.x;
wp::vec_t<3, float> result;
unsigned waiting = __ballot_sync(~0u, n >= 0);
if (waiting == 0u) return result;
staged[0][t] = make_uint4(Units::pack(f[0], f[1]), Units::pack(f[2], f[3]), Units::pack(f[4], f[5]), Units::pack(f[6], f[7]));
// The inputs 12 and 13 are 1: their weights are the bias, which contains the time, in two halves.
staged[1][t] = make_uint4(Units::pack(f[8], f[9]), Units::pack(f[10], f[11]), 0x3c003c00u, 0u);
__syncwarp();
unsigned early[4], late[4];
Units::load(early, &staged[0][t]);
Units::load(late, &staged[1][t]);
__syncwarp();
while (waiting != 0u) {
    const int leader = __ffs(waiting) - 1, tile = __shfl_sync(~0u, n, leader), at = __shfl_sync(~0u, time, leader);
    float share[4];
    for (int c = 0; c < 4; ++c) share[c] = __shfl_sync(~0u, encoding[c], leader);
    // A lane computes the biases of the units 32 j + lane.
    constexpr int OWN = (H + 31) / 32;
    const float* of = reinterpret_cast<const float*>(biases.data) + size_t(tile) * 5 * H;
    float bias[OWN];
    #pragma unroll
    for (int j = 0; j < OWN; ++j) {
        const int unit = min(32 * j + lane, H - 1);
        bias[j] = of[unit];
        for (int c = 0; c < 4; ++c) bias[j] += share[c] * of[(c + 1) * H + unit];
    }
    const unsigned* weights = packed.data + size_t(tile) * WORDS;
    unsigned b[2][KT][4];
    #pragma unroll
    for (int m = 0; m < 2; ++m)
        #pragma unroll
        for (int j = 0; j < 2; ++j) {
            b[m][0][j] = early[2 * m + j];
            b[m][0][2 + j] = late[2 * m + j];
        }
    const float3 output = network(
        b,
        [&](int i) {
            uint2 word = pair(weights, i);
            const float whole = __shfl_sync(~0u, bias[i / 4], 8 * (i & 3) + g);
            const unsigned two = Units::pack(whole, whole - Units::unpack(Units::pack(whole, 0.0f)).x);
            return make_uint2(word.x, q == 2 ? two : word.y);
        },
        weights + W1
    );
    // Of the 32 texels, a lane has the result of another one than it brought.
    const int from = 4 * (lane & 7) + (lane >> 3);
    const float red = __shfl_sync(~0u, output.x, from), green = __shfl_sync(~0u, output.y, from);
    const float blue = __shfl_sync(~0u, output.z, from);
    const bool own = n == tile && time == at;
    if (own) result = wp::vec_t<3, float>(red, green, blue);
    waiting &= ~__ballot_sync(~0u, own);
}
return result;
