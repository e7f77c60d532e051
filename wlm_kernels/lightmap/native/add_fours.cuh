// The lanes of a warp add to the sums of one sample, then of another, so that neighbours in memory are added at once;
// samples pass through their rows of shared memory.
#if defined(__CUDA_ARCH__)
    constexpr int WIDE = 20;  // numbers in a row, as in `matrix_step.cuh`
    const int own = threadIdx.x & 31;
    const int then = first < 0 ? -1 : second;
    float* mine = static_cast<float*>(__cvta_shared_to_generic(row));
    // Steps of 2^-40.
    reinterpret_cast<float4*>(mine)[0] =
        make_float4(__int_as_float(first), a * 1099511627776.0f, __int_as_float(then), b * 1099511627776.0f);
    reinterpret_cast<float4*>(mine)[1] = make_float4(g.c[0], g.c[1], g.c[2], g.c[3]);
    const unsigned any = __ballot_sync(0xffffffffu, first >= 0);
    __syncwarp();
    const float* from = mine + ((own >> 3) - own) * WIDE;
    #pragma unroll
    for (int r = 0; r < 8; ++r, from += 4 * WIDE) {
        if ((any >> (4 * r) & 15u) == 0u) continue;
        const float2 each = *reinterpret_cast<const float2*>(from + (own & 4) / 2);
        const int to = __float_as_int(each.x);
        const float steps = each.y * from[4 + (own & 3)];
        if (to >= 0 && steps != 0.0f)  // beyond the last cell of the last row is no sum
            atomicAdd(reinterpret_cast<unsigned long long*>(acc.data + to + (own & 3)),
                      static_cast<unsigned long long>(static_cast<long long>(steps)));
    }
    __syncwarp();
#endif
