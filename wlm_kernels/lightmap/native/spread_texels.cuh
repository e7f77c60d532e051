// The lanes of a warp exchange gradients by shuffles, which Warp has no function for; nothing on the CPU.
#if defined(__CUDA_ARCH__)
    const int own = threadIdx.x & 31;
    wp::vec_t<8, float> mine;
    #pragma unroll
    for (int r = 0; r < 8; ++r) {
        float of[4];
        #pragma unroll
        for (int c = 0; c < 4; ++c) of[c] = __shfl_sync(0xffffffffu, g.c[c], 4 * r + (own >> 3));
        mine.c[r] = own & 2 ? (own & 1 ? of[3] : of[2]) : (own & 1 ? of[1] : of[0]);
    }
    return mine;
#else
    return wp::vec_t<8, float>();
#endif
