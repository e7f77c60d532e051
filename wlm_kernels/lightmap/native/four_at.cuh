// A GPU reads four neighbours at once.
    const float* from = values.data + i;
#if defined(__CUDA_ARCH__)
    const float4 v = *reinterpret_cast<const float4*>(from);
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return wp::vec_t<4, float>(from[0], from[1], from[2], from[3]);
#endif
