// The function of `orthogonal.cuh` on a CPU, in float32; `rows` may exceed H, the columns of X. Constant: I, most rows if
// H is less.

constexpr int M = H > I ? H : I;
struct Product {
    // to = factor l r + share added, of `rows` x `inner` and `inner` x `columns`; rows are M floats apart.
    static void run(float* to, int columns, const float* l, const float* r, int rows, int inner, float factor,
                    const float* added, float share) {
        for (int i = 0; i < rows; ++i) {
            float sum[M] = {};
            for (int k = 0; k < inner; ++k)
                for (int j = 0; j < columns; ++j) sum[j] += l[i * M + k] * r[k * M + j];
            for (int j = 0; j < columns; ++j) to[i * M + j] = factor * sum[j] + share * added[i * M + j];
        }
    }
};
// The first product adds nothing times x, whose columns beyond H must be finite.
float x[M * M] = {}, gram[M * M], other[M * M], norm = 0.0f;
const float* from = momentum.data + at;
for (int i = 0; i < rows * H; ++i) norm += from[i] * from[i];
const float inverse = norm > 0.0f ? 1.0f / sqrtf(norm) : 0.0f;
for (int r = 0; r < rows; ++r)
    for (int c = 0; c < H; ++c) x[r * M + c] = from[r * H + c] * inverse;
for (int i = 0; i < 5; ++i) {
    for (int r = 0; r < rows; ++r)
        for (int c = 0; c < H; ++c) other[c * M + r] = x[r * M + c];
    Product::run(gram, rows, x, other, rows, H, 1.0f, x, 0.0f);
    Product::run(other, rows, gram, gram, rows, rows, C, gram, B);
    Product::run(gram, H, other, x, rows, rows, 1.0f, x, A);
    for (int r = 0; r < rows; ++r)
        for (int c = 0; c < H; ++c) x[r * M + c] = gram[r * M + c];
}
for (int r = 0; r < rows; ++r)
    for (int c = 0; c < H; ++c) weights.data[at + r * H + c] -= rate * x[r * M + c];
