// Four lanes add to the sums of one sample, neighbours in memory at once, then of another sample, see `add_fours.cuh`.
#if defined(__CUDA_ARCH__)
    constexpr int WIDE = 20;
    const int own = threadIdx.x & 31;
    float* mine = static_cast<float*>(__cvta_shared_to_generic(row));
    #pragma unroll
    for (int q = 0; q < 4; ++q) mine[8 + q] = __int_as_float(at.c[q]), mine[12 + q] = v.c[q] * 1099511627776.0f;
    __syncwarp();
    const float* from = mine + ((own >> 2) - own) * WIDE + 8 + (own & 3);
    #pragma unroll
    for (int r = 0; r < 4; ++r, from += 8 * WIDE)
        atomicAdd(reinterpret_cast<unsigned long long*>(acc.data + __float_as_int(from[0])),
                  static_cast<unsigned long long>(static_cast<long long>(from[4])));
    __syncwarp();
#endif
