// Light from the compressed lightmaps of a scene: each tile of each lightmap is a few rectangles of a texture array,
// found by one lookup texture. For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below
// #version, in ES below the precision statements of the types that it declares.
//
// wlm_scene_sheets: the texture sheets, usampler2D, filter nearest.
// wlm_scene_lut: the texture lut, usampler2D, filter nearest.
// wlm_scene_factors: the texture factors, sampler2D of 32-bit floats, filter nearest.
// wlm_scene_colour: the texture colour, sampler2DArray, filter linear, clamped to its edge.
@second@//
// Call wlm_scene with the lightmap's UVs, u to the right, v down, after the object's scale and offset; the number of
// the sheet that the object reads; and the number of the state, 1.5 for example half-way from the second to the third.

@samplers@
const float WLM_SCENE_TILE = @tile@.0; // texels of a lightmap along a tile

vec3 @name@(vec2 uv, int sheet, float state)
{
    uvec4 place = texelFetch(WLM_SCENE_SHEETS, ivec2(0, sheet), 0); // texels of its lightmap, first entry
    uvec4 tiles = texelFetch(WLM_SCENE_SHEETS, ivec2(1, sheet), 0);
    vec2 size = vec2(place.xy);
    // Tiles begin and end on centres of the lightmap's texels.
    vec2 x = clamp(uv * size - vec2(0.5, 0.5), vec2(0.0, 0.0), size - vec2(1.0, 1.0)) / WLM_SCENE_TILE;
    ivec2 tile = min(ivec2(floor(x)), ivec2(tiles.xy) - ivec2(1, 1));
    uvec4 entry = texelFetch(WLM_SCENE_LUT, ivec2(place.zw) + tile, 0);
    // @entry@
    vec2 first = vec2(entry.xy >> uvec2(@bits@u, @bits@u));
    vec2 steps = vec2(entry.xy & uvec2(@mask@u, @mask@u));
    vec2 extent = vec2(@width@.0, @height@.0); // of a page
@blocks@    vec2 at = first + (x - vec2(tile)) * steps + vec2(0.5, 0.5);
    int components = @components@;
    int component = @component@;
    float page = @page@;
    int before = min(int(state), @last@);
    int after = min(before + 1, @last@);
    float share = state - float(before);
    // A constant, and then a factor for each component.
    vec3 light = vec3(0.0, 0.0, 0.0);
    for (int k = 0; k <= components; k++) {
        vec3 factor = texelFetch(WLM_SCENE_FACTORS, ivec2(component + k, before), 0).rgb;
        factor = mix(factor, texelFetch(WLM_SCENE_FACTORS, ivec2(component + k, after), 0).rgb, share);
        vec2 spot = at + vec2(float(k - 1) * (steps.x + 1.0), 0.0);
@coarse@        spot = spot / extent;
        if (k > 0)
            @read@
        if (components > 0)
            light += factor;
    }
    return max(light, vec3(0.0, 0.0, 0.0));
}
