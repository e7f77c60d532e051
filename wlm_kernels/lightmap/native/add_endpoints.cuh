// Lanes of a warp add to blocks' sums together, by shuffles, which Warp has no function for; nothing on the CPU.
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int own = threadIdx.x & 31;
    const bool upper = own & 2, odd = own & 1;
    // Groups of four lanes with one block, or without any, add their total: each lane two of its eight numbers.
    int block = max(at, __shfl_xor_sync(all, at, 1));
    block = max(block, __shfl_xor_sync(all, block, 2));
    const unsigned differ = __ballot_sync(all, at >= 0 && at != block);
    const bool together = block >= 0 && (differ >> (own & 28) & 15u) == 0u;
    if (__any_sync(all, together)) {
        float half[4];
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
            const float share = i < 2 ? a : b, low = share * g.c[i & 1], high = share * g.c[(i & 1) + 2];
            half[i] = (upper ? high : low) + __shfl_xor_sync(all, upper ? low : high, 2);
        }
        #pragma unroll
        for (int i = 0; i < 2; ++i) {
            const float low = half[2 * i], high = half[2 * i + 1];
            const float sum = (odd ? high : low) + __shfl_xor_sync(all, odd ? low : high, 1);
            const long long steps = static_cast<long long>(sum * 1099511627776.0f);
            if (together)
                atomicAdd(reinterpret_cast<unsigned long long*>(acc.data + block + 4 * i + (own & 3)),
                          static_cast<unsigned long long>(steps));
        }
    }
    // Of other groups, eight lanes add the numbers of one lane, four at a time.
    #pragma unroll
    for (int r = 0; r < 8; ++r) {
        if ((differ >> (4 * r) & 15u) == 0u) continue;
        const int from = 4 * r + (own >> 3), to = __shfl_sync(all, at, from);
        const float first = __shfl_sync(all, a, from), second = __shfl_sync(all, b, from);
        float of[4];
        #pragma unroll
        for (int c = 0; c < 4; ++c) of[c] = __shfl_sync(all, g.c[c], from);
        const float mine = upper ? (odd ? of[3] : of[2]) : (odd ? of[1] : of[0]);
        const long long steps = static_cast<long long>((own & 4 ? second : first) * mine * 1099511627776.0f);
        if (to >= 0)
            atomicAdd(reinterpret_cast<unsigned long long*>(acc.data + to + (own & 7)),
                      static_cast<unsigned long long>(steps));
    }
#endif
