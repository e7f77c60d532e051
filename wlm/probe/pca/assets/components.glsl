// Decodes light probes from principal components. For GLSL 4.30 and later, with or without Vulkan; include it below
// #version. It fits every model of @outputs@ numbers per probe and such directions. The document has the
// formula; see "about" there.
//
// Buffer probes, 32-bit words, little-endian:
//   number of live probes V; number of clusters C; bits b of a cluster's number; number of codes Q of all clusters
//   C words, one for each cluster: its first code (16 bits), and the bits of its probes (16 bits)
//   Q words: the lowest value and the step of each code, half floats; the first code of a cluster is that of the
//        magnitude's logarithm, the others are those of the coefficients
//   Q bytes, padded to words: bits of each code
//   @words@ (Q - C) words: the direction of each coefficient; @directions@
//   G + 1 words for G = ceil(V / @group@) groups of @group@ probes: where the codes of the group begin, in bits, and
//        the end of the last one, which is filled up with probes of cluster 0, without codes
//   @group_words@ b G words: the numbers of the probes' clusters, b bits each
//   the codes of one probe after another, from the lowest bit of a word
//
// It is a storage buffer, unless WLM_PROBE_PROBES(i) is defined before this file as another way to read word i.

@buffers@
const int WLM_PROBE_OUTPUTS = @outputs@;

int wlm_probe_count()
{
    return int(WLM_PROBE_PROBES(0));
}

// Integer of some bits, fewer than 32, at a place in the bits that begin with a word.
uint wlm_probe_code(int word, uint bit, int width)
{
    if (width == 0)
        return 0u;
    word += int(bit >> 5u);
    int shift = int(bit & 31u);
    uint code = WLM_PROBE_PROBES(word) >> uint(shift);
    if (shift + width > 32)
        code |= WLM_PROBE_PROBES(word + 1) << uint(32 - shift);
    return code & ((1u << uint(width)) - 1u);
}

// The numbers of a live probe.
void wlm_probe_values(int probe, out float values[WLM_PROBE_OUTPUTS])
{
    int clusters = int(WLM_PROBE_PROBES(1));
    int b = int(WLM_PROBE_PROBES(2));
    int codes = int(WLM_PROBE_PROBES(3));
    int bounds = 4 + clusters;
    int widths = bounds + codes;
    int basis = widths + (codes + 3) / 4;
    int group = basis + (codes - clusters) * @words@;
    int groups = (wlm_probe_count() + @group@ - 1) / @group@;
    int index = group + groups + 1;
    int data = index + groups * @group_words@ * b;
    // From the nearer end of the group.
    int place = probe % @group@;
    int half_group = place / (@group@ / 2);
    uint bit = WLM_PROBE_PROBES(group + probe / @group@ + half_group);
    int begin = half_group == 0 ? probe - place : probe;
    int end_group = half_group == 0 ? probe : probe - place + @group@;
    for (int other = begin; other < end_group; ++other) {
        uint bits = WLM_PROBE_PROBES(4 + int(wlm_probe_code(index, uint(other * b), b))) >> 16u;
        bit = half_group == 0 ? bit + bits : bit - bits;
    }
    int cluster = int(wlm_probe_code(index, uint(probe * b), b));
    int first = int(WLM_PROBE_PROBES(4 + cluster) & 65535u);
    int end = cluster + 1 < clusters ? int(WLM_PROBE_PROBES(5 + cluster) & 65535u) : codes;
    float magnitude = 0.0;
    for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d)
        values[d] = 0.0;
    for (int k = first; k < end; ++k) {
        int width = int(WLM_PROBE_PROBES(widths + k / 4) >> uint(k % 4 * 8) & 255u);
        vec2 limits = unpackHalf2x16(WLM_PROBE_PROBES(bounds + k));
        float number = limits.x + limits.y * float(wlm_probe_code(data, bit, width));
        bit += uint(width);
        if (k == first) {
            magnitude = exp(number);
            continue;
        }
@body@    }@clamp@
}
