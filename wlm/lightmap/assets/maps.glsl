
const int WLM_LIGHTMAP_SIDE = @side@; // texels of a slice of F_uvt along a side

// A slice of F_uvt at a place in its texels; texel i has its centre at i + 1/2.
vec4 wlm_lightmap_slice(int image, vec2 place)
{
    ivec2 first = ivec2(image % @uvt_columns@, image / @uvt_columns@) * WLM_LIGHTMAP_SIDE;
    vec2 inside = clamp(place, vec2(0.5, 0.5), vec2(@side@.0, @side@.0) - vec2(0.5, 0.5));
#ifdef WLM_LIGHTMAP_EXACT
    inside = inside - vec2(0.5, 0.5);
    ivec2 low = ivec2(floor(inside));
    ivec2 high = min(low + ivec2(1, 1), ivec2(WLM_LIGHTMAP_SIDE - 1, WLM_LIGHTMAP_SIDE - 1));
    vec2 share = inside - vec2(low);
    vec4 a = texelFetch(WLM_LIGHTMAP_UVT, first + low, 0);
    vec4 b = texelFetch(WLM_LIGHTMAP_UVT, first + ivec2(high.x, low.y), 0);
    vec4 c = texelFetch(WLM_LIGHTMAP_UVT, first + ivec2(low.x, high.y), 0);
    vec4 d = texelFetch(WLM_LIGHTMAP_UVT, first + high, 0);
    return mix(mix(a, b, share.x), mix(c, d, share.x), share.y);
#else
    return textureLod(WLM_LIGHTMAP_UVT, (vec2(first) + inside) / vec2(@uvt_width@.0, @uvt_height@.0), 0.0);
#endif
}

// F_uvt at the table's hour, at a place from 0 to 1.
vec4 wlm_lightmap_volume(int row, vec2 place)
{
    vec4 time = wlm_lightmap_entry(0);
    vec2 texel = place * @side@.0;
    vec4 early = wlm_lightmap_slice(row * @slices@ + int(time.x), texel);
    return mix(early, wlm_lightmap_slice(row * @slices@ + int(time.y), texel), time.z);
}

// F_ut (an even image) or F_vt (an odd one) at a row of time.
vec2 wlm_lightmap_line(int image, float place, int time)
{
    ivec2 first = ivec2(image % @plane_across@ * @plane_columns@, image / @plane_across@ * @plane_rows@ + time);
    float inside = clamp(place * @plane_columns@.0, 0.5, @plane_columns@.0 - 0.5);
#ifdef WLM_LIGHTMAP_EXACT
    inside = inside - 0.5;
    int low = int(floor(inside));
    vec4 a = texelFetch(WLM_LIGHTMAP_PLANES, first + ivec2(low, 0), 0);
    vec4 b = texelFetch(WLM_LIGHTMAP_PLANES, first + ivec2(min(low + 1, @plane_columns@ - 1), 0), 0);
    return mix(a.xy, b.xy, inside - float(low));
#else
    vec2 at = vec2(first) + vec2(inside, 0.5);
    return textureLod(WLM_LIGHTMAP_PLANES, at / vec2(@planes_width@.0, @planes_height@.0), 0.0).xy;
#endif
}

vec2 wlm_lightmap_plane(int image, float place)
{
    vec4 time = wlm_lightmap_entry(1);
    vec2 early = wlm_lightmap_line(image, place, int(time.x));
    return mix(early, wlm_lightmap_line(image, place, int(time.y)), time.z);
}
