SamplerState wlm_linear_clamp_sampler;
// HLSL, shader model 5 and later, translated from the GLSL that is described below; macros are expanded.
//
// Decodes a temporal lightmap: feature maps and a small network for each tile of 128 x 128 texels (Neural Dynamic GI,
// sections 3.2 to 3.4). For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES
// below `precision highp` of float, int, sampler2D and sampler2DArray.
//
// For each stored hour that is needed: bind the table of the hour, draw the map into a texture of linear light with
// wlm_radiance(texel), and draw that one into another, each texel from wlm_source(texel), which fills the gaps between
// charts that a filter reads at their edges. Materials mix two of these by the time between both hours (eq. 2).
//
// Textures; row 0 is v = 0. Filters are linear, without mip levels.
//   wlm_lightmap_hour: the hour's floats of hours.bin, RGBA32F, 1024 a row; fetched.
//   wlm_lightmap_networks: networks.bin, RGBA32F, 1024 a row; fetched.
//   wlm_lightmap_uv: uv.dds, BC7, 128 x 128 texels a tile; fetched.
//   wlm_lightmap_uvt: uvt.dds, BC7, 32 x 32 texels for each of 12 slices of a tile; filtered.
//   wlm_lightmap_planes: planes.dds, RG8, 64 x 24 texels twice a tile; filtered.
//   wlm_lightmap_valid: valid.png, R8, 128 x 128, white inside charts; fetched.
//
// If WLM_LIGHTMAP_EXACT is defined, four texels are fetched and mixed in floats; otherwise the filter unit mixes four
// texels, with about 8 bits for a position between two of them.
//
// wlm_lightmap_four(i) and wlm_lightmap_entry(i) read four floats of networks and of the table: if these are in
// buffers change them, or define WLM_LIGHTMAP_NET(i) and WLM_LIGHTMAP_HOUR_AT(i) before this file.

Texture2D<float4> wlm_lightmap_hour;
Texture2D<float4> wlm_lightmap_networks;
Texture2D<float4> wlm_lightmap_uv;
Texture2D<float4> wlm_lightmap_uvt;
Texture2D<float4> wlm_lightmap_planes;
Texture2D<float4> wlm_lightmap_valid;

float4 wlm_lightmap_entry(int i)
{
    return wlm_lightmap_hour.Load(int3(int2(i & 1023, i >> 10), 0));
}

float4 wlm_lightmap_four(int i)
{
    return wlm_lightmap_networks.Load(int3(int2(i & 1023, i >> 10), 0));
}

// tiles in a row of the map
static const int WLM_LIGHTMAP_COLUMNS = 1;
// fours of a tile in the table, after 2 of all
static const int WLM_LIGHTMAP_RECORD = 7;

// texels of a slice of F_uvt along a side
static const int WLM_LIGHTMAP_SIDE = 32;

// A slice of F_uvt at a place in its texels; texel i has its centre at i + 1/2.
float4 wlm_lightmap_slice(int image, float2 place)
{
    int2 first = int2(image % 4, image / 4) * WLM_LIGHTMAP_SIDE;
    float2 inside = clamp(place, float2(0.5, 0.5), float2(32.0, 32.0) - float2(0.5, 0.5));
    return wlm_lightmap_uvt.SampleLevel(wlm_linear_clamp_sampler, (((float2)(first)) + inside) / float2(128.0, 96.0), 0.0);
}

// F_uvt at the table's hour, at a place from 0 to 1.
float4 wlm_lightmap_volume(int row, float2 place)
{
    float4 time = wlm_lightmap_entry(0);
    float2 texel = place * 32.0;
    float4 early = wlm_lightmap_slice(row * 12 + int(time.x), texel);
    return lerp(early, wlm_lightmap_slice(row * 12 + int(time.y), texel), time.z);
}

// F_ut (an even image) or F_vt (an odd one) at a row of time.
float2 wlm_lightmap_line(int image, float place, int time)
{
    int2 first = int2(image % 1 * 64, image / 1 * 24 + time);
    float inside = clamp(place * 64.0, 0.5, 64.0 - 0.5);
    float2 at = ((float2)(first)) + float2(inside, 0.5);
    return wlm_lightmap_planes.SampleLevel(wlm_linear_clamp_sampler, at / float2(64.0, 48.0), 0.0).xy;
}

float2 wlm_lightmap_plane(int image, float place)
{
    float4 time = wlm_lightmap_entry(1);
    float2 early = wlm_lightmap_line(image, place, int(time.x));
    return lerp(early, wlm_lightmap_line(image, place, int(time.y)), time.z);
}

// of 16 units
static const int WLM_LIGHTMAP_FOURS = 4;

// The tanh form of GELU, which the model was trained with, as x / (1 + exp(-2 z)), since the tanh of drivers takes
// several times as long; within 4.8e-4 of the exact form.
float4 wlm_gelu(float4 x)
{
    float4 z = x * (-2.3022082 - 0.10294324 * x * x); // for powers of 2, which end before a float overflows
    return x / (1.0 + exp2(min(z, float4(80.0, 80.0, 80.0, 80.0))));
}

