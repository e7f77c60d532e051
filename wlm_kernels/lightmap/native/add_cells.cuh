// The lanes of a warp add neighbouring numbers at once, by shuffles, which Warp has no function for; nothing on the CPU.
#if defined(__CUDA_ARCH__)
    const int own = threadIdx.x & 31;
    #pragma unroll
    for (int r = 0; r < 4; ++r) {
        const int from = 8 * r + (own >> 2);
        float of[4];
        #pragma unroll
        for (int c = 0; c < 4; ++c) of[c] = __shfl_sync(0xffffffffu, v.c[c], from);
        const float mine = own & 2 ? (own & 1 ? of[3] : of[2]) : (own & 1 ? of[1] : of[0]);
        #pragma unroll
        for (int k = 0; k < 2; ++k) {
            const int low = __shfl_sync(0xffffffffu, k == 0 ? early.c[0] : late.c[0], from);
            const int high = __shfl_sync(0xffffffffu, k == 0 ? early.c[1] : late.c[1], from);
            const float share = __shfl_sync(0xffffffffu, k == 0 ? 1.0f - ft : ft, from);
            const long long steps = static_cast<long long>(share * mine * 1099511627776.0f);
            atomicAdd(reinterpret_cast<unsigned long long*>(acc.data + (own & 2 ? high : low) + (own & 1)),
                      static_cast<unsigned long long>(steps));
        }
    }
#endif
