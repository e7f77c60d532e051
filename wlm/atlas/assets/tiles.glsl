
const vec2 WLM_ATLAS_SIZE = vec2(@width@.0, @height@.0); // of the lightmap, in texels
const float WLM_ATLAS_TILE = @tile@.0; // texels of the lightmap along a tile

vec3 wlm_atlas(vec2 uv)
{
    // Tiles begin and end on centres of the lightmap's texels.
    vec2 x = clamp(uv * WLM_ATLAS_SIZE - vec2(0.5, 0.5), vec2(0.0, 0.0), WLM_ATLAS_SIZE - vec2(1.0, 1.0));
    x = x / WLM_ATLAS_TILE;
    ivec2 tile = min(ivec2(floor(x)), textureSize(WLM_ATLAS_LUT, 0) - ivec2(1, 1));
    uvec2 entry = texelFetch(WLM_ATLAS_LUT, tile, 0).xy;
    // An entry is the first texel of the tile's rectangle, and in the low bits its texels less one.
    uvec2 first = entry >> uvec2(@bits@u, @bits@u);
    uvec2 steps = entry & uvec2(@mask@u, @mask@u);
@blocks@    return wlm_atlas_colour_at(vec2(first) + (x - vec2(tile)) * vec2(steps) + vec2(0.5, 0.5));
}
