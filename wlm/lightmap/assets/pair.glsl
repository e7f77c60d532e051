
@gelu@
shared vec4 wlm_lightmap_weights[@weights@];

// Copies the network of a tile to the memory that a group of @invocations@ invocations shares. Each calls it once, with
// a texel of the tile, the same for all, and its own index.
void wlm_lightmap_begin(ivec2 texel, int index)
{
    ivec2 place = texel / @TILE@;
    vec4 tile = wlm_lightmap_entry(@head@ + (place.y * WLM_LIGHTMAP_COLUMNS + place.x) * WLM_LIGHTMAP_RECORD);
    int count = int(tile.x) == 3 ? @weights@ : 0;
    for (int i = index; i < count; i += @invocations@)
        wlm_lightmap_weights[i] = wlm_lightmap_four(int(tile.z) + i);
    barrier();
}

// Colours of two texels of a tile of maps, @below@ rows apart: `record` is the position of its record, `inner` the
// upper texel in the tile. G of eq. 4 has two hidden layers of @hidden@ units. Each weight that is read serves both
// texels. Four units of the first layer at a time are added to the second, whose array has constant indices, so that it
// is in registers.
void wlm_lightmap_mapped(vec4 tile, int record, ivec2 inner, out vec3 colour[2])
{
    int row = int(tile.y);
    ivec2 at = ivec2(row % @uv_columns@, row / @uv_columns@) * @TILE@ + inner;
    vec4 uv0 = texelFetch(WLM_LIGHTMAP_UV, at, 0);
    vec4 uv1 = texelFetch(WLM_LIGHTMAP_UV, at + ivec2(0, @below@), 0);
    vec2 place = (vec2(inner) + vec2(0.5, 0.5)) / @TILE@.0;
    vec2 under = (vec2(inner) + vec2(0.5, 0.5 + @below@.0)) / @TILE@.0;
    vec2 ut = wlm_lightmap_plane(2 * row, place.x);
    vec4 uvt0 = wlm_lightmap_volume(row, place);
    vec4 uvt1 = wlm_lightmap_volume(row, under);
    vec4 planes0 = vec4(ut, wlm_lightmap_plane(2 * row + 1, place.y));
    vec4 planes1 = vec4(ut, wlm_lightmap_plane(2 * row + 1, under.y));
    // The encoded time is in the bias.
    vec4 w0;
    vec4 w1;
    vec4 w2;
    vec4 w3;
    vec4 b[2 * @fours@];
@biases@    for (int i = 0; i < @fours@; i++) {
        vec4 a0 = wlm_lightmap_entry(record + 3 + i);
        vec4 a1 = a0;
@sums@        a0 = wlm_gelu(a0);
        a1 = wlm_gelu(a1);
        int w = @second@ + 4 * @fours@ * i;
@products@    }
    vec4 y0 = wlm_lightmap_weights[@last@];
    vec4 y1 = y0;
    vec4 a0;
    vec4 a1;
@outputs@    vec3 gain = wlm_lightmap_entry(record + 1).xyz;
    vec3 spread = wlm_lightmap_entry(record + 2).xyz;
    colour[0] = max(gain + spread * y0.xyz, vec3(0.0, 0.0, 0.0));
    colour[1] = max(gain + spread * y1.xyz, vec3(0.0, 0.0, 0.0));
}
