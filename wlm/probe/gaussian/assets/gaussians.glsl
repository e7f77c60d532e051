// Decodes light probes: 3D Gaussians with latents, summed at a point, and a small network
// (Gaussian Compression for Precomputed Indirect Illumination, eq. 2 to 7). For GLSL 4.30 and later, with or without
// Vulkan; include it below #version. It fits every model of this shape: latents of length @latent@, @hidden@ units,
// @outputs@ numbers per probe@form@, support @reach@. The document explains the rest; see "about" there.
//
// Buffer gaussians, 32-bit words, little-endian:
//   0    origin, 3 floats, and extent; 4 size, 3 floats, and gain; 8 cut, a float; 9 count K, an integer
//   10   @channels@ floats, the lowest value of each number of a Gaussian, then @channels@ floats, the step of its code
//   @first@   K times @words@ words: codes of 16 bits, two in a word, the low half first: centre 3, log of the scale 3,
//        rotation 4 (w, x, y, z), latent @latent@
// Buffer network, half floats, two in a word, the low one first: for each layer, for each group of four outputs, their
// four biases, then the four weights of each input; inputs and outputs are padded with zeros to multiples of four. The
// weights of four consecutive inputs are the columns of a 4 x 4 matrix (section 4).
//
// Both are storage buffers, unless WLM_PROBE_GAUSSIANS(i) and WLM_PROBE_NETWORK(i) are defined before this file as
// other ways to read word i. If WLM_PROBE_LIST(i) is defined, as a way to read entry i of lists of Gaussians, there are
// also functions that sum a range of it; the document describes how to build lists that miss no Gaussian.

@buffers@
const int WLM_PROBE_LATENT = @latent@;
const int WLM_PROBE_OUTPUTS = @outputs@;
const int WLM_PROBE_CHANNELS = @channels@; // numbers of a Gaussian
const int WLM_PROBE_WORDS = @words@;
const int WLM_PROBE_FIRST = @first@;
const int WLM_PROBE_INPUT_FOURS = @input_fours@; // latent and position
const int WLM_PROBE_HIDDEN_FOURS = @hidden_fours@;
const int WLM_PROBE_MOST_FOURS = @most_fours@;

float wlm_probe_float(int word)
{
    return uintBitsToFloat(WLM_PROBE_GAUSSIANS(word));
}

vec3 wlm_probe_vec3(int word)
{
    return vec3(wlm_probe_float(word), wlm_probe_float(word + 1), wlm_probe_float(word + 2));
}

int wlm_probe_count()
{
    return int(WLM_PROBE_GAUSSIANS(9));
}

// A position in the frame of the Gaussians; points outside the probes' box are moved to its surface. Where the box is
// far from the scene's origin, floats are too coarse for this: there the engine computes it in doubles, from the
// numbers of the document, and calls the functions that take x.
vec3 wlm_probe_place(vec3 position)
{
    vec3 x = (position - wlm_probe_vec3(0)) / wlm_probe_float(3);
    return clamp(x, vec3(0.0, 0.0, 0.0), wlm_probe_vec3(4));
}

// Number c of the Gaussian that begins at a word (eq. 14).
float wlm_probe_number(int word, int c)
{
    uint pair = WLM_PROBE_GAUSSIANS(word + c / 2);
    uint code = c % 2 == 0 ? pair & 65535u : pair >> 16;
    return wlm_probe_float(@head@ + c) + float(code) * wlm_probe_float(@head@ + WLM_PROBE_CHANNELS + c);
}

// Adds Gaussian k at x to the sum (eq. 2 to 6).
void wlm_probe_add(inout float f[WLM_PROBE_LATENT], int k, vec3 x)
{
    int word = WLM_PROBE_FIRST + k * WLM_PROBE_WORDS;
    float cut = wlm_probe_float(8);
    vec3 d = x - vec3(wlm_probe_number(word, 0), wlm_probe_number(word, 1), wlm_probe_number(word, 2));
    vec3 s = vec3(exp(wlm_probe_number(word, 3)), exp(wlm_probe_number(word, 4)), exp(wlm_probe_number(word, 5)));
    float w = wlm_probe_number(word, 6);
    vec3 v = vec3(wlm_probe_number(word, 7), wlm_probe_number(word, 8), wlm_probe_number(word, 9));
    float norm = sqrt(w * w + dot(v, v));
    // A quaternion of length zero is no rotation.
    w = norm < 1e-12 ? 1.0 : w / norm;
    v = norm < 1e-12 ? vec3(0.0, 0.0, 0.0) : v / norm;
    vec3 t = 2.0 * cross(v, d);
    vec3 u = (d - w * t + cross(v, t)) / s;@longest@
    if (@reached@) {
        float weight = exp(-0.5 * dot(u, u));
        for (int c = 0; c < WLM_PROBE_LATENT; ++c)
            f[c] += weight * wlm_probe_number(word, 10 + c);
    }
}

