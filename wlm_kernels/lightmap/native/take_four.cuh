// A GPU reads and writes two neighbours at once.
    long long v[4];
#if defined(__CUDA_ARCH__)
    longlong2* from = reinterpret_cast<longlong2*>(&wp::index(sums, 0, 4 * i));
    const longlong2 low = from[0], high = from[1];
    v[0] = low.x, v[1] = low.y, v[2] = high.x, v[3] = high.y;
    from[0] = from[1] = make_longlong2(0, 0);
#else
    for (int c = 0; c < 4; ++c) v[c] = wp::index(sums, 0, 4 * i + c), wp::index(sums, 0, 4 * i + c) = 0;
#endif
    return wp::vec_t<4, float>(
        static_cast<float>(v[0]), static_cast<float>(v[1]), static_cast<float>(v[2]), static_cast<float>(v[3]));
