SamplerState wlm_linear_clamp_sampler;
// HLSL, shader model 5 and later, translated from the GLSL that is described below; macros are expanded.
//
// Six-way smoke of 12 frames, in 3 x 4 cells, in the channels of "unity".
// (Neural Six-way Lightmaps for Real-time Smoke Rendering, eq. 4; weights are squares, as in engines.)
// For GLSL 3.30, GLSL ES 3.00 and later; include it below #version.
// Both textures are linear, not sRGB; sample both at wlm_smoke_uv, clamped to their edge.
//
//     light = sum over lights of irradiance / (4 pi) * wlm_smoke_light(first, second, toward)
//     pixel = light + colour * wlm_smoke_emission(first, second) + behind * (1 - wlm_smoke_alpha(first, second))

// Returns the texture coordinates of a frame, counted from 0, at a place on the billboard: (0, 0) is the top left,
// (1, 1) the bottom right.
float2 wlm_smoke_uv(float2 place, float frame)
{
    float cell = clamp(floor(frame), 0.0, 11.0);
    float row = floor((cell + 0.5) / 4.0);
    float column = cell - 4.0 * row;
    float x = column + 0.0151515152 + place.x * 0.96969697;
    float y = row + 0.0151515152 + place.y * 0.96969697;
    return float2(x / 4.0, y / 3.0);
}

// Returns the scattered light of a light of irradiance 4 pi. The direction to it has length 1: x to the billboard's
// right, y up, z to the viewer.
float wlm_smoke_light(float4 first, float4 second, float3 toward)
{
    float x = (toward.x > 0.0) ? first.r : second.r;
    float y = (toward.y > 0.0) ? first.g : second.g;
    float z = (toward.z > 0.0) ? second.b : first.b;
    return (toward.x * toward.x * x + toward.y * toward.y * y + toward.z * toward.z * z) * 0.817871094;
}

float wlm_smoke_alpha(float4 first, float4 second)
{
    return first.a;
}

float wlm_smoke_emission(float4 first, float4 second)
{
    return 0.0;
}

// Returns the level for textureLod from the width of a screen pixel in texels. The largest is 1: beyond it
// frames show their neighbours.
float wlm_smoke_level(float texels)
{
    return clamp(log2(max(texels, 1.0)), 0.0, 1.0);
}

Texture2D<float4> wlm_smoke_first_map;

Texture2D<float4> wlm_smoke_second_map;

// Reads both textures at a place of the billboard: (0, 0) is the top left, (1, 1) the bottom right. The time is in
// frames, counted from 0; between two frames both are mixed. The width of a screen pixel is given in texels.
void wlm_smoke_texels(float2 place, float time, float texels, out float4 first, out float4 second)
{
    float frame = clamp(floor(time), 0.0, 11.0);
    float share = clamp(time - frame, 0.0, 1.0);
    float mip = wlm_smoke_level(texels);
    float2 early = wlm_smoke_uv(place, frame);
    float2 late = wlm_smoke_uv(place, frame + 1.0);
    first = lerp(wlm_smoke_first_map.SampleLevel(wlm_linear_clamp_sampler, early, mip), wlm_smoke_first_map.SampleLevel(wlm_linear_clamp_sampler, late, mip), share);
    second = lerp(wlm_smoke_second_map.SampleLevel(wlm_linear_clamp_sampler, early, mip), wlm_smoke_second_map.SampleLevel(wlm_linear_clamp_sampler, late, mip), share);
}

// Returns the light that the smoke scatters to the viewer under a light of an irradiance; see wlm_smoke_light.
float3 wlm_smoke_lit(float4 first, float4 second, float3 toward, float3 irradiance)
{
    return irradiance * (wlm_smoke_light(first, second, toward) * 0.0795774715);
}

// Returns the scattered light under a sky of constant radiance: the mean of the six lightmaps.
float3 wlm_smoke_sky(float4 first, float4 second, float3 radiance)
{
    float3 x = float3(1.0, 0.0, 0.0);
    float3 y = float3(0.0, 1.0, 0.0);
    float3 z = float3(0.0, 0.0, 1.0);
    float sum = wlm_smoke_light(first, second, x) + wlm_smoke_light(first, second, -x);
    sum += wlm_smoke_light(first, second, y) + wlm_smoke_light(first, second, -y);
    sum += wlm_smoke_light(first, second, z) + wlm_smoke_light(first, second, -z);
    return radiance * (sum / 6.0);
}

// Returns the light that the smoke emits.
float3 wlm_smoke_glow(float4 first, float4 second)
{
    return float3(0.0, 0.0, 0.0);
}

// Returns all light under one light and the sky, and the opacity: pixel = rgb + behind * (1 - opacity).
float4 wlm_smoke_pixel(float2 place, float time, float texels, float3 toward, float3 irradiance, float3 sky)
{
    float4 first;
    float4 second;
    wlm_smoke_texels(place, time, texels, first, second);
    float3 light = wlm_smoke_lit(first, second, toward, irradiance) + wlm_smoke_sky(first, second, sky);
    return float4(light + wlm_smoke_glow(first, second), wlm_smoke_alpha(first, second));
}
