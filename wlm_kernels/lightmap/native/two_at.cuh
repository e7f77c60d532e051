// A GPU reads two neighbours at once.
#if defined(__CUDA_ARCH__)
    const float2 v = *reinterpret_cast<const float2*>(values.data + i);
    return wp::vec_t<2, float>(v.x, v.y);
#else
    return wp::vec_t<2, float>(values.data[i], values.data[i + 1]);
#endif
