
// Colour of a texel of the map in gamma space, at least 0; of an empty tile 0.
vec3 wlm_colour(ivec2 texel)
{
    ivec2 place = texel / @TILE@;
    ivec2 inner = texel - place * @TILE@;
    int record = @head@ + (place.y * WLM_LIGHTMAP_COLUMNS + place.x) * WLM_LIGHTMAP_RECORD;
    vec4 tile = wlm_lightmap_entry(record);
@kinds@    return wlm_lightmap_unmapped(tile, record, inner);
}
