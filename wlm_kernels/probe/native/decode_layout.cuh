// Layout of a packed network: of 16 inputs and 8 units of a layer, a lane holds the weights of the inputs 2 q, 2 q + 1,
// 2 q + 8 and 2 q + 9 of unit g as half floats in two words, where g is lane / 4 and q is lane % 4 (matrix_units.cuh).
// Four words lie together: of the hidden layers, two of 8 units and two of the next 8; of the last layer, two of the rounded
// weights and two of their rests. The biases follow as floats. The magnitude is the first output.
//
// Constants from wlm_kernels/probe/decode.py: L latents, H hidden units, D outputs of the network, OUT of them numbers.

constexpr int I = L + 3, KI = (I + 15) / 16, KH = (H + 15) / 16, N = (D + 7) / 8;  // tiles of 16 inputs, 16 units, 8 outputs
constexpr int SECOND = KI * KH * 32, THIRD = SECOND + KH * KH * 32, END = THIRD + KH * N * 32;  // in four words
constexpr int WORDS = 4 * END + 32 * KH + 8 * N, FIRST = D - OUT;
