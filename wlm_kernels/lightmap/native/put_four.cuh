// A GPU writes four neighbours at once.
    float* to = values.data + i;
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(to) = make_float4(v.c[0], v.c[1], v.c[2], v.c[3]);
#else
    for (int c = 0; c < 4; ++c) to[c] = v.c[c];
#endif
