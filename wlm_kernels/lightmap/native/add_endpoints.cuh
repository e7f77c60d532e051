// The lanes of a warp add to one block's sums at once, by shuffles, which Warp has no function for; nothing on the CPU.
#if defined(__CUDA_ARCH__)
    const int own = threadIdx.x & 31;
    const unsigned any = __ballot_sync(0xffffffffu, at >= 0);
    #pragma unroll
    for (int r = 0; r < 8; ++r) {
        if ((any >> (4 * r) & 15u) == 0u) continue;
        const int from = 4 * r + (own >> 3), to = __shfl_sync(0xffffffffu, at, from);
        const float first = __shfl_sync(0xffffffffu, a, from), second = __shfl_sync(0xffffffffu, b, from);
        const long long steps = static_cast<long long>((own & 4 ? second : first) * g.c[r] * 1099511627776.0f);
        if (to >= 0)
            atomicAdd(reinterpret_cast<unsigned long long*>(acc.data + to + (own & 7)),
                      static_cast<unsigned long long>(steps));
    }
#endif
