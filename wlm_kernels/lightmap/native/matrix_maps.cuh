// Reads a lightmap's stored feature maps as integers: BC7 blocks of mode 6, and planes of bytes.
//
// Part of the bodies of native functions, behind `matrix_units.cuh`.

constexpr float SCALE = 3.4641016151377544f / 255.0f;  // from bytes to the inputs of a network

// The endpoints of a block of BC7 mode 6, so that a texel's bytes are (a + w d) / 64, rounded, for two channels at once.
struct Ends {
    unsigned a01, a23, d01, d23;
    __device__ Ends(const uint4& b) {
        const unsigned p = (b.y >> 31) * 0x10001u, o = (b.z & 1u) * 0x10001u;
        a01 = 2 * (b.x >> 7 & 127u | b.x >> 5 & 0x7f0000u) + p;
        a23 = 2 * (b.y >> 3 & 127u | b.y >> 1 & 0x7f0000u) + p;
        d01 = 2 * (b.x >> 14 & 127u | __funnelshift_r(b.x, b.y, 12) & 0x7f0000u) + o - a01;
        d23 = 2 * (b.y >> 10 & 127u | b.y >> 8 & 0x7f0000u) + o - a23;
        a01 = 64 * a01 + 0x200020u;
        a23 = 64 * a23 + 0x200020u;
    }
    // The weight of an index in 64ths, which is (64 index + 7) / 15.
    static __device__ unsigned weight(unsigned index) { return index * 279680u + 30590u >> 16; }
    // The index of a texel in its block.
    static __device__ unsigned index(const uint4& block, int y, int x) {
        const unsigned word = (y & 2) ? block.w : block.z;
        return (y & 3) + (x & 3) == 0 ? word >> 1 & 7u : word >> (16 * (y & 1) + 4 * (x & 3)) & 15u;
    }
    static __device__ unsigned bytes(unsigned a, unsigned d, unsigned w) { return a + w * d >> 6 & 0xff00ffu; }
    // Bytes less 128 as halves: 0x6400 is 1024, whose lowest bit is 1.
    static __device__ unsigned halves(unsigned two) { return Units::add(two | 0x64006400u, 0xe480e480u); }
    // Adds a share of a texel's four bytes to numbers.
    __device__ void add(float* f, float share, unsigned weight) const {
        const unsigned low = bytes(a01, d01, weight), high = bytes(a23, d23, weight);
        f[0] += share * (low & 255u);
        f[1] += share * (low >> 16);
        f[2] += share * (high & 255u);
        f[3] += share * (high >> 16);
    }
};
// A position on an axis of `size` cells, see wlm_kernels/interpolate.py.
struct Place {
    int a, b;
    float part;
    __device__ Place(float p, int size, bool wraps) {
        const float at = p * size - 0.5f, low = floorf(at);
        a = (int)low;
        b = a + 1;
        part = at - low;
        a = wraps ? (a + size) % size : max(a, 0);
        b = wraps ? b % size : min(b, size - 1);
    }
};
// The two inputs that come from F_ut of tile n at column i of its texels, or from F_vt at row i.
auto plane = [](const wp::array_t<wp::vec_t<2, wp::uint8>>& of, int n, int i, float tau, bool wraps) {
    const int rows = of.shape[1], columns = of.shape[2];
    const Place row(tau, rows, wraps), column((i + 0.5f) / 128.0f, columns, false);
    const uchar2* at = reinterpret_cast<const uchar2*>(of.data) + size_t(n) * rows * columns;
    float2 f = make_float2(0.0f, 0.0f);
    for (int k = 0; k < 4; ++k) {
        const uchar2 v = at[((k & 2) ? row.b : row.a) * columns + ((k & 1) ? column.b : column.a)];
        const float share = ((k & 2) ? row.part : 1.0f - row.part) * ((k & 1) ? column.part : 1.0f - column.part);
        f.x += share * v.x;
        f.y += share * v.y;
    }
    return make_float2((f.x - 127.5f) * SCALE, (f.y - 127.5f) * SCALE);
};
