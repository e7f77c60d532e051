
// The texture at a place in texels; texel i has its centre at i + 1/2.
@type@ wlm_atlas_@name@_at(vec2 place)
{
    ivec2 last = textureSize(@image@, 0) - ivec2(1, 1);
#ifdef WLM_ATLAS_EXACT
    vec2 inside = clamp(place - vec2(0.5, 0.5), vec2(0.0, 0.0), vec2(last));
    ivec2 low = ivec2(floor(inside));
    ivec2 high = min(low + ivec2(1, 1), last);
    vec2 share = inside - vec2(low);
    vec4 top = mix(texelFetch(@image@, low, 0), texelFetch(@image@, ivec2(high.x, low.y), 0), share.x);
    vec4 bottom = mix(texelFetch(@image@, ivec2(low.x, high.y), 0), texelFetch(@image@, high, 0), share.x);
    return mix(top, bottom, share.y).@channels@;
#else
    return textureLod(@image@, place / vec2(last + ivec2(1, 1)), 0.0).@channels@;
#endif
}
