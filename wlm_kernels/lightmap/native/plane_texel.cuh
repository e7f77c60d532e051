// A GPU reads both numbers at once, where Warp reads one after the other.
#if defined(__CUDA_ARCH__)
    const float2 v = *reinterpret_cast<const float2*>(&wp::index(values, n, t, x));
    return wp::vec_t<2, float>(v.x, v.y);
#else
    return wp::index(values, n, t, x);
#endif
