"""Sums over a CUDA block of samples, as native code: Warp's tiles have no products this small that are fast."""

import warp as wp

from wlm_kernels import mlp

__all__ = ["BLOCK", "block_reduction", "reload"]

BLOCK = 128  # threads of a CUDA block; the samples of a tile are a multiple of it there


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("" ::: "memory");
#endif
""")
def reload():
    """Keeps the compiler from holding the weights that the forward pass loaded for the backward pass.

    They are hundreds of registers, which it would spill to memory; loading them again hits the cache.
    """


def block_reduction(net: mlp.MlpKernels):
    """The sums over a block of 128 samples that the networks' gradients are, on CUDA, in a fixed order.

    They are three matrix products, [f 1]^T d1, [h1 1]^T d2 and [h2 1]^T d3: a 1 behind the inputs gives the bias, the
    loss rides as a fourth column of d3. Samples are staged in shared memory; a pair of threads sums a 4x4 piece of a
    product in registers, one the even samples and one the odd. (With ``wp.tile_matmul`` the products were a third
    of a step on an H200.)
    """
    inputs, hidden = net.inputs, net.hidden

    def round4(n: int) -> int:
        return -(-n // 4) * 4

    # Where each vector of a sample begins; the stride is an odd multiple of 4, so that threads hit different banks.
    sizes = [round4(inputs + 1), round4(hidden), round4(hidden + 1), round4(hidden), round4(hidden + 1), 4]
    starts = [sum(sizes[:i]) for i in range(6)]
    stride = sum(sizes) + (4 if sum(sizes) % 8 == 0 else 0)
    staged = next(s for s in (128, 64, 32, 16) if s * stride * 4 <= 46 * 1024)
    blocks_1, blocks_2, blocks_3 = (
        sizes[0] // 4 * (sizes[1] // 4),
        sizes[2] // 4 * (sizes[3] // 4),
        sizes[4] // 4,
    )
    snippet = f"""
    constexpr int I = {inputs}, H = {hidden}, STRIDE = {stride}, STAGED = {staged}, THREADS = {BLOCK};
    constexpr int B1 = {blocks_1}, B2 = {blocks_2}, B3 = {blocks_3}, ACROSS = {sizes[1] // 4};
    __shared__ __align__(16) float staged[STAGED * STRIDE];
    const int t = threadIdx.x;
    for (int chunk = 0; chunk < THREADS / STAGED; ++chunk) {{
        __syncthreads();
        if (t / STAGED == chunk) {{
            float* s = staged + (t % STAGED) * STRIDE;
            #pragma unroll
            for (int c = 0; c < I; ++c) s[{starts[0]} + c] = f.c[c];
            s[{starts[0]} + I] = 1.0f;
            #pragma unroll
            for (int c = 0; c < H; ++c) {{
                s[{starts[1]} + c] = d1.c[c];
                s[{starts[2]} + c] = h1.c[c];
                s[{starts[3]} + c] = d2.c[c];
                s[{starts[4]} + c] = h2.c[c];
            }}
            s[{starts[2]} + H] = 1.0f;
            s[{starts[4]} + H] = 1.0f;
            for (int c = 0; c < 3; ++c) s[{starts[5]} + c] = d3.c[c];
            s[{starts[5]} + 3] = value;
        }}
        __syncthreads();
        for (int base = 0; base < B1 + B2 + B3; base += THREADS / 2) {{
            const int item = base + t / 2;
            int layer = 0, r = 0, c = 0, left = 0, right = 0;
            if (item < B1) {{
                r = item / ACROSS * 4; c = item % ACROSS * 4;
                left = {starts[0]} + r; right = {starts[1]} + c;
            }} else if (item < B1 + B2) {{
                layer = 1; r = (item - B1) / ACROSS * 4; c = (item - B1) % ACROSS * 4;
                left = {starts[2]} + r; right = {starts[3]} + c;
            }} else {{
                layer = 2; r = min(item - B1 - B2, B3 - 1) * 4;
                left = {starts[4]} + r; right = {starts[5]};
            }}
            float sum[4][4] = {{}};
            for (int k = t % 2; k < STAGED; k += 2) {{
                const float4 a = *reinterpret_cast<const float4*>(staged + k * STRIDE + left);
                const float4 b = *reinterpret_cast<const float4*>(staged + k * STRIDE + right);
                const float u[4] = {{a.x, a.y, a.z, a.w}}, v[4] = {{b.x, b.y, b.z, b.w}};
                #pragma unroll
                for (int i = 0; i < 4; ++i)
                    #pragma unroll
                    for (int j = 0; j < 4; ++j) sum[i][j] += u[i] * v[j];
            }}
            #pragma unroll
            for (int i = 0; i < 4; ++i)
                #pragma unroll
                for (int j = 0; j < 4; ++j) sum[i][j] += __shfl_xor_sync(0xffffffffu, sum[i][j], 1);
            if (item >= B1 + B2 + B3) continue;
            #pragma unroll
            for (int i = 0; i < 4; ++i) {{
                if (i / 2 != t % 2) continue;  // each of the pair writes two rows
                const int at = r + i;
                #pragma unroll
                for (int j = 0; j < 4; ++j) {{
                    float* out = nullptr;
                    if (layer == 0 && at <= I && c + j < H)
                        out = partial.data + (size_t(row) * (I + H + 2) + at) * H + c + j;
                    if (layer == 1 && at <= H && c + j < H)
                        out = partial.data + (size_t(row) * (I + H + 2) + I + 1 + at) * H + c + j;
                    if (layer == 2 && at <= H && j < 3) out = partial_out.data + (size_t(row) * (H + 1) + at) * 3 + j;
                    if (layer == 2 && at == H && j == 3) out = loss.data + row;
                    if (out) *out = chunk == 0 ? sum[i][j] : *out + sum[i][j];
                }}
            }}
        }}
    }}
    """
    vec_in, vec_hidden = net.vec_in, net.vec_hidden

    @wp.func_native(snippet)
    def reduce(
        f: vec_in,
        h1: vec_hidden,
        h2: vec_hidden,
        d1: vec_hidden,
        d2: vec_hidden,
        d3: wp.vec3,
        value: float,
        row: int,
        partial: wp.array2d[float],
        partial_out: wp.array2d[float],
        loss: wp.array1d[float],
    ): ...

    return reduce
