
const int WLM_LIGHTMAP_FOURS = @fours@; // of @hidden@ units

@gelu@
// b + x W, where the rows of W are `apart` groups of four apart.
vec4 wlm_lightmap_add(vec4 b, vec4 x, int at, int apart)
{
    vec4 sum = b + x.x * wlm_lightmap_four(at) + x.y * wlm_lightmap_four(at + apart);
    return sum + x.z * wlm_lightmap_four(at + 2 * apart) + x.w * wlm_lightmap_four(at + 3 * apart);
}

// Colour of a tile of maps: `record` is the position of its record, `inner` the texel in the tile. G of eq. 4 has two
// hidden layers. Four units of the first at a time are added to the second, whose array has constant indices, so that
// it is in registers.
vec3 wlm_lightmap_mapped(vec4 tile, int record, ivec2 inner)
{
    int row = int(tile.y);
    int start = int(tile.z);
    int second = start + 17 * WLM_LIGHTMAP_FOURS; // the encoded time is in the bias
    ivec2 at = ivec2(row % @uv_columns@, row / @uv_columns@) * @TILE@ + inner;
    vec4 uv = texelFetch(WLM_LIGHTMAP_UV, at, 0);
    vec2 place = (vec2(inner) + vec2(0.5, 0.5)) / @TILE@.0;
    vec4 uvt = wlm_lightmap_volume(row, place);
    vec4 planes = vec4(wlm_lightmap_plane(2 * row, place.x), wlm_lightmap_plane(2 * row + 1, place.y));
    int third = second + (4 * WLM_LIGHTMAP_FOURS + 1) * WLM_LIGHTMAP_FOURS;
    vec4 b[WLM_LIGHTMAP_FOURS];
@biases@    for (int i = 0; i < WLM_LIGHTMAP_FOURS; i++) {
        vec4 a = wlm_lightmap_add(wlm_lightmap_entry(record + 3 + i), uv, start + i, WLM_LIGHTMAP_FOURS);
        a = wlm_lightmap_add(a, uvt, start + 4 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
        a = wlm_lightmap_add(a, planes, start + 8 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
        a = wlm_gelu(a);
        int w = second + 4 * WLM_LIGHTMAP_FOURS * i;
@products@    }
    vec4 y = wlm_lightmap_four(third + 4 * WLM_LIGHTMAP_FOURS);
@outputs@    vec3 gain = wlm_lightmap_entry(record + 1).xyz;
    return max(gain + wlm_lightmap_entry(record + 2).xyz * y.xyz, vec3(0.0, 0.0, 0.0));
}
