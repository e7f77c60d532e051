// Word m of a packed network, behind decode_layout.cuh. The weights are those of wlm_kernels/probe/network.py.

constexpr int DP = (D + 3) / 4 * 4, BASE2 = (I + 1) * H, BASE3 = BASE2 + (H + 1) * H;
auto weight = [&](int layer, int row, int unit) {
    const int base = layer == 0 ? 0 : layer == 1 ? BASE2 : BASE3, rows = layer == 0 ? I : H, stride = layer < 2 ? H : DP;
    const int column = layer < 2 || FIRST == 0 ? unit : unit == 0 ? D - 1 : unit < D ? unit - 1 : D;
    // A row of -1 has the biases.
    if (row >= rows || column >= (layer < 2 ? H : D)) return 0.0f;
    return net.data[base + (row < 0 ? rows : row) * stride + column];
};
if (m >= 4 * END) {
    const int b = m - 4 * END, layer = b < 16 * KH ? 0 : b < 32 * KH ? 1 : 2;
    return weight(layer, -1, b - 16 * KH * layer);
}
const int four = m / 4, word = m % 4, lane = four % 32, g = lane / 4, q = lane % 4;
const int layer = four < SECOND ? 0 : four < THIRD ? 1 : 2;
const int tile = (four - (layer == 0 ? 0 : layer == 1 ? SECOND : THIRD)) / 32, wide = layer < 2 ? KH : N;
const int row = tile / wide * 16 + word % 2 * 8 + 2 * q, unit = (layer < 2 ? 2 * (tile % wide) + word / 2 : tile % wide) * 8 + g;
union { float number; unsigned bits; } result;
result.bits = 0;
for (int e = 0; e < 2; ++e) {
    const float w = weight(layer, row + e, unit);
    wp::half h = wp::float_to_half(w);
    if (layer == 2 && word / 2 == 1) h = wp::float_to_half(w - wp::half_to_float(h));
    result.bits |= unsigned(h.u) << 16 * e;
}
return result.number;
