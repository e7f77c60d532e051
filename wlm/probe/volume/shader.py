"""Generates the GLSL that reads a volume from the buffers of `wlm.probe.volume.bundle`."""

from wlm.probe.glsl import buffer_glsl
from wlm.probe.sphere import sh_count

_HEAD_WORDS = 4  # words of the buffer `volume` before the levels
_LEVEL_WORDS = 8

_TEMPLATE = """\
// Reads the light of a cascaded lighting volume (Gaussian Compression for Precomputed Indirect Illumination, section
// 3.4) at a point, from three buffers. For GLSL 4.30 and later, with or without Vulkan; include
// it below #version. It fits every volume of {outputs} numbers per block.
//
// Buffer volume, 32-bit words, little-endian:
//   0    levels L, blocks along an axis of a window, numbers per block, rows of the pool: integers
//   4    L times 8 words, the finest level first: 4 floats, position of the viewer in the window and 1 / side of a
//        block; 3 integers, the first block of the window; 0
// Buffer pages, integers: for each level side * side * side entries; block b has entry ((b.x mod side) * side +
//        (b.y mod side)) * side + (b.z mod side): its row of the pool, or -1 where the block is missing.
// Buffer pool, floats: {outputs} in a row.
//
// Moving the viewer changes the buffer volume; a new block changes one entry of pages and one row of the pool. The
// buffers are storage buffers, unless WLM_VOLUME_HEAD(i), WLM_VOLUME_PAGE(i) and WLM_VOLUME_POOL(i) are defined before
// this file as other ways to read entry i.
{buffers}
const int WLM_VOLUME_OUTPUTS = {outputs};

int wlm_volume_wrap(int i, int side)
{{
    int r = i % side;
    return r < 0 ? r + side : r;
}}

// The light at a point relative to the viewer: scene position less viewpoint. With the unit normal of its surface the
// light is read half a block in front of it, so that the far side of a wall contributes less; with a normal of 0 it is
// read at the point. The finest level that has all eight surrounding blocks answers; the weight of missing blocks
// passes on to the next level. Returns the share of the weight that was found, 0 to 1; where it is 0, so are the
// values.
float wlm_volume_read(vec3 p, vec3 normal, out float values[{outputs}])
{{
    int levels = int(WLM_VOLUME_HEAD(0));
    int side = int(WLM_VOLUME_HEAD(1));
    for (int c = 0; c < WLM_VOLUME_OUTPUTS; ++c)
        values[c] = 0.0;
    float left = 1.0;
    float covered = 0.0;
    float edge = 0.5 * float(side);
    for (int level = 0; level < levels && left > 0.0; ++level) {{
        int at = {head} + {level_words} * level;
        float scale = uintBitsToFloat(WLM_VOLUME_HEAD(at + 3));
        float x = p.x * scale + uintBitsToFloat(WLM_VOLUME_HEAD(at)) + 0.5 * normal.x;
        float y = p.y * scale + uintBitsToFloat(WLM_VOLUME_HEAD(at + 1)) + 0.5 * normal.y;
        float z = p.z * scale + uintBitsToFloat(WLM_VOLUME_HEAD(at + 2)) + 0.5 * normal.z;
        if (min(x, min(y, z)) >= -edge - 1.0 && max(x, max(y, z)) < edge) {{
            float fx = x - floor(x);
            float fy = y - floor(y);
            float fz = z - floor(z);
            int i = int(floor(x)) + side / 2;
            int j = int(floor(y)) + side / 2;
            int k = int(floor(z)) + side / 2;
            float missing = 0.0;
            float here = 0.0;
            for (int corner = 0; corner < 8; ++corner) {{
                int u = i + corner % 2;
                int v = j + corner / 2 % 2;
                int w = k + corner / 4;
                float share = (corner % 2 == 1 ? fx : 1.0 - fx) * (corner / 2 % 2 == 1 ? fy : 1.0 - fy)
                    * (corner / 4 == 1 ? fz : 1.0 - fz);
                int row = -1;
                if (min(u, min(v, w)) >= 0 && max(u, max(v, w)) < side) {{
                    u = wlm_volume_wrap(u + int(WLM_VOLUME_HEAD(at + 4)), side);
                    v = wlm_volume_wrap(v + int(WLM_VOLUME_HEAD(at + 5)), side);
                    w = wlm_volume_wrap(w + int(WLM_VOLUME_HEAD(at + 6)), side);
                    row = WLM_VOLUME_PAGE(((level * side + u) * side + v) * side + w);
                }}
                if (row < 0) {{
                    missing += share;
                }} else if (share > 0.0) {{
                    here += share;
                    for (int c = 0; c < WLM_VOLUME_OUTPUTS; ++c)
                        values[c] += left * share * WLM_VOLUME_POOL(row * WLM_VOLUME_OUTPUTS + c);
                }}
            }}
            if (here > 0.0) {{
                covered += left * here;
                left *= missing;
            }}
        }}
    }}
    for (int c = 0; c < WLM_VOLUME_OUTPUTS; ++c)
        values[c] = covered > 0.0 ? values[c] / covered : 0.0;
    return min(covered, 1.0);
}}
"""

_IRRADIANCE = """
// The radiance of a white diffuse surface with unit normal n at a point: irradiance over pi, RGB, read in front of it.
// Orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2, all signs plus.
vec3 wlm_volume_diffuse(vec3 p, vec3 n)
{{
    float values[{outputs}];
    wlm_volume_read(p, n, values);
    float weight[9];
    weight[0] = 0.282094792;
    weight[1] = 0.325735008 * n.y;
    weight[2] = 0.325735008 * n.z;
    weight[3] = 0.325735008 * n.x;
    weight[4] = 0.273137108 * n.x * n.y;
    weight[5] = 0.273137108 * n.y * n.z;
    weight[6] = 0.0788478913 * (3.0 * n.z * n.z - 1.0);
    weight[7] = 0.273137108 * n.x * n.z;
    weight[8] = 0.136568554 * (n.x * n.x - n.y * n.y);
    vec3 sum = vec3(0.0, 0.0, 0.0);
    for (int c = 0; c < {coefficients}; ++c)
        sum += weight[c] * vec3(values[3 * c], values[3 * c + 1], values[3 * c + 2]);
    return max(sum, vec3(0.0, 0.0, 0.0)); // few bands ring below 0
}}
"""

_BUFFERS = (("HEAD", "uint"), ("PAGE", "int"), ("POOL", "float"))


def volume_glsl(outputs: int) -> str:
    """Returns the GLSL that reads a volume: functions to be included below `#version`.

    Args:
        outputs: Numbers per probe, D; for spherical harmonics of L0 to L2 in RGB there is also a function for a diffuse
            surface.

    Returns:
        GLSL 4.30, which is also valid Vulkan GLSL.
    """
    buffers = [buffer_glsl("volume", name, number, kind) for number, (name, kind) in enumerate(_BUFFERS)]
    text = _TEMPLATE.format(head=_HEAD_WORDS, level_words=_LEVEL_WORDS, buffers="".join(buffers), outputs=outputs)
    coefficients = sh_count(outputs)
    if coefficients in (1, 4, 9):
        text += _IRRADIANCE.format(coefficients=coefficients, outputs=outputs)
    return text
