
// Linear light of a texel of the group's tile and of the one @below@ rows below.
void wlm_lightmap_pair(ivec2 texel, out vec3 light[2])
{
    ivec2 place = texel / @TILE@;
    ivec2 inner = texel - place * @TILE@;
    int record = @head@ + (place.y * WLM_LIGHTMAP_COLUMNS + place.x) * WLM_LIGHTMAP_RECORD;
    vec4 tile = wlm_lightmap_entry(record);
    if (int(tile.x) == 3) {
        wlm_lightmap_mapped(tile, record, inner, light);
    } else {
        light[0] = wlm_lightmap_unmapped(tile, record, inner);
        light[1] = wlm_lightmap_unmapped(tile, record, inner + ivec2(0, @below@));
    }
    light[0] = wlm_lightmap_linear(light[0]);
    light[1] = wlm_lightmap_linear(light[1]);
}
