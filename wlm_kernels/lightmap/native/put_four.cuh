// A GPU writes four neighbours at once, see `four_at.cuh`.
    float* to = values.data + i;
#if defined(__CUDA_ARCH__)
    const float4 all = make_float4(v.c[0], v.c[1], v.c[2], v.c[3]);
    float4* at = reinterpret_cast<float4*>(to);
    ONCE ? __stcs(at, all) : void(*at = all);
#else
    for (int c = 0; c < 4; ++c) to[c] = v.c[c];
#endif
