// A GPU reads four neighbours at once; of numbers that are used ONCE in a step, its cache keeps others longer.
    const float* from = values.data + i;
#if defined(__CUDA_ARCH__)
    const float4* at = reinterpret_cast<const float4*>(from);
    const float4 v = ONCE ? __ldcs(at) : *at;
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return wp::vec_t<4, float>(from[0], from[1], from[2], from[3]);
#endif
