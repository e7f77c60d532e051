// The weights of ordinary kriging by a warp: each of the first `count` lanes brings a row of the covariances of N probes and
// the covariance of its probe with the block, and gets the weight of its probe. Gaussian elimination of two systems, for the
// covariance with the block and for ones, without exchange of rows: the matrix is positive definite.

const int lane = threadIdx.x % 32;
float a[N], u = lane < count ? hat : 0.0f, v = lane < count ? 1.0f : 0.0f, diagonal = 1.0f;
#pragma unroll
for (int j = 0; j < N; ++j) a[j] = lane < count ? row[j] : 0.0f;
#pragma unroll
for (int j = 0; j < N; ++j)
    if (j < count) {
        const float pivot = __shfl_sync(~0u, a[j], j), factor = lane == j ? 0.0f : a[j] / pivot;
        if (lane == j) diagonal = pivot;
        #pragma unroll
        for (int m = j + 1; m < N; ++m) a[m] -= factor * __shfl_sync(~0u, a[m], j);
        u -= factor * __shfl_sync(~0u, u, j);
        v -= factor * __shfl_sync(~0u, v, j);
    }
u /= diagonal;
v /= diagonal;
float sum_u = u, sum_v = v;
for (int step = 16; step > 0; step /= 2) {
    sum_u += __shfl_xor_sync(~0u, sum_u, step);
    sum_v += __shfl_xor_sync(~0u, sum_v, step);
}
return lane < count ? u + (1.0f - sum_u) / sum_v * v : 0.0f;
