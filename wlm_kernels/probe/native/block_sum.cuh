// The sum of a vector of N floats over a block of 32 * WARPS threads, in a fixed order, into row k of an array; constants
// from wlm_kernels/probe/step.py. The code is native because a sum by atomics would change from run to run: it adds by
// shuffles within each warp, then adds the warps in turn.

__shared__ float parts[WARPS][N];
const int t = threadIdx.x;
#pragma unroll
for (int c = 0; c < N; ++c) {
    float x = v.c[c];
    #pragma unroll
    for (int step = 16; step > 0; step /= 2) x += __shfl_down_sync(0xffffffffu, x, step);
    if (t % 32 == 0) parts[t / 32][c] = x;
}
__syncthreads();
if (t < N) {
    float x = 0.0f;
    for (int w = 0; w < WARPS; ++w) x += parts[w][t];
    out.data[size_t(k) * N + t] = x;
}
