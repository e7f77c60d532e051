"""The GLSL that decodes an exported lightmap; `wlm.lightmap.exporter` writes it beside the textures."""

from wlm.lightmap.model import LightmapModel
from wlm.texels import REACH
from wlm_kernels.lightmap.features import STATIC_INPUTS, TEMPORAL_INPUTS

_GELU = {
    "exact": """\
// x Phi(x). erf as in Abramowitz and Stegun, Handbook of Mathematical Functions, 7.1.26: within 1.5e-7, which leaves
// GELU within 2.2e-7.
float wlm_gelu(float x)
{
    float z = abs(x) * 0.70710678;
    float t = 1.0 / (1.0 + 0.3275911 * z);
    float p = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    float e = 1.0 - p * exp(-z * z);
    return 0.5 * x * (1.0 + (x < 0.0 ? -e : e));
}
""",
    "tanh": """\
// The tanh form of GELU, which the model was trained with; within 4.8e-4 of the exact one.
float wlm_gelu(float x)
{
    // Some drivers' tanh is a quotient of exponentials and overflows; beyond 9 it is 1 in a float anyway.
    float z = clamp(x * (0.79788456 + 0.035677408 * x * x), -9.0, 9.0);
    return 0.5 * x * (1.0 + tanh(z));
}
""",
}

