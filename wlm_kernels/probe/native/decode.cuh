// The network of a block of points (gaussian-probe-compression, eq. 7), after layers.cuh: the partial sums of each point's
// Gaussians are added in shared memory, and the outputs are written in rows, those of points in the region `own`, or of all
// if it is negative. Constants from wlm_kernels/probe/decode.py:
// OUT numbers of a point, and one output more, D = OUT + 1, if that is the magnitude; AMBIENT of them are clamped at 0.
// The reference is benchmarks/probe_exact.py; layers.cuh gives the reason for native code.

const int t = threadIdx.x, first = block * P, part = t / P, point = t % P;
const float* w1 = net.data, *w2 = w1 + SECOND, *w3 = w1 + THIRD;
if (part == 0) {
    for (int c = 0; c < 3; ++c) X[(L + c) * LD + point] = x[c];
}
for (int turn = 0; turn < T / P; ++turn) {
    if (part == turn) {
        #pragma unroll
        for (int c = 0; c < L; ++c) {
            float& sum = X[c * LD + point];
            sum = turn == 0 ? f.c[c] : sum + f.c[c];
        }
    }
    __syncthreads();
}
forward(X, I, w1, A);
forward(A, H, w2, B);
last(B, w3, [&](int c, int p, float y) { E[c * LD + p] = y; });
__syncthreads();
for (int m = t; m < P * OUT; m += T) {
    const int p = m / OUT, c = m % OUT;
    float value = gain * E[c * LD + p];
    if (D > OUT) value *= expf(fminf(E[(D - 1) * LD + p], 0.0f));
    if (c < AMBIENT) value = fmaxf(value, 0.0f);
    if (first + p < count && (own < 0 || region.data[first + p] == own)) out.data[size_t(first) * OUT + m] = value;
}
