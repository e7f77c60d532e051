// A GPU reads two numbers of one aligned four at once.
#if defined(__CUDA_ARCH__)
    const float4 v = *reinterpret_cast<const float4*>(values.data + (i & ~3));
    const auto of = [&](int k) { return k & 2 ? (k & 1 ? v.w : v.z) : (k & 1 ? v.y : v.x); };
    return wp::vec_t<2, float>(of(i), (i ^ j) < 4 ? of(j) : values.data[j]);
#else
    return wp::vec_t<2, float>(values.data[i], values.data[j]);
#endif