// b + x W, where the rows of W are `apart` groups of four apart.
float4 wlm_lightmap_add(float4 b, float4 x, int at, int apart)
{
    float4 sum = b + x.x * wlm_lightmap_four(at) + x.y * wlm_lightmap_four(at + apart);
    return sum + x.z * wlm_lightmap_four(at + 2 * apart) + x.w * wlm_lightmap_four(at + 3 * apart);
}

// Colour of a tile of maps: `record` is the position of its record, `inner` the texel in the tile. G of eq. 4 has two
// hidden layers. Four units of the first at a time are added to the second, whose array has constant indices, so that
// it is in registers.
float3 wlm_lightmap_mapped(float4 tile, int record, int2 inner)
{
    int row = int(tile.y);
    int start = int(tile.z);
    int second = start + 17 * WLM_LIGHTMAP_FOURS; // the encoded time is in the bias
    int2 at = int2(row % 1, row / 1) * 128 + inner;
    float4 uv = wlm_lightmap_uv.Load(int3(at, 0));
    float2 place = (((float2)(inner)) + float2(0.5, 0.5)) / 128.0;
    float4 uvt = wlm_lightmap_volume(row, place);
    float4 planes = float4(wlm_lightmap_plane(2 * row, place.x), wlm_lightmap_plane(2 * row + 1, place.y));
    int third = second + (4 * WLM_LIGHTMAP_FOURS + 1) * WLM_LIGHTMAP_FOURS;
    float4 b[WLM_LIGHTMAP_FOURS];
    b[0] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 0);
    b[1] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 1);
    b[2] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 2);
    b[3] = wlm_lightmap_four(third - WLM_LIGHTMAP_FOURS + 3);
    for (int i = 0; i < WLM_LIGHTMAP_FOURS; i++) {
        float4 a = wlm_lightmap_add(wlm_lightmap_entry(record + 3 + i), uv, start + i, WLM_LIGHTMAP_FOURS);
        a = wlm_lightmap_add(a, uvt, start + 4 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
        a = wlm_lightmap_add(a, planes, start + 8 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
        a = wlm_gelu(a);
        int w = second + 4 * WLM_LIGHTMAP_FOURS * i;
        b[0] = wlm_lightmap_add(b[0], a, w + 0, WLM_LIGHTMAP_FOURS);
        b[1] = wlm_lightmap_add(b[1], a, w + 1, WLM_LIGHTMAP_FOURS);
        b[2] = wlm_lightmap_add(b[2], a, w + 2, WLM_LIGHTMAP_FOURS);
        b[3] = wlm_lightmap_add(b[3], a, w + 3, WLM_LIGHTMAP_FOURS);
    }
    float4 y = wlm_lightmap_four(third + 4 * WLM_LIGHTMAP_FOURS);
    y = wlm_lightmap_add(y, wlm_gelu(b[0]), third + 0, 1);
    y = wlm_lightmap_add(y, wlm_gelu(b[1]), third + 4, 1);
    y = wlm_lightmap_add(y, wlm_gelu(b[2]), third + 8, 1);
    y = wlm_lightmap_add(y, wlm_gelu(b[3]), third + 12, 1);
    float3 gain = wlm_lightmap_entry(record + 1).xyz;
    return max(gain + wlm_lightmap_entry(record + 2).xyz * y.xyz, float3(0.0, 0.0, 0.0));
}

// Colour of a tile of frames, or of one colour.
float3 wlm_lightmap_unmapped(float4 tile, int record, int2 inner)
{
    return wlm_lightmap_entry(record + 1).xyz;
}

// Colour of a texel of the map in gamma space, at least 0; of an empty tile 0.
float3 wlm_colour(int2 texel)
{
    int2 place = texel / 128;
    int2 inner = texel - place * 128;
    int record = 2 + (place.y * WLM_LIGHTMAP_COLUMNS + place.x) * WLM_LIGHTMAP_RECORD;
    float4 tile = wlm_lightmap_entry(record);
    if (int(tile.x) == 3) {
        return wlm_lightmap_mapped(tile, record, inner);
    }
    return wlm_lightmap_unmapped(tile, record, inner);
}

// The texel whose light a texel of the map shows: itself inside a chart; in a gap the nearest inside within 2
// texels, in reading order of several as near; beyond that itself.
int2 wlm_source(int2 texel)
{
    if (wlm_lightmap_valid.Load(int3(texel, 0)).x > 0.5) {
        return texel;
    }
    int2 found = texel;
    int least = 9;
    for (int y = -2; y <= 2; y++) {
        for (int x = -2; x <= 2; x++) {
            int2 at = texel + int2(x, y);
            if (x * x + y * y < least && at.x >= 0 && at.y >= 0 && at.x < 128 && at.y < 128) {
                if (wlm_lightmap_valid.Load(int3(at, 0)).x > 0.5) {
                    least = x * x + y * y;
                    found = at;
                }
            }
        }
    }
    return found;
}

// Linear radiance of a colour, at most 65504: a target of half floats would make more infinite.
float3 wlm_lightmap_linear(float3 colour)
{
    return min(pow(colour, float3(2.2, 2.2, 2.2)), float3(65504.0, 65504.0, 65504.0));
}

float3 wlm_radiance(int2 texel)
{
    float3 colour = wlm_colour(texel); // glslang's HLSL takes no call with textures as an argument here
    return wlm_lightmap_linear(colour);
}
