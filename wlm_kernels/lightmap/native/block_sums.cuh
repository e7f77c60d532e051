// Sums over a CUDA block of THREADS samples that are the gradients of a network: three matrix products,
// [f 1]^T d1, [h1 1]^T d2 and [h2 1]^T d3. The 1 behind the inputs gives the bias; the loss is the fourth column of d3.
//
// Native, since with wp.tile_matmul the products were a third of a training step on an H200: Warp's tiles have no fast
// products of this size. Samples are staged in shared memory; a pair of threads sums a 4 x 4 piece of a product in
// registers, one the even samples and one the odd. The order of the additions is fixed.
//
// The body of the function `reduce` of wlm_kernels/lightmap/reduce.py, which defines its arguments and these constants:
//   I, H             inputs and hidden width of the network
//   THREADS, STAGED  threads of a block, and samples that are staged at a time
//   F, D1, H1, D2, H2, D3, STRIDE  floats before each vector of a staged sample, and between two samples
//   B1, B2, B3, ACROSS             pieces of each product, and pieces of the first two in a row

__shared__ __align__(16) float staged[STAGED * STRIDE];
const int t = threadIdx.x;
for (int chunk = 0; chunk < THREADS / STAGED; ++chunk) {
    __syncthreads();
    if (t / STAGED == chunk) {
        float* s = staged + (t % STAGED) * STRIDE;
        #pragma unroll
        for (int c = 0; c < I; ++c) s[F + c] = f.c[c];
        s[F + I] = 1.0f;
        #pragma unroll
        for (int c = 0; c < H; ++c) {
            s[D1 + c] = d1.c[c];
            s[H1 + c] = h1.c[c];
            s[D2 + c] = d2.c[c];
            s[H2 + c] = h2.c[c];
        }
        s[H1 + H] = 1.0f;
        s[H2 + H] = 1.0f;
        for (int c = 0; c < 3; ++c) s[D3 + c] = d3.c[c];
        s[D3 + 3] = value;
    }
    __syncthreads();
    for (int base = 0; base < B1 + B2 + B3; base += THREADS / 2) {
        const int item = base + t / 2;
        int layer = 0, r = 0, c = 0, left = 0, right = 0;
        if (item < B1) {
            r = item / ACROSS * 4; c = item % ACROSS * 4;
            left = F + r; right = D1 + c;
        } else if (item < B1 + B2) {
            layer = 1; r = (item - B1) / ACROSS * 4; c = (item - B1) % ACROSS * 4;
            left = H1 + r; right = D2 + c;
        } else {
            layer = 2; r = min(item - B1 - B2, B3 - 1) * 4;
            left = H2 + r; right = D3;
        }
        float sum[4][4] = {};
        for (int k = t % 2; k < STAGED; k += 2) {
            const float4 a = *reinterpret_cast<const float4*>(staged + k * STRIDE + left);
            const float4 b = *reinterpret_cast<const float4*>(staged + k * STRIDE + right);
            const float u[4] = {a.x, a.y, a.z, a.w}, v[4] = {b.x, b.y, b.z, b.w};
            #pragma unroll
            for (int i = 0; i < 4; ++i)
                #pragma unroll
                for (int j = 0; j < 4; ++j) sum[i][j] += u[i] * v[j];
        }
        #pragma unroll
        for (int i = 0; i < 4; ++i)
            #pragma unroll
            for (int j = 0; j < 4; ++j) sum[i][j] += __shfl_xor_sync(0xffffffffu, sum[i][j], 1);
        if (item >= B1 + B2 + B3) continue;
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
            if (i / 2 != t % 2) continue;  // each of the pair writes two rows
            const int at = r + i;
            #pragma unroll
            for (int j = 0; j < 4; ++j) {
                float* out = nullptr;
                if (layer == 0 && at <= I && c + j < H)
                    out = partial.data + (size_t(row) * (I + H + 2) + at) * H + c + j;
                if (layer == 1 && at <= H && c + j < H)
                    out = partial.data + (size_t(row) * (I + H + 2) + I + 1 + at) * H + c + j;
                if (layer == 2 && at <= H && j < 3) out = partial_out.data + (size_t(row) * (H + 1) + at) * 3 + j;
                if (layer == 2 && at == H && j == 3) out = loss.data + row;
                if (out) *out = chunk == 0 ? sum[i][j] : *out + sum[i][j];
            }
        }
    }
}
