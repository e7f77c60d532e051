// A GPU reads the four numbers at once, where Warp reads one after the other.
#if defined(__CUDA_ARCH__)
    const float4 v = *reinterpret_cast<const float4*>(&wp::index(values, s, y, x, e));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return wp::index(values, s, y, x, e);
#endif
