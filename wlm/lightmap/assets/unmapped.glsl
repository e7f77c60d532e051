
// Colour of a tile of frames, or of one colour.
vec3 wlm_lightmap_unmapped(vec4 tile, int record, ivec2 inner)
{
@frames@    return wlm_lightmap_entry(record + 1).xyz;
}