// Four weights, or biases.
vec4 wlm_probe_weights(int four)
{
    vec2 a = unpackHalf2x16(WLM_PROBE_NETWORK(2 * four));
    vec2 b = unpackHalf2x16(WLM_PROBE_NETWORK(2 * four + 1));
    return vec4(a.x, a.y, b.x, b.y);
}

// Four outputs of a layer whose biases and weights begin at group `at` of four numbers.
vec4 wlm_probe_outputs(vec4 inputs[WLM_PROBE_MOST_FOURS], int fours, int at)
{
    vec4 sum = wlm_probe_weights(at);
    for (int i = 0; i < fours; ++i) {
        int column = at + 1 + 4 * i;
        sum += wlm_probe_weights(column) * inputs[i].x + wlm_probe_weights(column + 1) * inputs[i].y;
        sum += wlm_probe_weights(column + 2) * inputs[i].z + wlm_probe_weights(column + 3) * inputs[i].w;
    }
    return sum;
}

vec4 wlm_probe_sigmoid(vec4 x)
{
    // exp(80) fits a float with room to spare; beyond it the result rounds to 0 anyway.
    vec4 e = exp(min(-x, vec4(80.0, 80.0, 80.0, 80.0)));
    return vec4(1.0, 1.0, 1.0, 1.0) / (vec4(1.0, 1.0, 1.0, 1.0) + e);
}

// Eq. 7: two hidden layers and a linear one, from the sum and x.
void wlm_probe_decode(float f[WLM_PROBE_LATENT], vec3 x, out float values[WLM_PROBE_OUTPUTS])
{
    vec4 a[WLM_PROBE_MOST_FOURS];
    vec4 b[WLM_PROBE_MOST_FOURS];
    for (int i = 0; i < WLM_PROBE_INPUT_FOURS; ++i)
        a[i] = vec4(0.0, 0.0, 0.0, 0.0);
    for (int c = 0; c < WLM_PROBE_LATENT; ++c)
        a[c / 4][c % 4] = f[c];
    a[WLM_PROBE_LATENT / 4][WLM_PROBE_LATENT % 4] = x.x;
    a[(WLM_PROBE_LATENT + 1) / 4][(WLM_PROBE_LATENT + 1) % 4] = x.y;
    a[(WLM_PROBE_LATENT + 2) / 4][(WLM_PROBE_LATENT + 2) % 4] = x.z;
    int at = 0;
    for (int i = 0; i < WLM_PROBE_HIDDEN_FOURS; ++i) {
        b[i] = wlm_probe_sigmoid(wlm_probe_outputs(a, WLM_PROBE_INPUT_FOURS, at));
        at += 1 + 4 * WLM_PROBE_INPUT_FOURS;
    }
    for (int i = 0; i < WLM_PROBE_HIDDEN_FOURS; ++i) {
        a[i] = wlm_probe_sigmoid(wlm_probe_outputs(b, WLM_PROBE_HIDDEN_FOURS, at));
        at += 1 + 4 * WLM_PROBE_HIDDEN_FOURS;
    }
    float light = wlm_probe_float(7);
    for (int i = 0; i < @columns@; i += 4) {
        vec4 y = wlm_probe_outputs(a, WLM_PROBE_HIDDEN_FOURS, at);
        at += 1 + 4 * WLM_PROBE_HIDDEN_FOURS;
        for (int c = 0; c < 4 && i + c < WLM_PROBE_OUTPUTS; ++c)
            values[i + c] = y[c];
@magnitude@    }
    for (int i = 0; i < WLM_PROBE_OUTPUTS; ++i)
        values[i] *= light;@clamp@
}

// The numbers of a probe at x, from all Gaussians.
void wlm_probe_values(vec3 x, out float values[WLM_PROBE_OUTPUTS])
{
    float f[WLM_PROBE_LATENT];
    for (int c = 0; c < WLM_PROBE_LATENT; ++c)
        f[c] = 0.0;
    int count = wlm_probe_count();
    for (int k = 0; k < count; ++k)
        wlm_probe_add(f, k, x);
    wlm_probe_decode(f, x, values);
}

#ifdef WLM_PROBE_LIST
// The same, from the Gaussians in a range of the lists.
void wlm_probe_values_listed(vec3 x, int first, int count, out float values[WLM_PROBE_OUTPUTS])
{
    float f[WLM_PROBE_LATENT];
    for (int c = 0; c < WLM_PROBE_LATENT; ++c)
        f[c] = 0.0;
    for (int i = 0; i < count; ++i)
        wlm_probe_add(f, int(WLM_PROBE_LIST(first + i)), x);
    wlm_probe_decode(f, x, values);
}
#endif
