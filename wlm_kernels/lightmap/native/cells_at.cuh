// A GPU reads the cells i and j at once where they are halves of one aligned four.
#if defined(__CUDA_ARCH__)
    const float4 v = *reinterpret_cast<const float4*>(values.data + (i & ~3));
    const float2 low = make_float2(v.x, v.y), high = make_float2(v.z, v.w), a = i & 2 ? high : low;
    const float2 b = (i ^ j) < 4 ? (j & 2 ? high : low) : *reinterpret_cast<const float2*>(values.data + j);
    return wp::vec_t<4, float>(a.x, a.y, b.x, b.y);
#else
    return wp::vec_t<4, float>(values.data[i], values.data[i + 1], values.data[j], values.data[j + 1]);
#endif
