// The body of the function `map_inputs` of wlm_kernels/lightmap/matrix_network.py, behind `matrix_maps.cuh`.

const bool wraps = stored.periodic != 0;
wp::vec_t<12, float> result;
const uint4 own = reinterpret_cast<const uint4*>(stored.uv.data)[(size_t(n) * 32 + y / 4) * 32 + x / 4];
float f[4] = {-128.0f, -128.0f, -128.0f, -128.0f};
Ends(own).add(f, 1.0f, Ends::weight(Ends::index(own, y, x)));
for (int c = 0; c < 4; ++c) result[c] = f[c];
const int blocks = stored.uvt.shape[1], size = 4 * blocks;
const Place row((y + 0.5f) / 128.0f, size, false), column((x + 0.5f) / 128.0f, size, false);
const Place slice(tau, stored.slices, wraps);
for (int c = 0; c < 4; ++c) f[c] = -127.5f;
const uint4* volume = reinterpret_cast<const uint4*>(stored.uvt.data) + size_t(n) * stored.slices * blocks * blocks;
#pragma unroll
for (int k = 0; k < 8; ++k) {
    const int v = (k & 2) ? row.b : row.a, u = (k & 1) ? column.b : column.a;
    const uint4 block = volume[(((k & 4) ? slice.b : slice.a) * blocks + v / 4) * blocks + u / 4];
    const float share = ((k & 4) ? slice.part : 1.0f - slice.part) * ((k & 2) ? row.part : 1.0f - row.part)
        * ((k & 1) ? column.part : 1.0f - column.part);
    Ends(block).add(f, share, Ends::weight(Ends::index(block, v, u)));
}
for (int c = 0; c < 4; ++c) result[4 + c] = f[c] * SCALE;
const float2 across = plane(stored.ut, n, x, tau, wraps), down = plane(stored.vt, n, y, tau, wraps);
result[8] = across.x;
result[9] = across.y;
result[10] = down.x;
result[11] = down.y;
return result;