_TEMPLATE = """\
// Decodes a texel of a temporal lightmap: BC7 feature maps and a small network for each tile of 128 x 128 texels
// (Neural Dynamic GI, sections 3.2 to 3.4). For GLSL 4.30 and later, with or without Vulkan; include it below #version.
//
// weights.json has everything else; see "about" there. What the caller does once a frame, for the time t:
{frame}//
// Gaps. A bilinear read at a chart's edge takes in texels outside it, which are decoded to anything. Once all tiles are
// in a texture of linear radiance, a pass over it gives each texel the light of the texel wlm_source(f_valid, texel);
// f_valid is valid.png, R8, {width} x {height}, white inside charts.
//
// Textures. u runs along x and v along y, row 0 is v = 0. Filters are linear, without mip levels; u and v clamp to the
// edge; the axis of time (z of F_uvt, y of F_ut and F_vt) {wrap}. At texel centres the
// fractions along u and v are multiples of 1/256, which the filter unit's 8 bits hold exactly; along time they round.
//   f_uv   tile_NNNN_uv.dds    BC7, 128 x 128
//   f_uvt  tile_NNNN_uvt.dds   BC7 volume, {resolution} x {resolution} x {slices}
//   f_ut   tile_NNNN_ut.dds    RG8, {columns} x {rows}
//   f_vt   tile_NNNN_vt.dds    RG8, {columns} x {rows}
//   f_frame  tile_NNNN_frame_TTTT.dds  128 x 128, BC7 of a tile of frames, RGB10A2 of one of video, at stored time TTTT
//
// Networks. One float array holds those of all tiles: for each tile of weights.json in turn W1, b1, W2, b2, W3 and b3,
// row by row; a tile's begins at its "network_offset". It is the storage buffer below, unless WLM_NET(i) is defined
// before this file as another way to read its float i.

#ifndef WLM_NET
#ifndef WLM_NET_BINDING
#define WLM_NET_BINDING 0
#endif
layout(std430, binding = WLM_NET_BINDING) readonly buffer WlmNetworks {{ float wlm_net[]; }};
#define WLM_NET(i) wlm_net[i]
#endif

const int WLM_HIDDEN = {hidden};
const int WLM_TEMPORAL_INPUTS = {temporal_inputs};
const int WLM_STATIC_INPUTS = {static_inputs};
const float WLM_TURN = {turn}; // {turn_note}
const float WLM_GAMMA = {gamma};

{gelu}
// G of eq. 4: two hidden layers and a linear one, of the first {static_inputs} or all {temporal_inputs} features.
// Textures are fed as they are sampled: their centring, (f - 1/2) sqrt(12), is in W1 and b1.
vec3 wlm_network(float f[WLM_TEMPORAL_INPUTS], int inputs, int offset)
{{
    float a[WLM_HIDDEN];
    float b[WLM_HIDDEN];
    int at = offset;
    for (int j = 0; j < WLM_HIDDEN; ++j) {{
        float s = WLM_NET(at + inputs * WLM_HIDDEN + j);
        for (int c = 0; c < inputs; ++c)
            s += WLM_NET(at + c * WLM_HIDDEN + j) * f[c];
        a[j] = wlm_gelu(s);
    }}
    at += (inputs + 1) * WLM_HIDDEN;
    for (int j = 0; j < WLM_HIDDEN; ++j) {{
        float s = WLM_NET(at + WLM_HIDDEN * WLM_HIDDEN + j);
        for (int c = 0; c < WLM_HIDDEN; ++c)
            s += WLM_NET(at + c * WLM_HIDDEN + j) * a[c];
        b[j] = wlm_gelu(s);
    }}
    at += (WLM_HIDDEN + 1) * WLM_HIDDEN;
    int bias = at + 3 * WLM_HIDDEN;
    vec3 y = vec3(WLM_NET(bias), WLM_NET(bias + 1), WLM_NET(bias + 2));
    for (int c = 0; c < WLM_HIDDEN; ++c)
        y += b[c] * vec3(WLM_NET(at + 3 * c), WLM_NET(at + 3 * c + 1), WLM_NET(at + 3 * c + 2));
    return y;
}}

// Section 4: the network answers relative to each channel's mean at this time.
vec3 wlm_finish(vec3 y, vec3 scale, vec3 shift, vec3 spread)
{{
    return max((shift + spread * y) * scale, vec3(0.0, 0.0, 0.0));
}}

// Colour in gamma space, at least 0, of a texel of a "dynamic" tile; for 8 bits divide it by the tile's bound.
vec3 wlm_decode_dynamic(sampler2D f_uv, sampler3D f_uvt, sampler2D f_ut, sampler2D f_vt, ivec2 texel, float tau,
                        int offset, vec3 scale, vec3 shift, vec3 spread)
{{
    float u = (float(texel.x) + 0.5) / 128.0;
    float v = (float(texel.y) + 0.5) / 128.0;
    vec4 uv = texelFetch(f_uv, texel, 0);
    vec4 uvt = textureLod(f_uvt, vec3(u, v, tau), 0.0);
    vec4 ut = textureLod(f_ut, vec2(u, tau), 0.0);
    vec4 vt = textureLod(f_vt, vec2(v, tau), 0.0);
    float f[WLM_TEMPORAL_INPUTS];
    f[0] = uv.x;
    f[1] = uv.y;
    f[2] = uv.z;
    f[3] = uv.w;
    f[4] = uvt.x;
    f[5] = uvt.y;
    f[6] = uvt.z;
    f[7] = uvt.w;
    f[8] = ut.x;
    f[9] = ut.y;
    f[10] = vt.x;
    f[11] = vt.y;
    // Encoded time, gamma(t) of eq. 4.
    f[12] = sin(WLM_TURN * tau);
    f[13] = cos(WLM_TURN * tau);
    f[14] = sin(2.0 * WLM_TURN * tau);
    f[15] = cos(2.0 * WLM_TURN * tau);
    return wlm_finish(wlm_network(f, WLM_TEMPORAL_INPUTS, offset), scale, shift, spread);
}}

// The same of a "static" tile: one pattern for all times.
vec3 wlm_decode_static(sampler2D f_uv, ivec2 texel, int offset, vec3 scale, vec3 shift, vec3 spread)
{{
    vec4 uv = texelFetch(f_uv, texel, 0);
    float f[WLM_TEMPORAL_INPUTS];
    f[0] = uv.x;
    f[1] = uv.y;
    f[2] = uv.z;
    f[3] = uv.w;
    for (int c = WLM_STATIC_INPUTS; c < WLM_TEMPORAL_INPUTS; ++c)
        f[c] = 0.0;
    return wlm_finish(wlm_network(f, WLM_STATIC_INPUTS, offset), scale, shift, spread);
}}

// The same of a tile of "frames" or "video" at a stored time, whose "least" and "greatest" these are.
vec3 wlm_decode_frame(sampler2D f_frame, ivec2 texel, vec3 least, vec3 greatest)
{{
    vec4 level = texelFetch(f_frame, texel, 0);
    return vec3(1.0 - level.x, 1.0 - level.y, 1.0 - level.z) * least + vec3(level.x, level.y, level.z) * greatest;
}}

// The texel whose light a texel of the map shows: itself inside a chart; in a gap the nearest inside within {reach}
// texels, in reading order of several as near; beyond that itself.
ivec2 wlm_source(sampler2D f_valid, ivec2 texel)
{{
    if (texelFetch(f_valid, texel, 0).x > 0.5)
        return texel;
    ivec2 size = textureSize(f_valid, 0);
    ivec2 found = texel;
    int least = {beyond};
    for (int y = -{reach}; y <= {reach}; ++y)
        for (int x = -{reach}; x <= {reach}; ++x) {{
            ivec2 at = ivec2(texel.x + x, texel.y + y);
            if (x * x + y * y < least && at.x >= 0 && at.y >= 0 && at.x < size.x && at.y < size.y
                && texelFetch(f_valid, at, 0).x > 0.5) {{
                least = x * x + y * y;
                found = at;
            }}
        }}
    return found;
}}

{last}"""

