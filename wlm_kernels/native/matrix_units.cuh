// What kernels need to use a GPU's matrix units: operands of half floats, sums of float32 (PTX ISA, "matrix fragments").
//
// Of a fragment, a lane holds the rows g and g + 8 and the columns 2 q, 2 q + 1, 2 q + 8, 2 q + 9, where g is lane / 4
// and q is lane % 4. So the sums of one product, packed, are the left operand of the next.

struct Units {
    static __device__ unsigned pack(float low, float high) {
        unsigned word;
        asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(word) : "f"(high), "f"(low));
        return word;
    }
    static __device__ float2 unpack(unsigned word) {
        float2 pair;
        asm("{.reg .b16 l, h; mov.b32 {l, h}, %2; cvt.f32.f16 %0, l; cvt.f32.f16 %1, h;}"
            : "=f"(pair.x), "=f"(pair.y)
            : "r"(word));
        return pair;
    }
    // Of two pairs of halves.
    static __device__ unsigned scale(unsigned a, unsigned b) {
        unsigned word;
        asm("mul.rn.f16x2 %0, %1, %2;" : "=r"(word) : "r"(a), "r"(b));
        return word;
    }
    static __device__ unsigned add(unsigned a, unsigned b) {
        unsigned word;
        asm("add.rn.f16x2 %0, %1, %2;" : "=r"(word) : "r"(a), "r"(b));
        return word;
    }
    static __device__ unsigned subtract(unsigned a, unsigned b) {
        unsigned word;
        asm("sub.rn.f16x2 %0, %1, %2;" : "=r"(word) : "r"(a), "r"(b));
        return word;
    }
    static __device__ unsigned fma(unsigned a, unsigned b, unsigned c) {
        unsigned word;
        asm("fma.rn.f16x2 %0, %1, %2, %3;" : "=r"(word) : "r"(a), "r"(b), "r"(c));
        return word;
    }
    static __device__ unsigned tanh(unsigned a) {
        unsigned word;
        asm("tanh.approx.f16x2 %0, %1;" : "=r"(word) : "r"(a));
        return word;
    }
    // c += a b of 16 x 16 and 16 x 8; the sums are halves.
    static __device__ void multiply_half(unsigned* c, const unsigned* a, unsigned low, unsigned high) {
        asm("mma.sync.aligned.m16n8k16.row.col.f16.f16.f16.f16 {%0,%1}, {%2,%3,%4,%5}, {%6,%7}, {%0,%1};"
            : "+r"(c[0]), "+r"(c[1])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(low), "r"(high));
    }
    // c += a b of 16 x 16 and 16 x 8.
    static __device__ void multiply(float* c, const unsigned* a, unsigned low, unsigned high) {
        asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
            : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(low), "r"(high));
    }
    // c += a b of 16 x 8 and 8 x 8.
    static __device__ void multiply_short(float* c, unsigned upper, unsigned lower, unsigned b) {
        asm("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5}, {%6}, {%0,%1,%2,%3};"
            : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(upper), "r"(lower), "r"(b));
    }
    // c += a b of 16 x 8 and 8 x 8; of each float only the upper 19 bits count (tf32). A lane holds the columns q and q + 4 of a.
    static __device__ void multiply_floats(float* c, const float* a, float upper, float lower) {
        asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
            : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(__float_as_uint(a[0])), "r"(__float_as_uint(a[1])), "r"(__float_as_uint(a[2])),
              "r"(__float_as_uint(a[3])), "r"(__float_as_uint(upper)), "r"(__float_as_uint(lower)));
    }
    // Four 8 x 8 pieces of halves from shared memory; lane l gives the address of row l % 8 of piece l / 8.
    static __device__ void load(unsigned* r, const void* row) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
                     : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
                     : "r"(unsigned(__cvta_generic_to_shared(row)))
                     : "memory");
    }
    static __device__ void load_transposed(unsigned* r, const void* row) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
                     : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
                     : "r"(unsigned(__cvta_generic_to_shared(row)))
                     : "memory");
    }
    // Two pieces: the addresses of lanes 0 to 15.
    static __device__ void load_two_transposed(unsigned* r, const void* row) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x2.trans.shared.b16 {%0,%1}, [%2];"
                     : "=r"(r[0]), "=r"(r[1])
                     : "r"(unsigned(__cvta_generic_to_shared(row)))
                     : "memory");
    }
};