_RADIANCE = """\
// Linear radiance of a colour in gamma space.
vec3 wlm_radiance(vec3 colour)
{
    return pow(colour, vec3(WLM_GAMMA, WLM_GAMMA, WLM_GAMMA));
}
"""

_VALUES = """\
// The values of a colour, which has no gamma here: levels from 0 to 1. They mix as radiance does.
vec3 wlm_value(vec3 colour)
{{
    return vec3({least}, {least}, {least}) + {span} * colour;
}}
"""


_FRAME = {
    "radiance": """\
//   t lies between two stored times: decode each with its own "tau", "scale" and "peak" and mix their radiance (eq. 2);
//   a cache that keeps both is decoded again only when t passes a stored time;
//   bound    of each tile, from its "peak", if colour is to be kept in 8 bits.
""",
    "network": """\
//   tau      from "tau", which belongs to "times": linear between the stored times around t;
//   scale    of each tile, from its "scale": linear likewise; the radiance of frames is mixed likewise;
//   bound    of each tile, from its "peak": the larger of the two, if colour is to be kept in 8 bits.
""",
}


def decode_glsl(model: LightmapModel, values: tuple[float, float] | None = None) -> str:
    """The shader text for a model: functions alone, to be included below `#version`.

    Args:
        model: Its settings choose the constants, the GELU and what the time axis does at its ends.
        values: What the levels 0 and 1 of a model without gamma stand for; None: the model is of radiance.

    Returns:
        GLSL 4.30, which Vulkan's dialect takes too.
    """
    profile = model.profile
    periodic = model.axis.periodic
    last = _RADIANCE if values is None else _VALUES.format(least=repr(values[0]), span=repr(values[1] - values[0]))
    # repr gives the shortest decimals that are the number again, and always a point or an exponent.
    return _TEMPLATE.format(
        frame=_FRAME[profile.interpolation],
        width=model.width,
        height=model.height,
        reach=REACH,
        beyond=2 * REACH * REACH + 1,
        wrap="repeats" if periodic else "clamps to the edge",
        resolution=profile.uvt_resolution,
        slices=profile.uvt_slices,
        columns=profile.plane_columns,
        rows=profile.plane_rows,
        hidden=profile.hidden,
        temporal_inputs=TEMPORAL_INPUTS,
        static_inputs=STATIC_INPUTS,
        turn="6.2831853" if periodic else "3.1415927",
        turn_note="2 pi: the axis is a circle, midnight is no jump" if periodic else "pi, as in eq. 4",
        gamma=repr(float(profile.gamma)),
        gelu=_GELU["exact" if profile.gelu == "exact" else "tanh"],
        last=last,
    )
